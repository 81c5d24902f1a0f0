"""Answers of Open-Meteo in JSON: past weather, and the hours of a forecast.

Precipitation is the total, and shortwave radiation the mean, over the hour *before* the time stamp;
all other quantities are instantaneous. (Open-Meteo, Historical Weather API and Weather Forecast
API, Hourly Parameter Definition: "Preceding hour sum", "Preceding hour mean", "Instant".) In this
project, values are for the hour that starts at the time stamp. Therefore rain and radiation are
moved back by one hour, and an instantaneous value is used for the following hour.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text
from greenroof_ros.base.ranges import Range
from greenroof_ros.site.site import Place
from greenroof_ros.weather.description import END, REANALYSIS, TIME, Description
from greenroof_ros.weather.quantities import (
    DEW_POINT,
    HUMIDITY,
    PRECIPITATION,
    PRESSURE,
    QUANTITIES,
    RADIATION,
    TEMPERATURE,
    WIND,
)
from greenroof_ros.weather.records import HOUR
from greenroof_ros.weather.table import Row, Rows, Table, arrange

VARIABLES = {
    PRECIPITATION: PRECIPITATION, TEMPERATURE: "temperature_2m", DEW_POINT: "dew_point_2m",
    WIND: "wind_speed_10m", PRESSURE: "surface_pressure", RADIATION: "shortwave_radiation",
}
"""The service's variable for each of our quantities; every request names all of them."""
_QUANTITIES = {"relative_humidity_2m": HUMIDITY} | {name: of for of, name in VARIABLES.items()}
# Quantities whose values are for the hour before their time.
_BEFORE = PRECIPITATION, RADIATION
# What an answer states of its place and clock, and how far it may be from the site's: the coarsest
# model's cell is half a degree wide; air is 2 degC colder 300 m further up.
_STATED = {
    "latitude": (Range(-90.0, 90.0, "degrees"), 0.5),
    "longitude": (Range(-180.0, 180.0, "degrees"), 0.5),
    "elevation": (Range(-1000.0, 9000.0, "m"), 300.0),
    "utc_offset_seconds": (Range(-43200.0, 50400.0, "s"), np.inf),
}


def make_parameters(site: Place, **more: str | float) -> dict[str, str | float]:
    """Return the parameters of a request for hours in UTC, in the service's default units.

    Args:
        site: site, including its location.
        more: parameters for the period or the model.

    Raises:
        ConfigurationError: if the site file lacks the location.
    """
    if site.latitude is None or site.longitude is None:
        raise ConfigurationError("must be in the site file", key="latitude and longitude")
    return {
        "latitude": site.latitude, "longitude": site.longitude,
        "hourly": ",".join(VARIABLES.values()), "timezone": "GMT", **more,
    }


def read_weather_rows(file: Path, site: Place, answer: bytes | None = None) -> list[Rows]:
    """Read past weather, which is from a weather model; see :func:`read_answer`.

    Returns:
        The rows whose times are starts, and those of rain and radiation, whose times are ends.

    Raises:
        ConfigurationError: if the file is not such an answer, contains no precipitation, or is for
            another place than the site's; or if a time is not a whole number of hours after the
            previous one, or a value is outside the range of its quantity.
    """
    table, described = read_answer(file, site, answer)
    used = {_QUANTITIES[name]: name for name in table.header if name in _QUANTITIES}
    if PRECIPITATION not in used:
        raise ConfigurationError("must contain precipitation", file=file, key="hourly")
    described = replace(
        described, units={quantity: described.units[name] for quantity, name in used.items()},
        columns={TIME: (TIME,), **{quantity: (name,) for quantity, name in used.items()}},
    )
    rows = arrange(table, described, site, used)
    at_ends, at_starts = (
        {name: series for name, series in rows.values.items() if (name in _BEFORE) == before}
        for before in (True, False)
    )
    parts = [replace(rows, values=at_starts), replace(
        rows, first=rows.first - HOUR, values=at_ends, described=replace(described, rows=END),
    )]
    return [part for part in parts if part.values]


def read_answer(file: Path, site: Place, answer: bytes | None = None) -> tuple[Table, Description]:
    """Return the hours of an answer as a table, and its description, with the unit of each column.

    Args:
        file: JSON file for a single location.
        site: site that must be near this location, if both are known.
        answer: content of the file, if it is not on the disk.

    Raises:
        ConfigurationError: if the file is not such an answer, or is for another place than the
            site's.
    """
    try:
        content = json.loads(read_text(file) if answer is None else answer)
    except (ValueError, RecursionError) as error:
        wrong = f"is not valid JSON, or is nested too deeply: {error}"
        raise ConfigurationError(wrong, file=file) from error
    content = content if isinstance(content, dict) else {}
    hourly, units = content.get("hourly"), content.get("hourly_units")
    if not isinstance(hourly, dict) or not isinstance(units, dict):
        raise ConfigurationError(
            f"is an error message from the service: {content['reason']}" if "reason" in content else
            "must be an answer of Open-Meteo for a single location, with hourly values and units",
            file=file,
        )
    columns = {TIME: [], **hourly}
    for name, series in columns.items():
        if not isinstance(series, list) or not series or len(series) != len(columns[TIME]):
            raise ConfigurationError(
                "must be a list with one value for each time", file=file, key=f"hourly.{name}"
            )
    stated = dict[str, float]()
    for name, (limits, far) in _STATED.items():
        if content.get(name) is not None:
            stated[name] = limits.read(content[name], key=name, file=file)
            own = getattr(site, name, None)
            if own is not None and abs(stated[name] - own) > far:
                raise ConfigurationError(
                    f"must be within {far:g} {limits.unit} of the site's {name}, {own:g}",
                    file=file, key=name, value=stated[name],
                )
    rows = [*map(Row, itertools.count(), zip(*columns.values(), strict=True))]
    return Table(file, [*columns], None, rows), Description(
        name="Open-Meteo", wind_height=10.0, rain_kind=REANALYSIS, step=3600.0,
        units={name: _find_unit(name, units.get(name)) for name in columns},
        utc_offset=stated.get("utc_offset_seconds", 0.0) / 3600,
        latitude=stated.get("latitude"), longitude=stated.get("longitude"),
    )


def _find_unit(variable: str, unit: object) -> str:
    """Return the unit of a variable; without any value, the service does not define it."""
    quantity = _QUANTITIES.get(variable, PRECIPITATION)
    return QUANTITIES[quantity].unit if unit == "undefined" else str(unit)
