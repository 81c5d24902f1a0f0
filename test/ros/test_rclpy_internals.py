"""The private parts of rclpy in use: each still does what it is used for, or it is missing."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from graphs import wait_for

rclpy = pytest.importorskip("rclpy", reason="it is about ROS 2")
pytestmark = pytest.mark.graph  # also run with the next ROS 2

from rclpy.duration import Duration  # noqa: E402
from rclpy.node import Node  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402

from greenroof_ros.interface.topics import read_topics  # noqa: E402
from greenroof_ros.ros.messages import decoder, encoder, qos_profile  # noqa: E402
from greenroof_ros.ros.rclpy_internals import raw_publish, take_messages  # noqa: E402
from greenroof_ros.ros.spin import start_receiving  # noqa: E402

LEVEL = read_topics()["/roof/level"]


@pytest.fixture
def small(domain: int) -> Iterator[Node]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("small", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


class ExecutorThatMisses:
    """An executor that misses all messages that arrived before it listened."""

    def add_node(self, node: Node) -> None:
        pass

    def spin_once(self, timeout_sec: float) -> None:
        pass


def test_messages_that_came_before_an_executor_listens(small: Node) -> None:
    """rclpy's fast executor misses some of them, once in 7,000 times; they are passed on.

    Each has its publisher's sequence number.
    """
    values: list[bytes] = []
    profile, decode, encode = qos_profile(LEVEL.qos), decoder(LEVEL.type), encoder(LEVEL.type)
    subscription = small.create_subscription(Float64, "level", values.append, profile, raw=True)
    publisher = small.create_publisher(Float64, "level", profile)
    publish = raw_publish(publisher)
    wait_for(publisher.get_subscription_count, 60, "the subscription")

    def publish_all(*values: float) -> None:
        for value in values:
            publish(encode(value))
        assert publisher.wait_for_all_acked(Duration(seconds=60))

    publish_all(1.0, 2.0, 3.0)
    start_receiving(ExecutorThatMisses(), small)
    assert [*map(decode, values)] == [1.0, 2.0, 3.0]
    publish_all(4.0, 5.0)
    numbers = [info["publication_sequence_number"] for _, info in take_messages(subscription)]
    assert numbers == [4, 5]
