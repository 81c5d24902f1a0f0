"""Check whether a pump driver complies with the interface: ``greenroof check-pump``."""

from __future__ import annotations

from greenroof_ros.base.command_line import Parser, add_site, command, make_number_type
from greenroof_ros.nodes.check_results import print_results
from greenroof_ros.ros.domain import require_ros
from greenroof_ros.site.file import read_site

_INVENTED = (
    "THE PUMP WILL RUN. The check sends invented levels and invented weather, so it would let the "
    "pump run a cistern dry, or pump into a frozen pipe. With a real pump, make sure that there is "
    "water in the cistern, room on the roof and no frost, and set --period to the site's tau (1). "
    "With a period of 0.1, the motor's actual minimum on and off times are only a tenth of those "
    "configured, and the motor is started ten times. The first line says how long the check takes."
)
_SUBJECT = (
    "Check through topics whether a running pump driver, in any language, follows the interface: "
    "when the pump must stop, that it runs again afterwards, and that the driver publishes one "
    "flow for each command, in whatever order its inputs come. The check takes the place of the "
    "plant node, the weather node and the controller, so do not start a run. Use --live for the "
    "driver of a live graph, such as this package's pump node, which publishes its flow every tau "
    "without waiting for a command."
)
_LIMIT = (
    "The flows that the driver reports are the only evidence: topics cannot show whether the "
    "pump's shaft has really stopped, so watch the pump."
)


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof check-pump",
        description=f"{_INVENTED}\n\n{_SUBJECT}\n\n{_LIMIT}",
        epilog="example:\n  python my_driver.py &\n"
        "  greenroof check-pump --node pump\n"
        "  greenroof check-pump --node pump --live --period 1    # the package's pump node\n\n"
        "exit codes: 0 all checks passed, 1 a check failed, 2 the driver was not found, 3 a "
        "graph is running",
    )
    parser.add_argument(
        "--node", required=True, metavar="NAME",
        help="check the node of this name, including its namespace if it has one, such as "
        "/site1/pump",
    )
    parser.add_argument(
        "--command", type=make_number_type(0.001, 1.0), default=0.5, metavar="SHARE",
        help="run the pump at this command, as a share of the pump's maximum flow (default: 0.5)",
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
    with require_ros():
        from greenroof_ros.nodes.check import check_node
        from greenroof_ros.nodes.check_pump import PumpCheck, describe_duration
    site = read_site(arguments.site)
    print(f"THE PUMP WILL RUN. The check takes {describe_duration(arguments.period)}.")
    code = print_results(f"pump driver {arguments.node}", check_node(lambda: PumpCheck(
        arguments.node, site, command=arguments.command, period=arguments.period,
        live=arguments.live,
    )))
    print(_LIMIT)
    return code
