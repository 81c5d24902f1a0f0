"""The interface, msg_defs/, compared with ROS 2 and with a live graph."""

from __future__ import annotations

import importlib
import json
import signal
from pathlib import Path
from typing import Any

import pytest
from graphs import Process
from paper import VALVE, site_file

from greenroof_ros.base.files import read_yaml, shared_directory
from greenroof_ros.interface.topics import read_topics, recorded_topics
from greenroof_ros.site.file import read_site


def test_numbers_have_a_display() -> None:
    """Each unit is shown in a related one: m as mm, m/s as mm/h, m3/s as L/min.

    And a reader can lag by more than 32 ticks.
    """
    factors = {
        ("s", "s"): 1, ("m", "mm"): 1e3, ("m/s", "mm/h"): 1e3 * 3600, ("m3/s", "L/min"): 1e3 * 60,
        ("1", ""): 1, ("1", "%"): 100, ("m2", "mm²"): 1e6, ("m3", "m³"): 1, ("degC", "°C"): 1,
    }
    for topic in read_topics().values():
        assert topic.qos.depth > 32 or not topic.per_tick, topic.name
        display = topic.display
        assert (display is None) == (topic.unit == ""), topic.name
        if display is not None:
            assert factors[topic.unit, display.unit] == display.factor, topic.name


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


@pytest.mark.parametrize("changes", [{}, VALVE | {"other_demand": 120}])
def test_live_graph_is_the_interface(
    domain: int, tmp_path: Path, request: pytest.FixtureRequest, changes: dict[str, Any]
) -> None:
    """The graph has exactly the topics of the interface, with their types and publishers."""
    pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    observer = request.getfixturevalue("observer")
    file = site_file(tmp_path, **changes)
    site = read_site(file)
    process = Process(
        domain, "bringup", "--controller", "mpc", "--speed", "20", "--output", "run",
        "--site", str(file), cwd=tmp_path,
    )
    names = {
        "plant": "plant", "weather": "weather", "controller": "mpc", "recorder": "recorder",
        "alarms": "alarms",
    }
    outputs = "/controller/cost", "/controller/solver_status"
    expected = {
        name: ([topic.type], sorted(names[role] for role in topic.publishers if role in names))
        for name, topic in read_topics().items() if names.keys() & {*topic.publishers}
        and (not topic.optional or name in outputs) and (
            not topic.needs or getattr(site, topic.needs)
        )
    }
    expected["/pump/flow"] = (expected["/pump/flow"][0], ["plant"])  # without a pump node

    def found() -> dict[str, tuple[list[str], list[str]]]:
        return {
            name: (kinds, sorted(
                info.node_name for info in observer.node.get_publishers_info_by_topic(name)
            ))
            for name, kinds in observer.node.get_topic_names_and_types()
            if name not in ("/rosout", "/parameter_events")
        }

    observer.until(lambda: found() == expected, 120, "the topics")
    process.process.send_signal(signal.SIGINT)
    assert process.wait(300) == 130
    recorded = {topic.name for topic in recorded_topics(dict.fromkeys(outputs, ""), site)}
    assert recorded == {name for name in expected if read_topics()[name].per_tick}
