"""Run every combination of the sites, weather, controllers and parameters in a grid, in parallel.

The results are collected in one table, results.csv. Without a grid, the command runs the paper's 30
runs. If it is interrupted or killed, run it again to continue.

Exit codes: 0 done; 1 a run failed (the other runs are in the table), or a process was lost (run
the same command again to continue); 2 bad usage or configuration; 130 interrupted

Examples:
  greenroof study                         the paper's 30 runs
  greenroof study my_study.yaml --jobs 4  your grid, on 4 cores
  greenroof report studies/paper          tables and figures
"""

from __future__ import annotations

import sys
from pathlib import Path

import yaml

from greenroof_ros.analysis.executors import WorkersLostError
from greenroof_ros.analysis.grid import read_grid
from greenroof_ros.analysis.store import StudyStore
from greenroof_ros.analysis.study import run_study
from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    Parser,
    command,
    make_number_type,
)
from greenroof_ros.base.console import PlainConsole, ProgressBar
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.files import find_shipped
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.text import escape
from greenroof_ros.weather.summary import as_lines


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser.of("study", __doc__, "[GRID.yaml] [options]")
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
        "--jobs", type=make_number_type(1, 1024, int), metavar="N",
        help="use N threads, and N processes for controllers that are not compiled (default: one "
        "per core)",
    )
    trajectories = parser.add_mutually_exclusive_group()
    trajectories.add_argument(
        "--trajectory-every", type=make_number_type(0, 1e9), default=0.0, metavar="S",
        help="keep a sample of each run every S seconds, a whole number of ticks (default: every "
        "tick). If all one-second ticks are kept, half a year takes up a gigabyte of memory",
    )
    trajectories.add_argument(
        "--no-trajectories", dest="trajectory_every", action="store_const", const=None,
        help="keep only the table, for studies with thousands of runs. A report then contains no "
        "figures of weather, commands and volumes",
    )
    return parser


@command
def main() -> int:
    """Run the cases of a study that have not been completed yet."""
    arguments = make_parser().parse_args()
    with require_extra("study"):
        from greenroof_ros.analysis.report.page import make_notes, make_table
        from greenroof_ros.analysis.report.runs import Report, find_runs
    path = find_shipped(arguments.grid)
    grid, records = read_grid(path), dict[str, list[str]]()
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
        with ProgressBar(signals=signals) as bar:
            run_study(
                store, jobs=arguments.jobs, progress=lambda share: bar.show(
                    f"{len(store.results)} of {len(grid.cases)} runs", share
                ),
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
        store.write_table()
    if store.results:
        console, done = PlainConsole(), Report(find_runs([store.directory]))
        table = make_table(done, done.show)
        console.print_table(table.caption, table.headings(), table.texts(), table.marked)
        for note in make_notes(done):
            console.print(f"NOTE: {note}")
    print(escape(f"written to {store.directory / 'results.csv'}"))
    return EXIT_FAILED if store.failures else EXIT_DONE
