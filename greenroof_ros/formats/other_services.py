"""Unsupported files of other services, and advice on how to convert them.

To add a service, add a row to :data:`SERVICES`, and a test.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_lines

_TIME, _RAIN, _TEMPERATURE = "time", "rain [mm]", "temperature [degC]"
_DEW_POINT, _WIND, _PRESSURE = "dew point [degC]", "wind speed [km/h]", "station pressure [kPa]"
_HUMIDITY, _RADIATION = "relative humidity [%]", "solar radiation [W/m2]"
_ENDED = "add the comment '# stamped: end', because the time stamps are at the end of each hour"


class OtherService(NamedTuple):
    """A kind of file from an unsupported service."""

    name: str
    pattern: str
    """case-insensitive regular expression for text that only the first lines of these files contain
    """
    columns: Mapping[str, str]
    """source of each column of this project's CSV format in the columns of the file"""
    further: str = ""
    """additional advice on the conversion"""


# Sources: the heads of the services' own files, for KNMI, NASA POWER and MeteoSwiss's legends;
# MeteoSwiss: opendata-download, "for granularity t and h the time stamp defines the end of the
# measurement interval"; NASA POWER: Hourly API, "precipitation values will be shown in mm/hour",
# and that rows begin at their hour [assumed]; Météo-France: H_descriptif_champs.csv; NOAA: Local
# Climatological Data (LCD) Dataset Documentation, Federal Climate Complex Data Documentation for
# Integrated Surface Data. NOAA, LCD version 2 and GHCNh: units according to their users [assumed].
SERVICES = (
    OtherService(
        "KNMI, hourly values", r"STN,\s*YYYYMMDD,\s*HH?\b",
        {
            _TIME: "YYYYMMDD and HH (UTC)", _RAIN: "RH / 10 (-1 is a trace: 0)",
            _TEMPERATURE: "T / 10", _DEW_POINT: "TD / 10", _WIND: "FH * 0.36",
            _RADIATION: "Q / 0.36", _HUMIDITY: "U",
        },
        _ENDED,
    ),
    OtherService(
        "KNMI, daily values", r"STN,\s*YYYYMMDD,|KONINKLIJK NEDERLANDS METEOROLOGISCH", {},
        "hourly values are needed (knmi.nl, uurgegevens)",
    ),
    OtherService(
        "MeteoSwiss, hourly values", r"\b(rre150|tre200|tde200|fkl010|presta|ure200|gre000)h0\b",
        {
            _TIME: "reference_timestamp, time or date (UTC)", _RAIN: "rre150h0",
            _TEMPERATURE: "tre200h0", _DEW_POINT: "tde200h0", _WIND: "fkl010h0 * 3.6",
            _PRESSURE: "prestah0 / 10", _HUMIDITY: "ure200h0", _RADIATION: "gre000h0",
        },
        _ENDED,
    ),
    OtherService(
        "MeteoSwiss, values other than hourly", r"\b(rre150|tre200|rka150|gre000)\w\d\b", {},
        "hourly values are needed (names end in h0)",
    ),
    OtherService(
        "NASA POWER, hourly values", r"YEAR,MO,DY,HR\b",
        {
            _TIME: "YEAR, MO, DY and HR (UTC if the file states so; LST is solar time)",
            "rain [mm/h]": "PRECTOTCORR", _TEMPERATURE: "T2M", _DEW_POINT: "T2MDEW",
            _WIND: "WS10M * 3.6", _PRESSURE: "PS", _HUMIDITY: "RH2M",
            _RADIATION: "ALLSKY_SFC_SW_DWN (unchanged if in Wh/m^2; / 0.0036 if in MJ/hr)",
        },
        "you may keep the code -999",
    ),
    OtherService(
        "NASA POWER, values other than hourly", r"NASA/POWER|YEAR,(MO,DY|DOY|PARAMETER)\b", {},
        "hourly values are needed as CSV (temporal/hourly)",
    ),
    OtherService(
        "NOAA, Local Climatological Data", r"HourlyPrecipitation|HourlyDryBulbTemp|HOURLYPrecip",
        {
            _TIME: "DATE (local standard time)",
            _RAIN: "HourlyPrecipitation (you may keep T)", _TEMPERATURE: "HourlyDryBulbTemperature",
            _DEW_POINT: "HourlyDewPointTemperature", _WIND: "HourlyWindSpeed",
            _PRESSURE: "HourlyStationPressure",
        },
        "convert inches (* 25.4), degF ((F - 32) / 1.8), mph (* 1.609) and inHg (* 3.386), or in "
        "version 2, with stations such as USW00094728, m/s (* 3.6) and hPa (/ 10); remove the "
        f"letter s after numbers; keep one row per hour with REPORT_TYPE FM-15; {_ENDED}",
    ),
    OtherService(
        "NOAA, Global Historical Climatology Network hourly", r"Station_name\|",
        {
            _TIME: "DATE, or Year to Minute (UTC)", _RAIN: "precipitation",
            _TEMPERATURE: "temperature", _DEW_POINT: "dew_point_temperature",
            _WIND: "wind_speed * 3.6", _PRESSURE: "station_level_pressure / 10",
            _HUMIDITY: "relative_humidity",
        },
        f"write commas between cells; keep one row per hour with report type FM-15; {_ENDED}",
    ),
    OtherService(
        "NOAA, Integrated Surface Database (global hourly)",
        r"STATION\W+DATE\W+SOURCE|REPORT_TYPE.*\bCALL_SIGN",
        {
            _TIME: "DATE (UTC)",
            _RAIN: "AA1 (second part / 10, in rows with the first part 01)",
            _TEMPERATURE: "TMP / 10", _DEW_POINT: "DEW / 10", _WIND: "WND (fourth part * 0.36)",
        },
        f"keep one row per hour with REPORT_TYPE FM-15; {_ENDED}",
    ),
    OtherService(
        "NOAA, Climate Data Online, hourly precipitation", r"\bHPCP\b",
        {
            _TIME: "DATE (local standard time)",
            _RAIN: "HPCP (* 25.4 if in inches; 999.99 or 25399.75 is missing)",
        },
        f"add rows for dry hours, which are missing from the file; {_ENDED}",
    ),
    OtherService(
        "NOAA, daily summaries", r"\bSTATION\W.*\bDATE\W.*\b(PRCP|TMAX)\b", {},
        "hourly values are needed (Local Climatological Data)",
    ),
    OtherService(
        "Météo-France, hourly values", r"\bAAAAMMJJHH\b|\bPOSTE;DATE;(.*;)?RR1\b",
        {
            _TIME: "AAAAMMJJHH or DATE (UTC)", _RAIN: "RR1", _TEMPERATURE: "T", _DEW_POINT: "TD",
            _WIND: "FF * 3.6", _PRESSURE: "PSTAT / 10", _HUMIDITY: "U", _RADIATION: "GLO / 0.36",
        },
        f"keep only one station (NUM_POSTE); {_ENDED}",
    ),
    OtherService(
        "Météo-France, values other than hourly", r"\bNUM_POSTE\b", {},
        "hourly values are needed (BASE/HOR)",
    ),
    OtherService(
        "Deutscher Wetterdienst, without hourly rain, temperature, wind or pressure",
        r"STATIONS_ID\s*[;,]\s*MESS_DATUM", {},
        "use the hourly files produkt_rr_stunde, tu, td, ff and p0, which can be read",
    ),
)
"""Unsupported kinds of files; the first entry with a matching pattern determines the kind."""

# A service's message instead of a file: one line of words, without a separator.
_MESSAGE = re.compile(r"[^,;\t\r\n]*[A-Za-z]{3,}:? [^,;\t\r\n]*", re.ASCII)
_LINES, _MAX_SHOWN = 100, 80


def explain_file(file: Path) -> None:
    """Reject a file from an unsupported service, or an error message that was saved as a file.

    Raises:
        ConfigurationError: if the file is from such a service or is an error message; the message
            contains advice.
    """
    lines = []
    for line in read_lines(file):
        lines.append(line)
        if len(lines) == _LINES:
            break
    head = "".join(lines)
    for service in SERVICES:
        if re.search(service.pattern, head, re.IGNORECASE):
            names = ", ".join(f"'{ours}' = {theirs}" for ours, theirs in service.columns.items())
            raise ConfigurationError(
                f"is a file from {service.name}, which cannot be read directly: "
                + (f"rename its columns: {names}; write times as in 2024-06-01T12:00Z; leave out "
                   "the lines before the header; " if names else "")
                + service.further, file=file,
            )
    first = next((line.strip() for line in lines if line.strip()), "")
    if first.startswith(("{", "[")):
        raise ConfigurationError(
            f"is JSON, perhaps a message from the service: {first[:_MAX_SHOWN]}", file=file
        )
    # For a single line, the first clause is enough.
    words = re.split("[,;]", first)[0] if len(lines) == 1 else first
    if _MESSAGE.fullmatch(words) and not first.startswith("#"):
        raise ConfigurationError(
            f"begins with {first[:_MAX_SHOWN]!r}, which is not a header: is it a message from a "
            "service?",
            file=file,
        )
