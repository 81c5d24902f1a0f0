"""The thread that keeps a drive up, against registers behind a real TCP port."""

from __future__ import annotations

import itertools
import os
import re
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
from simulators import until as wait

from greenroof_ros.common.times import boot_time
from greenroof_ros.drives.drive import DriveInUseError, DriveLock, DriveStatus
from greenroof_ros.drives.drive_file import DriveFile, Timeouts, find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import (
    DriveExchange,
    Obedience,
    RunsOnError,
    State,
    stop_drive,
)
from greenroof_ros.drives.modbus_line import (
    DriveError,
    ModbusLine,
    parse_address,
    parse_drive_address,
)

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

    close = end


@contextmanager
def driving(
    file: DriveFile, at: str, speed: float | None = None, **options: float
) -> Iterator[DriveExchange]:
    """Run a drive at a speed until the end."""
    with closing(made(file, at, **options)) as exchange, closing(Hand(exchange, speed)):
        exchange.start()
        yield exchange


@pytest.fixture
def hand(exchange: DriveExchange) -> Iterator[Hand]:
    with closing(Hand(exchange, None)) as made:
        yield made


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
    assert sum("0316b7" in each for each in wire.frames) == 1  # 58.16 is not read each time


def test_it_runs_while_asked_and_stops_when_told_or_asked_nonsense_or_not_at_all(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    """And when it is closed, which reads that back; nothing is written after that."""
    assert exchange.snapshot.state is State.CONNECTING
    exchange.start()
    wait(lambda: exchange.snapshot.state is State.STOPPED)
    hand.speed = 0.4
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.speed == 0.4)
    assert drive.written[-2:] in ([(1, 8000), RUN], [RUN, (1, 8000)])
    hand.speed = 0.6
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.speed == 0.6)
    assert exchange.snapshot.state is State.RUNNING
    hand.speed = None
    assert wait(lambda: drive.values[0] == 0x047E) < 0.05 + 3 * PERIOD
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.stands)
    assert (exchange.snapshot.state, exchange.snapshot.errors) == (State.STOPPED, 0)
    for nonsense in (float("nan"), float("inf"), -0.1, 1.5):
        hand.speed = 0.5
        wait(lambda: drive.values[4] == 10000)
        errors, hand.speed = exchange.snapshot.errors, nonsense
        wait(lambda: drive.values[0] == 0x047E)
        assert exchange.snapshot.errors > errors
    hand.speed = 1.0
    wait(lambda: drive.values[4] == 20000)
    hand.end()
    took = wait(lambda: drive.values[0] == 0x047E)
    assert DEAD_MAN - 0.1 < took < DEAD_MAN + 4 * PERIOD
    exchange.demand(0.5)
    wait(lambda: drive.values[4] == 10000)
    began = time.monotonic()
    exchange.close()
    assert time.monotonic() - began < 1.0
    assert drive.values[0] == 0x047E and not exchange.snapshot.connected
    assert exchange.snapshot.state is State.CONNECTING
    assert exchange.snapshot.status is not None and exchange.snapshot.status.stands
    count = len(drive.written)
    time.sleep(4 * PERIOD)
    assert len(drive.written) == count


def test_what_was_asked_for_before_a_suspend_runs_nothing_after_it(
    file: DriveFile, wire: Wire, drive: Registers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`time.monotonic`, which stands still in a suspend, would have it still new."""
    address = parse_drive_address(wire.gateway, "at")
    with closing(DriveExchange(file, address, PERIOD, dead_man_s=60.0)) as exchange:
        exchange.start()
        exchange.demand(0.5)
        wait(lambda: drive.values[4] == 10000)
        monkeypatch.setattr("greenroof_ros.drives.exchange.boot_time", lambda: boot_time() + 3600)
        assert wait(lambda: drive.values[0] == 0x047E) < 0.05 + 3 * PERIOD


def test_half_open_connection_is_noticed_and_heals_and_close_ends_in_time(
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
    drive.silent = True
    began = time.monotonic()
    exchange.close()
    assert time.monotonic() - began < 2.0
    assert exchange.snapshot.status is None and not exchange.snapshot.connected


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
        drive.written.clear()
        wire.answer = drive
        assert wait(lambda: exchange.snapshot.connected) < 2.0
        assert drive.written[0] == OFF  # a new connection begins with a stop
        wait(lambda: drive.values[4] == 10000)


def test_one_lost_answer_does_not_stop_the_pump_and_close_connects_once_more_to_stop(
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
    wire.answer = lambda _request: None
    wire.drop()
    wait(lambda: not exchange.snapshot.connected)
    wire.answer = drive
    exchange.close()
    assert drive.values[0] == 0x047E


def test_nobody_there_and_then_somebody(file: DriveFile, drive: Registers) -> None:
    """Attempts after 0, 0.25, 0.75, 1.75 s, and what each takes; no need for silence."""
    port = free_ports(1)[0]
    with driving(file, f"tcp://127.0.0.1:{port}") as exchange:
        time.sleep(2.0)
        assert 3 <= exchange.snapshot.errors <= 4
        assert not exchange.snapshot.connected and "cannot connect" in exchange.snapshot.problem
        with closing(Wire(drive, port)):
            wait(lambda: exchange.snapshot.connected, seconds=5.5)


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
    assert "somebody else writes to the drive" in exchange.snapshot.second_master
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
        wait(lambda: not exchange.snapshot.connected, seconds=1.0)
        assert wire.line in exchange.snapshot.problem
        began = time.monotonic()
        exchange.close()
        assert time.monotonic() - began < 2.0


# --- a drive that refuses to be stopped -----------------------------------------------------------


def refusing(
    drive: Registers, times: list[float] | None = None, *, refuses: bool = True
) -> Callable[[bytes], Any]:
    """Answer as a drive that refuses its control word, and write down when it was asked."""

    def answer(request: bytes) -> Any:
        if times is not None:
            times.append(time.monotonic())
        if refuses and request[7:10] == b"\x06\0\0":
            return [(0.0, request[:4] + bytes([0, 3, request[6], 0x86, 6]))]
        return drive(request)

    return answer


def silences(times: list[float]) -> list[float]:
    """Return how long nothing was sent, where that is longer than the waits between attempts."""
    gaps = [later - before for before, later in itertools.pairwise(times)]
    return [gap for gap in gaps if gap > 1.0]


def test_a_drive_that_refuses_to_stop_is_left_in_silence(
    file: DriveFile, drive: Registers, wire: Wire
) -> None:
    """Its own timeout, 58.16, is unknown, and the limit 0.8 s; the margin is 1 s.

    Closed in a silence it tries once more, and ends.
    """
    del drive.values[5815]
    times: list[float] = []
    with closing(made(file, wire.gateway, timeout_limit_s=0.8)) as exchange, closing(
        Hand(exchange, None)
    ) as hand:
        run_at_half(exchange, drive, hand)
        drive.written.clear()
        wire.answer = refusing(drive, times)
        wait(lambda: "so nothing is sent for 1.8 s" in exchange.snapshot.problem)
        assert "refused with exception 6" in exchange.snapshot.problem
        assert exchange.snapshot.state is State.SILENT
        assert not exchange.snapshot.connected and exchange.snapshot.status is None
        connections = wire.connections
        assert drive.written[-1] == (1, 0)  # what comes after the refused word
        for speed in (None, 0.5):  # who asks for something does not break it
            hand.speed = speed
            time.sleep(0.3)
        exchange.reset()
        wait(lambda: len(silences(times)) == 2, seconds=8)
        assert min(silences(times)) >= 1.8
        assert wire.connections == connections + 2  # one attempt after each silence
        wire.answer = drive
        wait(lambda: exchange.snapshot.connected, seconds=5)
        wait(lambda: drive.values[4] == 10000)
        wire.answer = refusing(drive)
        wait(lambda: "so nothing is sent" in exchange.snapshot.problem)
        count, began = len(wire.seen), time.monotonic()
        exchange.close()
        assert time.monotonic() - began < 2.0
        assert len(wire.seen) > count
        assert exchange.snapshot.status is None


def test_its_own_timeout_is_read_though_no_stop_was_ever_taken(
    file: DriveFile, drive: Registers, wire: Wire
) -> None:
    drive.values[5815] = 15
    wire.answer = refusing(drive)
    with driving(file, wire.gateway, timeout_limit_s=0.8) as exchange:
        wait(lambda: "so nothing is sent for 2.5 s" in exchange.snapshot.problem)


# --- a drive that acknowledges *stop* and runs on -------------------------------------------------

ACKNOWLEDGES = "it acknowledges *stop*, but its speed has not fallen for 1 s"


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge after 1 s instead of 10, 1.5 instead of 12."""
    for name, seconds in (("RUNS_ON_S", 1.0), ("SEEN_S", 0.5)):
        monkeypatch.setattr(f"greenroof_ros.drives.exchange.{name}", seconds)


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize(
    ("says", "left_for"),
    [
        # It says from now on that it is off, as after OFF1, and turns all the same.
        ({3: 0x1231, 4: 10000}, re.escape(f"{ACKNOWLEDGES} (it is 50.0%)")),
        # -32768 of 20000 is no speed.
        ({3: 0x1231, 4: 0x8000}, "register 400005.* is -32768.*; its speed cannot be read.*, "
         r"although \*stop\* is written"),
        # Without bit 9 a person at the panel has it, and sees to it.
        ({3: 0x1031, 4: 0x8000}, ""),
    ],
    ids=["runs on", "no speed", "no speed, in local control"],
)
def test_a_drive_that_does_not_show_that_it_stops_is_left_in_silence(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand, says: dict[int, int],
    left_for: str,
) -> None:
    """Its own timeout, 58.16, is 1.5 s; a margin of 1 s makes 2.5 s."""
    drive.values[5815] = 15
    times: list[float] = []
    run_at_half(exchange, drive, hand)
    wire.answer = refusing(drive, times, refuses=False)
    drive.on_write = lambda _address, _word: drive.values.update(says)
    hand.speed = None
    if says[4] == 10000:  # who asks for it sees the cause before the silence
        wait(lambda: exchange.snapshot.status and exchange.snapshot.status.fault == ACKNOWLEDGES)
        assert exchange.snapshot.state is State.STOPPING and not silences(times)
    if not left_for:
        time.sleep(4.0)
        assert "nothing is sent" not in exchange.snapshot.problem
        assert max(silences(times), default=0.0) < 2.5
        return
    wait(lambda: re.search(f"{left_for}, so nothing is sent for 2.5 s", exchange.snapshot.problem))
    assert "two connections" not in exchange.snapshot.problem
    assert not exchange.snapshot.connected and exchange.snapshot.status is None
    assert drive.written[-1] in (OFF, (1, 0))
    drive.written.clear()
    # It obeys again.
    drive.on_write = lambda _address, _word: drive.values.update({3: 0x1231, 4: 0})
    wait(lambda: exchange.snapshot.status and exchange.snapshot.status.stands)
    assert drive.written[0] == OFF
    # Where no speed is read connections are lost before, with shorter waits.
    assert silences(times)[-1] >= 2.5 and (says[4] != 10000 or len(silences(times)) == 1)
    assert exchange.snapshot.status is not None and exchange.snapshot.status.fault == ""


# --- whether a drive obeys, by a clock of the test's own ------------------------------------------


class Stopping:
    """Writes *stop* ten times a second, and listens to what the drive says."""

    def __init__(self) -> None:
        self.now, self.obedience, self.faults = 0.0, Obedience("there"), set[str]()
        # Of each time that it was left: when, and why; it lasts 6 s.
        self.left: list[tuple[float, str]] = []

    def listen(
        self, seconds: float, speed: Callable[[float], float | None], *, remote: bool = True
    ) -> None:
        """Go on with a drive of a speed that depends on the time; None cannot be read."""
        until = self.now + seconds
        while self.now < until:
            self.now += 0.1
            self.obedience.stop_written(self.now)
            said = speed(self.now)
            try:
                if said is None:
                    self.lose()
                else:
                    self.obedience.heard()
                    status = DriveStatus(True, True, "", "", said, None, remote)
                    self.faults.add(self.obedience.judge(status, self.now).fault)
            except RunsOnError as error:
                self.obedience.lost(True, self.now)
                self.leave(str(error))

    def lose(self) -> None:
        """Lose a connection, and wait for 1 s for the next."""
        why = self.obedience.lost(True, self.now)
        self.now += 1.0
        if why is not None:
            self.leave(why)

    def leave(self, why: str) -> None:
        self.left.append((self.now, why))
        self.now += 6.0
        self.obedience.left(self.now)


def test_a_ramp_however_slow_is_obedience() -> None:
    """1 % in 9 s; then noise at rest."""
    stopping = Stopping()
    stopping.listen(900, lambda now: max(0.019, 1.0 - 0.01 * (now // 9)))
    assert stopping.faults == {""} and not stopping.left


def test_one_that_runs_on_is_left_after_it_could_be_seen_and_again_after_a_minute() -> None:
    stopping = Stopping()
    stopping.listen(200, lambda _now: 0.5)
    assert stopping.faults == {"", ACKNOWLEDGES.replace("1 s", "10 s")}
    assert [round(at, -1) for at, _ in stopping.left] == [10, 80, 140]
    assert 12 < stopping.left[0][0] < 12.5
    assert stopping.left[0][1].endswith("not fallen for 10 s (it is 50.0%)")


def test_what_is_known_of_the_speed_outlives_connections_that_break() -> None:
    stopping = Stopping()
    while not stopping.left and stopping.now < 60:
        stopping.listen(0.7, lambda _now: 0.5)
        stopping.lose()
    assert 12 < stopping.left[0][0] < 20 and "has not fallen" in stopping.left[0][1]


@pytest.mark.parametrize("way", ["stood", "was run", "in local control"])
def test_one_that_stood_or_was_run_or_is_a_persons_begins_anew(way: str) -> None:
    stopping = Stopping()
    stopping.listen(9.5, lambda _now: 0.5)
    if way == "was run":
        stopping.obedience.forget()
    else:
        stopping.listen(0.1, lambda _now: 0.0 if way == "stood" else 0.5, remote=way == "stood")
    stopping.lose()
    stopping.listen(9.5, lambda _now: 0.5)
    stopping.listen(60, lambda _now: 0.5, remote=False)
    assert stopping.faults == {""} and not stopping.left


def test_one_whose_speed_cannot_be_read_is_left_and_again_after_a_minute() -> None:
    stopping = Stopping()
    stopping.listen(5, lambda _now: 0.0)
    stopping.listen(100, lambda _now: None)
    assert [round(at, -1) for at, _ in stopping.left] == [20, 80]
    assert stopping.left[0][1].startswith("; its speed cannot be read")


def test_a_stop_that_is_refused_on_two_connections_one_after_the_other() -> None:
    """A connection on which nothing could be sent counts for neither."""
    obedience = Obedience("there")
    ends = [obedience.lost(stopped, 0.0) for stopped in (False, True, False, None, False, False)]
    assert [bool(why) for why in ends] == [False, False, False, False, True, True]


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
    assert "is 0: No action; the pump might run on" in exchange.snapshot.timeout_note
    drive.values[5813] = 1
    wait(lambda: exchange.snapshot.timeout_s == 7.0)
    del drive.values[5815]
    wait(lambda: not exchange.snapshot.timeout_known)
    assert exchange.snapshot.timeout_s is None
    assert "reading register 5815: refused with exception 2" in exchange.snapshot.timeout_note
    assert exchange.snapshot.connected


def test_the_rated_speed_is_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Schneider: at 725 rpm of 1450 half of rated speed; of 2900 a quarter."""
    monkeypatch.setattr("greenroof_ros.drives.exchange.SETTINGS_S", 0.2)
    drive = Registers({
        8501: 0, 8602: 0, 3201: 0x0233, 8604: 725, 7121: 0, 9604: 1450, 6005: 50, 7010: 1,
        3302: 1, 3011: 1,
    })
    altivar = read_drive_file(find_drive_file("schneider_atv630"))
    with closing(Wire(drive)) as wire, driving(altivar, wire.at) as exchange:
        for rated, speed in ((1450, 0.5), (2900, 0.25)):
            drive.values[9604] = rated
            wait(lambda speed=speed: exchange.snapshot.status  # type: ignore[misc]
                 and exchange.snapshot.status.speed == pytest.approx(speed))


# --- where time is not real -----------------------------------------------------------------------


SIMULATOR = bytes.fromhex("2b0e0101000002") + b"\0\x0dgreenroof_ros\1\x0fdrive simulator"


@pytest.mark.parametrize("before", ["the simulator", "another", "a silent one"])
def test_where_the_simulator_alone_may_run_another_drive_is_stopped_and_stays_so(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand, before: str
) -> None:
    """Though it ran; one that does not answer that question is as little run.

    *Run* is written once more at most, in the round that is under way; which takes longer where the
    question is not answered in it. Each connection may lead to another one.
    """

    def answer(request: bytes) -> Any:
        if request[7] != 43 or before == "another":
            return drive(request)
        body = request[6:7] + SIMULATOR
        whole = request[:4] + len(body).to_bytes(2, "big") + body
        return [(0.0, whole)] if before == "the simulator" else []

    wire.answer = answer
    if before == "the simulator":
        exchange.only_simulator()
        run_at_half(exchange, drive, hand)
        assert exchange.snapshot.no_simulator == ""
        wire.answer = drive
        wire.drop()
        wait(lambda: exchange.snapshot.no_simulator)
        wait(lambda: drive.values[0] == 0x047E)
    else:
        run_at_half(exchange, drive, hand)
        before_it = len(drive.written)
        exchange.only_simulator()
        wait(lambda: drive.values[0] == 0x047E)
        assert drive.written[before_it:].count(RUN) <= 1
    drive.written.clear()
    wait(lambda: len(drive.written) > 5)
    assert RUN not in drive.written
    assert exchange.snapshot.no_simulator != ""
    assert before == "a silent one" or (
        "does not identify itself" in exchange.snapshot.unguarded
    )


# --- two drivers ----------------------------------------------------------------------------------


def test_a_second_driver_on_the_same_machine_keeps_off(
    exchange: DriveExchange, file: DriveFile, drive: Registers, wire: Wire, hand: Hand
) -> None:
    """The first names the host in another way."""
    first = DriveLock(file, parse_address(f"tcp://localhost:{wire.port}"))
    first.take()
    exchange.start()
    hand.speed = 0.5
    wait(lambda: f"process {os.getpid()} of this machine" in exchange.snapshot.problem)
    time.sleep(1.5)
    assert not exchange.snapshot.connected and exchange.snapshot.errors == 1
    # The supervisor's stop goes by, where that one is its own.
    with pytest.raises(DriveInUseError, match=f"process {os.getpid()} of this machine"):
        stop_drive(file, parse_address(wire.at), driver=1)
    assert wire.connections == 0
    assert str(stop_drive(file, parse_address(wire.at), driver=os.getpid())) == "speed 0.0%, off"
    (lock,) = (
        found for directory in ("/run/lock", "/tmp")
        for found in Path(directory).glob(f"greenroof_ros-127.0.0.1-{wire.port}-1.lock")
    )
    assert lock.stat().st_mode & 0o777 == 0o666
    first.release()
    wait(lambda: drive.values[4] == 10000, seconds=5)
    exchange.close()
    assert not lock.exists()


def test_a_serial_line_is_one_drivers_by_whatever_name(file: DriveFile, tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    one, two = (
        DriveLock(file, parse_drive_address(f"{tmp_path}/{name}", "at"))
        for name in ("ttyUSB0,1", "by-id,2")
    )
    one.take()
    with pytest.raises(DriveInUseError, match=f"process {os.getpid()} of this machine"):
        two.take()
    one.release()
    two.take()
    two.release()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
def test_a_lock_holds_between_users(file: DriveFile) -> None:
    """Nobody's process has it, so that its file is nobody's; then root takes it over."""
    port = free_ports(1)[0]
    lock = DriveLock(file, parse_address(f"tcp://localhost:{port}"))
    lock.take()  # what that imports nobody may not be able to read
    lock.release()
    ours, theirs = os.pipe()
    ready, said = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setuid(65534)
            other = DriveLock(file, parse_address(f"gateway://127.0.0.1:{port}"))
            other.take()
            os.write(said, b"x")
            os.read(ours, 1)
        finally:
            os._exit(0)
    os.close(said)
    assert os.read(ready, 1) == b"x"
    with pytest.raises(DriveError, match=f"process {child} of this machine"):
        lock.take()
    os.write(theirs, b"x")
    os.waitpid(child, 0)
    lock.take()
    lock.release()
    for each in (ours, theirs, ready):
        os.close(each)


# --- what must not happen -------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["connect", "close"])
def test_whatever_fails_the_next_step_begins_anew(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand,
    monkeypatch: pytest.MonkeyPatch, what: str,
) -> None:
    """No file descriptor is left, for instance."""
    run_at_half(exchange, drive, hand)
    does, errors, problems = getattr(ModbusLine, what), [OSError("torn out")], set[str]()

    def fail_once(self: ModbusLine) -> None:
        problems.add(exchange.snapshot.problem)
        if errors:
            raise errors.pop()
        does(self)

    monkeypatch.setattr(ModbusLine, what, fail_once)
    drive.values[4] = 0
    wire.drop()
    wait(lambda: not errors and exchange.snapshot.connected)
    wait(lambda: drive.values[4] == 10000)
    if what == "connect":  # that one is seen at the next attempt
        assert "talking to the drive failed: OSError('torn out')" in problems


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


def test_a_ramp_is_waited_for_at_the_end_and_by_the_supervisors_stop(
    file: DriveFile, drive: Registers, wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For as long as LEAVE_S, here 5 s: longer than a drive is left that does not slow down."""
    monkeypatch.setattr("greenroof_ros.drives.exchange.LEAVE_S", 5.0)
    for seconds, stands in ((4.0, True), (15.0, False)):
        second = acs880()
        with closing(Wire(second)) as other:
            falls_for(drive, seconds)
            drive.written.clear()
            exchange = DriveExchange(file, parse_address(wire.gateway), PERIOD, DEAD_MAN)
            exchange.start()
            wait(lambda: drive.written)
            falls_for(second, seconds)
            left: list[DriveStatus] = []
            stop = threading.Thread(
                target=lambda: left.append(stop_drive(file, parse_address(other.at)))  # noqa: B023
            )
            stop.start()
            exchange.close()
            stop.join()
        assert second.written[0] == OFF and RUN not in second.written
        assert exchange.snapshot.status is not None
        assert (exchange.snapshot.status.stands, left[0].stands) == (stands, stands)


def test_the_waits_fit_into_those_of_the_pump_control_bringup_and_the_service() -> None:
    """The control waits 15 s (follow_time); the node says by UNREAD_S that a drive must stand.

    Then the pump node's end; the supervisor's stop, while another may be at work; the others.
    """
    from greenroof_ros.drives import exchange
    from greenroof_ros.drives.drive_file import LONGEST_RAMP_S
    from greenroof_ros.graph.supervisor import ENDING_S, KILLING_S, PUMP_ENDING_S

    assert exchange.UNREAD_S == exchange.RUNS_ON_S + exchange.LONGEST_WAIT_S == 15
    assert exchange.STILL_S < exchange.RUNS_ON_S < exchange.RUNS_ON_S + exchange.SEEN_S < 15
    assert exchange.RUNS_ON_AGAIN_S > exchange.RUNS_ON_S
    leave = exchange.LEAVE_S
    assert LONGEST_RAMP_S < leave < leave + exchange.LONGEST_WAIT_S < PUMP_ENDING_S
    service = (CHECKOUT / "examples/greenroof.service").read_text()
    (line,) = (one for one in service.splitlines() if one.startswith("TimeoutStopSec="))
    others = 2 * (ENDING_S + KILLING_S)  # those, and the recorder
    assert float(line.partition("=")[2]) > max(
        PUMP_ENDING_S + KILLING_S + leave, 2 * leave
    ) + others


# --- the supervisor's stop ------------------------------------------------------------------------


def test_who_stops_a_drive_that_turns_on_says_what_it_says_and_keeps_drivers_off_meanwhile(
    exchange: DriveExchange, file: DriveFile, drive: Registers, wire: Wire
) -> None:
    """The supervisor's stop, and the exchange's end; that it runs on is seen after 3 s."""
    drive.values.update({3: 0x1137, 4: 20000})
    drive.on_write = lambda _address, _word: None
    left: list[DriveStatus | None] = []
    began = time.monotonic()
    stop = threading.Thread(
        target=lambda: left.append(stop_drive(file, parse_address(wire.at)))
    )
    stop.start()
    wait(lambda: wire.seen)
    exchange.start()
    wait(lambda: "runs this drive already" in exchange.snapshot.problem)
    stop.join()
    assert time.monotonic() - began < 4.0
    wait(lambda: exchange.snapshot.connected)
    began = time.monotonic()
    exchange.close()
    assert time.monotonic() - began < 4.0
    for status in (*left, exchange.snapshot.status):
        assert str(status) == "speed 100.0%, running, local control"
        assert status is not None and not status.stands


@pytest.mark.parametrize("refuses", [False, True])
def test_a_stop_that_is_not_taken_is_tried_three_times(
    file: DriveFile, drive: Registers, wire: Wire, refuses: bool
) -> None:
    wire.answer = refusing(drive) if refuses else lambda _request: []
    began = time.monotonic()
    with pytest.raises(DriveError, match="exception 6" if refuses else "no valid answer"):
        stop_drive(file, parse_address(wire.at), timeout_s=TIMEOUT)
    assert time.monotonic() - began < 2.0
    assert wire.connections == 3
