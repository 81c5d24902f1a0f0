"""A controller that is someone else's node, in a run: the example, and broken ones."""

from __future__ import annotations

import re
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from checked_nodes import changed, start_node
from graphs import Process, bag_file, bring_up, messages_of, summary_of
from paper import VALVE, site_file
from places import CHECKOUT

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

# On a starved machine its command may be 3 s late; the flow would then be 0, in one of the bags.
DRIVER = (CHECKOUT / "examples" / "pump_driver.py").read_text().replace(
    "SILENCE = 3.0", "SILENCE = 300.0"
)
EXAMPLE = (CHECKOUT / "examples" / "controller_node.py").read_text()
# The example decides so if it commands a valve.
WITH_VALVE = """
from examples.proportional import Proportional

class WithValve(Proportional):
    outlet = 0.0

    def command(self, cistern_level, *inputs):
        self.outlet = 1.0 if cistern_level > 2.0 else 0.0
        return super().command(cistern_level, *inputs)
"""
VALVE_ARGUMENTS = "--ros-args", "-p", "valve:=true"


@contextmanager
def ending(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """End a node that a failed test leaves."""
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


def valve_site(directory: Path) -> tuple[str, ...]:
    """Return the options of a site with a valve, from a level above which the example opens it."""
    return "--site", str(site_file(directory, **VALVE)), "--cistern", "50.02", "--roof", "2"


def test_it_gives_the_bag_of_the_same_controller_inside(domain: int, tmp_path: Path) -> None:
    """Equal in every byte, though it and the pump's driver are other processes.

    The examples need only rclpy, and end with the run.
    """
    for example in (EXAMPLE, DRIVER):
        assert "greenroof_ros" not in example and len(example.splitlines()) <= 72
    (tmp_path / "with_valve.py").write_text(WITH_VALVE)
    options = ("--hours", "0.1", "--pump", "external", *valve_site(tmp_path))
    outside, inside = "external", "with_valve:WithValve"
    with ending(start_node(domain, tmp_path, "controller_node", EXAMPLE, *VALVE_ARGUMENTS)) as node:
        for controller in (outside, inside):
            with ending(start_node(domain, tmp_path, "pump_driver", DRIVER)) as driver:
                summary = bring_up(
                    domain, tmp_path, "--controller", controller, *options, output=controller
                )
                assert driver.wait(60) == 0
        assert node.wait(60) == 0
    assert summary["max_command"] > 0 and summary["outflow_m3"] > 0
    outer, inner = (bag_file(tmp_path / run).read_bytes() for run in (outside, inside))
    assert outer == inner


PUBLISHED = "publisher.publish(Float64(data=command()))"
OPENED = "valve.publish(Float64(data=opening()))"
BAD = "{4: math.nan, 5: -0.1, 6: -math.inf, 7: math.inf, 8: 1e-9}"


def test_bad_commands_act_as_zero(domain: int, tmp_path: Path) -> None:
    """To the pump and to the valve: they are counted, never become a flow, and the run goes on."""
    wrong = f"(ticks.append(0), {BAD}.get(len(ticks) - 1, 1.0))[1]"
    source = changed(EXAMPLE, PUBLISHED, PUBLISHED.replace("command()", wrong))
    source = changed(source, OPENED, OPENED.replace("opening()", f"{BAD}.get(len(ticks) - 1, 1.0)"))
    source = changed(source, "tick = {}", "ticks, tick = [], {}")
    with ending(start_node(domain, tmp_path, "controller_node", source, *VALVE_ARGUMENTS)):
        summary = bring_up(
            domain, tmp_path, "--controller", "external", *valve_site(tmp_path), "--hours", "0.01"
        )
    assert summary["refused"] == {"/pump/command": 4, "/outlet/command": 4}
    for topic in ("/pump/flow", "/outlet/flow"):
        messages = messages_of(tmp_path / "run")[topic]
        flows = [struct.unpack("<d", message[4:12])[0] for message in messages]
        assert flows[4:8] == [0.0] * 4 and min(flows[:4] + flows[8:]) > 0, topic


@pytest.mark.parametrize(("changes", "arguments", "words"), [
    # Without its own check, which may be faster than the plant's.
    ({"if topic in tick:": "if False:", OPENED: f"{OPENED}, {OPENED}"}, VALVE_ARGUMENTS,
     r"/outlet/command has a second message in tick \d+ \(contr"),
    ({}, (), r"the run did not start within 30 s: /outlet/command from controller$"),
])
def test_a_node_that_breaks_a_rule_ends_the_run(
    domain: int, tmp_path: Path, changes: dict[str, str], arguments: tuple[str, ...], words: str
) -> None:
    """With the topic and its name, exit code 1, and a closed bag."""
    source = EXAMPLE
    for old, new in changes.items():
        source = changed(source, old, new)
    with ending(start_node(domain, tmp_path, "controller_node", source, *arguments)):
        process = Process(
            domain, "bringup", "--controller", "external", *valve_site(tmp_path), "--output", "run",
            cwd=tmp_path,
        )
        assert process.wait(120) == 1, process.stderr()
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == "failed" and re.search(words, summary["reason"])
    assert summary["reason"] in process.stderr() and "Traceback" not in process.stderr()
    assert (tmp_path / "run/bag/metadata.yaml").exists()
