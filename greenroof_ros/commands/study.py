"""Run all simulations of a grid: ``greenroof study``."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import fmean
from typing import Any

import yaml
from rich.table import Column, Table

from greenroof_ros.analysis.executors import WorkersLostError, open_dask
from greenroof_ros.analysis.grid import read_grid
from greenroof_ros.analysis.store import StudyStore
from greenroof_ros.analysis.study import run_study
from greenroof_ros.analysis.tables import COLUMNS, format_range
from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    Parser,
    command,
    make_number_type,
    refuse,
)
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.files import find_shipped
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.text import escape
from greenroof_ros.weather.summary import as_lines

# The bounds of metrics, by the metrics' names.
_BOUNDS = {
    "total_deviation_m3": "bound_m3", "wet_discharge_m3": "bound_wet_discharge_m3",
    "mains_m3": "bound_mains_m3",
}
_NOTES = {
    "filled_hours": "had missing hours of weather filled in",
    "frost_hours": "had frost, in which nothing was pumped",
    "limited_steps": "had a tank run empty",
}
_DESCRIPTION = """\
Run every combination of the sites, weather windows, initial states, controllers and parameters in a
grid in parallel, and collect the results in one table, results.csv. Without a grid, the command
runs the paper's 30 runs. If the command is interrupted or killed, run it again to continue.
"""
_EPILOG = """\
exit codes: 0 done, 1 a run failed (the other runs are in the table) or the workers were lost (run
the same command again to continue), 2 bad usage or configuration, 130 interrupted

examples:
  greenroof study                         the paper's 30 runs
  greenroof study my_study.yaml --jobs 4  your grid, on 4 cores
  greenroof report studies/paper          tables and figures
"""


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(prog="greenroof study", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "grid", nargs="?", type=Path, metavar="GRID.yaml",
        default=Path("config/studies/paper.yaml"), help="grid file, your own or one of this "
        "package's (default: the paper's, %(default)s)",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR",
        help="write the study to this directory, which may be new or may contain a study that "
        "was started earlier (default: a directory in studies/ with the grid's name)",
    )
    parser.add_argument(
        "--weather", type=Path, metavar="DIR",
        help="look in this directory for weather files that are named in the grid but are not "
        "next to the grid file",
    )
    parser.add_argument(
        "--jobs", type=make_number_type(1, 1024, int), metavar="N",
        help="use N threads, and N processes for controllers that are not compiled (default: one "
        "per core)",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="run on a Dask cluster, such as tcp://10.0.0.1:8786, instead of on this machine; its "
        "workers need greenroof_ros[dask,study]",
    )
    trajectories = parser.add_mutually_exclusive_group()
    trajectories.add_argument(
        "--trajectory-every", type=make_number_type(0, 1e9), default=0.0, metavar="S",
        help="keep a sample of each run every S seconds, a whole number of ticks (default: every "
        "tick). If all one-second ticks are kept, half a year takes up a gigabyte of memory",
    )
    trajectories.add_argument(
        "--no-trajectories", dest="trajectory_every", action="store_const", const=None,
        help="keep only the table and the rain events, for studies with thousands of runs. A "
        "report then contains no figures of weather, commands and volumes",
    )
    return parser


@command
def main() -> int:
    """Run the cases of a study that have not been completed yet."""
    arguments = make_parser().parse_args()
    weather: Path | None = arguments.weather
    refuse((
        weather is not None and not weather.is_dir(), "--weather", str(weather),
        "must be a directory with weather files",
    ))
    path = find_shipped(arguments.grid)
    grid, records = read_grid(path, weather), dict[str, list[str]]()
    for run, _ in grid.files.runs.values():
        name = f"{Path(run.weather.source).name}, {run.steps * run.site.tau / 3600:g} h"
        records[f"{name} from {run.start}"] = as_lines(run.series.summary)
    # A report shows what the weather contains among the study's configuration.
    grid.files.contents["weather.yaml"] = yaml.safe_dump(
        records, sort_keys=False, allow_unicode=True, width=1000
    ).encode()
    store = StudyStore(
        arguments.output or Path("studies") / path.stem, grid.cases, grid.files.contents,
        trajectory_every=arguments.trajectory_every, show=grid.show,
    )
    if store.results:
        print(f"{len(store.results)} of {len(grid.cases)} runs are stored", file=sys.stderr)
    signals = Signals()  # from now on a signal ends the study between two results
    try:
        with ExitStack() as stack:
            executor = None
            if arguments.scheduler is not None:
                executor = stack.enter_context(open_dask(arguments.scheduler))
            bar = stack.enter_context(ProgressBar())

            def report(share: float) -> None:
                signals.check()
                bar.show(f"{len(store.results)} of {len(grid.cases)} runs", share)

            run_study(
                store, executor=executor, jobs=arguments.jobs, progress=report,
                tell=lambda text: print(escape(text), file=sys.stderr),
            )
    except (WorkersLostError, InterruptedRun) as error:
        # A signal that a batch system sends to all processes also stops the workers.
        received = signals.received
        why = f"error: {error}" if received is None else f"interrupted by {received.name}"
        print(escape(
            f"{why}: {len(store.results)} of {len(grid.cases)} cases are stored; run the same "
            "command again to continue"
        ), file=sys.stderr)
        return EXIT_FAILED if received is None else EXIT_INTERRUPTED
    finally:
        rows = store.write_table()
    show(rows, grid.show)
    print(escape(f"written to {store.directory / 'results.csv'}"))
    return EXIT_FAILED if store.failures else EXIT_DONE


def show(rows: Sequence[Mapping[str, Any]], metrics: Sequence[str]) -> None:
    """Print the mean of each metric over years and seeds, with its range, the lowest mean first.

    Args:
        rows: rows of the study's ``results.csv``, one for each run.
        metrics: names of the metrics.
    """
    console, places = PlainConsole(), dict[str, dict[str, list[Mapping[str, Any]]]]()
    for row in rows:
        if row["status"] == "done":
            cases = places.setdefault(f"{row['window']}, from {row['initial']}", {})
            cases.setdefault(row["case"], []).append(row)
    for place, cases in places.items():
        headings = (Column(COLUMNS[name].heading, justify="right") for name in metrics)
        table = Table("case", *headings, title=place, title_justify="left")
        lines = {
            case: [_list_known(runs, name) for name in metrics] for case, runs in cases.items()
        }
        every = [run for runs in cases.values() for run in runs]
        least = [_list_known(every, _BOUNDS.get(name, "")) for name in metrics]
        for case, values in [
            *[("minimum possible", least)] * any(least),
            *sorted(lines.items(), key=lambda line: fmean(line[1][0] or [math.inf])),
        ]:
            table.add_row(case, *(
                format_range(fmean(each), min(each), max(each), COLUMNS[name]) if each else ""
                for name, each in zip(metrics, values, strict=True)
            ))
        console.print(table)
    for column, what in _NOTES.items():
        if count := sum(bool(row.get(column)) for row in rows):
            console.print(f"NOTE: {count} of {len(rows)} runs {what} (column {column})")


def _list_known(runs: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    return [run[name] for run in runs if run.get(name) is not None]
