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
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import parse_time, parse_unix_time
from greenroof_ros.site.site import Place, Site
from greenroof_ros.weather.description import PLACE, REANALYSIS
from greenroof_ros.weather.quantities import (
    DEW_POINT,
    HUMIDITY,
    PRECIPITATION,
    PRESSURE,
    QUANTITIES,
    RADIATION,
    TEMPERATURE,
    WIND,
    find_unit,
)
from greenroof_ros.weather.records import HOUR, Records, add_dew_point

VARIABLES = {
    PRECIPITATION: PRECIPITATION, TEMPERATURE: "temperature_2m", DEW_POINT: "dew_point_2m",
    WIND: "wind_speed_10m", PRESSURE: "surface_pressure", RADIATION: "shortwave_radiation",
}
"""The service's variable for each of our quantities; every request names all of them."""
_QUANTITIES = {variable: quantity for quantity, variable in VARIABLES.items()} | {
    "relative_humidity_2m": HUMIDITY,
}
_UNITS = {"mp/h": "mph"}
_WIND_HEIGHT_M = 10.0
# Largest distance of the answer's place from the site: the coarsest model's cell is half a degree
# wide; air is 2 degC colder 300 m further up.
_FAR = {"latitude": (0.5, "degrees"), "longitude": (0.5, "degrees"), "elevation": (300.0, "m")}
_RANGES = dict(zip(PLACE, (Range(-90.0, 90.0), Range(-180.0, 180.0)), strict=True))


def make_parameters(site: Site, **more: str | float) -> dict[str, str | float]:
    """Return the parameters of a request for hours in UTC, in the service's default units.

    Args:
        site: site, including its location.
        more: parameters for the period or the model.

    Raises:
        ConfigurationError: if the site file lacks the location.
    """
    for name in ("latitude", "longitude"):
        if getattr(site, name) is None:
            raise ConfigurationError(
                "must be in the site file, because Open-Meteo's data are for a location", key=name
            )
    return {
        "latitude": float(site.latitude or 0), "longitude": float(site.longitude or 0),
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
    nothing = np.array([np.nan])
    return replace(
        answer, first=answer.first - HOUR, rain_kind=REANALYSIS, shifted=shifted, values={
            name: np.concatenate((series, nothing) if name in shifted else (nothing, series))
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
        ConfigurationError: if the file is not such an answer, if a time is not a whole number of
            hours after the previous one, or if a value is outside the range of its quantity.
    """
    refuse = partial(ConfigurationError, file=file)
    try:
        content = json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise refuse(f"is not valid JSON, or is nested too deeply: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("hourly"), dict):
        reason = content.get("reason") if isinstance(content, dict) else None
        raise refuse(
            f"is an error message from the service: {reason}" if isinstance(reason, str) else
            "must be an answer of Open-Meteo for a single location, with hourly values"
        )
    hourly, units = content["hourly"], content.get("hourly_units") or {}
    times = hourly.get("time")
    count = len(times) if isinstance(times, list) else 0
    for name, series in hourly.items():
        if not isinstance(series, list) or len(series) != count or not count:
            raise refuse("must be a list with one value for each time", key=f"hourly.{name}")
    place = _read_place(content, site, refuse)
    first, hours = _read_times(content, refuse)
    values = dict[str, NDArray[np.float64]]()
    for name, series in hourly.items():
        quantity = None if name == "time" else quantity_of(name)
        if quantity is not None:
            values[name] = np.full(hours[-1] + 1, np.nan)
            values[name][hours] = _convert(name, quantity, series, units.get(name), refuse)
    return Records(
        (file,), first, values, wind_height=_WIND_HEIGHT_M,
        places={file: place} if place else {},
    )


def _read_place(
    content: dict[str, Any], site: Place, refuse: Callable[..., ConfigurationError]
) -> tuple[float, float] | None:
    if not all(name in content for name in PLACE):
        return None
    latitude, longitude = (
        limits.read(content[name], key=name) for name, limits in _RANGES.items()
    )
    for name, (far, unit) in _FAR.items():
        own: float | None = getattr(site, name)
        value = content.get(name)
        if own is None or not isinstance(value, (int, float)):
            continue
        away = abs((value - own + 180) % 360 - 180) if unit == "degrees" else abs(value - own)
        if away > far:
            raise refuse(
                f"must be within {far:g} {unit} of the site's {name}, {own:g}", key=name,
                value=value,
            )
    return latitude, longitude


def _read_times(
    content: dict[str, Any], refuse: Callable[..., ConfigurationError]
) -> tuple[datetime, NDArray[np.int64]]:
    """Return the first time, and the hours of all times since then."""
    zone = timezone(timedelta(seconds=content.get("utc_offset_seconds") or 0))
    times = list[datetime]()
    for text in content["hourly"]["time"]:
        try:
            time = parse_unix_time(str(text)).astimezone(zone) if isinstance(text, int) else (
                parse_time(str(text), zone)
            )
        except ValueError:
            raise refuse("must be a time", key="hourly.time", value=text) from None
        if times and (time <= times[-1] or (time - times[0]) % HOUR):
            raise refuse(
                "must be a whole number of hours after the previous time", key="hourly.time",
                value=text,
            )
        times.append(time)
    return times[0], np.array([(time - times[0]) // HOUR for time in times])


def _convert(
    name: str, quantity: str, series: list[Any], unit_name: Any,
    refuse: Callable[..., ConfigurationError],
) -> NDArray[np.float64]:
    """Return a variable's values in this project's unit."""
    known = [value for value in series if value is not None]
    if not known:
        return np.full(len(series), np.nan)
    try:
        unit = find_unit(quantity, _UNITS.get(str(unit_name), str(unit_name)), 1.0, np.nan)
    except ValueError:
        raise refuse(
            f"is not a unit of {quantity}", key=f"hourly_units.{name}", value=unit_name
        ) from None
    low, high = (
        end * unit.per_ours + unit.zero
        for end in (QUANTITIES[quantity].low, QUANTITIES[quantity].high)
    )
    limits = Range(low, high, unit.name)
    for value in known:
        if value not in limits:
            raise refuse(limits.expected(), key=f"hourly.{name}", value=value)
    numbers = np.array([np.nan if value is None else value for value in series], dtype=float)
    return np.asarray((numbers - unit.zero) / unit.per_ours)
