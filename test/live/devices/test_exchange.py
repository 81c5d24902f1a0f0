"""The thread that keeps up the connection to a drive: by a clock of the test, and by real ports."""

from __future__ import annotations

import math
import os
import socket
import stat
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from asking import Asking
from clocked_exchange import STEP_S, Bench, Cable
from modbus_wire import Answer, Registers, SerialWire, Wire, acs880, rtu_server
from places import CHECKOUT
from simulators import until as wait

from greenroof_ros.live.devices import exchange
from greenroof_ros.live.devices.drive import DriveEndpoint, DriveStatus
from greenroof_ros.live.devices.drive_file import (
    MAX_RAMP_S,
    Timeouts,
    find_drive_file,
    read_drive_file,
)
from greenroof_ros.live.devices.exchange import (
    DriveExchange,
    DriveInUseError,
    DriveSnapshot,
    StopMonitor,
    acquire_drive_lock,
    stop_drive,
)
from greenroof_ros.live.devices.modbus_line import (
    DriveError,
    parse_address,
    parse_drive_address,
)

PERIOD_S, DEAD_MAN_S, TIMEOUT_S = 0.1, 1.0, 0.5
SILENT = "so nothing is sent for"
OFF, RUN, ACKNOWLEDGE = (0, 0x047E), (0, 0x047F), (0, 0x04FE)

SHIPPED = read_drive_file(find_drive_file("abb_acs880"))
assert SHIPPED.timeout.serial is not None and SHIPPED.timeout.tcp is None
assert SHIPPED.timeout.serial.unguarded_after_power_up_s == 30.0
# Without the time after power-up, for which only its own test waits.
ABB = replace(SHIPPED, timeout=Timeouts(
    replace(SHIPPED.timeout.serial, unguarded_after_power_up_s=0.0)
))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    with closing(Bench(monkeypatch, ABB)) as bench:
        yield bench


# --- by the test's clock: what is asked for -------------------------------------------------------


def test_it_runs_while_asked_and_stops_when_told_or_asked_nonsense_or_not_at_all(
    bench: Bench
) -> None:
    """It is also stopped by a close, which reads back the stop; nothing is written after that."""
    drive = bench.drive
    assert not bench.now.connected
    bench.connect()
    for bench.speed in (0.4, 0.6):
        bench.until_reported(lambda status: status.speed == bench.speed)
        assert set(drive.written[-2:]) == {(1, round(20000 * (bench.speed or 0.0))), RUN}
    bench.speed = None
    assert bench.until(lambda: drive.values[0] == 0x047E) < PERIOD_S + STEP_S
    bench.until_reported(lambda status: status.at_rest)
    assert bench.now.errors == 0
    for nonsense in (float("nan"), 1.5):
        bench.speed = 0.5
        bench.until_half()
        errors, bench.speed = bench.now.errors, nonsense
        bench.until(lambda: drive.values[0] == 0x047E)
        assert bench.now.errors > errors
    bench.speed = 1.0
    bench.until(lambda: drive.values[4] == 20000)
    bench.asks = False
    took = bench.until(lambda: drive.values[0] == 0x047E)
    assert DEAD_MAN_S - STEP_S < took < DEAD_MAN_S + PERIOD_S + STEP_S
    bench.exchange.request_speed(0.5)
    bench.until_half()
    assert bench.close() < 1.0
    assert drive.values[0] == 0x047E and not bench.now.connected
    assert bench.now.status is not None and bench.now.status.at_rest


def test_what_is_asked_for_waits_for_no_round_of_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run and a stop are sent at once, however long the period; a change of speed can wait."""
    monkeypatch.setattr(exchange, "PERIOD_S", 20.0)
    monkeypatch.setattr(exchange, "DEAD_MAN_S", 60.0)
    with closing(Bench(monkeypatch, ABB)) as bench:
        bench.asks = False
        bench.connect()
        for speed, word in ((0.5, 0x047F), (None, 0x047E)):
            bench.exchange.request_speed(speed)
            assert bench.until(lambda word=word: bench.drive.values[0] == word) < 2 * STEP_S  # type: ignore[misc]


def test_what_was_asked_for_before_a_suspend_runs_nothing_after_it(bench: Bench) -> None:
    """By `time.monotonic`, which stands still during a suspend, the demand would still be new."""
    bench.run()
    bench.asks, bench.clock.suspended = False, 3600.0
    assert bench.until(lambda: bench.drive.values[0] == 0x047E) < PERIOD_S + STEP_S


# --- by the test's clock: connections that break --------------------------------------------------


def test_one_lost_answer_stops_nothing_and_a_half_open_connection_heals(bench: Bench) -> None:
    bench.run()
    bench.drive.written.clear()
    lost = iter([True])
    bench.answer = lambda request: [] if next(lost, False) else bench.drive(request)
    bench.until(lambda: bench.now.errors == 1)
    bench.until(lambda: bench.now.problem == "")
    assert bench.now.connected and bench.connections == 1
    assert OFF not in bench.drive.written
    bench.drive.silent = True
    took = bench.until(lambda: not bench.now.connected)
    assert took < 2 * (TIMEOUT_S + PERIOD_S) + PERIOD_S + STEP_S
    assert bench.now.status is None
    assert "no valid response within 0.5 s" in bench.now.problem
    bench.drive.written.clear()
    bench.drive.silent = False
    bench.until(lambda: bench.drive.values[4] == 10000 and bench.now.connected)
    assert bench.drive.written[0] == OFF
    bench.until(lambda: bench.now.problem == "")
    bench.drive.silent = True
    bench.close()
    assert bench.now.status is None and not bench.now.connected


def test_a_drive_that_closes_its_connections_for_a_moment_is_not_left_in_silence(
    bench: Bench
) -> None:
    """Closed at 0 s; connected again after 0.75 s and, 1 s later, at 1.75 s.

    At the end it is connected once more to be stopped.
    """
    bench.run()
    bench.lose()
    bench.wait(1.0)
    assert not bench.now.connected and SILENT not in bench.now.problem
    bench.drive.written.clear()
    bench.answer = bench.drive
    assert bench.until(lambda: bench.now.connected) < 1.0
    assert bench.drive.written[0] == OFF  # a new connection begins with a stop
    bench.until_half()
    bench.lose()
    bench.answer = bench.drive
    bench.close()
    assert bench.drive.values[0] == 0x047E


def test_after_each_connection_the_drive_is_off_while_it_may_not_guard(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """For 30 s; a cut cable looks like a power cycle, so they begin again."""
    with closing(Bench(monkeypatch, SHIPPED)) as bench:
        bench.speed = 0.5
        bench.exchange.start()
        for _ in range(2):
            bench.until(lambda: bench.now.connected)
            assert "is not effective for 30 s after power-up" in str(bench.now.unguarded)
            bench.drive.written.clear()
            assert bench.until(lambda: RUN in bench.drive.written) >= 30.0 - 2 * PERIOD_S
            bench.until(lambda: bench.now.unguarded is None and bench.drive.values[4] == 10000)
            assert bench.now.problem == ""
            bench.lose()
            bench.answer = bench.drive


def test_after_any_failure_the_next_step_begins_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For instance, no file descriptor is left over."""
    bench.run()
    connect, errors = Cable.connect, [OSError("torn out")]
    monkeypatch.setattr(
        Cable, "connect", lambda cable: connect(cable) if not errors else throw(errors.pop())
    )
    bench.cable.close()
    bench.until(lambda: "communication with the drive failed: OSError('torn out')"
                in bench.now.problem)
    bench.until_half()


def throw(error: Exception) -> None:
    raise error


@pytest.mark.parametrize("fails", ["to start", "while it runs"])
def test_after_a_failed_start_the_next_follows_an_off_that_was_asked_for(
    bench: Bench, fails: str
) -> None:
    """The caller counts starts, and waits between them; here it asks for the speed all the time."""
    bench.connect()
    bench.speed, obeys = 0.5, bench.drive.on_write
    if fails == "to start":
        bench.drive.on_write = lambda _address, _word: None
    else:
        bench.until_half()
        bench.lose()
        bench.answer = bench.drive
    bench.until(lambda: bench.now.start_failed)
    bench.asks = False

    def ask(speed: float | None, until: Callable[[], object]) -> float:
        return bench.until(lambda: bench.exchange.request_speed(speed) or until())

    ask(0.5, lambda: bench.now.connected)
    bench.drive.on_write = obeys
    bench.drive.written.clear()
    began = bench.clock.now
    ask(0.5, lambda: bench.clock.now - began > 20.0)
    assert RUN not in bench.drive.written
    assert str(bench.now.start_failed) == bench.now.problem
    assert bench.now.problem.startswith({
        "to start": "the drive failed to start: ",
        "while it runs": "the connection was lost: ",
    }[fails])
    ask(None, lambda: not bench.now.start_failed)
    ask(0.5, lambda: bench.now.status and bench.now.status.running)


# --- by the test's clock: faults, and another master ----------------------------------------------


def test_the_trip_of_a_lost_connection_is_acknowledged(bench: Bench) -> None:
    fault_texts = set()
    bench.drive.values.update({3: 0x1238, 400: 0x6681})  # EFB communication loss
    bench.exchange.start()
    bench.speed = 0.5

    def runs() -> bool:
        if bench.now.status is not None:
            fault_texts.add(bench.now.status.fault)
        return bench.drive.values[4] == 10000

    bench.until(runs)
    assert bench.drive.written[:3] == [OFF, (1, 0), OFF] and ACKNOWLEDGE in bench.drive.written
    assert fault_texts <= {""}
    assert bench.now.errors == 1


def test_a_fault_is_acknowledged_by_a_reset_while_it_is_seen(bench: Bench) -> None:
    """A reset before the first connection, or between two, does not count: no fault was seen."""
    bench.drive.values.update({3: 0x1238, 400: 0x1234})
    bench.exchange.reset()
    bench.speed = 0.5
    bench.exchange.start()
    for _ in range(2):
        bench.until_reported(
            lambda status: status.fault == "not in the drive file (code 4660, 0x1234)"
        )
        bench.until(lambda: "fault: not in the drive file (code 4660" in bench.now.problem)
        assert ACKNOWLEDGE not in bench.written_in(rounds=5)
        assert bench.now.status is not None and bench.now.status.fault
        bench.lose()
        bench.exchange.reset()
        bench.answer = bench.drive
    bench.until(lambda: bench.now.connected)
    bench.exchange.reset()
    bench.until_reported(lambda status: not status.fault)
    assert ACKNOWLEDGE in bench.drive.written
    bench.until_half()
    bench.until(lambda: bench.now.problem == "")


def test_another_master_is_given_way_and_a_reset_meanwhile_is_forgotten(bench: Bench) -> None:
    """While another master's control word is active, the drive is only stopped; then for 10 s."""
    bench.drive.values.update({3: 0x1238, 400: 0x1234})
    bench.connect()
    bench.written_in(rounds=2)

    def overwrite(address: int, _word: int) -> None:
        if address == 0:
            bench.drive.values[0] = 0x0001

    obeys, bench.drive.on_write = bench.drive.on_write, overwrite
    bench.until(lambda: "someone else is writing to the drive" in bench.now.problem)
    assert bench.now.problem.endswith("is kept off until 10 s after the last foreign control word")
    assert str(bench.now.second_master) == bench.now.problem
    bench.exchange.reset()
    bench.wait(exchange.RESET_S + PERIOD_S)
    bench.drive.on_write = obeys
    bench.drive.values[0] = 0x047E
    assert ACKNOWLEDGE not in bench.written_in(rounds=5)
    assert bench.now.status is not None and bench.now.status.fault
    bench.drive.values.update({3: 0x1231, 400: 0})
    bench.speed = 0.5
    assert 8.0 < bench.until_half() < 10.0


# --- by the test's clock: a drive that refuses to be stopped, or runs on --------------------------


def test_a_drive_that_refuses_to_stop_is_left_in_silence(bench: Bench) -> None:
    """Its own timeout, 58.16, is unknown, and the limit is 10 s.

    If closed during a silence, it tries once more, and ends.
    """
    del bench.drive.values[5815]
    bench.run()
    bench.drive.written.clear()
    bench.asked.clear()
    bench.drive.refused = {0}
    bench.until(lambda: f"{SILENT} 10 s" in bench.now.problem)
    assert "rejected with exception 6" in bench.now.problem
    assert not bench.now.connected and bench.now.status is None
    connections = bench.connections
    assert bench.drive.written[-1] == (1, 0)  # follows the refused word
    for bench.speed in (None, 0.5):  # a demand does not break the silence
        bench.wait(2.0)
    bench.exchange.reset()
    bench.until(lambda: len(bench.silences()) == 2)
    assert min(bench.silences()) >= 10.0
    assert bench.connections == connections + 2  # one attempt after each silence
    count = len(bench.asked)
    assert bench.close() < 2.0
    assert len(bench.asked) > count
    assert bench.now.status is None


@pytest.mark.parametrize(
    ("raw", "silence", "words"),
    [
        (15, "2.5", ""),
        # Above the limit: another master wrote it, or a bit of the answer flipped.
        (16434, "10", "read as 1643.4 s, which is above the limit of 10 s and is not trusted"),
        # Not even longer by the margin of 1 s that is added to the drive's own timeout.
        (95, "10", ""),
    ],
)
@pytest.mark.parametrize("ran", [True, False])
def test_a_silence_is_as_long_as_its_own_timeout_and_no_longer_than_the_limit(
    bench: Bench, raw: int, silence: str, words: str, ran: bool
) -> None:
    """58.16 is in tenths of a second; it is read even if no *stop* was ever taken."""
    if ran:
        bench.run()
    bench.drive.values[5815] = raw
    if ran:
        bench.until(lambda: round(bench.now.timeout_s or 0.0, 3) == raw / 10)
    bench.drive.refused = {0}
    bench.exchange.start()
    bench.speed = None
    bench.until(lambda: f"{SILENT} {silence} s" in bench.now.problem)
    assert words in bench.now.problem
    bench.drive.refused = set()
    bench.until(lambda: bench.drive.values[0] == 0x047E, float(silence) + 1.0)


def test_a_requested_stop_is_tried_during_a_silence(bench: Bench) -> None:
    """The silence lasts 6 s: the drive's own timeout and 1 s. Each request is one attempt.

    A stop that is requested while connected shortens no later silence.
    """
    bench.run()
    bench.exchange.stop()
    bench.written_in(2)
    bench.drive.refused = {0}
    bench.speed = None
    bench.until(lambda: SILENT in bench.now.problem)
    connections = bench.connections
    bench.wait(4.0)
    assert (bench.now.connected, bench.connections) == (False, connections)
    bench.exchange.stop()
    assert bench.until(lambda: bench.connections == connections + 1) < 2 * STEP_S
    bench.until(lambda: not bench.now.connected)
    bench.wait(4.0)
    assert bench.connections == connections + 1 and SILENT in bench.now.problem
    bench.drive.refused = set()
    bench.exchange.stop()
    assert bench.until(lambda: bench.drive.values[0] == 0x047E) < 2 * STEP_S
    bench.until_reported(lambda status: status.at_rest)


class RunningOn:
    """A drive that acknowledges *stop*, and whose speed the test defines; what is reported of it.

    Attributes:
        seconds: since the beginning, when the drive is at half of its speed.
        speed: share of the rated speed, by the time; None cannot be read.
        local: whether it is in local control.
        faults: all faults that were reported.
        left: when each silence began, and why.
    """

    def __init__(self, bench: Bench, speed: Callable[[float], float | None]) -> None:
        self.bench, self.speed, self.local = bench, speed, False
        self.faults: set[str] = set()
        self.left: list[tuple[float, str]] = []
        self._silent = False
        bench.run()
        self._began = bench.clock.now
        bench.answer, bench.speed = self._answer, None

    @property
    def seconds(self) -> float:
        return self.bench.clock.now - self._began

    def _answer(self, request: bytes) -> Answer:
        drive, speed = self.bench.drive, self.speed(self.seconds)
        answer = drive(request)
        drive.values[3] = 0x1031 if self.local else 0x1231
        if request[7] == 3 and request[9] == 4:
            data = request[:4] + bytes([0, 3, request[6], 0x83, 2])
            if speed is not None:
                data = request[:4] + bytes([0, 5, request[6], 3, 2])
                data += round(20000 * speed).to_bytes(2, "big")
            answer = [(0.0, data)]
        return answer

    def listen(self, until: float) -> None:
        """Note what is reported until a time (s)."""
        while self.seconds < until:
            self.bench.step()
            now = self.bench.now
            if now.status is not None:
                self.faults.add(now.status.fault)
            if SILENT in now.problem and not self._silent:
                self.left.append((self.seconds, now.problem))
            self._silent = SILENT in now.problem


FALLEN = "the drive acknowledges *stop*, but its speed has not fallen for 10 s"


@pytest.mark.parametrize(
    ("speed", "first", "why"),
    [
        # A ramp of 1 % in 9 s, which is slow but falls; then noise at standstill.
        (lambda now: max(0.019, 0.5 - 0.01 * (now // 9)), None, ""),
        # Has not fallen for 10 s, observed for 2 s; left for 6 s; and again a minute after that.
        (lambda _now: 0.5, 12.2, f"{FALLEN} (the speed is 50.0%)"),
        # From 5 s on two answers in turn end a connection; 10 s later that is long enough, and is
        # noticed at the next end of a connection, at most 5 s later; and so each minute.
        (lambda now: 0.0 if now < 5 else None, 17.8, "; the speed cannot be read"),
    ],
    ids=["obeys", "runs on", "speed not read"],
)
def test_one_that_does_not_slow_down_is_left_and_again_after_a_minute(
    bench: Bench, speed: Callable[[float], float | None], first: float | None, why: str
) -> None:
    """Meanwhile, 2 s long, the fault is seen."""
    drive = RunningOn(bench, speed)
    bench.asked.clear()
    drive.listen(470 if first is None else 165)
    assert drive.faults <= {"", FALLEN} and (FALLEN in drive.faults) == ("fallen" in why)
    times = [at for at, _ in drive.left]
    assert times[:1] == ([] if first is None else [pytest.approx(first, abs=0.5)])
    assert len(times) == (0 if first is None else 3)
    assert all(66.0 < later - before < 72.0 for before, later in pairwise(times))
    assert all(why in reason and f"{SILENT} 6 s" in reason for _, reason in drive.left)
    assert all(silence >= 6.0 for silence in bench.silences()[:len(times)])
    assert bench.drive.written[-1] in (OFF, (1, 0))
    drive.speed = lambda _now: 0.0
    bench.until_reported(lambda status: status.at_rest and not status.fault)


def test_what_is_known_of_the_speed_outlives_connections_that_break(bench: Bench) -> None:
    drive = RunningOn(bench, lambda _now: 0.5)
    while not drive.left and drive.seconds < 60:
        drive.listen(drive.seconds + 0.7)
        bench.cable.close()
    assert 12 < drive.left[0][0] < 20 and "has not fallen" in drive.left[0][1]


@pytest.mark.parametrize("way", ["stood", "was run", "in local control"])
def test_one_that_stood_or_was_run_or_is_a_persons_begins_again(bench: Bench, way: str) -> None:
    drive = RunningOn(bench, lambda _now: 0.5)
    drive.listen(9.0)
    if way == "stood":
        drive.speed = lambda _now: 0.0
    drive.local = way == "in local control"
    bench.speed = 0.5 if way == "was run" else None
    drive.listen(9.5)
    drive.speed, drive.local, bench.speed = lambda _now: 0.5, False, None
    bench.cable.close()
    drive.listen(18.0)
    drive.local = True
    drive.listen(80.0)
    assert drive.faults == {""} and not drive.left


def test_one_that_is_known_to_run_although_it_reports_rest_is_left(bench: Bench) -> None:
    """Only after *stop*: another order may just have started it."""
    bench.exchange.flows_at_rest = True
    drive = RunningOn(bench, lambda _now: 0.0)
    bench.speed = 0.5
    drive.listen(5.0)
    bench.until(lambda: bench.now.connected)
    bench.speed = None
    drive.listen(drive.seconds + 1.0)
    assert "there: the drive reports standstill, but water is flowing" in bench.now.problem
    assert f"{SILENT} 6 s" in bench.now.problem


def test_a_stop_that_is_refused_on_two_connections_one_after_the_other() -> None:
    """A connection on which nothing could be sent counts neither way."""
    monitor = StopMonitor("there")
    ends = [
        monitor.connection_lost(stopped, 0.0)
        for stopped in (False, True, False, None, False, False)
    ]
    assert [bool(why) for why in ends] == [False, False, False, False, True, True]


# --- by the test's clock: settings ----------------------------------------------------------------


def test_what_someone_changes_at_the_panel_is_noticed(bench: Bench) -> None:
    bench.exchange.start()
    for register, word, seconds in ((5815, 50, 5.0), (5815, 70, 7.0), (5813, 0, None)):
        bench.drive.values[register] = word
        bench.until(lambda seconds=seconds: bench.now.timeout_s == seconds  # type: ignore[misc]
                    and bench.now.timeout_known, 31.0)
    assert "is 0: No action; the pump might run on" in bench.now.timeout_note
    bench.drive.values[5813] = 1
    bench.until(lambda: bench.now.timeout_s == 7.0)
    del bench.drive.values[5815]
    bench.until(lambda: not bench.now.timeout_known)
    assert bench.now.timeout_s is None
    assert "reading register 5815: rejected with exception 2" in bench.now.timeout_note
    assert bench.now.connected


def test_the_rated_speed_is_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Schneider: 725 rpm is half of a rated speed of 1450 rpm, and a quarter of 2900 rpm."""
    file = read_drive_file(find_drive_file("schneider_atv630"))
    with closing(Bench(monkeypatch, file)) as bench:
        bench.answer = drive = Registers({
            8501: 0, 8602: 0, 3201: 0x0233, 8604: 725, 7010: 1, 9604: 1450, 6005: 50,
        })
        bench.exchange.start()
        bench.until_reported(lambda status: status.speed == pytest.approx(0.5))
        drive.values[9604] = 2900
        bench.until_reported(lambda status: status.speed == pytest.approx(0.25))


@pytest.mark.parametrize("status", [None, DriveStatus(True, False, "", "", 0.0, None, True)])
@pytest.mark.parametrize("problem", ["", "no valid response within 0.5 s"])
@pytest.mark.parametrize("age", [0.0, 9.9, 10.1, math.inf])
def test_a_drive_has_a_status_or_a_reason_for_none(
    status: DriveStatus | None, problem: str, age: float
) -> None:
    """At any time, from one look at it: an answer that comes meanwhile cannot hide both."""
    snapshot = DriveSnapshot(status=status, problem=problem, read_at=100.0 - age)
    known = status is not None and age < 10
    assert snapshot.status_at(100.0) == (status if known else None)
    assert (snapshot.absence_at(100.0) is None) == known


# --- behind real ports ----------------------------------------------------------------------------


class Port(Asking):
    """A drive behind a port.

    Attributes:
        drive: its registers.
        wire: the port.
    """

    def __init__(self, at: str = "") -> None:
        """Ask for nothing yet, from the drive at an address or, if that is empty, at the port."""
        self.drive = acs880()
        self.wire = Wire(self.drive)
        super().__init__(DriveExchange(
            DriveEndpoint(ABB, parse_drive_address(at or self.wire.gateway, "at"))
        ))

    def close(self) -> None:
        self.ask_no_more()
        self.exchange.close()
        self.wire.close()

    def close_within(self, seconds: float) -> None:
        began = time.monotonic()
        self.exchange.close()
        assert time.monotonic() - began < seconds


@pytest.fixture
def port() -> Iterator[Port]:
    with closing(Port()) as port:
        yield port


def test_it_stops_the_drive_first_and_reads_what_it_is(port: Port) -> None:
    port.drive.values.update({0: 0x047F, 1: 20000, 3: 0x1337, 4: 20000})  # left by someone
    port.connect()
    assert port.wire.frames[0][12:] == "01060000047e"  # the very first request
    now = port.now
    assert now.status is not None and now.status.at_rest and not now.status.running
    assert now.identity.startswith("ABB ACS880") and "1234" in now.identity
    assert (now.timeout_s, now.timeout_known, now.timeout_note) == (5.0, True, "")
    assert (now.problem, now.errors) == ("", 0)
    time.sleep(0.5)
    assert RUN not in port.drive.written
    assert port.drive.written.count(OFF) > 3  # this keeps the drive's own timeout from passing
    assert sum("0316b7" in frame for frame in port.wire.frames) == 1  # 58.16 is not read each time


def test_a_serial_line_whose_plug_is_pulled() -> None:
    with closing(SerialWire(rtu_server(acs880()))) as plug, closing(
        Port(at=plug.line)
    ) as port:
        port.exchange.start()
        port.speed = 0.5
        wait(lambda: port.now.status and port.now.status.speed == 0.5)
        assert port.now.connected and port.now.errors == 0
        plug.close()
        wait(lambda: not port.now.connected, seconds=1.0)
        assert plug.line in port.now.problem
        port.close_within(2.0)


# --- two drivers ----------------------------------------------------------------------------------


def test_a_second_driver_on_the_same_machine_keeps_off(port: Port) -> None:
    """Although the first names the host differently: each name and address of a machine is one."""
    number = port.wire.port
    names = ("localhost", "127.0.0.1", "127.0.0.2", "0.0.0.0", "[::1]", socket.gethostname())
    places = {DriveEndpoint(ABB, parse_address(f"tcp://{name}:{number}")).lock_name()
              for name in names}
    assert places == {f"localhost-{number}-1"}
    elsewhere = parse_address("tcp://192.0.2.1:502")  # of documentation: no machine's
    assert elsewhere.canonical_name(1) == "192.0.2.1-502"
    first = acquire_drive_lock(DriveEndpoint(ABB, parse_address(f"tcp://localhost:{number}")))
    port.exchange.start()
    port.speed = 0.5
    wait(lambda: f"process {os.getpid()} on this computer" in port.now.problem)
    time.sleep(0.3)
    assert not port.now.connected and port.now.errors
    # The supervisor's stop ignores the lock of its own driver.
    at = DriveEndpoint(ABB, parse_address(port.wire.at))
    with pytest.raises(DriveInUseError, match=f"process {os.getpid()} on this computer"):
        stop_drive(at, driver=1)
    assert port.wire.connections == 0
    assert str(stop_drive(at, driver=os.getpid())) == "speed 0.0%, off"
    first.close()
    wait(lambda: port.drive.values[4] == 10000, seconds=5)


def test_a_serial_line_is_one_drivers_by_any_name(tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    if os.geteuid() == 0:  # a link of a link, and a second file of one device
        (tmp_path / "by-id").unlink()
        (tmp_path / "by-id").symlink_to(tmp_path / "by-path")
        for name in ("ttyUSB0", "by-path"):
            os.mknod(tmp_path / name, stat.S_IFCHR | 0o600, os.makedev(188, 250))
    first, second = (
        DriveEndpoint(ABB, parse_drive_address(f"{tmp_path}/{name}", "at"))
        for name in ("ttyUSB0,1", "by-id,2")
    )
    with acquire_drive_lock(first), pytest.raises(
        DriveInUseError, match=f"process {os.getpid()} on this computer"
    ):
        acquire_drive_lock(second)
    acquire_drive_lock(second).close()


# --- leaving a drive ------------------------------------------------------------------------------


def falls_for(drive: Registers, seconds: float) -> None:
    """Let the drive turn at rated speed, and ramp down from the first *stop* on."""
    began: list[float] = []

    def falls(_address: int, _word: int) -> None:
        began.append(time.monotonic())
        left = max(0.0, 1.0 - (time.monotonic() - began[0]) / seconds)
        drive.values.update({3: 0x1231, 4: round(20000 * left)})

    drive.values.update({0: 0x047F, 1: 20000, 3: 0x1337, 4: 20000})
    drive.on_write = falls


@pytest.mark.parametrize(("seconds", "stands"), [(1.5, True), (6.0, False)])
def test_a_ramp_is_waited_for_at_the_end_and_by_the_supervisors_stop(
    port: Port, monkeypatch: pytest.MonkeyPatch, seconds: float, stands: bool
) -> None:
    """For REST_LIMIT_S, here 2 s: longer than a drive may fail to slow down."""
    monkeypatch.setattr(exchange, "REST_LIMIT_S", 2.0)
    monkeypatch.setattr(exchange, "STEADY_S", 1.0)
    second = acs880()
    with closing(Wire(second)) as second_wire, ThreadPoolExecutor() as pool:
        falls_for(port.drive, seconds)
        port.exchange.start()
        wait(lambda: port.drive.written)
        falls_for(second, seconds)
        stop = pool.submit(stop_drive, DriveEndpoint(ABB, parse_address(second_wire.at)))
        port.exchange.close()
        status = stop.result()
    assert second.written[0] == OFF and RUN not in second.written
    assert port.now.status is not None
    assert (port.now.status.at_rest, status.at_rest) == (stands, stands)


def test_who_stops_a_drive_that_turns_on_reports_what_it_reports_and_keeps_drivers_off_meanwhile(
    port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the supervisor's stop and at the exchange's end; "runs on" is judged after 1 s here."""
    monkeypatch.setattr(exchange, "STEADY_S", 1.0)
    port.drive.values.update({3: 0x1137, 4: 20000})
    port.drive.on_write = lambda _address, _word: None
    began = time.monotonic()
    with ThreadPoolExecutor() as pool:
        stop = pool.submit(stop_drive, DriveEndpoint(ABB, parse_address(port.wire.at)))
        wait(lambda: port.wire.requests)
        port.exchange.start()
        wait(lambda: "is already running this drive" in port.now.problem)
        at_end = stop.result()
    assert time.monotonic() - began < exchange.RUNS_ON_S
    wait(lambda: port.now.connected)
    port.close_within(2.0)
    for status in (at_end, port.now.status):
        assert str(status) == "speed 100.0%, running, local control"
        assert status is not None and not status.at_rest


def test_a_stop_that_is_not_taken_is_tried_three_times(port: Port) -> None:
    port.drive.silent = True
    with pytest.raises(DriveError, match="no valid response"):
        stop_drive(DriveEndpoint(ABB, parse_address(port.wire.at)))
    assert port.wire.connections == 3


def test_the_waits_fit_into_the_longer_ones_of_pump_control_bringup_and_service() -> None:
    """The control waits 15 s (follow_time); the node infers from UNREAD_S that a drive stands.

    Then the pump node's end; the supervisor's stop, perhaps after another one; the other nodes.
    """
    from greenroof_ros.live.supervisor import ACTUATORS_ENDING_S, ENDING_S, KILLING_S

    runs_on_s = exchange.RUNS_ON_S
    assert exchange.UNREAD_S == runs_on_s + exchange.MAX_WAIT_S == 15
    assert exchange.STEADY_S < runs_on_s < runs_on_s + exchange.VISIBLE_S < 15
    assert runs_on_s < exchange.RUNS_ON_AGAIN_S
    leave = exchange.REST_LIMIT_S
    assert MAX_RAMP_S < leave < leave + exchange.MAX_WAIT_S < ACTUATORS_ENDING_S
    service = (CHECKOUT / "examples/greenroof.service").read_text()
    (line,) = (line for line in service.splitlines() if line.startswith("TimeoutStopSec="))
    others_end = 2 * (ENDING_S + KILLING_S)  # the other nodes, and the recorder
    assert float(line.partition("=")[2]) > max(
        ACTUATORS_ENDING_S + KILLING_S + leave, 2 * leave
    ) + others_end
