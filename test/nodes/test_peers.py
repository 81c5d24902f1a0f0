"""Nodes started by hand: which peers they wait for, which have gone, and the end of the run."""

from __future__ import annotations

import math
import re
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from bag_topics import MPC_TOPICS
from builtin_interfaces.msg import Time
from graphs import Process, bag_file
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


# What the test's node sends to the node under test: topics, each with a value.
Messages = list[tuple[str, Any]]
LEVEL = ("/cistern/level", 2.5)
CLOCK = ("/clock", Time(sec=1_625_641_200))
OTHERS: Messages = [("/weather/frost", 0.0), *((name, [0.0]) for name in FORECASTS)]
INPUTS: Messages = [CLOCK, LEVEL, ("/roof/level", 0.03), *OTHERS]
RUN, LONGER = ("/run", [7.0, 0.0, 0.0]), ("/run", [7.0, 5.0, 0.0])
# One message of each topic recorded with mpc.
RECORDED: Messages = [
    (name, dict(INPUTS).get(name, [0.0] if "Array" in topic.type else 0.0))
    for name, topic in read_topics().items() if name in MPC_TOPICS
]


class Sender:
    """A test's node that sends messages to the node under test."""

    def __init__(self, observer: Observer, messages: Messages) -> None:
        self.observer = observer
        names = {topic for topic, _ in [*INPUTS, *messages]}
        self.publishers = {topic: observer.publisher(topic) for topic in names}
        self.commands = observer.collect("/pump/command")

    def send(self, messages: Messages) -> None:
        for topic, value in messages:
            kind = message_class(read_topics()[topic].type)
            field = "clock" if kind is Clock else "data"
            self.publishers[topic].publish(kind(**{field: value}))

    def until_received(self) -> None:
        for publisher in self.publishers.values():  # a later reader would get only the newest
            self.observer.until(publisher.get_subscription_count, 60, "its reader")
            assert publisher.wait_for_all_acked(Duration(seconds=60))


@pytest.mark.parametrize("refused", [("/roof/level", math.nan), ("/weather/frost", -1.0)])
def test_no_command_in_a_tick_with_a_refused_input(
    nodes: Nodes, observer: Observer, refused: tuple[str, float]
) -> None:
    """A refused level reads 0, as a dry roof would, and a refused frost as no frost."""
    sender = Sender(observer, [LONGER])
    nodes.node("onoff")
    sender.send([LONGER])
    for tick, roof in enumerate((("/roof/level", 0.03), refused, ("/roof/level", 0.03)), start=1):
        sender.send([*{**dict(INPUTS), roof[0]: roof[1]}.items()])
        observer.until(lambda tick=tick: len(sender.commands) == tick, 60, "a command")
    first, without, last = sender.commands
    assert first == last > 0 == without


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
    sender = Sender(observer, before)
    sender.send(before)
    nodes.node(node, controller="mpc" if node == "recorder" else None)
    if then:
        observer.until(lambda: sender.commands, 60, "a command")
        sender.until_received()
        time.sleep(0.5)
        sender.send(then)
    ended, error = nodes.end(node)
    assert ended == code and words in error
