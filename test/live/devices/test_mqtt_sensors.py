"""Sensors on MQTT, with a real broker: what is treated as a reading, and what is not.

Login and encryption are the client's, for sensors, relays and the bridge: see watch/test_bridge.py.
Totals are in test_total.py, and with a broker in test_sensor_node.py.
"""

from __future__ import annotations

import getpass
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from brokers import Mosquitto, Talker, mosquitto, needs_mosquitto
from simulators import until

from greenroof_ros.live.devices import sensor as devices
from greenroof_ros.live.devices.sensor import MqttReader, read_number
from greenroof_ros.live.devices.sensor_file import MqttSensor

pytestmark = needs_mosquitto
TOPIC = "tele/roof/SENSOR"
MAY_BE_OLD = "is sending again, but its first messages may be old"


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
    with closing(MqttReader("roof_sensor", sensor, "m")) as reader:
        assert reader.snapshot.problem.endswith("not yet connected")
        reader.start()
        until(lambda: reader.snapshot.code == "sensor_lost", 20)
        yield reader


def after(reader: MqttReader, talker: Talker, *messages: str) -> list[float | str | None]:
    """Return the result of each message: the value, or the problem that is reported instead."""
    results: list[float | str | None] = []
    for message in messages:
        before = reader.snapshot
        talker.publish(TOPIC, message)
        until(lambda before=before: reader.snapshot is not before, 20)
        now = reader.snapshot
        results.append(now.problem.rpartition(f"{TOPIC}: ")[2] or now.value)
    return results


def begin(reader: MqttReader, talker: Talker, message: str) -> None:
    """Repeat a message until it counts: subscribing takes a moment, and the first may be old."""
    before = reader.snapshot

    def is_heard() -> bool:
        talker.publish(TOPIC, message)
        time.sleep(0.05)
        return reader.snapshot is not before and "may be old" not in reader.snapshot.problem

    until(is_heard, 20)
    time.sleep(0.1)  # lets pending messages arrive


# --- a message ------------------------------------------------------------------------------------

# By the message and the place of the value in it: the number, or the problem.
MESSAGES: list[tuple[str, str, float | str]] = [
    ("2.31", "", 2.31),
    (" 2310\n", "", 2310),
    # A Tasmota message, and one from a gateway with several sensors.
    ('{"Time": "2026-06-01T12:00:00", "ANALOG": {"Range1": 1234}}', "ANALOG.Range1", 1234),
    ('{"sensors": [{"distance": 9}, {"distance": 350}]}', "sensors[1].distance", 350),
    ("[[1, 2], [3, 4]]", "[1][0]", 3),
    # Numbers as text, and numbers that JSON does not know.
    ('"317.3988"', "", 317.3988),
    ("00317.3988", "", 317.3988),
    (".5", "", 0.5),
    ("5.", "", 5.0),
    ('{"level": " +02.5e-1 "}', "level", 0.25),
    # Not a number.
    ("true", "", "reports 'True', which is not a number"),
    ('{"level": "0x2"}', "level", "reports '0x2', which is not a number"),
    ('"1_0"', "", "reports '1_0', which is not a number"),
    ('"' + "9" * 400 + '"', "", "reports a number that is too large"),
    ("9" * 400, "", "reports a number that is too large"),
    # Malformed, or of another form.
    ("2,31", "", "reports b'2,31', which is not JSON"),
    ('{"level": 2.3}', "depth", "reports b'{\"level\": 2.3}', which does not contain depth"),
    ('{"level": 2.3}', "level.m", "reports b'{\"level\": 2.3}', which does not contain level.m"),
    ('{"level": []}', "level[0]", "reports b'{\"level\": []}', which does not contain level[0]"),
    ("[" * 60_000, "", f"reports {b'[' * 40!r}, which is not JSON"),
    ("1" + " " * 65_536, "", "a message has 65537 bytes, but the limit is 65536"),
]


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
            reader = MqttReader("cistern", sensor_at(address, **changed), "m")
            with closing(reader):
                reader.start()
                until(lambda why=why, reader=reader: why in reader.snapshot.problem, 10)


@pytest.mark.parametrize(("message", "value", "expected"), MESSAGES)
def test_the_number_in_a_message(message: str, value: str, expected: float | str) -> None:
    try:
        result: float | str = read_number(message.encode(), sensor_at("mqtt://h/t", value=value))
    except ValueError as error:
        result = str(error)
    assert result == expected


def test_what_a_message_reports(shared: Mosquitto) -> None:
    with reading(shared, scale=100.0, offset=-0.5) as reader, Talker(shared) as talker:
        begin(reader, talker, "no JSON")
        assert after(reader, talker, "0.02", "NaN", "1e308", "-0.01", "[]") == [
            1.5, "reports nan, which is not a number", "reports 1e+308, which is not a number",
            "reports -1.5 m (raw -0.01), which is not from 0 to 6 m",
            "reports '[]', which is not a number",
        ]
        assert reader.snapshot.value is None


def test_another_topic_is_another_sensor(shared: Mosquitto) -> None:
    """Even if the broker delivers it, as some bridges of brokers do."""
    with reading(shared) as reader, Talker(shared, "tele/shed/SENSOR") as talker:
        reader._client.subscribe("tele/shed/SENSOR")
        begin(reader, talker, "1.5")
        talker.publish("tele/shed/SENSOR", "2.5")
        until(lambda: any(message == "2.5" for *_, message, _ in talker.received), 20)
        time.sleep(0.2)  # it would have arrived
        assert reader.snapshot.value == 1.5


# --- old messages ---------------------------------------------------------------------------------


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


def test_a_sensor_that_reports_nothing_is_lost(shared: Mosquitto) -> None:
    with reading(shared, max_age=0.5) as reader, Talker(shared) as talker:
        begin(reader, talker, "1")
        talker.publish(TOPIC, "2")
        until(lambda: reader.snapshot.value == 2.0, 20)
        lasted = until(lambda: reader.snapshot.value is None, 20)
        assert 0.3 < lasted < 2.0
        assert reader.snapshot.problem.endswith(f"{TOPIC}: has sent nothing for 0.5 s")
        assert after(reader, talker, "3") == [MAY_BE_OLD]
        begin(reader, talker, "3")
        assert reader.snapshot.value == 3.0


def test_nothing_of_before_a_suspend_counts_after_it(
    shared: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The machine was suspended for an hour: messages within a second after it may be old."""
    slept = 0.0
    monkeypatch.setattr(devices, "suspended_time", lambda: slept)
    with reading(shared, median=3) as reader, Talker(shared) as talker:
        begin(reader, talker, "1")
        assert after(reader, talker, "1") == [1.0]
        slept = 3600.0
        assert after(reader, talker, "1") == [MAY_BE_OLD]
        time.sleep(1.1)
        assert after(reader, talker, "4", "5") == [4.0, 4.0]


# --- whether sensor and broker are there ----------------------------------------------------------


def test_a_broker_that_comes_or_is_killed_or_stops_answering_is_used(tmp_path: Path) -> None:
    """A lost connection is reported at once, a broker that hangs within 15 s."""
    with mosquitto(tmp_path) as broker, closing(MqttReader(
        "roof_sensor", sensor_at(f"{broker.address}/{TOPIC}", max_age=1.0), "m",
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
