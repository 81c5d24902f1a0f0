"""Hourly CSV files of Open-Meteo's archive, the Historical Weather API, as downloaded.

Two lines about the place come first, then a header with units and the hours::

    latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation
    43.620384,-79.41748,77.0,-18000,America/Toronto,GMT-5

    time,temperature_2m (°C),precipitation (mm),shortwave_radiation (W/m²)
    2021-07-07T00:00,21.4,0.20,0.0

Precipitation is the sum, and shortwave radiation the mean, of the hour *before* their time; the
other quantities are of the instant. (Open-Meteo, Historical Weather API, Hourly Parameter
Definition: "Preceding hour sum", "Preceding hour mean", "Instant".) Here a record is of the hour
that starts at its time: so rain and radiation are moved an hour back, and what is of an instant
holds for the hour after it, as in ECCC's files.

Local times have one offset from UTC in the whole file, also over a change of daylight saving time:
that of ``utc_offset_seconds``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta, timezone
from functools import partial
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import (
    FOR_EVAPOTRANSPIRATION,
    HOUR,
    PRECIPITATION,
    RADIATION,
    Records,
)
from greenroof_ros.weather.table import Row, Table, Unit, numbered_lines, read_hours

BYTE_ORDER_MARK = True

PRECIPITATION_UNITS = (Unit("mm"), Unit("inch", 1 / 25.4))

_OFFSET = "utc_offset_seconds"
# Their variable for each quantity of ours, and the units that it may have.
_VARIABLES = {
    PRECIPITATION: ("precipitation", PRECIPITATION_UNITS),
    "temperature": ("temperature_2m", (Unit("°C"), Unit("°F", 1.8, 32.0))),
    "dew point": ("dew_point_2m", (Unit("°C"), Unit("°F", 1.8, 32.0))),
    "wind speed": (
        "wind_speed_10m",
        (Unit("km/h"), Unit("m/s", 1 / 3.6), Unit("mp/h", 1 / 1.609344), Unit("kn", 1 / 1.852)),
    ),
    "station pressure": ("surface_pressure", (Unit("hPa", 10.0),)),
    RADIATION: ("shortwave_radiation", (Unit("W/m²"),)),
}
_NEEDED = (PRECIPITATION, *FOR_EVAPOTRANSPIRATION)
_OF_THE_HOUR_BEFORE = (PRECIPITATION, RADIATION)
# How far the place of a file may be from the site, and the end of its range: a cell of the coarsest
# model is half a degree wide; air is 2 degC colder 300 m further up.
_PLACE = {
    "latitude": (0.5, 90.0), "longitude": (0.5, 180.0), "elevation": (300.0, 9000.0),
}


@dataclass(frozen=True)
class Place:
    """What a file of the service says of its place.

    Attributes:
        file: that it is from.
        line: of the file; None where it has none that say anything, as JSON.
        values: as they are written, by their name.
    """

    file: Path
    line: int | None
    values: dict[str, str]

    def refuse(self, expected: str, name: str) -> ConfigurationError:
        """Return an error that names file, line, and one of the values."""
        return ConfigurationError(
            expected, file=self.file, line=self.line, key=name, value=self.values.get(name)
        )


def recognises(text: str, /) -> bool:
    """Whether the first line names the service's offset from UTC."""
    return _OFFSET in text.split("\n", 1)[0]


def lines_of(file: Path, text: str) -> tuple[Place, list[tuple[int, str]]]:
    """Return what a CSV of the service says of the place, and its further lines, numbered.

    Raises:
        ConfigurationError: it has fewer than three lines, or those of the place are not CSV.
    """
    lines = numbered_lines(text)
    if len(lines) < 3:
        raise ConfigurationError(
            "must have two lines about the place, then a header and records", file=file
        )
    row = next(Table(file, lines[:2]).rows())
    return Place(file, row.line, row.cells), lines[2:]


def parse(file: Path, text: str, site: Site, /) -> Records:
    """Parse a file of one place with hourly values; an empty cell or ``NaN`` is a missing value.

    Needed are precipitation, temperature, dew point, wind speed and surface pressure; shortwave
    radiation is used where it is there, and other variables are not.

    Args:
        file: for messages.
        text: its content, without a byte order mark.
        site: must be near the file's place, as far as it says its own.

    Raises:
        ConfigurationError: the lines about the place are wrong or of another one, a column is
            missing or its unit unknown, a line broken or out of order, or a value not a number or
            not believable.
    """
    place, lines = lines_of(file, text)
    zone = zone_of(place)
    check_place(place, site)
    table = Table(file, lines)
    table.require(("time",), "Open-Meteo's hourly files")
    columns = dict(_columns(table))
    first, values = read_hours(
        table.rows(), "time",
        lambda row: row.local_time("time", zone, "2021-07-07T02:00"),
        {
            quantity: partial(
                Row.value, column=column, quantity=quantity, unit=unit, missing=("", "NaN")
            )
            for quantity, (column, unit) in columns.items()
        },
    )
    # One hour more: that before the first time has rain and radiation only, the last has none.
    nothing = np.array([math.nan])
    shifted = tuple(quantity for quantity in _OF_THE_HOUR_BEFORE if quantity in values)
    return Records(
        (file,),
        first - HOUR,
        {
            quantity: np.concatenate(
                (series, nothing) if quantity in shifted else (nothing, series)
            )
            for quantity, series in values.items()
        },
        shifted=shifted,
    )


def zone_of(place: Place) -> timezone:
    """Return the offset of all times of a file from UTC.

    Raises:
        ConfigurationError: the file is of several places, or the offset is not one.
    """
    if "location_id" in place.values:
        raise place.refuse("must be of one place; download each by itself", "location_id")
    text = place.values.get(_OFFSET, "")
    # From UTC-12 to UTC+14.
    if not re.fullmatch(r"-?\d{1,5}", text) or not -43200 <= int(text) <= 50400:
        raise place.refuse("must be a whole number of seconds from -43200 to 50400", _OFFSET)
    return timezone(timedelta(seconds=int(text)))


def check_place(place: Place, site: Site) -> None:
    """Refuse a place that is not near the site's, where the site says its own.

    Raises:
        ConfigurationError: it is not near, or not a place.
    """
    for name, (most, end) in _PLACE.items():
        try:
            value = float(place.values[name])
        except (KeyError, ValueError):
            raise place.refuse(f"must be a number from {-end:g} to {end:g}", name) from None
        if math.isnan(value) and name == "elevation":  # as the service writes an unknown one
            continue
        own: float | None = getattr(site, name)
        if not -end <= value <= end:
            raise place.refuse(f"must be a number from {-end:g} to {end:g}", name)
        if own is None:
            continue
        away = abs(value - own)
        if name == "longitude":  # 179.9 and -179.9 are neighbours
            away = min(away, 360 - away)
        if away > most:
            raise place.refuse(
                f"must be within {most:g} {'m' if name == 'elevation' else 'degrees'} of the "
                f"site's {name}, {own:g}",
                name,
            )


def _columns(table: Table) -> Iterator[tuple[str, tuple[str, Unit]]]:
    """Yield each quantity that the header has, with its column and unit."""
    for quantity, (variable, units) in _VARIABLES.items():
        found = [name for name in table.header if name.partition(" ")[0] == variable]
        known = [f"{variable} ({unit.name})" for unit in units]
        if not found and quantity not in _NEEDED:
            continue
        if not found:
            table.require(known[:1], "Open-Meteo's hourly files")
        table.require(found, "Open-Meteo's hourly files")
        if len(found) > 1 or found[0] not in known:
            raise table.refuse(f"must be {' or '.join(known)}, and one column", found[-1])
        yield quantity, (found[0], units[known.index(found[0])])
