"""A controller that is somebody else's node, in a run: the example, and broken ones."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from checked_nodes import changed, start_node
from graphs import Process, bag_file, bring_up, environment, summary_of
from places import CHECKOUT

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

EXAMPLE = (CHECKOUT / "examples" / "controller_node.py").read_text()
CLASS = "examples.proportional:Proportional"
# Changes that break the example, and what the run ends with. The run has 360 ticks.
BROKEN = {
    "dead": (
        "tick.clear()", "tick.clear()\n        node.ticks = getattr(node, 'ticks', 0) + 1\n"
        "        node.ticks == 100 and __import__('os').kill(__import__('os').getpid(), 9)",
        r"tick \d+: no message within 2 s on /pump/command from controller",
    ),
    "slow": (
        "tick.clear()", "tick.clear()\n        __import__('time').sleep(5.0)",
        r"tick \d+: no message within 2 s on /pump/command from controller",
    ),
    "doubled": (
        "publisher.publish(Float64(data=command()))",
        "publisher.publish(Float64(data=command())), publisher.publish(Float64(data=0.0))",
        r"/pump/command came twice in tick \d+ \(controller\)",
    ),
}


@contextmanager
def node(domain: int, directory: Path, source: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node as its user would."""
    process = start_node(domain, directory, "controller_node", source)
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


def test_it_gives_the_bag_of_the_same_controller_inside(domain: int, tmp_path: Path) -> None:
    """Equal in every byte, though it is another process; the example needs only rclpy."""
    assert "greenroof_ros" not in EXAMPLE and len(EXAMPLE.splitlines()) <= 60
    with node(domain, tmp_path, EXAMPLE) as controller:
        outside = bring_up(domain, tmp_path, "--controller", "external", "--hours", "0.1",
                           output="outside")
        assert controller.wait(60) == 0
    inside = bring_up(domain, tmp_path, "--controller", CLASS, "--hours", "0.1", output="inside")
    assert outside["total_deviation_m3"] == inside["total_deviation_m3"]
    assert outside["max_command"] > 0
    bags = [bag_file(tmp_path / run).read_bytes() for run in ("outside", "inside")]
    assert bags[0] == bags[1]


@pytest.mark.parametrize("case", BROKEN)
def test_a_node_that_breaks_a_rule_ends_the_run(domain: int, tmp_path: Path, case: str) -> None:
    """With its topic and name, exit code 1, and a closed bag."""
    old, new, reason = BROKEN[case]
    with node(domain, tmp_path, changed(EXAMPLE, old, new)):
        process = Process(
            domain, "bringup", "--controller", "external", "--hours", "0.1", "--output", "run",
            "--peer-limit", "2", cwd=tmp_path,
        )
        assert process.wait(120) == 1
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == "failed"
    assert re.search(reason, summary["reason"]), summary["reason"]
    assert summary["reason"] in process.stderr() and "Traceback" not in process.stderr()
    assert (tmp_path / "run" / "bag" / "metadata.yaml").exists()


def test_a_node_that_never_comes_is_named(domain: int, tmp_path: Path) -> None:
    (tmp_path / "limits.yaml").write_text(
        "/**/plant:\n  ros__parameters:\n    start_limit: 3.0\n"
    )
    process = Process(
        domain, "bringup", "--controller", "external", "--output", "run",
        "--node-parameters", "limits.yaml", cwd=tmp_path,
    )
    assert process.wait(120) == 1
    assert "no start within 3 s: /pump/command from the controller" in process.stderr()


def test_only_a_graph_can_use_it(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "greenroof_ros.simulate", "--controller", "external"],
        cwd=tmp_path, env=environment(0), capture_output=True, text=True, check=False,
    )
    assert done.returncode == 2
    assert "controller = 'external': is a node that you run yourself" in done.stderr
