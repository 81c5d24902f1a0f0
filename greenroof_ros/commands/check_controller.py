"""Check that a controller behaves as the node graph, simulate, studies and reports require.

Its commands must be finite, not negative, and the same for the same inputs, and it must cope with
skipped ticks, with missing forecasts and with its parameters. Without --site, a class that commands
the outlet valve is checked with config/site_valve.yaml.

With --node, check a running node, in any language, for 'greenroof run --controller external'. The
check takes the place of all other nodes, so do not start a run. At the end, it stops the node.

Examples:
  greenroof check-controller my_package.my_module:MyController
  python my_node.py &
  greenroof check-controller --node controller

Exit codes: 0 all checks passed, 1 a check failed, 2 the controller cannot be imported or the node
was not found, 3 a graph is running
"""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.base.command_line import (
    CHECKED_NODE,
    Parser,
    add_site,
    command,
    make_number_type,
    print_results,
)
from greenroof_ros.base.files import default_site_file, find_shipped
from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import BUILT_IN, find_controller
from greenroof_ros.ros.domain import prepare_ros
from greenroof_ros.site.file import read_site
from greenroof_ros.site.horizon import MAX_HORIZON


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("check-controller", __doc__, "(CONTROLLER | --node NAME) [options]")
    subject = parser.add_mutually_exclusive_group(required=True)
    subject.add_argument(
        "controller", nargs="?", metavar="CONTROLLER",
        help=f"check this controller: package.module:Class, or one of {', '.join(BUILT_IN)}",
    )
    subject.add_argument("--node", metavar="NAME", help=CHECKED_NODE)
    parser.add_argument(
        "--horizon", type=make_number_type(0.0, MAX_HORIZON), default=0.0, metavar="H",
        help="with --node, length of the forecasts to send (h), as for 'greenroof run "
        "--controller external' (default: 0, for the next M ticks)",
    )
    add_site(parser, "check the controller with this site")
    return parser


@command
def main() -> int:
    """Check the controller named on the command line."""
    arguments = make_parser().parse_args()
    site = read_site(find_shipped(arguments.site))
    if arguments.node is not None:
        prepare_ros()
        from greenroof_ros.nodes.check import ControllerCheck, check_node
        return print_results(arguments.node, check_node(
            lambda: ControllerCheck(arguments.node, site, horizon=arguments.horizon)
        ))
    choice = find_controller(arguments.controller)
    if arguments.site == default_site_file() and hasattr(choice.kind, "outlet"):
        site = read_site(find_shipped(Path("site_valve.yaml")))
    return print_results(
        f"{choice.name}, {choice.path}", check_controller(choice, site).items()
    )
