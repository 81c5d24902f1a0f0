"""A controller that is someone else's node, in a run: the example, and broken ones."""

from __future__ import annotations

import re
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from graphs import Process, bag_file, bring_up, changed, messages_of, start_node, summary_of
from paper import VALVE, site_file
from places import CHECKOUT

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from ros_rig import Observer
from std_msgs.msg import Float64

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
    assert "greenroof_ros" not in EXAMPLE
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


@pytest.mark.parametrize(("when", "sentence"), [
    (">= 30", r"/outlet/command has a second message in tick \d+ \(contr"),
    ("== 30", r"/outlet/command has a second message in tick \d+ \("),  # mostly by the recorder
])
def test_bad_commands_act_as_zero_and_a_second_one_ends_the_run(
    domain: int, tmp_path: Path, when: str, sentence: str
) -> None:
    """To the pump and to the valve: bad ones are counted, and never become a flow.

    A second command in a tick ends the run with topic and sender, and a closed bag.
    """
    wrong = f"(ticks.append(0), {BAD}.get(len(ticks) - 1, 1.0))[1]"
    source = changed(EXAMPLE, PUBLISHED, PUBLISHED.replace("command()", wrong))
    opened = OPENED.replace("opening()", f"{BAD}.get(len(ticks) - 1, 1.0)")
    source = changed(source, OPENED, f"{opened}, len(ticks) {when} and {opened}")
    # Without its own check, which may be faster than the plant's.
    source = changed(source, "if topic in tick:", "if False:")
    source = changed(source, "tick = {}", "ticks, tick = [], {}")
    with ending(start_node(domain, tmp_path, "controller_node", source, *VALVE_ARGUMENTS)):
        process = Process(
            domain, "bringup", "--controller", "external", *valve_site(tmp_path), "--output", "run",
            "--hours", "0.02", cwd=tmp_path,
        )
        assert process.wait(120) == 1, process.stderr()
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == "failed" and summary["reason"] in process.stderr()
    assert re.search(sentence, summary["reason"])
    assert summary["refused"] == {"/pump/command": 4, "/outlet/command": 4}
    for topic in ("/pump/flow", "/outlet/flow"):
        messages = messages_of(tmp_path / "run")[topic]
        flows = [struct.unpack("<d", message[4:12])[0] for message in messages]
        assert flows[4:8] == [0.0] * 4 and min(flows[:4] + flows[8:20]) > 0, topic


def test_a_node_that_publishes_into_a_run_ends_it_soon(
    domain: int, tmp_path: Path, observer: Observer
) -> None:
    """With its name and a closed bag, although its messages come faster than they are refused."""
    levels = observer.collect("/roof/level")
    process = Process(
        domain, "bringup", "--controller", "onoff", "--speed", "50", "--output", "run",
        cwd=tmp_path,
    )
    observer.until(lambda: len(levels) > 20, 60, "20 ticks")
    publisher = observer.publisher("/pump/command")

    def publish() -> bool:
        publisher.publish(Float64(data=0.1))
        return process.process.poll() is not None

    observer.until(publish, 60, "the end of the run")
    assert process.process.returncode == 1
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == "failed" and "observer" in summary["reason"]
    assert summary["reason"] in process.stderr()
    assert (tmp_path / "run" / "bag" / "metadata.yaml").exists()
