"""Sensors on Modbus and MQTT: what counts as a reading; totals, of which all is published."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import pytest
from modbus_wire import Answer, Wire

from greenroof_ros.live.devices import sensor as devices
from greenroof_ros.live.devices.modbus_line import DriveError
from greenroof_ros.live.devices.sensor import ModbusReader, MqttReader, Reader, SensorLine, Total
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor

TOPIC = "tele/roof/SENSOR"
STARTING, LOST = (None, False), (None, True)  # a reading, and whether there is a problem


MODBUS = ModbusSensor(  # 0.1 mm per count, up to 6 m, without a filter
    address="", device_id=1, register=16, kind="input", type="uint16", scale=1e-4, low=0.0,
    high=6.0, median=1, period=0.05,
)


def readers(at: str, *changed: dict[str, object], max_age: float = 3.0) -> list[ModbusReader]:
    """Return the readers of the sensors on a line."""
    line = SensorLine()
    sensors = [replace(MODBUS, address=at, **each) for each in changed]  # type: ignore[arg-type]
    return [ModbusReader("roof", sensor, line, max_age) for sensor in sensors]


def seen(reader: Reader) -> tuple[float | None, bool]:
    """Return the reading, and whether there is a problem."""
    return reader.snapshot.value, bool(reader.snapshot.problem)


def answer(request: bytes, data: str) -> Answer:
    """Return an answer to a request of function 03 or 04."""
    body = bytes([request[6], request[7], len(bytes.fromhex(data))]) + bytes.fromhex(data)
    return [(0.0, request[:4] + len(body).to_bytes(2, "big") + body)]


# --- Modbus ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("data", "changed", "level"), [
    ("0BB8", {"scale": 0.001, "offset": -0.5, "kind": "holding"}, 2.5),
    ("FF9C", {"type": "int16", "scale": 0.01, "offset": 3.0}, 2.0),  # -100
    ("0000 4020", {"type": "float32", "word_order": "low first", "scale": 1.0}, 2.5),
    ("8000 0000 0000 0000", {"type": "uint64", "word_order": "high first", "missing": 2**63}, None),
    # A value that cannot be a level.
    ("EA61", {}, None),
    ("7FC0 0000", {"type": "float32", "word_order": "high first", "scale": 1.0}, None),
])
def test_scale_offset_type_and_word_order(
    data: str, changed: dict[str, object], level: float | None
) -> None:
    with closing(Wire(lambda request: answer(request, data))) as wire:
        (reader,) = readers(wire.at, changed)
        reader.read()
        assert wire.requests[0][7] == (3 if "kind" in changed else 4)
    assert reader.snapshot.value == (None if level is None else pytest.approx(level))
    assert bool(reader.snapshot.problem) == (level is None)


def test_the_median_leaves_single_wrong_readings_out_and_starts_again_after_a_refused_one() -> None:
    """Of three: 1, 1 (of 1, 6: the lower), 1, 2 | 3 alone, then 3 (of 3, 4)."""
    (reader,), results = readers("tcp://h", {"median": 3}), list[float | None]()
    for level in (1, 6, 1, 2, 7, 3, 4):
        with reader.reading():
            reader.add(level * 10_000)
        results.append(reader.snapshot.value)
    assert results == [1.0, 1.0, 1.0, 2.0, None, 3.0, 3.0]


def test_a_reading_of_long_ago_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither if the reading hangs, nor after a suspend of the machine."""
    now = 1000.0
    monkeypatch.setattr(devices, "boot_time", lambda: now)
    (reader,) = readers("tcp://h", {"median": 3}, max_age=5.0)
    reader.add(10_000)
    now += 4.9
    assert reader.snapshot.value == 1.0
    now += 0.2
    assert seen(reader) == LOST
    reader.add(10_000)
    now += 3600.0
    reader.add(40_000)
    assert reader.snapshot.value == 4.0


# --- several on one line --------------------------------------------------------------------------


def test_a_sensor_next_to_a_silent_or_wrong_one_behind_a_gateway() -> None:
    """The devices 1 and 2 are at 1.0 m and 3.0 m."""
    data = {1: "2710", 2: "7530"}

    def reply(request: bytes) -> Answer:
        return answer(request, data[request[6]]) if data[request[6]] else []

    with closing(Wire(reply)) as wire:
        first, second = readers(wire.gateway, {"device_id": 1}, {"device_id": 2})
        for wrong in ("FFFF", "27102710", ""):
            for data[1] in ("2710", wrong):
                first.read()
                second.read()
                known = 1.0 if data[1] == "2710" else None
                assert (first.snapshot.value, second.snapshot.value) == (known, 3.0)


# --- MQTT -----------------------------------------------------------------------------------------


def sensor_at(address: str = f"mqtt://h/{TOPIC}", **changed: Any) -> MqttSensor:
    """Return a sensor that publishes metres, up to 6 m, without a filter."""
    sensor = MqttSensor(address=address, scale=1.0, low=0.0, high=6.0, median=1, max_age=30.0)
    return replace(sensor, **changed)


class Told:
    """The reader of a sensor, with the time and the messages of the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **changed: object) -> None:
        pytest.importorskip("paho.mqtt")
        self.now = 1000.0
        monkeypatch.setattr(devices, "boot_time", lambda: self.now)
        self.reader = MqttReader("roof", sensor_at(**changed))
        monkeypatch.setattr(self.reader._client, "subscribe", lambda topic: None)
        self.reader._on_connect()

    def tell(
        self, message: str, after: float = 1.1, topic: str = TOPIC, retained: bool = False
    ) -> tuple[float | None, bool]:
        """Send a message a while (s) after the last one, and return what is then seen."""
        self.now += after
        self.reader.receive(topic, message.encode(), retained)
        return seen(self.reader)


@pytest.mark.parametrize(("message", "path", "level"), [
    ("0.031", "", 2.6),
    # A Tasmota message, and one from a gateway with several sensors.
    ('{"Time": "2026-06-01T12:00:00", "ANALOG": {"Range1": 0.031}}', "ANALOG.Range1", 2.6),
    ('{"sensors": [{"distance": 9}, {"distance": 0.031}]}', "sensors[1].distance", 2.6),
    # Neither a number, nor JSON, nor of that form, nor a level.
    *((message, path, None) for message, path in (
        ("true", ""), ('"2.31"', ""), ("2,31", ""), ("9" * 400, ""), ("[" * 60_000, ""),
        ('{"level": 2.3}', "depth"), ('{"level": 2.3}', "level.m"), ('{"level": []}', "level[0]"),
        ("NaN", ""), ("-0.01", ""),
    )),
])
def test_what_a_message_reports(
    message: str, path: str, level: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Told(monkeypatch, scale=100.0, offset=-0.5, value=path)
    assert told.tell(message) == STARTING
    assert told.tell(message) == (level, level is None)


def test_what_may_be_old_is_no_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    """A retained message can be a year old. After a silence, as after a suspend for an hour,
    messages within a second may have waited. Another topic is another sensor, even if the broker
    delivers it, as some bridges do.
    """
    told = Told(monkeypatch, max_age=2.0, median=3)
    told.reader._on_disconnect("closed")
    told.reader._on_connect()
    assert told.tell("1.5", retained=True)[0] is None
    for silence in (3.0, 3600.0):
        assert told.tell("3", after=silence)[0] is None
        assert told.tell("3", after=0.9)[0] is None
        assert told.tell("4", after=0.2) == (4.0, False)
        assert told.tell("1", topic="tele/shed/SENSOR", after=0.1) == (4.0, False)
    told.now += 2.1
    assert seen(told.reader) == LOST


def test_at_the_start_a_sensor_is_lost_only_after_its_maximum_age(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """Devices publish every 12 to 30 s; what may be old is ignored without an alarm."""
    told = Told(monkeypatch, max_age=60.0)
    assert told.tell("1", after=1.0, retained=True) == told.tell("2", after=59.0) == STARTING
    assert told.tell("3", after=59.0) == (3.0, False)
    silent = Told(monkeypatch, max_age=60.0)
    silent.now += 59.9
    assert seen(silent.reader) == STARTING
    silent.now += 0.2
    assert seen(silent.reader) == LOST


# Time between two looks of a sensor's node (s), and what they may add to the last rise (mm).
LOOK_S = 0.05
LOOK_MM = 1.01 * LOOK_S * 1e-4 / 0.001
# When (s), and the total (mm); None for a lost connection.
Messages = Sequence[tuple[float, float | None]]


def published(
    monkeypatch: pytest.MonkeyPatch, messages: Messages, until: float, *, high: float = 1e-4,
    spread_s: float = float("inf"),
) -> tuple[float, float, int]:
    """Return the integral of the published rate (mm), its maximum, and the number of refusals.

    Args:
        messages: to a gauge that reports mm, in the order of their arrival.
        until: end of the integral (s).
    """
    now = 0.0
    monkeypatch.setattr(devices.time, "monotonic", lambda: now)
    monkeypatch.setattr(devices, "boot_time", lambda: now)
    sensor = MqttSensor(
        address="mqtt://h/t", scale=0.001, low=0.0, high=high, max_age=60.0, counts=True
    )
    gauge, waiting = Total(sensor, "m/s", spread_s), list(messages)
    sum_m, highest, refused, rate = 0.0, 0.0, 0, 0.0
    for look in range(round(until / LOOK_S)):
        sum_m += rate * (look * LOOK_S - now)
        now = look * LOOK_S
        while waiting and waiting[0][0] <= now:
            _, raw = waiting.pop(0)
            try:
                gauge.sensor_lost() if raw is None else gauge.add(raw)
            except DriveError:
                refused += 1
                gauge.sensor_lost()
        rate = gauge.rate() or 0.0
        highest = max(highest, rate)
    assert not waiting
    return sum_m / 0.001, highest, refused


GAUGE, METER = {"high": 1e-4}, {"high": 0.01, "spread_s": 5.0}
HOUR = 3600


@pytest.mark.parametrize(
    ("sensor", "messages", "within", "risen", "highest", "refused"),
    [
        # The gauge starts again: what fell before and after it counts, the fall does not.
        (GAUGE, [(0, 0.4), (10, 0.6), (20, 0.0), (30, 0.2), (40, 0.4)], 100, 0.6, 1e-4, 0),
        # A new gauge, whose total is far higher: nothing of the jump counts.
        (GAUGE, [(0, 17.0), (10, 17.2), (20, 900.0), (30, 900.0), (40, 900.4)], 100, 0.6, 1e-4, 1),
        # The connection is lost for an hour of rain.
        (GAUGE, [(0, 17.0), (30, 17.2), (31, None), (3630, 57.2), (3660, 57.4)],
         HOUR, 40.4, 1e-4, 0),
        # 5.8 mm in 0.6 s after 10 minutes of drizzle: all is published within about a minute.
        (GAUGE, [(0, 0.0), (600, 0.2), (600.5, 5.0), (600.6, 6.0)], 70, 6.0, 1e-4, 0),
        # A water meter after an outage of an hour shows no flow of long ago: a flow while the pump
        # is stopped looks like a welded contact.
        (METER, [(0, 0.0), (1, 3.0), (2, 6.0), (3600, 9006.0), (3603, 9006.0), (3604, 9009.0)],
         100, 9.0, 0.003, 1),
    ],
)
def test_as_much_is_published_as_the_total_rises(
    monkeypatch: pytest.MonkeyPatch, sensor: dict[str, float], messages: Messages, within: float,
    risen: float, highest: float, refused: int,
) -> None:
    result = published(monkeypatch, messages, messages[-1][0] + within, **sensor)
    assert result[0] == pytest.approx(risen, abs=LOOK_MM if sensor is GAUGE else 0.2)
    assert result[1] <= highest * (1 + 1e-9) and result[2] == refused
