"""Check whether a class is a controller: ``greenroof check-controller``."""

from __future__ import annotations

import argparse
from pathlib import Path

from greenroof_ros.common.command_line import Finding, Parser, command, print_findings
from greenroof_ros.common.files import shared_directory
from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import controller_names, find_controller
from greenroof_ros.experiment.options import add_output_arguments, add_run_arguments
from greenroof_ros.model.site import read_site


def _options(reference: str) -> Finding:
    """Check that no parameter has the name of an option of the commands."""
    parser = Parser()
    problem = ""
    try:
        add_run_arguments(parser, ["--controller", reference])
        add_output_arguments(parser)
    except argparse.ArgumentError as error:
        problem = f"{error}; rename the parameter"
    return Finding("its parameters have names that no option of the commands has", problem)


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof check-controller",
        description="Check that a controller does what the node graph, simulate, studies and "
        "reports rely on: commands finite and not negative, the same for the same inputs, skipped "
        "ticks, missing forecasts, parameters. Each failure is listed with the correct behaviour.",
        epilog="example:\n  greenroof check-controller my_package.my_module:MyController\n\n"
        "exit codes: 0 all is right, 1 a check failed, 2 it cannot be imported",
    )
    parser.add_argument(
        "controller", metavar="CONTROLLER",
        help=f"package.module:Class, or one of {', '.join(controller_names())}",
    )
    parser.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site with which it is checked (default: the paper's, config/site.yaml)",
    )
    return parser


@command
def main() -> int:
    """Check the controller named on the command line."""
    arguments = make_parser().parse_args()
    choice = find_controller(arguments.controller)
    site = read_site(arguments.site or shared_directory() / "config" / "site.yaml")
    findings = [*check_controller(choice, site), _options(arguments.controller)]
    return print_findings(f"{choice.name}, {choice.path}", findings)


if __name__ == "__main__":
    main()
