"""The simulated drive in bytes from the manuals, on paper and as a program; and with the driver."""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from graphs import free_ports
from places import guarding
from simulators import DEFAULT, Bus, Simulator, refusal, until

from greenroof_ros import drive_simulator
from greenroof_ros.drives.drive import Drive, DriveStatus
from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import DriveExchange, State
from greenroof_ros.drives.modbus_line import parse_address
from greenroof_ros.simulators.control_profiles import profile_of
from greenroof_ros.simulators.simulated_drive import DriveSettings

FREE = ("--port", "0", "--workbench", "0")


@dataclass(frozen=True)
class Make:
    """What a manual says: registers as on the wire, words, and what the status word shows then.

    Attributes:
        start: address and word of each write, and mask and value of the status word after it.
        status: address of the status word.
        keeps_alive: a reading starts the timeout again, too.
        lost: address of what shows that the drive's timeout has passed, and what it holds then.
        timeout: addresses of the timeout's parameters, and what they hold as delivered.
        off: address of one of them, and what it holds when the timeout is off.
        remote: mask of the status word: the bus has the drive.
    """

    start: tuple[tuple[int, int, int, int], ...]
    status: int
    keeps_alive: bool
    lost: tuple[int, int]
    timeout: dict[int, int]
    off: tuple[int, int]
    remote: int = 0x0200


MAKES = {
    # 3AUA0000085967, p. 617 to 620: CW 0x047E to READY TO SWITCH ON (SW bit 0), 0x047F to OPERATION
    # (bits 0 to 2); 20000 is 100 %. 58.14 = 0, 58.16 = 3.0 s; fault 0x6681 in 04.01.
    "abb_acs880": Make(
        ((0, 0x047E, 0x0047, 0x0001), (1, 10000, 0, 0), (0, 0x047F, 0x0047, 0x0007)),
        3, False, (400, 0x6681), {5813: 0, 5815: 30}, (5813, 0),
    ),
    # MG20Z102, p. 175 to 177: CTW 50000, REF 50010, STW 50200, MAV 50210, sent one less; bit 10
    # data valid, 6 start, 2 to 5 no stop of any kind; STW bits 0, 1, 2, 9 ready, 11 in operation.
    # 0x4000 is 100 %. 8-04 Off, 8-03 60.0 s; control word timeout is bit 4 of alarm word 16-90.
    "danfoss_fc202": Make(
        ((49999, 0x043C, 0x0A07, 0x0207), (50009, 0x2000, 0, 0), (49999, 0x047C, 0x0A07, 0x0A07)),
        50199, False, (16900, 0x0010), {8039: 0, 8030: 600}, (8039, 0),
    ),
    # Functional profile, 9.4 and 9.5: 00101 bit 0 remote, 1 on; 00102 = 1 constant frequency; 00103
    # = 0 automatic; 00104 in 0.01 %; 00201 bits 6 rotating, 8 remote, 9 on; 00305 in 0.1 Hz, of 50.
    # The watchdog 00012, 0 as delivered, hands the pump back: 00201 has neither bit.
    "grundfos_cim500": Make(
        (
            (100, 0x0001, 0x0300, 0x0100), (101, 1, 0, 0), (102, 0, 0, 0), (103, 5000, 0, 0),
            (100, 0x0003, 0x0300, 0x0300),
        ),
        200, True, (200, 0x0000), {11: 0}, (11, 0), remote=0x0100,
    ),
    # BBV51701, p. 9 to 13: CMD 8501 = 6, 7, 15 leads through ETA 3201 = ..21, ..23 to ..27. LFRD
    # 8602 and RFRD 8604 in rpm, NSP 1500. EAV64332: SLL 7010 = 1 freewheel, TTO 6005 = 10.0 s, LFT
    # 7121 = 5 on the serial port; on Ethernet ETHL 7021 = 1, TTOB 64415 = 10.0 s, LFT = 150.
    "schneider_atv630": Make(
        (
            (8501, 0x0006, 0x006F, 0x0021), (8501, 0x0007, 0x006F, 0x0023), (8602, 750, 0, 0),
            (8501, 0x000F, 0x006F, 0x0027),
        ),
        3201, True, (7121, 5), {7010: 1, 6005: 100, 7021: 1, 64415: 100}, (7010, 0),
    ),
}


@pytest.fixture(params=MAKES)
def make(request: pytest.FixtureRequest) -> str:
    return str(request.param)


class OnPaper:
    """A simulated drive with a clock of our own; the ramp takes 10 s unless said otherwise."""

    def __init__(self, make: str, interface: str = "serial", **settings: float | None) -> None:
        self.now = 0.0
        self.its = MAKES[make]
        file = read_drive_file(find_drive_file(make))
        told = DriveSettings(**({"ramp_s": 10.0} | settings))  # type: ignore[arg-type]
        self.drive = profile_of(file.make)(file, told, lambda: self.now, interface)

    def write(self, address: int, word: int) -> None:
        assert self.drive.write(address, [word]) is None

    def read(self, address: int) -> int:
        return self.drive.registers()[address]

    def status(self, mask: int) -> int:
        return self.read(self.its.status) & mask

    def start(self) -> None:
        """Order half of rated speed, as the manual does."""
        for address, word, mask, value in self.its.start:
            self.write(address, word)
            assert self.status(mask) == value, f"after 0x{word:04X}"

    def speed(self, now: float | None = None) -> float:
        """Return the true speed (share of rated) at a time (s)."""
        self.now = self.now if now is None else now
        self.drive.advance()
        return self.drive.speed

    def run(self) -> None:
        """Be at half of rated speed."""
        self.start()
        self.speed(self.now + 0.5 * self.drive.settings.ramp_s)
        assert self.drive.speed == 0.5


def start(bus: Bus, make: str) -> None:
    """Bring a drive to half of its rated speed."""
    for address, word, _, _ in MAKES[make].start:
        bus.write(address, word)


def place_of(drive: Simulator) -> str:
    """Return the address that a simulator says is the drive's."""
    return drive.ready.split()[2].rstrip(",")


# --- running --------------------------------------------------------------------------------------


def test_a_factor_makes_ramps_faster_and_the_timeout_not() -> None:
    """A ramp of 40 s at 100 times: half of it takes 0.2 s. The timeout of 0.6 s stays."""
    drive = OnPaper("danfoss_fc202", ramp_s=40.0, speed=100.0, timeout_s=0.6)
    drive.start()
    assert drive.speed(0.1) == pytest.approx(0.25)
    assert drive.speed(0.2) == drive.speed(0.59) == 0.5
    assert drive.read(16900) == 0
    assert drive.speed(0.61) < 0.5
    assert drive.read(16900) == 0x0010


def test_the_flow_of_a_drive_that_reports_it_is_that_of_the_sites_curve() -> None:
    """By hand, at half speed: (0.25 x 55.2 + level - 16)^0.5 x 1.29646e-3 m3/s.

    At 3 / 1.3 = 2.3077 m that is 4.255e-4 m3/s = 1.53 m3/h; at 3 m 1.1596e-3 m3/s = 4.17 m3/h.
    Half of a ramp of 400 s takes 0.2 s when it is 1000 times as fast.
    """
    with Simulator(
        "drive_simulator", "--drive", "grundfos_cim500", *FREE, "--ramp", "400", "--speed", "1000"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "grundfos_cim500")
        assert 0.1 < until(lambda: bus.read(304) == 250) < 5
        assert drive.speed() == pytest.approx(0.5, abs=1e-3)
        assert bus.read(301) == 15
        with Bus(drive.ports[1]) as bench:
            bench.ask("0001 0000 0006 f7 06 0005 7530")
        assert bus.read(301) == 42


def test_grundfos_runs_at_another_speed_where_the_set_point_is_none() -> None:
    """In constant pressure, its mode after power-up, the set-point is no share of the speed."""
    drive = OnPaper("grundfos_cim500", ramp_s=1.0)
    drive.write(103, 2500)
    drive.write(100, 0x0003)
    assert drive.speed(1.0) > 0.5


def test_abb_must_come_to_rest_before_it_is_switched_on_again() -> None:
    """OFF1 ACTIVE leaves bit 0 of the status word clear until n(f) = 0; Schneider's is no such."""
    drive = OnPaper("abb_acs880", timeout_s=100.0)
    drive.run()
    drive.write(0, 0x047E)
    drive.write(0, 0x047F)
    assert drive.status(0x0003) == 0
    assert drive.speed(drive.now + 5) == 0
    assert drive.status(0x0041) == 0x0000  # 0x047F still stands, OFF1 must be 0 once
    drive.write(0, 0x047E)
    assert drive.status(0x0041) == 0x0001


@pytest.mark.parametrize(
    ("make", "address", "word", "left"),
    [
        ("abb_acs880", 0, 0x047D, 0.25),  # OFF2
        ("abb_acs880", 0, 0x0477, 0.25),  # inhibit operation
        ("danfoss_fc202", 49999, 0x0474, 0.25),  # coast
        ("danfoss_fc202", 49999, 0x0000, 0.5),  # without the bit *data valid* it is not obeyed
        ("schneider_atv630", 8501, 0x0000, 0.25),  # disable voltage
    ],
)
def test_words_that_let_the_motor_coast(make: str, address: int, word: int, left: float) -> None:
    """Coasting takes 2 s from rated speed, the ramp 60 s: after 0.5 s half of 0.5 is left."""
    drive = OnPaper(make, ramp_s=60.0, coast_s=2.0, timeout_s=100.0)
    drive.run()
    drive.write(address, word)
    assert drive.speed(drive.now + 0.5) == pytest.approx(left)


# --- the drive's own timeout ----------------------------------------------------------------------


def test_the_drives_timeout_stops_the_motor(make: str) -> None:
    """5 s after the last message that counts; reading counts with some makes, not with others."""
    drive = OnPaper(make, timeout_s=5.0, ramp_s=2.0)
    drive.start()
    for now in (4.0, 8.0, 12.0):  # kept alive
        assert drive.speed(now) == 0.5
        drive.write(*drive.its.start[-1][:2])
    drive.now = 16.0
    drive.drive.heard()
    assert drive.speed(16.9) == 0.5
    assert drive.speed(20.9) == (0.5 if drive.its.keeps_alive else 0.0)
    assert drive.speed(23.0) == 0.0
    assert drive.read(drive.its.lost[0]) == drive.its.lost[1]


def test_the_drives_timeout_counts_messages_on_the_wire() -> None:
    """1 s: Schneider counts readings, too, and not the workbench's. On Ethernet LFT is 150."""
    with Simulator(
        "drive_simulator", "--drive", "schneider_atv630", *FREE, "--ramp", "0.2", "--timeout", "1"
    ) as drive, Bus(drive.ports[0]) as bus:
        start(bus, "schneider_atv630")
        for _ in range(7):
            time.sleep(0.2)
            bus.read(3201)
        assert drive.speed() > 0.4
        until(lambda: drive.speed() == 0)
        assert bus.read(7121) == 150
    assert drive.said.count("communication timeout: nothing for 1 s; lets it coast") == 1


def test_a_trip_is_reset_by_the_manuals_word_when_its_cause_is_gone() -> None:
    """ABB: bit 7 rising; back in SWITCH-ON INHIBITED, from where OFF1 leads on.

    Fault 0x2310, overcurrent, stands for a while.
    """
    drive = OnPaper("abb_acs880", timeout_s=100.0)
    drive.run()
    drive.drive.inject("drive_fault", 0x2310)
    assert (drive.status(0x000F), drive.read(400)) == (0x0008, 0x2310)
    for status in (0x0008, 0x0040):
        drive.write(0, 0x047F)
        assert drive.status(0x000F) == 0x0008
        drive.write(0, 0x04FE)
        assert drive.status(0x0048) == status
        drive.drive.inject("none", 0)
    drive.start()
    assert drive.read(400) == 0


def test_as_delivered_the_timeout_is_the_makers_and_off_is_read_back(make: str) -> None:
    """On the serial port; the other interface's is as delivered in any case."""
    drive = OnPaper(make, timeout_s=None)
    assert {each: drive.read(each) for each in drive.its.timeout} == drive.its.timeout
    if make == "schneider_atv630":
        on_ethernet = OnPaper(make, "tcp", timeout_s=3.0)
        assert [on_ethernet.read(each) for each in (6005, 64415)] == [100, 30]
    drive = OnPaper(make, timeout_s=3.0, ramp_s=1.0)
    address, off = drive.its.off
    assert drive.read(address) != off
    drive.drive.inject("timeout_off", 0)
    assert drive.read(address) == off
    drive.run()
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
    drive = OnPaper(make, timeout_s=10.0, coast_s=2.0)
    for address, word in writes.items():
        drive.write(address, word)
    drive.start()
    assert drive.speed(9.9) == 0.5
    assert drive.speed(12.0) == pytest.approx(speed)


def test_abb_takes_over_a_changed_timeout_only_with_58_06() -> None:
    """58.16 = 0.2 s is read back at once; 58.06 = 1 (Refresh settings) puts it in force."""
    drive = OnPaper("abb_acs880")
    drive.start()
    drive.write(5815, 2)
    assert drive.read(5815) == 2
    drive.now = 0.5
    assert drive.status(0x0008) == 0
    drive.write(5805, 1)
    assert drive.status(0x0008) == 0x0008


def test_abb_guards_nothing_for_30_s_after_power_up() -> None:
    """Power-up at 10 s, boot until 12 s, so guarded from 42 s on."""
    drive = OnPaper("abb_acs880", boot_s=2.0, timeout_s=3.0, ramp_s=1.0)
    drive.now = 10.0
    drive.drive.power_cycle()
    for drive.now, answers in ((11.99, False), (12.0, True), (13.0, True)):
        assert drive.drive.answers is answers
    drive.start()
    assert drive.speed(41.9) == 0.5
    assert drive.speed(44.5) == 0.0
    assert drive.read(400) == 0x6681


# --- what can go wrong with the drive -------------------------------------------------------------


def test_a_speed_that_stays_and_a_motor_that_runs_on() -> None:
    drive = OnPaper("abb_acs880", timeout_s=100.0)
    drive.drive.inject("speed_stays", 0)
    drive.start()
    assert drive.speed(5.0) == drive.read(4) == 0
    drive.drive.inject("stuck_running", 7000)
    drive.write(0, 0x047E)
    assert drive.speed(10.0) == pytest.approx(0.7)
    assert drive.read(4) == 14000
    drive.drive.inject("none", 0)
    assert drive.speed(20.0) == 0


def test_a_drive_that_runs_on_says_that_it_is_off() -> None:
    """ABB: bits 0 to 2 of the status word are 001 after OFF1, as at rest."""
    drive = OnPaper("abb_acs880", timeout_s=100.0)
    drive.run()
    drive.drive.inject("runs_on", 0)
    drive.write(0, 0x047E)
    assert drive.speed(drive.now + 1) == 0.5 and drive.status(0x0007) == 0x0001


@pytest.mark.parametrize("make", ["grundfos_cim500", "danfoss_fc202"])
def test_local_control_takes_no_orders_from_the_bus(make: str) -> None:
    """A bit of the status word says whose the drive is."""
    drive = OnPaper(make, ramp_s=1.0)
    drive.run()
    assert drive.status(drive.its.remote)
    drive.drive.take_over(True)
    assert not drive.status(drive.its.remote)
    for _ in range(2):
        assert drive.speed(drive.now + 0.5) == 0
        drive.write(*drive.its.start[-1][:2])


# --- what can go wrong on the wire ----------------------------------------------------------------

READ = "0007 0000 0006 01 03 0000 0001"
ANSWER = "00070000000501030204 7e".replace(" ", "")


@pytest.fixture(scope="module")
def shared() -> Iterator[Simulator]:
    """A drive whose control word is 0x047E."""
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", *FREE, "--ramp", "0.2", "--boot", "0.4"
    ) as drive:
        yield drive


@pytest.fixture
def drive(shared: Simulator) -> Iterator[Simulator]:
    """The same, without a fault."""
    shared.inject("none")
    yield shared
    shared.inject("none")


@pytest.fixture
def bus(drive: Simulator) -> Iterator[Bus]:
    """A connection to it."""
    with Bus(drive.ports[0]) as made:
        made.write(0, 0x047E)
        yield made


@pytest.mark.parametrize(
    ("port", "request_", "answer"),
    [
        (0, "0006 01 03 7000 0001", "0003018302"),
        (0, "0006 01 06 0003 0001", "0003018602"),  # read only
        (0, "0006 05 03 0000 0001", "000305830b"),  # no such unit
        # No fault has the number 99, and the true speed cannot be written.
        (1, "0006 f7 06 0001 0063", "0003f78603"),
        (1, "0006 f7 06 0000 0001", "0003f78602"),
    ],
)
def test_what_is_not_there_is_refused_by_the_specifications_exception(
    drive: Simulator, port: int, request_: str, answer: str
) -> None:
    """An illegal address is exception 2, a value 3, a path of a gateway 11; 1: the workbench."""
    with Bus(drive.ports[port]) as bus:
        assert bus.ask(f"0008 0000 {request_}") == f"00080000{answer}"


@pytest.mark.parametrize(
    ("fault", "parameter", "answer"),
    [
        ("none", DEFAULT, ANSWER),
        ("wrong_unit", DEFAULT, "000700000005020302047e"),
        ("wrong_function", DEFAULT, "000700000005010402047e"),
        ("wrong_length", DEFAULT, "00070000000401030204"),
        ("exception", DEFAULT, "000700000003018304"),
        ("exception", 6, "000700000003018306"),
        ("absurd_value", 0x8001, ANSWER),  # in the register of the speed alone
    ],
)
def test_wrong_answers(
    drive: Simulator, bus: Bus, fault: str, parameter: int, answer: str
) -> None:
    drive.inject(fault, parameter)
    assert bus.ask(READ) == answer
    assert fault != "absurd_value" or bus.read(4) == parameter
    drive.inject("none")
    assert bus.ask(READ) == ANSWER


def test_silence_obeys_and_half_open_does_not(drive: Simulator, bus: Bus) -> None:
    drive.inject("half_open")
    assert bus.ask("0007 0000 0006 01 06 0001 4e20", 0.2) == ""
    drive.inject("none")
    assert (bus.read(1), bus.ask(READ)) == (0, ANSWER)
    drive.inject("silence")
    assert bus.ask("0008 0000 0006 01 06 0001 4e20", 0.2) == ""
    assert bus.ask("0008 0000 0006 01 06 0000 047f", 0.2) == ""
    until(lambda: drive.speed() == 1.0)


def test_garbage_and_an_answer_byte_by_byte(drive: Simulator, bus: Bus) -> None:
    drive.inject("garbage", 40)
    first, second = bus.ask(READ), bus.ask(READ)
    assert len(first) == len(second) == 80 and first != second
    drive.inject("split", 30)
    pieces = [bus.ask(READ)]
    while len("".join(pieces)) < len(ANSWER):
        pieces.append(bus.receive())
    assert "".join(pieces) == ANSWER and len(pieces) >= 4


def test_slow_and_late_answers(drive: Simulator, bus: Bus) -> None:
    """A late answer meets the next question: it has the transaction id of the former."""
    for fault, milliseconds in (("slow", 150), ("late", 600)):
        drive.inject(fault, milliseconds)
        began = time.monotonic()
        bus.send(READ)
        assert bus.receive(0.1) == ""
        if fault == "late":
            time.sleep(0.3)
            bus.send("0008" + READ[4:])
        assert bus.receive() == ANSWER
        assert milliseconds / 1000 <= time.monotonic() - began < milliseconds / 1000 + 1
    assert bus.receive() == "0008" + ANSWER[4:]


@pytest.mark.parametrize("fault", ["dropped", "runs_on"])
def test_a_connection_that_is_closed_at_a_request(
    drive: Simulator, bus: Bus, fault: str
) -> None:
    """At once; or by a drive that runs on, when it is a second old, but at no order."""
    drive.inject(fault, 1 if fault == "runs_on" else DEFAULT)
    if fault == "runs_on":
        assert bus.ask(READ) == ANSWER
        time.sleep(1.1)
        bus.write(0, 0x047E)
    assert bus.receive(0.1) == ""
    with pytest.raises(ConnectionError):
        bus.ask(READ)


@pytest.mark.parametrize("gone", ["refused", "power_cycle"])
def test_a_port_that_closes_and_comes_back(drive: Simulator, bus: Bus, gone: str) -> None:
    """Refused until that ends; without power until it has booted, and the control word is gone."""
    if gone == "refused":
        drive.inject("refused")
    else:
        drive.power_cycle()
    with pytest.raises(ConnectionError):
        bus.ask(READ)
    with pytest.raises(ConnectionRefusedError):
        Bus(drive.ports[0])
    drive.inject("none")
    time.sleep(0.5)
    with Bus(drive.ports[0]) as again:
        assert again.ask(READ) == (ANSWER if gone == "refused" else ANSWER[:-4] + "0000")


# --- the program ----------------------------------------------------------------------------------


def test_rtu_over_a_pseudo_terminal() -> None:
    """Frames with their CRC as in Modbus over Serial Line V1.02, 6.2.2, by hand; unit 2 is another.

    CRC of 01 03 0003 0001 is 74 0A, of 01 03 02 1230 B4 F0. Without power the line is silent. The
    driver is told there, too, that it is a simulator.
    """
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", "--serial", "pty", "--workbench", "0",
        "--boot", "0.5",
    ) as drive:
        device = os.open(place_of(drive), os.O_RDWR | os.O_NOCTTY)

        def ask(frame: str, seconds: float) -> str:
            os.write(device, bytes.fromhex(frame))
            answer = b""
            while len(answer) < 7 and select.select([device], [], [], seconds)[0]:
                answer += os.read(device, 64)
            return answer.hex()

        status = "01 03 0003 0001 740a"
        assert ask("02 03 0003 0001 7439", 0.2) == ""
        assert ask(status, 2) == "0103021230b4f0"
        drive.power_cycle()
        assert ask(status, 0.2) == ""
        time.sleep(0.4)
        assert ask(status, 2) == "0103021230b4f0"
        driver = Drive(
            read_drive_file(find_drive_file("abb_acs880")), parse_address(place_of(drive))
        )
        driver.line.connect()
        assert driver.why_no_simulator() == ""
        driver.line.close()
        os.close(device)


def test_wrong_options_are_refused_with_what_would_be_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = partial(refusal, monkeypatch, drive_simulator, "--drive", "abb_acs880")
    assert "abb_acs880, danfoss_fc202" in refused("--drive", "siemens")
    assert "must be one of none, refused" in refused("--fault", "smoke")
    assert "silence has no parameter" in refused("--fault", "silence=3")
    assert "whole number from 0 to 65534" in refused("--fault", "late=soon")
    assert "is no exception code" in refused(*FREE, "--fault", "exception=99")
    own = tmp_path / "own.yaml"
    own.write_text(find_drive_file("abb_acs880").read_text().replace("make: ABB", "make: Hoover"))
    assert "make = 'Hoover': cannot be simulated" in refused("--drive", str(own))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert "the port is taken" in refused("--port", port, "--workbench", "0")
    assert "no such serial device" in refused("--serial", "/dev/nothing", "--workbench", "0")


def test_it_listens_on_loopback_alone_and_its_workbench_is_beside_it() -> None:
    port = free_ports(1)[0]
    with Simulator("drive_simulator", "--drive", "abb_acs880", "--port", str(port)) as drive:
        assert drive.ports == [port, port + 1]
        listening = [line.split()[1:4] for line in Path("/proc/net/tcp").read_text().splitlines()]
        ours = {f"{each:04X}" for each in drive.ports}
        assert {at for at, _, state in listening if state == "0A" and at[-4:] in ours} == {
            f"0100007F:{each}" for each in ours
        }


# --- with the driver, which is made from the drive files ------------------------------------------


def test_with_the_driver_every_make_runs_stops_and_is_left_when_it_does_not(
    make: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault and its reset, and a stop that is acknowledged and no more; seen after 2 s here.

    It says that it is a simulator, at a port, or at a gateway's where the make has none. Writing
    *stop* on and on would keep its own timeout alive, so it is left in silence. That is 2 s here,
    but for a CIM, whose is fixed.
    """
    monkeypatch.setattr("greenroof_ros.drives.exchange.RUNS_ON_S", 2.0)
    timeout = 5 if make == "grundfos_cim500" else 2
    file = read_drive_file(Path(guarding(make, tmp_path)))
    with Simulator(
        "drive_simulator", "--drive", make, *FREE, "--ramp", "0.4", "--timeout", "2"
    ) as drive, closing(
        DriveExchange(file, parse_address(place_of(drive)), period_s=0.1)
    ) as exchange:

        def said(what: Callable[[DriveStatus], bool]) -> bool:
            return exchange.snapshot.status is not None and what(exchange.snapshot.status)

        def reach(speed: float) -> None:
            """Ask for a speed until motor and driver both say that it is there."""

            def there() -> bool:
                exchange.demand(speed or None)
                return drive.speed() == pytest.approx(speed, abs=1e-3) and said(
                    lambda status: status.speed == pytest.approx(speed, abs=2e-3)
                )

            until(there, 8)

        exchange.only_simulator()
        exchange.start()
        reach(0.6)
        assert exchange.snapshot.timeout_s == timeout
        reach(0.0)
        reach(0.4)
        drive.inject("drive_fault")
        until(lambda: said(lambda status: status.fault != "") and drive.speed() == 0)
        drive.inject("none")
        exchange.demand(None)
        exchange.reset()
        until(lambda: said(lambda status: status.fault == ""))
        reach(0.6)
        drive.inject("runs_on")
        exchange.demand(None)
        until(lambda: said(
            lambda status: "acknowledges *stop*" in status.fault and not status.running
        ), 20)
        assert exchange.snapshot.state is State.STOPPING  # its cause is seen before the silence
        until(lambda: "acknowledges *stop*" in exchange.snapshot.problem, 20)
        assert drive.speed() == pytest.approx(0.6, abs=1e-3)
        assert f"so nothing is sent for {timeout + 1} s" in exchange.snapshot.problem
        until(lambda: drive.speed() == 0, 20)
        until(lambda: exchange.snapshot.connected, 20)
        reach(0.4)
        exchange.close()
        assert drive.speed() < 0.4
        until(lambda: drive.speed() == 0)
    assert f"communication timeout: nothing for {timeout} s" in drive.said
