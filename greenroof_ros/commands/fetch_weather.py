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

import shutil
from datetime import datetime, timezone
from pathlib import Path

from greenroof_ros.base.command_line import (
    Parser,
    add_site,
    command,
    make_number_type,
    refuse_unwritable,
)
from greenroof_ros.base.console import ProgressBar
from greenroof_ros.base.files import replace_text
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import FIRST_YEAR
from greenroof_ros.commands.weather_file import show_records
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.download import eccc_station, fetch, join_blocks, open_meteo_archive
from greenroof_ros.weather.records import write_records

_read_year = make_number_type(FIRST_YEAR, 9999, int)


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
    years = sorted(int(_read_year(year)) for year in text.split("-"))
    return range(years[0], years[-1] + 1)


_parse_years.__name__ = "years"  # argparse and the documentation show this


@command
def main() -> None:
    """Fetch the weather of the years named on the command line."""
    arguments = make_parser().parse_args()
    output, years = arguments.output, arguments.years
    refuse_unwritable(output, ".csv")
    site, now = read_site(arguments.site), datetime.now(timezone.utc)
    if arguments.eccc is None:
        source = open_meteo_archive(site, years, now.date(), arguments.url)
    else:
        source = eccc_station(arguments.eccc, years, now.date(), arguments.url)
    part = output.with_name(f"{output.name}.part")
    with ProgressBar() as progress:
        records = join_blocks(fetch(source, site, part, progress), site, years)
    replace_text(output, write_records(
        records, f"{source.about}\nFetched on {now:%Y-%m-%d}; the time of an hour is its "
        f"start, UTC{records.first.isoformat()[-6:]}."
    ))
    shutil.rmtree(part)
    show_records(records, site, site)
    print(escape(f"written: {output}"), *source.about.splitlines(), sep="\n")
