"""The files of sensors, drives and relays, the errors for wrong ones, and addresses."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import CONFIG, refusal

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.live.devices.drive import Drive, DriveEndpoint
from greenroof_ros.live.devices.drive_file import find_drive_file, read_drive_file
from greenroof_ros.live.devices.exchange import read_endpoint
from greenroof_ros.live.devices.modbus_line import Address, parse_address
from greenroof_ros.live.devices.sensor_file import read_sensors

ABB = read_drive_file(find_drive_file("abb_acs880"))
FILES = sorted([*CONFIG.glob("sensors*.yaml"), *CONFIG.glob("drives/*.yaml")])
MODBUS, MQTT, DRIVE = "sensors.yaml", "sensors_mqtt.yaml", "drives/abb_acs880.yaml"
# Keys that do not fit together: a file of config/, what is replaced, and the key in the error.
WRONG = [
    (MODBUS, "  median: 5", "  median: 99", "cistern.median"),
    (MODBUS, "period: 1.0", "period: 3.0", "cistern.period"),
    (MODBUS, "5031", "5030", "roof.register"),
    (MQTT, "  max_age: 5.0  ", "  max_age: 6.0  ", "cistern.max_age"),
    (MQTT, "  low: -40.0   ", "  counts: true\n  low: -40.0   ", "thermometer.counts"),
    (DRIVE, "0, manual: 400001,", "1, manual: 400001,", "registers.control.manual"),
    (DRIVE, "    - {write: control,", "    - {write: reference,", "sequences.stop"),
    (DRIVE, "mask: 0x0004, value: 0x0004", "mask: 0x0004, value: 0x0005", "status.running.value"),
    (DRIVE, "    register: timeout_time\n", "    register: time\n", "timeout.serial.register"),
    (DRIVE, "  speed:\n    address: 4", "  pace:\n    address: 4", "registers"),
]


def error_in(name: str, text: str, directory: Path) -> ConfigurationError:
    """Return the error of a file of config/ with another content; it names file and line."""
    path = directory / "own.yaml"
    path.write_text(text, encoding="utf-8")
    file = (path, "tcp://h" if "registers:" in text else "mqtt://h/x", "")
    with pytest.raises(ConfigurationError) as caught:
        read_sensors(path, {"level_limit": 5.0}) if "sensors" in name else read_endpoint(*file)
    assert str(caught.value).startswith(f"{path}, line ")
    return caught.value


@pytest.mark.parametrize(("name", "old", "new", "key"), WRONG)
def test_what_does_not_fit_together_is_refused(
    name: str, old: str, new: str, key: str, tmp_path: Path
) -> None:
    text = (CONFIG / name).read_text(encoding="utf-8")
    assert old in text
    assert error_in(name, text.replace(old, new, 1), tmp_path).key == key


@given(st.sampled_from(FILES), st.sampled_from([": [1]", "_of_mine: 1"]), st.data())
def test_a_wrong_type_and_an_unknown_key_are_refused(
    file: Path, wrong: str, data: st.DataObject
) -> None:
    """Which keys there are depends on the address."""
    lines = file.read_text(encoding="utf-8").split("\n")
    key_line = re.compile(r" *(?!address)\w+: +\w")
    places = [number for number, line in enumerate(lines) if key_line.match(line)]
    number = data.draw(st.sampled_from(places))
    key = lines[number].partition(":")[0]
    lines[number] = key + wrong
    with TemporaryDirectory() as directory:
        assert key.strip() in str(error_in(file.name, "\n".join(lines), Path(directory)).key)


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


@pytest.mark.parametrize(("drive", "text"), [
    ("abb_acs880", "10.0.0.7"), ("abb_acs880", "tcp://10.0.0.7,256"),
    ("abb_acs880", "gateway://10.0.0.7,0"), ("tasmota", "tcp://127.0.0.1:502"),
])
def test_no_addresses(drive: str, text: str) -> None:
    assert refusal(read_endpoint, find_drive_file(drive), text, "at").startswith(f"at = '{text}'")


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
