"""The site as a ROS 2 graph: ``greenroof run`` and ``greenroof live``.

A run is simulated, also with a drive in the loop (:mod:`.simulated`), or live (:mod:`.live`).
"""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from functools import partial

from greenroof_ros.bringup.drive import add_drive_arguments
from greenroof_ros.bringup.live import run_live
from greenroof_ros.bringup.live_site import (
    EXTERNAL,
    add_live_arguments,
    live_site,
    refuse_options,
)
from greenroof_ros.bringup.simulated import run_simulated, simulated_run
from greenroof_ros.common.command_line import EXIT_INTERRUPTED, command, within
from greenroof_ros.common.namespace import namespace
from greenroof_ros.common.signals import InterruptedRun, Signals
from greenroof_ros.experiment.options import (
    add_output_arguments,
    add_run_arguments,
    parse_run_arguments,
)
from greenroof_ros.watch.beside import watcher


def make_parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    parser = argparse.ArgumentParser(
        prog="greenroof {run,live}",
        usage="%(prog)s [options]",
        description="Start plant, weather, controller and recorder as ROS 2 nodes, each its own\n"
        "process, run them in lockstep on simulated time, and end them. While it runs,\n"
        "'ros2 topic echo --qos-durability volatile /roof/level' shows the roof.\n\n"
        "Three ways to run:\n"
        "  simulated             run, with any option but those below\n"
        "  hardware in the loop  run with --drive and --drive-at: a drive, not a simulated pump\n"
        "  live                  live: a site with sensors, nothing is simulated\n\n"
        "python -m greenroof_ros.bringup is both, by its option --plant.",
        epilog="examples:\n"
        "  greenroof run --controller lookahead --initial high-low\n"
        "  greenroof run --weather mine.csv --start 2024-06-01 --hours 24\n"
        "  greenroof run --namespace site1 --site site1.yaml\n"
        "  greenroof run --speed 60 --no-record\n"
        "  greenroof run --drive danfoss_fc202 --drive-at gateway://127.0.0.1:5020\n"
        "  greenroof live --sensors sensors.yaml --forecast forecast.csv \\\n"
        "    --drive danfoss_fc202 --drive-at /dev/ttyUSB0\n\n"
        "exit codes: 0 done, or live and asked to stop, 1 a node failed, the pump may run on, or\n"
        "done with incidents: a drive or a sensor was lost for a while, 2 bad usage or\n"
        "configuration, 3 a graph is there already, 130 interrupted",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run_arguments(parser)
    add_output_arguments(parser)
    group = parser.add_argument_group("the graph")
    group.add_argument(
        "--pump", choices=["internal", "external"], default="internal",
        help="external: /pump/flow comes from a pump driver that you start yourself "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--namespace", type=namespace, default="", metavar="NAME",
        help="put the whole graph, its clock too, under /NAME, so that several run side by side "
        "in one domain (default: none)",
    )
    group.add_argument(
        "--peer-limit", type=within(2, 1e6), default=5.0, metavar="S",
        help="longest wait for a node, in wall time, 2 s at least: nodes that join listen for a "
        "second (default: %(default)s s)",
    )
    group.add_argument(
        "--watch", action="store_true",
        help="show the run on a page in a browser, whose address is printed. It ends with the run, "
        "which goes on without it; greenroof watch is a page that stays. Needs "
        "greenroof_ros[watch]",
    )
    add_drive_arguments(parser)
    add_live_arguments(parser)
    parser.set_defaults(speed=None)
    return parser


@command
def main() -> int:
    """Bring the graph up, watch it, and end it."""
    parser = make_parser()
    arguments = parse_run_arguments(parser)
    signals = Signals()
    try:
        if arguments.plant == EXTERNAL:
            site = live_site(parser, arguments)
            site_file, start = site.site_file, partial(run_live, site)
        else:
            refuse_options("simulated", parser, arguments)
            run = simulated_run(arguments)
            site_file, start = run.site_file, partial(run_simulated, run)
        with watcher(arguments.namespace, site_file) if arguments.watch else nullcontext():
            return start(arguments, signals)
    except InterruptedRun as error:  # before a node was started
        print(error, file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    main()
