"""Hourly bulk files of Environment and Climate Change Canada (ECCC), as downloaded."""

from __future__ import annotations

from datetime import timedelta, timezone
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import parse_local_time
from greenroof_ros.formats.records import QUANTITIES, Records, Table, read_table
from greenroof_ros.model.site import Site

_TIME = "Date/Time (LST)"
_LONGITUDE = "Longitude (x)"
# Their column, and its flag's, for each quantity of ours; the units are the same.
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


def recognises(_file: Path, head: bytes, /) -> bool:
    """Whether the first line has the service's column of local standard time."""
    return _TIME.encode() in head.partition(b"\n")[0]


def read_records(file: Path, site: Site, /) -> Records:
    """Read a bulk file; times are local standard time, at the site's offset from UTC.

    A record is of the hour that starts at its time, as in the paper. But rain is of the hour
    before: the service's current observations call it ``pcpn_amt_pst1hr``, and by the column
    ``Weather`` it rains at a wet row's time and an hour before about as often, and less often an
    hour after. So rain stands an hour late, ``rain_late`` of the records, by which forecasts are
    compared with it. Flags ``M`` (missing) and ``NA`` make a value missing even where one is given.
    Other flags, such as ``E`` (estimated by the service), do not. A row that ends before the first
    observation, as the service writes them for hours without observations, is an hour in which
    all are missing.

    Args:
        file: as downloaded, with a byte order mark or without.
        site: gives the offset of local standard time, which the file does not.

    Raises:
        ConfigurationError: a column is missing, a line broken or out of order, a value not a number
            or not believable, or the site's offset missing or not the station's.
    """
    if site.utc_offset is None:
        raise ConfigurationError(
            f"is in local standard time ({_TIME}); the site file must say its offset from UTC, "
            "as in 'utc_offset: -5.0'",
            file=file, line=1,
        )
    observed = [name for pair in _COLUMNS.values() for name in pair]
    table = read_table(file, observed)
    table.require((_TIME, _LONGITUDE, *observed), "hourly bulk files")
    _check_zone(table, site.utc_offset)
    zone = timezone(timedelta(hours=site.utc_offset))
    first = table.first_hour(
        _TIME, lambda text: parse_local_time(text, zone), "2021-07-01 0:00"
    )
    values = {}
    for quantity, (column, flags) in _COLUMNS.items():
        table.columns[column] = [
            "" if flag in _MISSING_FLAGS else text
            for text, flag in zip(table.columns[column], table.columns[flags], strict=True)
        ]
        values[quantity] = table.numbers(column, QUANTITIES[quantity], missing=("",))
    return Records((file,), first, values, rain_late=1)


def _check_zone(table: Table, utc_offset: float) -> None:
    """Refuse a station at which the sun is not near the site's standard time."""
    longitude = table.numbers(_LONGITUDE, ("degrees", -180.0, 180.0))[0]
    if abs(longitude / 15 - utc_offset) > _MOST_FROM_SOLAR_TIME:
        raise table.refuse(
            f"is not near the standard time of the site, utc_offset = {utc_offset:g} h, which "
            f"belongs to a longitude of about {15 * utc_offset:g}",
            _LONGITUDE, 0,
        )
