"""Nodes started by hand: which peers they wait for, which have gone, and the end of the run."""

from __future__ import annotations

import re
import signal
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from bag_topics import MPC_TOPICS
from builtin_interfaces.msg import Time
from graphs import Process, bag_file, wait_for
from mcap.reader import make_reader
from rclpy.duration import Duration
from ros_rig import FORECASTS, Observer, ros_arguments
from rosgraph_msgs.msg import Clock

from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.domain import LEASE
from greenroof_ros.ros.messages import message_class


class Nodes:
    """Nodes started by hand, by their names."""

    def __init__(self, domain: int, cwd: Path) -> None:
        self.domain, self.cwd = domain, cwd
        self.started: dict[str, Process] = {}

    def node(self, name: str, **parameters: object) -> Process:
        """Start a node; a controller by its own name. The recorder is of ``mpc`` unless told."""
        if name == "recorder":
            parameters.setdefault("controller", "mpc")
        which = ["controller", "--controller", name] if name in ("mpc", "onoff") else [name]
        self.started[name] = Process(
            self.domain, f"nodes.{which[0]}", *which[1:], *ros_arguments(**parameters),
            cwd=self.cwd,
        )
        return self.started[name]

    def log(self, name: str) -> str:
        return self.started[name].stderr()

    def code(self, name: str) -> int:
        """Wait until a node ends on its own, and return its exit code."""
        code = self.started[name].wait(300)
        # If the middleware is slow to end, the kernel ends the node, which has printed everything.
        return int("error: " in self.log(name)) if code == -signal.SIGALRM else code


@pytest.fixture
def nodes(domain: int, tmp_path: Path) -> Nodes:
    return Nodes(domain, tmp_path)


def test_started_by_hand_gives_the_bag_of_bringup(
    tmp_path: Path, nodes: Nodes, recorded: Path
) -> None:
    """Equal in every byte; each node starts while the others wait for it.

    All end on their own with exit code 0.
    """
    nodes.node("weather", run_length=360)
    nodes.node("recorder", directory="bag")
    nodes.node("plant", run_length=360, record="true")
    nodes.node("mpc")
    for name in nodes.started:
        assert nodes.code(name) == 0
        log = nodes.log(name)
        assert "does not answer" not in log and "ended" not in log
    mine = tmp_path / "bag" / "bag_0.mcap"
    assert mine.read_bytes() == bag_file(recorded).read_bytes()


def test_plant_that_is_killed_ends_the_others(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They name it, with exit code 1; the bag is closed. ROS drops it after 6 s instead of 20."""
    monkeypatch.setenv(LEASE, "6")
    nodes.node("weather")
    nodes.node("onoff")
    nodes.node("recorder", directory="bag", controller="onoff")
    nodes.node("plant", run_length=40_000, record="true", speed=500.0)
    file = nodes.cwd / "bag" / "bag_0.mcap"
    wait_for(lambda: file.exists() and file.stat().st_size > 20_000, 60, "a growing bag")
    nodes.started["plant"].process.kill()
    for name in ("weather", "onoff", "recorder"):
        assert nodes.code(name) == 1, name
        (line,) = [line for line in nodes.log(name).splitlines() if line.startswith("error: ")]
        assert "the plant has stopped" in line
    with file.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None


def test_fatal_line_names_the_cause(nodes: Nodes, observer: Observer) -> None:
    """It names the weather, not the controller that waits for the weather's forecast."""
    nodes.node("weather")
    nodes.node("onoff")
    nodes.node("plant", run_length=40_000, speed=100.0, peer_limit=4.0)
    flows = observer.collect("/pump/flow")
    observer.until(lambda: len(flows) >= 50, 60, "50 ticks")
    nodes.started["weather"].process.kill()
    assert nodes.code("plant") == 1
    (fatal,) = [text for text in nodes.log("plant").splitlines() if text.startswith("error: ")]
    # The kill can come between the two messages of a tick.
    assert re.search(
        "no message within 4 s on (/weather/precipitation, )?/weather/evapotranspiration from "
        "weather$", fatal,
    )


def test_a_plant_that_stood_still_makes_up_for_nothing(nodes: Nodes, observer: Observer) -> None:
    """Otherwise a real pump's minimum times, which are counted in ticks, would pass too fast."""
    times = observer.times("/roof/level")
    nodes.node("weather")
    nodes.node("onoff")
    plant = nodes.node("plant", run_length=400, speed=4.0)
    observer.until(lambda: len(times) > 4, 60, "ticks")
    plant.process.send_signal(signal.SIGSTOP)
    time.sleep(3.0)
    plant.process.send_signal(signal.SIGCONT)

    def after() -> list[float]:
        """Return when the ticks after the stop were sent."""
        sent = [later for time, later in pairwise(times) if later - time > 2.5]
        return times[times.index(sent[0]):] if sent else []

    observer.until(lambda: len(after()) > 8, 60, "ticks after it")
    assert after()[8] - after()[0] > 8 / 4 - 0.5


# What the test's node sends to the node under test: topics, each with a value.
Messages = list[tuple[str, Any]]
LEVEL = ("/cistern/level", 2.5)
INPUTS: Messages = [
    ("/clock", Time(sec=1_625_641_200)), LEVEL, ("/roof/level", 0.03), ("/weather/frost", 0.0),
    *((name, [0.0]) for name in FORECASTS),
]
RUN = ("/run", [7.0, 0.0, 0.0])
LONGER = ("/run", [7.0, 5.0, 0.0])
# One message of each topic recorded with mpc, the recorder's default.
RECORDED: Messages = [
    (name, dict(INPUTS).get(name, [0.0] if "Array" in topic.type else 0.0))
    for name, topic in read_topics().items() if name in MPC_TOPICS
]
# The node, its messages, those after its first command, its exit code, and its message.
WRONG: dict[str, tuple[str, Messages, Messages, int, str]] = {
    "a level twice before the run": (
        "onoff", [LEVEL, LEVEL], [], 3, "/cistern/level has a second message in tick 0 ("),
    "a level twice in the run": (
        "onoff", [LONGER, *INPUTS], [LEVEL, LEVEL], 1,
        "/cistern/level has a second message in tick 1 ("),
    "a level after the last tick": (
        "onoff", [RUN, *INPUTS], [LEVEL], 1, "/cistern/level has a second message in tick 1 ("),
    "another run": (
        "onoff", [LONGER, *INPUTS], [("/run", [8.0, 5.0, 0.0])], 1,
        "the plant was restarted, or there are two plants"),
    # Whether the tick is complete before the second message depends on the order of the topics.
    "one more of a topic": ("recorder", [RUN, LEVEL, *RECORDED], [], 1, "/cistern/level has"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_lockstep_cannot_be_ends_the_node(nodes: Nodes, observer: Observer, case: str) -> None:
    """The error names the cause; the exit code is 3 before the run, 1 during it."""
    node, before, then, code, words = WRONG[case]
    names = {topic for topic, _ in [*INPUTS, *before]}
    publishers = {topic: observer.publisher(topic) for topic in names}
    commands = observer.collect("/pump/command")

    def publish(messages: Messages) -> None:
        for topic, value in messages:
            kind = message_class(read_topics()[topic].type)
            field = "clock" if kind is Clock else "data"
            publishers[topic].publish(kind(**{field: value}))

    publish(before)
    nodes.node(node)
    if then:
        observer.until(lambda: commands, 60, "a command")
        for publisher in publishers.values():  # a later reader would get only the newest
            observer.until(publisher.get_subscription_count, 60, "its reader")
            assert publisher.wait_for_all_acked(Duration(seconds=60))
        time.sleep(0.5)
        publish(then)
    assert nodes.code(node) in (code, -signal.SIGALRM)
    assert words in nodes.log(node)
