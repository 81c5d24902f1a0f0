"""Simulate a run in one process, without ROS: ``greenroof simulate``."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.base.command_line import Parser, command, make_number_type
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.times import hours_minutes_seconds
from greenroof_ros.bringup.progress import RunProgress
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.physics.sensor_and_pump import read_errors
from greenroof_ros.results.trajectory import CSV, Trajectory, columns_of
from greenroof_ros.simulation import screen, summary
from greenroof_ros.simulation.directory import make_run_directory, write_configuration
from greenroof_ros.simulation.loop import Simulation, Tick, simulate
from greenroof_ros.simulation.options import add_output_arguments, add_run_arguments, build_run
from greenroof_ros.simulation.run import Run

# Time between two updates of the progress (s): often enough for the eye, rarely enough to cost
# nothing.
_INTERVAL_S = 0.2
# Rows of a trajectory that are converted together.
_ROWS = 65_536


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof simulate",
        usage="%(prog)s [options]",
        description="Simulate the cistern, roof, pumps and controller with real weather "
        "in a single process, without ROS. The results are bit-for-bit identical to those of the "
        "node graph (greenroof run).",
        epilog="examples:\n"
        "  greenroof simulate --controller lookahead --horizon 12 --trajectory\n"
        "  greenroof simulate --start 2021-07-08T05:00 --hours 6 --trajectory\n"
        "  greenroof simulate --controller lookahead --horizon 24 \\\n"
        "      --forecast errors --forecast-skill real --forecast-seed 3\n"
        "  greenroof simulate --weather 'hourly_*.csv' --start 2021-07-01\n\n"
        "exit codes: 0 done, 2 bad usage or configuration, or error in a controller's code, 130 "
        "interrupted",
    )
    add_run_arguments(parser)
    group = add_output_arguments(parser)
    group.add_argument(
        "--trajectory", action="store_true",
        help="write every tick from 0 to N, with numbers in full precision, to trajectory.csv in "
        "the run's directory; greenroof report draws its figures from this file",
    )
    group.add_argument(
        "--trajectory-every", type=make_number_type(0, 1e9), default=0.0, metavar="S",
        help="write only one tick every S seconds, and the last tick, instead of all ticks. At a "
        "hundred bytes per tick, all ticks of a year take up gigabytes",
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
    position = _At(Signals(interrupt=True))
    directory = make_run_directory(arguments.output, run.controller.name)
    with _described(run, position, directory):
        write_configuration(directory, run, {})
        with RunProgress(run.steps, run.site.tau) as progress:
            if arguments.speed or run.controller.kind is not OnOff:
                ticks = _paced(run, simulation.ticks(), arguments.speed, position, progress)
                if every:
                    ticks = _written(run, ticks, every, directory / CSV)
                for _ in ticks:
                    pass
                result = simulation.summary()
            else:
                result = _simulate_at_once(run, every, directory / CSV, position, progress)
        summary.write(result, directory)
    screen.show_summary(result, directory, as_json=arguments.json)
    position.signals.check()


@dataclass
class _At:
    """The signals received so far, and the last simulated tick; None before the first."""

    signals: Signals
    tick: int | None = None


@contextmanager
def _described(run: Run, position: _At, directory: Path) -> Iterator[None]:
    """Keep the summary of an unfinished run up to date: its status, and why it ended early."""
    def write(status: str, reason: str | None = None) -> None:
        summary.write(summary.make_unfinished_summary(
            run, status, reason=reason, last_tick=position.tick
        ), directory)

    try:
        write(summary.RUNNING)
        yield
    except (Exception, KeyboardInterrupt) as error:
        received = position.signals.received
        position.signals.ignore()
        if received is None:
            write(summary.FAILED, str(error))
            raise
        # Compiled code and a user's class can turn the interrupt into any other error.
        reason = f"interrupted by {received.name}"
        write(summary.INTERRUPTED, reason)
        raise InterruptedRun(reason) from error


def _paced(
    run: Run, ticks: Iterator[Tick], speed: float, position: _At, progress: RunProgress
) -> Iterator[Tick]:
    """Yield the ticks, at the given speed unless it is 0, and show the progress."""
    began = shown = time.monotonic()
    for tick in ticks:
        position.tick = tick.k
        yield tick
        now = time.monotonic()
        if speed:
            time.sleep(max(0.0, began + tick.k * run.site.tau / speed - now))
        if now - shown > _INTERVAL_S or tick.k == run.steps:
            position.signals.check()
            shown = now
            progress.show_tick(tick.k, tick.cistern_level, tick.roof_level, tick.command)


def _written(run: Run, ticks: Iterator[Tick], every: int, file: Path) -> Iterator[Tick]:
    """Yield the ticks, and write every n-th tick, and the last one, to a new file."""
    values = attrgetter(*(column.tick for column in columns_of(run.site)))
    with _open_trajectory(run, file) as write_row:
        for tick in ticks:
            if tick.k % every == 0 or tick.k == run.steps:
                write_row(tick.k * run.site.tau, values(tick))
            yield tick


def _simulate_at_once(
    run: Run, every: int, file: Path, position: _At, progress: RunProgress
) -> dict[str, Any]:
    """Simulate on/off as fast as possible, write the trajectory, and return the summary.

    Args:
        run: the run.
        every: interval between the ticks that are written (ticks); 0 for no trajectory.
        file: a new file for the trajectory.
        position: position of the run, which is kept up to date.
        progress: progress bar.
    """
    def show(share: float) -> None:
        position.signals.check()
        position.tick = round(share * (run.steps + 1)) - 1
        progress.show(hours_minutes_seconds(position.tick * run.site.tau), share)

    result, trajectory = simulate(run, every=every, progress=show)
    if trajectory is not None:
        _write_trajectory(run, trajectory, every, file)
    return result


def _write_trajectory(run: Run, trajectory: Trajectory, every: int, file: Path) -> None:
    """Write a trajectory of every n-th tick with the readings of the sensors to a new file."""
    site, ticks = run.site, np.minimum(every * np.arange(len(trajectory.time)), run.steps)
    roof, errors = trajectory.roof / site.a2, read_errors(run.sensor_and_pump, run.steps + 1)
    levels = {
        "cistern_level": trajectory.cistern / site.a1,
        "roof_level": np.maximum(0.0, roof + errors[ticks]) if len(errors) else roof,
    }
    columns = [
        levels[column.tick] if column.tick in levels
        else getattr(trajectory, column.attribute or column.tick) for column in columns_of(site)
    ]
    with _open_trajectory(run, file) as write_row:
        for first in range(0, len(ticks), _ROWS):
            rows = slice(first, first + _ROWS)
            of_rows = zip(*(column[rows].tolist() for column in columns), strict=True)
            for seconds, values in zip(trajectory.time[rows].tolist(), of_rows, strict=True):
                write_row(seconds, values)


@contextmanager
def _open_trajectory(
    run: Run, file: Path
) -> Iterator[Callable[[float, tuple[float, ...]], None]]:
    """Create the file of a trajectory, and yield a function that writes a row at a time (s)."""
    with add_path_to_errors(file), file.open("x", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(("time", "time_s", *(column.name for column in columns_of(run.site))))
        yield lambda seconds, values: rows.writerow(
            ((run.start + timedelta(seconds=seconds)).isoformat(), seconds, *values)
        )
