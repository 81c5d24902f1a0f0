"""Hourly bulk files of Environment and Climate Change Canada (ECCC), as downloaded."""

from __future__ import annotations

import math
from datetime import timedelta, timezone
from functools import partial
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import Records
from greenroof_ros.weather.table import Row, Table, numbered_lines, read_hours

BYTE_ORDER_MARK = True

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


def recognises(text: str, /) -> bool:
    """Whether the first line has the service's column of local standard time."""
    return _TIME in text.split("\n", 1)[0]


def parse(file: Path, text: str, site: Site, /) -> Records:
    """Parse a bulk file; times are local standard time, at the site's offset from UTC.

    A record is taken as of the hour that starts at its time, as in the paper. Rain is of the hour
    before: the service's current observations call it ``pcpn_amt_pst1hr``, and by the column
    ``Weather`` it rains at a wet row's time and an hour before about as often, and less often an
    hour after. So rain stands an hour late, ``rain_late`` of the records, which is what forecasts
    are held against. Flags ``M`` (missing) and ``NA`` make a value missing even where one is given.
    Other flags, such as ``E`` (estimated by the service), do not. A row that ends before the first
    observation, as the service writes them for hours of which it has nothing, is an hour in which
    all are missing.

    Args:
        file: for messages.
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
            file=file, line=1,
        )
    zone = timezone(timedelta(hours=site.utc_offset))
    table = Table(file, numbered_lines(text))
    observed = [name for pair in _COLUMNS.values() for name in pair]
    table.require((_TIME, _LONGITUDE, *observed), "hourly bulk files")
    observed_from = min(map(table.header.index, observed))
    _check_zone(next(table.rows(observed_from)), site.utc_offset)
    first, values = read_hours(
        table.rows(observed_from), _TIME,
        lambda row: row.local_time(_TIME, zone, "2021-07-01 0:00"),
        {quantity: partial(_value, quantity=quantity) for quantity in _COLUMNS},
    )
    return Records((file,), first, values, rain_late=1)


def _value(row: Row, quantity: str) -> float:
    """Return a value, NaN if it is missing."""
    column, flag = _COLUMNS[quantity]
    if row.cells[flag] in _MISSING_FLAGS:
        return math.nan
    return row.value(column, quantity, missing=("",))


def _check_zone(row: Row, utc_offset: float) -> None:
    """Refuse a station at which the sun is not near the site's standard time."""
    try:
        longitude = float(row.cells[_LONGITUDE])
    except ValueError:
        longitude = math.nan
    if not abs(longitude / 15 - utc_offset) <= _MOST_FROM_SOLAR_TIME:
        raise row.refuse(
            f"is not near the standard time of the site, utc_offset = {utc_offset:g} h, which "
            f"belongs to a longitude of about {15 * utc_offset:g}",
            _LONGITUDE,
        )
