"""The executor of a node, and the one private part of rclpy that the graph needs.

In lockstep it is ``rclpy.experimental.EventsExecutor``, which takes a third of the processor time,
or rclpy's own where an rclpy lacks that. A live node has events of its publishers, which can lock
up the fast executor (rmw_fastrtps, pull request 890), and time enough for the slow one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.subscription import Subscription


def make_executor() -> Any:
    """Return the fastest executor that this rclpy has."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def begin_to_listen(executor: Any, node: Node) -> None:
    """Give a node to an executor, and hand it the messages that came before it listened.

    rmw_fastrtps counts the messages that wait, and listens for others after that; of one that comes
    in between nothing is said until the next, which in lockstep never comes. ``test/swaps.py``
    measures how often. rclpy has no public way to take what waits: ``handle.take_message`` is
    private, and ``test/graph/test_executors.py`` fails where an rclpy has it no more.

    Args:
        executor: that is to serve the node.
        node: all of its subscriptions to serialised messages have callbacks of one argument.
    """
    executor.add_node(node)
    executor.spin_once(timeout_sec=0.0)  # it begins to listen here, not in add_node
    for subscription in node.subscriptions:
        if subscription.raw:
            for message, _ in waiting_in(subscription):
                subscription.callback(message)


def waiting_in(subscription: Subscription) -> Iterator[tuple[bytes, Any]]:
    """Take the messages that wait, serialised, each with what rclpy says of it."""
    with subscription.handle:
        while (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield taken
