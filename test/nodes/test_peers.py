"""Nodes started by hand: whom they wait for, who went, and the end of the run."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from bag_topics import MPC_TOPICS
from graphs import bag_file, bring_up, wait_for
from mcap.reader import make_reader
from places import Once
from rclpy.duration import Duration
from ros_rig import FORECASTS, Observer
from rosgraph_msgs.msg import Clock

from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.messages import message_class


class Nodes:
    """Nodes started by hand, each with what it prints in a file."""

    def __init__(self, observer: Observer) -> None:
        self.observer, self.cwd = observer, observer.cwd
        self.started: dict[str, subprocess.Popen[str]] = {}

    def node(self, name: str, **parameters: object) -> None:
        """Start one; a controller by its own name."""
        which = f"controller --controller {name}" if name in ("mpc", "onoff") else name
        with (self.cwd / f"{name}.log").open("w") as log:
            popen = {"stdin": subprocess.PIPE, "stdout": log, "stderr": log, "text": True}
            self.started[name] = self.observer.start(which, popen=popen, **parameters)

    def log(self, name: str) -> str:
        return (self.cwd / f"{name}.log").read_text()

    def says(self, name: str, text: str, seconds: float = 20) -> None:
        """Wait until a node has printed a text."""
        wait_for(lambda: text in self.log(name), seconds, f"'{text}' of {name}")

    def code(self, name: str, seconds: float) -> int:
        """Wait for the end of a node by itself and return its exit code."""
        wait_for(lambda: self.started[name].poll() is not None, seconds, f"the end of {name}")
        found = self.started[name].returncode
        # Where the middleware takes long to go, the kernel ends a node that has said all.
        return int("FATAL" in self.log(name)) if found == -signal.SIGALRM else found


@pytest.fixture
def nodes(observer: Observer) -> Nodes:
    return Nodes(observer)


def test_started_by_hand_gives_the_bag_of_bringup(
    domain: int, tmp_path: Path, nodes: Nodes, once: Once
) -> None:
    """Equal in every byte, each node started when the others wait for it, by name.

    All end by themselves with exit code 0.
    """
    nodes.node("weather", run_length=360)
    nodes.says("weather", "waiting for plant\n")
    nodes.node("recorder", directory="bag")
    nodes.says("recorder", "waiting for mpc, plant\n")
    nodes.node("plant", run_length=360, record="true")
    nodes.says("plant", "waiting for the controller\n")
    nodes.says("weather", "waiting for the controller\n")
    nodes.node("mpc")
    nodes.says("plant", "finished 360 ticks", 60)
    for name in nodes.started:
        assert nodes.code(name, 60) == 0
        log = nodes.log(name)
        assert "does not answer" not in log and "ended" not in log
        assert log.count("waiting for") < 15
    run = once("recorded", lambda cwd: bring_up(domain, cwd, "--hours", "0.1")) / "run"
    mine = tmp_path / "bag" / "bag_0.mcap"
    assert mine.read_bytes() == bag_file(run).read_bytes()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=["killed", "ctrl-c"])
def test_plant_that_goes_ends_the_others(nodes: Nodes, how: signal.Signals) -> None:
    """By name, with exit code 1; the bag is closed. ROS knows a killed node for 20 s."""
    nodes.node("weather")
    nodes.node("onoff")
    nodes.node("recorder", directory="bag", controller="onoff")
    nodes.node("plant", run_length=40_000, record="true", speed=500.0)
    file = nodes.cwd / "bag" / "bag_0.mcap"
    wait_for(lambda: file.exists() and file.stat().st_size > 20_000, 60, "a growing bag")
    nodes.started["plant"].send_signal(how)
    for name in ("weather", "onoff", "recorder"):
        assert nodes.code(name, 60) == 1, name
        (line,) = [line for line in nodes.log(name).splitlines() if "FATAL" in line]
        assert "plant has ended" in line
    with file.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None


def test_fatal_line_names_the_cause(nodes: Nodes, observer: Observer) -> None:
    """The weather: not the controller that waits for its forecast."""
    nodes.node("weather")
    nodes.node("onoff")
    nodes.node("plant", run_length=40_000, speed=100.0, peer_limit=5.0)
    flows = observer.hear("/pump/flow")
    observer.until(lambda: len(flows) >= 50, 60, "50 ticks")
    nodes.started["weather"].kill()
    assert nodes.code("plant", 60) == 1
    (said,) = [text for text in nodes.log("plant").splitlines() if "FATAL" in text]
    assert said.endswith(
        "nothing came within 5 s on /weather/precipitation, /weather/evapotranspiration from "
        "weather"
    )


# What the test's own node says to one under test: topics, each with a value.
Said = list[tuple[str, Any]]
LEVEL = ("/cistern/level", 2.5)
INPUTS: Said = [
    LEVEL, ("/roof/level", 0.03), ("/weather/frost", 0.0), *((name, [0.0]) for name in FORECASTS)
]
RUN = ("/run", [7.0, 0.0, 0.0])
# One of each topic that is recorded of mpc, the recorder's default.
EACH: Said = [
    (name, [0.0] if "Array" in topic.type else dict(INPUTS).get(name, 0.0))
    for name, topic in read_topics().items() if name in MPC_TOPICS
]
COUNT = "of each topic 1 messages should have come; messages were lost or came twice: /cistern/"
# The node, what it is told, what then after its first command, its exit code, and what it says.
WRONG: dict[str, tuple[str, Said, Said, int, str]] = {
    "a level twice before the run": (
        "onoff", [LEVEL, LEVEL], [], 3, "/cistern/level came twice in tick 0 ("),
    "a level twice in the run": (
        "onoff", INPUTS, [LEVEL, LEVEL], 1, "/cistern/level came twice in tick 1 ("),
    "another run": (
        "onoff", [("/run", [7.0, 5.0, 0.0]), *INPUTS], [("/run", [8.0, 5.0, 0.0])], 1,
        "the plant was started again, or there are two"),
    "a plant of another version": (
        "onoff", [("/run", [7.0, 5.0])], [], 1, "the plant is of another version"),
    "one more of a topic": ("recorder", [RUN, *EACH, LEVEL], [], 1, f"{COUNT}level: 2\n"),
    "one less of a topic": (
        "recorder", [RUN, *(one for one in EACH if one != LEVEL)], [], 1, f"{COUNT}level: 0\n"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_lockstep_cannot_be_ends_the_node(nodes: Nodes, observer: Observer, case: str) -> None:
    """By name: exit code 3 before the run, 1 in it."""
    node, before, then, code, words = WRONG[case]
    names = {"/clock", *(topic for topic, _ in before + then)}
    publishers = {topic: observer.publisher(topic) for topic in names}
    commands = observer.hear("/pump/command")

    def say(said: Said) -> None:
        for topic, value in said:
            kind = message_class(read_topics()[topic].type)
            publishers[topic].publish(kind() if kind is Clock else kind(data=value))

    say(before)
    nodes.node(node, **({"peer_limit": 0.5} if node == "recorder" else {}))
    if then:
        observer.until(lambda: commands, 60, "a command")
        for publisher in publishers.values():  # a reader that joins now would hear the newest alone
            observer.until(publisher.get_subscription_count, 60, "its reader")
            assert publisher.wait_for_all_acked(Duration(seconds=60))
        time.sleep(0.5)
        say(then)
    assert nodes.code(node, 60) in (code, -signal.SIGALRM)
    assert words in nodes.log(node)


def test_a_second_publisher_before_the_run(nodes: Nodes, observer: Observer) -> None:
    """As nodes that were started by hand find it: bringup looks before it starts any."""
    both = [observer.publisher(LEVEL[0]) for _ in range(2)]
    nodes.node("onoff")
    assert len(both) == 2 and nodes.code("onoff", 60) == 3
    assert "/cistern/level has 2 publishers (" in nodes.log("onoff")
