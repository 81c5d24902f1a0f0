"""The inputs of a run, from Python's objects: sites, weather in data frames, numbers, times."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from datetime import date
from numbers import Real
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import yaml

from greenroof_ros.common.errors import ConfigurationError, suggest_names
from greenroof_ros.common.files import default_site_file
from greenroof_ros.common.times import DEFAULT_START
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.experiment.run import Run, build_run, count_ticks
from greenroof_ros.forecast.choice import ForecastChoice, choose
from greenroof_ros.model import site as site_file
from greenroof_ros.model.initial_state import (
    INITIAL_STATES,
    check_volumes,
    default_state,
    initial_state,
)
from greenroof_ros.model.site import Site
from greenroof_ros.weather.reading import default_weather, find_files, read_weather
from greenroof_ros.weather.series import GAPS, REFUSE

PathText: TypeAlias = "str | os.PathLike[str]"

# The names of a run's inputs besides its controller.
_INPUTS = (
    "site", "weather", "start", "hours", "forecast", "initial", "evapotranspiration", "gaps",
)


@functools.cache
def _directory() -> TemporaryDirectory[str]:
    """The files of sites and data frames, until the process ends."""
    return TemporaryDirectory(prefix="greenroof-")


def _kept(text: str, name: str) -> Path:
    """Write a text to a file, the same for equal texts."""
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    file = Path(_directory().name) / digest / name
    file.parent.mkdir(exist_ok=True)
    file.write_text(text, encoding="utf-8")
    return file


def read_site(path: PathText | None = None, **changes: float | str) -> Site:
    """Read a site file; without one the paper's site.

    Volumes that follow from changed values follow them, such as the target volume ``x2_star`` from
    the target level ``z_veg``.

    Args:
        path: of the file.
        changes: parameters with other values than in the file.

    Raises:
        ConfigurationError: the file, or a value, is wrong.

    Example:
        >>> import greenroof_ros as gr
        >>> site = gr.read_site(z_veg=0.04)
        >>> round(site.x2_star, 3), site.a2
        (2.752, 68.8)
    """
    file = file_of_site(path)
    if changes:
        file = _kept(site_file.edited(file, changes), file.name)
    return site_file.read_site(file)


def _refuse(expected: str, key: str, value: object) -> ConfigurationError:
    """Return the error of an input that is none of what it may be."""
    return ConfigurationError(f"must be {expected}", key=key, value=value)


def file_of_site(site: PathText | Site | None) -> Path:
    """Return a file that has a site; the paper's if it is None.

    Raises:
        ConfigurationError: it is neither a site nor a path.
    """
    if not (site is None or isinstance(site, (str, os.PathLike, Site))):
        raise _refuse("a site file, or what gr.read_site returns", "site", site)
    if isinstance(site, Site):
        values = {entry.name: getattr(site, entry.name) for entry in fields(site)}
        text = yaml.safe_dump({
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items() if value not in (None, ())
        }, sort_keys=False)
        return _kept(text, "site.yaml")
    return default_site_file() if site is None else Path(site)


def _weather_files(weather: Any) -> list[Path]:
    if weather is None:
        return [default_weather()]
    if (hasattr(weather, "write_csv") or hasattr(weather, "to_csv")) and hasattr(
        weather, "columns"
    ):
        return [_kept(_csv(weather), "weather.csv")]
    names = [weather] if isinstance(weather, (str, os.PathLike)) else (
        list(weather) if isinstance(weather, Iterable) and not isinstance(weather, Mapping)
        else [None]
    )
    if not all(isinstance(name, (str, os.PathLike)) for name in names):
        kind = type(weather)
        raise _refuse(
            "a file, a pattern or several of them, or a data frame of polars or pandas, not of "
            f"type {kind.__module__}.{kind.__qualname__}", "weather", None,
        )
    return find_files(map(os.fspath, names), "weather")


def _csv(frame: Any) -> str:
    text: str
    if hasattr(frame, "write_csv"):
        import polars

        known = frame.with_columns(polars.selectors.float().fill_nan(None))
        text = known.write_csv(datetime_format="%Y-%m-%dT%H:%M:%S%.f%:z" if any(
            getattr(kind, "time_zone", None) for kind in frame.dtypes
        ) else None)
        return text
    if "time" not in frame.columns:
        frame = frame.rename_axis("time").reset_index()
    text = frame.to_csv(index=False)
    return text


def _forecast(forecast: PathText | ForecastChoice) -> ForecastChoice:
    if isinstance(forecast, ForecastChoice):
        return forecast
    if not isinstance(forecast, (str, os.PathLike)):
        raise _refuse("a name, a path or a ForecastChoice", "forecast", forecast)
    return choose(os.fspath(forecast), "forecast")


def _initial(
    site: Site, initial: str | Sequence[float] | None
) -> tuple[str, tuple[float, float]]:
    """Return the name of an initial state, and its volumes (m3)."""
    if initial is None:
        return default_state(site)
    expected = f"one of {', '.join(INITIAL_STATES)}, or the volumes in cistern and roof (m3)"
    if isinstance(initial, str):
        if initial not in INITIAL_STATES:
            raise _refuse(expected, "initial", initial)
        return initial, initial_state(site, initial)
    try:
        cistern, roof = map(float, initial)
    except (TypeError, ValueError) as error:
        raise _refuse(expected, "initial", initial) from error
    if not (cistern >= 0 and roof >= 0):  # NaN is neither
        raise _refuse(f"{expected}, not negative", "initial", initial)
    return "custom", (cistern, roof)


def check_parameters(
    choice: ControllerChoice, site: Site, given: Mapping[str, float]
) -> dict[str, float]:
    """Return the value of each parameter of a controller, given or by default.

    Raises:
        ConfigurationError: it has no such parameter, or a value is outside its range.
    """
    known, values = choice.parameters, choice.defaults(site)
    for name, value in given.items():
        if name not in known:
            raise ConfigurationError(
                f"is neither an input nor a parameter of {choice.name}; "
                f"{suggest_names(name, [*_INPUTS, *known])}", key=name, value=value,
            )
        try:
            values[name] = known[name].range.check(value)
        except ValueError as error:
            raise ConfigurationError(str(error), key=name, value=value) from None
    return values


def make_run(
    choice: ControllerChoice,
    own: Mapping[str, float] | None = None,
    *,
    site: PathText | Site | None = None,
    weather: Any = None,
    start: str | date | None = None,
    hours: float | None = None,
    forecast: PathText | ForecastChoice = "perfect",
    initial: str | Sequence[float] | None = None,
    evapotranspiration: str | None = None,
    gaps: str = REFUSE,
    **parameters: Any,
) -> Run:
    """Build and check a run from the inputs of :func:`.simulate`.

    Args:
        choice: its controller.
        own: all parameters of an instance; None for those given, and defaults.
        site: see there, as for the others.
        weather: weather.
        start: time of tick 0.
        hours: length.
        forecast: which forecasts.
        initial: initial state.
        evapotranspiration: its method.
        gaps: what to do about them.
        parameters: of the controller.

    Raises:
        ConfigurationError: an input is wrong.
    """
    file = file_of_site(site)
    site = site_file.read_site(file)
    values = check_parameters(choice, site, parameters) if own is None else dict(own)
    name, volumes = _initial(site, initial)
    check_volumes(site, *volumes, keys=("initial, cistern", "initial, roof"))
    begin = start.isoformat() if isinstance(start, date) else start
    if not (begin is None or isinstance(begin, str)):
        raise _refuse("a time such as 2021-07-07T02:00-05:00, or a datetime", "start", start)
    if not (hours is None or isinstance(hours, Real)):
        raise _refuse("a number of hours", "hours", hours)
    if gaps not in GAPS:
        raise _refuse(" or ".join(GAPS), "gaps", gaps)
    return build_run(
        file, site, read_weather(_weather_files(weather), site, evapotranspiration, gaps),
        begin or DEFAULT_START, count_ticks(site, hours, "hours"), choice, values, name, volumes,
        _forecast(forecast),
    )
