"""Executables of nodes: command line, ``--help``, running the node, and exit code."""

from __future__ import annotations

import argparse
import math
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NoReturn

from rclpy.utilities import remove_ros_args

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_USAGE,
    command,
)
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.ros.errors import print_failure
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.lockstep import LockstepNode
from greenroof_ros.ros.parameters import default_site, refuse_unknown, type_name
from greenroof_ros.ros.spin import destroy_nodes, end_nodes, ros, spin


class NodeParser(argparse.ArgumentParser):
    """Parser for the node's own arguments, as opposed to ROS arguments, with one-line errors."""

    def error(self, message: str) -> NoReturn:
        """Print an error as one line, and exit."""
        self.exit(EXIT_USAGE, f"error: {message}; --help lists the node's arguments\n")

    def parse_own_args(self) -> argparse.Namespace:
        """Return the process's own arguments."""
        try:
            argv = remove_ros_args(sys.argv)
        except RuntimeError as error:  # rcl cannot parse the arguments
            self.error(" ".join(str(error).split()))
        return self.parse_args(argv[1:])


def node_command(
    make: Callable[..., Any], module: str, purpose: str | None,
    parameters: Callable[[Any], Iterable[Parameter]], option: str = "",
    spin: Callable[[Any, Callable[[], None]], None] | None = None,
) -> Callable[[], NoReturn]:
    """Return the main function of a node's executable.

    Args:
        make: function that returns the node, or the nodes, of this process; its argument is the
            value of the option, if there is an option.
        module: the node's module in this package, for ``--help``.
        purpose: docstring of the node's module, which describes the node.
        parameters: function that returns all parameters that the node declares for a site or, if
            there is an option, for the option's value (None if the user omits it).
        option: the option that the node requires, such as ``--of``; empty for none.
        spin: function that runs the nodes and, 20 times a second, calls its second argument, which
            can raise an error; None for a node of a simulated graph.
    """

    @command
    def main() -> int:
        parser = NodeParser(add_help=False, allow_abbrev=False)
        parser.add_argument("-h", "--help", action="store_true")
        if option:
            parser.add_argument(option, dest="value")
        arguments = parser.parse_own_args()
        of = [arguments.value] if option else []
        if arguments.help:
            usage = f"{module} {option} VALUE" if option else module
            print(node_help(usage, purpose, parameters(*of or [default_site()])))
            return EXIT_DONE
        if of == [None]:
            parser.error(f"{option} is missing")
        return run_nodes(partial(make, *of), spin or spin_alone)

    return main


def node_help(module: str, purpose: str | None, parameters: Iterable[Parameter]) -> str:
    """Return the text of a node's ``--help``.

    Args:
        module: the node's module in this package, followed by the arguments that it requires.
        purpose: docstring of the node's module, which describes the node.
        parameters: all parameters that the node declares.
    """
    lines = [
        f"usage: python -m greenroof_ros.{module} [--help] [--ros-args ...]\n",
        f"{purpose}".strip().replace("``", "`"),
        "\nparameters, set after --ros-args with -p NAME:=VALUE or --params-file FILE:",
    ]
    for parameter in parameters:
        lines += (f"  {parameter.name} ({_about(parameter)})", textwrap.fill(
            parameter.description, 96, initial_indent=" " * 6, subsequent_indent=" " * 6,
            break_on_hyphens=False,
        ))
    return "\n".join(lines)


def _about(parameter: Parameter) -> str:
    """Return a parameter's type, range and default, formatted as in a parameter file."""
    default = parameter.default
    if isinstance(default, list):
        default = f"[{', '.join(default)}]"
    elif isinstance(default, bool):
        default = str(default).lower()
    elif isinstance(default, float):
        default = f"{default:.7g}" if default % 1 else f"{default:.1f}"
        if math.isnan(parameter.default):
            default = "set by the site"
    limits = f"{parameter.limits and ', '}{parameter.limits}"
    changes = "; may change during a run" if parameter.may_change else ""
    return f"{type_name(parameter)}{limits}; default {str(default) or 'empty'}{changes}"


# --- the process ----------------------------------------------------------------------------------


def run_nodes(
    make: Callable[[], GraphNode | Sequence[GraphNode]],
    spin: Callable[[Any, Callable[[], None]], None],
) -> int:
    """Run the nodes of this process until the run is over, a signal stops them, or a node fails.

    Args:
        make: class of the node, or a function that returns the node or the nodes.
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
            made = make()
            nodes = [made] if isinstance(made, GraphNode) else made
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
    """Run a node of a simulated graph until its run is over; see :func:`node_command`.

    Before the node acts for the first time, log the nodes that it is waiting for whenever they
    change.
    """
    (node,) = nodes
    missing: list[str] = []

    def may_end() -> bool:
        nonlocal missing
        check()
        before = missing
        if not node.acted:
            missing = sorted(map(node.peers.name_of, node.peers.absent()))
        if missing != before:
            awaited = ", ".join(missing)
            node.get_logger().info(
                f"waiting for {awaited}" if missing else "all inputs have publishers"
            )
        return node.may_end

    spin(nodes, may_end)
