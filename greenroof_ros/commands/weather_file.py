"""Describe weather files, and write them as one plain CSV: ``greenroof weather FILE``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from greenroof_ros.base.command_line import Parser, add_site, command, refuse_unwritable
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.times import to_people
from greenroof_ros.formats.cells import HOUR
from greenroof_ros.formats.comments import STAMPS
from greenroof_ros.formats.hourly import Records, name_hours
from greenroof_ros.formats.own_csv import write_records
from greenroof_ros.formats.quantities import PRECIPITATION, QUANTITIES
from greenroof_ros.formats.reading import name_format
from greenroof_ros.formats.rules import check_hours
from greenroof_ros.simulation.screen import grid
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site, format_place, measure_distance
from greenroof_ros.weather.evapotranspiration import FAO56, HARGREAVES
from greenroof_ros.weather.reading import complete_records, find_files, read_measured
from greenroof_ros.weather.series import Weather

_DESCRIPTION = """\
Read weather files in the same way as simulate, and describe the weather: service, location, period,
columns, rainfall totals, gaps, suspicious values, and the method by which evapotranspiration would
be computed. If more than one file is specified, the files are joined into one record. Your own file
needs only the times and a column 'rain [mm]' with the amount of rain in the interval that begins at
the time of the row. The intervals must be of equal length, at most one hour. If there is a column
'temperature [degC]', evapotranspiration is computed with Hargreaves' equation. Otherwise, the
site's monthly means are used, and it is assumed that there is no frost.
"""
_EPILOG = """\
your own file:
  time,rain [mm]
  2024-06-01T00:00-05:00,0.0
  2024-06-01T00:05-05:00,0.2

examples:
  greenroof weather logger.csv --site my_site.yaml
  greenroof weather 'hourly_*.csv' --output toronto.csv
  greenroof weather gauge.csv --stamped end --output toronto.csv
  greenroof simulate --weather toronto.csv --start 2021-07-01

exit codes: 0 done, 2 bad usage, configuration or file
"""
# For more months than this, rain is summed by year.
_MAX_MONTHS = 24
# Maximum number of spans of hours, and of implausible things, that the table names.
_MAX_NAMED = 3


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(prog="greenroof weather", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="weather files, or a glob pattern in quotes"
    )
    add_site(parser, "use the location, time zone and monthly means in this site file")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv",
        help="write the weather to this new CSV file, in this project's format; a run with this "
        "file yields the same numbers",
    )
    parser.add_argument(
        "--stamped", choices=STAMPS,
        help="treat the time of each row in your own file as the start or the end of the row's "
        "interval (default: end if the file has the comment 'stamped: end', otherwise start)",
    )
    return parser


@command
def main() -> None:
    """Describe the files named on the command line."""
    arguments = make_parser().parse_args()
    output: Path | None = arguments.output
    if output is not None:
        refuse_unwritable(output, (".csv",), "--output")
    site = read_site(arguments.site)
    # A file for another place is described, too; a run rejects it, or warns.
    anywhere = replace(site, latitude=None, longitude=None, elevation=None)
    measured = read_measured(find_files(arguments.files, "FILE"), anywhere, arguments.stamped)
    table = grid("Weather", _describe(measured, site))
    if output is not None:
        with add_path_to_errors(output):
            output.write_text(
                write_records(measured, f"{_name_formats(measured)}; written by greenroof weather"),
                encoding="utf-8",
            )
    console = Console()
    console.print(table)
    if output is not None:
        console.print(f"written: {output}", soft_wrap=True, highlight=False)


def _describe(measured: Records, site: Site) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of the table, each with a label, a value and a description."""
    try:
        weather = complete_records(measured, site)
        unknown = ""
    except ConfigurationError as error:
        weather, unknown = complete_records(measured, site, rain_only=True), str(error)
    names = [file.name for file in measured.files]
    yield (
        "file", _name_formats(measured),
        names[0] if len(names) == 1 else f"{len(names)} files, {names[0]} to {names[-1]}",
    )
    yield from _describe_places(measured, site)
    last = measured.first + (measured.hours - 1) * HOUR
    yield "hours", str(measured.hours), f"{to_people(measured.first)} to {to_people(last)}"
    for name, series in measured.values.items():
        yield name, QUANTITIES[name].unit, (
            f"{np.nanmin(series):g} to {np.nanmax(series):g}, mean {np.nanmean(series):.3g}"
            + _count_missing("; ", np.isnan(series).sum())
        )
    yield from _sum_rain(measured)
    if measured.rain_late:
        yield "rain", "1 h late", "each time is the end of an hour; a run treats it as the start"
    if measured.rain_kind:
        yield "rain", measured.rain_kind, measured.rain_note
    missing = {name: np.isnan(weather.values[name]) for name in measured.values}
    for what, marked in (("MISSING", missing), ("interpolated", weather.filled)):
        for name, marks in marked.items():
            if marks.any():
                yield what, name, _shorten(name_hours(measured.first, np.flatnonzero(marks)))
    if suspicious := check_hours(measured, site, range(measured.hours)):
        yield "SUSPICIOUS", "", _shorten(suspicious)
    yield _describe_evapotranspiration(weather, unknown)
    yield from _average_months(weather, site)
    for note in weather.notes:
        yield "note", "", note


def _name_formats(measured: Records) -> str:
    return " and ".join(dict.fromkeys(map(name_format, measured.files)))


def _describe_places(measured: Records, site: Site) -> Iterator[tuple[str, str, str]]:
    """Yield a row for every location in the records, with its distance from the site if known."""
    for place in dict.fromkeys(measured.places.values()):
        away = ""
        if site.latitude is not None and site.longitude is not None:
            own = site.latitude, site.longitude
            away = (
                f"{measure_distance(place, own):.0f} km from the site, {format_place(*own)} "
                "(--site)"
            )
        yield "place", format_place(*place), away
    if not measured.places:
        yield "place", "not stated", ""


def _sum_rain(measured: Records) -> Iterator[tuple[str, str, str]]:
    """Yield the rain (mm) by month, or by year for long records, on the records' clock."""
    rain = measured.values[PRECIPITATION]
    first = np.datetime64(measured.first.replace(tzinfo=None), "h")
    months = (first + np.arange(len(rain))).astype("datetime64[M]")
    long = len(np.unique(months)) > _MAX_MONTHS
    spans, span = np.unique(months.astype("datetime64[Y]" if long else months.dtype),
                            return_inverse=True)
    sums = np.bincount(span, np.nan_to_num(rain))
    hours, missing = np.bincount(span), np.bincount(span, np.isnan(rain))
    for name, total, count, lost in zip(spans, sums, hours, missing, strict=True):
        # Rounded twice: a sum of binary numbers just below a half belongs to the half.
        yield "rain", f"{round(total, 6):.1f} mm", (
            f"{name}, {count} hours{_count_missing(', ', lost)}"
        )


def _describe_evapotranspiration(weather: Weather, unknown: str) -> tuple[str, str, str]:
    """Return the row for evapotranspiration, with its method and mean, or the reason if unknown."""
    if unknown:
        return "EVAPOTRANSPIRATION", "unknown", unknown
    known = weather.evapotranspiration[~np.isnan(weather.evapotranspiration)]
    mean = f"mean {known.mean():.2f} mm/day" if known.size else "mean unknown"
    lost = weather.hours - known.size
    return "evapotranspiration", weather.method, (
        mean + (f", unknown in {lost} hours" if lost else "")
    )


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


def _count_missing(separator: str, missing: int) -> str:
    return f"{separator}{missing} missing" if missing else ""


def _shorten(texts: Sequence[str]) -> str:
    """Join the first few strings, and state the number of the others."""
    more = len(texts) - _MAX_NAMED
    return "; ".join([*texts[:_MAX_NAMED], *([f"and {more} more"] if more > 0 else [])])
