"""Bounds on deviation or wet-weather discharge that no controller can beat: ``greenroof bound``."""

from __future__ import annotations

import sys

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    command,
    make_number_type,
)
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.times import hours_minutes_seconds
from greenroof_ros.simulation.bound import BLOCK_S, NoBoundError, bound_discharge, clairvoyant_bound
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.options import add_site_arguments, build_run
from greenroof_ros.simulation.run import Run, count_ticks
from greenroof_ros.simulation.screen import setting_rows, show
from greenroof_ros.simulation.summary import describe_setting


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof bound",
        usage="%(prog)s [options]",
        description="Compute a lower bound on the total deviation that any controller could "
        "achieve if it knew all weather in advance. With --of discharge, for a site with an "
        "outlet valve, compute a lower bound on the discharge in wet weather, whatever the "
        "commands to the valve, for some amounts of mains water and for the irrigation under "
        "on/off control.",
        epilog="examples:\n"
        "  greenroof bound --start 2021-07-08T05:00\n"
        "  greenroof bound --block 1 --hours 2 --max-command 0.1\n"
        "  greenroof bound --of discharge --site my_site.yaml\n\n"
        "exit codes: 0 done, 1 no bound found, 2 bad usage or configuration",
    )
    add_site_arguments(parser.add_argument_group("the run"))
    group = parser.add_argument_group("the bound")
    group.add_argument(
        "--of", choices=("deviation", "discharge"), default="deviation",
        help="quantity to bound (default: %(default)s)",
    )
    group.add_argument(
        "--block", type=make_number_type(1e-9, 1e9), metavar="S",
        help="length of the blocks of ticks that share one variable (s). Shorter blocks yield a "
        "tighter bound but take longer to solve; blocks of one tick are exact and take a minute "
        f"for 12 h (default: {BLOCK_S:g}, or one tick if a tick is longer)",
    )
    group.add_argument(
        "--max-command", type=make_number_type(1e-9, 100.0), default=1.0, metavar="U",
        help="maximum command, as a share of the maximum flow (default: %(default)g)",
    )
    group.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser


def _print_frontier(run: Run, as_json: bool) -> None:
    """Print the minimum discharge in wet weather for every amount of mains water."""
    with ProgressBar() as bar:
        def report(share: float) -> None:
            bar.show(hours_minutes_seconds(share * run.steps * run.site.tau), share)

        summary, trajectory = simulate(run, every=1, progress=report)
    assert trajectory is not None
    points = bound_discharge(run, trajectory)
    result = {
        **describe_setting(run), "wet_discharge_m3": summary["wet_discharge_m3"],
        "mains_m3": summary.get("mains_m3", 0.0),
        "frontier": [point._asdict() for point in points],
    }
    about = "m3 in wet weather, with {:.2f} m3 of mains water".format
    if run.site.mains_level is None:  # so its cost makes no difference
        about, points = "m3 in wet weather".format, points[:1]
    rows = (
        *setting_rows(result),
        *(
            ("bound", f"{point.wet_discharge_m3:.2f}", about(point.mains_m3)) for point in points
        ),
        (
            "on/off", f"{result['wet_discharge_m3']:.2f}",
            f"{about(result['mains_m3'])}; the bound uses the same irrigation",
        ),
    )
    show("Minimum discharge", rows, result, as_json=as_json)


def _print_bound(run: Run, block: float | None, max_command: float, as_json: bool) -> None:
    """Print the lower bound on the total deviation."""
    block_s = max(1, round(BLOCK_S / run.site.tau)) * run.site.tau
    if block is not None:
        block_s = count_ticks(run.site, block, "--block", unit_s=1.0) * run.site.tau
    result = {
        "bound_m3": clairvoyant_bound(run, block_s, max_command), "max_command": max_command,
        "block_s": block_s, **describe_setting(run),
    }
    rows = (
        *setting_rows(result),
        (
            "bound", f"{result['bound_m3']:.2f}",
            "m3, total deviation that no controller can beat with commands of at most "
            f"{max_command:g}",
        ),
        ("block", f"{block_s:g} s", "length of the blocks of ticks that share one variable"),
    )
    show("Clairvoyant bound", rows, result, as_json=as_json)


@command
def main() -> int:
    """Compute the bound for the run that the command line describes."""
    parser = make_parser()
    arguments = parser.parse_args()
    if arguments.of == "discharge" and (arguments.block, arguments.max_command) != (None, 1.0):
        parser.error("--block and --max-command cannot be used with --of discharge")
    run = build_run(arguments)
    try:
        if arguments.of == "discharge":
            _print_frontier(run, arguments.json)
        else:
            _print_bound(run, arguments.block, arguments.max_command, arguments.json)
    except NoBoundError as error:
        print(f"error: no bound found; the solver reports: {error}", file=sys.stderr)
        return EXIT_FAILED
    return EXIT_DONE
