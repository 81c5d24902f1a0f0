"""Runs nodes of a simulated graph in this process, with one executor, like ROS 2's containers."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.graph.domain import SHUTDOWN_S, choose_transport
from greenroof_ros.graph.graph_node import GraphNode
from greenroof_ros.graph.node import SimulationNode
from greenroof_ros.graph.rclpy_internals import take_messages

# How often the wall clock, the signals and the ends of the nodes are checked (s).
_CHECK_S = 0.05
# How long the middleware may take to shut down on a busy machine (s); SHUTDOWN_S is processor time.
_MAX_SHUTDOWN_S = 30
# A clock that is not affected when the system's clock is set.
_STEADY = Clock(clock_type=ClockType.STEADY_TIME)


@contextmanager
def ros(arguments: Sequence[str]) -> Iterator[None]:
    """Initialise ROS for the nodes of this process, and shut it down at the end.

    When this ends, the process must be done: see :func:`end_soon`.

    Args:
        arguments: the command line, with ROS arguments.

    Raises:
        ConfigurationError: if rcl cannot parse the arguments.
    """
    choose_transport()
    try:
        # Not rclpy's own handlers: after them nothing can be published, and a node that stops still
        # has to send its last report.
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ConfigurationError(" ".join(str(error).split())) from error
    try:
        yield
    finally:
        end_soon()
        rclpy.try_shutdown()


def spin(nodes: Sequence[SimulationNode], may_end: Callable[[], bool]) -> None:
    """Run nodes until they may end.

    The loop over messages is in the executor, since a loop in Python would cost a seventh of a
    tick. In between, everything that depends on the wall clock is checked 20 times a second.

    Args:
        nodes: the nodes.
        may_end: function that returns whether the nodes may end, called 20 times a second; it can
            raise an error to end the run.

    Raises:
        LockstepError: if the graph cannot go on.
        ConfigurationError: if the set-up is wrong.
        OSError: if a node cannot go on, for instance on a full disk.
    """
    executor, pause = make_executor(), Future()

    def stop() -> None:
        if not pause.done():
            pause.set_result(None)

    for node in nodes:
        node.on_failure = stop
        start_receiving(executor, node)
    # The timeout alone is not enough: while messages are waiting, rclpy's fast executor does not
    # return.
    nodes[0].create_timer(_CHECK_S, stop, clock=_STEADY)
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


def make_executor() -> Any:
    """Return the fastest executor of this rclpy, for nodes without publisher events.

    ``rclpy.experimental.EventsExecutor`` takes a third of the processor time. Publisher events can
    lock it up (rmw_fastrtps, pull request 890).
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def start_receiving(executor: Any, node: Any) -> None:
    """Add a node to an executor, and deliver the messages that arrived before it listened.

    rmw_fastrtps counts the waiting messages and then starts to listen. A message that arrives in
    between is not noticed until the next one arrives, which in lockstep never happens.

    Args:
        executor: the executor that will serve the node.
        node: the node; callbacks of its raw subscriptions take one argument.
    """
    executor.add_node(node)
    executor.spin_once(timeout_sec=0.0)  # this, not add_node, begins to listen
    for subscription in node.subscriptions:
        if subscription.raw:
            for message, _ in take_messages(subscription):
                subscription.callback(message)


def end_nodes(nodes: Sequence[GraphNode], failure: str | None) -> str | None:
    """End nodes: let each close what is open, and report its end.

    Args:
        nodes: the nodes.
        failure: the error that ended them; None if there was none.

    Returns:
        The first error, including errors while ending; None if there was none.
    """
    for node in nodes:
        try:
            node.on_stop()
        except OSError as error:
            failure = failure or str(error)
            print(f"error: {error}", file=sys.stderr)
    for node in nodes:
        node.end(failure)
    return failure


def destroy_nodes(nodes: Sequence[GraphNode]) -> None:
    """Let nodes leave the graph, after :func:`end_nodes`; this process must end soon."""
    end_soon()
    for node in nodes:
        node.destroy_node()


def end_soon() -> None:
    """Let the kernel end this process if it locks up: everything has been sent and written.

    A process that has locked up spins, so its processor time is what counts. On a busy machine a
    normal end takes longer, too, and must keep its exit code.
    """
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, SHUTDOWN_S)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(_MAX_SHUTDOWN_S)
