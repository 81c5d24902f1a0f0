"""Whoever looks on, as the documentation says, sees the present and not what was kept."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from graphs import Process
from places import CHECKOUT
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_rig import Observer, qos
from rosgraph_msgs.msg import Clock

START = 1_625_641_200  # 2021-07-07T02:00-05:00 in seconds since 1970
PAGES = ("README.md", "doc/tutorials/first-run.md", "doc/reference/topics.md")


def printed_durabilities() -> set[str]:
    """Return what the documentation tells ``ros2 topic echo``."""
    found = set()
    for page in PAGES:
        lines = re.findall(r"^ros2 topic echo .*$", (CHECKOUT / page).read_text(), re.MULTILINE)
        assert lines, page
        for line in lines:
            option = re.search(r"--qos-durability (\w+)", line)
            # Where all publishers are transient local, ros2 chooses that.
            found.add(option[1] if option else "transient_local")
    return found


def first_seen(watcher: Observer, profile: QoSProfile) -> int:
    """Return the first clock (s) that a new subscription gets."""
    seen: list[int] = []
    subscription = watcher.node.create_subscription(
        Clock, "/clock", lambda message: seen.append(message.clock.sec), profile
    )
    watcher.until(lambda: seen, 60, "a message")
    watcher.node.destroy_subscription(subscription)
    return seen[0]


def test_echo_as_printed_shows_the_present(domain: int, tmp_path: Path, observer: Observer) -> None:
    """The first message is not older than the newest when the subscription was made."""
    (durability,) = printed_durabilities()
    newest = [0]
    process = Process(domain, "bringup", "--no-record", "--speed", "10", cwd=tmp_path)
    observer.node.create_subscription(
        Clock, "/clock", lambda message: newest.__setitem__(0, message.clock.sec), qos("/clock")
    )
    observer.until(lambda: newest[0] >= START + 20, 60, "20 ticks")
    # As ros2 topic echo subscribes once one policy is given: the others are a sensor's.
    as_printed = QoSProfile(
        depth=5, reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy[durability.upper()],
    )
    for _ in range(3):
        before = newest[0]
        assert before <= first_seen(observer, as_printed)
    # The history is there for nodes that join late: of 64 ticks, 6 s, which joining may take.
    for _ in range(5):
        before = newest[0]
        if first_seen(observer, qos("/clock")) < before:
            break
    else:
        pytest.fail("a late subscriber sees nothing older than the newest of before")
    process.process.terminate()
    assert process.wait(300) == 130
