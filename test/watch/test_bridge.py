"""``greenroof bridge`` next to real runs and a real broker: what it publishes and obeys."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import pytest
from brokers import Talker, mosquitto, needs_mosquitto
from graphs import Process, wait_for
from page_inputs import SECOND, START, add_plan, add_values, alarm, fail, running, store, valve
from test_watch_command import running_pump

from greenroof_ros.base.mqtt import parse_broker
from greenroof_ros.base.standard_error import LINES
from greenroof_ros.watch.bridge import BUTTONS, Bridge, make_alarms, make_discovery, make_state
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import RequestError
from greenroof_ros.watch.store import GraphStore

pytest.importorskip("paho.mqtt", reason="the bridge needs paho-mqtt")

# From home-assistant.io (integration sensor), read in November 2026: the units of its classes.
UNITS = {
    "distance": "mm", "precipitation_intensity": "mm/h", "volume_flow_rate": "L/min", "enum": None,
}


def test_discovery_is_what_home_assistant_documents() -> None:
    messages = make_discovery("site1", [*BUTTONS])
    for topic, text in messages.items():
        said = json.loads(text)
        match = re.fullmatch(r"homeassistant/(\w+)/greenroof_site1/(\w+)/config", topic)
        assert match and said["unique_id"] == f"greenroof_site1_{match[2]}"
        assert said["availability"] == [{"topic": "greenroof/site1/availability"}]
        if match[1] == "button":
            assert said["command_topic"] == f"greenroof/site1/{said['payload_press'].lower()}"
        elif (own := said.get("device_class")) in UNITS:
            assert said.get("unit_of_measurement") == UNITS[own]
            assert ("state_class" in said) == (own != "enum") and 30 <= said["expire_after"] <= 60
    assert (len(messages), len(make_discovery("site1"))) == (14, 11)


# --- what is published ----------------------------------------------------------------------------


def state(graph: GraphStore, steady: float = 100.0) -> dict[str, Any]:
    return make_state(make_document(graph, steady))


def test_a_bridge_that_starts_after_the_end_of_a_site_tells_of_the_problem() -> None:
    graph = GraphStore()
    assert state(graph)["problem"] is None  # nothing has been here
    graph.seen_at = START / SECOND
    assert state(graph)["problem"] == "ON"


def test_each_value_has_the_pages_unit_and_what_is_old_is_unknown() -> None:
    graph = store("live")
    add_values(graph, 0, 10, {
        "/roof/level": 0.0457, "/cistern/level": 2.5, "/weather/precipitation": 1e-6,
        "/pump/flow": 1e-3, "/pump/command": 0.25, "/weather/frost": 1.0,
    })
    add_plan(graph, 9, (1000.0, 0.0, 0.04), (4600.0, 1e-3, 0.045))
    graph.system = START / SECOND + 10
    assert state(graph) | {"plan": ""} == {
        "plan": "",
        "mode": "live", "roof_level": 45.7, "cistern_level": 2500, "rain": 3.6, "flow": 60.0,
        "command": 25, "frost": "ON", "pump": "unknown", "condition": "none", "problem": "OFF",
    }
    graph.add_statuses(100.0, 0, valve("open: as commanded"))
    assert state(graph)["valve"] == "open"
    numbers = "roof_level", "cistern_level", "rain", "flow", "command", "frost"
    assert {state(graph, 161.0)[key] for key in numbers} == {None}
    assert state(graph, 161.0)["condition"] == "unknown"  # the alarms are old, too
    held = alarm("/pump: pump", "pump", "roof_level_unknown", "held: the levels are unknown")
    graph.add_alarms(100.0, [held])
    said, alarms = state(graph), make_alarms(make_document(graph, 100.0))
    assert (said["problem"], said["condition"]) == ("ON", "roof_level_unknown")
    assert [row["do"] for row in alarms["alarms"]] == [alarms["advice"]]


# --- next to a run --------------------------------------------------------------------------------


@needs_mosquitto
def test_a_stop_holds_the_pump_and_a_lost_broker_disturbs_nothing(
    domain: int, tmp_path: Path
) -> None:
    """A retained stop and any other request are ignored. After a kill it is offline."""
    stop, availability = "greenroof/site1/stop", "greenroof/site1/availability"
    with (
        mosquitto(tmp_path) as broker, Talker(broker) as heard,
        # At less than full flow, so that it still runs after the broker was lost.
        running_pump(domain, tmp_path, "--fraction", "0.4") as (_, drive),
    ):
        def state() -> dict[str, Any]:
            return json.loads(heard.last("greenroof/site1/state") or "{}")

        heard.publish(stop, "STOP", retain=True)
        bridge = Process(
            domain, "bridge", "--broker", broker.address, "--namespace", "site1", cwd=tmp_path
        )
        bridge.until_printed("must be STOP, and not retained")  # the retained one
        wait_for(lambda: state().get("pump") == "running" and state()["flow"], 60, "a running pump")
        with Talker(broker) as late:
            wait_for(lambda: late.of("greenroof/site1/state"), 60, "a state")
            retained = {topic for _, topic, _, retained in late.received if retained}
            assert retained == {stop, availability, *make_discovery("site1")}
        for wish in ("RELEASE", "", '{"data": false}', "stop"):
            heard.publish(stop, wish)
        broker.kill()
        bridge.until_printed("not connected to")
        broker.start()
        before = len(heard.of(availability))
        wait_for(lambda: len(heard.of(availability)) > before, 60, "the bridge again")
        wait_for(lambda: state()["pump"] == "running", 60, "a running pump")
        # Sent retained while the bridge is connected, it is a stop like any other.
        heard.publish(stop, "STOP", retain=True)
        wait_for(lambda: drive.speed() < 0.005, 60, "a pump that stands")
        wait_for(lambda: state()["condition"] == "hold", 60, "the hold as its condition")
        bridge.process.kill()
        wait_for(lambda: heard.last(availability) == "offline", 60, "the last will")


@needs_mosquitto
def test_a_stop_is_requested_until_it_is_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Whatever fails, even if nothing can be published; a refusal is reported, not repeated.

    Nor is a request to open the valve.
    """
    answers = [
        RequestError("no valve node"), RequestError("no pump node"), ZeroDivisionError("a bug"),
        RequestError("the disk is full", answered=True), RequestError("no answer"),
    ]

    def request_action(*_: Any, **__: Any) -> str:
        if answers:
            raise answers.pop(0)
        return "held"

    monkeypatch.setattr(LINES, "_kinds", {})  # nothing was printed in the last minute
    monkeypatch.setattr("greenroof_ros.watch.bridge._POLL_S", 0.05)
    monkeypatch.setattr("greenroof_ros.watch.bridge.make_document", fail)
    monkeypatch.setattr(Feed, "request_action", request_action)
    graph = store("live")
    with (
        mosquitto(tmp_path) as broker, Talker(broker) as heard,
        running(Bridge(graph, Feed(graph), parse_broker(broker.address, "broker"), True).run),
    ):
        wait_for(lambda: heard.last("greenroof/roof/availability"), 60, "a message")
        for name, left in (("valve_open", 4), ("stop", 1), ("valve_close", 0)):
            heard.publish(f"greenroof/roof/{name}", name.upper())
            wait_for(lambda left=left: len(answers) == left, 60, "an answer")
            time.sleep(0.5)
            assert len(answers) == left
    said = capfd.readouterr().err
    assert "MQTT: no pump node" in said and "MQTT: the disk is full" in said
    assert "MQTT: held" in said and "ZeroDivisionError: a bug" in said
