"""Run all simulations of a grid: ``greenroof study``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from pathlib import Path
from statistics import fmean
from typing import Any, TypeAlias

import yaml
from rich.table import Column, Table

from greenroof_ros.analysis.study.case import Case, collect_contents
from greenroof_ros.analysis.study.case_run import bound_case, bound_discharge, run_case
from greenroof_ros.analysis.study.grid import read_grid
from greenroof_ros.analysis.study.names import Names
from greenroof_ros.analysis.study.store import StudyStore
from greenroof_ros.analysis.workers.choice import (
    add_worker_arguments,
    check_workers,
    describe_end,
    open_workers,
)
from greenroof_ros.analysis.workers.processes import Workers
from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    Parser,
    command,
    make_number_type,
)
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.files import find_shipped, replace_text, shared_directory
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.text import escape
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.physics.compiled import note_if_slow
from greenroof_ros.simulation.screen import print_weather
from greenroof_ros.weather.summary import as_lines

_Bounds: TypeAlias = dict[str, tuple[Callable[[Path, Case], dict[str, float]], Case]]
"""Functions that compute bounds, each with a case, by the identity of the bound."""

_REFRESH_S = 0.5
# What every worker needs.
_PRELOADED = [
    "greenroof_ros.analysis.study.case_run", "greenroof_ros.controllers.mpc",
    "greenroof_ros.controllers.lookahead", "osqp", "polars", "scipy.optimize",
]
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
        help="grid file, your own or one of this package's (default: the paper's, "
        "config/studies/paper.yaml)",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR",
        help="write the study to this directory, which may be new or may contain a study that "
        "was started earlier (default: a directory in studies/ with the grid's name)",
    )
    parser.add_argument(
        "--weather", type=Path, metavar="DIR",
        help="look in this directory for weather files that are named in the grid but are not "
        "next to the grid file, such as the multi-year record for config/studies/seasons.yaml",
    )
    add_worker_arguments(parser, "runs", "run N runs at a time")
    trajectories = parser.add_mutually_exclusive_group()
    trajectories.add_argument(
        "--trajectory-every", type=make_number_type(0, 1e9), default=0.0, metavar="S",
        help="keep a sample of each run every S seconds, a whole number of ticks (default: every "
        "tick). If all one-second ticks are kept, half a year takes up a gigabyte of memory",
    )
    trajectories.add_argument(
        "--no-trajectories", action="store_true",
        help="keep only the table and the rain events, for studies with thousands of runs. A "
        "report then contains no figures of weather, commands and volumes",
    )
    return parser


@command
def main() -> int:
    """Run the cases of a study that have not been completed yet."""
    arguments = make_parser().parse_args()
    check_workers(arguments)
    grid = shared_directory() / "config/studies/paper.yaml"
    if arguments.grid is not None:
        grid = find_shipped(arguments.grid)
    contents = dict[str, list[str]]()

    def note_weather(summary: Mapping[str, Any], name: str) -> None:
        contents[f"{name} from {summary['from']}"] = as_lines(summary)
        print_weather(summary, name)

    cases = read_grid(grid, arguments.weather, note_weather)
    every = None if arguments.no_trajectories else arguments.trajectory_every
    store = StudyStore(
        arguments.output or Path("studies") / grid.stem, grid, cases, trajectory_every=every
    )
    # A report shows it among the study's configuration.
    replace_text(
        store.directory / "configuration" / "weather.yaml",
        yaml.safe_dump(contents, sort_keys=False, allow_unicode=True, width=1000),
    )
    open_cases = [case for case in cases if case.identity not in store.outcomes]
    bounds: _Bounds = {}
    for case in cases:
        if case.bound_block != 0:
            bounds[case.bound_identity] = bound_case, case
        if case.discharge_bound_identity:
            bounds[case.discharge_bound_identity] = bound_discharge, case
    bounds = {identity: each for identity, each in bounds.items() if identity not in store.bounds}
    if store.outcomes:
        print(f"{len(store.outcomes)} of {len(cases)} runs are already stored", file=sys.stderr)
    compiled = [case for case in open_cases if case.inputs.controller.kind is OnOff]
    compiled += [case for bound, case in bounds.values() if bound is bound_discharge]
    note_if_slow(sum(case.ticks for case in compiled))
    signals: Signals | None = None
    try:
        if open_cases or bounds:
            with open_workers(arguments, collect_contents(cases), _PRELOADED) as workers:
                signals = Signals()  # from now on a signal ends the study between two results
                _run(store, open_cases, bounds, workers, signals)
    except (BrokenExecutor, InterruptedRun) as error:
        why, code = describe_end(error, signals)
        print(escape(
            f"{why}: {len(store.outcomes)} of {len(cases)} cases are stored; run the same command "
            "again to continue"
        ), file=sys.stderr)
        return code
    finally:
        rows = store.write_table()
    show(rows, store.directory)
    if signals is not None and signals.received:  # after the last result
        return EXIT_INTERRUPTED
    return EXIT_FAILED if store.failures else EXIT_DONE


def _run(
    store: StudyStore, cases: Sequence[Case], bounds: _Bounds, workers: Workers, signals: Signals
) -> None:
    """Run the given cases and compute the given bounds; store each result as it arrives."""
    names = Names(store.cases)
    # The longest first, or at the end one core may have a long run while the others are idle.
    cases = sorted(cases, key=lambda case: (
        not case.inputs.controller.ensemble, not case.inputs.controller.outputs, -case.hours,
        case.weather_name, case.start,
    ))
    # Each with the identity of its bound, which is empty for a run.
    pending: dict[Future[Any], tuple[Case, str]] = {
        workers.submit(bound, case): (case, identity) for identity, (bound, case) in bounds.items()
    }
    pending |= {
        workers.submit(run_case, case, store.trajectory_every): (case, "") for case in cases
    }
    tasks, runs = len(pending), 0
    with ProgressBar() as progress:
        while pending:
            progress.show(f"{runs} of {len(cases)} runs", 1 - len(pending) / tasks)
            workers.check()
            done, _ = wait(pending, timeout=_REFRESH_S, return_when=FIRST_COMPLETED)
            broken: Exception | None = None
            for future in done:
                case, identity = pending.pop(future)
                try:
                    result = workers.result(future)
                except (BrokenExecutor, CancelledError) as error:
                    broken = error  # raised once all results that came before are stored
                    continue
                except Exception as error:  # raised by the run
                    _report_failure(store, names, case, error, is_run=not identity)
                else:
                    if identity:
                        store.write_bound(identity, result)
                    else:
                        store.write_outcome(case, result)
                runs += not identity
            if broken is not None:
                raise broken
            signals.check()


def _report_failure(
    store: StudyStore, names: Names, case: Case, error: Exception, *, is_run: bool
) -> None:
    """Print the reason for a failed run or a missing bound; keep a run's reason for the table."""
    what, reason = "no bound", str(error) or type(error).__name__
    if is_run:  # a missing bound is no failure
        what, store.failures[case.identity] = "failed", reason
    name = ", ".join(filter(None, names.columns(case).values()))
    name += f", {case.inputs.initial}, run {case.identity}"
    print(escape(f"{what}: {name}: {reason}"), file=sys.stderr)


def show(rows: Sequence[Mapping[str, Any]], directory: Path) -> None:
    """Print the mean deviations for each window, with cases as rows and initial states as columns.

    Args:
        rows: rows of the study's ``results.csv``, one for each run.
        directory: directory of the study.
    """
    console = PlainConsole()
    windows: dict[str, dict[str, dict[str, list[float | None]]]] = {}
    for row in rows:
        cases = windows.setdefault(row["window"], {})
        means = cases.setdefault(row["case"], {}).setdefault(row["initial"], [])
        means.append(row.get("mean_deviation_mm"))
    for window, cases in windows.items():
        initials = list(dict.fromkeys(initial for case in cases.values() for initial in case))
        table = Table(
            "case", *(Column(initial, justify="right") for initial in initials),
            title=f"Mean deviation from the target level (mm): {window}", title_justify="left",
        )
        for case, of_case in cases.items():
            table.add_row(case, *(_mean(of_case.get(initial, [])) for initial in initials))
        console.print(table)
    for column, what in _NOTES.items():
        count = sum(bool(row.get(column)) for row in rows)
        if count:
            console.print(f"NOTE: {count} of {len(rows)} runs {what} (column {column})")
    console.print(f"written to {directory / 'results.csv'}", soft_wrap=True)


def _mean(values: Sequence[float | None]) -> str:
    """Return the mean over seeds and years, and the number of runs without a result."""
    known = [value for value in values if value is not None]
    lacking = len(values) - len(known)
    return " ".join([
        *([f"{fmean(known):.2f}"] if known else []),
        *([f"({lacking} without result)"] if lacking else []),
    ])
