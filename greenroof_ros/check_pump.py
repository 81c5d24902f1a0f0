"""Whether a pump driver keeps to the interface: ``greenroof check-pump``."""

from __future__ import annotations

import argparse
from pathlib import Path

from greenroof_ros.common.command_line import command, within
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.findings import print_findings
from greenroof_ros.graph.domain import no_ros
from greenroof_ros.model.site import read_site

_INVENTED = (
    "The levels and the weather that it tells are invented: it would have an empty cistern pumped "
    "dry, and water pumped into a frozen pipe. With a real pump see yourself that there is water "
    "in the cistern, room on the roof and no frost, and give the --period of the site's tau (1): "
    "at 0.1 the least times on and off pass ten times as fast for the motor, which is started nine "
    "times."
)
_LIMIT = (
    "The flows that it answers are the only witness: whether the pump's shaft really stands is not "
    "seen over topics, so look at the pump. Lockstep is played, one flow for each command; not a "
    "live graph, in which a driver must also stop for an input that falls silent."
)


def make_parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    parser = argparse.ArgumentParser(
        prog="greenroof check-pump",
        description="Hold a pump driver that runs, be it this package's or your own in any "
        "language, to the interface over topics alone: off at start, one flow for each command, "
        "refused values, watchdog, a second publisher, frost, levels and frost that are unknown, a "
        "cistern at the suction level, and that it runs again after each. It plays plant, weather "
        f"and controller itself, so start no bringup; THE PUMP WILL RUN. {_INVENTED} {_LIMIT}",
        epilog="example:\n  python examples/pump_driver.py &\n"
        "  greenroof check-pump --node pump\n\n"
        "exit codes: 0 all is right, 1 a check failed, 2 there is no such driver, 3 a graph is at "
        "work",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    number = within(0.001, 3600.0)
    parser.add_argument(
        "--node", required=True, metavar="NAME",
        help="name of the driver's node, with its namespace where it has one: /site1/pump",
    )
    parser.add_argument(
        "--command", type=within(0.001, 1.0), default=0.5, metavar="SHARE",
        help="at which the pump is to run, a share of its maximum flow (default: 0.5)",
    )
    parser.add_argument(
        "--period", type=number, default=0.1, metavar="S",
        help="least time between two commands; each is a tick of the site; with a "
        "real pump its tau, 1 (default: 0.1)",
    )
    parser.add_argument(
        "--answer-within", type=number, default=5.0, metavar="S",
        help="how long a flow may take to answer a command (default: 5)",
    )
    parser.add_argument(
        "--start-within", type=number, default=60.0, metavar="S",
        help="how long the flow may take to become steady (default: 60)",
    )
    parser.add_argument(
        "--stop-within", type=number, default=30.0, metavar="S",
        help="how long the flow may take to become 0, whatever the pump is to stop for; it may "
        "ramp down (default: 30)",
    )
    parser.add_argument(
        "--silence", type=number, default=5.0, metavar="S",
        help="how long no command comes; the pump must have stopped then (default: 5)",
    )
    parser.add_argument(
        "--wait", type=within(0.0, 3600.0), default=10.0, metavar="S",
        help="how long the driver may take to be in the graph (default: 10)",
    )
    parser.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site whose levels and ticks it is told (default: the paper's, config/site.yaml)",
    )
    return parser


@command
def main() -> int:
    """Check the driver that the command line names."""
    arguments = make_parser().parse_args()
    try:
        from greenroof_ros.graph.pump_check import Limits, check_pump
    except ImportError as error:
        raise no_ros(error) from error
    site = read_site(arguments.site or shared_directory() / "config" / "site.yaml")
    limits = Limits(
        command=arguments.command, period=arguments.period, answer=arguments.answer_within,
        start=arguments.start_within, stop=arguments.stop_within, silence=arguments.silence,
        arrival=arguments.wait,
    )
    findings = check_pump(arguments.node, site, limits)
    code = print_findings(f"pump driver {arguments.node}", findings)
    print(_LIMIT)
    return code


if __name__ == "__main__":
    main()
