"""A node as a process: set up, spun, asked to stop, and its exit code."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED, EXIT_USAGE, exit_code
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.graph.domain import begin_to_listen, choose_transport, make_executor
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.parameters import refuse_unknown
from greenroof_ros.graph.states import LockstepError

# How long the middleware may take to go (s); it is a fraction of a second, but on a busy machine.
_TAKING_DOWN_S = 6


def run_node(make: Callable[[], LinkedNode]) -> int:
    """Run one node until it is asked to stop, fails, or the run is over for all who were in it.

    The process has to end with it, soon.

    Args:
        make: the node's class, or what else returns the node.

    Returns:
        An exit code: 0 over or asked to stop, 1 failed, 2 wrong arguments or parameters, 3 another
        graph is there.
    """
    choose_transport()
    stopping = False

    def on_signal(signum: int, frame: Any) -> None:
        nonlocal stopping
        stopping = True

    # Not rclpy's own handlers: after them nothing can be published, and a node that stops has a
    # last word.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, on_signal)
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # of rcl: arguments that it cannot read
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return EXIT_USAGE
    code = EXIT_DONE
    failure: str | None = None
    node: LinkedNode | None = None
    try:
        node = make()
        refuse_unknown(node, sys.argv)
        if not node.live:
            _run_in_batches()
        executor = SingleThreadedExecutor() if node.live else make_executor()
        begin_to_listen(executor, node)
        while not (stopping or node.over):
            executor.spin_once(timeout_sec=node.listen_s())
            node.check()
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        code, failure = exit_code(error), str(error)
    except (LockstepError, OSError) as error:
        code, failure = _failed(node, error)
    except ExternalShutdownException:
        pass
    finally:
        if node is not None:
            try:
                node.on_stop()
            except OSError as error:
                code, failure = _failed(node, error)
            node.flush(failure)
        # All is said and written. Fast DDS can lock up, and spin, in taking itself down while a
        # peer does the same, be it here or where Python frees the last of it at the process's end;
        # no Python would run then, so that the kernel has to end it.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_TAKING_DOWN_S)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def _run_in_batches() -> None:
    """Have the process preempt no other when it is woken: only in a simulation, which waits anyway.

    Whoever wakes a peer then goes on until it has said all it has to say. Being preempted by each
    of those that it wakes costs a third more of processor time per tick. A live node must be in
    time, also beside a process that computes for hours.
    """
    for thread in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has just ended
            os.sched_setscheduler(int(thread.name), os.SCHED_BATCH, os.sched_param(0))


def _failed(node: LinkedNode | None, error: Exception) -> tuple[int, str]:
    """Log what ends the node, or print it before there is one; return exit code and reason."""
    if node is None:
        print(f"error: {error}", file=sys.stderr)
    else:
        node.get_logger().fatal(str(error))
    return EXIT_FAILED, str(error)
