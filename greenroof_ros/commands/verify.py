"""Compare forecasts with records: ``greenroof verify FORECASTS --weather FILE``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path

from rich import box
from rich.table import Table

from greenroof_ros.analysis.verification.checks import check_forecasts
from greenroof_ros.analysis.verification.pairs import Class, Sum, read_issued_forecasts, tally_pairs
from greenroof_ros.analysis.verification.scores import SHOWN, Tally
from greenroof_ros.base.command_line import Parser, add_site, command, make_number_type, print_lines
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.times import to_people
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.results.table import format_csv
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import find_files, read_weather
from greenroof_ros.weather.summary import as_lines, summarize

_DESCRIPTION = """\
Score rain forecasts against records, by lead time and by the number of hours over which the rain is
summed. Sums that reach a given amount are also scored as events. FORECASTS is an archive: a file or
a directory of files, as for the option --forecast of simulate.
"""
_EPILOG = """\
  bias   forecast rain divided by observed rain
  r      correlation
  POD    probability of detection: share of the events that were forecast
  FAR    false alarm ratio: share of the forecast events that did not occur
  ETS    equitable threat score: 1 is perfect, 0 is no skill
  Brier  mean squared error of the event's probability
  CRPS error of the whole distribution (mm), in its fair form, comparable for
         any number of members; for a single forecast, the mean absolute error

For an ensemble, the first five scores use member 0, and the last two use all members.

examples:
  greenroof verify gem_previous_runs.csv --weather gauge.csv
  greenroof verify gem_runs/ --weather 'hourly_*.csv' --lead 6 --sums 1 6 --events 1 2

exit codes: 0 done, 2 bad usage, configuration or file
"""
# Default sums: hours, and the mm from which such a sum counts as an event.
_SUMS = ((1, 1.0), (6, 2.0), (12, 3.0), (24, 5.0))
_MAX_HOURS = 384
# Notes about files that are printed; an archive can have one for every issue.
_MAX_NOTES = 20


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(prog="greenroof verify", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("forecasts", type=Path, metavar="FORECASTS", help="archive")
    parser.add_argument(
        "--weather", nargs="+", required=True, metavar="FILE",
        help="rain records: weather files, as for simulate, or a glob pattern in quotes; missing "
        "hours are left out",
    )
    add_site(parser, "use the location in this site file")
    whole_hours = make_number_type(1, _MAX_HOURS, int)
    parser.add_argument(
        "--sums", type=whole_hours, nargs="+", metavar="H",
        help="score rain totals over these numbers of hours (default: those of 1, 6, 12 and 24 "
        "that divide --lead)",
    )
    parser.add_argument(
        "--events", type=make_number_type(1e-3, 1e3), nargs="+", metavar="MM",
        help="amounts from which sums count as events (mm), one for each value of --sums "
        "(default: 1, 2, 3 and 5)",
    )
    parser.add_argument(
        "--lead", type=whole_hours, default=24, metavar="H",
        help="length of the blocks of lead time that are scored together (h), a multiple of "
        "every value of --sums (default: %(default)s, one day)",
    )
    parser.add_argument(
        "--horizon", type=whole_hours, default=120, metavar="H",
        help="score forecasts up to this many hours ahead (default: %(default)s)",
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv", help="write all scores to this file as "
            "CSV",
    )
    return parser


@command
def main() -> None:
    """Verify the forecasts named on the command line."""
    arguments = make_parser().parse_args()
    sums = _read_sums(arguments)
    if arguments.output is not None:
        refuse_unwritable(arguments.output, ".csv")
    site = read_site(arguments.site)
    weather = read_weather(find_files(arguments.weather, "--weather"), site, method="")
    forecasts = read_issued_forecasts(arguments.forecasts, weather, site, arguments.horizon)
    if arguments.lead % forecasts.finest_lead:
        raise ConfigurationError(
            f"must be a multiple of {forecasts.finest_lead} h, the finest lead time of "
            f"{forecasts.name}", key="--lead", value=arguments.lead,
        )
    count = len(forecasts.issues)
    with ProgressBar() as progress:
        tallies = tally_pairs(
            forecasts, weather.precipitation, arguments.lead, sums,
            lambda done: progress.show(f"verifying: {done} of {count} forecasts", done / count),
        )
    span = f"{to_people(weather.first)} to {to_people(weather.end)}"
    if not any(of_class.scores().n for of_class in tallies.values()):
        raise ConfigurationError(
            f"include no complete sum in the period of the records: the forecasts cover "
            f"{forecasts.span}, and the records cover {span}",
            file=arguments.forecasts, key="FORECASTS", value=str(arguments.forecasts),
        )
    # Only archives put together from previous runs have leads in whole days.
    warnings = check_forecasts(tallies, previous_runs=forecasts.finest_lead > 1)
    if arguments.output is not None:
        with add_path_to_errors(arguments.output):
            arguments.output.write_text(_write_csv(tallies), encoding="utf-8")
    console = PlainConsole()
    console.print(_make_table(
        f"{forecasts.name}: {count} forecasts, compared with {weather.source}", tallies
    ))
    notes = [
        *as_lines(summarize(weather, site)), *filter(None, [weather.rain_note]), *weather.left_out,
        *forecasts.notes,
    ]
    if len(notes) > _MAX_NOTES:
        notes[_MAX_NOTES:] = [f"and {len(notes) - _MAX_NOTES} more notes"]
    print_lines("note", notes)
    print_lines("warning", warnings)
    if arguments.output:
        console.print(f"written: {arguments.output}", soft_wrap=True)


def _read_sums(arguments: argparse.Namespace) -> list[Sum]:
    if arguments.sums is None and arguments.events is None:
        return [Sum(*values) for values in _SUMS if arguments.lead % values[0] == 0]
    if arguments.sums is None or arguments.events is None:
        raise ConfigurationError("must be used together", key="--sums and --events")
    if len(arguments.sums) != len(arguments.events):
        raise ConfigurationError(
            f"must have as many values as --sums ({len(arguments.sums)}), not "
            f"{len(arguments.events)}",
            key="--events",
        )
    for hours in arguments.sums:
        if arguments.lead % hours or arguments.sums.count(hours) > 1:
            raise ConfigurationError(
                f"must be a divisor of --lead ({arguments.lead} h), and be given only once",
                key="--sums", value=hours,
            )
    return [Sum(*values) for values in zip(arguments.sums, arguments.events, strict=True)]


def _make_table(title: str, tallies: Mapping[Class, Tally]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("lead", "sum of", "event", *(heading for heading, _ in SHOWN.values())):
        table.add_column(name, justify="left" if name == "lead" else "right", no_wrap=True)
    before = ""
    for key, of_class in tallies.items():
        scores = of_class.scores()
        table.add_row(
            key.lead if key.lead != before else "",
            f"{key.sum.hours} h", f"{key.sum.event:g} mm",
            *map(scores.shown, SHOWN),
        )
        before = key.lead
    return table


def _write_csv(tallies: Mapping[Class, Tally]) -> str:
    """Return all scores as CSV, one line per class; leave a cell empty if there is no score."""
    columns = [
        "lead_from_h", "lead_to_h", "sum_hours", "event_mm",
        *("crps_mm" if name == "crps" else name for name in SHOWN),
    ]
    rows = [
        (key.low, key.high, key.sum.hours, f"{key.sum.event:g}", scores.n,
         *("" if math.isnan(value) else f"{value:.6g}" for value in scores[1:]))
        for key, scores in ((key, of_class.scores()) for key, of_class in tallies.items())
    ]
    return format_csv(columns, [dict(zip(columns, row, strict=True)) for row in rows])
