"""The thread that keeps a drive up, against registers behind a real TCP port."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from modbus_wire import Registers, SerialWire, Wire, acs880, over_serial

from greenroof_ros.drives.address import parse_address
from greenroof_ros.drives.drive_file import DriveFile, find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import DriveExchange, stop_drive
from greenroof_ros.drives.modbus_line import DriveError

PERIOD, DEAD_MAN, TIMEOUT = 0.05, 0.3, 0.2
OFF, RUN = (0, 0x047E), (0, 0x047F)


@pytest.fixture(scope="module")
def file() -> DriveFile:
    return read_drive_file(find_drive_file("abb_acs880"))


@pytest.fixture
def drive() -> Registers:
    return acs880()


@pytest.fixture
def wire(drive: Registers) -> Iterator[Wire]:
    wire = Wire(drive)
    yield wire
    wire.close()


@pytest.fixture
def exchange(file: DriveFile, wire: Wire) -> Iterator[DriveExchange]:
    made = DriveExchange(
        file, parse_address(wire.at), PERIOD, DEAD_MAN, timeout_s=TIMEOUT
    )
    yield made
    made.close()


def wait(what: Callable[[], Any], within: float = 3.0) -> float:
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


@pytest.fixture
def hand(exchange: DriveExchange) -> Iterator[Hand]:
    made = Hand(exchange, None)
    yield made
    made.end()


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
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
    hand.speed = nonsense
    wait(lambda: drive.values[0] == 0x047E)
    assert exchange.snapshot.errors > 0
    time.sleep(4 * PERIOD)
    assert drive.values[0] == 0x047E


def test_close_stops_and_reads_back(
    exchange: DriveExchange, drive: Registers, hand: Hand
) -> None:
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
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
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
    drive.silent = True
    bound = exchange.lost_after_s + PERIOD
    assert bound == pytest.approx(2 * (TIMEOUT + PERIOD) + PERIOD)
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
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
    drive.written.clear()
    wire.drop()
    wait(lambda: exchange.snapshot.errors > 0)
    wait(lambda: wire.connections == 2 and exchange.snapshot.connected)
    wait(lambda: drive.values[4] == 10000)
    assert OFF in drive.written  # a new connection begins with a stop


def test_one_lost_answer_does_not_stop_the_pump(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
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
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
    drive.silent = True
    began = time.monotonic()
    exchange.close()
    assert time.monotonic() - began < 2.0


def test_close_connects_once_more_to_stop(
    exchange: DriveExchange, drive: Registers, wire: Wire, hand: Hand
) -> None:
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
    wire.answer = lambda _request: None
    wire.drop()
    wait(lambda: not exchange.snapshot.connected)
    wire.answer = drive
    exchange.close()
    assert drive.values[0] == 0x047E


def test_nobody_there_and_then_somebody(file: DriveFile, drive: Registers) -> None:
    wire = Wire(drive)
    wire.answer = lambda _request: None
    exchange = DriveExchange(file, parse_address(wire.at), PERIOD, DEAD_MAN, timeout_s=TIMEOUT)
    try:
        exchange.start()
        wait(lambda: exchange.snapshot.errors >= 3)
        assert not exchange.snapshot.connected and "closed" in exchange.snapshot.problem
        wire.answer = drive
        wait(lambda: exchange.snapshot.connected, within=5.5)
    finally:
        exchange.close()
        wire.close()


def test_waits_between_attempts_grow(file: DriveFile) -> None:
    wire = Wire(lambda _request: None)
    exchange = DriveExchange(file, parse_address(wire.at), PERIOD, DEAD_MAN, timeout_s=TIMEOUT)
    try:
        exchange.start()
        time.sleep(2.0)  # attempts after 0, 0.25, 0.75, 1.75 s, and what each takes
        assert 3 <= wire.connections <= 4
    finally:
        exchange.close()
        wire.close()


def test_own_timeout_that_cannot_be_read(exchange: DriveExchange, drive: Registers) -> None:
    del drive.values[5815]
    exchange.start()
    wait(lambda: exchange.snapshot.connected)
    now = exchange.snapshot
    assert not now.timeout_known and now.timeout_s is None
    assert "reading register 5815: refused with exception 2" in now.timeout_note


def test_own_timeout_that_lets_it_run_on(exchange: DriveExchange, drive: Registers) -> None:
    drive.values[5813] = 2
    exchange.start()
    wait(lambda: exchange.snapshot.connected)
    now = exchange.snapshot
    assert now.timeout_known and now.timeout_s is None
    assert "is 2: Last speed; the pump would run on" in now.timeout_note


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
    exchange.start()
    hand.speed = 0.5
    wait(lambda: drive.values[4] == 10000)
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
    wire = SerialWire(over_serial(drive))
    exchange = DriveExchange(file, parse_address(wire.line), PERIOD, DEAD_MAN, timeout_s=TIMEOUT)
    hand = Hand(exchange, 0.5)
    try:
        exchange.start()
        wait(lambda: drive.values[4] == 10000)
        assert exchange.snapshot.connected and exchange.snapshot.errors == 0
        wire.close()
        wait(lambda: not exchange.snapshot.connected, within=1.0)
        assert wire.line in exchange.snapshot.problem
        began = time.monotonic()
        exchange.close()
        assert time.monotonic() - began < 2.0
    finally:
        hand.end()
        exchange.close()
        wire.close()


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
