"""An exchange with a drive on a clock that the test advances; only threads and locks are real."""

from __future__ import annotations

import itertools
import socket
import struct
import threading
from collections.abc import Callable

import pytest
from modbus_wire import Answer, acs880

from greenroof_ros.live.devices import drive, exchange
from greenroof_ros.live.devices.drive import DriveEndpoint, DriveStatus
from greenroof_ros.live.devices.drive_file import DriveFile
from greenroof_ros.live.devices.exchange import DriveExchange, DriveSnapshot
from greenroof_ros.live.devices.modbus_line import Address, DriveError

# Longest time that passes between two looks of the test (s).
STEP_S = 0.05


class Clock:
    """Stands in for the modules `time` of the driver; whoever sleeps is parked until it is time."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.suspended = 0.0
        self._due: float | None = None
        self._wakes = False  # whether the sleep ends early if something is requested
        self._turn = threading.Condition()

    def monotonic(self) -> float:
        return self.now

    def boot_time(self) -> float:
        return self.now + self.suspended

    def sleep(self, seconds: float, wakes: bool = False) -> None:
        with self._turn:
            self._due, self._wakes = self.now + max(0.0, seconds), wakes
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._due is None)

    def wake(self) -> None:
        with self._turn:
            if self._wakes and self._due is not None:
                self._due = self.now

    def advance(self, thread: threading.Thread) -> None:
        """Let at most one step pass; the thread is parked before and after."""
        with self._turn:
            self._wait_for(thread)
            if self._due is not None:
                self.now = max(self.now, min(self._due, self.now + STEP_S))
                if self.now >= self._due:
                    self._due = None
                    self._turn.notify_all()
                    self._wait_for(thread)

    def _wait_for(self, thread: threading.Thread) -> None:
        while self._due is None and thread.is_alive():
            self._turn.wait(0.01)


class Wake(threading.Event):
    """The event for which the exchange waits between two rounds."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock

    def set(self) -> None:
        super().set()
        self._clock.wake()

    def wait(self, timeout: float | None = None) -> bool:
        if not self.is_set():
            self._clock.sleep(timeout or 0.0, wakes=True)
        return True


class Cable:
    """Stands in for a connection on Modbus."""

    where = "there"

    def __init__(self, bench: Bench, timeout_s: float) -> None:
        self._bench, self._timeout_s, self.connected = bench, timeout_s, False

    def connect(self) -> None:
        self._bench.connections += 1
        self.connected = True
        self._bench.cable = self

    def close(self) -> None:
        self.connected = False

    def error(self, kind: str, problem: str) -> DriveError:
        return DriveError(kind, f"there: {problem}")

    def read(self, address: int, count: int) -> list[int]:
        data = self._request(f"reading register {address}", 3, address, count)
        return list(struct.unpack(f">{count}H", data[9:]))

    def write(self, address: int, word: int) -> None:
        self._request(f"writing 0x{word:04X} to register {address}", 6, address, word)

    def _request(self, action: str, function: int, address: int, number: int) -> bytes:
        bench = self._bench
        bench.asked.append(bench.clock.now)
        request = struct.pack(">HHHBBHH", 0, 0, 6, 1, function, address, number)
        answers = bench.answer(request) if self.connected else None
        if answers is None:
            self.connected = False
            raise self.error("connection", f"{action}: the connection was closed")
        if not answers:
            bench.clock.sleep(self._timeout_s)
            raise self.error(
                "connection", f"{action}: no valid response within {self._timeout_s:g} s")
        ((_, data),) = answers
        if data[7] & 0x80:
            raise self.error("answer", f"{action}: rejected with exception {data[8]}")
        return data


class Bench:
    """A drive, and an exchange with it that is asked for a speed again and again.

    Attributes:
        clock: the time for both.
        drive: registers of the drive.
        answer: answers a request; by default, the drive.
        exchange: not yet started.
        speed: the speed that is asked for; None for off.
        asks: whether it is asked; if a start failed, it is asked for off.
        insists: whether the speed is asked for even after a failed start.
        connections: number of connections so far.
        asked: when each request came (s).
    """

    cable: Cable

    def __init__(self, monkeypatch: pytest.MonkeyPatch, file: DriveFile) -> None:
        self.clock, self.drive = Clock(), acs880()
        self.answer: Callable[[bytes], Answer] = self.drive
        self.speed: float | None = None
        self.asks, self.insists, self.connections, self.asked = True, False, 0, list[float]()
        for module in (drive, exchange):
            monkeypatch.setattr(module, "time", self.clock)
        monkeypatch.setattr(exchange, "boot_time", self.clock.boot_time)
        monkeypatch.setattr(exchange, "acquire_drive_lock", lambda _endpoint: socket.socket())
        monkeypatch.setattr(drive, "ModbusLine", lambda _at, _set, timeout: Cable(self, timeout))
        self.exchange = DriveExchange(DriveEndpoint(file, Address(line="there")))
        self.exchange._wake = Wake(self.clock)

    @property
    def now(self) -> DriveSnapshot:
        return self.exchange.snapshot

    def step(self) -> None:
        if self.asks:
            failed = self.now.start_failed and not self.insists
            self.exchange.request_speed(None if failed else self.speed)
        self.clock.advance(self.exchange._thread)

    def until(self, condition: Callable[[], object], within: float = 300.0) -> float:
        """Let time pass until a condition holds, and return how long that took (s)."""
        began = self.clock.now
        while not condition():
            assert self.clock.now - began < within, "did not come to be so"
            self.step()
        return self.clock.now - began

    def wait(self, seconds: float) -> None:
        until = self.clock.now + seconds
        self.until(lambda: self.clock.now >= until, seconds + 1.0)

    def connect(self) -> None:
        self.exchange.start()
        self.until(lambda: self.now.connected)

    def run(self) -> None:
        """Start, and wait until the drive runs at half of its speed."""
        self.exchange.start()
        self.speed = 0.5
        self.until_half()

    def until_half(self) -> float:
        return self.until(lambda: self.drive.values[4] == 10000)

    def until_reported(self, condition: Callable[[DriveStatus], object]) -> None:
        """Wait until the drive's status meets a condition."""
        self.until(lambda: self.now.status and condition(self.now.status))

    def until_written(self, order: tuple[int, int]) -> float:
        """Wait until a word is written to a register."""
        self.drive.written.clear()
        return self.until(lambda: order in self.drive.written)

    def written_in(self, rounds: int) -> list[tuple[int, int]]:
        """Return what is written from now on in this many rounds, with at least two words each."""
        self.drive.written.clear()
        self.until(lambda: len(self.drive.written) > 2 * rounds)
        return self.drive.written

    def lose(self) -> None:
        """Close the connection, and each new one at its first request."""
        self.answer = lambda _request: None
        self.cable.close()
        self.until(lambda: not self.now.connected)

    def silences(self) -> list[float]:
        """Return the times without any request, if longer than the waits between attempts."""
        gaps = [later - before for before, later in itertools.pairwise(self.asked)]
        return [gap for gap in gaps if gap > 6.0]

    def close(self) -> float:
        """Close the exchange if it was started, and return how long that took (s)."""
        began, self.asks = self.clock.now, False
        closing = threading.Thread(target=self.exchange.close)
        closing.start()
        self.exchange._thread.join(0.05)
        while self.exchange._thread.is_alive():
            self.clock.advance(self.exchange._thread)
        closing.join()
        return self.clock.now - began
