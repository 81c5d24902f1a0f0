"""Simulate a district of many buildings with green roofs and cisterns.

The buildings are drawn from distributions or listed in a CSV file, and simulated in every season of
a weather record. The discharge from all buildings to the sewer is added up for every type of outlet
and every adoption rate (the share of buildings that take part). The result is one page for a
browser, with the discharge in wet weather, the flow beyond the capacity of the sewer, and the mains
water, each with its range.

The output consists of page.html, its figures as SVG and PNG, results.csv (means and percentiles of
each adoption rate and outlet), seasons.csv (every draw and season), buildings.csv (every building),
and, with --swmm, a folder for EPA SWMM.

Exit codes: 0 done, 1 the output cannot be written, 2 bad usage or configuration, 130 interrupted

Examples:
  greenroof district config/districts/example.yaml --output district
  greenroof district my_district.yaml --output district --jobs 4 --swmm
"""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.base.command_line import Parser, command, make_number_type, print_lines
from greenroof_ros.base.console import PlainConsole, ProgressBar
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.files import find_shipped
from greenroof_ros.base.processes import Signals, count_cores

_PRINTED = ("wet_discharge_m3", "wet_discharge_reduction", "retention_share", "mains_m3")


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser.of("district", __doc__, "[options] DISTRICT.yaml")
    parser.add_argument(
        "district", type=Path, metavar="DISTRICT.yaml",
        help="buildings, weather, adoption rates and sewer, as in config/districts/example.yaml",
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR",
        help="write the results to DIR, which may be new, empty, or that of an earlier district",
    )
    parser.add_argument(
        "--jobs", type=make_number_type(1, 1024, int), metavar="N", default=count_cores(),
        help="use N threads (default: one per core)",
    )
    parser.add_argument(
        "--swmm", action="store_true",
        help="also route the flows of the first draw with EPA SWMM, through a sewer network scaled "
        "to the district; needs swmm-toolkit, without which only the files for SWMM are written",
    )
    return parser


@command
def main() -> None:
    """Simulate the district named on the command line."""
    given = make_parser().parse_args()
    with require_extra("study"):
        from greenroof_ros.analysis.district import page, result
        from greenroof_ros.analysis.page import claim_output
    claim_output(given.output, result.PAGE, result.FILES)
    with ProgressBar(signals=Signals()) as bar:
        made = result.district(
            find_shipped(given.district), jobs=given.jobs,
            swmm=given.output / "swmm" if given.swmm else None, progress=bar.show,
        )
        path = made.save(given.output)
    print_lines("note", made.notes)
    columns = {name: page.VOLUMES[name] for name in _PRINTED}
    table = page.tabulate(made.table, columns, "Discharge to the sewer in a season")
    console = PlainConsole()
    console.print_table(table.caption, table.headings(), table.texts(), table.marked)
    console.print(made.sentence)
    print_lines("warning", made.warnings)
    console.print(f"written to {path}", soft_wrap=True)
