"""Check a controller, a class or a running node: ``greenroof check-controller``."""

from __future__ import annotations

import argparse

from greenroof_ros.common.command_line import (
    CheckResult,
    Parser,
    add_site,
    command,
    make_number_type,
    print_check_results,
)
from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import BUILT_IN, find_controller
from greenroof_ros.experiment.options import add_output_arguments, add_run_arguments
from greenroof_ros.graph.domain import require_ros
from greenroof_ros.model.look_ahead import MAX_HORIZON
from greenroof_ros.model.site import read_site

_CLASS = (
    "Check that a controller does what the node graph, simulate, studies and reports rely on: "
    "its commands are finite, not negative, and the same for the same inputs, and it copes with "
    "skipped ticks, missing forecasts and parameters. Every failure is listed with the correct "
    "behaviour."
)
_NODE = (
    "With --node, check a running node, in any language, that 'greenroof run --controller "
    "external' can use. It must keep four rules: (1) every topic reliable, transient local, keep "
    "last 64, with a liveliness lease of 1 s for its publisher; (2) exactly one message on "
    "/pump/command for each tick, when all its inputs of the tick have arrived, and one on "
    "/outlet/command at a site whose low outlet has a valve; (3) an answer to every tick, finite "
    "and not negative, and at most 1 to the valve; 0 when a level or frost is not finite, and to "
    "the pump also in frost; "
    "(4) it ends when /clock no longer has a publisher. The check replaces plant and weather, "
    "so start no run; it ends the node."
)


def _options(reference: str) -> CheckResult:
    """Check that no parameter bears the name of an option of the commands."""
    parser = Parser()
    problem = ""
    try:
        add_run_arguments(parser, ["--controller", reference])
        add_output_arguments(parser)
    except argparse.ArgumentError as error:
        problem = f"{error}; rename the parameter"
    return CheckResult("its parameters do not have the names of the commands' options", problem)


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof check-controller",
        description=f"{_CLASS}\n\n{_NODE}",
        epilog="examples:\n  greenroof check-controller my_package.my_module:MyController\n"
        "  python my_controller_node.py &\n"
        "  greenroof check-controller --node controller\n\n"
        "exit codes: 0 all checks passed, 1 a check failed, 2 it cannot be imported, or there is "
        "no such node, 3 a graph is running",
    )
    subject = parser.add_mutually_exclusive_group(required=True)
    subject.add_argument(
        "controller", nargs="?", metavar="CONTROLLER",
        help=f"check this controller: package.module:Class, or one of {', '.join(BUILT_IN)}",
    )
    subject.add_argument(
        "--node", metavar="NAME",
        help="check the running node of this name, with its namespace if it has one: "
        "/site1/controller",
    )
    node = parser.add_argument_group("options with --node")
    node.add_argument(
        "--horizon", type=make_number_type(0.0, MAX_HORIZON), default=0.0, metavar="H",
        help="send forecasts that reach this far (h), as for 'greenroof run --controller external' "
        "(default: 0, the next M ticks)",
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
            from greenroof_ros.commands.checks.controller import ControllerCheck
            from greenroof_ros.commands.checks.node import check_node
        results = check_node("check_controller", arguments.node, lambda node, name: ControllerCheck(
            node, name, site, horizon=arguments.horizon
        ))
        return print_check_results(f"controller node {arguments.node}", results)
    choice = find_controller(arguments.controller)
    results = [*check_controller(choice, site), _options(arguments.controller)]
    return print_check_results(f"{choice.name}, {choice.path}", results)
