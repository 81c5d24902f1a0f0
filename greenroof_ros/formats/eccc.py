"""Hourly bulk files of Environment and Climate Change Canada (ECCC), as downloaded."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Container, Iterable, Mapping
from datetime import timedelta, timezone
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import parse_local_time
from greenroof_ros.formats.records import (
    NEARLY,
    PRECIPITATION,
    QUANTITIES,
    Records,
    Table,
    by_hour,
    read_table,
)
from greenroof_ros.model.site import Site

# Names of columns, in English and French, without accents, case, spaces and points; in the English
# files before 2021 the time has no zone.
_TIME = ("date/time(lst)", "date/time", "date/heure(hnl)", "date/heure")
_LATITUDE, _LONGITUDE = "latitude(y)", "longitude(x)"
# Height of the wind at its stations, as WMO has it (m).
_WIND_HEIGHT_M = 10.0
# The service's columns of each of our quantities; the units are the same. Flags are in the next.
_COLUMNS = {
    PRECIPITATION: ("precipamount(mm)", "hauteurdeprecip(mm)"),
    "temperature": ("temp(°c)",),
    "dew point": ("dewpointtemp(°c)", "pointderosee(°c)"),
    "wind speed": ("windspd(km/h)", "vitduvent(km/h)"),
    "station pressure": ("stnpress(kpa)", "pressionalastation(kpa)"),
}
_FLAG = ("flag", "indicateur")
# In the name of a column of daily and monthly files.
_LONGER = "max"
_DOWNLOAD = (
    "download hourly data of the station with precipitation (climate.weather.gc.ca, Hourly data; "
    "climat.meteo.gc.ca, Données horaires)"
)
# The service's legend: M = missing, NA (N/D in French) = not available. A value flagged M is not an
# observation: it often repeats the last one before the gap.
_MISSING_FLAGS = {"M", "NA", "N/D"}
# Largest difference between a place's mean solar time and its standard time (h).
_MOST_FROM_SOLAR_TIME = 2.5


def recognises(_file: Path, head: bytes, /) -> bool:
    """Return whether the first line has the service's columns of place and time."""
    cells = re.split("[,;\t]", head.decode("utf-8-sig", "replace").partition("\n")[0])
    names = {_plain(cell.strip('" \r')) for cell in cells}
    return not names.isdisjoint(_TIME) and (
        _LONGITUDE in names or not names.isdisjoint(_COLUMNS["temperature"])
        or any(_LONGER in name for name in names)
    )


def _plain(name: str) -> str:
    """Return a column's name without accents, case, spaces and points."""
    letters = unicodedata.normalize("NFD", name.replace("°", "deg")).casefold()
    return re.sub(r"[ .\u0300-\u036f]", "", letters).replace("deg", "°")


def read_records(file: Path, site: Site, /) -> Records:
    """Read a bulk file; times are local standard time, at the site's offset from UTC.

    A record is for the hour that starts at its time, as in the paper. But rain is for the hour
    before: the service's current observations call it ``pcpn_amt_pst1hr``, and by the column
    ``Weather`` it rains at a wet row's time and an hour before about equally often, and less often
    an hour after. So rain is recorded an hour late; ``rain_late`` of the records states this, and
    forecasts are compared accordingly. Flags ``M`` (missing) and ``NA`` make a value missing even
    if one is given. Other flags, such as ``E`` (estimated by the service), do not. A row that ends
    before the first observation, as the service writes for hours without any, is all missing.

    Args:
        file: as downloaded, in English or French, with or without a byte order mark.
        site: gives the offset of local standard time, which is not in the file.

    Raises:
        ConfigurationError: the file is not hourly or lacks a column, a line is broken or out of
            order, too few values are plausible, or the site's offset is missing or does not fit the
            station.
    """
    if site.utc_offset is None:
        raise ConfigurationError(
            "is in local standard time; the site file must give its offset from UTC, as in "
            "'utc_offset: -5.0'",
            file=file, line=1,
        )
    table = read_table(file, lambda name: _quantity(name) is not None)
    names: dict[str, str] = {}
    for name in table.header:
        names.setdefault(_plain(name), name)
    time = next(names[name] for name in _TIME if name in names)
    columns = {
        quantity: name for name in table.header if (quantity := _quantity(name)) is not None
    }
    _check_kind(table, names.keys(), columns.keys())
    table.require((time, *columns.values()), "hourly bulk files")
    if _LONGITUDE in names:
        _check_zone(table, names[_LONGITUDE], site.utc_offset)
    zone = timezone(timedelta(hours=site.utc_offset))
    first, hours = table.hours(time, lambda text: parse_local_time(text, zone), "2021-07-01 0:00")
    values = {}
    for quantity, column in columns.items():
        flags = "".join(table.header[table.header.index(column) + 1 :][:1])
        if _plain(flags).endswith(_FLAG):
            table.columns[column] = [
                "" if flag in _MISSING_FLAGS else text
                for text, flag in zip(table.columns[column], table.columns[flags], strict=True)
            ]
        values[quantity] = table.usable(
            column, QUANTITIES[quantity], nearly=NEARLY.get(quantity, 0.0),
            optional=quantity != PRECIPITATION,
        )
    return Records(
        (file,), first, by_hour(values, hours), rain_late=1, left_out=tuple(table.notes),
        places=_place(table, names), wind_height=_WIND_HEIGHT_M,
    )


def _place(table: Table, names: Mapping[str, str]) -> dict[Path, tuple[float, float]]:
    """Return the station's place, by file; empty if a column is missing.

    Args:
        table: the file.
        names: its columns, by their plain names.
    """
    if _LATITUDE not in names or _LONGITUDE not in names:
        return {}
    latitude, longitude = (
        table.number(names[column], 0, ("degrees", -end, end), missing=("",))
        for column, end in ((_LATITUDE, 90.0), (_LONGITUDE, 180.0))
    )
    return {table.file: (latitude, longitude)}


def _quantity(name: str) -> str | None:
    plain = _plain(name)
    return next((quantity for quantity, names in _COLUMNS.items() if plain in names), None)


def _check_kind(table: Table, names: Iterable[str], quantities: Container[str]) -> None:
    """Refuse a file that does not have each hour's rain, and state what it is."""
    if any(_LONGER in name for name in names):
        what = "holds days or months, not hours"
    elif PRECIPITATION not in quantities:
        what = "holds hours without precipitation, which files from before 2021 do not have"
    else:
        return
    raise table.refuse(f"is a file of Environment Canada that {what}: {_DOWNLOAD}")


def _check_zone(table: Table, column: str, utc_offset: float) -> None:
    """Refuse a station whose solar time is not near the site's standard time."""
    longitude = table.number(column, 0, ("degrees", -180.0, 180.0))
    if abs(longitude / 15 - utc_offset) > _MOST_FROM_SOLAR_TIME:
        raise table.refuse(
            f"is not near the standard time of the site, utc_offset = {utc_offset:g} h, which "
            f"belongs to a longitude of about {15 * utc_offset:g}",
            column, 0,
        )
