"""Execution of simulated nodes in one process with one executor, as in a ROS 2 container."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from greenroof_ros.ros.domain import SHUTDOWN_S, prepare_ros
from greenroof_ros.ros.errors import explain
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.lockstep import LockstepNode
from greenroof_ros.ros.rclpy_internals import take_messages

# How often the steady clock, the signals and the ends of the nodes are checked (s).
_CHECK_S = 0.05
# Interval of the reports while nodes close their files and connections, and the longest time for
# which they report this (s): a pump takes up to 38 s to come to a standstill.
_REPORT_S, _MAX_STOP_S = 0.25, 45.0
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""a clock that is not affected when the system's clock is set"""


@contextmanager
def ros(arguments: Sequence[str]) -> Iterator[None]:
    """Initialise ROS for the nodes of this process, and shut ROS down after the block.

    After the block, the process must exit soon: see :func:`end_soon`.

    Args:
        arguments: the command line, including ROS arguments.
    """
    prepare_ros()
    # Not rclpy's own handlers: after them nothing can be published, and a node that stops still has
    # to send its last report.
    rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        end_soon()
        rclpy.try_shutdown()


def spin(
    nodes: Sequence[LockstepNode], may_end: Callable[[], bool], beside: Sequence[GraphNode] = ()
) -> None:
    """Run nodes until they may stop.

    The executor loops over the messages, since a loop in Python would take a seventh of the time of
    a tick. Every 50 ms, the loop is interrupted to check what depends on the steady clock. The
    fast executor uses a third of the processor time of rclpy's others, but publisher events can
    lock it up (rmw_fastrtps, pull request 890), so these nodes use none.

    Args:
        nodes: the nodes.
        may_end: function, called 20 times a second, that returns True if the nodes may stop; it can
            raise an error to end the run.
        beside: nodes that only receive messages here: ``may_end`` has to check them.

    Raises:
        LockstepError: if the graph cannot continue.
        ConfigurationError: if the configuration of a node is invalid.
        OSError: if a node cannot continue, for instance because the disk is full.
    """
    executor, pause = EventsExecutor(), Future()

    def stop() -> None:
        if not pause.done():
            pause.set_result(None)

    for each in (*nodes, *beside):
        start_receiving(executor, each)
    # The timeout alone is not enough: while messages are waiting, rclpy's fast executor does not
    # return.
    nodes[0].create_timer(_CHECK_S, stop, clock=STEADY)
    while not may_end():
        # With a timeout, since without one rclpy's fast executor fires no timers.
        executor.spin_until_future_complete(pause, timeout_sec=_CHECK_S)
        pause = Future()
        now = time.monotonic()
        failed = next((node.failure for node in nodes if node.failure is not None), None)
        if failed is not None:
            raise failed
        for node in nodes:
            node.check(now)


def start_receiving(executor: Any, node: Any) -> None:
    """Add a node to an executor, and deliver the messages that arrived before it began to listen.

    rmw_fastrtps counts the waiting messages and then starts to listen. A message that arrives
    between these two steps is not noticed until the next message arrives, which never happens in
    lockstep.

    Args:
        executor: the executor for the node.
        node: the node; the callbacks of its raw subscriptions have one argument.
    """
    executor.add_node(node)
    executor.spin_once(timeout_sec=0.0)  # this, not add_node, begins to listen
    for subscription in node.subscriptions:
        if subscription.raw:
            for message, _ in take_messages(subscription):
                subscription.callback(message)


def end_nodes(nodes: Sequence[GraphNode], failure: str | None) -> str | None:
    """Make every node close its open files and connections, and report that it is stopping.

    A failure is reported before the nodes stop, and they go on reporting while they stop: a
    supervisor would kill a silent node.

    Args:
        nodes: the nodes.
        failure: description of the error that ended the run; None if there was none.

    Returns:
        The description of the first error raised while a node was stopping, such as a bag that
        cannot be closed; None if there was no such error.
    """
    for node in nodes:
        node.note_failure(failure)
    stopped, unstopped = threading.Event(), None
    reporter = threading.Thread(target=_report, args=(nodes, stopped), daemon=True)
    reporter.start()
    for node in nodes:
        try:
            node.on_stop()
        except Exception as error:  # the other nodes must stop too
            why, _ = explain(error)
            unstopped = unstopped or why
            print(f"error: {why}", file=sys.stderr)
    stopped.set()
    reporter.join()
    for node in nodes:
        node.end(failure or unstopped)
    return unstopped


def _report(nodes: Sequence[GraphNode], stopped: threading.Event) -> None:
    """Let nodes report their states until they have stopped, for a limited time."""
    until = time.monotonic() + _MAX_STOP_S
    while time.monotonic() < until:
        for node in nodes:
            with suppress(Exception):  # its own error is reported already
                node.report_state()
        if stopped.wait(_REPORT_S):
            return


def destroy_nodes(nodes: Sequence[GraphNode]) -> None:
    """Let the nodes leave the graph after :func:`end_nodes`; this process must then exit soon."""
    end_soon()
    for node in nodes:
        node.destroy_node()


def end_soon() -> None:
    """Let the kernel kill this process if it locks up after all has been sent and written."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(SHUTDOWN_S)
