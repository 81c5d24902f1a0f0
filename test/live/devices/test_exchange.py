"""The thread that keeps up the connection to a drive: by a clock of the test, and by real ports.

That a pump stops in time with each fault of a drive and its line is shown by the fault campaign.
"""

from __future__ import annotations

import itertools
import math
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import pytest
from modbus_wire import Answer, Wire, acs880
from places import CHECKOUT
from simulators import until as wait

from greenroof_ros.live.devices import drive, exchange
from greenroof_ros.live.devices.drive import DriveEndpoint, DriveStatus
from greenroof_ros.live.devices.drive_file import (
    LIMIT_S,
    MAX_RAMP_S,
    DriveFile,
    find_drive_file,
    read_drive_file,
)
from greenroof_ros.live.devices.exchange import (
    DriveExchange,
    DriveInUseError,
    DriveSnapshot,
    acquire_drive_lock,
    stop_drive,
)
from greenroof_ros.live.devices.modbus_line import Address, DriveError, parse_address

PERIOD_S, DEAD_MAN_S, TIMEOUT_S = 0.1, 1.0, 0.5
SILENT = "nothing is sent for 10 s"
OFF, RUN, ACKNOWLEDGE = (0, 0x047E), (0, 0x047F), (0, 0x04FE)
TRIPPED = {3: 0x1238, 400: 0x1234}  # with a code that the drive file does not have

SHIPPED = read_drive_file(find_drive_file("abb_acs880"))
assert SHIPPED.timeout["serial"].unguarded_after_power_up_s == 30.0
# Without the time after power-up, for which only its own test waits.
ABB = replace(SHIPPED, timeout={
    "serial": replace(SHIPPED.timeout["serial"], unguarded_after_power_up_s=0.0)
})


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


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    with closing(Bench(monkeypatch, ABB)) as bench:
        yield bench


# --- by the test's clock: what is asked for -------------------------------------------------------


def test_it_runs_while_asked_and_stops_when_told_or_asked_nonsense_or_not_at_all(
    bench: Bench
) -> None:
    """What was asked for before a suspend, during which `time.monotonic` stands still, counts no
    more. The drive is also stopped by a close, which reads back the stop.
    """
    bench.run()
    for off in (None, float("nan"), 1.5, 0.0):
        bench.speed = 0.5
        bench.until_half()
        bench.until_reported(lambda status: status.speed == 0.5)
        bench.speed = off
        assert bench.until_written(OFF) < PERIOD_S + STEP_S
        bench.until_reported(lambda status: status.at_rest)
    for suspended, within in ((0.0, DEAD_MAN_S), (3600.0, 0.0)):
        bench.asks, bench.speed = True, 0.5
        bench.until_half()
        bench.asks, bench.clock.suspended = False, suspended
        assert within - STEP_S < bench.until_written(OFF) < within + PERIOD_S + STEP_S
    bench.exchange.request_speed(0.5)
    bench.until_half()
    assert bench.close() < 1.0
    assert bench.drive.values[0] == 0x047E and not bench.now.connected
    assert bench.exchange.outcome() == "released the drive: speed 0.0%, off"


# --- by the test's clock: connections that break --------------------------------------------------


def test_one_lost_answer_stops_nothing_and_a_new_connection_begins_with_a_stop(
    bench: Bench
) -> None:
    bench.run()
    bench.drive.written.clear()
    lost = iter([True])
    bench.answer = lambda request: [] if next(lost, False) else bench.drive(request)
    bench.until(lambda: bench.now.problem)
    bench.until(lambda: bench.now.problem == "")
    assert bench.connections == 1 and OFF not in bench.drive.written
    bench.drive.silent = True
    bench.until(lambda: not bench.now.connected)
    bench.drive.written.clear()
    bench.drive.silent = False
    bench.until(lambda: bench.now.connected)
    assert bench.drive.written[0] == OFF
    bench.drive.silent = True
    bench.close()
    with pytest.raises(OSError, match=r"not stopped .*no valid .*its own timeout \(5 s\)"):
        bench.exchange.outcome()


def test_after_each_connection_the_drive_is_off_while_it_may_not_guard(bench: Bench) -> None:
    """For 30 s; a cut cable looks like a power cycle, so they begin again."""
    bench.exchange.endpoint, bench.speed = DriveEndpoint(SHIPPED, Address(line="there")), 0.5
    bench.exchange.start()
    for _ in range(2):
        bench.until(lambda: bench.now.connected)
        assert "is not effective for 30 s after power-up" in str(bench.now.unguarded)
        assert bench.until_written(RUN) >= 30.0 - 2 * PERIOD_S
        bench.until_half()
        bench.lose()
        bench.answer = bench.drive


@pytest.mark.parametrize("problem", ["the drive failed to start: ", "the connection was lost: "])
def test_after_a_failed_start_the_next_follows_an_off_that_was_asked_for(
    bench: Bench, problem: str
) -> None:
    """The caller counts starts, and waits between them; here it asks for the speed all the time."""
    bench.connect()
    obeys, bench.insists, bench.speed = bench.drive.on_write, True, 0.5
    if "start" in problem:
        bench.drive.on_write = lambda _address, _word: None
    else:
        bench.until_half()
        bench.lose()
        bench.answer = bench.drive
    bench.until(lambda: bench.now.start_failed and bench.now.connected)
    bench.drive.on_write = obeys
    bench.drive.written.clear()
    bench.wait(20.0)
    assert RUN not in bench.drive.written and bench.now.problem.startswith(problem)
    bench.insists = False
    bench.until_half()


# --- by the test's clock: faults, and another master ----------------------------------------------


def test_a_fault_is_acknowledged_by_a_reset_while_it_is_seen(bench: Bench) -> None:
    """A reset before the first connection does not count: no fault was seen."""
    bench.drive.values.update(TRIPPED)
    bench.speed = 0.5
    bench.exchange.reset()
    bench.exchange.start()
    bench.until(lambda: "fault: not in the drive file (code 4660" in bench.now.problem)
    assert ACKNOWLEDGE not in bench.written_in(rounds=5)
    bench.exchange.reset()
    bench.until_half()
    assert ACKNOWLEDGE in bench.drive.written


def test_another_master_is_given_way_and_a_reset_meanwhile_is_forgotten(bench: Bench) -> None:
    """While another master's control word is active, the drive is only stopped; then for 10 s."""
    bench.drive.values.update(TRIPPED)
    bench.connect()
    bench.written_in(rounds=2)
    obeys = bench.drive.on_write
    bench.drive.on_write = lambda _address, _word: bench.drive.values.update({0: 0x0001})
    bench.until(lambda: "someone else is writing to the drive" in bench.now.problem)
    bench.exchange.reset()
    bench.wait(2 * PERIOD_S)
    bench.drive.on_write, bench.drive.values[0] = obeys, 0x047E
    assert ACKNOWLEDGE not in bench.written_in(rounds=5)
    bench.drive.values.update({3: 0x1231, 400: 0})
    bench.speed = 0.5
    assert 8.0 < bench.until_half() < 10.0


# --- by the test's clock: a drive that refuses to be stopped, or runs on --------------------------

Speed = float | None | Callable[[float], float]


def answer_at(bench: Bench, speed: Speed, seconds: float, local: bool, request: bytes) -> Answer:
    """Answer as a drive that acknowledges *stop*, at a share of the rated speed.

    Args:
        bench: the drive with its exchange.
        speed: its speed, or that by the time; None cannot be read.
        seconds: the time (s).
        local: whether it is in local control.
        request: the request.
    """
    bench.drive.values[3] = 0x1031 if local else 0x1231
    bench.drive.values.pop(4, None)
    if (at := speed(seconds) if callable(speed) else speed) is not None:
        bench.drive.values[4] = round(20000 * at)
    return bench.drive(request)


NEVER = math.inf, math.inf
FALLEN = "the drive acknowledges *stop*, but its speed has not fallen for 10 s"
# Until when (s), the speed, and what else is so; the first silence (s), and the faults.
COURSES: dict[str, tuple[list[tuple[float, Speed, str]], float, float, set[str]]] = {
    # It refuses the word on two connections; it closes each connection for a while.
    "refuses to stop": ([(8, 0.5, "refused")], 0.0, 1.0, {""}),
    "closes connections": ([(4, 0.5, "closes"), (9, 0.0, ""), (29, 0.0, "closes")], 10.0, 29.0,
                           {""}),
    # A ramp of 1 % in 9 s, which is slow but falls; then noise at standstill.
    "obeys": ([(470, lambda now: max(0.019, 0.5 - 0.01 * (now // 9)), "")], *NEVER, {""}),
    # Has not fallen for 10 s; left for 10 s; and again when the longest ramp has passed.
    "runs on": ([(165, 0.5, "")], 10.0, 10.5, {"", FALLEN}),
    # What is known of the speed outlives connections that break.
    "breaks": ([(0.7 * part, 0.5, "cut") for part in range(1, 25)], 10.0, 15.0, {"", FALLEN}),
    # From 5 s on two answers in turn end a connection; 10 s later that is long enough, and is
    # noticed at the next end of a connection, at most 5 s later.
    "speed not read": ([(5, 0.0, ""), (165, None, "")], 15.0, 5.0 + exchange.UNREAD_S, {""}),
    # A meter shows that it runs although it reports rest.
    "rest is not true": ([(5, 0.0, "flows")], 0.0, 0.5, {""}),
    # One that stood, or was run, or is in a person's hands at 9 s, begins again.
    **{what: ([(9, 0.5, ""), (9.5, speed, how), (18, 0.5, ""), (80, 0.5, "local")], *NEVER, {""})
       for what, speed, how in (
           ("stood", 0.0, ""), ("was run", 0.5, "asked"), ("in local control", 0.5, "local"))},
}


@pytest.mark.parametrize("course", COURSES)
def test_one_that_is_not_seen_to_slow_down_is_left_again_and_again(
    bench: Bench, course: str
) -> None:
    """During the silence, the fault is seen."""
    parts, first, latest, expected = COURSES[course]
    bench.run()
    began, faults, left, was_silent = bench.clock.now, set[str](), list[float](), False
    bench.asked.clear()
    for until, speed, how in parts:
        bench.speed, bench.exchange.flows_at_rest = 0.5 if how == "asked" else None, how == "flows"
        bench.answer = lambda request, speed=speed, how=how: answer_at(  # type: ignore[misc]
            bench, speed, bench.clock.now - began, how == "local", request)
        if how == "closes":
            bench.answer = lambda _request: None
        bench.drive.refused = {0} if how == "refused" else set()
        if how == "cut":
            bench.cable.close()
        while bench.clock.now - began < until:
            bench.step()
            if (status := bench.now.status) is not None:
                faults.add(status.fault)
                assert status.runs_on == (status.fault == FALLEN)
            silent = SILENT in bench.now.problem
            left += [bench.clock.now - began] * (silent and not was_silent)
            was_silent = silent
    assert (faults, bool(left)) == (expected, math.isfinite(first)), left
    assert all(first <= at <= latest for at in left[:1])
    longest = LIMIT_S + MAX_RAMP_S + exchange.UNREAD_S
    assert all(longest - 5.5 < b - a < longest for a, b in itertools.pairwise(left))
    bench.answer, bench.exchange.flows_at_rest, bench.drive.refused = bench.drive, False, set()
    bench.until_reported(lambda status: status.at_rest and not status.fault)
    assert all(silence > 9.9 for silence in bench.silences()[:len(left)])


# --- the end, and two drivers ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("falls_for", "took", "stands"), [(20.0, 20.0, True), (math.inf, 3.0, False)]
)
def test_a_ramp_is_waited_for_at_the_end_but_no_drive_that_turns_on(
    bench: Bench, falls_for: float, took: float, stands: bool
) -> None:
    """One that does not obey is left soon, so that its own timeout stops it."""
    bench.run()
    began, bench.speed = bench.clock.now, None
    bench.answer = lambda request: answer_at(
        bench, lambda now: 0.5 * max(0.0, 1.0 - now / falls_for), bench.clock.now - began, False,
        request,
    )
    assert bench.close() == pytest.approx(took, abs=1.0)
    assert bench.drive.values[0] == 0x047E and not bench.now.connected
    assert bench.now.status is not None and bench.now.status.at_rest == stands
    if not stands:
        with pytest.raises(OSError, match=r"not stopped .*speed 50.0%.* timeout \(5 s\) can"):
            bench.exchange.outcome()


def test_a_second_driver_on_the_same_machine_keeps_off() -> None:
    """Only the supervisor's stop ignores the lock, of its own driver."""
    with closing(Wire(acs880())) as wire:
        at = DriveEndpoint(ABB, parse_address(wire.gateway, "at"))
        with closing(DriveExchange(at)) as second:
            with acquire_drive_lock(at):
                second.start()
                holder = f"process {os.getpid()} on this computer"
                wait(lambda: holder in second.snapshot.problem)
                with pytest.raises(DriveInUseError, match=holder):
                    stop_drive(at, driver=1)
                assert wire.connections == 0
                assert str(stop_drive(at, driver=os.getpid())) == "speed 0.0%, off"
            wait(lambda: second.snapshot.connected)


def test_who_stops_the_drive_of_a_dead_driver_keeps_other_drivers_off_and_tries_three_times(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drive that turns on is left after 1 s here."""
    monkeypatch.setattr(exchange, "STEADY_S", 1.0)
    drive = acs880()
    drive.on_write = lambda _address, _word: None
    drive.values.update({3: 0x1137, 4: 20000})
    with closing(Wire(drive)) as wire, ThreadPoolExecutor() as pool:
        at = DriveEndpoint(ABB, parse_address(wire.gateway, "at"))
        stop = pool.submit(stop_drive, at)
        wait(lambda: wire.requests)
        with pytest.raises(DriveInUseError):
            acquire_drive_lock(at)
        assert str(stop.result()) == "speed 100.0%, running, local control"
        assert wire.frames[0][12:] == "01060000047e"  # the very first request
        drive.silent = True
        with pytest.raises(DriveError, match="no valid response"):
            stop_drive(at)
        assert wire.connections == 4


def test_the_waits_fit_into_the_longer_ones_of_bringup_and_service() -> None:
    """The pump node's end; the supervisor's stop, perhaps after another one; the other nodes."""
    from greenroof_ros.live.supervisor import ACTUATORS_ENDING_S, ENDING_S, KILLING_S

    leave = exchange.REST_LIMIT_S
    assert MAX_RAMP_S < leave < leave + exchange.MAX_WAIT_S < ACTUATORS_ENDING_S
    service = (CHECKOUT / "examples/greenroof.service").read_text()
    limit = float(service.partition("\nTimeoutStopSec=")[2].split()[0])
    others_end = 2 * (ENDING_S + KILLING_S)  # the other nodes, and the recorder
    assert limit > max(ACTUATORS_ENDING_S + KILLING_S + leave, 2 * leave) + others_end
