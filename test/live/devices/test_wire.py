"""The driver's bytes against requests written out by hand from the makers' manuals.

In a dialogue, `0003? 1337` reads register 0x0003 (function 03), which answers 0x1337; `0000= 047E`
writes a word (function 06), and the answer repeats it, or refuses it with an exception: `! 06`.
`modbus_wire.script` makes the bytes of Modbus TCP.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from typing import Any

import pytest
from modbus_wire import Answer, Registers, Wire, acs880, frame, script
from simulators import until

from greenroof_ros.live.devices.drive import Drive, DriveStatus
from greenroof_ros.live.devices.drive_file import find_drive_file, read_drive_file
from greenroof_ros.live.devices.modbus_line import DriveError, parse_address

Task = Callable[[Drive], Any]


def talk(name: str, wire: str, task: Task, timeout_s: float = 0.3) -> Any:
    """Call a function with a drive behind an address."""
    file = read_drive_file(find_drive_file(name))
    drive = Drive(file, parse_address(wire, "at"), timeout_s)
    drive.line.connect()
    with closing(drive.line):
        return task(drive)


def follow(name: str, dialogue: str, task: Task, *, gateway: bool = False) -> Any:
    """Call a function; every request must be the dialogue's, byte for byte."""
    requests, answer = script(dialogue)
    with closing(Wire(answer)) as wire:
        try:
            return talk(name, wire.gateway if gateway else wire.at, task, timeout_s=3.0)
        finally:
            assert wire.frames == [request.hex() for request in requests]


def run(drive: Drive) -> None:
    drive.run(0.5)


# The start from any state to half of rated speed; the stop; and, after it, the reset of a fault.
DIALOGUES = {
    # ABB ACS880: 400004 status, 400001 control, 400002 reference. State diagram, p. 620: CW x110
    # leads to READY TO SWITCH ON (SW bit 0), x111 and 1111 with bits 4 to 6 set to OPERATION; bit
    # 10 must be set. 20000 is 100 % (FENA-11 p. 92): 10000 = 0x2710. A rising bit 7 acknowledges
    # (p. 437). It runs first, in an unknown mode; then it is not yet ready to switch on, then is.
    "abb_acs880": (
        "0003? 1337, 0000= 047E, 0003? 1270, 0003? 1231, 0001= 2710, 0000= 047F, 0003? 1237",
        "0000= 047E, 0001= 0000, 0003? 1231",
        "0000= 04FE, 0000= 047E, 0003? 1231",
    ),
    # Danfoss FC 202: 50200 status (sent as 50199 = 0xC417), 50000 control (0xC34F), 50010 reference
    # (0xC359). FC profile, MG.33.B6.22 p. 277: bits 2 to 5 ramp, no coast, no quick stop, no
    # freeze; 6 start; 7 acknowledges when it rises; 10 data valid. 0x4000 is 100 %: 0x2000. Status:
    # bits 0 1 2 9 enabled, 3 trip, 11 in operation.
    "danfoss_fc202": (
        "C417? 0603, C34F= 043C, C417? 0607, C359= 2000, C34F= 047C, C417? 0E07",
        "C34F= 043C, C359= 0000, C417? 0607",
        "C34F= 04BC, C34F= 043C, C417? 0607",
    ),
    # Grundfos CIM 500: 00201 status (sent as 200 = 0x00C8), 00101 control bits, 00102 control mode
    # (1 frequency), 00103 operating mode (0 normal), 00104 set-point in 0.01 %: 5000 = 0x1388.
    # Manual p. 18 to 21: 00101 bit 0 remote, bit 1 on, bit 2 acknowledges when it rises; 00201 bit
    # 8 remote, bit 9 on, bit 10 fault. Both modes are read back.
    "grundfos_cim500": (
        "00C8? 0000, 0064= 0001, 00C8? 0100, 0065= 0001, 0065? 0001, 0066= 0000, 0066? 0000, "
        "0067= 1388, 0064= 0003, 00C8? 0340",
        "0064= 0001, 0067= 0000, 00C8? 0100",
        "0064= 0001, 0064= 0005, 0064= 0001, 00C8? 0100",
    ),
    # Schneider ATV630: 3201 ETA (0x0C81), 8501 CMD (0x2135), 8602 LFRD in rpm (0x219A), 9604 NSP
    # (0x2584; here 1450 = 0x05AA). State chart of BBV51701, p. 10: 6 shutdown, 7 switch on, F
    # enable; ETA under 0x006F: 0x40, 0x21, 0x23, 0x27. Half of 1450 rpm: 725 = 0x02D5. Stop is 7,
    # disable operation: out of 'operation enabled' a shutdown (6) would coast. A rising bit 7
    # acknowledges (p. 12).
    "schneider_atv630": (
        "0C81? 0250, 2135= 0006, 0C81? 0231, 2135= 0007, 0C81? 0233, 2584? 05AA, 219A= 02D5, "
        "2135= 000F, 0C81? 0637",
        "2135= 0007, 219A= 0000, 0C81? 0250",
        "2135= 0000, 2135= 0080, 0C81? 0250, 2135= 0000",
    ),
}
ABB_START, *_ = DIALOGUES["abb_acs880"]


@pytest.mark.parametrize("name", DIALOGUES)
def test_start_stop_and_reset(name: str) -> None:
    start, stop, reset = DIALOGUES[name]
    follow(name, start, run)
    follow(name, stop, Drive.stop)
    follow(name, f"{stop}, {reset}", Drive.reset)


def test_a_running_drive_gets_only_the_new_speed_and_the_control_word() -> None:
    """In operation there is nothing to wait for."""
    follow("abb_acs880", ABB_START + ", 0003? 1337, 0001= 4E20, 0000= 047F",
           lambda drive: [drive.run(speed) for speed in (0.5, 1.0)])


def test_giving_up_in_the_middle_of_a_start() -> None:
    """Off is asked for while the drive does not get ready: no wait, no speed, no run."""
    def go(drive: Drive) -> None:
        answers = iter([True, False])
        drive.may_run = lambda: next(answers)
        drive.run(0.5)

    follow("abb_acs880", "0003? 1270, 0000= 047E, 0003? 1270", go)


# --- what a drive reports -------------------------------------------------------------------------

READS = [
    # In operation, at 7500 of 20000.
    ("abb_acs880", "0003? 1337, 0004? 1D4C", DriveStatus(True, True, "", 0.375)),
    # Bits 3 and 7; 04.01 is 0x6681.
    ("abb_acs880", "0003? 10B8, 0190? 6681, 0004? 0000", DriveStatus(
        False, False, "EFB communication loss (code 26241, 0x6681)", 0.0, remote=False)),
    # 20000 is 100 % (FENA-11 p. 92): -400 is -2 %, noise of a stopped pump; -8000 is -40 %.
    ("abb_acs880", "0003? 1231, 0004? FE70", DriveStatus(True, False, "", 0.0)),
    ("abb_acs880", "0003? 1231, 0004? E0C0", DriveStatus(
        True, False, "the pump is turning backwards (speed -40.0%)", -0.4)),
    # A trip. The alarm word 16-90 bit by bit, high word first; there is another fault besides the
    # timeout. The speed is -1 of 16384.
    ("danfoss_fc202", "C417? 060B, 4203? 4000 0010, C421? FFFF", DriveStatus(
        False, False, "control word timeout (bit 4), safe stop (bit 30)", 0.0)),
    # 45.0 Hz of 50.0 Hz; 12.3 m3/h are 12.3 / 3600 m3/s.
    ("grundfos_cim500", "00C8? 0340, 0130? 01C2, 00D3? 01F4, 012D? 007B",
     DriveStatus(True, True, "", 0.9, 12.3 / 3600)),
]


@pytest.mark.parametrize(("name", "dialogue", "expected"), READS)
def test_what_it_reports(name: str, dialogue: str, expected: DriveStatus) -> None:
    assert asdict(follow(name, dialogue, Drive.read)) == pytest.approx(asdict(expected))


def test_the_timeout_of_the_port_in_use_has_passed() -> None:
    """By ABB's code, and by Danfoss's bit 4 if no other bit is set."""
    (abb, code, _), (danfoss, bits, _) = READS[1], READS[4]
    for name, dialogue in ((abb, code), (danfoss, bits.replace("4000 0010", "0000 0010"))):
        assert follow(name, dialogue, Drive.read, gateway=True).timed_out


@pytest.mark.parametrize(("name", "dialogue", "expected"), [
    # 58.16 = 3.0 s, 58.14 = 1, fault, 58.15 = 2, a write of control word or reference (p. 435).
    ("abb_acs880", "16B7? 001E, 16B5? 0001, 16B6? 0002", 3.0),
    # 58.15 = 1, any message: another client that only reads would keep it running.
    ("abb_acs880", "16B7? 001E, 16B5? 0001, 16B6? 0001", None),
    # 8-03 = 5 s; 8-04 = [2] stop: the next valid control word starts it again. [5] stop and trip.
    ("danfoss_fc202", "1F5D? 0000 0032, 1F67? 0002", None),
    ("danfoss_fc202", "1F5D? 0000 0032, 1F67? 0005", 5.0),
    # 00012 switches it on, for an Ethernet module too.
    ("grundfos_cim500", "000B? 0000", None),
    ("grundfos_cim500 tcp", "000B? 0001", 5.0),
    # TTO 10.0 s, SLL 1 freewheel stop: factory settings. EAV64332, sheet Parameters: the embedded
    # Ethernet port has TTOB 64415 (0xFB9F) and ETHL 7021 (0x1B6D; 5: the speed is kept) instead.
    ("schneider_atv630", "1775? 0064, 1B62? 0001", 10.0),
    ("schneider_atv630 tcp", "FB9F? 0028, 1B6D? 0005", None),
    ("abb_acs880 tcp", "", None),  # the file describes none of this port
])
def test_own_timeout(name: str, dialogue: str, expected: float | None) -> None:
    """Behind a gateway the serial port's timeout is read, otherwise the Ethernet port's."""
    name, _, port = name.partition(" ")
    seconds, note = follow(name, dialogue, Drive.timeout, gateway=port != "tcp")
    assert seconds == (None if expected is None else pytest.approx(expected))
    assert bool(note) == (expected is None)


@pytest.mark.parametrize(("name", "dialogue", "task", "kind", "message"), [
    ("abb_acs880", "0003? 1238, 0190? 6681", run, "drive", "fault: EFB communication loss"),
    # A refused step does not keep the next one from being written.
    ("abb_acs880", "0000= 047E ! 06, 0001= 0000", Drive.stop, "answer",
     "writing 0x047E to register 0: rejected with exception 6$"),
    # 2 is an illegal data address (Modbus Application Protocol V1.1b3, section 7).
    ("abb_acs880", "0003? 0000 ! 02", Drive.read, "answer",
     "register 3: rejected with exception 2: the device answers, but has no such register; check"),
    ("abb_acs880", "0003? 1337, 0004? 7FFF", Drive.read, "answer",
     r"register 400005\) is 32767: 1.63835; plau"),
    # With a rated speed of 1 rpm, any speed would be the minimum. RFRD is 750.
    ("schneider_atv630", "0C81? 0627, 219C? 02EE, 2584? 0001", Drive.read, "answer",
     "NSP.*is 1: .*plausible values are 300 to 7200"),
    # 600 % of 7000 rpm is 42000, as signed 16 bits -23536: full speed backwards.
    ("schneider_atv630", DIALOGUES["schneider_atv630"][0].replace("05AA", "1B58").partition(
        ", 219A")[0], lambda drive: drive.run(6.0), "drive", r"42000, a speed of 600\.0%, is too"),
])
def test_what_cannot_be_done_or_believed(
    name: str, dialogue: str, task: Task, kind: str, message: str
) -> None:
    with pytest.raises(DriveError, match=message) as raised:
        follow(name, dialogue, task)
    assert raised.value.kind == kind


def test_a_state_that_is_not_reached_is_named() -> None:
    """Inhibited, and bit 9 is 0."""
    with closing(Wire(Registers({0: 0, 3: 0x1070}))) as wire, pytest.raises(
        DriveError, match="0x047E had no effect within 2 s; status is 0x1070"
    ):
        talk("abb_acs880", wire.at, run)


# --- wrong answers --------------------------------------------------------------------------------

def test_a_connection_without_an_answer_is_reset() -> None:
    """So that a drive with only one socket has it free at once (RFC 9293, 3.10.7.4)."""
    with closing(Wire(lambda _request: [])) as wire:
        with pytest.raises(DriveError) as raised:
            talk("abb_acs880", wire.at, Drive.read)
        assert raised.value.kind == "connection" and len(wire.requests) == 1
        until(lambda: wire.resets == 1)


def confirm_another_word(request: bytes) -> Answer:
    """Answer like a good drive, but with the next word."""
    ((_, answer),) = acs880()(request) or []
    return [(0, answer[:-1] + bytes([answer[-1] + 1]))]


@pytest.mark.parametrize("answer", [
    confirm_another_word,
    lambda _request: None,  # closed
    lambda request: [(0, request)],  # a gateway that echoes, or another service
])
def test_a_stop_is_not_taken_for_done(answer: Any) -> None:
    """The echoes of a serial line are in the fault campaign."""
    with closing(Wire(answer)) as wire:
        with pytest.raises(DriveError):
            talk("abb_acs880", wire.at, Drive.stop)
        assert frame("01 06 0000 047E") in wire.requests[0]
