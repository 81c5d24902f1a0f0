"""rclpy's executors: the slow one says the number of a message, the fast one does not.

See :attr:`greenroof_ros.graph.link.LinkedNode.in_lockstep` for who takes which.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.subscription import Subscription


def make_executor() -> Any:
    """Return the fastest executor that this rclpy has; it does not say the number of a message."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def hand_over(node: Node, slow: SingleThreadedExecutor) -> Any:
    """Take a node from the slow executor to the fastest one, and return that.

    No message is left behind. The fast executor is told of each that comes; but rmw_fastrtps counts
    those that wait before it listens for others, and of one that comes in between nothing is said
    until the next, which in lockstep never comes. ``test/swaps.py`` measures how often. So
    whatever waits is taken once the executor listens.

    Args:
        node: all of its subscriptions to serialised messages have callbacks of one argument.
        slow: has the node.
    """
    slow.remove_node(node)
    fast = make_executor()
    fast.add_node(node)
    fast.spin_once(timeout_sec=0.0)  # it begins to listen here, not in add_node
    for subscription in node.subscriptions:
        if subscription.raw:
            for message, _ in waiting_in(subscription):
                subscription.callback(message)
    return fast


def waiting_in(subscription: Subscription) -> Iterator[tuple[bytes, Any]]:
    """Take the messages that wait, serialised, each with what rclpy says of it."""
    with subscription.handle:
        while (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield taken
