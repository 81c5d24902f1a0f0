"""Score rain forecasts against records, by lead time and by the hours over which rain is summed.

Sums of at least 1, 2, 3 and 5 mm in 1, 6, 12 and 24 h are also scored as events. FORECASTS is an
archive: a file or a directory of files, as for the option --forecast of simulate. The scores are:

  bias   forecast rain divided by observed rain
  r      correlation
  POD    probability of detection: share of the events that were forecast
  FAR    false alarm ratio: share of the forecast events that did not occur
  ETS    equitable threat score: 1 is perfect, 0 is no skill
  Brier  mean squared error of the event's probability
  CRPS   error of the whole distribution (mm), in its fair form, comparable for
         any number of members; for a single forecast, the mean absolute error

For an ensemble, the first five scores use member 0, and the last two use all members.

Examples:
  greenroof verify gem_previous_runs.csv --weather gauge.csv
  greenroof verify gem_runs/ --weather 'hourly_*.csv' --lead 6

Exit codes: 0 done, 2 bad usage, configuration or file
"""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.analysis.verification import SCORES, verify
from greenroof_ros.base.command_line import (
    Parser,
    add_site,
    command,
    make_number_type,
    print_lines,
    refuse_unwritable,
)
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import rename_keys
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.results.table import format_csv


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("verify", __doc__, "FORECASTS --weather FILE ... [options]")
    parser.add_argument("forecasts", metavar="FORECASTS", help="archive")
    parser.add_argument(
        "--weather", nargs="+", required=True, metavar="FILE",
        help="rain records: weather files, as for simulate, or a glob pattern in quotes; missing "
        "hours are left out",
    )
    add_site(parser, "use the location in this site file")
    hours = make_number_type(1, 384, int)
    parser.add_argument(
        "--lead", type=hours, default=24, metavar="H",
        help="length of the blocks of lead time that are scored together (h); rain is summed over "
        "1, 6, 12 and 24 h, as far as these divide it (default: %(default)s, one day)",
    )
    parser.add_argument(
        "--horizon", type=hours, default=120, metavar="H",
        help="score forecasts up to this many hours ahead (default: %(default)s)",
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv", help="write all scores to this CSV file"
    )
    return parser


@command
def main() -> None:
    """Verify the forecasts named on the command line."""
    options = vars(make_parser().parse_args())
    output = options.pop("output")
    if output is not None:
        refuse_unwritable(output, ".csv")
    with rename_keys({name: f"--{name}" for name in options}):
        made = verify(**options)
    console = PlainConsole()
    console.print_table(made.title, ["lead", "sum of", "event", *dict(SCORES.values())], [
        [f"{row['lead_from_h']}-{row['lead_to_h']} h", f"{row['sum_hours']} h",
         f"{row['event_mm']:g} mm",
         *("-" if row[name] is None else format(row[name], form)
           for name, (_, form) in SCORES.items())]
        for row in made.rows
    ])
    print_lines("note", made.notes)
    if output is not None:
        with add_path_to_errors(output):
            output.write_text(format_csv(made.rows[0], made.rows), encoding="utf-8")
        console.print(f"written: {output}", soft_wrap=True)
