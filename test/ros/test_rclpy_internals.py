"""The private parts of rclpy in use: each still does what it is used for, or it is missing."""

from __future__ import annotations

from contextlib import closing
from types import SimpleNamespace

import pytest
from graphs import wait_for
from peers import Peer, in_domain

rclpy = pytest.importorskip("rclpy", reason="it is about ROS 2")
pytestmark = pytest.mark.graph  # also run with the next ROS 2

from rclpy.duration import Duration  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402

from greenroof_ros.interface.topics import read_topics  # noqa: E402
from greenroof_ros.ros.messages import decoder, encoder, qos_profile, raw_publish, take_messages  # noqa: E402  # noqa: E402
from greenroof_ros.ros.spin import start_receiving  # noqa: E402

LEVEL = read_topics()["/roof/level"]
# An executor that misses all messages that arrived before it listened.
MISSES = SimpleNamespace(add_node=lambda _: None, spin_once=lambda timeout_sec: None)


def test_messages_that_came_before_an_executor_listens(domain: int) -> None:
    """rclpy's fast executor misses some of them, once in 7,000 times; they are passed on.

    Each has its publisher's sequence number.
    """
    with in_domain(domain), closing(Peer(domain, "small")) as peer:
        small = peer.node
        values: list[bytes] = []
        profile, decode, encode = qos_profile(LEVEL.qos), decoder(LEVEL.type), encoder(LEVEL.type)
        subscription = small.create_subscription(Float64, "level", values.append, profile, raw=True)
        publisher = small.create_publisher(Float64, "level", profile)
        publish = raw_publish(publisher)
        wait_for(publisher.get_subscription_count, 60, "the subscription")
        for value in (1.0, 2.0, 3.0):
            publish(encode(value))
        assert publisher.wait_for_all_acked(Duration(seconds=60))
        start_receiving(MISSES, small)
        assert [*map(decode, values)] == [1.0, 2.0, 3.0]
        publish(encode(4.0))
        assert publisher.wait_for_all_acked(Duration(seconds=60))
        ((_, info),) = take_messages(subscription)
        assert info["publication_sequence_number"] == 4
