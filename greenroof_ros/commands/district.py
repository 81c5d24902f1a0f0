"""Simulate green roofs and cisterns on the buildings of a district: ``greenroof district``."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.table import Column, Table

from greenroof_ros.analysis.workers.choice import (
    add_worker_arguments,
    check_workers,
    describe_end,
    open_workers,
)
from greenroof_ros.base.command_line import EXIT_DONE, Parser, command, print_lines
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.files import claim_directory, find_shipped
from greenroof_ros.base.processes import InterruptedRun, Signals, count_cores
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.text import escape

_DESCRIPTION = """\
Simulate a district of many buildings with green roofs and cisterns, which are drawn from
distributions or listed in a CSV file. The discharge from all buildings to the sewer is added up for
every type of outlet and every adoption rate (the share of buildings that take part). The result is
one page for a browser, with the discharge in wet weather, its peaks, the overflow of a sewer of a
specified capacity, and the mains water.
"""
_EPILOG = """\
The output consists of page.html, its figures as SVG and PNG, results.csv (one row per adoption rate
and outlet), buildings.csv (one row per building), hydrographs.parquet (flows in m3/s in each
interval) and, with --swmm, a folder for EPA SWMM.

exit codes: 0 done, 1 the workers were lost, 2 bad usage or configuration, 130 interrupted

examples:
  greenroof district config/districts/example.yaml --weather weather --output district
  greenroof district my_district.yaml --output district --jobs 4 --swmm
"""


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(prog="greenroof district", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "district", type=Path, metavar="DISTRICT.yaml",
        help="district file, which describes the buildings, the weather, the adoption rates and "
        "the sewer, such as config/districts/example.yaml",
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR",
        help="write the results to DIR, which must be new or empty",
    )
    parser.add_argument(
        "--weather", type=Path, metavar="DIR",
        help="look in DIR for weather files that are not next to DISTRICT.yaml",
    )
    add_worker_arguments(parser, "parts of the district", "use N threads")
    parser.add_argument(
        "--swmm", action="store_true",
        help="also write the hydrographs as time series for EPA SWMM, with a drainage network "
        "that receives the flows",
    )
    return parser


@command
def main() -> int:
    """Simulate the district named on the command line."""
    arguments = make_parser().parse_args()
    check_workers(arguments)
    with require_extra("study"):
        from greenroof_ros.analysis.district import page, run
        from greenroof_ros.analysis.district.result import PAGE, DistrictResult
    places = [] if arguments.weather is None else [arguments.weather]
    district = run.read_run(find_shipped(arguments.district), places)
    print_lines("note", district.notes)
    claim_directory(arguments.output)
    signals = Signals()  # from now on, a signal ends the run at the next report
    try:
        with ProgressBar() as bar:
            def report(text: str, share: float) -> None:
                signals.check()
                bar.show(text, share)

            if arguments.scheduler is None:
                jobs = arguments.jobs or count_cores()
                totals = run.simulate_district(district, jobs, report)
            else:
                with open_workers(arguments, district.files, []) as workers:
                    totals = run.distribute_district(district, workers, report)
    except (BrokenExecutor, InterruptedRun) as error:
        why, code = describe_end(error, signals)
        print(escape(why), file=sys.stderr)
        return code
    result = DistrictResult(district, totals)
    result.save(arguments.output, with_swmm=arguments.swmm)
    _show(result.rows, page)
    print(escape(result.sentence))
    print_lines("warning", result.warnings)
    print(escape(f"written to {arguments.output / PAGE}"))
    return EXIT_DONE


# Columns of the printed table: their headers, and the names of the results.
_SHOWN = {
    "in wet weather (m3)": "wet_discharge_m3", "60 min peak (mm/h)": "peak_60min_mm_h",
    "sewer overflow (m3)": "sewer_overflow_m3", "mains water (m3)": "mains_m3",
}


def _show(rows: Sequence[Mapping[str, Any]], page: ModuleType) -> None:
    """Print the main results."""
    columns = {header: name for header, name in _SHOWN.items() if name in rows[0]}
    table = Table(
        Column("buildings", justify="right"), Column("outlet", no_wrap=True),
        *(Column(header, justify="right") for header in columns),
        title="Discharge to the sewer", title_justify="left",
    )
    for row in rows:
        table.add_row(
            page.percent(row["adoption"]),
            page.LABELS[row["outlet"]] if row["adoption"] else page.AS_IS_LABEL,
            *(f"{row[name]:,.4g}" for name in columns.values()),
        )
    PlainConsole().print(table)
