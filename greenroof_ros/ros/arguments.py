"""Command-line options shared by all commands that run a graph of nodes."""

from __future__ import annotations

import argparse
from pathlib import Path

from greenroof_ros.base.command_line import make_number_type
from greenroof_ros.controllers.registry import EXTERNAL
from greenroof_ros.ros.domain import add_namespace


def add_graph_arguments(parser: argparse.ArgumentParser, pump: str = "") -> None:
    """Add the options of the graph, which ``run`` and ``live`` share.

    Args:
        parser: argument parser of the command.
        pump: default value of ``--pump``; if it is empty, ``external`` is the only choice.
    """
    group = parser.add_argument_group("the graph")
    group.add_argument(
        "--pump", choices=[*filter(None, [pump]), EXTERNAL], default=pump,
        help="source of /pump/flow; external selects a pump driver that you start yourself"
        + (f" (default: {pump})" if pump else ""),
    )
    add_namespace(
        group, "put the whole graph, including its clock, in the namespace /NAME, so that several "
        "graphs can run side by side in one ROS domain",
    )
    if pump:
        group.add_argument(
            "--peer-limit", type=make_number_type(2, 1e6), default=5.0, metavar="S",
            help="longest time to wait for a node (s of wall time; default: %(default)s s)",
        )
    group.add_argument(
        "--watch", action="store_true",
        help="show the graph on a page in a web browser, and print the address of the page; for a "
        "run, only at a --speed of 60 or less. The page closes when the graph stops, whereas the "
        "page of greenroof watch stays open. Requires the extra [watch]",
    )
    if not pump:
        group.add_argument(
            "--node-parameters", type=Path, metavar="FILE",
            help="ROS 2 parameter file for the parameters that bringup does not set, such as the "
            "limits of the pump node (doc/reference/nodes.md); unknown parameters are rejected",
        )
