"""The simulated drive as a program, spoken to in bytes written from the makers' manuals."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from graphs import free_ports
from places import CHECKOUT
from simulators import Bus, Simulator, until

from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file
from greenroof_ros.simulators.control_profiles import profile_of
from greenroof_ros.simulators.simulated_drive import DriveSettings

FREE = ("--port", "0", "--workbench", "0")


@dataclass(frozen=True)
class Make:
    """What a manual says: registers as on the wire, words, and what the status word shows then.

    Attributes:
        start: address and word of each write, and mask and value of the status word after it.
        stop: address and word that ramps down.
        status: address of the status word.
        speed: address of the actual speed, and what it holds at half of rated speed.
        keeps_alive: a reading starts the timeout anew, too.
        lost: address of what shows that the drive's timeout has passed, and what it holds then.
        timeout: addresses of the timeout's parameters, and what they hold as delivered.
    """

    start: tuple[tuple[int, int, int, int], ...]
    stop: tuple[int, int]
    status: int
    speed: tuple[int, int]
    keeps_alive: bool
    lost: tuple[int, int]
    timeout: dict[int, int]


MAKES = {
    # 3AUA0000085967, p. 617 to 620: CW 0x047E to READY TO SWITCH ON (SW bit 0), 0x047F to OPERATION
    # (bits 0 to 2); 20000 is 100 %. 58.14 = 0, 58.16 = 3.0 s; fault 0x6681 in 04.01.
    "abb_acs880": Make(
        ((0, 0x047E, 0x0047, 0x0001), (1, 10000, 0, 0), (0, 0x047F, 0x0047, 0x0007)),
        (0, 0x047E), 3, (4, 10000), False, (400, 0x6681), {5813: 0, 5815: 30},
    ),
    # MG20Z102, p. 175 to 177: CTW 50000, REF 50010, STW 50200, MAV 50210, sent one less; bit 10
    # data valid, 6 start, 2 to 5 no stop of any kind; STW bits 0, 1, 2, 9 ready, 11 in operation.
    # 0x4000 is 100 %. 8-04 Off, 8-03 60.0 s; control word timeout is bit 4 of alarm word 16-90.
    "danfoss_fc202": Make(
        ((49999, 0x043C, 0x0A07, 0x0207), (50009, 0x2000, 0, 0), (49999, 0x047C, 0x0A07, 0x0A07)),
        (49999, 0x043C), 50199, (50209, 0x2000), False, (16900, 0x0010), {8039: 0, 8030: 600},
    ),
    # Functional profile, 9.4 and 9.5: 00101 bit 0 remote, 1 on; 00102 = 1 constant frequency; 00103
    # = 0 automatic; 00104 in 0.01 %; 00201 bits 6 rotating, 8 remote, 9 on; 00305 in 0.1 Hz, of 50.
    # The watchdog 00012, 0 as delivered, hands the pump back: 00201 has neither bit.
    "grundfos_cim500": Make(
        (
            (100, 0x0001, 0x0300, 0x0100), (101, 1, 0, 0), (102, 0, 0, 0), (103, 5000, 0, 0),
            (100, 0x0003, 0x0300, 0x0300),
        ),
        (100, 0x0001), 200, (304, 250), True, (200, 0x0000), {11: 0},
    ),
    # BBV51701, p. 9 to 13: CMD 8501 = 6, 7, 15 leads through ETA 3201 = ..21, ..23 to ..27. LFRD
    # 8602 and RFRD 8604 in rpm, NSP 1500. EAV64332: SLL 7010 = 1 freewheel, TTO 6005 = 10.0 s, LFT
    # 7121 = 5 on the serial port; on Ethernet ETHL 7021 = 1, TTOB 64415 = 10.0 s, LFT = 150.
    "schneider_atv630": Make(
        (
            (8501, 0x0006, 0x006F, 0x0021), (8501, 0x0007, 0x006F, 0x0023), (8602, 750, 0, 0),
            (8501, 0x000F, 0x006F, 0x0027),
        ),
        (8501, 0x0007), 3201, (8604, 750), True, (7121, 5),
        {7010: 1, 6005: 100, 7021: 1, 64415: 100},
    ),
}


@pytest.fixture(params=MAKES)
def make(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def start(bus: Bus, make: str) -> None:
    """Bring a drive to half of its rated speed."""
    for address, word, mask, value in MAKES[make].start:
        bus.write(address, word)
        assert bus.read(MAKES[make].status) & mask == value, f"after 0x{word:04X}"


def control(make: str) -> tuple[int, int]:
    """Return the write that keeps a drive running."""
    return MAKES[make].start[-1][:2]


class OnPaper:
    """A simulated drive with a clock of our own."""

    def __init__(self, make: str, **settings: float | None) -> None:
        file = read_drive_file(find_drive_file(make))
        self.now = 0.0
        settings_of_its_own = DriveSettings(**settings)  # type: ignore[arg-type]
        self.drive = profile_of(file.make)(file, settings_of_its_own, lambda: self.now)

    def start(self, make: str) -> None:
        for address, word, _, _ in MAKES[make].start:
            self.write(address, word)

    def write(self, address: int, word: int) -> None:
        assert self.drive.write(address, [word]) is None

    def speed(self, now: float) -> float:
        self.now = now
        self.drive.advance()
        return self.drive.speed

    def read(self, address: int) -> int:
        return self.drive.registers()[address]


# --- running --------------------------------------------------------------------------------------


def follow_ramp(bus: Bus, register: int, at_half: int, write: tuple[int, int], up: bool) -> None:
    """Write a word and hold every reading until the end of the ramp against a ramp time of 0.8 s.

    Between a write and a reading lies a time that is known as well as their duration, whatever
    else the machine does.
    """
    earliest = time.monotonic()
    bus.write(*write)
    latest = time.monotonic()
    seen = 0
    while True:
        before = time.monotonic()
        share = bus.read(register) / at_half
        after = time.monotonic()
        done = [min(1.0, passed / 0.4) for passed in (before - latest, after - earliest)]
        low, high = done if up else (1 - done[1], 1 - done[0])
        assert low - 0.02 <= share <= high + 0.02
        seen += 0.1 < share < 0.9
        if share == (1 if up else 0):
            break
        assert after - latest < 5
    assert seen >= 3


def test_the_start_of_the_manual_runs_the_motor_up_a_ramp_and_the_stop_down(make: str) -> None:
    """Half of rated speed takes half of the ramp time of 0.8 s, each way."""
    its = MAKES[make]
    with Simulator("drive_simulator", "--drive", make, *FREE, "--ramp", "0.8") as drive, Bus(
        drive.ports[0]
    ) as bus:
        for address, word, mask, value in its.start[:-1]:
            bus.write(address, word)
            assert bus.read(its.status) & mask == value, f"after 0x{word:04X}"
        follow_ramp(bus, *its.speed, its.start[-1][:2], up=True)
        assert drive.speed() == pytest.approx(0.5, abs=1e-3)
        mask, value = its.start[-1][2:]
        assert bus.read(its.status) & mask == value
        follow_ramp(bus, *its.speed, its.stop, up=False)
        assert drive.speed() == 0
        start(bus, make)
        until(lambda: drive.speed() > 0.1)


def test_a_factor_makes_ramps_faster_and_the_timeout_not() -> None:
    """A ramp of 40 s at 100 times: half of it takes 0.2 s. The timeout of 0.6 s stays."""
    drive = OnPaper("danfoss_fc202", ramp_s=40.0, speed=100.0, timeout_s=0.6)
    drive.start("danfoss_fc202")
    assert drive.speed(0.1) == pytest.approx(0.25)
    assert drive.speed(0.2) == drive.speed(0.59) == 0.5
    assert drive.read(16900) == 0
    assert drive.speed(0.61) < 0.5
    assert drive.read(16900) == 0x0010
    with Simulator(
        "drive_simulator", "--drive", "danfoss_fc202", *FREE, "--ramp", "400", "--speed", "1000"
    ) as program, Bus(program.ports[0]) as bus:
        start(bus, "danfoss_fc202")
        until(lambda: bus.read(50209) == 0x2000)


def test_the_flow_of_a_drive_that_reports_it_is_that_of_the_sites_curve() -> None:
    """By hand, at half speed: (0.25 x 55.2 + level - 16)^0.5 x 1.29646e-3 m3/s.

    At 3 / 1.3 = 2.3077 m that is 4.255e-4 m3/s = 1.53 m3/h; at 3 m 1.1596e-3 m3/s = 4.17 m3/h.
    """
    with Simulator(
        "drive_simulator", "--drive", "grundfos_cim500", *FREE, "--ramp", "0.1"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "grundfos_cim500")
        until(lambda: bus.read(304) == 250)
        assert bus.read(301) == 15
        with Bus(drive.ports[1]) as bench:
            bench.ask("0001 0000 0006 f7 06 0005 7530")
        assert bus.read(301) == 42


def test_grundfos_runs_at_another_speed_where_the_set_point_is_none() -> None:
    """In constant pressure, its mode after power-up, the set-point is no share of the speed."""
    with Simulator(
        "drive_simulator", "--drive", "grundfos_cim500", *FREE, "--ramp", "0.1"
    ) as drive, Bus(drive.ports[0]) as bus:
        bus.write(103, 2500)
        bus.write(100, 0x0003)
        until(lambda: drive.speed() > 0.5)


def test_abb_must_come_to_rest_before_it_is_switched_on_again() -> None:
    """OFF1 ACTIVE leaves bit 0 of the status word clear until n(f) = 0; Schneider's is no such."""
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", *FREE, "--ramp", "0.8"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "abb_acs880")
        until(lambda: drive.speed() > 0.3)
        bus.write(0, 0x047E)
        bus.write(0, 0x047F)
        assert bus.read(3) & 0x0003 == 0
        until(lambda: drive.speed() == 0)
        assert bus.read(3) & 0x0041 == 0x0000  # 0x047F still stands, OFF1 must be 0 once
        bus.write(0, 0x047E)
        assert bus.read(3) & 0x0041 == 0x0001


@pytest.mark.parametrize(
    ("make", "address", "word"),
    [
        ("abb_acs880", 0, 0x047D),  # OFF2
        ("abb_acs880", 0, 0x0477),  # inhibit operation
        ("danfoss_fc202", 49999, 0x0474),  # coast
        ("schneider_atv630", 8501, 0x0000),  # disable voltage
    ],
)
def test_words_that_let_the_motor_coast(make: str, address: int, word: int) -> None:
    """Coasting takes 2 s from rated speed, the ramp 60 s: after 0.5 s half of 0.5 is left."""
    drive = OnPaper(make, ramp_s=60.0, coast_s=2.0, timeout_s=100.0)
    drive.start(make)
    assert drive.speed(40.0) == 0.5
    drive.write(address, word)
    assert drive.speed(40.5) == pytest.approx(0.25)


def test_danfoss_obeys_no_control_word_without_the_bit_data_valid() -> None:
    with Simulator("drive_simulator", "--drive", "danfoss_fc202", *FREE, "--ramp", "0.1") as (
        drive
    ), Bus(drive.ports[0]) as bus:
        start(bus, "danfoss_fc202")
        bus.write(49999, 0x0000)
        time.sleep(0.3)
        assert drive.speed() == pytest.approx(0.5, abs=1e-3)


# --- the drive's own timeout ----------------------------------------------------------------------


def test_the_drives_timeout_stops_the_motor(make: str) -> None:
    """5 s after the last message that counts; reading counts with some makes, not with others."""
    its = MAKES[make]
    drive = OnPaper(make, timeout_s=5.0, ramp_s=2.0)
    drive.start(make)
    for now in (4.0, 8.0, 12.0):  # kept alive
        assert drive.speed(now) == 0.5
        drive.write(*control(make))
    drive.now = 16.0
    drive.drive.heard()
    assert drive.speed(16.9) == 0.5
    assert drive.speed(20.9) == (0.5 if its.keeps_alive else 0.0)
    assert drive.speed(23.0) == 0.0
    assert drive.read(its.lost[0]) == its.lost[1]


def test_the_drives_timeout_counts_messages_on_the_wire() -> None:
    """ABB, 1 s: writes keep it alive, readings do not, and neither does the workbench."""
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", *FREE, "--ramp", "0.2", "--timeout", "1"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "abb_acs880")
        for _ in range(7):
            time.sleep(0.2)
            bus.write(0, 0x047F)
        assert drive.speed() > 0.4
        until(lambda: bus.read(400) == 0x6681)
        until(lambda: drive.speed() == 0)
    assert drive.said.count("communication timeout: nothing for 1 s; lets it coast") == 1


def test_a_read_on_the_wire_keeps_a_drive_alive_where_any_message_does() -> None:
    with Simulator(
        "drive_simulator", "--drive", "schneider_atv630", *FREE, "--ramp", "0.2", "--timeout", "1"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "schneider_atv630")
        for _ in range(8):
            time.sleep(0.2)
            bus.read(3201)
        assert drive.speed() > 0.4
        until(lambda: drive.speed() == 0)
        assert bus.read(7121) == 150


def test_a_trip_by_the_timeout_is_reset_by_the_manuals_word() -> None:
    """ABB: bit 7 rising; back in SWITCH-ON INHIBITED, from where OFF1 leads on."""
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", *FREE, "--ramp", "0.1", "--timeout", "0.3"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "abb_acs880")
        until(lambda: bus.read(3) & 0x0008 == 0x0008)
        bus.write(0, 0x047F)
        assert bus.read(3) & 0x000F == 0x0008
        bus.write(0, 0x04FE)
        assert bus.read(3) & 0x0049 == 0x0040
        start(bus, "abb_acs880")
        assert bus.read(400) == 0


def test_as_delivered_the_timeout_is_the_makers(make: str) -> None:
    drive = OnPaper(make, timeout_s=None)
    assert {each: drive.read(each) for each in MAKES[make].timeout} == MAKES[make].timeout


def test_timeout_off_is_read_back_as_off(make: str) -> None:
    """What the registers then hold is off by the manual."""
    address, value = {
        "abb_acs880": (5813, 0), "danfoss_fc202": (8039, 0), "grundfos_cim500": (11, 0),
        "schneider_atv630": (7010, 0),
    }[make]
    drive = OnPaper(make, timeout_s=3.0)
    assert drive.read(address) != value
    drive.drive.inject("timeout_off", 0)
    assert drive.read(address) == value
    drive.start(make)
    assert drive.speed(60.0) == 0.5


@pytest.mark.parametrize(
    ("make", "writes", "speed"),
    [
        ("abb_acs880", {5813: 0, 5805: 1}, 0.5),  # No action
        ("danfoss_fc202", {8039: 1}, 0.5),  # Freeze output
        ("danfoss_fc202", {8039: 2}, 0.3),  # Stop: on the ramp
        ("schneider_atv630", {7010: 0}, 0.5),  # Ignore
        ("schneider_atv630", {7010: 6}, 0.3),  # Ramp stop
        ("schneider_atv630", {7010: 1}, 0.0),  # Freewheel
    ],
)
def test_what_the_timeout_does_is_a_parameter(
    make: str, writes: dict[int, int], speed: float
) -> None:
    """Of 10 s; 2 s later, a ramp of 10 s has taken 0.2 of 0.5, coasting within 2 s all of it."""
    drive = OnPaper(make, timeout_s=10.0, ramp_s=10.0, coast_s=2.0)
    for address, word in writes.items():
        drive.write(address, word)
    drive.start(make)
    assert drive.speed(9.9) == 0.5
    assert drive.speed(12.0) == pytest.approx(speed)


def test_abb_takes_over_a_changed_timeout_only_with_58_06() -> None:
    """58.16 = 0.2 s is read back at once; 58.06 = 1 (Refresh settings) puts it in force."""
    with Simulator("drive_simulator", "--drive", "abb_acs880", *FREE, "--ramp", "0.1") as (
        drive
    ), Bus(drive.ports[0]) as bus:
        start(bus, "abb_acs880")
        bus.write(5815, 2)
        assert bus.read(5815) == 2
        time.sleep(0.5)
        assert bus.read(3) & 0x0008 == 0
        bus.write(5805, 1)
        until(lambda: bus.read(3) & 0x0008 == 0x0008)


def test_abb_guards_nothing_for_30_s_after_power_up() -> None:
    """Power-up at 10 s, boot until 12 s, so guarded from 42 s on."""
    drive = OnPaper("abb_acs880", boot_s=2.0, timeout_s=3.0, ramp_s=1.0)
    drive.now = 10.0
    drive.drive.power_cycle()
    for drive.now, answers in ((11.99, False), (12.0, True), (13.0, True)):
        assert drive.drive.answers is answers
    drive.start("abb_acs880")
    assert drive.speed(41.9) == 0.5
    assert drive.speed(44.5) == 0.0
    assert drive.read(400) == 0x6681


# --- what can go wrong on the wire ----------------------------------------------------------------

READ = "0007 0000 0006 01 03 0000 0001"
ANSWER = "00070000000501030204 7e".replace(" ", "")


@pytest.fixture(scope="module")
def shared() -> Iterator[Simulator]:
    """A drive whose control word is 0x047E."""
    with Simulator("drive_simulator", "--drive", "abb_acs880", *FREE, "--ramp", "0.2") as drive:
        yield drive


@pytest.fixture
def drive(shared: Simulator) -> Iterator[Simulator]:
    """The same, without a fault."""
    shared.inject("none")
    with Bus(shared.ports[0]) as bus:
        bus.write(0, 0x047E)
    yield shared
    shared.inject("none")


def test_without_a_fault_the_answer_is_the_specifications(drive: Simulator) -> None:
    """MBAP header, unit 1, function 3, 2 bytes; an illegal address is exception 2."""
    with Bus(drive.ports[0]) as bus:
        assert bus.ask(READ) == ANSWER
        assert bus.ask("0008 0000 0006 01 03 7000 0001") == "000800000003018302"
        assert bus.ask("0009 0000 0006 01 06 0003 0001") == "000900000003018602"  # read only
        assert bus.ask("000a 0000 0006 05 03 0000 0001") == "000a0000000305830b"  # no such unit


@pytest.mark.parametrize(
    ("fault", "parameter", "answer"),
    [
        ("wrong_unit", None, "000700000005020302047e"),
        ("wrong_function", None, "000700000005010402047e"),
        ("wrong_length", None, "00070000000401030204"),
        ("exception", None, "000700000003018304"),
        ("exception", 6, "000700000003018306"),
    ],
)
def test_wrong_answers(
    drive: Simulator, fault: str, parameter: int | None, answer: str
) -> None:
    drive.inject(fault, *([] if parameter is None else [parameter]))
    with Bus(drive.ports[0]) as bus:
        assert bus.ask(READ) == answer
        drive.inject("none")
        assert bus.ask(READ) == ANSWER


def test_garbage(drive: Simulator) -> None:
    drive.inject("garbage", 40)
    with Bus(drive.ports[0]) as bus:
        first, second = bus.ask(READ), bus.ask(READ)
    assert len(first) == len(second) == 80
    assert first != second


def test_a_split_answer_comes_byte_by_byte(drive: Simulator) -> None:
    drive.inject("split", 30)
    with Bus(drive.ports[0]) as bus:
        pieces = [bus.ask(READ)]
        while len("".join(pieces)) < len(ANSWER):
            pieces.append(bus.receive())
    assert "".join(pieces) == ANSWER
    assert len(pieces) >= 4


@pytest.mark.parametrize(("fault", "milliseconds"), [("slow", 150), ("late", 600)])
def test_slow_and_late_answers(drive: Simulator, fault: str, milliseconds: int) -> None:
    """A late answer meets the next question: it has the transaction id of the former."""
    drive.inject(fault, milliseconds)
    with Bus(drive.ports[0]) as bus:
        began = time.monotonic()
        bus.send(READ)
        assert bus.receive(0.1) == ""
        if fault == "late":
            time.sleep(0.3)
            bus.send("0008" + READ[4:])
        assert bus.receive() == ANSWER
        assert milliseconds / 1000 <= time.monotonic() - began < milliseconds / 1000 + 1
        if fault == "late":
            assert bus.receive() == "0008" + ANSWER[4:]


def test_silence_obeys_but_does_not_answer(drive: Simulator) -> None:
    with Bus(drive.ports[0]) as bus:
        drive.inject("silence")
        assert bus.ask("0007 0000 0006 01 06 0001 4e20", 0.2) == ""
        assert bus.ask("0008 0000 0006 01 06 0000 047f", 0.2) == ""
        until(lambda: drive.speed() == 1.0)


def test_half_open_accepts_connections_and_hears_nothing(drive: Simulator) -> None:
    with Bus(drive.ports[0]) as before:
        drive.inject("half_open")
        with Bus(drive.ports[0]) as after:
            for bus in (before, after):
                assert bus.ask("0008 0000 0006 01 06 0000 047f", 0.2) == ""
        time.sleep(0.1)
        assert drive.speed() == 0


def test_dropped_closes_at_the_request(drive: Simulator) -> None:
    drive.inject("dropped")
    with Bus(drive.ports[0]) as bus:
        assert bus.receive(0.1) == ""
        with pytest.raises(ConnectionError):
            bus.ask(READ)


def test_refused_closes_and_refuses_and_comes_back(drive: Simulator) -> None:
    with Bus(drive.ports[0]) as bus:
        drive.inject("refused")
        with pytest.raises(ConnectionError):
            bus.ask(READ)
    with pytest.raises(ConnectionRefusedError):
        Bus(drive.ports[0])
    drive.inject("none")
    time.sleep(0.1)
    with Bus(drive.ports[0]) as bus:
        assert bus.ask(READ) == ANSWER


def test_an_absurd_speed_is_in_its_register_alone(drive: Simulator) -> None:
    drive.inject("absurd_value", 0x8001)
    with Bus(drive.ports[0]) as bus:
        assert bus.read(4) == 0x8001
        assert bus.ask(READ) == ANSWER


def test_an_unknown_fault_is_refused_by_the_workbench(drive: Simulator) -> None:
    with Bus(drive.ports[1]) as bench:
        assert bench.ask("0001 0000 0006 f7 06 0001 0063") == "000100000003f78603"
        assert bench.ask("0001 0000 0006 f7 06 0000 0001") == "000100000003f78602"


# --- what can go wrong with the drive -------------------------------------------------------------


def test_a_fault_of_the_drive_can_be_reset_when_its_cause_is_gone(drive: Simulator) -> None:
    """ABB fault 0x2310, overcurrent."""
    with Bus(drive.ports[0]) as bus:
        start(bus, "abb_acs880")
        until(lambda: drive.speed() > 0.4)
        drive.inject("drive_fault", 0x2310)
        assert bus.read(3) & 0x000F == 0x0008
        assert bus.read(400) == 0x2310
        bus.write(0, 0x047E)
        bus.write(0, 0x04FE)
        assert bus.read(3) & 0x0008 == 0x0008
        drive.inject("none")
        assert bus.read(3) & 0x0008 == 0x0008
        bus.write(0, 0x047E)
        bus.write(0, 0x04FE)
        assert bus.read(3) & 0x0008 == 0


def test_a_speed_that_stays_and_a_motor_that_runs_on(drive: Simulator) -> None:
    with Bus(drive.ports[0]) as bus:
        until(lambda: bus.read(4) == 0)
        drive.inject("speed_stays")
        start(bus, "abb_acs880")
        time.sleep(0.3)
        assert bus.read(4) == 0
        drive.inject("stuck_running", 7000)
        bus.write(0, 0x047E)
        time.sleep(0.3)
        assert bus.read(4) == 14000
        assert drive.speed() == pytest.approx(0.7)
        drive.inject("none")
        until(lambda: drive.speed() == 0)


def test_a_drive_that_says_it_is_off_and_runs_on(drive: Simulator) -> None:
    """ABB: bits 0 to 2 of the status word are 001 after OFF1, as at rest."""
    with Bus(drive.ports[0]) as bus:
        start(bus, "abb_acs880")
        until(lambda: drive.speed() == pytest.approx(0.5, abs=1e-3))
        drive.inject("runs_on")
        bus.write(0, 0x047E)
        until(lambda: bus.read(3) & 0x0007 == 0x0001)
        bus.write(1, 0)
        for _ in range(20):
            bus.write(0, 0x047E)
            assert bus.read(4) == 10000 and drive.speed() == pytest.approx(0.5, abs=1e-3)
            time.sleep(0.05)
        assert bus.read(3) & 0x0007 == 0x0001
    until(lambda: drive.speed() == 0, 10)
    with Bus(drive.ports[0]) as bus:
        for word in (0x047E, 0x04FE, 0x047E):
            bus.write(0, word)
        assert bus.read(3) & 0x0008 == 0


def test_a_power_cycle_closes_the_port_and_forgets_the_control_word() -> None:
    with Simulator(
        "drive_simulator", "--drive", "schneider_atv630", *FREE, "--boot", "0.4"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "schneider_atv630")
        until(lambda: drive.speed() > 0.05)
        drive.power_cycle()
        time.sleep(0.1)
        with pytest.raises(ConnectionRefusedError):
            Bus(drive.ports[0])
        until(lambda: drive.speed() == 0)
        time.sleep(0.4)
        with Bus(drive.ports[0]) as again:
            assert again.read(3201) & 0x006F == 0x0040  # switch on disabled
            assert again.read(8501) == 0
            start(again, "schneider_atv630")


@pytest.mark.parametrize("make", ["grundfos_cim500", "danfoss_fc202"])
def test_local_control_takes_no_orders_from_the_bus(make: str) -> None:
    """Bit 9 of the status word, with Grundfos bit 8, says whose the drive is."""
    remote = 0x0100 if make == "grundfos_cim500" else 0x0200
    with Simulator("drive_simulator", "--drive", make, *FREE, "--ramp", "0.1") as drive, Bus(
        drive.ports[0]
    ) as bus:
        start(bus, make)
        until(lambda: drive.speed() > 0.4)
        assert bus.read(MAKES[make].status) & remote
        drive.take_over(True)
        assert not bus.read(MAKES[make].status) & remote
        until(lambda: drive.speed() == 0)
        bus.write(*control(make))
        time.sleep(0.2)
        assert drive.speed() == 0


# --- the program ----------------------------------------------------------------------------------


def test_rtu_over_a_pseudo_terminal() -> None:
    """Frames with their CRC as in Modbus over Serial Line V1.02, 6.2.2, by hand; unit 2 is another.

    CRC of 01 03 0003 0001 is 74 0A, of 01 03 02 1230 B4 F0. Without power the line is silent.
    """
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", "--serial", "pty", "--workbench", "0",
        "--boot", "0.5",
    ) as drive:
        device = os.open(drive.ready.split()[2].rstrip(","), os.O_RDWR | os.O_NOCTTY)

        def receive(seconds: float) -> str:
            answer = b""
            while len(answer) < 7 and select.select([device], [], [], seconds)[0]:
                answer += os.read(device, 64)
            return answer.hex()

        os.write(device, bytes.fromhex("02 03 0003 0001 7439"))
        assert receive(0.2) == ""
        os.write(device, bytes.fromhex("01 03 0003 0001 740a"))
        assert receive(2) == "0103021230b4f0"
        assert drive.speed() == 0
        drive.power_cycle()
        os.write(device, bytes.fromhex("01 03 0003 0001 740a"))
        assert receive(0.2) == ""
        time.sleep(0.4)
        os.write(device, bytes.fromhex("01 03 0003 0001 740a"))
        assert receive(2) == "0103021230b4f0"
        os.close(device)


def refused(*options: str) -> str:
    """Return what is said of wrong options."""
    done = subprocess.run(
        [sys.executable, "-m", "greenroof_ros.drive_simulator", *options], cwd=CHECKOUT,
        capture_output=True, text=True, check=False, timeout=20,
    )
    assert done.returncode == 2, done
    assert "Traceback" not in done.stderr
    return done.stderr


def test_wrong_options_are_refused_with_what_would_be_right(tmp_path: Path) -> None:
    assert "abb_acs880, danfoss_fc202" in refused("--drive", "siemens")
    abb = ("--drive", "abb_acs880")
    assert "must be one of none, refused" in refused(*abb, "--fault", "smoke")
    assert "silence has no parameter" in refused(*abb, "--fault", "silence=3")
    assert "whole number from 0 to 65534" in refused(*abb, "--fault", "late=soon")
    free = (*abb, *FREE)
    assert "is no exception code" in refused(*free, "--fault", "exception=99")
    assert "name one with --workbench" in refused(*abb, "--port", "65535")
    own = tmp_path / "own.yaml"
    own.write_text(
        (CHECKOUT / "config" / "drives" / "abb_acs880.yaml").read_text().replace(
            "make: ABB", "make: Hoover"
        )
    )
    assert "make = 'Hoover': cannot be simulated" in refused("--drive", str(own))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert "the port is taken" in refused(*abb, "--port", port, "--workbench", "0")
    assert "no such serial device" in refused(*abb, "--serial", "/dev/nothing", "--workbench", "0")


def test_it_listens_on_loopback_alone_and_its_workbench_is_beside_it() -> None:
    port = free_ports(1)[0]
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", "--port", str(port)
    ) as drive:
        assert drive.ports == [port, port + 1]
        listening = {
            line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
            if line.split()[3] == "0A" and line.split()[1].endswith((f"{port:04X}",
                                                                     f"{port + 1:04X}"))
        }
        assert listening == {f"0100007F:{each:04X}" for each in drive.ports}
