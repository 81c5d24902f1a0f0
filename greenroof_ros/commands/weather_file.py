"""Describe weather files, and write them as one plain CSV: ``greenroof weather FILE``."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from greenroof_ros.common.command_line import Parser, add_site, command, refuse_unwritable
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import add_path_to_errors
from greenroof_ros.common.times import to_people
from greenroof_ros.experiment.summary_table import grid
from greenroof_ros.formats.cells import HOUR
from greenroof_ros.formats.comments import STAMPS
from greenroof_ros.formats.hourly import Records, name_hours
from greenroof_ros.formats.own_csv import write_records
from greenroof_ros.formats.quantities import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES
from greenroof_ros.formats.reading import name_format
from greenroof_ros.formats.rules import check_hours
from greenroof_ros.model.place import format_place, measure_distance
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.weather.reading import complete_records, find_files, read_measured
from greenroof_ros.weather.series import Weather

_DESCRIPTION = """\
Read weather as simulate does, and describe it: service, place, period, columns, sums of rain,
gaps, what is odd, and how evapotranspiration would be computed. Several files are joined. Your own
file needs only the times and a column 'rain [mm]': the amount of each row, which begins at its
time. Rows are an hour apart, or less at a regular step. With a column 'temperature [degC]'
evapotranspiration is computed by Hargreaves; without it the site's monthly means are used, and no
frost is assumed.
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
# Above this number of months, rain is summed over years.
_MAX_MONTHS = 24
# Spans of hours, and implausible things, that the table names.
_MAX_NAMED = 3


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(prog="greenroof weather", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="weather files, or a pattern in quotes"
    )
    add_site(parser, "site file, for place, time zone and monthly means")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv",
        help="write a new CSV in this project's format; a run gives the same numbers with it",
    )
    parser.add_argument(
        "--stamped", choices=STAMPS,
        help="what the time of a row of your own file is: its start, or its end (default: as the "
        "comment 'stamped: end' states, otherwise start)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser


@command
def main() -> None:
    """Describe the files named on the command line."""
    arguments = make_parser().parse_args()
    output: Path | None = arguments.output
    if output is not None:
        refuse_unwritable(output, (".csv",), "--output")
    site = read_site(arguments.site)
    # A file of another place is described, too; a run refuses it, or warns.
    anywhere = replace(site, latitude=None, longitude=None, elevation=None)
    measured = read_measured(find_files(arguments.files, "FILE"), anywhere, arguments.stamped)
    about = _describe(measured, site)
    if output is not None:
        with add_path_to_errors(output):
            output.write_text(
                write_records(measured, f"{about['format']}; written by greenroof weather"),
                encoding="utf-8",
            )
    if arguments.json:
        print(json.dumps(about, indent=2, allow_nan=False))
        return
    console = Console()
    console.print(grid("Weather", _list_rows(about)))
    if output is not None:
        console.print(f"written: {output}", soft_wrap=True, highlight=False)


def _describe(measured: Records, site: Site) -> dict[str, Any]:
    """Return what records are, as ``--json`` prints it."""
    try:
        weather = complete_records(measured, site)
        unknown = ""
    except ConfigurationError as error:
        weather, unknown = complete_records(measured, site, rain_only=True), str(error)
    places = [*dict.fromkeys(measured.places.values())]
    return {
        "files": [str(file) for file in measured.files],
        "format": " and ".join(dict.fromkeys(map(name_format, measured.files))),
        "places": [list(place) for place in places],
        "site_place": [site.latitude, site.longitude],
        "km_from_site": _measure_distances(places, site),
        "first_hour": measured.first.isoformat(),
        "last_hour": (measured.first + (measured.hours - 1) * HOUR).isoformat(),
        "hours": measured.hours,
        "columns": {name: _describe_column(name, measured) for name in measured.values},
        "rain_mm": _sum_rain(measured),
        "rain_late_h": measured.rain_late,
        "wind_height_m": measured.wind_height,
        "missing": {
            name: name_hours(measured.first, np.flatnonzero(np.isnan(weather.values[name])))
            for name in measured.values if np.isnan(weather.values[name]).any()
        },
        "interpolated": {
            name: name_hours(measured.first, np.flatnonzero(marks))
            for name, marks in weather.filled.items() if marks.any()
        },
        "suspicious": check_hours(measured, site, range(measured.hours)),
        "evapotranspiration": _describe_evapotranspiration(weather, unknown),
        "notes": list(weather.notes),
    }


def _measure_distances(places: Sequence[tuple[float, float]], site: Site) -> list[float] | None:
    """Return how far places are from the site (km); None if the site gives no place."""
    if site.latitude is None or site.longitude is None:
        return None
    return [round(measure_distance(place, (site.latitude, site.longitude)), 1) for place in places]


def _describe_column(name: str, measured: Records) -> dict[str, Any]:
    """Return the unit of a column, its values' range and mean, and how many are missing."""
    series = measured.values[name]
    return {
        "unit": QUANTITIES[name].unit,
        **({"method": measured.method} if name == EVAPOTRANSPIRATION else {}),
        "minimum": float(np.nanmin(series)), "maximum": float(np.nanmax(series)),
        "mean": float(np.nanmean(series)), "missing_hours": int(np.isnan(series).sum()),
    }


def _sum_rain(measured: Records) -> dict[str, dict[str, float]]:
    """Return the rain of each month (mm) by the records' clock, of long records of each year."""
    rain = measured.values[PRECIPITATION]
    first = np.datetime64(measured.first.replace(tzinfo=None), "h")
    months = (first + np.arange(len(rain))).astype("datetime64[M]")
    long = len(np.unique(months)) > _MAX_MONTHS
    spans, span = np.unique(months.astype("datetime64[Y]" if long else months.dtype),
                            return_inverse=True)
    sums = np.bincount(span, np.nan_to_num(rain))
    hours, missing = np.bincount(span), np.bincount(span, np.isnan(rain))
    return {
        str(name): {"sum": round(float(total), 6), "hours": int(count), "missing_hours": int(lost)}
        for name, total, count, lost in zip(spans, sums, hours, missing, strict=True)
    }


def _describe_evapotranspiration(weather: Weather, unknown: str) -> dict[str, Any]:
    """Return the method of evapotranspiration, and its mean; or why there is none."""
    if unknown:
        return {"method": None, "reason": unknown}
    known = weather.evapotranspiration[~np.isnan(weather.evapotranspiration)]
    return {
        "method": weather.method, "mean_mm_per_day": float(known.mean()) if known.size else None,
        "missing_hours": weather.hours - known.size,
    }


def _list_rows(about: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    files = about["files"]
    yield (
        "file", about["format"],
        Path(files[0]).name if len(files) == 1
        else f"{len(files)} files, {Path(files[0]).name} to {Path(files[-1]).name}",
    )
    for number, place in enumerate(about["places"]):
        away = "" if about["km_from_site"] is None else (
            f"{about['km_from_site'][number]:.0f} km from the site, "
            f"{format_place(*about['site_place'])} (--site)"
        )
        yield "place", format_place(*place), away
    if not about["places"]:
        yield "place", "not given", ""
    span = " to ".join(
        to_people(datetime.fromisoformat(about[at])) for at in ("first_hour", "last_hour")
    )
    yield "hours", str(about["hours"]), span
    for name, column in about["columns"].items():
        missing = f"; {column['missing_hours']} missing" if column["missing_hours"] else ""
        yield name, column["unit"], (
            f"{column['minimum']:g} to {column['maximum']:g}, mean {column['mean']:.3g}{missing}"
        )
    for span, rain in about["rain_mm"].items():
        missing = f", {rain['missing_hours']} missing" if rain["missing_hours"] else ""
        yield "rain", f"{rain['sum']:.1f} mm", f"{span}, {rain['hours']} hours{missing}"
    if about["rain_late_h"]:
        yield "rain", "1 h late", "its time is the end of its hour; a run takes it as the start"
    for name, spans in about["missing"].items():
        yield "MISSING", name, _shorten(spans)
    for name, spans in about["interpolated"].items():
        yield "interpolated", name, _shorten(spans)
    if about["suspicious"]:
        yield "SUSPICIOUS", "", _shorten(about["suspicious"])
    computed = about["evapotranspiration"]
    if computed["method"] is None:
        yield "EVAPOTRANSPIRATION", "unknown", computed["reason"]
    else:
        mean = computed["mean_mm_per_day"]
        lost = computed["missing_hours"]
        yield "evapotranspiration", computed["method"], ", ".join((
            "mean unknown" if mean is None else f"mean {mean:.2f} mm/day",
            *([f"unknown in {lost} hours"] if lost else []),
        ))
    for note in about["notes"]:
        yield "note", "", note


def _shorten(texts: Sequence[str]) -> str:
    """Return the first of some texts, and how many there are besides."""
    more = len(texts) - _MAX_NAMED
    return "; ".join([*texts[:_MAX_NAMED], *([f"and {more} more"] if more > 0 else [])])
