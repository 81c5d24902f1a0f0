"""The private parts of rclpy that are used: each does here what it is used for, or is missing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest
from places import CHECKOUT

rclpy = pytest.importorskip("rclpy", reason="it is about ROS 2")
pytestmark = pytest.mark.graph  # the next ROS 2 runs them, too

from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402

from greenroof_ros.graph.lifecycle import (  # noqa: E402
    INACTIVE,
    UNCONFIGURED,
    Lifecycle,
    transition,
)


def test_messages_that_come_while_an_executor_begins_to_listen() -> None:
    """A sample of test/swaps.py."""
    done = subprocess.run(
        [sys.executable, str(CHECKOUT / "test" / "swaps.py"), "--rounds", "1000"],
        capture_output=True, text=True, timeout=300, check=False,
    )
    assert done.stdout == "0 of 1000 times a message was left behind\n", done.stderr
    assert done.returncode == 0


class Small(Lifecycle, Node):
    """A node with a lifecycle that does nothing."""

    def __init__(self, context: rclpy.Context) -> None:
        Node.__init__(self, "small", context=context)
        Lifecycle.__init__(self)
        self.asked = 0

    @transition
    def on_configure(self) -> None:
        pass

    def on_asked(self) -> None:
        self.asked += 1


@pytest.fixture
def small(domain: int) -> Iterator[Small]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = Small(context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def test_a_transition_that_the_state_lacks_is_refused(small: Small) -> None:
    """Where rclpy alone raises in its executor; the state is read, and the next one is made."""
    client = small.create_client(ChangeState, "/small/change_state")
    executor = SingleThreadedExecutor(context=small.context)
    executor.add_node(small)

    def ask(number: int) -> bool:
        answer = client.call_async(ChangeState.Request(transition=Transition(id=number)))
        executor.spin_until_future_complete(answer, 60)
        return bool(answer.result().success)

    assert small.lifecycle_state == UNCONFIGURED
    assert not ask(Transition.TRANSITION_ACTIVATE)
    assert ask(Transition.TRANSITION_CONFIGURE)
    assert small.lifecycle_state == INACTIVE
    assert small.asked == 2
