"""Simulate green roofs and cisterns on the buildings of a district: ``greenroof district``."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.base.command_line import Parser, command, make_number_type, print_lines, refuse
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.files import find_shipped
from greenroof_ros.base.processes import Signals, count_cores
from greenroof_ros.base.progress import ProgressBar

_DESCRIPTION = """\
Simulate a district of many buildings with green roofs and cisterns, which are drawn from
distributions or listed in a CSV file, in every season of a weather record. The discharge from all
buildings to the sewer is added up for every type of outlet and every adoption rate (the share of
buildings that take part). The result is one page for a browser, with the discharge in wet weather,
the flow beyond the capacity of the sewer, and the mains water, each with its range.
"""
_EPILOG = """\
The output consists of page.html, its figures as SVG and PNG, results.csv (means and percentiles of
each adoption rate and outlet), seasons.csv (every draw and season), buildings.csv (every building),
hydrographs.parquet (flows in m3/s in each interval) and, with --swmm, a folder for EPA SWMM.

exit codes: 0 done, 1 the output cannot be written, 2 bad usage or configuration, 130 interrupted

examples:
  greenroof district config/districts/example.yaml --output district
  greenroof district my_district.yaml --output district --jobs 4 --swmm
"""

_PRINTED = ("wet_discharge_m3", "wet_discharge_reduction", "retention_share", "mains_m3")


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
        help="write the results to DIR, which may be new or empty, or may contain an earlier "
        "district",
    )
    parser.add_argument(
        "--weather", type=Path, metavar="DIR",
        help="look in DIR for weather files that are not next to DISTRICT.yaml",
    )
    parser.add_argument(
        "--jobs", type=make_number_type(1, 1024, int), metavar="N",
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
    arguments = make_parser().parse_args()
    weather: Path | None = arguments.weather
    refuse((
        weather is not None and not weather.is_dir(), "--weather", str(weather),
        "must be a directory with weather files",
    ))
    with require_extra("study"):
        from greenroof_ros.analysis.district.page import SHOWN, tabulate
        from greenroof_ros.analysis.district.result import FILES, PAGE, simulate_district
        from greenroof_ros.analysis.page import claim_output
    claim_output(arguments.output, PAGE, FILES)
    signals = Signals()  # from now on, a signal ends the run at the next report
    with ProgressBar() as bar:
        def report(text: str, share: float) -> None:
            signals.check()
            bar.show(text, share)

        result = simulate_district(
            find_shipped(arguments.district), [] if weather is None else [weather],
            arguments.jobs or count_cores(),
            arguments.output / "swmm" if arguments.swmm else None, report,
        )
        page = result.save(arguments.output)
    print_lines("note", result.notes)
    console = PlainConsole()
    table = tabulate(
        result, {name: SHOWN[name] for name in _PRINTED}, "Discharge to the sewer in a season"
    )
    console.print_table(table.caption, table.headings(), table.texts(), table.marked)
    console.print(result.sentence)
    print_lines("warning", result.warnings)
    console.print(f"written to {page}", soft_wrap=True)
