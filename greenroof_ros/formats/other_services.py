"""Files of services that are not read: what they are, and which of their columns to rename.

A service more is a row of :data:`SERVICES`, with a test.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_lines

_TIME, _RAIN, _TEMPERATURE = "time", "rain [mm]", "temperature [degC]"
_DEW_POINT, _WIND, _PRESSURE = "dew point [degC]", "wind speed [km/h]", "station pressure [kPa]"
_HUMIDITY, _RADIATION = "relative humidity [%]", "solar radiation [W/m2]"
_ENDED = "and add the comment '# stamped: end'"


class OtherService(NamedTuple):
    """A kind of file of a service."""

    name: str
    pattern: str
    """regular expression of what only its files have in their first lines"""
    columns: Mapping[str, str]
    """the column of this project's CSV for each of its columns, with what must be computed"""
    further: str = ""
    """what else to do"""


SERVICES = (
    OtherService(
        "KNMI, hourly values", r"STN,\s*YYYYMMDD,\s*HH?\b",
        {
            "YYYYMMDD and HH": f"{_TIME} (UTC)", "RH / 10 (-1 is a trace: 0)": _RAIN,
            "T / 10": _TEMPERATURE, "TD / 10": _DEW_POINT, "FH * 0.36": _WIND,
            "Q / 0.36": _RADIATION, "U": _HUMIDITY,
        },
        f"hour HH ends at its time: {_ENDED}",
    ),
    OtherService(
        "KNMI, daily values", r"STN,\s*YYYYMMDD,|KONINKLIJK NEDERLANDS METEOROLOGISCH", {},
        "hourly values are needed (knmi.nl, uurgegevens)",
    ),
    OtherService(
        "MeteoSwiss, hourly values",
        r"(station_abbr|stn|Station/Location|ABBR)\W.*(rre150h0|tre200h0)",
        {
            "reference_timestamp, time or date": f"{_TIME} (UTC)", "rre150h0": _RAIN,
            "tre200h0": _TEMPERATURE, "tde200h0": _DEW_POINT, "fkl010h0 * 3.6": _WIND,
            "prestah0 / 10": _PRESSURE, "ure200h0": _HUMIDITY, "gre000h0": _RADIATION,
        },
        f"each hour ends at its time: {_ENDED}",
    ),
    OtherService(
        "MeteoSwiss, of other than hours",
        r"(station_abbr|stn|Station/Location|ABBR)\W.*\b(rre150|tre200|rka150|gre000)\w\d", {},
        "hourly values are needed (names end in h0)",
    ),
    OtherService(
        "NASA POWER, hourly values", r"YEAR,MO,DY,HR\b",
        {
            "YEAR, MO, DY and HR": f"{_TIME} (UTC, or local solar time, as chosen)",
            "PRECTOTCORR": "rain [mm/h]", "T2M": _TEMPERATURE, "T2MDEW": _DEW_POINT,
            "WS10M * 3.6": _WIND, "PS": _PRESSURE, "RH2M": _HUMIDITY,
            "ALLSKY_SFC_SW_DWN": _RADIATION,
        },
        "each row begins at its time; -999 may stay",
    ),
    OtherService(
        "NASA POWER, of other than hours", r"NASA/POWER|YEAR,(MO,DY|DOY|PARAMETER)\b", {},
        "hourly values are needed (temporal/hourly)",
    ),
    OtherService(
        "NOAA, Local Climatological Data",
        r"HourlyPrecipitation|HourlyDryBulbTemperature|HOURLYPrecip",
        {
            "DATE": f"{_TIME} (local standard time)",
            "HourlyPrecipitation": f"{_RAIN} (inches * 25.4; T may stay)",
            "HourlyDryBulbTemperature": f"{_TEMPERATURE} ((degF - 32) / 1.8)",
            "HourlyDewPointTemperature": f"{_DEW_POINT} ((degF - 32) / 1.8)",
            "HourlyWindSpeed": f"{_WIND} (mph * 1.609)",
            "HourlyStationPressure": f"{_PRESSURE} (inHg * 3.386)",
        },
        "keep only the rows of REPORT_TYPE FM-15, one an hour, some minutes before the hour's end: "
        f"{_ENDED}",
    ),
    OtherService(
        "NOAA, Integrated Surface Database (global hourly)",
        r"STATION\W+DATE\W+SOURCE|REPORT_TYPE.*\bCALL_SIGN",
        {
            "DATE": f"{_TIME} (UTC)",
            "AA1": f"{_RAIN} (its second part / 10, of rows whose first part is 01)",
            "TMP / 10": _TEMPERATURE, "DEW / 10": _DEW_POINT,
            "WND": f"{_WIND} (its fourth part * 0.36)",
        },
        f"rain is of the hour before its time: {_ENDED}",
    ),
    OtherService(
        "NOAA, Climate Data Online, hourly precipitation", r"\bHPCP\b",
        {"DATE": f"{_TIME} (local standard time)", "HPCP": f"{_RAIN} (25400 and more is missing)"},
        f"rain is of the hour that ends at its time, and dry hours have no row: add them; {_ENDED}",
    ),
    OtherService(
        "NOAA, daily summaries", r"\bSTATION\W.*\bDATE\W.*\b(PRCP|TMAX)\b", {},
        "hourly values are needed (Local Climatological Data)",
    ),
    OtherService(
        "Deutscher Wetterdienst, of other than hourly rain, temperature, wind or pressure",
        r"STATIONS_ID\s*;\s*MESS_DATUM", {},
        "the files that are read are produkt_rr_stunde, tu, td, ff and p0, of hours",
    ),
)
"""The first whose pattern is found names a file."""

# A service's message instead of a file: one line of words, without a separator.
_MESSAGE = re.compile(r"[^,;\t\r\n]*[A-Za-z]{3,}:? [^,;\t\r\n]*", re.ASCII)
_LINES, _MAX_SHOWN = 100, 80


def explain_file(file: Path) -> None:
    """Refuse a file of a service that is not read, or a message in place of a file.

    Raises:
        ConfigurationError: it is one; the message gives its name, and what to do.
    """
    lines = []
    for line in read_lines(file):
        lines.append(line)
        if len(lines) == _LINES:
            break
    head = "".join(lines)
    for service in SERVICES:
        if re.search(service.pattern, head):
            names = ", ".join(f"{theirs} to '{ours}'" for theirs, ours in service.columns.items())
            raise ConfigurationError(
                f"is a file of {service.name}, which is not read: "
                + (f"rename {names}; leave out the lines before the header; " if names else "")
                + service.further, file=file,
            )
    first = next((line.strip() for line in lines if line.strip()), "")
    if first.startswith(("{", "[")):
        raise ConfigurationError(
            f"is JSON, perhaps a service's message: {first[:_MAX_SHOWN]}", file=file
        )
    # Of a line alone the first clause is enough.
    words = re.split("[,;]", first)[0] if len(lines) == 1 else first
    if _MESSAGE.fullmatch(words) and not first.startswith("#"):
        raise ConfigurationError(
            f"begins with {first[:_MAX_SHOWN]!r}, which is no header: is it a service's message?",
            file=file,
        )
