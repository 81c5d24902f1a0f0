"""``--help`` of each node: nothing is started, and what it says is what the started node has."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bag_topics import MPC_TOPICS
from commands import run_command
from graphs import environment, wait_for
from mcap.reader import make_reader
from places import CONFIG
from rcl_interfaces.srv import DescribeParameters, ListParameters
from rclpy.node import NodeNameNonExistentError
from ros_rig import Observer

from greenroof_ros.common.interface import read_topics


def help_of(cwd: Path, command: str) -> str:
    """Return a node's help, which starts nothing: after domain 232 no node can be made."""
    done = run_command(*f"nodes.{command} --help".split(), cwd=cwd, env=environment(1000))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"usage: python -m greenroof_ros.nodes.{command.split()[0]} ")
    assert list(cwd.iterdir()) == []  # the recorder makes no bag
    return done.stdout


def section(text: str, heading: str) -> dict[str, str]:
    """Return the entries of a section of a help, each with its explanation on one line."""
    found = re.search(rf"^{heading}.*:\n((?:  .*\n)*)", text, re.MULTILINE)
    assert found, text
    entries = re.findall(r"^  (\S+) .*\n((?:      .*\n)*)", found[1], re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in entries}


@pytest.mark.parametrize(
    "command", ["live_recorder", "controller", "level_sensor", "level_sensor --tank roof"]
)
def test_help_starts_no_node(tmp_path: Path, command: str) -> None:
    """The help of the others is held against the nodes."""
    assert "[--ros-args ...]" in help_of(tmp_path, command)


def parameters_of(watcher: Observer, node: str) -> dict[str, str]:
    """Return the description of each parameter of a started node, but rclpy's own."""
    names = [
        name for name in watcher.call(ListParameters, f"/{node}/list_parameters").result.names
        if name not in ("use_sim_time", "start_type_description_service")
    ]
    found = watcher.call(DescribeParameters, f"/{node}/describe_parameters", names=names)
    return {each.name: " ".join(each.description.split()) for each in found.descriptors}


def check_topics(watcher: Observer, node: str, text: str) -> None:
    """Hold a help's topics against those of the started node."""

    def found(names_and_types: Any) -> set[str]:
        try:
            return {name for name, _ in names_and_types(node, "/")} & read_topics().keys()
        except NodeNameNonExistentError:
            return set()

    publishes, subscribes = section(text, "publishes"), section(text, "subscribes to")
    own = watcher.node
    watcher.until(
        lambda: found(own.get_publisher_names_and_types_by_node) == publishes.keys(),
        60, f"{publishes.keys()} of {node}",
    )
    # Some are subscribed to only where they are needed.
    needed = subscribes.keys() - {
        "plant": {"/weather/frost", "/pump/flow", "/recorder/written"},
        "recorder": {
            "/controller/planned_deviation", "/controller/plan", "/controller/fill_to",
            "/controller/trust",
        },
    }.get(node, set())
    watcher.until(
        lambda: needed <= found(own.get_subscriber_names_and_types_by_node) <= subscribes.keys(),
        60, f"{needed} of {node}",
    )


def test_help_is_what_the_nodes_have(domain: int, tmp_path: Path, observer: Observer) -> None:
    """Parameters and topics of the started nodes; their examples, as typed, are a graph."""
    helps = {
        node: help_of(tmp_path, command)
        for node, command in {
            "plant": "plant", "weather": "weather", "recorder": "recorder",
            "mpc": "controller --controller mpc",
        }.items()
    }
    started = {}

    def start(node: str) -> None:
        line = helps[node].splitlines()[-1].split()
        assert line[0] == "python"
        started[node] = subprocess.Popen(
            [sys.executable, *line[1:]], cwd=tmp_path, env=environment(domain)
        )

    try:
        for node in ("plant", "weather", "recorder"):  # they wait for the controller
            start(node)
        for node in started:
            assert section(helps[node], "parameters") == parameters_of(observer, node)
            check_topics(observer, node, helps[node])
        start("mpc")
        check_topics(observer, "mpc", helps["mpc"])
        bag = tmp_path / "my_bag"
        wait_for(lambda: (bag / "metadata.yaml").exists(), 120, "the bag")
    finally:
        for process in started.values():
            process.terminate()
        for process in started.values():
            process.wait(300)
    with (bag / "my_bag_0.mcap").open("rb") as stream:
        index = make_reader(stream).get_summary()
    assert index is not None and index.statistics is not None
    assert len(index.channels) == len(MPC_TOPICS)
    assert set(index.statistics.channel_message_counts.values()) == {3601}
    weights = re.findall(r"^    (\w+):", (CONFIG / "mpc.yaml").read_text(), re.MULTILINE)
    assert set(weights) < section(helps["mpc"], "parameters").keys()
