"""Hourly bulk files of Environment and Climate Change Canada (ECCC), as downloaded."""

from __future__ import annotations

from datetime import timedelta, timezone
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import parse_local_time
from greenroof_ros.formats.records import QUANTITIES, Records, Table, read_table
from greenroof_ros.model.site import Site

_TIME = "Date/Time (LST)"
_LATITUDE, _LONGITUDE = "Latitude (y)", "Longitude (x)"
# Height of the wind at its stations, as WMO has it (m).
_WIND_HEIGHT_M = 10.0
# The service's columns of value and flag for each of our quantities; the units are the same.
_COLUMNS = {
    "precipitation": ("Precip. Amount (mm)", "Precip. Amount Flag"),
    "temperature": ("Temp (°C)", "Temp Flag"),
    "dew point": ("Dew Point Temp (°C)", "Dew Point Temp Flag"),
    "wind speed": ("Wind Spd (km/h)", "Wind Spd Flag"),
    "station pressure": ("Stn Press (kPa)", "Stn Press Flag"),
}
# The service's legend: M = missing, NA = not available. A value flagged M is not an observation: it
# often repeats the last one before the gap.
_MISSING_FLAGS = {"M", "NA"}
# Largest difference between a place's mean solar time and its standard time (h).
_MOST_FROM_SOLAR_TIME = 2.5


def recognises(_file: Path, head: bytes, /) -> bool:
    """Return whether the first line has the service's column of local standard time."""
    return _TIME.encode() in head.partition(b"\n")[0]


def read_records(file: Path, site: Site, /) -> Records:
    """Read a bulk file; times are local standard time, at the site's offset from UTC.

    A record is for the hour that starts at its time, as in the paper. But rain is for the hour
    before: the service's current observations call it ``pcpn_amt_pst1hr``, and by the column
    ``Weather`` it rains at a wet row's time and an hour before about equally often, and less often
    an hour after. So rain is recorded an hour late; ``rain_late`` of the records says so, and
    forecasts are compared accordingly. Flags ``M`` (missing) and ``NA`` make a value missing even
    if one is given. Other flags, such as ``E`` (estimated by the service), do not. A row that ends
    before the first observation, as the service writes for hours without any, is all missing.

    Args:
        file: as downloaded, with or without a byte order mark.
        site: gives the offset of local standard time, which is not in the file.

    Raises:
        ConfigurationError: a column is missing, a line is broken or out of order, a value is not a
            plausible number, or the site's offset is missing or does not fit the station.
    """
    if site.utc_offset is None:
        raise ConfigurationError(
            f"is in local standard time ({_TIME}); the site file must give its offset from UTC, "
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
    return Records(
        (file,), first, values, rain_late=1, places=_place(table), wind_height=_WIND_HEIGHT_M
    )


def _place(table: Table) -> dict[Path, tuple[float, float]]:
    """Return the station's place, by file; empty if a column is missing."""
    if not {_LATITUDE, _LONGITUDE} <= table.columns.keys():
        return {}
    latitude, longitude = (
        float(table.numbers(column, ("degrees", -end, end), missing=("",))[0])
        for column, end in ((_LATITUDE, 90.0), (_LONGITUDE, 180.0))
    )
    return {table.file: (latitude, longitude)}


def _check_zone(table: Table, utc_offset: float) -> None:
    """Refuse a station whose solar time is not near the site's standard time."""
    longitude = table.numbers(_LONGITUDE, ("degrees", -180.0, 180.0))[0]
    if abs(longitude / 15 - utc_offset) > _MOST_FROM_SOLAR_TIME:
        raise table.refuse(
            f"is not near the standard time of the site, utc_offset = {utc_offset:g} h, which "
            f"belongs to a longitude of about {15 * utc_offset:g}",
            _LONGITUDE, 0,
        )
