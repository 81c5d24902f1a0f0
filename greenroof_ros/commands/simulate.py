"""Simulate a run in one process, without ROS: ``greenroof simulate``."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from operator import attrgetter
from pathlib import Path

from greenroof_ros.common.command_line import (
    Parser,
    check_interrupts,
    command,
    end_repeats,
    make_number_type,
)
from greenroof_ros.common.files import add_path_to_errors
from greenroof_ros.common.progress import INTERVAL_S, RunProgress
from greenroof_ros.recording.trajectory import CSV, columns_of
from greenroof_ros.simulation import screen, summary
from greenroof_ros.simulation.directory import make_run_directory, write_configuration
from greenroof_ros.simulation.loop import Simulation, Tick
from greenroof_ros.simulation.options import (
    add_output_arguments,
    add_run_arguments,
    build_run,
)
from greenroof_ros.simulation.run import Run


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
    every = run.count_ticks_between(arguments.trajectory_every)
    simulation = Simulation(run)  # if a controller cannot be made, there is no directory
    directory = make_run_directory(arguments.output, run.controller.name)
    with _described(run, simulation, directory):
        write_configuration(directory, run, {})
        with RunProgress(run.steps, run.site.tau) as progress:
            ticks = _paced(run, simulation.ticks(), arguments.speed, progress)
            if arguments.trajectory or arguments.trajectory_every:
                ticks = _written(run, ticks, every, directory / CSV)
            for _ in ticks:
                pass
        result = simulation.summary()
        summary.write(result, directory)
    screen.show(result, directory, as_json=arguments.json)
    check_interrupts()


@contextmanager
def _described(run: Run, simulation: Simulation, directory: Path) -> Iterator[None]:
    """Keep the summary of an unfinished run up to date: its status, and why it ended early."""
    def write(status: str, reason: str | None = None) -> None:
        last = simulation.site.tick - 1
        summary.write(summary.make_unfinished_summary(
            run, status, reason=reason, last_tick=last if last >= 0 else None
        ), directory)

    try:
        write(summary.RUNNING)
        yield
    except KeyboardInterrupt as error:
        end_repeats()
        write(summary.INTERRUPTED, f"interrupted by {error}")
        raise
    except Exception as error:
        write(summary.FAILED, str(error))
        raise


def _paced(
    run: Run, ticks: Iterator[Tick], speed: float, progress: RunProgress
) -> Iterator[Tick]:
    """Yield the ticks, at the given speed unless it is 0, and show the progress."""
    began = shown = time.monotonic()
    for tick in ticks:
        yield tick
        now = time.monotonic()
        if speed:
            time.sleep(max(0.0, began + tick.k * run.site.tau / speed - now))
        if now - shown > INTERVAL_S or tick.k == run.steps:
            check_interrupts()
            shown = now
            progress.show_tick(tick.k, tick.cistern_level, tick.roof_level, tick.command)


def _written(run: Run, ticks: Iterator[Tick], every: int, file: Path) -> Iterator[Tick]:
    """Yield the ticks, and write every n-th tick, and the last one, to a new file."""
    columns = columns_of(run.site)
    values = attrgetter(*(column.tick for column in columns))
    with add_path_to_errors(file), file.open("x", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(("time", "time_s", *(column.name for column in columns)))
        for tick in ticks:
            if tick.k % every == 0 or tick.k == run.steps:
                seconds = tick.k * run.site.tau
                time_of = run.start + timedelta(seconds=seconds)
                rows.writerow((time_of.isoformat(), seconds, *values(tick)))
            yield tick
