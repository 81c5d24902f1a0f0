"""The thread that keeps a drive up, against registers behind a real TCP port."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from graphs import free_ports
from modbus_wire import Registers, SerialWire, Wire, acs880, over_serial
from places import CHECKOUT

from greenroof_ros.drives.address import parse_address, parse_drive_address
from greenroof_ros.drives.drive import Drive, DriveStatus
from greenroof_ros.drives.drive_file import DriveFile, Timeouts, find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import DriveExchange, State, stop_drive
from greenroof_ros.drives.lock import DriveLock, HeldError
from greenroof_ros.drives.modbus_line import DriveError

PERIOD, DEAD_MAN, TIMEOUT = 0.05, 0.3, 0.2
OFF, RUN = (0, 0x047E), (0, 0x047F)


@pytest.fixture(scope="module")
def file() -> DriveFile:
    """ABB's, but for the time after power-up, which only its own test waits for."""
    read = read_drive_file(find_drive_file("abb_acs880"))
    assert read.timeout.serial is not None
    return replace(
        read, timeout=Timeouts(replace(read.timeout.serial, unguarded_after_power_up_s=0.0))
    )


@pytest.fixture
def drive() -> Registers:
    return acs880()


@pytest.fixture
def wire(drive: Registers) -> Iterator[Wire]:
    wire = Wire(drive)
    yield wire
    wire.close()


def made(file: DriveFile, at: str, **options: float) -> DriveExchange:
    return DriveExchange(
        file, parse_drive_address(at, "at"), PERIOD, DEAD_MAN, **{"timeout_s": TIMEOUT, **options}
    )


@pytest.fixture
def exchange(file: DriveFile, wire: Wire) -> Iterator[DriveExchange]:
    with closing(made(file, wire.gateway)) as exchange:
        yield exchange


def wait(what: Callable[[], Any], within: float = 60.0) -> float:
    """Wait until something holds; return how long that took (s)."""
    began = time.monotonic()
    while not what():
        assert time.monotonic() - began < within, "it did not come to that in time"
        time.sleep(0.005)
    return time.monotonic() - began


class Hand:
    """Asks for a speed again and again, as the node does."""

    def __init__(self, exchange: DriveExchange, speed: float | None) -> None:
        self.speed, self._ended = speed, threading.Event()

        def ask() -> None:
            while not self._ended.wait(0.05):
                exchange.demand(self.speed)

        self._thread = threading.Thread(target=ask, daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()


@contextmanager
def driving(
    file: DriveFile, at: str, speed: float | None = None, **options: float
) -> Iterator[DriveExchange]:
    """Run a drive at a speed until the end."""
    with closing(made(file, at, **options)) as exchange:
        hand = Hand(exchange, speed)
        exchange.start()
        try:
            yield exchange
        finally:
            hand.end()


@pytest.fixture
def hand(exchange: DriveExchange) -> Iterator[Hand]:
    made = Hand(exchange, None)
    yield made
    made.end()


def run_at_half(exchange: DriveExchange, drive: Registers, hand: Hand) -> None:
    """Start, and wait until the drive runs at half of its speed."""
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)


def test_it_stops_the_drive_first_and_reads_what_it_is(
    exchange: DriveExchange, drive: Registers, wire: Wire
) -> None:
    drive.values.update({0: 0x047F, 1: 20000, 3: 0x1337, 4: 20000})  # left running by somebody
    exchange.start()
    wait(lambda: exchange.snapshot.connected)
    assert wire.frames[0][12:] == "01060000047e"  # the very first request
    now = exchange.snapshot
    assert now.status is not None and now.status.stands and not now.status.running
    assert now.identity.startswith("ABB ACS880") and "1234" in now.identity
    assert (now.timeout_s, now.timeout_known, now.timeout_note) == (5.0, True, "")
    assert (now.problem, now.errors) == ("", 0)
    time.sleep(5 * PERIOD)
    assert RUN not in drive.written
    assert drive.written.count(OFF) > 3  # which keeps the drive's own timeout fed


def test_it_runs_while_asked_and_stops_when_told(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    exchange.start()
    hand.speed = 0.4
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.speed == 0.4)
    assert drive.written[-2:] in ([(1, 8000), RUN], [RUN, (1, 8000)])
    hand.speed = 0.6
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.speed == 0.6)
    hand.speed = None
    assert wait(lambda: drive.values[0] == 0x047E) < 0.05 + 3 * PERIOD
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.stands)
    assert exchange.snapshot.errors == 0


def test_dead_man(exchange: DriveExchange, drive: Registers, hand: Hand) -> None:
    exchange.start()
    hand.speed = 1.0
    wait(lambda: drive.values[4] == 20000)
    hand.end()
    took = wait(lambda: drive.values[0] == 0x047E)
    assert DEAD_MAN - 0.1 < took < DEAD_MAN + 4 * PERIOD


@pytest.mark.parametrize("nonsense", [float("nan"), float("inf"), -0.1, 1.5])
def test_nonsense_is_off(
    exchange: DriveExchange, drive: Registers, hand: Hand, nonsense: float
) -> None:
    run_at_half(exchange, drive, hand)
    hand.speed = nonsense
    wait(lambda: drive.values[0] == 0x047E)
    assert exchange.snapshot.errors > 0
    time.sleep(4 * PERIOD)
    assert drive.values[0] == 0x047E


def test_close_stops_and_reads_back(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    run_at_half(exchange, drive, hand)
    began = time.monotonic()
    exchange.close()
    assert time.monotonic() - began < 1.0
    assert drive.values[0] == 0x047E and not exchange.snapshot.connected
    assert exchange.snapshot.status is not None and exchange.snapshot.status.stands
    count = len(drive.written)
    time.sleep(4 * PERIOD)
    assert len(drive.written) == count


def test_half_open_connection_is_noticed_and_heals(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    run_at_half(exchange, drive, hand)
    drive.silent = True
    bound = 2 * (TIMEOUT + PERIOD) + PERIOD
    assert wait(lambda: not exchange.snapshot.connected) < bound + 0.1
    assert exchange.snapshot.status is None
    assert "no valid answer within 0.2 s" in exchange.snapshot.problem
    drive.written.clear()
    drive.silent = False
    wait(lambda: drive.values[4] == 10000 and exchange.snapshot.connected)
    assert drive.written[0] == OFF
    assert exchange.snapshot.problem == ""


def test_dropped_connection_heals(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    run_at_half(exchange, drive, hand)
    drive.written.clear()
    wire.drop()
    wait(lambda: exchange.snapshot.errors > 0)
    wait(lambda: wire.connections == 2 and exchange.snapshot.connected)
    wait(lambda: drive.values[4] == 10000)
    assert OFF in drive.written  # a new connection begins with a stop


def test_a_drive_that_closes_its_connections_for_a_moment_is_not_left_in_silence(
    file: DriveFile, drive: Registers, wire: Wire
) -> None:
    """Closed at 0 s, connected again after 0.25 s and, twice that and 0.5 s later, at 1.25 s."""
    with driving(file, wire.gateway, 0.5, timeout_s=0.5) as exchange:
        wait(lambda: drive.values[4] == 10000)
        wire.answer = lambda _request: None
        wire.drop()
        time.sleep(1.0)
        assert exchange.snapshot.state is State.CONNECTING
        wire.answer = drive
        assert wait(lambda: exchange.snapshot.connected) < 2.0


def test_one_lost_answer_does_not_stop_the_pump(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    run_at_half(exchange, drive, hand)
    drive.written.clear()
    lost = iter([True])
    wire.answer = lambda request: [] if next(lost, False) else drive(request)
    wait(lambda: exchange.snapshot.errors == 1)
    wait(lambda: exchange.snapshot.problem == "")
    assert exchange.snapshot.connected and wire.connections == 1
    assert OFF not in drive.written


def test_close_of_a_lost_drive_ends_in_time(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    run_at_half(exchange, drive, hand)
    drive.silent = True
    began = time.monotonic()
    exchange.close()
    assert time.monotonic() - began < 2.0


def test_close_connects_once_more_to_stop(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    run_at_half(exchange, drive, hand)
    wire.answer = lambda _request: None
    wire.drop()
    wait(lambda: not exchange.snapshot.connected)
    wire.answer = drive
    exchange.close()
    assert drive.values[0] == 0x047E


def test_nobody_there_and_then_somebody(file: DriveFile, drive: Registers) -> None:
    port = free_ports(1)[0]
    with driving(file, f"tcp://127.0.0.1:{port}") as exchange:
        wait(lambda: exchange.snapshot.errors >= 3)
        assert not exchange.snapshot.connected and "cannot connect" in exchange.snapshot.problem
        with closing(Wire(drive, port)):
            wait(lambda: exchange.snapshot.connected, within=5.5)


def test_waits_between_attempts_grow(file: DriveFile) -> None:
    """Where nobody listens nothing is heard, so that there is no need for silence."""
    port = free_ports(1)[0]
    with driving(file, f"tcp://127.0.0.1:{port}") as exchange:
        time.sleep(2.0)  # attempts after 0, 0.25, 0.75, 1.75 s, and what each takes
        assert 3 <= exchange.snapshot.errors <= 4


def test_own_timeout_that_cannot_be_read(exchange: DriveExchange, drive: Registers) -> None:
    del drive.values[5815]
    exchange.start()
    wait(lambda: exchange.snapshot.connected)
    now = exchange.snapshot
    assert not now.timeout_known and now.timeout_s is None
    assert "reading register 5815: refused with exception 2" in now.timeout_note


def test_the_timeout_of_another_port_guards_nothing(
    file: DriveFile, drive: Registers, wire: Wire
) -> None:
    """ABB's embedded fieldbus is serial: an Ethernet port is an adapter's, with 50.02 and 50.03."""
    with driving(file, wire.at) as exchange:
        wait(lambda: exchange.snapshot.connected)
        now = exchange.snapshot
        assert not now.timeout_known and now.timeout_s is None
        assert "1234" in now.identity
        for words in ("abb_acs880.yaml", "timeout.tcp", "gateway://HOST:PORT"):
            assert words in now.timeout_note
        asked = {frame[-8:-4] for frame in wire.frames if frame[14:16] == "03"}
        assert not asked & {"16b5", "16b7"}  # neither 58.14 nor 58.16 was read


def test_after_each_connection_the_drive_is_off_while_it_may_not_guard(
    file: DriveFile, drive: Registers, wire: Wire
) -> None:
    """Here for 1 s of the 30 s; a cut cable looks like a power cycle, so it counts anew."""
    assert read_drive_file(find_drive_file("abb_acs880")).timeout.serial == replace(
        file.timeout.serial, unguarded_after_power_up_s=30.0  # type: ignore[type-var]
    )
    slow = replace(file, timeout=Timeouts(
        replace(file.timeout.serial, unguarded_after_power_up_s=1.0)  # type: ignore[type-var]
    ))
    began = time.monotonic()
    with driving(slow, wire.gateway, 0.5) as exchange:
        for _ in range(2):
            wait(lambda: exchange.snapshot.connected)
            assert "does not guard for 1 s after power-up" in exchange.snapshot.unguarded
            wait(lambda: RUN in drive.written)
            assert time.monotonic() - began > 1.0
            wait(lambda: exchange.snapshot.unguarded == "" and drive.values[4] == 10000)
            assert exchange.snapshot.problem == ""
            began = time.monotonic()
            wire.drop()
            wait(lambda: not exchange.snapshot.connected)
            drive.written.clear()


def test_own_timeout_that_lets_it_run_on(exchange: DriveExchange, drive: Registers) -> None:
    drive.values[5813] = 2
    exchange.start()
    wait(lambda: exchange.snapshot.connected)
    now = exchange.snapshot
    assert now.timeout_known and now.timeout_s is None
    assert "is 2: Last speed; the pump might run on" in now.timeout_note


def test_the_trip_of_a_lost_connection_is_acknowledged(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    seen = set()
    drive.values.update({3: 0x1238, 400: 0x6681})  # EFB communication loss
    exchange.start()
    hand.speed = 0.5
    while drive.values[4] != 10000:
        if exchange.snapshot.status is not None:
            seen.add(exchange.snapshot.status.fault)
        time.sleep(0.001)
    assert drive.written[:3] == [OFF, (1, 0), OFF] and (0, 0x04FE) in drive.written
    assert seen <= {""}
    assert exchange.snapshot.errors == 1


def test_fault_and_reset(exchange: DriveExchange, drive: Registers, hand: Hand) -> None:
    run_at_half(exchange, drive, hand)
    drive.values.update({3: 0x1238, 4: 0, 400: 0x1234})
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.fault)
    assert exchange.snapshot.status is not None
    assert exchange.snapshot.status.fault == "no text for it (code 4660, 0x1234)"
    wait(lambda: "fault: no text for it (code 4660" in exchange.snapshot.problem)
    assert (0, 0x04FE) not in drive.written
    hand.speed = None
    wait(lambda: drive.values[0] == 0x047E)
    exchange.reset()
    wait(lambda: exchange.snapshot.status and not exchange.snapshot.status.fault)
    assert (0, 0x04FE) in drive.written
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
    assert exchange.snapshot.problem == ""


def test_a_reset_without_a_connection_acknowledges_nothing(
    exchange: DriveExchange, drive: Registers, wire: Wire
) -> None:
    """Nobody has seen that fault: neither before the first connection, nor between two."""
    drive.values.update({3: 0x1238, 400: 0x1234})
    exchange.reset()
    exchange.start()
    for _ in range(2):
        wait(lambda: exchange.snapshot.connected)
        drive.written.clear()
        wait(lambda: len(drive.written) > 20)  # ten rounds, which stop it
        assert (0, 0x04FE) not in drive.written
        assert exchange.snapshot.status is not None and exchange.snapshot.status.fault
        wire.answer = lambda _request: None
        wire.drop()
        wait(lambda: not exchange.snapshot.connected)
        exchange.reset()
        wire.answer = drive
    wait(lambda: exchange.snapshot.connected)
    exchange.reset()
    wait(lambda: exchange.snapshot.status and not exchange.snapshot.status.fault)
    assert (0, 0x04FE) in drive.written


def test_a_reset_that_could_not_be_done_in_time_is_forgotten(
    exchange: DriveExchange, drive: Registers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While somebody else's control word stands the drive is stopped, and nothing else."""
    monkeypatch.setattr("greenroof_ros.drives.exchange.RESET_S", 0.3)
    drive.values.update({3: 0x1238, 400: 0x1234})
    exchange.start()
    wait(lambda: exchange.snapshot.connected and len(drive.written) > 5)

    def overwrite(address: int, _word: int) -> None:
        if address == 0:
            drive.values[0] = 0x0001

    drive.on_write = overwrite
    wait(lambda: "somebody else writes to the drive" in exchange.snapshot.problem)
    exchange.reset()
    time.sleep(0.6)
    drive.on_write = lambda _address, _word: None
    drive.values[0] = 0x047E
    drive.written.clear()
    wait(lambda: len(drive.written) > 20)
    assert (0, 0x04FE) not in drive.written
    assert exchange.snapshot.status is not None and exchange.snapshot.status.fault


def test_a_drive_that_does_not_start_is_left_off_for_a_while(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    exchange.start()
    wait(lambda: exchange.snapshot.connected)
    drive.on_write = lambda _address, _word: None
    hand.speed = 0.5
    wait(lambda: "had no effect within 2 s" in exchange.snapshot.problem)
    drive.written.clear()
    time.sleep(10 * PERIOD)
    assert RUN not in drive.written
    assert drive.written.count((1, 0)) >= 4  # it is being stopped, not started again
    assert exchange.snapshot.connected and exchange.snapshot.problem


def test_a_serial_line_whose_plug_is_pulled(file: DriveFile, drive: Registers) -> None:
    with closing(SerialWire(over_serial(drive))) as wire, driving(
        file, wire.line, 0.5
    ) as exchange:
        wait(lambda: drive.values[4] == 10000)
        assert exchange.snapshot.connected and exchange.snapshot.errors == 0
        wire.close()
        wait(lambda: not exchange.snapshot.connected, within=1.0)
        assert wire.line in exchange.snapshot.problem
        began = time.monotonic()
        exchange.close()
        assert time.monotonic() - began < 2.0


# --- a drive that refuses to be stopped -----------------------------------------------------------


def refusing(drive: Registers, times: list[float]) -> Callable[[bytes], Any]:
    """Answer as a drive that refuses its control word, and write down when it was asked."""

    def answer(request: bytes) -> Any:
        times.append(time.monotonic())
        if request[7:10] == b"\x06\0\0":
            return [(0.0, request[:4] + bytes([0, 3, request[6], 0x86, 6]))]
        return drive(request)

    return answer


def silences(times: list[float]) -> list[float]:
    """Return how long nothing was sent, where that is longer than the waits between attempts."""
    gaps = [later - before for before, later in itertools.pairwise(times)]
    return [gap for gap in gaps if gap > 1.0]


def test_a_drive_that_refuses_to_stop_is_left_in_silence(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    """Its own timeout, 58.16, is 1.5 s; a margin of 1 s makes 2.5 s."""
    drive.values[5815] = 15
    times: list[float] = []
    run_at_half(exchange, drive, hand)
    drive.written.clear()
    wire.answer = refusing(drive, times)
    wait(lambda: "so nothing is sent for 2.5 s" in exchange.snapshot.problem)
    assert "refused with exception 6" in exchange.snapshot.problem
    assert not exchange.snapshot.connected and exchange.snapshot.status is None
    connections = wire.connections
    assert drive.written[-1] == (1, 0)  # what comes after the refused word
    for speed in (None, 0.5):  # who asks for something does not break it
        hand.speed = speed
        time.sleep(0.3)
    exchange.reset()
    wait(lambda: len(silences(times)) == 2, within=8)
    assert min(silences(times)) >= 2.5
    assert wire.connections == connections + 2  # one attempt after each silence
    wire.answer = drive
    wait(lambda: exchange.snapshot.connected, within=5)
    wait(lambda: drive.values[4] == 10000)


def test_the_silence_is_that_of_the_limit_where_the_timeout_is_unknown(
    file: DriveFile, drive: Registers
) -> None:
    del drive.values[5815]
    times: list[float] = []
    with closing(Wire(refusing(drive, times))) as wire, driving(
        file, wire.at, timeout_limit_s=0.8
    ):
        wait(lambda: len(silences(times)) == 1, within=6)
        assert silences(times)[0] >= 1.8


def test_close_in_a_silence_tries_once_more_and_ends(
    exchange: DriveExchange, drive: Registers, wire: Wire
) -> None:
    wire.answer = refusing(drive, [])
    exchange.start()
    wait(lambda: "so nothing is sent for 6 s" in exchange.snapshot.problem)
    count = len(wire.seen)
    began = time.monotonic()
    exchange.close()
    assert time.monotonic() - began < 2.0
    assert len(wire.seen) > count
    assert exchange.snapshot.status is None


def test_its_states(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    assert exchange.snapshot.state is State.CONNECTING
    obeys = drive.on_write
    exchange.start()
    wait(lambda: exchange.snapshot.state is State.STOPPED)
    hand.speed = 0.5
    wait(lambda: exchange.snapshot.state is State.RUNNING)
    drive.on_write = lambda _address, _word: drive.values.update({3: 0x1231})
    hand.speed = None
    wait(lambda: exchange.snapshot.state is State.STOPPING)
    drive.values[4] = 0
    wait(lambda: exchange.snapshot.state is State.STOPPED)
    drive.on_write = obeys
    wire.answer = refusing(drive, [])
    wait(lambda: exchange.snapshot.state is State.SILENT)
    exchange.close()
    assert exchange.snapshot.state is State.CONNECTING and not exchange.snapshot.connected


# --- a drive that acknowledges *stop* and runs on -------------------------------------------------

ACKNOWLEDGES = "it acknowledges *stop*, but its speed has not fallen for 1 s"


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge after 1 s instead of 10, 1.5 instead of 12, and again after 3 instead of 60."""
    for name, seconds in (("RUNS_ON_S", 1.0), ("SEEN_S", 0.5), ("RUNS_ON_AGAIN_S", 3.0)):
        monkeypatch.setattr(f"greenroof_ros.drives.exchange.{name}", seconds)


def asked_at(drive: Registers, times: list[float]) -> Callable[[bytes], Any]:
    """Answer as a drive, and write down when it was asked."""

    def answer(request: bytes) -> Any:
        times.append(time.monotonic())
        return drive(request)

    return answer


def run_on(drive: Registers) -> None:
    """Say from now on that it is off, as after OFF1, and turn at half of its speed all the same."""
    drive.on_write = lambda _address, _word: drive.values.update({3: 0x1231, 4: 10000})


def test_the_waits_for_a_drive_that_runs_on() -> None:
    """Longer than what closing waits for; the pump control waits 15 s (follow_time).

    The node says by drive_timeout_limit, 30 s of ramp and 15 s that a drive which is not heard
    stands: 10 s, and a wait of 5 s between two attempts.
    """
    from greenroof_ros.drives import exchange

    assert exchange.UNREAD_S == 15
    assert exchange.STILL_S < exchange.RUNS_ON_S < exchange.RUNS_ON_S + exchange.SEEN_S < 15
    assert exchange.RUNS_ON_AGAIN_S > exchange.RUNS_ON_S


@pytest.mark.usefixtures("soon")
def test_a_drive_that_runs_on_is_left_in_silence_now_and_then(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    """Its own timeout, 58.16, is 1.5 s; a margin of 1 s makes 2.5 s."""
    drive.values[5815] = 15
    times: list[float] = []
    run_at_half(exchange, drive, hand)
    wire.answer = asked_at(drive, times)
    run_on(drive)
    hand.speed = None
    # Who asks for it sees the cause before the silence.
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.fault == ACKNOWLEDGES)
    assert exchange.snapshot.connected and not silences(times)
    wait(lambda: f"{ACKNOWLEDGES} (it is 50.0%), so nothing is sent for 2.5 s"
         in exchange.snapshot.problem)
    assert "two connections" not in exchange.snapshot.problem
    assert not exchange.snapshot.connected and exchange.snapshot.status is None
    count = len(times)
    drive.written.clear()
    wait(lambda: exchange.snapshot.connected)
    assert drive.written[0] == OFF
    assert len(silences(times)) == 1 and silences(times)[0] >= 2.5
    # It did not help: what the drive says can be read for longer, before the next.
    wait(lambda: len(silences(times)) == 2)
    assert silences(times)[1] >= 2.5
    first, second = [at for at, then in itertools.pairwise(times) if then - at > 1.0]
    assert second - first > 2.5 + 3.0 and len(times) - count > 20
    # It obeys again.
    drive.values.update({3: 0x1231, 4: 0})
    drive.on_write = lambda _address, _word: None
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.stands)
    assert exchange.snapshot.status is not None and exchange.snapshot.status.fault == ""


@pytest.mark.usefixtures("soon")
def test_a_ramp_however_slow_is_not_met_by_silence(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    """1 % in 0.4 s: 40 s from full speed."""
    times: list[float] = []
    run_at_half(exchange, drive, hand)
    wire.answer = asked_at(drive, times)
    began = time.monotonic()
    faults: set[str] = set()

    def falls(_address: int, _word: int) -> None:
        fallen = int((time.monotonic() - began) / 0.4)
        drive.values.update({3: 0x1231, 4: 10000 - 200 * fallen})

    drive.on_write = falls
    hand.speed = None
    while time.monotonic() - began < 6:
        status = exchange.snapshot.status
        assert status is not None
        faults.add(status.fault)
        time.sleep(0.05)
    assert faults == {""} and not silences(times)
    assert not exchange.snapshot.status.stands  # type: ignore[union-attr]


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize(
    "values", [{3: 0x1031, 4: 10000}, {3: 0x1031, 4: 0x8000}, {3: 0x1231, 4: 300}],
    ids=["local control", "local control, unknown speed", "noise at rest"],
)
def test_what_is_not_known_to_run_on_is_not_met_by_silence(
    exchange: DriveExchange, drive: Registers, hand: Hand, values: dict[int, int]
) -> None:
    """Without bit 9 a person at the panel has it; -32768 of 20000 is no speed; 300 is 1.5 %."""
    run_at_half(exchange, drive, hand)
    drive.values.update(values)
    drive.on_write = lambda _address, _word: drive.values.update(values)
    hand.speed = None
    began = time.monotonic()
    problems: set[str] = set()
    while time.monotonic() - began < 5:
        problems.add(exchange.snapshot.problem)
        status = exchange.snapshot.status
        assert status is None or status.fault == ""
        time.sleep(0.02)
    assert not [each for each in problems if "nothing is sent" in each]


@pytest.mark.usefixtures("soon")
def test_a_drive_that_runs_on_behind_a_connection_that_breaks_is_left_in_silence(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    """Broken every 0.7 s, sooner than it is judged; what is known of the speed outlives that."""
    drive.values[5815] = 15
    times: list[float] = []
    run_at_half(exchange, drive, hand)
    wire.answer = asked_at(drive, times)
    run_on(drive)
    hand.speed = None
    faults: set[str] = set()
    ended = threading.Event()

    def break_it() -> None:
        while not ended.wait(0.7):
            wire.drop()

    breaks = threading.Thread(target=break_it)
    breaks.start()

    def left() -> bool:
        status = exchange.snapshot.status
        if status is not None:
            faults.add(status.fault)
        return f"{ACKNOWLEDGES} (it is 50.0%), so nothing" in exchange.snapshot.problem

    try:
        wait(left)
        assert ACKNOWLEDGES in faults and wire.connections > 2
        count = len(times)
        wait(lambda: len(times) > count)
        assert times[count] - times[count - 1] >= 2.5
        # The same again, while it does not help.
        wait(lambda: not left())
        assert wait(left) > 2.0
    finally:
        ended.set()
        breaks.join()


@pytest.mark.usefixtures("soon")
def test_a_drive_that_obeyed_and_a_run_order_begin_the_time_anew(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    """It stood, or was run, when the connection broke for longer than a fault takes (1 s)."""
    run_at_half(exchange, drive, hand)
    obeys = drive.on_write
    for speed in (None, 0.5):
        hand.speed = speed
        wait(lambda speed=speed: drive.values[4] == (10000 if speed else 0))  # type: ignore[misc]
        time.sleep(4 * PERIOD)
        wire.answer = lambda _request: None
        wire.drop()
        wait(lambda: not exchange.snapshot.connected)
        time.sleep(2.0)
        # It turns, and obeys *stop* by a ramp that the first reading does not show yet.
        drive.on_write = lambda _address, _word: None
        drive.values.update({3: 0x1231, 4: 10000})
        wire.answer = drive
        hand.speed = None
        wait(lambda: exchange.snapshot.status is not None)
        assert exchange.snapshot.status is not None and exchange.snapshot.status.fault == ""
        drive.values.update({3: 0x1231, 4: 0})
        drive.on_write = obeys
        wait(lambda: exchange.snapshot.status and exchange.snapshot.status.stands)


UNREADABLE = {
    "no speed": "(register 400005) is -32768", "exception": "reading register 4: refused",
}


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("way", UNREADABLE)
def test_a_drive_that_takes_stop_and_whose_speed_cannot_be_read_is_left_in_silence(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand, way: str
) -> None:
    """Nobody knows whether it stands, and the node trusts in its own timeout, which must fall.

    That is 1.5 s; a margin of 1 s makes 2.5 s. Between two silences it is asked for 3 s.
    """
    drive.values[5815] = 15
    times: list[float] = []
    run_at_half(exchange, drive, hand)
    wire.answer = asked_at(drive, times)
    if way == "exception":
        del drive.values[4]
        drive.on_write = lambda _address, _word: drive.values.pop(4, None)
    else:
        drive.on_write = lambda _address, _word: drive.values.update({4: 0x8000})

    def is_left() -> bool:
        return "so nothing is sent for 2.5 s" in exchange.snapshot.problem

    wait(is_left)
    for words in (UNREADABLE[way], "its speed cannot be read", "although *stop* is written"):
        assert words in exchange.snapshot.problem
    count = len(times)
    wait(lambda: len(times) > count)
    assert times[count] - times[count - 1] >= 2.5
    wait(lambda: not is_left())
    assert wait(is_left) > 2.5
    assert drive.written[-1] in (OFF, (1, 0))
    # It can be read again.
    drive.on_write = lambda _address, _word: None
    drive.values[4] = 0
    wait(lambda: exchange.snapshot.connected)
    assert exchange.snapshot.problem == ""


# --- settings -------------------------------------------------------------------------------------


def test_what_somebody_changes_at_the_panel_is_noticed(
    exchange: DriveExchange, drive: Registers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("greenroof_ros.drives.exchange.SETTINGS_S", 0.2)
    exchange.start()
    wait(lambda: exchange.snapshot.timeout_s == 5.0)
    drive.values[5815] = 70
    wait(lambda: exchange.snapshot.timeout_s == 7.0)
    drive.values[5813] = 0
    wait(lambda: exchange.snapshot.timeout_s is None)
    assert exchange.snapshot.timeout_known
    drive.values[5813] = 1
    wait(lambda: exchange.snapshot.timeout_s == 7.0)
    del drive.values[5815]
    wait(lambda: not exchange.snapshot.timeout_known)
    assert exchange.snapshot.timeout_s is None
    assert "reading register 5815: refused with exception 2" in exchange.snapshot.timeout_note
    assert exchange.snapshot.connected


def test_the_rated_speed_is_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Schneider: at 725 rpm of 1450 half of rated speed; of 2900 a quarter; of 60000 nonsense."""
    monkeypatch.setattr("greenroof_ros.drives.exchange.SETTINGS_S", 0.2)
    drive = Registers({
        8501: 0, 8602: 0, 3201: 0x0233, 8604: 725, 7121: 0, 9604: 1450, 6005: 50, 7010: 1,
        3302: 1, 3011: 1,
    })
    altivar = read_drive_file(find_drive_file("schneider_atv630"))
    with closing(Wire(drive)) as wire, driving(altivar, wire.at) as exchange:

        def reads(speed: float) -> None:
            wait(lambda: exchange.snapshot.status
                 and exchange.snapshot.status.speed == pytest.approx(speed))

        reads(0.5)
        drive.values[9604] = 2900
        reads(0.25)
        drive.values[9604] = 60000
        wait(lambda: "believable are 300 to 7200" in exchange.snapshot.problem)
        wait(lambda: exchange.snapshot.status is None)
        drive.values.update({9604: 1450, 8604: 0})
        wait(lambda: exchange.snapshot.connected)


# --- two drivers ----------------------------------------------------------------------------------


def test_a_second_driver_on_the_same_machine_keeps_off(
    exchange: DriveExchange, file: DriveFile, drive: Registers, wire: Wire, hand: Hand
) -> None:
    """The first, a process of its own that names the host in another way, dies by SIGKILL."""
    first = subprocess.Popen(
        [
            sys.executable, "-c",
            "import sys, time\n"
            "from greenroof_ros.drives.address import parse_address\n"
            "from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file\n"
            "from greenroof_ros.drives.exchange import DriveExchange\n"
            "file = read_drive_file(find_drive_file('abb_acs880'))\n"
            "exchange = DriveExchange(file, parse_address(sys.argv[1]))\n"
            "exchange.start()\n"
            "time.sleep(60)\n",
            f"tcp://localhost:{wire.port}",
        ],
        cwd=CHECKOUT,
    )
    try:
        wait(lambda: wire.seen, within=20)
        exchange.start()
        wait(lambda: f"process {first.pid} of this machine" in exchange.snapshot.problem)
        hand.speed = 0.5
        time.sleep(1.5)
        assert wire.connections == 1 and RUN not in drive.written
        assert not exchange.snapshot.connected and exchange.snapshot.errors == 1
        # The supervisor's stop goes by, where that one is its own.
        with pytest.raises(HeldError, match=f"process {first.pid} of this machine"):
            stop_drive(file, parse_address(wire.at), driver=os.getpid())
        assert wire.connections == 1
        stopped = stop_drive(file, parse_address(wire.at), driver=first.pid)
        assert str(stopped) == "speed 0.0%, off"
        first.kill()
        wait(lambda: drive.values[4] == 10000, within=5)
    finally:
        first.kill()
        first.wait()
    (lock,) = (
        found for directory in ("/run/lock", "/tmp")
        for found in Path(directory).glob(f"greenroof_ros-127.0.0.1-{wire.port}-1.lock")
    )
    assert lock.stat().st_mode & 0o777 == 0o666
    exchange.close()
    assert not lock.exists()


def test_a_serial_line_is_one_drivers_by_whatever_name(
    file: DriveFile, drive: Registers, tmp_path: Path
) -> None:
    wire = SerialWire(over_serial(drive))
    other = tmp_path / "by-id"
    other.symlink_to(wire.line)
    one, two = (
        made(file, str(name)) for name in (wire.line, other)
    )
    try:
        one.start()
        wait(lambda: one.snapshot.connected)
        two.start()
        wait(lambda: f"process {os.getpid()} of this machine" in two.snapshot.problem)
        one.close()
        wait(lambda: two.snapshot.connected)
    finally:
        one.close()
        two.close()
        wire.close()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
def test_a_lock_holds_between_users(file: DriveFile) -> None:
    """Nobody's process has it, so that its file is nobody's; then root takes it over."""
    port = free_ports(1)[0]
    lock = DriveLock(file, parse_address(f"tcp://localhost:{port}"))
    ours, theirs = os.pipe()
    ready, said = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setuid(65534)
            DriveLock(file, parse_address(f"gateway://127.0.0.1:{port}")).take()
            os.write(said, b"x")
            os.read(ours, 1)
        finally:
            os._exit(0)
    assert os.read(ready, 1) == b"x"
    with pytest.raises(DriveError, match=f"process {child} of this machine"):
        lock.take()
    os.write(theirs, b"x")
    os.waitpid(child, 0)
    lock.take()
    lock.release()
    for each in (ours, theirs, ready, said):
        os.close(each)


# --- what must not happen -------------------------------------------------------------------------


def test_a_connection_that_cannot_even_be_closed_is_made_again(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run_at_half(exchange, drive, hand)
    close = Drive.close
    broken = iter([True])

    def fail_once(self: Drive) -> None:
        if next(broken, False):
            raise OSError("torn out")
        close(self)

    monkeypatch.setattr(Drive, "close", fail_once)
    drive.values[4] = 0
    wire.drop()
    wait(lambda: next(broken, None) is None and exchange.snapshot.connected)
    wait(lambda: drive.values[4] == 10000)


def test_a_thread_without_a_file_descriptor_says_so_and_goes_on(wire: Wire) -> None:
    done = subprocess.run(
        [
            sys.executable, "-c",
            "import os, resource, sys, time\n"
            "from greenroof_ros.drives.address import parse_address\n"
            "from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file\n"
            "from greenroof_ros.drives.exchange import DriveExchange\n"
            "file = read_drive_file(find_drive_file('abb_acs880'))\n"
            "exchange = DriveExchange(file, parse_address(sys.argv[1]))\n"
            "last = os.dup(0)\n"
            "os.close(last)\n"
            "limits = resource.getrlimit(resource.RLIMIT_NOFILE)\n"
            "resource.setrlimit(resource.RLIMIT_NOFILE, (last, limits[1]))\n"
            "exchange.start()\n"
            "until = time.monotonic() + 20\n"
            "while exchange.snapshot.errors == 0 and time.monotonic() < until:\n"
            "    time.sleep(0.01)\n"
            "resource.setrlimit(resource.RLIMIT_NOFILE, limits)\n"
            "print(exchange.snapshot.problem)\n"
            "while not exchange.snapshot.connected and time.monotonic() < until:\n"
            "    time.sleep(0.01)\n"
            "exchange.close()\n"
            "print(exchange.snapshot.status)\n",
            wire.at,
        ],
        cwd=CHECKOUT, capture_output=True, text=True, check=True, timeout=60,
    )
    problem, status = done.stdout.splitlines()
    assert "Too many open files" in problem or "No file descriptors" in problem
    assert status == "speed 0.0%, off"


# --- a ramp as long as it may be ------------------------------------------------------------------


def falls_for(drive: Registers, seconds: float) -> None:
    """Have it turn at rated speed, and ramp down from the first *stop* on."""
    began: list[float] = []

    def falls(_address: int, _word: int) -> None:
        began.append(time.monotonic())
        left = max(0.0, 1.0 - (time.monotonic() - began[0]) / seconds)
        drive.values.update({3: 0x1231, 4: round(20000 * left)})

    drive.values.update({0: 0x047F, 1: 20000, 3: 0x1337, 4: 20000})
    drive.on_write = falls


def test_a_ramp_of_29_s_is_waited_for_at_the_end_and_by_the_supervisors_stop(
    file: DriveFile, drive: Registers, wire: Wire
) -> None:
    """real-pump.md allows 30 s. Each answer may take as long as by default: a machine is busy."""
    falls_for(drive, 29.0)
    exchange = DriveExchange(file, parse_address(wire.gateway), PERIOD, DEAD_MAN)
    exchange.start()
    wait(lambda: drive.written)
    second = acs880()
    other = Wire(second)
    falls_for(second, 29.0)
    left: list[DriveStatus] = []
    stop = threading.Thread(
        target=lambda: left.append(stop_drive(file, parse_address(other.at)))
    )
    stop.start()
    exchange.close()
    stop.join()
    other.close()
    assert exchange.snapshot.status is not None and exchange.snapshot.status.stands
    assert left[0].stands


def test_the_waits_for_a_ramp_fit_into_those_of_bringup_and_the_service() -> None:
    """The pump node's end; then the supervisor's stop, while another may be at work; the others."""
    from greenroof_ros.drives.drive_file import LONGEST_RAMP_S
    from greenroof_ros.drives.exchange import LEAVE_S, LONGEST_WAIT_S
    from greenroof_ros.graph.supervisor import ENDING_S, KILLING_S, PUMP_ENDING_S

    assert LONGEST_RAMP_S < LEAVE_S < LEAVE_S + LONGEST_WAIT_S < PUMP_ENDING_S
    service = (CHECKOUT / "examples/greenroof.service").read_text()
    (line,) = (one for one in service.splitlines() if one.startswith("TimeoutStopSec="))
    others = 2 * (ENDING_S + KILLING_S)  # those, and the recorder
    assert float(line.partition("=")[2]) > max(
        PUMP_ENDING_S + KILLING_S + LEAVE_S, 2 * LEAVE_S
    ) + others


# --- the supervisor's stop ------------------------------------------------------------------------


def test_stop_drive(file: DriveFile, drive: Registers, wire: Wire) -> None:
    drive.values.update({0: 0x047F, 1: 20000, 3: 0x1337, 4: 20000})
    assert str(stop_drive(file, parse_address(wire.at))) == "speed 0.0%, off"
    assert drive.written[0] == OFF and RUN not in drive.written


def test_stop_drive_says_what_a_drive_that_turns_on_says(
    file: DriveFile, drive: Registers, wire: Wire
) -> None:
    drive.values.update({3: 0x1137, 4: 20000})
    drive.on_write = lambda _address, _word: None
    began = time.monotonic()
    status = stop_drive(file, parse_address(wire.at))
    assert str(status) == "speed 100.0%, running, local control" and not status.stands
    assert time.monotonic() - began < 4.0


def test_stop_drive_of_nobody(file: DriveFile, wire: Wire) -> None:
    wire.answer = lambda _request: []
    began = time.monotonic()
    with pytest.raises(DriveError, match="no valid answer"):
        stop_drive(file, parse_address(wire.at), timeout_s=TIMEOUT)
    assert time.monotonic() - began < 2.0
    assert wire.connections == 3


def units(wire: Wire) -> set[int]:
    """Return which devices were asked: byte 6 of a Modbus TCP frame."""
    return {request[6] for request in wire.seen}


@pytest.mark.parametrize(
    ("scheme", "device", "asked"),
    [("gateway", "", 17), ("tcp", "", 3), ("gateway", ",200", 200), ("tcp", ",0", 0)],
)
def test_driver_and_stop_ask_the_same_device(
    file: DriveFile, drive: Registers, wire: Wire, scheme: str, device: str, asked: int
) -> None:
    """Behind a gateway the slave address, of the file or of the address."""
    two = replace(
        file, serial=replace(file.serial, device_id=17), tcp=replace(file.tcp, device_id=3)
    )
    at = f"{scheme}://127.0.0.1:{wire.port}{device}"
    with driving(two, at) as exchange:
        wait(lambda: exchange.snapshot.connected)
        assert units(wire) == {asked}
    wire.seen.clear()
    assert stop_drive(two, parse_drive_address(at, "at")).stands
    assert units(wire) == {asked}


def test_stop_drive_keeps_drivers_off_meanwhile(
    exchange: DriveExchange, file: DriveFile, drive: Registers, wire: Wire
) -> None:
    drive.values.update({0: 0x047F, 1: 20000, 3: 0x1337, 4: 20000})
    drive.on_write = lambda _address, _word: None  # it runs on, which is seen after 3 s
    stop = threading.Thread(target=stop_drive, args=(file, parse_address(wire.gateway)))
    stop.start()
    wait(lambda: wire.seen)
    exchange.start()
    wait(lambda: "runs this drive already" in exchange.snapshot.problem)
    stop.join()
    wait(lambda: exchange.snapshot.connected)
