r"""Simulate the cistern, roof, pumps and controller with real weather in one process, without ROS.

The results are bit-for-bit identical to those of the node graph (greenroof run).

Examples:
  greenroof simulate --controller lookahead --horizon 12 --trajectory
  greenroof simulate --start 2021-07-08T05:00 --hours 6 --trajectory
  greenroof simulate --controller lookahead --horizon 24 \
      --forecast errors --forecast-skill real --forecast-seed 3
  greenroof simulate --weather 'hourly_*.csv' --start 2021-07-01

Exit codes: 0 done, 2 bad usage or configuration, or error in a controller's code, 130 interrupted
"""

from __future__ import annotations

import csv
from datetime import timedelta
from pathlib import Path

from greenroof_ros.base.command_line import Parser, command, make_number_type
from greenroof_ros.base.console import ProgressBar
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.times import hours_minutes_seconds
from greenroof_ros.results.trajectory import CSV, Trajectory, columns_of
from greenroof_ros.simulation import output, screen
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.options import add_output_arguments, add_run_arguments, build_run
from greenroof_ros.simulation.run import Run

# Rows of a trajectory that are converted together.
_ROWS = 65_536


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("simulate", __doc__)
    add_run_arguments(parser)
    group = add_output_arguments(parser)
    group.add_argument(
        "--trajectory", action="store_true",
        help="write every tick from 0 to N to trajectory.csv in the run's directory; greenroof "
        "report draws its figures from this file",
    )
    group.add_argument(
        "--trajectory-every", type=make_number_type(0, 1e9), default=0.0, metavar="S",
        help="write only one tick every S seconds, and the last tick; all ticks of a year take up "
        "gigabytes",
    )
    return parser


@command
def main() -> None:
    """Simulate the run that the command line describes."""
    arguments = make_parser().parse_args()
    run = build_run(arguments)
    screen.print_weather(run.series.summary)
    every = 0
    last_tick: int | None = None
    if arguments.trajectory or arguments.trajectory_every:
        every = run.count_ticks_between(arguments.trajectory_every)
    controller = run.make_controller()  # if it cannot be made, there is no directory
    directory = output.make_run_directory(arguments.output, run.controller.name)
    signals, progress = Signals(interrupt=True), ProgressBar()

    def show(share: float) -> None:
        nonlocal last_tick
        signals.check()
        last_tick = int(share * run.steps)
        progress.show(hours_minutes_seconds(last_tick * run.site.tau), share)

    def write(status: str, reason: str | None = None) -> None:
        happened = {"reason": reason, "last_tick": last_tick}
        output.write_summary(output.make_unfinished_summary(run, status, **happened), directory)

    try:
        write(output.RUNNING)
        output.write_configuration(directory, run, {})
        with progress:
            result, trajectory = simulate(run, controller, every, show)
        if trajectory is not None:
            _write_trajectory(run, trajectory, directory / CSV)
        output.write_summary(result, directory)
    except (Exception, KeyboardInterrupt) as error:
        received = signals.received
        signals.ignore()
        if received is None:
            write(output.FAILED, str(error))
            raise
        # Compiled code and a user's class can turn the interrupt into any other error.
        reason = f"interrupted by {received.name}"
        write(output.INTERRUPTED, reason)
        raise InterruptedRun(reason) from error
    screen.show_summary(result, directory, as_json=arguments.json)
    signals.check()


def _write_trajectory(run: Run, trajectory: Trajectory, file: Path) -> None:
    columns = columns_of(run.site)
    known = {
        **vars(trajectory), "cistern_level": trajectory.cistern / run.site.a1,
        "roof_level": trajectory.roof / run.site.a2,
    }
    values = [trajectory.time, *(known[each.attribute or each.tick] for each in columns)]
    with add_path_to_errors(file), file.open("x", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(("time", "time_s", *(column.name for column in columns)))
        for first in range(0, len(trajectory.time), _ROWS):
            part = (column[first : first + _ROWS].tolist() for column in values)
            rows.writerows(
                ((run.start + timedelta(seconds=row[0])).isoformat(), *row)
                for row in zip(*part, strict=True)
            )
