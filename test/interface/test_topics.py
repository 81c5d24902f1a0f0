"""The interface, msg_defs/, compared with ROS 2 and with a live graph."""

from __future__ import annotations

import importlib
import json
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from graphs import Process, wait_for
from paper import VALVE, site_file

from greenroof_ros.base.files import read_yaml, shared_directory
from greenroof_ros.interface.topics import read_topics, recorded_topics


def test_numbers_have_a_display() -> None:
    """Each unit is shown in a related one: m as mm, m/s as mm/h, m3/s as L/min.

    And a reader can lag by more than 32 ticks.
    """
    factors = {
        ("s", "s"): 1, ("m", "mm"): 1e3, ("m/s", "mm/h"): 1e3 * 3600, ("m3/s", "L/min"): 1e3 * 60,
        ("1", ""): 1, ("1", "%"): 100, ("m2", "mm²"): 1e6, ("m3", "m³"): 1, ("degC", "°C"): 1,
    }
    labels = []
    for topic in read_topics().values():
        assert topic.qos.depth > 32 or not topic.per_tick, topic.name
        display = topic.display
        assert (display is None) == (topic.unit == ""), topic.name
        if display is not None:
            assert factors[topic.unit, display.unit] == display.factor, topic.name
            assert display.decimals in range(4), topic.name
            labels.append(display.label)
    assert len(set(labels)) == len(labels)


def test_types_match_ros() -> None:
    """Definitions and hashes in msg_defs/bag.yaml agree with the installed ROS 2."""
    rclpy = pytest.importorskip("rclpy", reason="the message packages come with ROS 2")
    assert rclpy
    types: dict[str, Any] = read_yaml(shared_directory() / "msg_defs" / "bag.yaml")["types"]
    for name, entry in types.items():
        first, *used = entry["definition"].split(f"{'=' * 80}\nMSG: ")
        definitions = {name: first}
        for part in used:
            short_name, _, definition = part.partition("\n")
            definitions[short_name.replace("/", "/msg/")] = definition
        for kind, definition in definitions.items():
            package, _, short = kind.split("/")
            module = importlib.import_module(f"{package}.msg")
            share = next(
                parent / "share" / package / "msg"
                for parent in Path(str(module.__file__)).parents
                if (parent / "share" / package / "msg" / f"{short}.msg").exists()
            )
            text = (share / f"{short}.msg").read_text()
            fields = [line.split("#")[0].split() for line in text.splitlines()]
            assert [line.split() for line in definition.splitlines()] == list(filter(None, fields))
            if kind == name:
                described = json.loads((share / f"{short}.json").read_text())["type_hashes"]
                assert {"type_name": name, "hash_string": entry["hash"]} in described


OUTPUTS = {"/controller/cost": "cost", "/controller/solver_status": "status"}


@pytest.mark.parametrize("valve", [False, True])
def test_live_graph_is_the_interface(domain: int, tmp_path: Path, valve: bool) -> None:
    """The graph has exactly the topics of the interface: types, QoS, nodes."""
    rclpy = pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    from rclpy.node import Node

    process = Process(
        domain, "bringup", "--controller", "mpc", "--speed", "20", "--output", "run",
        *(("--site", str(site_file(tmp_path, **VALVE))) if valve else ()), cwd=tmp_path,
    )
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    node = Node(
        "observer", context=context, start_parameter_services=False, enable_rosout=False
    )
    names = {
        "plant": "plant", "weather": "weather", "controller": "mpc", "recorder": "recorder",
        "alarms": "alarms",
    }
    try:
        process.wait_for_ticks(size=0)
        nodes = set(names.values())
        wait_for(lambda: nodes <= set(node.get_node_names()), 60, "discovery of the nodes")
        interface = {
            name: topic
            for name, topic in read_topics().items()
            if names.keys() & set(topic.publishers)
            and (not topic.optional or name in OUTPUTS) and (valve or not topic.of_valve)
        }
        expected = {
            name: tuple(
                sorted({names[role] for role in roles if role in names})
                for roles in (topic.publishers, topic.subscribers)
            ) for name, topic in interface.items()
        }
        # A simulated pump is a part of the plant, which knows the frost.
        expected["/pump/flow"] = ["plant"], [
            name for name in expected["/pump/flow"][1] if name != "plant"
        ]
        expected["/weather/frost"][1].remove("plant")

        def ends() -> dict[str, tuple[list[str], list[str]]]:
            return {
                name: (
                    sorted(info.node_name for info in node.get_publishers_info_by_topic(name)),
                    sorted(info.node_name for info in node.get_subscriptions_info_by_topic(name)),
                )
                for name, _ in node.get_topic_names_and_types()
                if name not in ("/rosout", "/parameter_events")
            }

        wait_for(lambda: ends() == expected, 60, "discovery of the topics")
        time.sleep(1)  # for a topic too many
        assert ends() == expected
        kinds = dict(node.get_topic_names_and_types())
        for name, topic in interface.items():
            assert kinds[name] == [topic.type]
            publishers = node.get_publishers_info_by_topic(name)
            subscribers = node.get_subscriptions_info_by_topic(name)
            # Other devices may report with any profile.
            for info in publishers if name == "/diagnostics" else [*publishers, *subscribers]:
                profile = info.qos_profile
                assert profile.reliability.name.lower() == topic.qos.reliability
                assert profile.durability.name.lower() == topic.qos.durability
        assert {topic.name for topic in recorded_topics(OUTPUTS, valve)} == {
            name for name, topic in interface.items() if topic.per_tick
        }
    finally:
        node.destroy_node()
        context.try_shutdown()
        process.process.send_signal(signal.SIGINT)
    assert process.wait(300) == 130
