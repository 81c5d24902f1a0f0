"""The files of sensors, and the errors for wrong ones; values of registers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from places import CONFIG
from refusals import refusal

from greenroof_ros.live.devices.modbus_line import decode, limits
from greenroof_ros.live.devices.sensor_file import ModbusSensor, read_sensors

# By file of config/: what is replaced (pairs of old and new), and the error: for sensors with the
# line, which is that of the change, or of the head of the section that lacks something.
WRONG: dict[str, list[tuple[str, ...]]] = {
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
    refused = refusal(read_sensors, path, {"level_limit": 5.0})
    assert re.match(rf"{path}, line \d+: ", refused) and message in refused


def test_two_sensors_share_a_serial_line_by_any_name(tmp_path: Path) -> None:
    link, file = tmp_path / "line", tmp_path / "own.yaml"
    link.symlink_to("/dev/ttyS0")
    text = (CONFIG / "sensors.yaml").read_text().replace("tcp://127.0.0.1:5031", str(link))
    file.write_text(text.replace("tcp://127.0.0.1:5030", "/dev/ttyS0"))
    sensors = read_sensors(file)
    assert isinstance(sensors.cistern, ModbusSensor) and isinstance(sensors.roof, ModbusSensor)
    assert sensors.cistern.place.connection == sensors.roof.place.connection


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
