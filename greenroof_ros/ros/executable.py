"""Executables of nodes: command line, running the nodes, and exit code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from rclpy.utilities import remove_ros_args

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED, Parser, command
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.ros.errors import print_failure
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.lockstep import LockstepNode
from greenroof_ros.ros.parameters import refuse_unknown
from greenroof_ros.ros.spin import destroy_nodes, end_nodes, ros, spin


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
