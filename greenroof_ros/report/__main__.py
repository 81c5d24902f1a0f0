"""A report on runs: ``python -m greenroof_ros.report PATH [PATH ...]``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from greenroof_ros.common.command_line import EXIT_DONE, command, within
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.report.assessment import Assumptions
from greenroof_ros.report.results import Report, best_runs, result
from greenroof_ros.report.runs import find_runs
from greenroof_ros.report.seeds import split_by_seeds
from greenroof_ros.report.settings import controller_name

_DEFAULTS = Assumptions()
# On the terminal; the report has them all.
_MOST_TABLES = 3


_DESCRIPTION = """\
Judge and draw runs: every figure of the paper, tables of deviation, water balance, energy and pump
starts, on one page that needs nothing but a browser.
"""
_EPILOG = """\
The output holds report.html, and each figure as SVG and PNG in figures/. A bag needs
/cistern/level, /roof/level, /pump/command and /pump/flow, under a namespace perhaps; what else is
missing counts as 0, and the report says so. The pumps' efficiency is pump_efficiency of the site.

examples:
  python -m greenroof_ros.report studies/paper            a study
  python -m greenroof_ros.report runs/a runs/b --output both
                                                          two runs, side by side
  python -m greenroof_ros.report bag --site my_site.yaml  a bag of a real site
"""


def _parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m greenroof_ros.report",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_EPILOG,
    )
    parser.add_argument(
        "paths", type=Path, nargs="+", metavar="PATH",
        help="a study's directory, a run's, or a bag (a directory with metadata.yaml)",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR",
        help="of the report, new or empty (default: report in the first PATH)",
    )
    parser.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site of the bags (default: configuration/site.yaml beside each, else the paper's)",
    )
    parser.add_argument(
        "--pump-data", type=Path, metavar="FILE.csv",
        help="points of the pumps' data sheet, to draw and to fit: lines of 'flow [m3/s],head [m]'",
    )
    group = parser.add_argument_group("assumptions")
    group.add_argument(
        "--energy-price", type=within(0, 1e9), default=_DEFAULTS.energy_price, metavar="PRICE",
        help="of a kWh of electric energy (default: %(default)s, Ontario 2021)",
    )
    group.add_argument(
        "--water-price", type=within(0, 1e9), default=_DEFAULTS.water_price, metavar="PRICE",
        help="of a m3 from the mains (default: %(default)s, Toronto 2021)",
    )
    group.add_argument(
        "--currency", default=_DEFAULTS.currency, metavar="NAME",
        help="of the prices (default: %(default)s)",
    )
    group.add_argument(
        "--band", type=within(0, 1), default=_DEFAULTS.band, metavar="SHARE",
        help="a roof this share of the target off it counts as near it (default: %(default)s)",
    )
    return parser


def _check_output(directory: Path) -> None:
    """Refuse a directory that holds something.

    Raises:
        ConfigurationError: it does, or is no directory.
    """
    try:
        taken = directory.exists() and any(directory.iterdir())
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", key="--output", value=str(directory)
        ) from error
    if taken:
        raise ConfigurationError(
            "exists and is not empty; a report is never written over",
            key="--output", value=str(directory),
        )


@command
def main() -> int:
    """Make the report that the command line asks for."""
    arguments = _parser().parse_args()
    try:
        from greenroof_ros.report import figures, page
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"needs {error.name}: pip install 'greenroof_ros[study]'"
        ) from error
    output: Path = arguments.output or arguments.paths[0] / "report"
    assumptions = Assumptions(
        energy_price=arguments.energy_price,
        water_price=arguments.water_price,
        currency=arguments.currency,
        band=arguments.band,
    )
    _check_output(output)
    sources = find_runs(arguments.paths, arguments.site)
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        console=Console(stderr=True), transient=True,
    ) as progress:
        single, seeded = split_by_seeds(sources.runs)
        results = [
            result(entry, assumptions)
            for entry in progress.track(single, description="reading runs")
        ]
        report = Report(results, seeded)
        makers = figures.make_figures(report, arguments.pump_data)
        try:
            (output / "figures").mkdir(parents=True)
        except OSError as error:
            raise ConfigurationError(
                f"cannot be written: {error.strerror}", key="--output", value=str(output)
            ) from error
        drawn = []
        for make in progress.track(makers, description="drawing figures"):
            figure = make()
            figure.save(output / "figures")
            drawn.append(figure)
    html = page.render(report, drawn, sources, assumptions)
    (output / "report.html").write_text(html, encoding="utf-8")
    console = Console()
    for table in _tables(report):
        console.print(table)
    if len(report.windows) > _MOST_TABLES:
        console.print(f"and {len(report.windows) - _MOST_TABLES} more windows in the report")
    if report.seeded:
        console.print(
            f"runs with many seeds of their forecasts' errors: {len(report.seeded)}; the report "
            "has their mean and their worst tenth"
        )
    if sources.failed:
        console.print(
            f"runs that failed or did not run: {len(sources.failed)}; the report lists them",
            style="bold",
        )
    console.print(f"written to {output.resolve() / 'report.html'}", soft_wrap=True, highlight=False)
    return EXIT_DONE


def _tables(report: Report) -> Iterator[Table]:
    """Make a table of the best run of each controller for each of the first windows."""
    best = best_runs(report)
    for window in report.windows[:_MOST_TABLES]:
        title = f"Least total deviation: {report.heading(window)}"
        table = Table(title=title, title_justify="left")
        for name in ("from", "controller", "best setting"):
            table.add_column(name)
        table.add_column("m3", justify="right")
        for one in best:
            if one.window == window:
                table.add_row(
                    one.initial, controller_name(one.run.entry.controller), one.setting,
                    f"{one.run.assessment.metrics['total_deviation_m3']:.2f}",
                )
        yield table


if __name__ == "__main__":
    main()
