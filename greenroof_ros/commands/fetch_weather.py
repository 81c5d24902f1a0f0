"""Fetch several years of weather from the internet into one file: ``greenroof fetch-weather``."""

from __future__ import annotations

import argparse
import shutil
import sys
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    add_site,
    command,
    make_number_type,
    print_error,
)
from greenroof_ros.base.files import replace_text
from greenroof_ros.base.http import ServiceError
from greenroof_ros.base.processes import Signals
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import FIRST_YEAR, to_people
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import format_place, measure_distance
from greenroof_ros.weather.download import eccc_station, fetch, join_blocks, open_meteo_archive
from greenroof_ros.weather.quantities import PRECIPITATION
from greenroof_ros.weather.records import HOUR, name_hours, write_records

_DESCRIPTION = """\
Fetch several years of hourly weather, with all the data needed to compute evapotranspiration, into
one CSV file that every command can read with --weather. By default, the data are Open-Meteo's
reanalysis for the site's location. The reanalysis contains the mean rain over a grid cell, so its
peaks are lower than those recorded by a rain gauge; the file and all results state this. In Canada,
--eccc fetches the observations of a station instead.

Each year or month of data is kept in FILE.part until all data have arrived. If the command is
interrupted, run it again to fetch the missing data. The command pauses between requests, and waits
after a failure, as the services request.

Open-Meteo: CC BY 4.0; the service is free for non-commercial use (https://open-meteo.com/en/terms).
Environment and Climate Change Canada: Open Government Licence - Canada. Credit the source.
"""
_EPILOG = """\
examples:
  greenroof fetch-weather --site my_site.yaml --years 2015-2024 --output weather.csv
  greenroof fetch-weather --site my_site.yaml --years 2015-2024 --eccc 48549 --output toronto.csv
  greenroof weather weather.csv --site my_site.yaml       # describe the new file

exit codes: 0 done, 1 the service did not send all the data, 2 bad usage or configuration, 130
interrupted
"""
# Maximum number of gaps that are listed.
_MAX_NAMED = 3


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(prog="greenroof fetch-weather", description=_DESCRIPTION, epilog=_EPILOG)
    add_site(parser, "site file, with latitude and longitude; --eccc also needs utc_offset")
    parser.add_argument(
        "--years", type=_parse_years, required=True, metavar="YEARS",
        help="fetch this year, or all years from the first to the last, such as 2015-2024; for "
        "the current year, the hours already available from the service are fetched",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE.csv",
        help="write the weather to this file, which must not exist yet",
    )
    parser.add_argument(
        "--eccc", type=_parse_station, metavar="ID",
        help="fetch the hourly bulk files of the Environment and Climate Change Canada station "
        "with this stationID, which is the number in the address of the station's page at "
        "climate.weather.gc.ca, such as 48549 for Toronto City Centre",
    )
    parser.add_argument(
        "--pause", type=make_number_type(0.01, 3600), metavar="S",
        help="wait S seconds between requests, and five times as long after a failure; every "
        "additional failure doubles the wait (default: 3 for Open-Meteo, 1 for ECCC)",
    )
    parser.add_argument(
        "--url", default="",
        help="fetch from another server with the same API, with an API key if necessary, such as "
        "https://customer-archive-api.open-meteo.com/v1/archive?apikey=KEY; the key is neither "
        "printed nor stored (default: the service's own address)",
    )
    return parser


def _parse_years(text: str) -> range:
    first, dash, last = text.partition("-")
    try:
        years = range(int(first), int(last if dash else first) + 1)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be a year, or two years such as 2015-2024, not {text}"
        ) from None
    if not years:
        raise argparse.ArgumentTypeError(
            f"must begin with the earlier year: {last}-{first}, not {text}"
        )
    if years[0] < FIRST_YEAR:
        raise argparse.ArgumentTypeError(f"must begin in {FIRST_YEAR} or later, not {text}")
    return years


# argparse and the documentation show this name.
_parse_years.__name__ = "years"


def _parse_station(text: str) -> int:
    if len(text) == 7:
        raise argparse.ArgumentTypeError(
            f"must be the stationID, not the climate identifier {text}: the stationID follows "
            "'StationID=' in the address of the station's page at climate.weather.gc.ca"
        )
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"must be a number such as 48549, not {text}")
    return int(text)


_parse_station.__name__ = "number"


@command
def main() -> int:
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
    except BaseException as error:
        kept = sum(file.exists() for file in source.files(part))
        if isinstance(error, ServiceError):
            print_error(str(error))
        if 0 < kept < len(source.blocks):
            print(escape(
                f"{kept} of {len(source.blocks)} parts have been saved in {part}; run the same "
                "command again to fetch the rest"
            ), file=sys.stderr)
        if isinstance(error, ServiceError):
            return EXIT_FAILED
        raise
    shutil.rmtree(part)
    rain = records.values[PRECIPITATION]
    last = records.first + (records.hours - 1) * HOUR
    print(escape(
        f"{output}: {records.hours} hours, {to_people(records.first)} to {to_people(last)}, "
        f"{np.nansum(rain):.0f} mm of rain"
    ))
    for place in {*records.places.values()}:
        away = ""
        if site.latitude is not None and site.longitude is not None:
            km = measure_distance(place, (site.latitude, site.longitude))
            away = f", {km:.0f} km from the site"
        print(f"  at {format_place(*place)}{away}")
    for name, series in records.values.items():
        spans = name_hours(records.first, np.isnan(series))
        if spans:
            more = f", and {len(spans) - _MAX_NAMED} more" if len(spans) > _MAX_NAMED else ""
            print(f"  {name} is missing: {', '.join(spans[:_MAX_NAMED])}{more}")
    for note in filter(None, [*source.about.splitlines(), records.rain_note, *records.left_out]):
        print(escape(f"  {note}"))
    return EXIT_DONE
