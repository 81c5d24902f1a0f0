"""The executable of a node: its command line and ``--help``, start, end and exit code."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import textwrap
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NoReturn

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_USAGE,
    command,
    exit_code,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.processes import InterruptedRun, Signals
from greenroof_ros.graph.domain import (
    TAKING_DOWN_S,
    begin_to_listen,
    choose_transport,
    make_executor,
)
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.messages import LockstepError
from greenroof_ros.graph.parameters import default_site, refuse_unknown, type_name
from greenroof_ros.graph.peers import Peers
from greenroof_ros.graph.supervision import PUMP
from greenroof_ros.model.site import Site


class _Parser(argparse.ArgumentParser):
    """Reads a node's own arguments (other than ROS arguments); prints errors in one line."""

    def error(self, message: str) -> NoReturn:
        """Print an error in one line and end the process."""
        self.exit(EXIT_USAGE, f"error: {message}; --help shows what the node takes\n")


def node_command(
    make: Callable[..., LinkedNode], help_of: Callable[..., str], option: str = "",
    choices: Sequence[str] = (), value: str | None = None,
) -> Callable[[], NoReturn]:
    """Return the executable of a node.

    Args:
        make: returns the node; called with the value of the option, if there is an option.
        help_of: returns the text of ``--help``; called likewise, with None if the value is missing.
        option: the option that the node requires, such as ``--of``; empty for none.
        choices: allowed values of the option; empty for any.
        value: fixed value of the option; the command line then has no such option.
    """

    @command
    def main() -> int:
        """Run the node, or print its help."""
        parser = _Parser(add_help=False, allow_abbrev=False)
        parser.add_argument("-h", "--help", action="store_true")
        if option and value is None:
            parser.add_argument(option, dest="value", choices=choices or None)
        try:
            argv = remove_ros_args(sys.argv)
        except RuntimeError as error:  # rcl cannot parse the arguments
            parser.error(" ".join(str(error).split()))
        arguments = parser.parse_args(argv[1:], argparse.Namespace(value=value))
        of = [arguments.value] if option else []
        if arguments.help:
            print(help_of(*of))
            return EXIT_DONE
        if of == [None]:
            parser.error(": ".join(filter(None, (f"{option} is missing", " or ".join(choices)))))
        return run_node(partial(make, *of))

    return main


def node_help(
    module: str,
    role: str,
    purpose: str | None,
    parameters: Callable[[Site], Iterable[Parameter]],
    example: str,
    outputs: Collection[str] = (),
    *,
    always_live: bool = False,
) -> str:
    """Return the text of a node's ``--help``.

    Args:
        module: its module, and the arguments that it requires.
        role: its role in the interface.
        purpose: what it does; a module docstring.
        parameters: returns all parameters that it declares for a site.
        example: the arguments in the example.
        outputs: the optional topics that it publishes.
        always_live: whether it is only for live graphs.
    """
    start = f"python -m greenroof_ros.nodes.{module}"
    topics = [topic for topic in read_topics().values() if topic.live or not always_live]
    sections = {
        "parameters, after --ros-args as -p NAME:=VALUE or by --params-file FILE": [
            (parameter.name, _about(parameter), parameter.description)
            for parameter in parameters(default_site())
        ],
        **{
            heading: [
                (topic.name, f"{topic.type}{topic.unit and ', unit '}{topic.unit}", topic.meaning)
                for topic in topics if role in roles(topic)
                and (heading != "publishes" or not topic.optional or topic.name in outputs)
            ]
            for heading, roles in {
                "publishes": lambda topic: (*topic.publishers, *topic.live_publishers),
                "subscribes to": lambda topic: topic.subscribers,
                "in a live graph also to": lambda topic: topic.live_subscribers,
            }.items()
        },
    }
    return "\n".join([
        f"usage: {start} [--help] [--ros-args ...]\n",
        f"{purpose}".strip().replace("``", "`"),
        *(line for heading in sections for line in _section(heading, sections[heading])),
        f"\nexample:\n  {start} {example}",
    ])


def _section(heading: str, entries: list[tuple[str, str, str]]) -> Iterator[str]:
    """Yield the lines of a section; none if it has no entries."""
    if entries:
        yield f"\n{heading}:"
    for name, about, meaning in entries:
        yield f"  {name} ({about})"
        yield textwrap.fill(
            meaning, 96, initial_indent=" " * 6, subsequent_indent=" " * 6, break_on_hyphens=False
        )


def _about(parameter: Parameter) -> str:
    """Return a parameter's type, range and default, formatted as in a parameter file."""
    default = parameter.default
    if isinstance(default, list):
        default = f"[{', '.join(default)}]"
    elif isinstance(default, bool):
        default = str(default).lower()
    elif isinstance(default, float):
        default = f"{default:.7g}" if default % 1 else f"{default:.1f}"
    limits = f"{parameter.limits and ', '}{parameter.limits}"
    changes = "; may change in a run" if parameter.may_change else ""
    return f"{type_name(parameter)}{limits}; default {str(default) or 'empty'}{changes}"


# --- the process ----------------------------------------------------------------------------------


def run_node(make: Callable[[], LinkedNode]) -> int:
    """Run one node until it is asked to stop, fails, or the run is over for all its nodes.

    The process must end within 6 s of the return: a SIGALRM is pending.

    Args:
        make: the node's class, or a function that returns the node.

    Returns:
        An exit code: 0 if the run is over or the node was asked to stop, 1 if the node failed, 2 if
        arguments or parameters are wrong, 3 if there is another graph.
    """
    choose_transport()
    # Not rclpy's own handlers: after them nothing can be published, and a node that stops must
    # still send its last report.
    signals = Signals()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # rcl cannot parse the arguments
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return EXIT_USAGE
    code = EXIT_DONE
    failure: str | None = None
    node: LinkedNode | None = None
    try:
        node = make()
        refuse_unknown(node, sys.argv)
        if not node.live and node.role != PUMP:
            _run_in_batches()
        executor = SingleThreadedExecutor() if node.live else make_executor()
        begin_to_listen(executor, node)
        peers = None if node.live else Peers(node)
        while peers is None or not peers.over:
            signals.check()
            executor.spin_once(timeout_sec=node.listen_s())
            node.check()
            if peers is not None:
                peers.look(time.monotonic())
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        code, failure = exit_code(error), str(error)
    except (LockstepError, OSError) as error:
        code, failure = _failed(node, error)
    except (InterruptedRun, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            try:
                node.on_stop()
            except OSError as error:
                code, failure = _failed(node, error)
            node.flush(failure)
        # Everything has been sent and written. From here the kernel ends a process that locks up.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(TAKING_DOWN_S)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def _run_in_batches() -> None:
    """Give the process batch scheduling, so that it preempts no other process when it wakes up.

    A node that wakes a peer then goes on until it has sent everything. Being preempted by each peer
    that it wakes would cost a third more processor time per tick. Not for a live node or one that
    runs a drive: they must be on time even beside a process that computes for hours.
    """
    for thread in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has just ended
            os.sched_setscheduler(int(thread.name), os.SCHED_BATCH, os.sched_param(0))


def _failed(node: LinkedNode | None, error: Exception) -> tuple[int, str]:
    """Log the error that ends the node, or print it if there is no node; return code and reason."""
    if node is None:
        print(f"error: {error}", file=sys.stderr)
    else:
        node.get_logger().fatal(str(error))
    return EXIT_FAILED, str(error)
