"""Nodes started by hand: which peers they wait for, which have gone, and the end of the run."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from graphs import Process, bag_file
from mcap.reader import make_reader
from ros_rig import Observer, ros_arguments

from greenroof_ros.ros.domain import LEASE


@pytest.fixture
def start(domain: int, tmp_path: Path) -> Callable[..., Process]:
    """Return a function that starts a node by hand; a controller by its own name."""

    def start(name: str, **parameters: object) -> Process:
        which = ["controller", "--controller", name] if name in ("mpc", "onoff") else [name]
        return Process(
            domain, f"nodes.{which[0]}", *which[1:], *ros_arguments(**parameters), cwd=tmp_path
        )

    return start


def end(node: Process) -> tuple[int, str]:
    """Wait until a node ends on its own, and return its exit code and its error."""
    code = node.wait(300)
    error = "".join(line for line in node.stderr().splitlines() if line.startswith("error: "))
    # If the middleware is slow to end, the kernel ends the node, which has printed everything.
    return int(bool(error)) if code == -signal.SIGALRM else code, error


def test_started_by_hand_gives_the_bag_of_bringup(
    tmp_path: Path, start: Callable[..., Process], recorded: Path
) -> None:
    """Equal in every byte; each node starts while the others wait for it, and ends with 0."""
    nodes = [
        start("weather", run_length=360), start("recorder", directory="bag", controller="mpc"),
        start("plant", run_length=360, record="true"), start("mpc"),
    ]
    assert {end(node) for node in nodes} == {(0, "")}
    assert (tmp_path / "bag/bag_0.mcap").read_bytes() == bag_file(recorded).read_bytes()


def test_a_node_that_is_killed_is_named(
    start: Callable[..., Process], observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the plant: the weather, not the controller that waits for the weather's forecast.

    Without a plant, the others end, and the bag is closed. ROS drops a node after 6 s, not 20.
    """
    monkeypatch.setenv(LEASE, "6")
    flows = observer.collect("/pump/flow")
    weather, *others = (
        start("weather"), start("onoff"),
        start("recorder", directory="bag", controller="onoff"),
    )
    plant = start("plant", run_length=40_000, record="true", speed=500.0, peer_limit=2.0)
    observer.until(lambda: len(flows) >= 50, 60, "50 ticks")
    weather.process.kill()
    code, error = end(plant)
    # The kill can come between the two messages of a tick.
    assert code == 1 and re.search(
        "no message within 2 s on (/weather/precipitation, )?/weather/evapotranspiration from "
        "weather$", error,
    ), error
    for other in others:
        code, error = end(other)
        assert code == 1 and "the plant has stopped" in error
    with (observer.cwd / "bag/bag_0.mcap").open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None
