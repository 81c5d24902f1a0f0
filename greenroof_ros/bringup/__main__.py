"""A simulated site as a ROS 2 graph, also with a drive in the loop: ``greenroof run``."""

from __future__ import annotations

import argparse
import sys
from functools import partial

from greenroof_ros.bringup import live
from greenroof_ros.bringup.drive import add_graph_arguments, bring_up
from greenroof_ros.bringup.simulated import run_simulated, simulated_run
from greenroof_ros.common.command_line import command
from greenroof_ros.experiment.options import (
    add_output_arguments,
    add_run_arguments,
    parse_run_arguments,
)


def make_parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    parser = argparse.ArgumentParser(
        prog="greenroof run",
        usage="%(prog)s [options]",
        description="Start plant, weather, controller and recorder as ROS 2 nodes, each its own\n"
        "process, run them in lockstep on simulated time, and end them. While it runs,\n"
        "'ros2 topic echo --qos-durability volatile /roof/level' shows the roof.\n\n"
        "With --drive and --drive-at there is hardware in the loop: a drive, and no simulated\n"
        "pump, at real time, or with the drive simulator at another --speed.\n\n"
        "A site with sensors, at which nothing is simulated, is greenroof live, or\n"
        "python -m greenroof_ros.bringup --plant external.",
        epilog="examples:\n"
        "  greenroof run --controller lookahead --initial high-low\n"
        "  greenroof run --weather mine.csv --start 2024-06-01 --hours 24\n"
        "  greenroof run --namespace site1 --site site1.yaml\n"
        "  greenroof run --speed 60 --no-record\n"
        "  greenroof run --drive danfoss_fc202 --drive-at gateway://127.0.0.1:5020\n\n"
        "exit codes: 0 done, 1 a node failed, the pump may run on, or done with incidents: a\n"
        "drive was lost for a while, 2 bad usage or configuration, 3 a graph is there already,\n"
        "130 interrupted",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run_arguments(parser)
    add_output_arguments(parser)
    add_graph_arguments(parser, "internal")
    parser.set_defaults(speed=None)
    return parser


@command
def main() -> int:
    """Bring the graph up, watch it, and end it; ``--plant external`` is ``greenroof live``."""
    parser = argparse.ArgumentParser(prog="greenroof run", add_help=False, allow_abbrev=False)
    parser.add_argument("--plant", choices=["internal", "external"])
    given, sys.argv[1:] = parser.parse_known_args()
    if given.plant == "external":
        return live.main()
    arguments = parse_run_arguments(make_parser())
    run = simulated_run(arguments)
    return bring_up(arguments, run.site_file, partial(run_simulated, run, arguments))


if __name__ == "__main__":
    main()
