"""The driver's bytes against frames written out by hand from the makers' manuals.

Modbus TCP: transaction (2 bytes, 1, 2, ... in each connection), protocol 0000, length, unit, then
function 03 (address, count) or 06 (address, word); Modbus Messaging on TCP/IP V1.0b, section 3.1.
The manual's number of each register and what each word means stand beside the frames.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from modbus_wire import Answer, SerialWire, Wire, crc, frame, script

from greenroof_ros.drives.address import parse_drive_address
from greenroof_ros.drives.drive import Drive
from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file
from greenroof_ros.drives.modbus_line import DriveError

Task = Callable[[Drive], Any]


def talk(name: str, wire: str, task: Task, **options: Any) -> Any:
    """Do something with a drive behind an address."""

    drive = Drive(
        read_drive_file(find_drive_file(name)), parse_drive_address(wire, "at"),
        **{"timeout_s": 0.3, **options},
    )
    drive.connect()
    try:
        return task(drive)
    finally:
        drive.close()


def follow(name: str, dialogue: str, task: Task, *, gateway: bool = False) -> Any:
    """Do something; every request must be that of the dialogue, byte for byte."""
    requests, answer = script(dialogue)
    wire = Wire(answer)
    try:
        result = talk(name, wire.gateway if gateway else wire.at, task)
    finally:
        wire.close()
    assert wire.frames == [each.hex() for each in requests]
    return result


# --- start: from any state to half of rated speed -------------------------------------------------

# ABB ACS880: 400004 status, 400001 control, 400002 reference. State diagram, p. 620: CW x110 leads
# to READY TO SWITCH ON (SW bit 0), x111 and 1111 with bits 4 to 6 set to OPERATION; bit 10 must be
# set. 20000 is 100 % (FENA-11 p. 92): 10000 = 0x2710.
ABB_START = """
fault?        : 0001 0000 0006 01 03 0003 0001
no; inhibited : 0001 0000 0005 01 03 02 1270
OFF1          : 0002 0000 0006 01 06 0000 047E
              : 0002 0000 0006 01 06 0000 047E
ready?        : 0003 0000 0006 01 03 0003 0001
not yet       : 0003 0000 0005 01 03 02 1270
ready?        : 0004 0000 0006 01 03 0003 0001
to switch on  : 0004 0000 0005 01 03 02 1231
50 %          : 0005 0000 0006 01 06 0001 2710
              : 0005 0000 0006 01 06 0001 2710
run           : 0006 0000 0006 01 06 0000 047F
              : 0006 0000 0006 01 06 0000 047F
operation?    : 0007 0000 0006 01 03 0003 0001
              : 0007 0000 0005 01 03 02 1237
"""

# Danfoss FC 202: 50200 status (sent as 50199 = 0xC417), 50000 control (0xC34F), 50010 reference
# (0xC359). FC profile, MG.33.B6.22 p. 277: bits 2 to 5 ramp, no coast, no quick stop, no freeze; 6
# start; 10 data valid. 0x4000 is 100 %: 0x2000.
DANFOSS_START = """
fault?        : 0001 0000 0006 01 03 C417 0001
no; coasting  : 0001 0000 0005 01 03 02 0603
stop, valid   : 0002 0000 0006 01 06 C34F 043C
              : 0002 0000 0006 01 06 C34F 043C
enabled?      : 0003 0000 0006 01 03 C417 0001
bits 0 1 2 9  : 0003 0000 0005 01 03 02 0607
50 %          : 0004 0000 0006 01 06 C359 2000
              : 0004 0000 0006 01 06 C359 2000
start         : 0005 0000 0006 01 06 C34F 047C
              : 0005 0000 0006 01 06 C34F 047C
in operation? : 0006 0000 0006 01 03 C417 0001
bit 11        : 0006 0000 0005 01 03 02 0E07
"""

# Grundfos CIM 500: 00201 status (sent as 200 = 0x00C8), 00101 control bits, 00102 control mode,
# 00103 operating mode, 00104 set-point in 0.01 %: 5000 = 0x1388. Manual p. 18 to 21: 00101 bit 0
# remote, bit 1 on; 00201 bit 8 remote, bit 9 on.
GRUNDFOS_START = """
fault?        : 0001 0000 0006 01 03 00C8 0001
no; local     : 0001 0000 0005 01 03 02 0000
remote, off   : 0002 0000 0006 01 06 0064 0001
              : 0002 0000 0006 01 06 0064 0001
remote?       : 0003 0000 0006 01 03 00C8 0001
              : 0003 0000 0005 01 03 02 0100
frequency     : 0004 0000 0006 01 06 0065 0001
              : 0004 0000 0006 01 06 0065 0001
taken?        : 0005 0000 0006 01 03 0065 0001
              : 0005 0000 0005 01 03 02 0001
normal        : 0006 0000 0006 01 06 0066 0000
              : 0006 0000 0006 01 06 0066 0000
taken?        : 0007 0000 0006 01 03 0066 0001
              : 0007 0000 0005 01 03 02 0000
50 %          : 0008 0000 0006 01 06 0067 1388
              : 0008 0000 0006 01 06 0067 1388
remote, on    : 0009 0000 0006 01 06 0064 0003
              : 0009 0000 0006 01 06 0064 0003
on?           : 000A 0000 0006 01 03 00C8 0001
              : 000A 0000 0005 01 03 02 0340
"""

# Schneider ATV630: 3201 ETA (0x0C81), 8501 CMD (0x2135), 8602 LFRD in rpm (0x219A), 9604 NSP
# (0x2584; here 1450 = 0x05AA). State chart of BBV51701, p. 10: 6 shutdown, 7 switch on, F enable;
# ETA under 0x006F: 0x40, 0x21, 0x23, 0x27. Half of 1450 rpm: 725 = 0x02D5.
SCHNEIDER_START = """
fault?        : 0001 0000 0006 01 03 0C81 0001
no; disabled  : 0001 0000 0005 01 03 02 0250
shutdown      : 0002 0000 0006 01 06 2135 0006
              : 0002 0000 0006 01 06 2135 0006
              : 0003 0000 0006 01 03 0C81 0001
to switch on  : 0003 0000 0005 01 03 02 0231
switch on     : 0004 0000 0006 01 06 2135 0007
              : 0004 0000 0006 01 06 2135 0007
              : 0005 0000 0006 01 03 0C81 0001
switched on   : 0005 0000 0005 01 03 02 0233
rated speed?  : 0006 0000 0006 01 03 2584 0001
1450 rpm      : 0006 0000 0005 01 03 02 05AA
50 %          : 0007 0000 0006 01 06 219A 02D5
              : 0007 0000 0006 01 06 219A 02D5
enable        : 0008 0000 0006 01 06 2135 000F
              : 0008 0000 0006 01 06 2135 000F
              : 0009 0000 0006 01 03 0C81 0001
enabled       : 0009 0000 0005 01 03 02 0637
"""


@pytest.mark.parametrize(
    ("name", "dialogue"),
    [
        ("abb_acs880", ABB_START), ("danfoss_fc202", DANFOSS_START),
        ("grundfos_cim500", GRUNDFOS_START), ("schneider_atv630", SCHNEIDER_START),
    ],
)
def test_start(name: str, dialogue: str) -> None:
    follow(name, dialogue, lambda drive: drive.run(0.5))


def test_a_running_drive_gets_only_the_new_speed_and_the_control_word() -> None:
    def twice(drive: Drive) -> None:
        drive.run(0.5)
        drive.run(1.0)

    follow("abb_acs880", ABB_START.rstrip() + """
fault?        : 0008 0000 0006 01 03 0003 0001
operation     : 0008 0000 0005 01 03 02 1337
100 %         : 0009 0000 0006 01 06 0001 4E20
              : 0009 0000 0006 01 06 0001 4E20
run           : 000A 0000 0006 01 06 0000 047F
              : 000A 0000 0006 01 06 0000 047F
""", twice)


def test_a_drive_that_already_runs_is_first_brought_off() -> None:
    """What somebody else had it do, in which mode, is not known on a new connection."""
    follow("abb_acs880", ABB_START.replace("02 1270", "02 1337", 1), lambda drive: drive.run(0.5))


def test_a_drive_that_was_stopped_is_waited_for_when_it_runs_again() -> None:
    def again(drive: Drive) -> None:
        drive.run(0.5)
        drive.run(0.5)

    follow("abb_acs880", ABB_START.rstrip() + """
fault?        : 0008 0000 0006 01 03 0003 0001
ready, off    : 0008 0000 0005 01 03 02 1231
50 %          : 0009 0000 0006 01 06 0001 2710
              : 0009 0000 0006 01 06 0001 2710
run           : 000A 0000 0006 01 06 0000 047F
              : 000A 0000 0006 01 06 0000 047F
operation?    : 000B 0000 0006 01 03 0003 0001
              : 000B 0000 0005 01 03 02 1237
""", again)


# --- stop and reset -------------------------------------------------------------------------------

ABB_STOP = """
OFF1          : 0001 0000 0006 01 06 0000 047E
              : 0001 0000 0006 01 06 0000 047E
no speed      : 0002 0000 0006 01 06 0001 0000
              : 0002 0000 0006 01 06 0001 0000
"""
DANFOSS_STOP = """
ramp stop     : 0001 0000 0006 01 06 C34F 043C
              : 0001 0000 0006 01 06 C34F 043C
no speed      : 0002 0000 0006 01 06 C359 0000
              : 0002 0000 0006 01 06 C359 0000
"""
GRUNDFOS_STOP = """
remote, off   : 0001 0000 0006 01 06 0064 0001
              : 0001 0000 0006 01 06 0064 0001
no speed      : 0002 0000 0006 01 06 0067 0000
              : 0002 0000 0006 01 06 0067 0000
"""
# Disable operation: out of 'operation enabled' a shutdown (6) would coast (BBV51701 p. 10).
SCHNEIDER_STOP = """
disable       : 0001 0000 0006 01 06 2135 0007
              : 0001 0000 0006 01 06 2135 0007
rated speed?  : 0002 0000 0006 01 06 219A 0000
              : 0002 0000 0006 01 06 219A 0000
"""
STOPS = {
    "abb_acs880": ABB_STOP, "danfoss_fc202": DANFOSS_STOP, "grundfos_cim500": GRUNDFOS_STOP,
    "schneider_atv630": SCHNEIDER_STOP,
}
# After the stop. The bit that acknowledges is 7 (ABB p. 437, Danfoss p. 277, Schneider p. 12), or 2
# (Grundfos p. 20), and counts when it rises.
RESETS = {
    "abb_acs880": """
reset         : 0003 0000 0006 01 06 0000 04FE
              : 0003 0000 0006 01 06 0000 04FE
OFF1          : 0004 0000 0006 01 06 0000 047E
              : 0004 0000 0006 01 06 0000 047E
fault?        : 0005 0000 0006 01 03 0003 0001
bit 3 is 0    : 0005 0000 0005 01 03 02 1231
""",
    "danfoss_fc202": """
reset         : 0003 0000 0006 01 06 C34F 04BC
              : 0003 0000 0006 01 06 C34F 04BC
stop          : 0004 0000 0006 01 06 C34F 043C
              : 0004 0000 0006 01 06 C34F 043C
trip?         : 0005 0000 0006 01 03 C417 0001
bit 3 is 0    : 0005 0000 0005 01 03 02 0607
""",
    "grundfos_cim500": """
lowered       : 0003 0000 0006 01 06 0064 0001
              : 0003 0000 0006 01 06 0064 0001
reset         : 0004 0000 0006 01 06 0064 0005
              : 0004 0000 0006 01 06 0064 0005
remote, off   : 0005 0000 0006 01 06 0064 0001
              : 0005 0000 0006 01 06 0064 0001
fault?        : 0006 0000 0006 01 03 00C8 0001
bit 10 is 0   : 0006 0000 0005 01 03 02 0100
""",
    "schneider_atv630": """
lowered       : 0003 0000 0006 01 06 2135 0000
              : 0003 0000 0006 01 06 2135 0000
reset         : 0004 0000 0006 01 06 2135 0080
              : 0004 0000 0006 01 06 2135 0080
fault?        : 0005 0000 0006 01 03 0C81 0001
bit 3 is 0    : 0005 0000 0005 01 03 02 0250
lowered       : 0006 0000 0006 01 06 2135 0000
              : 0006 0000 0006 01 06 2135 0000
""",
}


@pytest.mark.parametrize("name", STOPS)
def test_stop(name: str) -> None:
    follow(name, STOPS[name], lambda drive: drive.stop())


def test_a_refused_step_of_the_stop_does_not_keep_the_next_from_being_written() -> None:
    with pytest.raises(DriveError, match="writing 0x047E to register 0: refused with exc") as got:
        follow("abb_acs880", """
OFF1          : 0001 0000 0006 01 06 0000 047E
busy          : 0001 0000 0003 01 86 06
no speed      : 0002 0000 0006 01 06 0001 0000
              : 0002 0000 0006 01 06 0001 0000
""", lambda drive: drive.stop())
    assert got.value.kind == "answer"


@pytest.mark.parametrize("name", RESETS)
def test_reset(name: str) -> None:
    follow(name, STOPS[name].rstrip() + RESETS[name], lambda drive: drive.reset())


# --- what it says ---------------------------------------------------------------------------------

def test_status_of_abb() -> None:
    status = follow("abb_acs880", """
400004        : 0001 0000 0006 01 03 0003 0001
operation     : 0001 0000 0005 01 03 02 1337
400005        : 0002 0000 0006 01 03 0004 0001
7500 of 20000 : 0002 0000 0005 01 03 02 1D4C
""", lambda drive: drive.read())
    assert (status.ready, status.running, status.remote) == (True,) * 3
    assert (status.fault, status.warning, status.flow) == ("", "", None)
    assert status.speed == pytest.approx(0.375)


def test_fault_and_warning_of_abb_have_their_texts() -> None:
    status = follow("abb_acs880", """
400004        : 0001 0000 0006 01 03 0003 0001
bits 3 and 7  : 0001 0000 0005 01 03 02 10B8
04.01         : 0002 0000 0006 01 03 0190 0001
0x6681        : 0002 0000 0005 01 03 02 6681
04.06         : 0003 0000 0006 01 03 0195 0001
0xA7CE        : 0003 0000 0005 01 03 02 A7CE
400005        : 0004 0000 0006 01 03 0004 0001
              : 0004 0000 0005 01 03 02 0000
""", lambda drive: drive.read(), gateway=True)
    assert status.fault == "EFB communication loss (code 26241, 0x6681)"
    assert status.warning == "EFB communication loss (code 42958, 0xA7CE)"
    assert not status.ready and not status.remote
    assert status.timed_out


def test_alarm_word_of_danfoss_is_read_bit_by_bit_high_word_first() -> None:
    status = follow("danfoss_fc202", """
50200         : 0001 0000 0006 01 03 C417 0001
trip          : 0001 0000 0005 01 03 02 060B
16-90         : 0002 0000 0006 01 03 4203 0002
bits 4 and 30 : 0002 0000 0007 01 03 04 4000 0010
50210         : 0003 0000 0006 01 03 C421 0001
-1 of 16384   : 0003 0000 0005 01 03 02 FFFF
""", lambda drive: drive.read())
    assert status.fault == "control word timeout, safe stop"
    assert not status.timed_out  # there is another fault besides
    assert status.speed == 0  # noise of a pump at rest
    assert status.stands


def test_flow_and_speed_of_grundfos() -> None:
    # 45.0 Hz of 50.0 Hz; 12.3 m3/h are 12.3 / 3600 m3/s.
    status = follow("grundfos_cim500", """
00201         : 0001 0000 0006 01 03 00C8 0001
bits 6 8 9    : 0001 0000 0005 01 03 02 0340
00305         : 0002 0000 0006 01 03 0130 0001
450           : 0002 0000 0005 01 03 02 01C2
00212         : 0003 0000 0006 01 03 00D3 0001
500           : 0003 0000 0005 01 03 02 01F4
00302         : 0004 0000 0006 01 03 012D 0001
123           : 0004 0000 0005 01 03 02 007B
""", lambda drive: drive.read())
    assert status.speed == pytest.approx(0.9)
    assert status.flow == pytest.approx(12.3 / 3600)
    assert status.running


def test_flow_that_is_not_available() -> None:
    # 0xFFFF: manual, section 9.8, "not available".
    status = follow("grundfos_cim500", """
00201         : 0001 0000 0006 01 03 00C8 0001
              : 0001 0000 0005 01 03 02 0300
00305         : 0002 0000 0006 01 03 0130 0001
              : 0002 0000 0005 01 03 02 0000
00212         : 0003 0000 0006 01 03 00D3 0001
              : 0003 0000 0005 01 03 02 01F4
00302         : 0004 0000 0006 01 03 012D 0001
              : 0004 0000 0005 01 03 02 FFFF
""", lambda drive: drive.read())
    assert status.flow is None


def test_fault_of_schneider() -> None:
    status = follow("schneider_atv630", """
3201          : 0001 0000 0006 01 03 0C81 0001
bit 3         : 0001 0000 0005 01 03 02 0018
7121          : 0002 0000 0006 01 03 1BD1 0001
126           : 0002 0000 0005 01 03 02 007E
8604          : 0003 0000 0006 01 03 219C 0001
              : 0003 0000 0005 01 03 02 0000
9604          : 0004 0000 0006 01 03 2584 0001
              : 0004 0000 0005 01 03 02 05AA
""", lambda drive: drive.read())
    assert status.fault == "dry run (code 126, 0x007E)"
    assert not status.timed_out


def test_nameplate_in_letters() -> None:
    # 15-40 FC type: 46 43 2D 32 30 32 are the letters of FC-202.
    text = follow("danfoss_fc202", """
15-40         : 0001 0000 0006 01 03 3C27 0003
FC-202        : 0001 0000 0009 01 03 06 4643 2D32 3032
""", lambda drive: drive.identify())
    assert text.startswith("Danfoss VLT AQUA Drive FC 202") and "FC type: FC-202" in text


# --- the drive's own timeout ----------------------------------------------------------------------

TIMEOUTS = [
    # 58.16 = 3.0 s, 58.14 = 1, fault, 58.15 = 2, a write of control word or reference (p. 435).
    ("abb_acs880", 3.0, """
58.16         : 0001 0000 0006 01 03 16B7 0001
              : 0001 0000 0005 01 03 02 001E
58.14         : 0002 0000 0006 01 03 16B5 0001
              : 0002 0000 0005 01 03 02 0001
58.15         : 0003 0000 0006 01 03 16B6 0001
              : 0003 0000 0005 01 03 02 0002
"""),
    # 58.15 = 1, any message: somebody else who reads keeps it running.
    ("abb_acs880", None, """
58.16         : 0001 0000 0006 01 03 16B7 0001
              : 0001 0000 0005 01 03 02 001E
58.14         : 0002 0000 0006 01 03 16B5 0001
              : 0002 0000 0005 01 03 02 0001
58.15         : 0003 0000 0006 01 03 16B6 0001
              : 0003 0000 0005 01 03 02 0001
"""),
    # 58.14 = 3, safe speed: it would run on.
    ("abb_acs880", None, """
58.16         : 0001 0000 0006 01 03 16B7 0001
              : 0001 0000 0005 01 03 02 001E
58.14         : 0002 0000 0006 01 03 16B5 0001
              : 0002 0000 0005 01 03 02 0003
"""),
    # As delivered: 8-03 60 s, 8-04 off.
    ("danfoss_fc202", None, """
8-03          : 0001 0000 0006 01 03 1F5D 0002
600           : 0001 0000 0007 01 03 04 0000 0258
8-04          : 0002 0000 0006 01 03 1F67 0001
[0]           : 0002 0000 0005 01 03 02 0000
"""),
    # 8-04 = [2] stop: the next valid control word starts it again.
    ("danfoss_fc202", None, """
8-03          : 0001 0000 0006 01 03 1F5D 0002
50            : 0001 0000 0007 01 03 04 0000 0032
8-04          : 0002 0000 0006 01 03 1F67 0001
[2]           : 0002 0000 0005 01 03 02 0002
"""),
    # 8-04 = [5] stop and trip.
    ("danfoss_fc202", 5.0, """
8-03          : 0001 0000 0006 01 03 1F5D 0002
50            : 0001 0000 0007 01 03 04 0000 0032
8-04          : 0002 0000 0006 01 03 1F67 0001
[5]           : 0002 0000 0005 01 03 02 0005
"""),
    ("grundfos_cim500", None, """
00012         : 0001 0000 0006 01 03 000B 0001
off           : 0001 0000 0005 01 03 02 0000
"""),
    ("grundfos_cim500", 5.0, """
00012         : 0001 0000 0006 01 03 000B 0001
on            : 0001 0000 0005 01 03 02 0001
"""),
    # TTO 10.0 s, SLL 1 freewheel stop: as delivered.
    ("schneider_atv630", 10.0, """
TTO           : 0001 0000 0006 01 03 1775 0001
              : 0001 0000 0005 01 03 02 0064
SLL           : 0002 0000 0006 01 03 1B62 0001
              : 0002 0000 0005 01 03 02 0001
"""),
    ("schneider_atv630", None, """
TTO           : 0001 0000 0006 01 03 1775 0001
              : 0001 0000 0005 01 03 02 0064
SLL           : 0002 0000 0006 01 03 1B62 0001
speed kept    : 0002 0000 0005 01 03 02 0005
"""),
]


@pytest.mark.parametrize(("name", "expected", "dialogue"), TIMEOUTS)
def test_own_timeout(name: str, expected: float | None, dialogue: str) -> None:
    def ask(drive: Drive) -> tuple[float | None, str]:
        return drive.timeout(), drive.timeout_note

    seconds, note = follow(name, dialogue, ask, gateway=True)
    assert seconds == (None if expected is None else pytest.approx(expected))
    assert bool(note) == (expected is None)


# EAV64332, sheet Parameters: the embedded Ethernet port has TTOB 64415 (0xFB9F) and ETHL 7021
# (0x1B6D), the serial port TTO and SLL. The CIM 500 is an Ethernet module.
ON_ETHERNET = [
    ("schneider_atv630", 4.0, """
TTOB          : 0001 0000 0006 01 03 FB9F 0001
              : 0001 0000 0005 01 03 02 0028
ETHL          : 0002 0000 0006 01 03 1B6D 0001
ramp stop     : 0002 0000 0005 01 03 02 0006
"""),
    ("schneider_atv630", None, """
TTOB          : 0001 0000 0006 01 03 FB9F 0001
              : 0001 0000 0005 01 03 02 0028
ETHL          : 0002 0000 0006 01 03 1B6D 0001
ignore        : 0002 0000 0005 01 03 02 0000
"""),
    ("grundfos_cim500", 5.0, """
00012         : 0001 0000 0006 01 03 000B 0001
on            : 0001 0000 0005 01 03 02 0001
"""),
]


@pytest.mark.parametrize(("name", "expected", "dialogue"), ON_ETHERNET)
def test_own_timeout_of_its_ethernet_port(
    name: str, expected: float | None, dialogue: str
) -> None:
    seconds = follow(name, dialogue, lambda drive: drive.timeout())
    assert seconds == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize("name", ["abb_acs880", "danfoss_fc202"])
def test_no_timeout_of_an_ethernet_port_is_known(name: str) -> None:
    with pytest.raises(DriveError, match=rf"{name}.yaml tells of none .* \(timeout.tcp\)"):
        follow(name, "", lambda drive: drive.timeout())


@pytest.mark.parametrize("rpm", [0, 1, 299, 7201, 0xFFFF])
def test_a_rated_speed_that_cannot_be_is_refused(rpm: int) -> None:
    """NSP 9604 (0x2584) of 1 rpm would make any speed the least, of 65535 rpm the greatest."""
    with pytest.raises(DriveError, match=f"NSP.*is {rpm}: .*believable are 300 to 7200"):
        follow("schneider_atv630", f"""
ETA           : 0001 0000 0006 01 03 0C81 0001
enabled       : 0001 0000 0005 01 03 02 0627
RFRD          : 0002 0000 0006 01 03 219C 0001
750           : 0002 0000 0005 01 03 02 02EE
NSP           : 0003 0000 0006 01 03 2584 0001
              : 0003 0000 0005 01 03 02 {rpm:04X}
""", lambda drive: drive.read())


# --- serial line ----------------------------------------------------------------------------------

def test_check_is_that_of_a_manual() -> None:
    # BBV52816 (Altivar 312), p. 12: two frames with their checks.
    assert crc(frame("02 03 0C1E 0004")).hex() == "276c"
    assert crc(frame("02 06 2329 000D")).hex() == "9270"


def test_start_on_a_serial_line() -> None:
    """The same words as over TCP, between slave address and check."""
    lines = [line.split(":")[1] for line in ABB_START.strip().splitlines()]
    frames = [frame(line)[6:] for line in lines]
    frames = [each + crc(each) for each in frames]
    answers = iter(frames[1::2])
    wire = SerialWire(lambda _request: next(answers))
    try:
        talk("abb_acs880", wire.line, lambda drive: drive.run(0.5))
    finally:
        wire.close()
    assert [each.hex() for each in wire.seen] == [each.hex() for each in frames[::2]]


def test_a_frame_with_a_wrong_check_is_no_answer() -> None:
    wire = SerialWire(lambda _request: frame("01 03 02 1231 0000"))
    try:
        with pytest.raises(DriveError) as got:
            talk("abb_acs880", wire.line, lambda drive: drive.read())
    finally:
        wire.close()
    assert got.value.kind == "connection" and "no valid answer within 0.3 s" in str(got.value)


# --- wrong answers --------------------------------------------------------------------------------

GOOD = [frame("0001 0000 0005 01 03 02 1337"), frame("0002 0000 0005 01 03 02 1D4C")]


def first(*answers: tuple[float, bytes]) -> Callable[[bytes], Answer]:
    """Answer the first request so, every other one as a good drive."""
    rest = iter([list(answers)])

    def answer(request: bytes) -> Answer:
        value = b"\x13\x37" if request[8:10] == b"\0\3" else b"\x1d\x4c"
        return next(rest, [(0.0, request[:4] + frame("0005 01 03 02") + value)])

    return answer


@pytest.mark.parametrize(
    ("answers", "kind", "says"),
    [
        ([(0, frame("0001 0000 0003 01 83 02"))], "answer", "exception 2, illegal data address"),
        ([(0, frame("0001 0000 0003 01 83 06"))], "answer", "exception 6, server device busy"),
        ([(0, frame("0001 0000 0003 01 83 63"))], "answer", "exception 99, unknown"),
        ([(0, frame("0009 0000 0005 01 03 02 1337"))], "connection", "no valid answer"),
        ([(0, frame("0001 0000 0005 07 03 02 1337"))], "connection", "no valid answer"),
        ([(0, frame("0001 DEAD 0005 01 03 02 1337"))], "connection", "no valid answer"),
        ([(0, frame("0001 0000 0005 01 04 02 1337"))], "answer", "function 4, not 3"),
        ([(0, frame("0001 0000 0007 01 03 04 1337 0000"))], "answer", "2 registers came, not 1"),
        ([(0, frame("0001 0000 0003 01 03 00"))], "answer", "0 registers came, not 1"),
        ([(0, bytes(range(255, 0, -1)) * 4)], "connection", ""),
        ([(0, frame("0001 0000 0002 01 7F"))], "connection", ""),
        ([], "connection", "no valid answer within 0.3 s"),
    ],
)
def test_wrong_answers_have_a_name_and_a_time(
    answers: list[tuple[float, bytes]], kind: str, says: str
) -> None:
    wire = Wire(first(*answers))

    def go(drive: Drive) -> float:
        began = time.monotonic()
        with pytest.raises(DriveError) as got:
            drive.read()
        assert got.value.kind == kind
        assert says in str(got.value) and f":{wire.port}, device 1: reading register 3" in str(
            got.value
        )
        return time.monotonic() - began

    try:
        assert talk("abb_acs880", wire.at, go) < 1.0
        assert len(wire.seen) == 1  # nothing is asked for twice
    finally:
        wire.close()


def test_an_answer_in_pieces_is_an_answer() -> None:
    pieces = [(0.005, bytes([byte])) for byte in GOOD[0]]
    wire = Wire(first(*pieces))
    try:
        assert talk("abb_acs880", wire.at, lambda drive: drive.read()).speed == 0.375
    finally:
        wire.close()


def test_a_late_answer_is_not_taken_for_the_next() -> None:
    wire = Wire(first((0.5, frame("0001 0000 0005 01 03 02 0008"))))

    def go(drive: Drive) -> Any:
        with pytest.raises(DriveError, match="no valid answer"):
            drive.read()
        # The server is still busy with the first; it answers both, one after the other.
        return drive.read()

    try:
        status = talk("abb_acs880", wire.at, go, timeout_s=0.4)
        assert status.running and not status.fault
    finally:
        wire.close()


def test_a_write_whose_answer_names_another_word() -> None:
    wire = Wire(lambda _request: [(0, frame("0001 0000 0006 01 06 0000 047F"))])
    try:
        with pytest.raises(DriveError, match="writing 0x047E to register 0: the answer") as got:
            talk("abb_acs880", wire.at, lambda drive: drive.stop())
        assert got.value.kind == "answer"
    finally:
        wire.close()


def test_a_connection_closed_by_the_drive() -> None:
    wire = Wire(lambda _request: None)
    try:
        with pytest.raises(DriveError, match="the connection was closed") as got:
            talk("abb_acs880", wire.at, lambda drive: drive.stop())
        assert got.value.kind == "connection"
    finally:
        wire.close()


def test_a_connection_without_an_answer_is_reset() -> None:
    """So that a drive with one socket has it free at once; RFC 9293, section 3.10.7.4."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ended: list[str] = []

        def serve() -> None:
            one, _ = listener.accept()
            with one:
                try:
                    while one.recv(512):
                        pass
                    ended.append("closed")
                except ConnectionResetError:
                    ended.append("reset")

        drive = threading.Thread(target=serve)
        drive.start()
        with pytest.raises(DriveError, match="no valid answer"):
            talk(
                "abb_acs880", f"tcp://127.0.0.1:{listener.getsockname()[1]}",
                lambda drive: drive.read(),
            )
        drive.join(5)
    assert ended == ["reset"]


def test_a_connection_is_watched_by_the_kernel() -> None:
    """Timer 2 of /proc/net/tcp, keepalive, runs while nothing is sent: proc_net_tcp.txt."""
    wire = Wire(lambda _request: [])

    def look(_drive: Drive) -> list[str]:
        lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        return [line[5][:2] for line in lines if line[2].endswith(f":{wire.port:04X}")
                and line[3] == "01"]

    try:
        assert talk("abb_acs880", wire.at, look) == ["02"]
    finally:
        wire.close()


def test_nobody_there() -> None:
    wire = Wire(lambda _request: [])
    wire.close()
    with pytest.raises(DriveError, match=f":{wire.port}, device 1: cannot connect") as got:
        talk("abb_acs880", wire.at, lambda drive: drive.stop())
    assert got.value.kind == "connection"


def test_a_speed_that_cannot_be() -> None:
    with pytest.raises(DriveError, match=r"register 400005\) is 32767: 1.63835 share") as got:
        follow("abb_acs880", """
              : 0001 0000 0006 01 03 0003 0001
              : 0001 0000 0005 01 03 02 1337
              : 0002 0000 0006 01 03 0004 0001
              : 0002 0000 0005 01 03 02 7FFF
""", lambda drive: drive.read())
    assert got.value.kind == "answer"


def test_a_rated_speed_of_nothing() -> None:
    with pytest.raises(DriveError, match=r"NSP, nominal .* is 0: 0, believ"):
        follow("schneider_atv630", """
              : 0001 0000 0006 01 03 0C81 0001
              : 0001 0000 0005 01 03 02 0233
              : 0002 0000 0006 01 03 219C 0001
              : 0002 0000 0005 01 03 02 0000
              : 0003 0000 0006 01 03 2584 0001
              : 0003 0000 0005 01 03 02 0000
""", lambda drive: drive.read())


def test_a_rated_speed_that_no_motor_has() -> None:
    """0xEA60 = 60000 rpm: every speed would look like rest."""
    with pytest.raises(DriveError, match="is 60000: 60000, believable are 300 to 7200"):
        follow("schneider_atv630", """
              : 0001 0000 0006 01 03 0C81 0001
              : 0001 0000 0005 01 03 02 0233
              : 0002 0000 0006 01 03 219C 0001
              : 0002 0000 0005 01 03 02 0000
              : 0003 0000 0006 01 03 2584 0001
              : 0003 0000 0005 01 03 02 EA60
""", lambda drive: drive.read())


def test_a_word_that_the_register_cannot_hold_is_not_written(tmp_path: Path) -> None:
    """90 % of 40000 rpm is 36000, in 16 bits with a sign -29536: full speed backwards."""
    file = tmp_path / "fast.yaml"
    text = find_drive_file("schneider_atv630").read_text()
    file.write_text(text.replace("high: 7200", "high: 60000"))
    with pytest.raises(DriveError, match=r"a speed of 90\.0% would be 36000 in LFRD") as got:
        follow(
            str(file), SCHNEIDER_START.split("50 %")[0].replace("05AA", "9C40"),
            lambda drive: drive.run(0.9),
        )
    assert got.value.kind == "drive"


@pytest.mark.parametrize(
    ("word", "speed", "fault"),
    [
        # 20000 is 100 % (FENA-11 p. 92): -100 is -0.5 %, -400 -2 %, -8000 -40 %.
        ("FF9C", 0.0, ""), ("FE70", 0.0, ""),
        ("E0C0", -0.4, "the pump turns backwards (speed -40.0%)"),
    ],
)
def test_a_speed_below_0(word: str, speed: float, fault: str) -> None:
    status = follow("abb_acs880", f"""
400004        : 0001 0000 0006 01 03 0003 0001
              : 0001 0000 0005 01 03 02 1231
400005        : 0002 0000 0006 01 03 0004 0001
              : 0002 0000 0005 01 03 02 {word}
""", lambda drive: drive.read())
    assert (status.speed, status.fault) == (speed, fault)
    assert status.stands == (speed == 0)


def test_an_own_file_may_begin_its_speeds_at_0(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(find_drive_file("abb_acs880").read_text().replace("low: -1.6", "low: 0.0"))
    assert follow(str(file), """
              : 0001 0000 0006 01 03 0003 0001
              : 0001 0000 0005 01 03 02 1231
-1 count      : 0002 0000 0006 01 03 0004 0001
              : 0002 0000 0005 01 03 02 FFFF
""", lambda drive: drive.read()).speed == 0


def test_a_fault_keeps_it_from_running() -> None:
    with pytest.raises(DriveError, match="fault: EFB communication loss") as got:
        follow("abb_acs880", """
              : 0001 0000 0006 01 03 0003 0001
tripped       : 0001 0000 0005 01 03 02 1238
04.01         : 0002 0000 0006 01 03 0190 0001
              : 0002 0000 0005 01 03 02 6681
""", lambda drive: drive.run(0.5))
    assert got.value.kind == "drive"


def test_local_control_is_named() -> None:
    def answer(request: bytes) -> Answer:
        if request[7] == 6:
            return [(0, request)]
        return [(0, request[:4] + frame("0005 01 03 02 1070"))]  # inhibited, and bit 9 is 0

    wire = Wire(answer)
    try:
        with pytest.raises(DriveError, match="it is in local control") as got:
            talk("abb_acs880", wire.at, lambda drive: drive.run(0.5))
        assert got.value.kind == "drive"
        assert "control = 0x047E had no effect within 2 s" in str(got.value)
        assert "switch-on inhibited" in str(got.value)
    finally:
        wire.close()


def test_giving_up_in_the_middle_of_a_start() -> None:
    """Off asked for while the drive does not get ready: no wait, no speed, no run."""
    asked = iter([True, False])
    follow("abb_acs880", """
              : 0001 0000 0006 01 03 0003 0001
              : 0001 0000 0005 01 03 02 1270
              : 0002 0000 0006 01 06 0000 047E
              : 0002 0000 0006 01 06 0000 047E
              : 0003 0000 0006 01 03 0003 0001
not ready     : 0003 0000 0005 01 03 02 1270
""", lambda drive: drive.run(0.5, lambda: next(asked)))


@pytest.mark.parametrize("speed", [-0.1, 1.1, float("nan")])
def test_no_speed(speed: float) -> None:
    with pytest.raises(ValueError, match="no share"):
        follow("abb_acs880", "", lambda drive: drive.run(speed))


def test_another_device_id() -> None:
    requests, answer = script("""
              : 0001 0000 0006 11 06 0000 047E
              : 0001 0000 0006 11 06 0000 047E
              : 0002 0000 0006 11 06 0001 0000
              : 0002 0000 0006 11 06 0001 0000
""")
    wire = Wire(answer)
    try:
        talk("abb_acs880", f"{wire.at},17", lambda drive: drive.stop())
    finally:
        wire.close()
    assert wire.seen == requests
