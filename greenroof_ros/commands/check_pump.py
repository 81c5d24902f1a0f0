"""Check through topics whether a running pump driver, in any language, follows the interface.

THE PUMP WILL RUN, while its driver receives invented levels and invented weather: with a real pump,
make sure that there is water in the cistern, room on the roof and no frost. The check takes the
place of all other nodes, so do not start a run.

The flows that the driver reports are the only evidence: topics cannot show whether the pump's shaft
has really stopped, so watch the pump.

Example:
  python my_driver.py &
  greenroof check-pump --node pump

Exit codes: 0 all checks passed, 1 a check failed, 2 the driver was not found, 3 a graph is running
"""

from __future__ import annotations

from greenroof_ros.base.command_line import (
    CHECKED_NODE,
    Parser,
    add_site,
    command,
    make_number_type,
    print_results,
)
from greenroof_ros.ros.domain import prepare_ros
from greenroof_ros.site.file import read_site


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("check-pump", __doc__, "--node NAME [options]")
    parser.add_argument("--node", required=True, metavar="NAME", help=CHECKED_NODE)
    parser.add_argument(
        "--command", type=make_number_type(0.001, 1.0), default=0.5, metavar="SHARE",
        help="run the pump at this share of its maximum flow (default: 0.5)",
    )
    parser.add_argument(
        "--live", action="store_true",
        help="expect the driver to publish its flow on its own clock, not once for each command",
    )
    parser.add_argument(
        "--period", type=make_number_type(0.001, 3600.0), default=0.1, metavar="S",
        help="minimum interval between two commands (s), each of which is a tick of the site; with "
        "--live and with a real pump, use the site's tau, 1 (default: 0.1)",
    )
    add_site(parser, "send the driver the levels and ticks of this site")
    return parser


@command
def main() -> int:
    """Check the driver named on the command line."""
    arguments = make_parser().parse_args()
    prepare_ros()
    from greenroof_ros.nodes.check import PumpCheck, check_node, describe_duration
    print(f"THE PUMP WILL RUN. The check takes {describe_duration(arguments.period)}.")
    site = read_site(arguments.site)
    code = print_results(arguments.node, check_node(lambda: PumpCheck(
        arguments.node, site, command=arguments.command, period=arguments.period,
        live=arguments.live,
    )))
    print("Topics cannot show whether the pump's shaft has really stopped, so watch the pump.")
    return code
