"""Hourly observations of Deutscher Wetterdienst (DWD): unpacked ``produkt_*_stunde_*.txt``.

Every quantity has its own files, which are joined like other weather files::

    STATIONS_ID;MESS_DATUM;QN_8;  R1;RS_IND;WRTR;eor
           1219;1995090100;    1;   0.0;   0;-999;eor

``MESS_DATUM`` is the hour in UTC. Precipitation is the total over an hour that ends ten minutes
before this time, and is moved back by one hour. Other quantities are measured ten minutes before
this time. ("The value for UTC 11 contains the precipitation from UTC 9:51-UTC 10:50", "hour x
corresponds to the reading from 10min earlier": DWD, Climate Data Center,
observations_germany/climate/hourly, descriptions of precipitation and air_temperature.) Missing
values are -999. Units are mm, degC, %, m/s and hPa.
"""

from __future__ import annotations

import re
from datetime import datetime, timezone
from pathlib import Path

from greenroof_ros.base.times import parse_time
from greenroof_ros.formats.cells import HOUR, Column, read_table
from greenroof_ros.formats.hourly import Records, add_dew_point
from greenroof_ros.formats.quantities import (
    DEW_POINT,
    HUMIDITY,
    PRECIPITATION,
    TEMPERATURE,
    Unit,
)
from greenroof_ros.site.site import Place

_TIME, _STATION = "MESS_DATUM", "STATIONS_ID"
# The service's column for each of our quantities, with its unit.
_COLUMNS = {
    "R1": (PRECIPITATION, Unit("mm")),
    "TT_TU": (TEMPERATURE, Unit("degC")),
    "RF_TU": (HUMIDITY, Unit("%")),
    "TD": (DEW_POINT, Unit("degC")),
    "F": ("wind speed", Unit("m/s", 1 / 3.6)),
    "P0": ("station pressure", Unit("hPa", 10.0)),
}
# Height at which the stations measure the wind, as the WMO requires (m).
_WIND_HEIGHT_M = 10.0
_HEADER = re.compile(
    rb"(?:\xef\xbb\xbf)?\s*STATIONS_ID\s*[;,]\s*MESS_DATUM\s*[;,]([^\r\n]*)"
)
_HOUR = re.compile(r"(\d{8})(\d\d)", re.ASCII)


def recognises(head: bytes, /) -> bool:
    """Return True if the first line contains the service's columns and a known quantity."""
    match = _HEADER.match(head)
    return match is not None and not _COLUMNS.keys().isdisjoint(
        name.strip() for name in re.split("[;,]", match[1].decode("utf-8", "replace"))
    )


def read_records(file: Path, _site: Place, /) -> Records:
    """Read a file that contains one or two quantities.

    Raises:
        ConfigurationError: if a line is malformed or out of order, or if too few values are
            plausible.
    """
    table = read_table(file, observed=_COLUMNS.__contains__)
    present = {name: _COLUMNS[name] for name in table.header if name in _COLUMNS}
    table.require_columns((_TIME, *present), "DWD's hourly files")
    columns = {
        quantity: Column(table, name, quantity, unit)
        for name, (quantity, unit) in present.items()
    }
    first, values = table.read_hours(_TIME, columns, _parse_hour, "2024060112", station=_STATION)
    late = PRECIPITATION in values
    return Records(
        (file,), first - HOUR if late else first, add_dew_point(values),
        shifted=(PRECIPITATION,) if late else (), left_out=tuple(table.notes),
        wind_height=_WIND_HEIGHT_M if "wind speed" in values else None,
    )


def _parse_hour(text: str) -> datetime:
    """Return an hour such as ``2024060112``, in UTC.

    Raises:
        ValueError: if the text is not an hour; times of ten-minute values have two more digits.
    """
    match = _HOUR.fullmatch(text)
    if match is None:
        raise ValueError
    return parse_time(f"{match[1]}T{match[2]}", timezone.utc)
