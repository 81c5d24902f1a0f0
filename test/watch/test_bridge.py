"""``greenroof bridge`` beside real runs and a real broker: what it publishes and obeys."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brokers import mosquitto, needs_mosquitto
from commands import run_command
from graphs import Process, environment, free_ports, messages_of, wait_for
from places import guarding
from said import ERROR, SECOND, START, hear, node, store
from simulators import Simulator

from greenroof_ros.common.mqtt import make_client, parse_broker
from greenroof_ros.watch import wire
from greenroof_ros.watch.bridge import alarms_of, state_of
from greenroof_ros.watch.document import document as read_document
from greenroof_ros.watch.home_assistant import discovery
from greenroof_ros.watch.store import Store

pytest.importorskip("paho.mqtt", reason="the bridge needs paho-mqtt")

# From home-assistant.io (integrations sensor, binary_sensor, button, and mqtt, under "MQTT
# Discovery" and "Configuration variables"), read in November 2026: the units that a class of
# sensors may have, and the keys that a message may have.
UNITS = {
    "distance": {"km", "m", "cm", "mm", "mi", "nmi", "yd", "in"},
    "precipitation_intensity": {"in/d", "in/h", "mm/d", "mm/h"},
    "volume_flow_rate": {
        "m³/h", "m³/s", "ft³/min", "L/h", "L/min", "L/s", "gal/min", "mL/s",
    },
    "enum": {None}, "timestamp": {None},
}
BINARY = {"cold", "problem"}
EVERY = {"unique_id", "name", "availability", "device", "origin"}
REQUIRED = {
    "sensor": {"state_topic"}, "binary_sensor": {"state_topic"}, "button": {"command_topic"},
}
OPTIONAL = {
    "sensor": {
        "device_class", "expire_after", "options", "state_class", "unit_of_measurement",
        "value_template",
    },
    "binary_sensor": {"device_class", "expire_after", "json_attributes_topic", "value_template"},
    "button": {"availability_mode", "payload_press"},
}
DEVICE = {"identifiers", "manufacturer", "name", "sw_version"}


class Phone:
    """A client of the broker that keeps all it receives.

    Attributes:
        heard: for each topic the payloads, and whether each was retained.
    """

    def __init__(self, address: str, name: str = "phone") -> None:
        self.heard: defaultdict[str, list[tuple[str, bool]]] = defaultdict(list)
        self._subscribed = threading.Event()
        self._client = make_client(
            parse_broker(address, "broker"), name, self._on_connect, self._on_message
        )
        self._client.loop_start()
        assert self._subscribed.wait(10)

    def _on_connect(self) -> None:
        self._client.subscribe("#", qos=1)
        self._subscribed.set()

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        self.heard[topic].append((payload.decode(), retained))

    def say(self, topic: str, payload: str, retain: bool = False) -> None:
        self._client.publish(topic, payload, qos=1, retain=retain).wait_for_publish(10)

    def last(self, topic: str) -> str:
        return self.heard[topic][-1][0] if self.heard[topic] else ""

    def state(self, site: str = "roof") -> dict[str, Any]:
        return json.loads(self.last(f"greenroof/{site}/state") or "{}")

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@contextmanager
def phone(address: str, name: str = "phone") -> Iterator[Phone]:
    client = Phone(address, name)
    try:
        yield client
    finally:
        client.close()


def end(process: Process) -> None:
    """End a bridge by Ctrl-C; it must end soon and well."""
    begun = time.monotonic()
    process.process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0, process.stderr()
    assert time.monotonic() - begun < 20  # 1 s on an idle machine
    assert "Traceback" not in process.stderr()


# --- what Home Assistant is asked to show ---------------------------------------------------------


def test_discovery_is_what_home_assistant_documents() -> None:
    messages, ids = discovery("site1", "ha"), set()
    for topic, text in messages.items():
        said = json.loads(text)
        match = re.fullmatch(r"ha/(\w+)/([a-zA-Z0-9_-]+)/([a-zA-Z0-9_-]+)/config", topic)
        assert match and match[2] == "greenroof_site1"
        kind = match[1]
        assert EVERY | REQUIRED[kind] <= said.keys() <= EVERY | REQUIRED[kind] | OPTIONAL[kind]
        assert said["device"].keys() == DEVICE and said["origin"].keys() == {"name", "sw_version"}
        assert said["device"]["identifiers"] == ["greenroof_site1"]
        assert said["availability"][0] == {"topic": "greenroof/site1/availability"}
        ids.add(said["unique_id"])
        own = said.get("device_class")
        if kind == "sensor" and own:
            assert said.get("unit_of_measurement") in UNITS[own]
        if kind == "binary_sensor":
            assert own in BINARY
        if own in ("enum", "timestamp"):  # these are not measurements
            assert "state_class" not in said
        if kind == "button":
            assert said["payload_press"] == "STOP"
            assert said["command_topic"] == "greenroof/site1/stop"
        else:
            assert 3 * 10 <= said["expire_after"] <= 60
    assert len(ids) == len(messages) == 13


# --- what is published ----------------------------------------------------------------------------


def state(graph: Store, wall: float = 0.0) -> dict[str, Any]:
    return state_of(graph, read_document(graph, wall))


def test_each_value_has_the_pages_unit_and_what_is_old_is_unknown() -> None:
    graph = store("live")
    hear(graph, 0, 10, {
        "/roof/level": 0.0457, "/cistern/level": 2.5, "/weather/precipitation": 1e-6,
        "/pump/flow": 1e-3, "/pump/command": 0.25, "/weather/frost": 1.0,
    })
    # 12 h: 1 L/s for the hour that begins in 1000 s.
    graph.add_plan(START + 9 * SECOND, np.array([
        [1000.0, 0.0, 0.04], [4600.0, 1e-3, 0.045], [43_200.0, 0.0, 0.04],
    ]), past=False)
    graph.look(0.0, START / SECOND + 10)
    said = state(graph)
    assert {key: said[key] for key in (
        "mode", "roof_level", "cistern_level", "rain", "flow", "command", "frost", "planned_volume",
        "planned_start",
    )} == {
        "mode": "live", "roof_level": 45.7, "cistern_level": 2500, "rain": 3.6, "flow": 60.0,
        "command": 25, "frost": "ON", "planned_volume": 3600,
        "planned_start": "2021-07-20T05:16:49+00:00",
    }
    later = state(graph, 20.0)
    assert {later[key] for key in (
        "roof_level", "cistern_level", "rain", "flow", "command", "frost"
    )} == {None}
    hear(graph, 30, 40, {"/roof/level": 0.0457, "/cistern/level": -1.0})
    assert (state(graph, 20.0)["roof_level"], state(graph, 20.0)["cistern_level"]) == (45.7, None)
    graph.set_present(mode="ended", factor=None, note="")
    said = state(graph, 20.0)
    assert (said["roof_level"], said["pump"], said["problem"]) == (None, "unknown", None)


def test_alarms_are_said_by_code() -> None:
    graph = store("live")
    quiet = node("/pump", "pump", stands=True, pump="off")
    graph.add_statuses(0.0, quiet)
    assert (state(graph)["problem"], state(graph)["condition"]) == ("OFF", "none")
    graph.add_statuses(1.0, node(
        "/pump", "pump", ("pump", ERROR, "held: the levels are not known", "roof_level_unknown"),
        stands=True, pump="held: the levels are not known",
    ))
    said, alarms = state(graph, 1.0), alarms_of(read_document(graph, 1.0))
    assert (said["problem"], said["condition"]) == ("ON", "roof_level_unknown")
    (row,) = alarms["alarms"]
    assert (row["code"], row["level"], row["id"]) == (
        "roof_level_unknown", "error", "/pump: pump"
    )
    assert row["do"] == alarms["advice"]


# --- beside a run ---------------------------------------------------------------------------------


@needs_mosquitto
def test_it_says_what_a_simulated_run_does_and_nothing_can_be_stopped(
    domain: int, tmp_path: Path
) -> None:
    """Its levels are the bag's; an old state is not retained; after a kill it is offline."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    with mosquitto(tmp_path) as broker, phone(broker.address) as heard:
        bridge = Process(domain, "bridge", "--broker", broker.address, cwd=tmp_path)
        run = Process(
            domain, "bringup", "--controller", "lookahead", "--hours", "0.4", "--speed", "30",
            "--cistern", "57", "--roof", "0", "--output", "run", cwd=tmp_path,
        )

        def states() -> list[dict[str, Any]]:
            return [json.loads(text) for text, _ in heard.heard["greenroof/roof/state"]]

        wait_for(
            lambda: heard.state().get("planned_volume") is not None
            and len({state["roof_level"] for state in states()}) > 3, 60, "a plan, and water",
        )
        assert heard.state()["mode"] == "simulated" and not heard.state()["can_stop"]
        assert "pump" in heard.state()["plan"]
        with phone(broker.address, "late") as late:
            wait_for(lambda: late.heard["greenroof/roof/availability"], 10, "what is retained")
            retained = {name for name, said in late.heard.items() if said[0][1]}
            assert retained == {"greenroof/roof/availability", *discovery("roof", "homeassistant")}
        heard.say("greenroof/roof/stop", "STOP")
        bridge.until_said("There is no pump node that could be stopped")
        bridge.process.kill()
        wait_for(
            lambda: heard.last("greenroof/roof/availability") == "offline", 20, "the last will"
        )
        assert run.wait(120) == 0
    recorded = {
        key: {round(value * 1000, places) for message in messages_of(tmp_path / "run")[topic]
              if (value := wire.number(message)) is not None}
        for key, topic, places in (
            ("roof_level", "/roof/level", 1), ("cistern_level", "/cistern/level", 0),
        )
    }
    for key, values in recorded.items():
        assert {state[key] for state in states()} - {None} <= values


@contextmanager
def running_pump(domain: int, cwd: Path) -> Iterator[tuple[Process, Simulator]]:
    """Run a site in the loop, in the namespace site1, until its pump runs."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    pytest.importorskip("pymodbus", reason="drives are on Modbus")
    at, bench = free_ports(2)
    options = ("--drive", guarding("danfoss_fc202", cwd / "drives"), "--speed", "10")
    with Simulator(
        "drive_simulator", *options, "--port", str(at), "--workbench", str(bench)
    ) as drive:
        run = Process(
            domain, "bringup", *options, "--drive-at", drive.address,
            "--controller", "onoff", "--hours", "2", "--namespace", "site1",
            "--cistern", "57", "--roof", "0", "--output", "run", cwd=cwd,
        )
        yield run, drive
        assert run.process.poll() is None
        run.process.send_signal(signal.SIGINT)
        assert run.wait(300) == 130


@needs_mosquitto
def test_a_stop_holds_the_pump_and_a_lost_broker_disturbs_nothing(
    domain: int, tmp_path: Path
) -> None:
    """A retained stop, one in other words, and any other request are ignored."""
    stop, availability = "greenroof/site1/stop", "greenroof/site1/availability"
    with (
        mosquitto(tmp_path) as broker, phone(broker.address) as heard,
        running_pump(domain, tmp_path) as (run, drive),
    ):
        heard.say(stop, "STOP", retain=True)
        bridge = Process(
            domain, "bridge", "--broker", broker.address, "--namespace", "site1", cwd=tmp_path
        )

        def state() -> dict[str, Any]:
            return heard.state("site1")

        bridge.until_said("ignored, since it is retained")
        wait_for(
            lambda: state().get("can_stop") and state()["pump"] == "running"
            and (state()["flow"] or 0.0) > 0, 60, "a running pump, and its flow",
        )
        assert state()["condition"] != "page_stop"
        for wish in ("RELEASE", "", '{"data": false}', "stop"):
            heard.say(stop, wish)
        wait_for(lambda: bridge.stderr().count("it is not STOP") >= 4, 10, "four refusals")
        assert state()["pump"] == "running"
        before = len(heard.heard[availability])
        broker.kill()
        bridge.until_said("not connected to")
        time.sleep(3.0)
        broker.start()
        wait_for(lambda: len(heard.heard[availability]) > before, 30, "the bridge again")
        wait_for(lambda: state()["pump"] == "running", 30, "a running pump")
        assert run.process.poll() is None
        config = next(iter(discovery("site1", "homeassistant")))
        before = len(heard.heard[config])
        heard.say("homeassistant/status", "online")
        wait_for(lambda: len(heard.heard[config]) > before, 10, "the discovery again")
        heard.say(stop, "STOP")
        wait_for(lambda: state()["pump"] == "held", 30, "a pump that is held off")
        assert state()["condition"] == "page_stop"
        wait_for(lambda: drive.speed() < 0.005, 30, "a pump that stands")
        for wish in ("RELEASE", "START", "dose"):
            heard.say(stop, wish)
        time.sleep(3.0)
        assert state()["pump"] == "held"
        end(bridge)
        wait_for(lambda: heard.last(availability) == "offline", 10, "its last word")


# --- the broker -----------------------------------------------------------------------------------


@needs_mosquitto
def test_it_logs_in_over_tls_and_says_once_why_not(domain: int, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    key, certificate, words = (tmp_path / name for name in ("key.pem", "cert.pem", "words"))
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-keyout", key, "-out", certificate, "-subj", "/CN=localhost",
         "-addext", "subjectAltName=DNS:localhost", "-days", "2"],
        check=True, capture_output=True,
    )
    subprocess.run(["mosquitto_passwd", "-b", "-c", words, "roof", "secret"], check=True)
    login = tmp_path / "login.yaml"
    login.write_text("username: roof\npassword: secret\n")
    with mosquitto(
        tmp_path, f"certfile {certificate}", f"keyfile {key}", "allow_anonymous false",
        f"password_file {words}", "user root",  # root reads the test's own files
    ) as broker:
        address = f"mqtts://localhost:{broker.port}"
        options = ("--broker", address, "--authority", str(certificate))
        bridge = Process(domain, "bridge", *options, "--login", str(login), cwd=tmp_path)
        bridge.until_said(f"connected to {address}")
        end(bridge)
        (nobody,) = free_ports(1)
        for wrong, why in (
            (options, "Not authorized"), (("--broker", address), "not connected"),
            (("--broker", f"mqtt://127.0.0.1:{nobody}"), "nobody answers at"),
        ):
            bridge = Process(domain, "bridge", *wrong, cwd=tmp_path)
            bridge.until_said(why)
            assert f"\nconnected to {address}" not in f"\n{bridge.stderr()}"
            time.sleep(2.0)  # it has tried again
            assert bridge.stderr().count(why) == 1
            end(bridge)


def test_wrong_input_is_one_message(unused_domain: int, tmp_path: Path) -> None:
    """For addresses and logins see test_mqtt.py."""
    done = run_command(
        "bridge", "--broker", "mqtt://h", "--prefix", "a/#", cwd=tmp_path,
        env=environment(unused_domain),
    )
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if "error:" in line]
    assert "--prefix = 'a/#': must be letters, digits" in line
    assert "Traceback" not in done.stderr
