"""Fetch several years of hourly weather from the internet into one CSV file for --weather.

The file has all the data needed to compute evapotranspiration. By default, the data are
Open-Meteo's reanalysis for the site's location. The reanalysis contains the mean rain over a grid
cell, so its peaks are lower than those recorded by a rain gauge; the file and all results state
this. In Canada, --eccc fetches the observations of a station instead.

Each year or month of data is kept in FILE.part until all data have arrived. If the command is
interrupted, run it again to fetch the missing data. The command pauses between requests, and waits
after a failure, as the services request.

Open-Meteo: CC BY 4.0; the service is free for non-commercial use (https://open-meteo.com/en/terms).
Environment and Climate Change Canada: Open Government Licence - Canada. Credit the source.

Examples:
  greenroof fetch-weather --site my_site.yaml --years 2015-2024 --output weather.csv
  greenroof fetch-weather --site my_site.yaml --years 2015-2024 --eccc 48549 --output toronto.csv

Exit codes: 0 done, 1 the service did not send all the data, 2 bad usage or configuration, 130
interrupted
"""

from __future__ import annotations

import argparse
import shutil
from datetime import datetime, timezone
from pathlib import Path

from greenroof_ros.base.command_line import Parser, add_site, command, make_number_type, print_lines
from greenroof_ros.base.files import replace_text
from greenroof_ros.base.processes import Signals
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import FIRST_YEAR
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.commands.weather_file import show_records
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.download import eccc_station, fetch, join_blocks, open_meteo_archive
from greenroof_ros.weather.records import write_records


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("fetch-weather", __doc__, "--years YEARS --output FILE.csv [options]")
    add_site(parser, "site file, with latitude and longitude; --eccc also needs utc_offset")
    parser.add_argument(
        "--years", type=_parse_years, required=True, metavar="YEARS",
        help="fetch this year, or all years from the first to the last, such as 2015-2024",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE.csv",
        help="write the weather to this file, which must not exist yet",
    )
    parser.add_argument(
        "--eccc", type=make_number_type(1, 999_999, int), metavar="ID",
        help="fetch the hourly bulk files of this station of Environment and Climate Change Canada "
        "instead: its stationID, which is in the address of its page at climate.weather.gc.ca, "
        "such as 48549 for Toronto City Centre",
    )
    parser.add_argument(
        "--pause", type=make_number_type(0.01, 3600), metavar="S",
        help="wait between requests (s), five times as long after a failure, and twice as long "
        "after each further one (default: 3 for Open-Meteo, 1 for ECCC)",
    )
    add_url(parser, "https://customer-archive-api.open-meteo.com/v1/archive?apikey=KEY")
    return parser


def add_url(parser: Parser, example: str) -> None:
    """Add the option for the address of a service."""
    parser.add_argument(
        "--url", default="",
        help=f"another server with the same API, such as {example}; the key is neither printed "
        "nor stored (default: the service's own)",
    )


def _parse_years(text: str) -> range:
    first, dash, last = text.partition("-")
    try:
        years = range(int(first), int(last if dash else first) + 1)
    except ValueError:
        years = range(0)
    if not years or years[0] < FIRST_YEAR:
        raise argparse.ArgumentTypeError(
            f"must be a year from {FIRST_YEAR} on, or the first and the last year, such as "
            f"2015-2024, not {text}"
        )
    return years


_parse_years.__name__ = "years"  # argparse and the documentation show this


@command
def main() -> None:
    """Fetch the weather of the years named on the command line."""
    arguments = make_parser().parse_args()
    output: Path = arguments.output
    refuse_unwritable(output, ".csv")
    site, now = read_site(arguments.site), datetime.now(timezone.utc)
    if arguments.eccc is None:
        source = open_meteo_archive(site, arguments.years, now.date(), arguments.url)
    else:
        source = eccc_station(arguments.eccc, arguments.years, now.date(), arguments.url)
    part = output.with_name(f"{output.name}.part")
    Signals(interrupt=True)  # a message says what is kept
    try:
        with ProgressBar() as progress:
            files = fetch(source, site, part, arguments.pause, progress)
            progress.show("reading and joining", 1.0)
            records = join_blocks(files, site, arguments.years)
            replace_text(output, write_records(
                records, f"{source.about}\nFetched on {now:%Y-%m-%d}; the time of an hour is its "
                f"start, UTC{records.first.isoformat()[-6:]}."
            ))
    except BaseException:
        kept = sum(file.exists() for file in source.files(part))
        if 0 < kept < len(source.blocks):
            print_lines("note", [
                f"{kept} of {len(source.blocks)} parts have been saved in {part}; run the same "
                "command again to fetch the rest"
            ])
        raise
    shutil.rmtree(part)
    show_records(records, site)
    print(escape(f"written: {output}"), *source.about.splitlines(), sep="\n")
