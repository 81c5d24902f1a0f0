"""Compare forecasts with records: ``greenroof verify FORECASTS --weather FILE``."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.analysis.verification.result import verify
from greenroof_ros.analysis.verification.scores import SHOWN
from greenroof_ros.base.command_line import (
    Parser,
    add_site,
    command,
    make_number_type,
    option_of,
    print_lines,
)
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import rename_keys
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.results.table import format_csv

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
    if arguments.output is not None:
        refuse_unwritable(arguments.output, ".csv")
    options = {name: getattr(arguments, name) for name in ("lead", "sums", "events", "horizon")}
    with ProgressBar() as progress, rename_keys({
        name: option_of(name) for name in ("weather", *options)
    }):
        made = verify(
            arguments.forecasts, arguments.weather, arguments.site, progress=progress.show,
            **options,
        )
    console = PlainConsole()
    console.print_table(
        made.title, ["lead", "sum of", "event", *(heading for heading, _ in SHOWN.values())],
        [
            [key.lead, f"{key.sum.hours} h", f"{key.sum.event:g} mm", *map(score.shown, SHOWN)]
            for key, score in made.scores.items()
        ],
    )
    notes = list(made.notes)
    if len(notes) > _MAX_NOTES:
        notes[_MAX_NOTES:] = [f"and {len(notes) - _MAX_NOTES} more notes"]
    print_lines("note", notes)
    print_lines("warning", made.warnings)
    if arguments.output:
        rows = made.rows()
        with add_path_to_errors(arguments.output):
            arguments.output.write_text(format_csv(rows[0], rows), encoding="utf-8")
        console.print(f"written: {arguments.output}", soft_wrap=True)
