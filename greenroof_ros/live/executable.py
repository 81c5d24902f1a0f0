"""The executable of a live node."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NoReturn

from rclpy.executors import SingleThreadedExecutor

from greenroof_ros.graph.domain import begin_to_listen
from greenroof_ros.graph.executable import node_command
from greenroof_ros.live.node import LiveNode


def spin(node: LiveNode, check: Callable[[], None]) -> NoReturn:
    """Run a live node until it fails or a check ends it.

    Not with rclpy's fast executor: publisher events can lock it up (rmw_fastrtps, pull request
    890).

    Args:
        node: the node.
        check: called at least 20 times a second; it can raise.
    """
    executor = SingleThreadedExecutor()
    begin_to_listen(executor, node)
    while True:
        check()
        executor.spin_once(timeout_sec=node.wait_s)
        node.check(time.monotonic())


live_command = partial(node_command, spin=spin)
