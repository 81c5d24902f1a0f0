"""Read weather files in the same way as simulate, and show what they contain.

The table has the period, the rain of each month or year, the wettest hour and day, the range of
every quantity, missing hours, and the method by which evapotranspiration would be computed. Nothing
in a file is guessed or changed: what its columns mean is stated by its header or by a description,
a YAML file beside it. If more than one file is given, the files are joined.

a file in the package's own form needs no description:
  time,rain [mm],temperature [degC]
  2024-06-01T00:00-05:00,0.0,17.3
  2024-06-01T00:05-05:00,0.2,17.2

Examples:
  greenroof weather logger.csv --site my_site.yaml
  greenroof weather gauge.csv --describe > gauge.yaml
  greenroof weather gauge.yaml --output gauge_plain.csv
  greenroof simulate --weather gauge.yaml --start 2021-07-01

Exit codes: 0 done, 2 bad usage, configuration or file
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from greenroof_ros.base.command_line import Parser, add_site, command, refuse_unwritable
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors, default_site_file
from greenroof_ros.base.times import to_people
from greenroof_ros.simulation.screen import grid
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Place, Site, format_place
from greenroof_ros.weather.describe import describe
from greenroof_ros.weather.evapotranspiration import FAO56, HARGREAVES
from greenroof_ros.weather.read import complete_records, find_files, read_measured
from greenroof_ros.weather.records import HOUR, Records, name_hours, write_records
from greenroof_ros.weather.series import Weather
from greenroof_ros.weather.summary import as_lines, summarize

# Gaps that are named; the first ones.
_MAX_NAMED = 3

def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("weather", __doc__, "FILE [FILE ...] [options]")
    parser.add_argument(
        "files", nargs="+", metavar="FILE",
        help="weather files, descriptions of weather files, directories, or a pattern in quotes",
    )
    add_site(parser, "use the location, time zone and monthly means in this site file")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv",
        help="write the weather to this new CSV file, with which a run yields the same numbers",
    )
    parser.add_argument(
        "--describe", action="store_true",
        help="print a description of the file, in which a person must replace each question mark",
    )
    return parser


@command
def main() -> None:
    """Describe the files named on the command line."""
    arguments = make_parser().parse_args()
    output: Path | None = arguments.output
    if output is not None:
        refuse_unwritable(output, ".csv")
    files = find_files(arguments.files, "FILE")
    if arguments.describe:
        print(describe(files[0]), end="")
        return
    site = read_site(arguments.site)
    # A file for another place is described, too; a run rejects it, or warns.
    anywhere = replace(site, latitude=None, longitude=None, elevation=None)
    measured = read_measured(files, anywhere)
    # No place is known without a site file, so the file's clock counts.
    show_records(measured, site, Place() if arguments.site == default_site_file() else site)
    if output is not None:
        about = "\n".join((*measured.applied, "Written by greenroof weather."))
        with add_path_to_errors(output):
            output.write_text(write_records(measured, about), encoding="utf-8")
        PlainConsole().print(f"written: {output}", soft_wrap=True)


def show_records(measured: Records, site: Site, clock: Place) -> None:
    """Print a table of what a weather record contains, at a site, with sums on a clock."""
    PlainConsole().print(grid("Weather", _describe(measured, site, clock)))


def _describe(measured: Records, site: Site, clock: Place) -> Iterator[tuple[str, str, str]]:
    """Yield rows: a label, a value and a description."""
    try:
        weather, unknown = complete_records(measured, site), ""
    except ConfigurationError as error:
        weather, unknown = complete_records(measured, site, method=""), str(error)
    for text in measured.left_out:
        yield "left out", "", text
    for place in dict.fromkeys(measured.places.values()):
        yield "place", format_place(*place), "of the weather"
    last = measured.first + (measured.hours - 1) * HOUR
    yield "hours", str(measured.hours), f"{to_people(measured.first)} to {to_people(last)}"
    if measured.rain_late:
        yield "rain", "1 h late", "each time is the end of an hour; a run treats it as the start"
    if measured.rain_kind:
        yield "rain", measured.rain_kind, measured.rain_note
    for line in as_lines(summarize(measured, clock)):
        yield "summary", "", line
    for name, series in measured.values.items():
        if spans := name_hours(measured.first, np.isnan(series)):
            yield f"no {name}", f"{np.isnan(series).sum()} h", ", ".join(spans[:_MAX_NAMED])
    known = weather.evapotranspiration[~np.isnan(weather.evapotranspiration)]
    if known.size:
        lost = f", unknown in {weather.hours - known.size} hours" * (known.size < weather.hours)
        yield "evapotranspiration", weather.method, f"mean {known.mean():.2f} mm/day{lost}"
    else:
        yield "EVAPOTRANSPIRATION", "unknown", unknown
    yield from _average_months(weather, site)


def _average_months(weather: Weather, site: Site) -> Iterator[tuple[str, str, str]]:
    """Yield the monthly means for reference grass, as in a site file, if all of them are known."""
    first = np.datetime64(weather.first.replace(tzinfo=None), "h")
    months = (first + np.arange(weather.hours)).astype("datetime64[M]").astype(int) % 12
    known = ~np.isnan(weather.evapotranspiration)
    hours = np.bincount(months[known], minlength=12)
    if weather.method in (FAO56, HARGREAVES) and hours.all():
        sums = np.bincount(months[known], weather.evapotranspiration[known])
        means = np.round(sums / hours / site.crop_coefficient, 2).tolist()
        yield "evapotranspiration", "monthly", f"monthly_evapotranspiration: {means}"
