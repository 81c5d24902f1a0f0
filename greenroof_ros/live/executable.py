"""The executable of live nodes, and their help."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NoReturn

from rclpy.executors import SingleThreadedExecutor

from greenroof_ros.common.interface import read_live_topics
from greenroof_ros.graph.executable import node_command, node_help
from greenroof_ros.graph.spin import start_receiving
from greenroof_ros.live.node import LiveNode


def spin(nodes: Sequence[LiveNode], check: Callable[[], None]) -> NoReturn:
    """Run the live nodes of this process until one fails or a check ends them.

    Not with rclpy's fast executor: publisher events can lock it up (rmw_fastrtps, pull request
    890).

    Args:
        nodes: the nodes.
        check: called at least 20 times a second; it can raise.
    """
    executor = SingleThreadedExecutor()
    for node in nodes:
        start_receiving(executor, node)
    while True:
        check()
        executor.spin_once(timeout_sec=min(node.wait_s for node in nodes))
        for node in nodes:
            node.check(time.monotonic())


live_command = partial(node_command, spin=spin)
live_help = partial(node_help, interface=read_live_topics)
