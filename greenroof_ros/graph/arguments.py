"""The options shared by the commands that run a graph of nodes."""

from __future__ import annotations

import argparse
from pathlib import Path

from greenroof_ros.common.command_line import add_foxglove, make_number_type, parse_namespace
from greenroof_ros.controllers.registry import EXTERNAL


def add_graph_arguments(parser: argparse.ArgumentParser, pump: str = "") -> None:
    """Add the options of a graph, which are the same for ``run`` and ``live``.

    Args:
        parser: the command's parser.
        pump: the default of ``--pump``; if empty, ``external`` is the only choice.
    """
    group = parser.add_argument_group("the graph")
    group.add_argument(
        "--pump", choices=[*filter(None, [pump]), EXTERNAL], default=pump,
        help="external: /pump/flow comes from a pump driver that you start yourself"
        + (f" (default: {pump})" if pump else ""),
    )
    group.add_argument(
        "--namespace", type=parse_namespace, default="", metavar="NAME",
        help="put the whole graph, including its clock, under /NAME, so that several can run side "
        "by side in one domain (default: none)",
    )
    group.add_argument(
        "--peer-limit", type=make_number_type(2, 1e6), default=5.0, metavar="S",
        help="wait at most this long for a node, in wall time; at least 2 s, because joining "
             "nodes listen for one second (default: %(default)s s)",
    )
    group.add_argument(
        "--watch", action="store_true",
        help="show the graph on a page in a browser, at the address that is printed; for a run, "
        "only at a --speed of 60 or less. The page ends with the graph, which does not need it; "
        "the page of greenroof watch stays. Needs the extra [watch]",
    )
    add_foxglove(
        group, "serve the graph to Foxglove or Lichtblick on this machine, at the address that is "
        "printed, until the graph ends; the graph does not need it.",
    )
    group.add_argument(
        "--node-parameters", type=Path, metavar="FILE",
        help="ROS 2 parameter file for what bringup does not decide, such as the pump node's "
        "limits; each node's --help lists its parameters; unknown ones are rejected",
    )
