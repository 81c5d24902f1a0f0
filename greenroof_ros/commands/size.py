"""Compare targets, cisterns and outlets of a site over all seasons of a weather record.

The result is a sentence, a page for a client or a council, sizes.html, which can be printed to PDF,
a table with one row per design and season, sizes.csv, and the figures as SVG and PNG. It states
what it rests on. No forecast of rain is used.

The outlets are: none; drain, a valve that drains the cistern down to a reserve in dry weather; and
plan, a valve that retains the water that plants take up in 20 days. A site must have a mains
top-up, and a low outlet if valves are to be compared.

Exit codes: 0 done, 2 bad usage or configuration, 130 interrupted

Examples:
  greenroof size --site config/site_valve.yaml --gaps fill --output sizes
                 --weather config/weather/toronto_2014-2025.csv.gz
  greenroof size --site my_site.yaml --weather record.csv --volumes 3 5 8 12 --targets 39
"""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.analysis.sizing.designs import KNEE, OUTLETS, PAGE, TABLE, TARGETS, VOLUMES
from greenroof_ros.analysis.sizing.run import KNEE_RANGE, size
from greenroof_ros.base.command_line import (
    Parser,
    add_option,
    add_site,
    command,
    make_number_type,
    option_of,
)
from greenroof_ros.base.console import PlainConsole, ProgressBar
from greenroof_ros.base.errors import rename_keys, require_extra
from greenroof_ros.base.processes import Signals, count_cores
from greenroof_ros.simulation.inputs import INPUTS
from greenroof_ros.weather.climate import CLIMATE


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser.of("size", __doc__, "--weather FILE ... [options]")
    group = parser.add_argument_group("site and weather")
    add_site(group)
    group.add_argument(
        "--weather", nargs="+", required=True, metavar="FILE",
        help="weather files, which are joined in chronological order, or a glob pattern; together, "
        "the files must cover at least one season",
    )
    add_option(group, INPUTS["evapotranspiration"], metavar="METHOD")
    for name in ("gaps", *CLIMATE):
        add_option(group, INPUTS[name])
    group.add_argument(
        "--season", metavar="MM-DD/MM-DD",
        help="first and last day of a season (default: 05-01/10-31, or 11-01/04-30 south of the "
        "equator). Seasons that the record covers only in part are left out and listed",
    )
    group = parser.add_argument_group("designs")
    group.add_argument(
        "--volumes", nargs="+", type=make_number_type(VOLUMES.low, VOLUMES.high), metavar="M3",
        help="compare cisterns of these volumes up to the overflow (m3; default: the site's own, "
        "and preferred numbers for 4 to 100 mm of rain on the roofs, finer around the best)",
    )
    group.add_argument(
        "--targets", nargs="+", type=make_number_type(TARGETS.low, TARGETS.high), metavar="MM",
        help="compare these target depths of water on the roof (mm; default: the site's z_veg, and "
        "steps of a twentieth of what the soil holds, finer around the best)",
    )
    group.add_argument(
        "--outlets", nargs="+", choices=OUTLETS,
        help="compare these types of cistern outlet (default: all, or only none for a site without "
        "a low outlet)",
    )
    group = parser.add_argument_group("value of a larger cistern")
    group.add_argument(
        "--knee", type=make_number_type(KNEE_RANGE.low, KNEE_RANGE.high), metavar="M3",
        default=KNEE,
        help="recommend the smallest cistern for which an additional m3 would save less than "
        "this amount per season of mains water and of storm water in the sewer (m3; default: "
        f"{KNEE:g}, one filling)",
    )
    group = parser.add_argument_group("output and pace")
    group.add_argument(
        "--output", type=Path, default=Path("sizes"), metavar="DIR",
        help=f"write {PAGE}, {TABLE} and the figures to DIR, which may be new or empty, or may "
        "contain an earlier sizing (default: %(default)s)",
    )
    group.add_argument(
        "--jobs", type=make_number_type(1, 1024, int), metavar="N", default=count_cores(),
        help="run N threads in parallel (default: one per core)",
    )
    return parser


@command
def main() -> None:
    """Size the cistern of the site named on the command line."""
    given = vars(make_parser().parse_args())
    output: Path = given.pop("output")
    with require_extra("study"):
        from greenroof_ros.analysis.page import claim_output
        from greenroof_ros.analysis.sizing.sizes import describe_outlets, tabulate_volumes
    claim_output(output, PAGE, [TABLE])
    names = {name: option_of(name) for name in given}
    with ProgressBar(signals=Signals()) as bar, rename_keys(names):
        sizes = size(progress=bar.show, **given)
        bar.show("drawing", 1.0)
        page = sizes.save(output)
    console = PlainConsole()
    console.print(sizes.sentence, style="bold")
    outlets, remarks = describe_outlets(sizes)
    for table in (*outlets, tabulate_volumes(sizes)[0]):
        console.print_table(table.caption, table.headings(), table.texts(), table.marked)
    for note in (*remarks, *sizes.read, *sizes.notes):
        console.print(f"NOTE: {note}")
    console.print(
        f"written to {page}, which also shows what the result rests on, and {TABLE}",
        soft_wrap=True,
    )
