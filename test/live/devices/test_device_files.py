"""The files of drives, relays and sensors, and the errors for wrong ones."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from places import CONFIG
from refusals import refusal

from greenroof_ros.base.files import shared_directory
from greenroof_ros.live.devices.drive import DriveEndpoint
from greenroof_ros.live.devices.drive_file import (
    Codes,
    find_drive_file,
    read_drive_file,
    read_relay_file,
)
from greenroof_ros.live.devices.exchange import DriveExchange
from greenroof_ros.live.devices.modbus_line import (
    Address,
    decode,
    limits,
    parse_address,
    parse_drive_address,
)
from greenroof_ros.live.devices.sensor_file import ModbusSensor, read_sensors

SHIPPED = [
    path for path in sorted((shared_directory() / "config" / "drives").glob("*.yaml"))
    if "protocol: mqtt" not in path.read_text()
]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_files_are_right(path: Path) -> None:
    drive = read_drive_file(path)
    assert drive.path == find_drive_file(path.stem) == path
    letters = {"even": "E", "odd": "O", "none": "N"}
    assert drive.serial.parity_letter("/dev/ttyS0") == letters[drive.serial.parity]
    # What has no source is marked as unverified.
    for name, register in drive.registers.items():
        if register.source == "none":
            assert f"registers.{name}" in drive.unverified
        # When stopped, a signed speed can be a count below 0.
        if name == "speed" and register.type.startswith("int"):
            assert register.low <= -1.2
    # A drive whose vital words were not checked in its manual states this.
    assert drive.unverified_and_vital


ABB_BIT_2 = "running: {mask: 0x0004, value: 0x0004}"
ABB_SECONDS = "    type: uint16\n    unit: s"
# By file of config/: what is replaced (pairs of old and new), and the error: for sensors with the
# line, which is that of the change, or of the head of the section that lacks something.
WRONG: dict[str, list[tuple[str, ...]]] = {
    "drives/abb_acs880.yaml": [
        ("{address: 0, manual: 400001,", "{address: 1, manual: 400001,",
         "registers.control.manual = 400001: must be 400002, which is address 1 + "
         "numbering.offset 400001"),
        ("make: ABB", "makes: ABB", "makes = 'ABB': is not a valid key; did you mean make?"),
        ("    - {write: control, value: 0x047E}\n    - {write: reference, value: 0}",
         "    - {write: reference, value: 0}", "sequences.stop: must write the register control"),
        ("    - {write: reference, value: speed}\n", "", "sequences.run: must write the speed"),
        ("- {write: reference, value: 0}", "- {write: reference, value: speed}",
         "sequences.stop.2.value = 'speed': may only be written in sequences.run"),
        (ABB_BIT_2, ABB_BIT_2.replace("value: 0x0004", "value: 0x0005"),
         "status.running.value = 5: has bits outside the mask 0x0004, so the condition"),
        ("stop_bits: 1", "stop_bits: 3", "serial.stop_bits = 3: must be a whole number from 1"),
        (ABB_BIT_2, ABB_BIT_2.replace("}", ", register: speed}"),
         "status.running.register = 'speed': must be a register of the type uint16 or uint32"),
        (ABB_SECONDS, ABB_SECONDS.replace("16", "32"),
         "registers.timeout_time.word_order: must be 'high first' or 'low first'"),
        ("    scale: 0.1\n", "    scale: 0\n", "registers.timeout_time.scale = 0: must be fin"),
        ("    low: -1.6\n", "    low: 2\n", "registers.speed.low = 2: must be at most high, which"),
        ("stops: {1: Fault,", "stops: {2: Fault,",
         "timeout.serial.action.stops.2 = 'Fault': is in both stops and"),
        ("    register: timeout_time\n", "    register: rating\n",
         "registers.rating: must have the unit s"),
        ("    scale: 5.0e-5\n    low: -1.6\n", "    full_scale: rating\n    low: -1.6\n",
         "registers.rating: must have high, a low above 0 and no full_scale, since speed"),
        ("  - registers.fault\n", "  - registers.faulty\n",
         "unverified.5 = 'registers.faulty': is not a key of this file"),
        ("  speed:\n    address: 4", "  pace:\n    address: 4", "registers: must contain speed"),
    ],
    "drives/tasmota.yaml": [
        ("state: {question: state,", "state: {question: status,",
         "state.question = 'status': must be the name of a request under questions in this file: "
         "state, timer"),
        ("payload: \"ON\"}", "payload: $on}",
         "switch_on.payload = '$on': may contain only these placeholders: $device, $me, $id, "
         "$seconds"),
        ('is_off: "OFF"', 'is_off: "ON"', "state.is_off = 'ON': must differ from is_on"),
        ("{low: 1, high: 111,", "{low: 112, high: 111,", "must be at most high, which is"),
        ("unverified: []", "unverified: [clock]", "is not a key of this file"),
    ],
    "drives/shelly_gen2.yaml": [
        ('{"id": $id, "src": "$me", "method": "Shelly.GetDeviceInfo"}', "{}",
         "number = 'id': requires $id in the payload of every request"),
        ("protocol: mqtt", "protocol: coap", "protocol = 'coap': must be one of mqtt"),
    ],
    "sensors.yaml": [
        ("tcp://127.0.0.1:5030", "127.0.0.1",
         "line 11: cistern.address = '127.0.0.1': must be tcp"),
        ("  median: 5", "  median: 99", "line 21: cistern.median = 99: must be smaller"),
        ("low: 0.0 ", "low: -0.2 ", "line 18: cistern.low = -0.2: must be at least -0.1 m, since"),
        ("period: 1.0", "period: 3.0", "line 22: cistern.period = 3.0: must be at most 2.5 s, sin"),
        ("5031", "5030", "line 27: roof.register = 0: must differ from that of the cistern"),
    ],
    "sensors_mqtt.yaml": [
        ("/cistern/sensor/level/state  #", " #",
         "line 10: cistern.address = 'mqtt://127.0.0.1:1883': must be mqtt://HOST[:PORT]/TOPIC"),
        ("  max_age: 5.0  ", "  max_age: 6.0  ",
         "line 16: cistern.max_age = 6.0: must be at most 5 s, since older values than"),
        ("# login: /etc/greenroof/broker.yaml", "login: broker.yaml",
         "line 17: cistern.login = 'broker.yaml': must be an absolute path"),
        ("# login:", "authority: /ca.pem #",
         "line 10: cistern.address = "
         "'mqtt://127.0.0.1:1883/cistern/sensor/level/state': certificates can be used only"),
        ("counts: true ", "period: 1.0 #", "line 31: rain_gauge.period = 1.0: is not a valid key"),
        ("  low: -40.0   ", "  counts: true\n  low: -40.0   ",
         "line 41: thermometer.counts = True: is only allowed for a flow meter or a rain gauge"),
        ("  high: 0.0001    ", "  # high: 0.0001 ", "line 29: rain_gauge.high: is missing"),
        ("roof/temperature", "roof/rain",
         "line 39: thermometer.address = 'mqtt://127.0.0.1:1883/roof/rain': must differ from that "
         "of the rain gauge"),
    ],
}


@pytest.mark.parametrize(("name", "changes", "message"), [
    (name, changes, message) for name, rows in WRONG.items() for *changes, message in rows
])
def test_wrong_files_are_refused_by_line_key_and_value(
    tmp_path: Path, name: str, changes: list[str], message: str
) -> None:
    text = (CONFIG / name).read_text(encoding="utf-8")
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "own.yaml"
    path.write_text(text, encoding="utf-8")
    if name.startswith("sensors"):
        refused = refusal(read_sensors, path, {"level_limit": 5.0})
    else:
        refused = refusal(read_relay_file if "protocol" in text else read_drive_file, path)
    assert re.match(rf"{path}, line \d+: ", refused) and message in refused


@pytest.mark.parametrize(("name", "remedy"), [
    ("siemens", "choose from abb_acs880, danfoss_fc202, "),
    ("danfos", "did you mean danfoss_fc202?"),
])
def test_a_drive_that_is_unknown(name: str, remedy: str) -> None:
    message = f"drive = '{name}': is neither a file nor a name in config/drives/; {remedy}"
    assert message in refusal(find_drive_file, name)


@pytest.mark.parametrize(
    ("device_id", "keys", "line", "message"),
    [
        (2, "", 0, ""),
        (2, "parity: even\n  stop_bits: 1\n  baud_rate: 19200", 0, ""),  # the defaults
        (1, "register: 4", 26, "roof.device_id = 1: must differ from that of the cistern on the "
         "same serial line, since a late response could be mistaken"),
        (2, "baud_rate: 9600", 37, "roof.baud_rate = 9600: must be 19200, as for the cistern on "
         "the same line"),
        (2, "parity: none", 37, "roof.parity = 'none': must be even, as for the cistern"),
    ],
)
def test_two_sensors_on_one_serial_line(
    tmp_path: Path, device_id: int, keys: str, line: int, message: str
) -> None:
    """By any name. They need slave addresses of their own, and the same settings."""
    link, file = tmp_path / "line", tmp_path / "own.yaml"
    link.symlink_to("/dev/ttyS0")
    cistern, roof = (CONFIG / "sensors.yaml").read_text().split("\nroof:")
    roof = roof.replace("tcp://127.0.0.1:5031", str(link)).replace(": 1   ", f": {device_id}   ")
    if keys.startswith("register"):
        roof = roof.replace("register: 0", keys)
    elif keys:
        roof += f"  {keys}\n"
    file.write_text(f"{cistern.replace('tcp://127.0.0.1:5030', '/dev/ttyS0')}\nroof:{roof}")
    if not message:
        sensors = read_sensors(file)
        assert isinstance(sensors.cistern, ModbusSensor) and isinstance(sensors.roof, ModbusSensor)
        assert sensors.cistern.connection == sensors.roof.connection
        return
    assert f"own.yaml, line {line}: {message}" in refusal(read_sensors, file)


@pytest.mark.parametrize(
    ("text", "address", "interface", "device_id"),
    [
        ("tcp://10.0.0.7", Address(host="10.0.0.7"), "tcp", 3),
        ("tcp://[::1]:502", Address(host="::1", port=502), "tcp", 3),
        ("gateway://10.0.0.7", Address(host="10.0.0.7", gateway=True), "serial", 17),
        ("/dev/ttyUSB0", Address(line="/dev/ttyUSB0"), "serial", 17),
        ("gateway://10.0.0.7:41,200", Address("10.0.0.7", 41, "", True, 200), "serial", 200),
        ("tcp://10.0.0.7:65535", Address("10.0.0.7", 65535), "tcp", 3),
        ("/dev/ttyUSB0,247", Address(line="/dev/ttyUSB0", device_id=247), "serial", 247),
    ],
)
def test_addresses(text: str, address: Address, interface: str, device_id: int) -> None:
    """A gateway leads to the serial port; the device number is the address's or the file's."""
    assert parse_drive_address(text, "at") == address
    assert str(address) == text and address.interface == interface
    assert address.device_id is not None or parse_address(text) == address
    read = read_drive_file(SHIPPED[0])
    numbered = replace(
        read, serial=replace(read.serial, device_id=17), tcp=replace(read.tcp, device_id=3)
    )
    assert numbered.line(address, 1.0).where == f"{text}, device {device_id}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((text, "must be tcp://HOST, tcp://HOST:PORT, gateway:")
          for text in ("10.0.0.7", "tcp://host:0", "tcp://host:65536", "udp://host")),
        ("tcp://10.0.0.7,256", "must have a device id, 0 to 255, after"),
        ("gateway://10.0.0.7,0", "must have a device id, 1 to 247, after"),
        ("/dev/ttyUSB0,x", "must have a device id, 1 to 247, after"),
    ],
)
def test_no_addresses(text: str, message: str) -> None:
    refusal(parse_drive_address, text, "at", match=message)


@pytest.mark.parametrize(
    ("kind", "order", "words", "value"),
    [
        ("int16", "", [0xFFFE], -2),
        ("uint32", "low first", [0x0001, 0x0002], 131073),
        ("int32", "high first", [0xFFFF, 0xFFFD], -3),
        # IEEE 754 textbook example: 0x3FC00000 is 1.5.
        ("float32", "high first", [0x3FC0, 0x0000], 1.5),
        ("uint64", "low first", [0x0001, 0, 0, 0x0002], 2**49 + 1),
        ("int64", "high first", [0xFFFF, 0xFFFF, 0xFFFF, 0xFFFD], -3),
        ("float64", "high first", [0x3FF8, 0x0000, 0x0000, 0x0000], 1.5),
        ("text", "", [0x4142, 0x4300], "ABC"),
    ],
)
def test_values_of_all_types(kind: str, order: str, words: list[int], value: object) -> None:
    assert decode(words, kind, order) == value


@pytest.mark.parametrize(("kind", "low", "high"), [
    ("uint16", 0, 0xFFFF), ("int16", -0x8000, 0x7FFF),
    ("uint32", 0, 0xFFFF_FFFF), ("int32", -0x8000_0000, 0x7FFF_FFFF),
    ("uint64", 0, 2**64 - 1), ("int64", -(2**63), 2**63 - 1),
])
def test_a_type_has_its_own_limits(kind: str, low: int, high: int) -> None:
    assert limits(kind) == (low, high)


def test_a_fault_that_is_the_timeout_and_no_other() -> None:
    """Bits 1 and 7; no bits at all are not this fault."""
    codes = Codes("fault", "bits", {})
    only = [codes.only(raw, (1, 7)) for raw in (0x82, 0x80, 0x83, 0)]
    assert only == [True, True, False, False]


def test_the_bits_of_a_word_in_words() -> None:
    """From the lowest to the highest of 32 bits; bits without a text by their number."""
    codes = Codes("fault", "bits", {0: "low", 31: "high"})
    assert codes.text(0x8000_0003) == "low, bit 1, high"
    assert codes.text(0) == ""


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "pymodbus.client", raising=False)
    monkeypatch.setitem(sys.modules, "pymodbus", None)  # type: ignore[arg-type]
    endpoint = DriveEndpoint(read_drive_file(SHIPPED[0]), parse_address("tcp://127.0.0.1"))
    needs = "needs pymodbus: install greenroof_ros with its extra [pump]"
    assert refusal(DriveExchange, endpoint) == needs
