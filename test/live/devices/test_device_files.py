"""The files of sensors, drives and relays, the errors for wrong ones, and addresses."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from places import CONFIG
from refusals import refusal

from greenroof_ros.live.devices.drive import Drive, DriveEndpoint
from greenroof_ros.live.devices.drive_file import find_drive_file, read_drive_file
from greenroof_ros.live.devices.exchange import read_endpoint
from greenroof_ros.live.devices.modbus_line import Address, parse_address
from greenroof_ros.live.devices.sensor_file import read_sensors

ABB = read_drive_file(find_drive_file("abb_acs880"))
MODBUS, MQTT, DRIVE = "sensors.yaml", "sensors_mqtt.yaml", "drives/abb_acs880.yaml"
# A file of config/, what is replaced, and the error with the line, which is that of the change, or
# of the head of the section that lacks something; one of each kind.
WRONG = [
    (MODBUS, "  median: 5", "  median: 99", "line 21: cistern.median = 99: must be smaller"),
    (MODBUS, "low: 0.0 ", "low: -0.2 ", "line 18: cistern.low = -0.2: must be at least -0.1"),
    (MODBUS, "period: 1.0", "period: 3.0", "cistern.period = 3.0: must be at most 2.5 s, sin"),
    (MODBUS, "5031", "5030", "roof.register = 0: must differ from that of the cistern"),
    (MQTT, "/cistern/sensor/level/state  #", " #", "must be mqtt://HOST[:PORT]/TOPIC"),
    (MQTT, "  max_age: 5.0  ", "  max_age: 6.0  ", "cistern.max_age = 6.0: must be at"),
    (MQTT, "  low: -40.0   ", "  counts: true\n  low: -40.0   ",
     "thermometer.counts = True: is only allowed for a flow meter or a rain gauge"),
    (MQTT, "  high: 0.0001    ", "  # high: 0.0001 ", "line 29: rain_gauge.high: is missing"),
    (DRIVE, "{address: 0, manual: 400001,", "{address: 1, manual: 400001,",
     "registers.control.manual = 400001: must be 400002, which is address 1 + numbering"),
    (DRIVE, "    - {write: control, value: 0x047E}", "    - {write: reference, value: 0}",
     "sequences.stop: must write the register control"),
    (DRIVE, "{mask: 0x0004, value: 0x0004}", "{mask: 0x0004, value: 0x0005}",
     "status.running.value = 5: has bits outside the mask 0x0004, so the condition"),
    (DRIVE, "type: uint16\n    scale", "type: uint32\n    scale",
     "registers.timeout_time.word_order: must be 'high first' or 'low first'"),
    (DRIVE, "type: uint16, meaning: control",
     "type: uint32, word_order: low first, meaning: control",
     "registers.control.type = 'uint32': must be uint16 or int16, since the register is writ"),
    (DRIVE, "    scale: 5.0e-5\n    low: -1.6\n",
     "    full_scale: fault\n    low: -1.6\n", "must have high, a low above 0 and no full_scale"),
    (DRIVE, "    register: timeout_time\n", "    register: time\n",
     "timeout.serial.register = 'time': must be the name of a register in this file: control"),
    (DRIVE, "  speed:\n    address: 4", "  pace:\n    address: 4",
     "registers: must contain speed"),
]


@pytest.mark.parametrize(("name", "old", "new", "message"), WRONG)
def test_wrong_files_are_refused_by_line_key_and_value(
    tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    text, path = (CONFIG / name).read_text(encoding="utf-8"), tmp_path / "own.yaml"
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    if name.startswith("drives"):
        refused = refusal(read_endpoint, path, "tcp://h", "at")
    else:
        refused = refusal(read_sensors, path, {"level_limit": 5.0})
    assert re.match(rf"{path}, line \d+: ", refused) and message in refused


@pytest.mark.parametrize(
    ("text", "address", "interface", "device_id"),
    [
        ("tcp://10.0.0.7", Address(host="10.0.0.7"), "tcp", 17),
        ("tcp://[::1]:502", Address(host="::1", port=502), "tcp", 17),
        ("gateway://10.0.0.7", Address(host="10.0.0.7", gateway=True), "serial", 17),
        ("/dev/ttyUSB0", Address(line="/dev/ttyUSB0"), "serial", 17),
        ("gateway://10.0.0.7:41,200", Address("10.0.0.7", 41, "", True, 200), "serial", 200),
        ("tcp://10.0.0.7:65535,0", Address("10.0.0.7", 65535, device_id=0), "tcp", 0),
    ],
)
def test_addresses(text: str, address: Address, interface: str, device_id: int) -> None:
    """A gateway leads to the serial port; the device number is the address's or the file's."""
    assert parse_address(text, "at") == address
    assert str(address) == text and address.interface == interface
    numbered = replace(ABB, serial=replace(ABB.serial, device_id=17))
    assert Drive(numbered, address).line.where == f"{text}, device {device_id}"


@pytest.mark.parametrize(("drive", "text", "message"), [
    ("abb_acs880", "10.0.0.7", "must be tcp://HOST, tcp://HOST:PORT, gateway:"),
    ("abb_acs880", "tcp://10.0.0.7,256", "must have a device id, 0 to 255, after"),
    ("abb_acs880", "gateway://10.0.0.7,0", "must have a device id, 1 to 247, after"),
    ("tasmota", "tcp://127.0.0.1:502", r"must be mqtt://HOST\[:PORT\]/TOPIC"),
])
def test_no_addresses(drive: str, text: str, message: str) -> None:
    refusal(read_endpoint, find_drive_file(drive), text, "at", match=message)


def test_a_drive_has_one_lock_by_any_name_of_its_host_or_line(tmp_path: Path) -> None:
    """A serial line is locked with all its devices; sensors share it by any name, too."""
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    for *names, lock in (
        ("tcp://localhost", "tcp://127.0.0.1:502", "gateway://127.0.0.1,1", "127.0.0.1-502-1"),
        (f"{tmp_path}/ttyUSB0,1", f"{tmp_path}/by-id,2", f"{tmp_path}/ttyUSB0".strip("/")),
    ):
        assert {DriveEndpoint(ABB, parse_address(name)).lock_name() for name in names} == {lock}
    first, second = (parse_address(f"{tmp_path}/{name}") for name in ("by-id", "ttyUSB0"))
    assert first.connection == second.connection
