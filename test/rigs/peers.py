"""Nodes inside the tests' process, with the nodes' transport, in a separate domain."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def in_domain(domain: int) -> Iterator[None]:
    """Set the environment that nodes of this process need, and restore it afterwards."""
    before = dict(os.environ)
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class Peer:
    """A foreign node that publishes and offers services."""

    def __init__(self, domain: int, name: str, namespace: str = "") -> None:
        import rclpy
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions

        from greenroof_ros.ros.domain import prepare_ros

        self.context = rclpy.Context()
        prepare_ros()
        rclpy.init(
            args=[], context=self.context, domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = Node(name, namespace=namespace or None, context=self.context)

    def close(self) -> None:
        self.node.destroy_node()
        self.context.try_shutdown()
