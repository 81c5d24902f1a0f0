"""Answers of Open-Meteo in JSON: past weather, and the hours of a forecast.

Precipitation is the total, and shortwave radiation the mean, over the hour *before* the time stamp;
all other quantities are instantaneous. (Open-Meteo, Historical Weather API and Weather Forecast
API, Hourly Parameter Definition: "Preceding hour sum", "Preceding hour mean", "Instant".) In this
project, values are for the hour that starts at the time stamp. Therefore rain and radiation are
moved back by one hour, and an instantaneous value is used for the following hour.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text
from greenroof_ros.base.ranges import Range
from greenroof_ros.site.site import Place, Site
from greenroof_ros.weather.description import PLACE, REANALYSIS, TIME, Description
from greenroof_ros.weather.frame import read_columns
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
from greenroof_ros.weather.records import HOUR, Records, add_dew_point

VARIABLES = {
    PRECIPITATION: PRECIPITATION, TEMPERATURE: "temperature_2m", DEW_POINT: "dew_point_2m",
    WIND: "wind_speed_10m", PRESSURE: "surface_pressure", RADIATION: "shortwave_radiation",
}
"""The service's variable for each of our quantities; every request names all of them."""
_QUANTITIES = {"relative_humidity_2m": HUMIDITY} | {name: of for of, name in VARIABLES.items()}
# What an answer states of its place and clock, and how far it may be from the site's: the coarsest
# model's cell is half a degree wide; air is 2 degC colder 300 m further up.
_STATED = {
    "latitude": (Range(-90.0, 90.0, "degrees"), 0.5),
    "longitude": (Range(-180.0, 180.0, "degrees"), 0.5),
    "elevation": (Range(-1000.0, 9000.0, "m"), 300.0),
    "utc_offset_seconds": (Range(-43200.0, 50400.0, "s"), np.inf),
}


def make_parameters(site: Site, **more: str | float) -> dict[str, str | float]:
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


def read_records(file: Path, site: Place) -> Records:
    """Read past weather, which is from a weather model.

    Raises:
        ConfigurationError: if the file is not such an answer, contains no precipitation, or is for
            another place than the site's.
    """
    answer = read_answer(file, site, _QUANTITIES.get)
    values = add_dew_point({_QUANTITIES[name]: each for name, each in answer.values.items()})
    if PRECIPITATION not in values:
        raise ConfigurationError("must contain precipitation", file=file, key="hourly")
    shifted = tuple(quantity for quantity in (PRECIPITATION, RADIATION) if quantity in values)
    # One more hour: the hour before the first time has only rain and radiation, the last has
    # neither.
    return replace(
        answer, first=answer.first - HOUR, rain_kind=REANALYSIS, shifted=shifted, values={
            name: np.append(series, np.nan) if name in shifted else np.append(np.nan, series)
            for name, series in values.items()
        },
    )


def read_answer(file: Path, site: Place, quantity_of: Callable[[str], str | None]) -> Records:
    """Read the hours of an answer, by variable, at the time stamps of the answer.

    Args:
        file: JSON file for a single location.
        site: site that must be near this location, if both are known.
        quantity_of: function that returns the quantity of a variable, or None if the variable is
            not needed.

    Raises:
        ConfigurationError: if the file is not such an answer, or is for another place than the
            site's; if a time is not a whole number of hours after the previous one, or a value is
            outside the range of its quantity.
    """
    try:
        content = json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        wrong = f"is not valid JSON, or is nested too deeply: {error}"
        raise ConfigurationError(wrong, file=file) from error
    answer = content if isinstance(content, dict) else {}
    hourly, units = answer.get("hourly"), answer.get("hourly_units")
    if not isinstance(hourly, dict) or not isinstance(units, dict):
        raise ConfigurationError(
            f"is an error message from the service: {answer['reason']}" if "reason" in answer else
            "must be an answer of Open-Meteo for a single location, with hourly values and units",
            file=file,
        )
    times = hourly.get(TIME) or []
    for name, series in {TIME: times, **hourly}.items():
        if not isinstance(series, list) or not series or len(series) != len(times):
            raise ConfigurationError(
                "must be a list with one value for each time", file=file, key=f"hourly.{name}"
            )
    stated = dict[str, float]()
    for name, (limits, far) in _STATED.items():
        if answer.get(name) is not None:
            stated[name] = limits.read(answer[name], key=name, file=file)
            own = getattr(site, name, None)
            if own is not None and abs(stated[name] - own) > far:
                raise ConfigurationError(
                    f"must be within {far:g} {limits.unit} of the site's {name}, {own:g}",
                    file=file, key=name, value=stated[name],
                )
    wanted = {name: quantity for name in hourly if (quantity := quantity_of(name)) is not None}
    # Members of an ensemble are of one quantity, so each is a table of its own.
    one_table = len({*wanted.values()}) == len(wanted)
    values = {}
    for names in [[*wanted]] if one_table else [[name] for name in wanted]:
        columns = {TIME: [*map(str, times)], **{name: hourly[name] for name in names}}
        rows = read_columns(file, columns, Description(
            columns={TIME: (TIME,), **{wanted[name]: (name,) for name in names}},
            units={wanted[name]: _find_unit(units.get(name), wanted[name]) for name in names},
            utc_offset=stated.get("utc_offset_seconds", 0.0) / 3600, step=3600.0,
        ), site)
        for name in names:
            values[name] = np.full(rows.steps[-1] + 1, np.nan)
            values[name][rows.steps] = rows.values[wanted[name]]
    place = {file: (stated["latitude"], stated["longitude"])} if {*PLACE} <= {*stated} else {}
    return Records((file,), rows.first, values, places=place, wind_height=10.0)


def _find_unit(name: object, quantity: str) -> str:
    """Return the usual name of a unit; without any value, the service does not define it."""
    return {"mp/h": "mph", "undefined": QUANTITIES[quantity].unit}.get(str(name), str(name))
