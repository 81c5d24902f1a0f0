"""Downloaded hourly files of Environment and Climate Change Canada (ECCC).

These are bulk files from the service's web page, in English or French, and CSV files from its
collection ``climate-hourly`` (api.weather.gc.ca, GeoMet-OGC-API), which contains the same
observations in the same units under different names.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Container, Iterable, Mapping
from datetime import timedelta, timezone
from pathlib import Path

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import parse_local_time
from greenroof_ros.formats.cells import Column, Row, Table, read_table
from greenroof_ros.formats.hourly import Records
from greenroof_ros.formats.quantities import DEW_POINT, PRECIPITATION, TEMPERATURE
from greenroof_ros.site.site import Place

# Names of columns, in English and French, without accents, case, spaces and points; in English
# files before 2021, the time has no zone. The last names are GeoMet's.
_GEOMET_TIME = "local_date"
_TIME = ("date/time(lst)", "date/time", "date/heure(hnl)", "date/heure", _GEOMET_TIME)
_LATITUDE, _LONGITUDE = ("latitude(y)", "y"), ("longitude(x)", "x")
_STATION = ("climateid", "idclimatologique", "climate_identifier", "station_name")
# Height at which the stations measure the wind, as the WMO requires (m).
_WIND_HEIGHT_M = 10.0
# The service's columns for each of our quantities, in the same units. Flags are in the next column.
_COLUMNS = {
    PRECIPITATION: ("precipamount(mm)", "hauteurdeprecip(mm)", "precip_amount"),
    TEMPERATURE: ("temp(°c)", "temp"),
    DEW_POINT: ("dewpointtemp(°c)", "pointderosee(°c)", "dew_point_temp"),
    "wind speed": ("windspd(km/h)", "vitduvent(km/h)", "wind_speed"),
    "station pressure": ("stnpress(kpa)", "pressionalastation(kpa)", "station_pressure"),
}
_FLAG = ("flag", "indicateur")
# A column in daily and monthly files has this in its name.
_LONGER = "max"
_DOWNLOAD = (
    "download hourly data of the station with precipitation (climate.weather.gc.ca, Hourly data; "
    "climat.meteo.gc.ca, Données horaires)"
)
# The service's legend: M = missing, NA (N/D in French) = not available.
_MISSING_FLAGS = {"M", "NA", "N/D"}
# Largest difference between a place's mean solar time and its standard time (h).
_MAX_FROM_SOLAR_TIME = 2.5


def recognises(head: bytes, /) -> bool:
    """Return True if the first line contains the service's columns for location and time."""
    cells = re.split("[,;\t]", head.decode("utf-8-sig", "replace").partition("\n")[0])
    names = {_simplify(cell.strip('" \r')) for cell in cells}
    return not names.isdisjoint(_TIME) and (
        _LONGITUDE[0] in names or not names.isdisjoint(_COLUMNS[TEMPERATURE])
        or any(_LONGER in name for name in names)
    )


def _simplify(name: str) -> str:
    """Return a column's name in lower case, without accents, spaces and periods."""
    letters = unicodedata.normalize("NFD", name.replace("°", "deg")).casefold()
    return re.sub(r"[ .\u0300-\u036f]", "", letters).replace("deg", "°")


def read_records(file: Path, site: Place, /) -> Records:
    """Read a bulk file with times in local standard time, at the site's UTC offset.

    As in the paper, the values are assumed to apply to the hour that starts at the time stamp.
    However, rain applies to the hour before: in the service's current observations it is named
    ``pcpn_amt_pst1hr``. According to the column ``Weather``, rain is about equally frequent at the
    time of a wet row and an hour earlier, but less frequent an hour later. Therefore rain is
    recorded an hour late; the attribute ``rain_late`` of the records states this delay, and
    forecasts are compared accordingly. A value with the flag ``M`` (missing) or ``NA`` is missing
    even if the file contains a number. Values with other flags, such as ``E`` (estimated by the
    service), are used. A row that ends before the first observation, which the service writes for
    hours without observations, is missing.

    Args:
        file: downloaded file, in English or French, with or without a byte order mark.
        site: site with the UTC offset of local standard time, which the file does not contain.

    Raises:
        ConfigurationError: if the file is not hourly or lacks a column, if a line is malformed or
            out of order, if too few values are plausible, or if the site's UTC offset is missing or
            does not match the station's longitude.
    """
    if site.utc_offset is None:
        raise ConfigurationError(
            "contains local standard time; the site file must state the UTC offset, as in "
            "'utc_offset: -5.0'",
            file=file, line=1,
        )
    table = read_table(file, observed=lambda name: _find_quantity(name) is not None)
    names: dict[str, str] = {}
    for name in table.header:
        names.setdefault(_simplify(name), name)
    time = next(names[name] for name in _TIME if name in names)
    columns = {
        quantity: name for name in table.header if (quantity := _find_quantity(name)) is not None
    }
    _check_kind(table, names.keys(), columns.keys())
    table.require_columns((time, *columns.values()), "hourly bulk files")
    longitude = next((names[name] for name in _LONGITUDE if name in names), None)
    if longitude is not None:
        _check_zone(table, longitude, site.utc_offset)
    zone = timezone(timedelta(hours=site.utc_offset))
    read = {
        quantity: Column(table, column, quantity, cell=_make_reader(table, column))
        for quantity, column in columns.items()
    }
    first, values = table.read_hours(
        time, read, lambda text: parse_local_time(text, zone), "2021-07-01 0:00",
        in_order=_simplify(time) != _GEOMET_TIME,
        station=next((names[name] for name in _STATION if name in names), None),
    )
    return Records(
        (file,), first, values, rain_late=1, left_out=tuple(table.notes),
        places=_read_place(table, names), wind_height=_WIND_HEIGHT_M,
    )


def _make_reader(table: Table, column: str) -> Callable[[Row], str]:
    """Return a function that returns the text of a row, or an empty text if its flag is "missing".

    The flag is in the column with the suffix ``_FLAG``, or otherwise in the next column. A value
    with the flag M is not an observation; often it repeats the last observation before the gap.
    """
    place = table.header.index(column)
    flag = f"{column}_FLAG"
    flag_place = table.header.index(flag) if flag in table.header else place + 1
    flagged = _simplify("".join(table.header[flag_place : flag_place + 1])).endswith(_FLAG)

    def read(row: Row) -> str:
        return "" if flagged and row.cells[flag_place] in _MISSING_FLAGS else row.cells[place]

    return read


def _read_place(table: Table, names: Mapping[str, str]) -> dict[Path, tuple[float, float]]:
    """Return the station's position, keyed by the file; empty if a column is missing.

    Args:
        table: table of the file.
        names: the file's columns, keyed by their simplified names.
    """
    columns = [
        next((names[name] for name in these if name in names), "")
        for these in (_LATITUDE, _LONGITUDE)
    ]
    if not all(columns):
        return {}
    latitude, longitude = (
        table.read_number(table.first, column, Range(-end, end, "degrees"), ("",))
        for column, end in zip(columns, (90.0, 180.0), strict=True)
    )
    return {table.file: (latitude, longitude)}


def _find_quantity(name: str) -> str | None:
    plain = _simplify(name)
    return next((quantity for quantity, names in _COLUMNS.items() if plain in names), None)


def _check_kind(table: Table, names: Iterable[str], quantities: Container[str]) -> None:
    """Reject a file without hourly rain; the error states the kind of file."""
    if any(_LONGER in name for name in names):
        what = "contains daily or monthly values instead of hourly values"
    elif PRECIPITATION not in quantities:
        what = "contains hourly values without precipitation (files from before 2021 have none)"
    else:
        return
    raise table.refuse(f"is a file from Environment Canada that {what}: {_DOWNLOAD}")


def _check_zone(table: Table, column: str, utc_offset: float) -> None:
    """Reject a station whose solar time differs too much from the site's standard time."""
    longitude = table.read_number(table.first, column, Range(-180.0, 180.0, "degrees"))
    if abs(longitude / 15 - utc_offset) > _MAX_FROM_SOLAR_TIME:
        raise table.refuse(
            f"does not match the standard time of the site, utc_offset = {utc_offset:g} h, which "
            f"corresponds to a longitude of about {15 * utc_offset:g}",
            column, table.first,
        )
