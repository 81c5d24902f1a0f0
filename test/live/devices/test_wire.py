"""The driver's bytes against requests written out by hand from the makers' manuals.

A line of a dialogue: a word, function 03 (address, count) or 06 (address, word), the answer (if
missing, the request repeated, as after a write), a remark. `modbus_wire.script` adds the Modbus TCP
header. The manual's number of each register and the meaning of each word stand next to them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from modbus_wire import (
    Answer,
    Registers,
    SerialWire,
    Wire,
    acs880,
    crc,
    frame,
    rtu_server,
    script,
)
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


def against(answer: Callable[[bytes], Answer], task: Task, timeout_s: float = 0.3) -> Any:
    """Call a function with an ABB drive that gives these answers."""
    with closing(Wire(answer)) as wire:
        return talk("abb_acs880", wire.at, task, timeout_s)


def run(drive: Drive) -> None:
    drive.run(0.5)


# The start from any state to half of rated speed; the stop; and, after it, the reset of a fault.
DIALOGUES = {
    # ABB ACS880: 400004 status, 400001 control, 400002 reference. State diagram, p. 620: CW x110
    # leads to READY TO SWITCH ON (SW bit 0), x111 and 1111 with bits 4 to 6 set to OPERATION; bit
    # 10 must be set. 20000 is 100 % (FENA-11 p. 92): 10000 = 0x2710. A rising bit 7 acknowledges
    # (p. 437).
    "abb_acs880": ("""
fault?        : 03 0003 0001 -> 03 02 1337 : no; it runs, in which mode is unknown
OFF1          : 06 0000 047E
ready?        : 03 0003 0001 -> 03 02 1270 : not yet
ready?        : 03 0003 0001 -> 03 02 1231 : to switch on
50 %          : 06 0001 2710
run           : 06 0000 047F
operation?    : 03 0003 0001 -> 03 02 1237""", """
OFF1          : 06 0000 047E
no speed      : 06 0001 0000
confirmed?    : 03 0003 0001 -> 03 02 1231""", """
reset         : 06 0000 04FE
OFF1          : 06 0000 047E
fault?        : 03 0003 0001 -> 03 02 1231 : bit 3 is 0"""),
    # Danfoss FC 202: 50200 status (sent as 50199 = 0xC417), 50000 control (0xC34F), 50010 reference
    # (0xC359). FC profile, MG.33.B6.22 p. 277: bits 2 to 5 ramp, no coast, no quick stop, no
    # freeze; 6 start; 7 acknowledges when it rises; 10 data valid. 0x4000 is 100 %: 0x2000.
    "danfoss_fc202": ("""
fault?        : 03 C417 0001 -> 03 02 0603 : no; coasting
stop, valid   : 06 C34F 043C
enabled?      : 03 C417 0001 -> 03 02 0607 : bits 0 1 2 9
50 %          : 06 C359 2000
start         : 06 C34F 047C
in operation? : 03 C417 0001 -> 03 02 0E07 : bit 11""", """
ramp stop     : 06 C34F 043C
no speed      : 06 C359 0000
confirmed?    : 03 C417 0001 -> 03 02 0607""", """
reset         : 06 C34F 04BC
stop          : 06 C34F 043C
trip?         : 03 C417 0001 -> 03 02 0607 : bit 3 is 0"""),
    # Grundfos CIM 500: 00201 status (sent as 200 = 0x00C8), 00101 control bits, 00102 control mode,
    # 00103 operating mode, 00104 set-point in 0.01 %: 5000 = 0x1388. Manual p. 18 to 21: 00101 bit
    # 0 remote, bit 1 on, bit 2 acknowledges when it rises; 00201 bit 8 remote, bit 9 on.
    "grundfos_cim500": ("""
fault?        : 03 00C8 0001 -> 03 02 0000 : no; local
remote, off   : 06 0064 0001
remote?       : 03 00C8 0001 -> 03 02 0100
frequency     : 06 0065 0001
taken?        : 03 0065 0001 -> 03 02 0001
normal        : 06 0066 0000
taken?        : 03 0066 0001 -> 03 02 0000
50 %          : 06 0067 1388
remote, on    : 06 0064 0003
on?           : 03 00C8 0001 -> 03 02 0340""", """
remote, off   : 06 0064 0001
no speed      : 06 0067 0000
confirmed?    : 03 00C8 0001 -> 03 02 0100""", """
lowered       : 06 0064 0001
reset         : 06 0064 0005
remote, off   : 06 0064 0001
fault?        : 03 00C8 0001 -> 03 02 0100 : bit 10 is 0"""),
    # Schneider ATV630: 3201 ETA (0x0C81), 8501 CMD (0x2135), 8602 LFRD in rpm (0x219A), 9604 NSP
    # (0x2584; here 1450 = 0x05AA). State chart of BBV51701, p. 10: 6 shutdown, 7 switch on, F
    # enable; ETA under 0x006F: 0x40, 0x21, 0x23, 0x27. Half of 1450 rpm: 725 = 0x02D5. Stop is 7,
    # disable operation: out of 'operation enabled' a shutdown (6) would coast. A rising bit 7
    # acknowledges (p. 12).
    "schneider_atv630": ("""
fault?        : 03 0C81 0001 -> 03 02 0250 : no; disabled
shutdown      : 06 2135 0006
              : 03 0C81 0001 -> 03 02 0231 : to switch on
switch on     : 06 2135 0007
              : 03 0C81 0001 -> 03 02 0233 : switched on
rated speed?  : 03 2584 0001 -> 03 02 05AA : 1450 rpm
50 %          : 06 219A 02D5
enable        : 06 2135 000F
              : 03 0C81 0001 -> 03 02 0637 : enabled""", """
disable       : 06 2135 0007
no speed      : 06 219A 0000
confirmed?    : 03 0C81 0001 -> 03 02 0250""", """
lowered       : 06 2135 0000
reset         : 06 2135 0080
fault?        : 03 0C81 0001 -> 03 02 0250 : bit 3 is 0
lowered       : 06 2135 0000"""),
}
ABB_START, ABB_STOP, _ = DIALOGUES["abb_acs880"]


@pytest.mark.parametrize("name", DIALOGUES)
def test_start_stop_and_reset(name: str) -> None:
    start, stop, reset = DIALOGUES[name]
    follow(name, start, run)
    follow(name, stop, Drive.stop)
    follow(name, stop + reset, Drive.reset)


def test_a_running_drive_gets_only_the_new_speed_and_the_control_word() -> None:
    follow("abb_acs880", ABB_START + """
fault?        : 03 0003 0001 -> 03 02 1337 : operation: nothing to wait for
100 %         : 06 0001 4E20
run           : 06 0000 047F
""", lambda drive: [drive.run(speed) for speed in (0.5, 1.0)])


def test_another_ones_run_is_noticed() -> None:
    """Noticed when the control word that is read back is not the one written, but *run*.

    Some drives do not return it, so it counts once it was returned as written.
    """
    read_back = "".join(f"\n: 03 0000 0001 -> 03 02 {word}" for word in ("047F", "047E", "047F"))
    _, *before, found = follow(
        "abb_acs880", ABB_STOP + read_back,
        lambda drive: [drive.stop(), *(drive.second_master() for _ in range(3))],
    )
    assert before == [None, None]
    assert "word is 0x047F, although 0x047E was" in found.sentence


# --- what a drive reports -------------------------------------------------------------------------

READS = [
    ("abb_acs880", """
400004        : 03 0003 0001 -> 03 02 1337 : operation
400005        : 03 0004 0001 -> 03 02 1D4C : 7500 of 20000
""", DriveStatus(True, True, "", 0.375)),
    ("abb_acs880", """
400004        : 03 0003 0001 -> 03 02 10B8 : bits 3 and 7
04.01         : 03 0190 0001 -> 03 02 6681 : 0x6681
400005        : 03 0004 0001 -> 03 02 0000
""", DriveStatus(False, False, "EFB communication loss (code 26241, 0x6681)", 0.0, remote=False)),
    # 20000 is 100 % (FENA-11 p. 92): -400 is -2 %, noise of a stopped pump; -8000 is -40 %.
    ("abb_acs880", """
400004        : 03 0003 0001 -> 03 02 1231
400005        : 03 0004 0001 -> 03 02 FE70 : -400
""", DriveStatus(True, False, "", 0.0)),
    ("abb_acs880", """
400004        : 03 0003 0001 -> 03 02 1231
400005        : 03 0004 0001 -> 03 02 E0C0 : -8000
""", DriveStatus(True, False, "the pump is turning backwards (speed -40.0%)", -0.4)),
    # The alarm word bit by bit, high word first; there is another fault besides the timeout.
    ("danfoss_fc202", """
50200         : 03 C417 0001 -> 03 02 060B : trip
16-90         : 03 4203 0002 -> 03 04 4000 0010 : bits 4 and 30
50210         : 03 C421 0001 -> 03 02 FFFF : -1 of 16384
""", DriveStatus(False, False, "control word timeout (bit 4), safe stop (bit 30)", 0.0)),
    # 45.0 Hz of 50.0 Hz; 12.3 m3/h are 12.3 / 3600 m3/s.
    ("grundfos_cim500", """
00201         : 03 00C8 0001 -> 03 02 0340 : bits 6 8 9
00305         : 03 0130 0001 -> 03 02 01C2 : 450
00212         : 03 00D3 0001 -> 03 02 01F4 : 500
00302         : 03 012D 0001 -> 03 02 007B : 123
""", DriveStatus(True, True, "", 0.9, 12.3 / 3600)),
]


@pytest.mark.parametrize(("name", "dialogue", "expected"), READS)
def test_what_it_reports(name: str, dialogue: str, expected: DriveStatus) -> None:
    assert asdict(follow(name, dialogue, Drive.read)) == pytest.approx(asdict(expected))


def test_the_timeout_of_the_port_in_use_has_passed() -> None:
    """By ABB's code, and by Danfoss's bit 4 if no other bit is set."""
    (abb, code, _), (danfoss, bits, _) = READS[1], READS[4]
    for name, dialogue in ((abb, code), (danfoss, bits.replace("4000 0010", "0000 0010"))):
        assert follow(name, dialogue, Drive.read, gateway=True).timed_out


# --- the drive's own timeout ----------------------------------------------------------------------

ABB_3_S = "58.16 : 03 16B7 0001 -> 03 02 001E"
DANFOSS_5_S = "8-03 : 03 1F5D 0002 -> 03 04 0000 0032 : 50"
TIMEOUTS = [
    # 58.16 = 3.0 s, 58.14 = 1, fault, 58.15 = 2, a write of control word or reference (p. 435).
    ("abb_acs880", 3.0, ABB_3_S, "58.14 : 03 16B5 0001 -> 03 02 0001",
     "58.15 : 03 16B6 0001 -> 03 02 0002"),
    # 58.15 = 1, any message: another client that only reads would keep it running.
    ("abb_acs880", None, ABB_3_S, "58.14 : 03 16B5 0001 -> 03 02 0001",
     "58.15 : 03 16B6 0001 -> 03 02 0001"),
    # 8-04 = [2] stop: the next valid control word starts it again. [5] is stop and trip.
    ("danfoss_fc202", None, DANFOSS_5_S, "8-04 : 03 1F67 0001 -> 03 02 0002 : [2]"),
    ("danfoss_fc202", 5.0, DANFOSS_5_S, "8-04 : 03 1F67 0001 -> 03 02 0005 : [5]"),
    ("grundfos_cim500", None, "00012 : 03 000B 0001 -> 03 02 0000 : off"),
    # TTO 10.0 s, SLL 1 freewheel stop: factory settings.
    ("schneider_atv630", 10.0, "TTO : 03 1775 0001 -> 03 02 0064",
     "SLL : 03 1B62 0001 -> 03 02 0001"),
    # EAV64332, sheet Parameters: the embedded Ethernet port has TTOB 64415 (0xFB9F) and ETHL 7021
    # (0x1B6D), the serial port TTO and SLL. The CIM 500 is an Ethernet module.
    ("schneider_atv630 tcp", None, "TTOB : 03 FB9F 0001 -> 03 02 0028",
     "ETHL : 03 1B6D 0001 -> 03 02 0005 : speed kept"),
    ("grundfos_cim500 tcp", 5.0, "00012 : 03 000B 0001 -> 03 02 0001 : on"),
    ("abb_acs880 tcp", None),  # the file describes none of this port
]


@pytest.mark.parametrize(("interface", "expected", "dialogue"), [
    (interface, expected, "\n".join(lines)) for interface, expected, *lines in TIMEOUTS
])
def test_own_timeout(interface: str, expected: float | None, dialogue: str) -> None:
    """Behind a gateway the serial port's timeout is read, otherwise the Ethernet port's."""
    name, _, port = interface.partition(" ")
    seconds, note = follow(name, dialogue, Drive.timeout, gateway=port != "tcp")
    assert seconds == (None if expected is None else pytest.approx(expected))
    assert bool(note) == (expected is None)


# --- wrong answers --------------------------------------------------------------------------------

def first(*answers: tuple[float, bytes]) -> Callable[[bytes], Answer]:
    """Answer the first request in this way, and every other one like a good drive."""
    remaining = iter([list(answers)])

    def answer(request: bytes) -> Answer:
        value = b"\x13\x37" if request[8:10] == b"\0\3" else b"\x1d\x4c"
        return next(remaining, [(0.0, request[:4] + frame("0005 01 03 02") + value)])

    return answer


@pytest.mark.parametrize(
    ("answers", "kind", "message"),
    [
        ([(0, frame("0001 0000 0003 01 83 02"))], "answer", "rejected with exception 2"),
        ([(0, frame("0009 0000 0005 01 03 02 1337"))], "connection", "no valid response"),
        ([(0, frame("0001 0000 0005 07 03 02 1337"))], "connection", "no valid response"),
        ([(0, frame("0001 0000 0005 01 04 02 1337"))], "answer", "the response "),
        ([(0, frame("0001 0000 0007 01 03 04 1337 0000"))], "answer", "the response "),
        ([(0, bytes(range(255, 0, -1)) * 4)], "connection", ""),
        ([], "connection", "no valid response within 0.3 s"),
    ],
)
def test_wrong_answers_have_a_name_and_a_time(
    answers: list[tuple[float, bytes]], kind: str, message: str
) -> None:
    """No request is repeated. A connection without an answer is reset (RFC 9293, 3.10.7.4), so that
    a drive with only one socket has it free at once.
    """
    with closing(Wire(first(*answers))) as wire:
        with pytest.raises(DriveError) as raised:
            talk("abb_acs880", wire.at, Drive.read)
        assert raised.value.kind == kind and message in str(raised.value)
        assert f":{wire.port}, device 1: reading register 3" in str(raised.value)
        assert len(wire.requests) == 1
        if not answers:
            until(lambda: wire.resets == 1, 5)


def test_a_late_answer_is_not_taken_for_the_next() -> None:
    """The server is still busy with the first request; it answers both, one after the other."""
    def go(drive: Drive) -> DriveStatus:
        with pytest.raises(DriveError, match="no valid response"):
            drive.read()
        return drive.read()

    late = first((0.5, frame("0001 0000 0005 01 03 02 0008")))
    status = against(late, go, timeout_s=0.4)
    assert status.running and not status.fault


def confirm_another_word(request: bytes) -> Answer:
    """Answer like a good drive, but with the next word."""
    ((_, answer),) = acs880()(request) or []
    return [(0, answer[:-1] + bytes([answer[-1] + 1]))]


@pytest.mark.parametrize("answer", [
    confirm_another_word,
    lambda _request: None,  # closed
    lambda request: [(0, request)],  # a gateway whose serial side echoes, or another service
])
def test_a_stop_is_not_taken_for_done(answer: Callable[[bytes], Answer]) -> None:
    with pytest.raises(DriveError):
        against(answer, Drive.stop)


def test_an_echo_is_no_value() -> None:
    """As an answer, the echo of this request would have two bytes of data."""
    with pytest.raises(DriveError, match="does not fit"):
        against(lambda request: [(0, request)], lambda drive: drive.line.read(0x02BE, 1))


@pytest.mark.parametrize("answer", [
    lambda request: request,
    lambda request: [request[:5], request[5:]],
    lambda request: [request, request],
    lambda request: request + rtu_server(acs880())(request),
    lambda request: request[:6] + b"\0\0",
], ids=["echo", "echo in halves", "echo twice", "echo before the answer", "wrong check"])
def test_a_stop_on_a_serial_line_is_not_taken_for_done(
    answer: Callable[[bytes], bytes | list[bytes]]
) -> None:
    """Echoes are of an RS-485 adapter, in most cases without a drive behind it."""
    with closing(SerialWire(answer)) as wire:
        with pytest.raises(DriveError):
            talk("abb_acs880", wire.line, Drive.stop)
        assert wire.requests[0][:6] == frame("01 06 0000 047E")


def test_start_on_a_serial_line() -> None:
    """The same words as over TCP, between slave address and CRC."""
    requests, answer = script(ABB_START)

    def over_line(_request: bytes) -> bytes:
        (_, data), = answer(b"") or []
        return data[6:] + crc(data[6:])

    with closing(SerialWire(over_line)) as wire:
        talk("abb_acs880", wire.line, run)
        assert wire.requests == [request[6:] + crc(request[6:]) for request in requests]


REFUSED: list[tuple[str, str, Task, str, str]] = [
    ("abb_acs880", """
400004        : 03 0003 0001 -> 03 02 1238 : tripped
04.01         : 03 0190 0001 -> 03 02 6681
""", run, "drive", "fault: EFB communication loss"),
    # A refused step does not keep the next one from being written.
    ("abb_acs880", """
OFF1          : 06 0000 047E -> 86 06 : busy
no speed      : 06 0001 0000
""", Drive.stop, "answer", "writing 0x047E to register 0: rejected with exc"),
    ("abb_acs880", """
400004        : 03 0003 0001 -> 03 02 1337
400005        : 03 0004 0001 -> 03 02 7FFF
""", Drive.read, "answer", r"register 400005\) is 32767: 1.63835; plau"),
    # With a rated speed of 1 rpm, any speed would be the minimum.
    ("schneider_atv630", """
ETA           : 03 0C81 0001 -> 03 02 0627 : enabled
RFRD          : 03 219C 0001 -> 03 02 02EE : 750
NSP           : 03 2584 0001 -> 03 02 0001
""", Drive.read, "answer", "NSP.*is 1: .*plausible values are 300 to 7200"),
]


@pytest.mark.parametrize(("name", "dialogue", "task", "kind", "message"), REFUSED)
def test_what_cannot_be_done_or_believed(
    name: str, dialogue: str, task: Task, kind: str, message: str
) -> None:
    with pytest.raises(DriveError, match=message) as raised:
        follow(name, dialogue, task)
    assert raised.value.kind == kind


def test_a_word_that_the_register_cannot_hold_is_not_written(tmp_path: Path) -> None:
    """90 % of 40000 rpm is 36000, as signed 16 bits -29536: full speed backwards."""
    file, dialogue = tmp_path / "fast.yaml", DIALOGUES["schneider_atv630"][0].partition("50 %")[0]
    text = find_drive_file("schneider_atv630").read_text()
    file.write_text(text.replace("high: 7200", "high: 60000"))
    with pytest.raises(DriveError, match=r"36000, a speed of 90\.0%, is too large for LFRD"):
        follow(str(file), dialogue.replace("05AA", "9C40"), lambda drive: drive.run(0.9))


def test_a_state_that_is_not_reached_is_named() -> None:
    """Inhibited, and bit 9 is 0."""
    with pytest.raises(DriveError, match="0x047E had no effect within 2 s; status is 0x1070"):
        against(Registers({0: 0, 3: 0x1070}), run)


def test_giving_up_in_the_middle_of_a_start() -> None:
    """Off is asked for while the drive does not get ready: no wait, no speed, no run."""
    def go(drive: Drive) -> None:
        answers = iter([True, False])
        drive.may_run = lambda: next(answers)
        drive.run(0.5)

    follow("abb_acs880", """
              : 03 0003 0001 -> 03 02 1270
              : 06 0000 047E
              : 03 0003 0001 -> 03 02 1270 : not ready
""", go)
