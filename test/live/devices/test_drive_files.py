"""The files of drives and relays, the errors for wrong ones, and addresses."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from places import CONFIG
from refusals import refusal

from greenroof_ros.live.devices.drive import DriveEndpoint
from greenroof_ros.live.devices.drive_file import (
    find_drive_file,
    read_drive_file,
    read_relay_file,
)
from greenroof_ros.live.devices.exchange import DriveExchange, read_endpoint
from greenroof_ros.live.devices.modbus_line import Address, parse_address

SHIPPED = sorted(
    path for path in (CONFIG / "drives").glob("*.yaml") if "protocol: mqtt" not in path.read_text()
)
ABB_RUNNING = "running: {mask: 0x0004, value: 0x0004}"
# By file: what is replaced, and the error.
WRONG: dict[str, list[tuple[str, str, str]]] = {
    "abb_acs880": [
        ("{address: 0, manual: 400001,", "{address: 1, manual: 400001,",
         "registers.control.manual = 400001: must be 400002, which is address 1 + numbering"),
        ("make: ABB", "makes: ABB", "makes = 'ABB': is not a valid key; did you mean make?"),
        ("    - {write: control, value: 0x047E}", "    - {write: reference, value: 0}",
         "sequences.stop: must write the register control"),
        (ABB_RUNNING, ABB_RUNNING.replace("value: 0x0004", "value: 0x0005"),
         "status.running.value = 5: has bits outside the mask 0x0004, so the condition"),
        ("stop_bits: 1", "stop_bits: 3", "serial.stop_bits = 3: must be a whole number from 1"),
        ("type: uint16\n    scale", "type: uint32\n    scale",
         "registers.timeout_time.word_order: must be 'high first' or 'low first'"),
        ("type: uint16, meaning: control", "type: uint32, word_order: low first, meaning: control",
         "registers.control.type = 'uint32': must be uint16 or int16, since the register is writ"),
        ("    scale: 0.1\n", "    scale: 0\n", "registers.timeout_time.scale = 0: must be"),
        ("    scale: 5.0e-5\n    low: -1.6\n", "    full_scale: fault\n    low: -1.6\n",
         "registers.fault: must have high, a low above 0 and no full_scale, since speed"),
        ("    register: timeout_time\n", "    register: time\n",
         "timeout.serial.register = 'time': must be the name of a register in this file: control"),
        ("  speed:\n    address: 4", "  pace:\n    address: 4", "registers: must contain speed"),
    ],
    "tasmota": [
        ("protocol: mqtt", "protocol: coap", "protocol = 'coap': must be one of mqtt"),
        ("  path: StatusSTS.POWER\n", "", "state.path: is missing: path of the value in the reply"),
    ],
}


@pytest.mark.parametrize(("name", "old", "new", "message"), [
    (name, *row) for name, rows in WRONG.items() for row in rows
])
def test_wrong_files_are_refused_by_line_key_and_value(
    tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    text, path = find_drive_file(name).read_text(encoding="utf-8"), tmp_path / "own.yaml"
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    refused = refusal(read_relay_file if "protocol" in text else read_drive_file, path)
    assert re.match(rf"{path}, line \d+: ", refused) and message in refused


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_files_are_right(path: Path) -> None:
    """What was not checked in the drive's own manual is stated."""
    drive = read_drive_file(path)
    assert drive.path == find_drive_file(path.stem) == path
    assert drive.unverified


@pytest.mark.parametrize(("name", "remedy"), [
    ("siemens", "choose from abb_acs880, danfoss_fc202, "),
    ("danfos", "did you mean danfoss_fc202?"),
])
def test_a_drive_that_is_unknown(name: str, remedy: str) -> None:
    message = f"drive = '{name}': is neither a file nor a name in config/drives/; {remedy}"
    assert message in refusal(find_drive_file, name)


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
    read = read_drive_file(SHIPPED[0])
    numbered = replace(read, serial=replace(read.serial, device_id=17))
    assert numbered.line(address, 1.0).where == f"{text}, device {device_id}"


@pytest.mark.parametrize(
    ("drive", "text", "message"),
    [
        *(("abb_acs880", text, "must be tcp://HOST, tcp://HOST:PORT, gateway:") for text in
          ("10.0.0.7", "tcp://host:0", "tcp://host:65536", "udp://host", "mqtt://127.0.0.1/roof")),
        ("abb_acs880", "tcp://10.0.0.7,256", "must have a device id, 0 to 255, after"),
        ("abb_acs880", "gateway://10.0.0.7,0", "must have a device id, 1 to 247, after"),
        ("abb_acs880", "/dev/ttyUSB0,x", "must have a device id, 1 to 247, after"),
        ("tasmota", "tcp://127.0.0.1:502", r"must be mqtt://HOST\[:PORT\]/TOPIC"),
    ],
)
def test_no_addresses(drive: str, text: str, message: str) -> None:
    refusal(read_endpoint, find_drive_file(drive), text, "at", match=message)


def test_a_drive_has_one_lock_by_any_name_of_its_host() -> None:
    file = read_drive_file(SHIPPED[0])
    places = {
        DriveEndpoint(file, parse_address(text)).lock_name()
        for text in ("tcp://localhost", "tcp://127.0.0.1:502", "gateway://127.0.0.1,1")
    }
    assert places == {"127.0.0.1-502-1"}


def test_a_login_that_is_wrong(tmp_path: Path) -> None:
    pytest.importorskip("paho.mqtt.client")
    login = tmp_path / "login.yaml"
    login.write_text("username: roof\n")
    login.chmod(0o600)
    relay = read_endpoint(find_drive_file("tasmota"), "mqtts://broker/roof/a", "at", str(login))
    assert str(relay) == "mqtts://broker:8883/roof/a"
    refusal(DriveExchange, relay, match="login.yaml.*password: must be text")


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "pymodbus.client", raising=False)
    monkeypatch.setitem(sys.modules, "pymodbus", None)  # type: ignore[arg-type]
    endpoint = DriveEndpoint(read_drive_file(SHIPPED[0]), parse_address("tcp://127.0.0.1"))
    needs = "needs pymodbus: install greenroof_ros with its extra [pump]"
    assert refusal(DriveExchange, endpoint) == needs
