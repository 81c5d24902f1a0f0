"""Sensors on Modbus and MQTT: what counts as a reading, and what does not."""

from __future__ import annotations

import getpass
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from itertools import pairwise
from pathlib import Path

import pytest
from brokers import Mosquitto, Talker, mosquitto, needs_mosquitto
from graphs import free_ports
from modbus_wire import Answer, SerialWire, Wire, crc
from simulators import until

from greenroof_ros.live.devices import sensor as devices
from greenroof_ros.live.devices.modbus_line import DriveError, ModbusLine, parse_address
from greenroof_ros.live.devices.sensor import (
    ModbusReader,
    MqttReader,
    Reader,
    SensorLine,
    read_number,
)
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor

TOPIC = "tele/roof/SENSOR"
MAY_BE_OLD = "is sending again, but its first messages may be old"


def sensor(at: str, **changed: object) -> ModbusSensor:
    """A sensor with 0.1 mm per count, up to 6 m, without a filter."""
    values: dict[str, object] = {
        "address": at, "device_id": 1, "register": 16, "kind": "input", "type": "uint16",
        "scale": 1e-4, "low": 0.0, "high": 6.0, "median": 1, "period": 0.05,
    }
    return ModbusSensor(**{**values, **changed})  # type: ignore[arg-type]


def alone(sensor: ModbusSensor, timeout_s: float = 0.2) -> ModbusReader:
    """The reader of a sensor alone on its line: three timeouts are half of the maximum age."""
    return ModbusReader("roof", sensor, SensorLine(), max_age=6 * timeout_s)


def result(reader: Reader) -> float | str:
    now = reader.snapshot
    return now.problem.removeprefix(f"{reader.sensor}: ") or now.value or 0.0


def word(data: str) -> bytes:
    """Return the rest of an answer to function 04, after the first four bytes of the request."""
    return bytes.fromhex("0005 01 04 02" + data)


def levels(readings: list[str], **changed: object) -> list[float | str]:
    """Return the result of each answer: levels, or the problem reported instead."""
    remaining = list(readings)

    def answer(request: bytes) -> Answer:
        if not remaining:
            return []
        assert request[7] == (4 if changed.get("kind", "input") == "input" else 3)
        data = bytes.fromhex(remaining.pop(0))
        body = bytes([request[6], request[7], len(data)]) + data
        return [(0.0, request[:4] + len(body).to_bytes(2, "big") + body)]

    results: list[float | str] = []
    with closing(Wire(answer)) as wire, closing(alone(sensor(wire.at, **changed), 0.3)) as reader:
        before = reader.snapshot.read_at
        reader.start()
        while len(results) < len(readings):
            if (now := reader.snapshot).read_at > before:
                results.append(result(reader))
            before = now.read_at
            time.sleep(0.001)
    return results


# --- Modbus ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "changed", "level"),
    [
        ("0BB8", {"scale": 0.001, "offset": -0.5, "kind": "holding"}, 2.5),
        ("FF9C", {"type": "int16", "scale": 0.01, "offset": 3.0}, 2.0),  # -100
        ("0000 4020", {"type": "float32", "word_order": "low first", "scale": 1.0}, 2.5),
        ("8000 0000 0000 0000",
         {"type": "uint64", "word_order": "high first", "missing": 2**63},
         "reports 0x8000000000000000, which means 'no reading'"),
        # A value that cannot be a level is refused with the reason.
        ("EA61", {}, "reports 6.0001 m (raw 60001), which is not from 0 to 6 m"),
        ("7FC0 0000", {"type": "float32", "word_order": "high first", "scale": 1.0},
         "reports nan, which is not a number"),
    ],
)
def test_scale_offset_type_and_word_order(
    data: str, changed: dict[str, object], level: float | str
) -> None:
    (result,) = levels([data], **changed)
    assert result == (level if isinstance(level, str) else pytest.approx(level))


def test_the_median_leaves_single_wrong_readings_out_and_starts_again_after_a_refused_one() -> None:
    """Of three: 1, 1 (of 1, 9: the lower), 1, 2 | 3 alone, then 3 (of 3, 4)."""
    data = ["2710", "EA60", "2710", "4E20", "FFFF", "7530", "9C40"]  # 1, 6, 1, 2, -, 3, 4 m
    no_reading = "reports 0xFFFF, which means 'no reading'"
    assert levels(data, median=3, missing=0xFFFF) == [1.0, 1.0, 1.0, 2.0, no_reading, 3.0, 3.0]


def test_a_sensor_that_comes_and_goes_is_read_while_it_is_there() -> None:
    port = free_ports(1)[0]
    with closing(alone(sensor(f"tcp://127.0.0.1:{port}"))) as reader:
        reader.start()
        for _ in range(2):
            until(lambda: "cannot connect" in reader.snapshot.problem)
            assert reader.snapshot.value is None
            with closing(Wire(lambda request: [(0.0, request[:4] + word("2710"))], port=port)):
                until(lambda: reader.snapshot.value == 1.0)
                assert reader.snapshot.problem == ""


def test_a_reading_of_long_ago_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither if the reading hangs, nor after a suspend of the machine."""
    now = 1000.0
    monkeypatch.setattr(devices, "boot_time", lambda: now)
    reader = ModbusReader("roof", sensor("tcp://h", median=3), SensorLine(), max_age=5.0)
    for raw in (10_000, 10_000):
        reader.add(raw)
    now += 4.9
    assert reader.snapshot.value == 1.0
    now += 0.2
    assert result(reader) == "has sent nothing for 5 s" and reader.snapshot.value is None
    reader.add(10_000)
    now += 3600.0
    reader.add(40_000)
    assert reader.snapshot.value == 4.0


def test_no_error_ends_the_reading_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that no one expects is reported, and the sensor is tried again."""
    monkeypatch.setattr(ModbusLine, "connect", lambda line: 1 / 0)
    with closing(alone(sensor("tcp://127.0.0.1:502"))) as reader:
        reader.start()
        until(lambda: "reading failed: Zero" in reader.snapshot.problem)
        first = reader.snapshot
        assert first.value is None
        until(lambda: reader.snapshot.read_at > first.read_at)


# --- several on one line --------------------------------------------------------------------------


class TwoSensors:
    """The other end of a serial line with the devices 1 and 2, at 1.0 m and 3.0 m."""

    def __init__(self) -> None:
        self.data = {1: "2710", 2: "7530"}

    def __call__(self, request: bytes) -> bytes:
        if not (data := bytes.fromhex(self.data[request[0]])):
            return b""
        frame = bytes([request[0], 4, len(data)]) + data
        return frame + crc(frame)


@contextmanager
def both(at: str, **changed: tuple[int, int]) -> Iterator[list[ModbusReader]]:
    """Start the readers of two sensors on one line, the first of which is due far more often."""
    line = SensorLine()
    readers = [
        ModbusReader("roof", sensor(at, period=period, **{
            key: values[number] for key, values in changed.items()
        }), line, 3.0)
        for number, period in enumerate((0.05, 0.2))
    ]
    for reader in readers:
        reader.start()
    with closing(readers[0]), closing(readers[1]):
        until(lambda: all(reader.snapshot.value or reader.snapshot.problem for reader in readers))
        yield readers


def gaps(reader: ModbusReader, seconds: float) -> list[float]:
    """Return the times between the good readings of the next seconds; all must be 3.0 m."""
    began, times = time.monotonic(), list[float]()
    newest = reader.snapshot.read_at
    while time.monotonic() - began < seconds:
        now = reader.snapshot
        if not now.problem and now.read_at > newest:
            assert now.value == 3.0
            times.append(time.monotonic())
            newest = now.read_at
        time.sleep(0.005)
    return [after - before for before, after in pairwise([began, *times, time.monotonic()])]


def test_a_sensor_next_to_a_silent_or_wrong_one_on_a_serial_line() -> None:
    """Readings of the good one are never further apart than its maximum age, 3 s, in any case.

    For a silent neighbour they come after at most its period and three timeouts, 0.2 + 0.75 s.
    Nothing else can open the line, neither a drive nor another program.
    """
    devices = TwoSensors()
    with closing(SerialWire(devices)) as wire, both(wire.line, device_id=(1, 2)) as (first, second):
        assert (first.snapshot.value, second.snapshot.value) == (1.0, 3.0)
        with pytest.raises(DriveError, match="cannot connect"):
            ModbusLine(parse_address(wire.line), sensor(wire.line).serial, 0.2).connect()
        for data, problem in (
            ("", "no valid response within 0.25 s"), ("FFFF", "which is not from 0 to 6 m"),
            ("27102710", "the response does not fit"),
        ):
            devices.data[1] = data
            until(lambda problem=problem: problem in first.snapshot.problem)
            assert first.snapshot.value is None
            apart = gaps(second, 3.0)
            assert max(apart) < 3.0 and sorted(apart)[len(apart) // 2] < 1.2, data
        devices.data[1] = "2710"
        until(lambda: first.snapshot.value == 1.0)
        assert second.snapshot.value == 3.0


@pytest.mark.parametrize("late_s", [0.3, 0.6])
def test_a_late_answer_is_no_value_of_the_next_register(late_s: float) -> None:
    """Two channels of one device, at 1.0 m and 3.0 m, behind a gateway.

    It gives a late answer the number of the request that it received last.
    """
    data, wait_s, newest = {16: "2710", 17: "7530"}, 0.0, b""

    def answer(request: bytes) -> Answer:
        nonlocal newest
        newest = request

        def send() -> None:
            with suppress(OSError, IndexError):
                wire.newest.sendall(newest[:4] + word(data[request[9]]))

        threading.Timer(wait_s, send).start()
        return []

    with closing(Wire(answer)) as wire, both(wire.gateway, register=(16, 17)) as readers:
        assert [reader.snapshot.value for reader in readers] == [1.0, 3.0]
        assert wire.connections == 1
        wait_s = late_s
        until(lambda: all("no valid" in reader.snapshot.problem for reader in readers))
        end = time.monotonic() + 2.0
        while time.monotonic() < end:
            assert readers[0].snapshot.value in (None, 1.0)
            assert readers[1].snapshot.value in (None, 3.0)
            time.sleep(0.01)


# --- MQTT, with a real broker ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    with mosquitto(tmp_path_factory.mktemp("broker")) as broker:
        yield broker


def sensor_at(address: str, **changed: object) -> MqttSensor:
    """Return a sensor that publishes metres, up to 6 m, without a filter."""
    values: dict[str, object] = {
        "address": address, "scale": 1.0, "low": 0.0, "high": 6.0, "median": 1, "max_age": 30.0,
    }
    return MqttSensor(**{**values, **changed})  # type: ignore[arg-type]


@contextmanager
def reading(broker: Mosquitto, **changed: object) -> Iterator[MqttReader]:
    """Subscribe to a sensor."""
    sensor = sensor_at(f"{broker.address}/{TOPIC}", **changed)
    with closing(MqttReader("roof", sensor)) as reader:
        reader.start()
        until(lambda: "has sent nothing yet" in reader.snapshot.problem, 20)
        yield reader


def after(reader: MqttReader, talker: Talker, *messages: str) -> list[float | str]:
    """Return the result of each message: the value, or the problem that is reported instead."""
    results = []
    for message in messages:
        before = reader.snapshot.read_at
        talker.publish(TOPIC, message)
        until(lambda before=before: reader.snapshot.read_at > before, 20)
        results.append(result(reader))
    return results


def begin(reader: MqttReader, talker: Talker, message: str) -> None:
    """Repeat a message until it counts: subscribing takes a moment, and the first may be old."""
    before = reader.snapshot.read_at

    def is_heard() -> bool:
        talker.publish(TOPIC, message)
        time.sleep(0.05)
        return reader.snapshot.read_at > before and MAY_BE_OLD not in reader.snapshot.problem

    until(is_heard, 20)
    time.sleep(0.1)  # lets pending messages arrive


@pytest.mark.parametrize(("message", "path", "expected"), [
    ("2.31", "", 2.31),
    (" 2310\n", "", 2310),
    # A Tasmota message, and one from a gateway with several sensors.
    ('{"Time": "2026-06-01T12:00:00", "ANALOG": {"Range1": 1234}}', "ANALOG.Range1", 1234),
    ('{"sensors": [{"distance": 9}, {"distance": 350}]}', "sensors[1].distance", 350),
    # Neither a number, nor JSON, nor of that form.
    *((message, path, None) for message, path in (
        ("true", ""), ('"2.31"', ""), ("2,31", ""), ("9" * 400, ""), ("[" * 60_000, ""),
        ('{"level": 2.3}', "depth"), ('{"level": 2.3}', "level.m"), ('{"level": []}', "level[0]"),
    )),
])
def test_the_number_in_a_message(message: str, path: str, expected: float | None) -> None:
    if expected is not None:
        assert read_number(message.encode(), path) == expected
        return
    with pytest.raises(DriveError, match=f"which has no number{path and ' at '}"):
        read_number(message.encode(), path)


@needs_mosquitto
def test_what_a_message_reports(shared: Mosquitto) -> None:
    """Another topic is another sensor, even if the broker delivers it, as some bridges do."""
    with reading(shared, scale=100.0, offset=-0.5) as reader, Talker(shared) as talker:
        begin(reader, talker, "no JSON")
        assert after(reader, talker, "0.02", "NaN", "1e308", "-0.01", "[]") == [
            1.5, "reports nan, which is not a number", "reports 1e+308, which is not a number",
            "reports -1.5 m (raw -0.01), which is not from 0 to 6 m",
            "reports b'[]', which has no number",
        ]
        assert reader.snapshot.value is None
        reader._client.subscribe("tele/shed/SENSOR")
        after(reader, talker, "0.03")
        with Talker(shared, "tele/shed/SENSOR") as shed:
            shed.publish("tele/shed/SENSOR", "0.04")
            until(lambda: any(message == "0.04" for *_, message, _ in shed.received), 20)
        time.sleep(0.2)  # it would have arrived
        assert reader.snapshot.value == pytest.approx(2.5)


@needs_mosquitto
def test_what_the_broker_kept_is_no_reading(shared: Mosquitto) -> None:
    """A retained message can be a year old; a live one counts, with any retain flag."""
    with Talker(shared) as talker:
        talker.publish(TOPIC, "1.5", retain=True)
        with reading(shared) as reader:
            until(lambda: "the retained message may be old" in reader.snapshot.problem, 20)
            assert reader.snapshot.value is None
            begin(reader, talker, "1.7")
            talker.publish(TOPIC, "1.6", retain=True)
            until(lambda: reader.snapshot.value == 1.6, 20)
        talker.publish(TOPIC, "", retain=True)


@needs_mosquitto
def test_a_sensor_that_reports_nothing_is_lost(
    shared: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a silence, as after a suspend for an hour, messages within a second may be old."""
    with reading(shared, max_age=0.5, median=3) as reader, Talker(shared) as talker:
        begin(reader, talker, "1")
        talker.publish(TOPIC, "1")
        until(lambda: reader.snapshot.value == 1.0, 20)
        lasted = until(lambda: reader.snapshot.value is None, 20)
        assert 0.3 < lasted < 2.0
        assert result(reader) == "has sent nothing for 0.5 s"
        assert after(reader, talker, "3") == [MAY_BE_OLD]
        begin(reader, talker, "3")
        monkeypatch.setattr(
            devices, "boot_time", lambda: time.clock_gettime(time.CLOCK_BOOTTIME) + 3600.0
        )
        assert after(reader, talker, "3") == [MAY_BE_OLD]
        begin(reader, talker, "4")
        assert reader.snapshot.value == 4.0


@needs_mosquitto
def test_a_broker_that_comes_or_is_killed_or_stops_answering_is_used(tmp_path: Path) -> None:
    """A lost connection is reported at once, a broker that hangs within 15 s."""
    with mosquitto(tmp_path) as broker, closing(MqttReader(
        "roof", sensor_at(f"{broker.address}/{TOPIC}", max_age=1.0)
    )) as reader:

        def talk(message: str) -> None:
            until(lambda: reader.snapshot.code == "sensor_lost", 20)
            with Talker(broker) as talker:
                begin(reader, talker, message)
                talker.publish(TOPIC, message)
                until(lambda: reader.snapshot.value == float(message), 20)

        broker.kill()
        reader.start()
        until(lambda: "no response from" in reader.snapshot.problem, 20)
        assert reader.snapshot.code == "broker_lost"
        broker.start()
        talk("1")
        broker.kill()
        until(lambda: reader.snapshot.code == "broker_lost" and reader.snapshot.problem, 10)
        assert reader.snapshot.value is None
        broker.start()
        talk("2")
        broker.pause()
        until(lambda: "has sent nothing for 1 s" in reader.snapshot.problem, 5)
        until(lambda: reader.snapshot.code == "broker_lost" and reader.snapshot.problem, 15)
        broker.resume()
        talk("3")


@needs_mosquitto
@pytest.mark.skipif(shutil.which("openssl") is None, reason="there is no openssl here")
def test_why_a_broker_cannot_be_used_is_reported(tmp_path: Path) -> None:
    """An unknown certificate, another host's, TLS on one side only, a wrong password."""
    files = certificate, key, login, users = [
        tmp_path / name for name in ("c.pem", "k.pem", "login.yaml", "users")
    ]
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out",
         certificate, "-subj", "/CN=x", "-addext", "subjectAltName=DNS:elsewhere"],
        check=True, capture_output=True,
    )
    login.write_text("username: a\npassword: wrong\n")
    users.write_text("")
    for file in files:
        file.chmod(0o600)
    user = f"user {getpass.getuser()}"
    open_to_all = ("allow_anonymous true", user)
    secret = (*open_to_all, f"certfile {certificate}", f"keyfile {key}")
    strict = ("allow_anonymous false", user, f"password_file {users}")
    for lines, scheme, changed, why in (
        (secret, "mqtts", {}, "verify failed: self-signed certificate"),
        (secret, "mqtts", {"authority": str(certificate)}, "verify failed: IP address mismatch"),
        (secret, "mqtt", {}, "if it expects TLS, use mqtts://"),
        (open_to_all, "mqtts", {}, "no response over TLS from mqtts://"),
        (strict, "mqtt", {"login": str(login)}, "Not authorized"),
    ):
        with mosquitto(tmp_path, *lines) as broker:
            address = f"{scheme}://127.0.0.1:{broker.port}/x"
            with closing(MqttReader("cistern", sensor_at(address, **changed))) as reader:
                reader.start()
                until(lambda why=why, reader=reader: why in reader.snapshot.problem, 10)
