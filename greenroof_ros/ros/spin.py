"""Execution of nodes in one process with one executor, and the executables of nodes."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    command,
    explain,
    print_failure,
)
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.ros.domain import SHUTDOWN_S, prepare_ros
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.lockstep import LockstepNode
from greenroof_ros.ros.messages import take_messages
from greenroof_ros.ros.parameters import refuse_unknown

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


def parse_own_arguments(parser: Parser) -> argparse.Namespace:
    """Return the process's own arguments, as opposed to its ROS arguments."""
    try:
        own: argparse.Namespace = parser.parse_args(remove_ros_args(sys.argv)[1:])
    except RuntimeError as error:  # rcl cannot parse the arguments
        parser.error(" ".join(str(error).split()))
    return own


def node_command(
    make: Callable[..., Any], purpose: str | None, option: str = "",
    spin: Callable[[Any, Callable[[], None]], None] | None = None,
) -> Callable[[], NoReturn]:
    """Return the main function of a node's executable.

    Args:
        make: function that returns the node; its argument is the value of the option, if there is
            an option.
        purpose: docstring of the node's module, which describes the node.
        option: the option that the node requires, such as ``--controller``; empty for none.
        spin: function that runs the nodes and, 20 times a second, calls its second argument, which
            can raise an error; None for a node of a simulated graph.
    """

    @command
    def main() -> int:
        parser = Parser(description=purpose)
        if option:
            parser.add_argument(option, dest="value", required=True)
        arguments = parse_own_arguments(parser)
        return run_nodes(lambda: [make(*vars(arguments).values())], spin or spin_alone)

    return main


def run_nodes(
    make: Callable[[], Sequence[GraphNode]], spin: Callable[[Any, Callable[[], None]], None]
) -> int:
    """Run the nodes of this process until the run is over, a signal stops them, or a node fails.

    Args:
        make: function that returns the nodes.
        spin: function that runs the nodes; see :func:`node_command`.

    Returns:
        The exit code: 0 if the run is over or a signal stopped the nodes, 1 if a node failed, 2 if
        an argument or a parameter is invalid, or 3 if another graph is running.
    """
    signals = Signals()
    with ros(sys.argv):
        code, failure = EXIT_DONE, None
        nodes: Sequence[GraphNode] = ()
        try:
            nodes = make()
            for node in nodes:
                refuse_unknown(node, sys.argv)
            spin(nodes, signals.check)
        except InterruptedRun:
            pass
        except Exception as error:  # whatever the error, its cause must be reported
            failure, code = print_failure(error)
        finally:
            if nodes and end_nodes(nodes, failure) is not None:
                code = code or EXIT_FAILED
            destroy_nodes(nodes)
    return code


def spin_alone(nodes: Sequence[LockstepNode], check: Callable[[], None]) -> None:
    """Run a node of a simulated graph until its run is over; see :func:`node_command`."""
    (node,) = nodes

    def may_end() -> bool:
        check()
        return node.may_end

    spin(nodes, may_end)
