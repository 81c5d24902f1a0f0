"""Hourly bulk files of Environment and Climate Change Canada, as downloaded."""

from __future__ import annotations

import csv
import math
import re
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import HOUR, QUANTITIES, Records

_TIME = "Date/Time (LST)"
_LONGITUDE = "Longitude (x)"
# Their column, and that of its flag, for each quantity of ours; the units are the same.
_COLUMNS = {
    "precipitation": ("Precip. Amount (mm)", "Precip. Amount Flag"),
    "temperature": ("Temp (°C)", "Temp Flag"),
    "dew point": ("Dew Point Temp (°C)", "Dew Point Temp Flag"),
    "wind speed": ("Wind Spd (km/h)", "Wind Spd Flag"),
    "station pressure": ("Stn Press (kPa)", "Stn Press Flag"),
}
# The service's legend: M = missing, NA = not available. A value beside M is not an observation:
# the last one before the gap is found repeated there.
_MISSING_FLAGS = {"M", "NA"}
# Between the mean solar time of a place and its standard time (h); more is another place's.
_MOST_FROM_SOLAR_TIME = 2.5


def is_eccc(text: str) -> bool:
    """Whether a text starts like such a file."""
    return _TIME in text.split("\n", 1)[0]


def _time(text: str, zone: timezone) -> datetime:
    """Read ``2021-07-01 0:00`` or ``2021-03-01 00:00``."""
    match = re.fullmatch(r"(\d{4})-(\d\d)-(\d\d) (\d{1,2}):(\d\d)", text.strip())
    if match is None:
        raise ValueError
    year, month, day, hour, minute = (int(part) for part in match.groups())
    return datetime(year, month, day, hour, minute, tzinfo=zone)


def parse(path: Path, text: str, site: Site) -> Records:
    """Parse a bulk file; times are local standard time, at the site's offset from UTC.

    Flags ``M`` (missing) and ``NA`` make a value missing even where one is given. Other flags, such
    as ``E`` (estimated by the service), do not.

    Args:
        path: for messages.
        text: its content, without a byte order mark.
        site: gives the offset of local standard time, which the file does not.

    Raises:
        ConfigurationError: a column is missing, a line broken or out of order, a value not a number
            or not believable, or the site's offset missing or not that of the station.
    """
    if site.utc_offset is None:
        raise ConfigurationError(
            f"is in local standard time ({_TIME}); the site file must say its offset from UTC, "
            "as in 'utc_offset: -5.0'",
            file=path, line=1,
        )
    zone = timezone(timedelta(hours=site.utc_offset))
    reader = csv.reader(text.splitlines(), strict=True)
    try:
        rows = [(reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        raise ConfigurationError(
            f"is not valid CSV: {error}", file=path, line=reader.line_num
        ) from error
    header = [cell.strip() for cell in rows[0][1]]
    needed = [_TIME, _LONGITUDE, *(name for pair in _COLUMNS.values() for name in pair)]
    for name in needed:
        if name not in header:
            raise ConfigurationError(
                f"must have a column '{name}', as hourly bulk files have", file=path, line=1
            )
    index = {name: header.index(name) for name in needed}
    if len(rows) == 1:
        raise ConfigurationError("has a header but no records", file=path)
    first: datetime | None = None
    values: dict[str, list[float]] = {quantity: [] for quantity in _COLUMNS}
    for number, (line, row) in enumerate(rows[1:]):
        if len(row) != len(header):
            raise ConfigurationError(
                f"must have {len(header)} cells as the header has, not {len(row)}",
                file=path, line=line,
            )
        try:
            time = _time(row[index[_TIME]], zone)
        except ValueError:
            raise ConfigurationError(
                "must be a time such as 2021-07-01 0:00",
                file=path, line=line, key=_TIME, value=row[index[_TIME]],
            ) from None
        if first is None:
            first = time
            _check_zone(path, line, row[index[_LONGITUDE]], site.utc_offset)
        due = first + number * HOUR
        if time != due:
            raise ConfigurationError(
                f"must be {due:%Y-%m-%d %H:%M}: the records must be hour after hour",
                file=path, line=line, key=_TIME, value=row[index[_TIME]],
            )
        for quantity, (column, flag) in _COLUMNS.items():
            values[quantity].append(
                _value(path, line, quantity, column, row[index[column]], row[index[flag]])
            )
    assert first is not None
    return Records(path, first, {key: np.array(value) for key, value in values.items()})


def _value(path: Path, line: int, quantity: str, column: str, text: str, flag: str) -> float:
    """Return a value, NaN if it is missing."""
    if not text.strip() or flag.strip() in _MISSING_FLAGS:
        return math.nan
    unit, least, largest = QUANTITIES[quantity]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= largest:
        raise ConfigurationError(
            f"must be a number from {least:g} to {largest:g} {unit}, or empty",
            file=path, line=line, key=column, value=text,
        )
    return value


def _check_zone(path: Path, line: int, text: str, utc_offset: float) -> None:
    """Refuse a station at which the sun is not near the site's standard time."""
    try:
        longitude = float(text)
    except ValueError:
        longitude = math.nan
    if not abs(longitude / 15 - utc_offset) <= _MOST_FROM_SOLAR_TIME:
        raise ConfigurationError(
            f"is not near the standard time of the site, utc_offset = {utc_offset:g} h, which "
            f"belongs to a longitude of about {15 * utc_offset:g}",
            file=path, line=line, key=_LONGITUDE, value=text,
        )
