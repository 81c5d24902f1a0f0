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
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from operator import attrgetter
from pathlib import Path

from greenroof_ros.base.command_line import Parser, command, make_number_type
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.times import hours_minutes_seconds
from greenroof_ros.bringup.progress import RunProgress
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.results.trajectory import CSV, Column, Trajectory, columns_of
from greenroof_ros.simulation import screen, summary
from greenroof_ros.simulation.directory import make_run_directory, write_configuration
from greenroof_ros.simulation.loop import Simulation, simulate
from greenroof_ros.simulation.options import add_output_arguments, add_run_arguments, build_run
from greenroof_ros.simulation.run import Run

# Time between two updates of the progress (s): often enough for the eye, rarely enough to cost
# nothing.
_INTERVAL_S = 0.2
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
    if arguments.trajectory or arguments.trajectory_every:
        every = run.count_ticks_between(arguments.trajectory_every)
    simulation = Simulation(run)  # if a controller cannot be made, there is no directory
    progress = _Progress(run)
    directory = make_run_directory(arguments.output, run.controller.name)
    with _described(run, progress, directory):
        write_configuration(directory, run, {})
        with progress, _open_trajectory(run, every, directory / CSV) as write_row:
            if arguments.speed or run.controller.kind is not OnOff:
                _simulate_ticks(run, simulation, arguments.speed, every, write_row, progress)
                result = simulation.summary()
            else:
                result, trajectory = simulate(run, every=every, progress=progress.show_share)
                if trajectory is not None:
                    _write_trajectory(run, trajectory, write_row)
        summary.write(result, directory)
    screen.show_summary(result, directory, as_json=arguments.json)
    progress.signals.check()


class _Progress(RunProgress):
    """Progress bar of a run that a signal interrupts.

    Attributes:
        signals: the signals received so far.
        tick: the last simulated tick; None before the first.
    """

    def __init__(self, run: Run) -> None:
        super().__init__(run.steps, run.site.tau)
        self.signals, self._run = Signals(interrupt=True), run
        self.tick: int | None = None

    def show_share(self, share: float) -> None:
        """Show the completed share of a run (1)."""
        self.signals.check()
        self.tick = round(share * (self._run.steps + 1)) - 1
        self.show(hours_minutes_seconds(self.tick * self._run.site.tau), share)


@contextmanager
def _described(run: Run, progress: _Progress, directory: Path) -> Iterator[None]:
    """Keep the summary of an unfinished run up to date: its status, and why it ended early."""
    def write(status: str, reason: str | None = None) -> None:
        summary.write(summary.make_unfinished_summary(
            run, status, reason=reason, last_tick=progress.tick
        ), directory)

    try:
        write(summary.RUNNING)
        yield
    except (Exception, KeyboardInterrupt) as error:
        received = progress.signals.received
        progress.signals.ignore()
        if received is None:
            write(summary.FAILED, str(error))
            raise
        # Compiled code and a user's class can turn the interrupt into any other error.
        reason = f"interrupted by {received.name}"
        write(summary.INTERRUPTED, reason)
        raise InterruptedRun(reason) from error


def _simulate_ticks(
    run: Run, simulation: Simulation, speed: float, every: int, write_row: Callable[..., None],
    progress: _Progress,
) -> None:
    """Simulate tick by tick, at the given speed unless it is 0, and write each n-th tick."""
    values = attrgetter(*(column.tick for column in _columns(run)))
    began = shown = time.monotonic()
    for tick in simulation.ticks():
        progress.tick = tick.k
        if every and (tick.k % every == 0 or tick.k == run.steps):
            write_row(tick.k * run.site.tau, *values(tick))
        now = time.monotonic()
        if speed:
            time.sleep(max(0.0, began + tick.k * run.site.tau / speed - now))
        if now - shown > _INTERVAL_S or tick.k == run.steps:
            progress.signals.check()
            shown = now
            progress.show_tick(tick.k, tick.cistern_level, tick.roof_level, tick.command)


def _write_trajectory(run: Run, trajectory: Trajectory, write_row: Callable[..., None]) -> None:
    names = ("time", *(column.attribute or column.tick for column in _columns(run)))
    columns = [getattr(trajectory, name) for name in names]
    for first in range(0, len(columns[0]), _ROWS):
        part = [column[first : first + _ROWS].tolist() for column in columns]
        for values in zip(*part, strict=True):
            write_row(*values)


def _columns(run: Run) -> list[Column]:
    """Return the columns of a trajectory except the levels, which the volumes determine."""
    return [column for column in columns_of(run.site) if not column.name.endswith("level_m")]


@contextmanager
def _open_trajectory(run: Run, every: int, file: Path) -> Iterator[Callable[..., None]]:
    """Create the file of a trajectory, unless no tick is written.

    Yields:
        A function that writes a row, given the time (s) and the values of :func:`_columns`.
    """
    if not every:
        yield lambda *_: None
        return
    a1, a2 = run.site.a1, run.site.a2
    with add_path_to_errors(file), file.open("x", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(("time", "time_s", *(column.name for column in columns_of(run.site))))
        yield lambda seconds, x1, x2, *others: rows.writerow((
            (run.start + timedelta(seconds=seconds)).isoformat(), seconds, x1, x2, x1 / a1,
            x2 / a2, *others,
        ))
