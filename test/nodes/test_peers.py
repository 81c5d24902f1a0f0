"""Nodes started by hand: which peers they wait for, which have gone, and the end of the run."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from graphs import Process, bag_file
from mcap.reader import make_reader
from ros_rig import Observer, ros_arguments

from greenroof_ros.ros.domain import LEASE


class Nodes:
    """Nodes started by hand, by their names."""

    def __init__(self, domain: int, cwd: Path) -> None:
        self.domain, self.cwd = domain, cwd
        self.started: dict[str, Process] = {}

    def node(self, name: str, **parameters: object) -> Process:
        """Start a node; a controller by its own name."""
        which = ["controller", "--controller", name] if name in ("mpc", "onoff") else [name]
        self.started[name] = Process(
            self.domain, f"nodes.{which[0]}", *which[1:], *ros_arguments(**parameters),
            cwd=self.cwd,
        )
        return self.started[name]

    def end(self, name: str) -> tuple[int, str]:
        """Wait until a node ends on its own, and return its exit code and its error."""
        code, log = self.started[name].wait(300), self.started[name].stderr()
        error = "".join(line for line in log.splitlines() if line.startswith("error: "))
        # If the middleware is slow to end, the kernel ends the node, which has printed everything.
        return int(bool(error)) if code == -signal.SIGALRM else code, error


@pytest.fixture
def nodes(domain: int, tmp_path: Path) -> Nodes:
    return Nodes(domain, tmp_path)


def test_started_by_hand_gives_the_bag_of_bringup(
    tmp_path: Path, nodes: Nodes, recorded: Path
) -> None:
    """Equal in every byte; each node starts while the others wait for it, and ends with 0."""
    nodes.node("weather", run_length=360)
    nodes.node("recorder", directory="bag", controller="mpc")
    nodes.node("plant", run_length=360, record="true")
    nodes.node("mpc")
    assert {nodes.end(name) for name in nodes.started} == {(0, "")}
    assert (tmp_path / "bag/bag_0.mcap").read_bytes() == bag_file(recorded).read_bytes()


def test_a_node_that_is_killed_is_named(
    nodes: Nodes, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the plant: the weather, not the controller that waits for the weather's forecast.

    Without a plant, the others end, and the bag is closed. ROS drops a node after 6 s, not 20.
    """
    monkeypatch.setenv(LEASE, "6")
    flows = observer.collect("/pump/flow")
    nodes.node("weather")
    nodes.node("onoff")
    nodes.node("recorder", directory="bag", controller="onoff")
    nodes.node("plant", run_length=40_000, record="true", speed=500.0, peer_limit=2.0)
    observer.until(lambda: len(flows) >= 50, 60, "50 ticks")
    nodes.started["weather"].process.kill()
    code, error = nodes.end("plant")
    # The kill can come between the two messages of a tick.
    assert code == 1 and re.search(
        "no message within 2 s on (/weather/precipitation, )?/weather/evapotranspiration from "
        "weather$", error,
    ), error
    for name in ("onoff", "recorder"):
        code, error = nodes.end(name)
        assert code == 1 and "the plant has stopped" in error
    with (nodes.cwd / "bag/bag_0.mcap").open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None
