"""Check a controller, which is a class or a running node: ``greenroof check-controller``."""

from __future__ import annotations

import argparse

from greenroof_ros.base.command_line import Parser, add_site, command, make_number_type
from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import BUILT_IN, find_controller
from greenroof_ros.nodes.check_results import print_results
from greenroof_ros.ros.domain import require_ros
from greenroof_ros.simulation.options import add_output_arguments, add_run_arguments
from greenroof_ros.site.file import read_site
from greenroof_ros.site.horizon import MAX_HORIZON

_CLASS = (
    "Check that a controller behaves as the node graph, simulate, studies and reports require: "
    "its commands are finite, not negative, and the same for the same inputs, and it copes with "
    "skipped ticks, with missing forecasts and with its parameters. Every failure is listed "
    "together with the required behaviour."
)
_NODE = (
    "With --node, check a running node, written in any language, for use with 'greenroof run "
    "--controller external'. Once all inputs of a tick have arrived, in whatever order, the node "
    "must publish exactly one command to the pump and, if the site has an outlet valve, one to the "
    "valve. They must be 0 while a level or frost is not finite, and that to the pump also in "
    "frost. The node must use the quality of service of the interface, and stop when /clock no "
    "longer has a publisher. The check takes the place of the plant node and the weather node, so "
    "do not start a run. At the end, the check stops the node."
)


def _check_options(reference: str) -> str:
    """Return which parameter has the same name as an option of the commands; empty for none."""
    parser = Parser()
    try:
        add_run_arguments(parser, ["--controller", reference])
        add_output_arguments(parser)
    except argparse.ArgumentError as error:
        return f"{error}; rename the parameter"
    return ""


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof check-controller",
        description=f"{_CLASS}\n\n{_NODE}",
        epilog="examples:\n  greenroof check-controller my_package.my_module:MyController\n"
        "  python my_controller_node.py &\n"
        "  greenroof check-controller --node controller\n\n"
        "exit codes: 0 all checks passed, 1 a check failed, 2 the controller cannot be "
        "imported or the node was not found, 3 a graph is running",
    )
    subject = parser.add_mutually_exclusive_group(required=True)
    subject.add_argument(
        "controller", nargs="?", metavar="CONTROLLER",
        help=f"check this controller: package.module:Class, or one of {', '.join(BUILT_IN)}",
    )
    subject.add_argument(
        "--node", metavar="NAME",
        help="check the running node of this name, including its namespace if it has one, such as "
        "/site1/controller",
    )
    node = parser.add_argument_group("options with --node")
    node.add_argument(
        "--horizon", type=make_number_type(0.0, MAX_HORIZON), default=0.0, metavar="H",
        help="length of the forecasts to send (h), as for 'greenroof run --controller external' "
        "(default: 0, for the next M ticks)",
    )
    add_site(parser, "check the controller with this site")
    return parser


@command
def main() -> int:
    """Check the controller named on the command line."""
    arguments = make_parser().parse_args()
    site = read_site(arguments.site)
    if arguments.node is not None:
        with require_ros():
            from greenroof_ros.nodes.check import check_node
            from greenroof_ros.nodes.check_controller import ControllerCheck
        return print_results(
            f"controller node {arguments.node}",
            check_node(lambda: ControllerCheck(arguments.node, site, horizon=arguments.horizon)),
        )
    choice = find_controller(arguments.controller)
    problems = check_controller(choice, site)
    problems["none of its parameters has the same name as an option of the commands"] = (
        _check_options(arguments.controller)
    )
    results = [(check, problem, "") for check, problem in problems.items()]
    return print_results(f"{choice.name}, {choice.path}", results)
