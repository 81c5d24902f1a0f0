"""The inputs of a run, from Python's objects: sites, weather in data frames, numbers, times."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import yaml

from greenroof_ros.common.errors import ConfigurationError, did_you_mean
from greenroof_ros.common.files import shared_directory
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
from greenroof_ros.weather.series import REFUSE

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


def file_of_site(site: PathText | Site | None) -> Path:
    """Return a file that has a site; the paper's if it is None."""
    if isinstance(site, Site):
        values = {entry.name: getattr(site, entry.name) for entry in fields(site)}
        text = yaml.safe_dump({
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items() if value not in (None, ())
        }, sort_keys=False)
        return _kept(text, "site.yaml")
    return shared_directory() / "config" / "site.yaml" if site is None else Path(site)


def _weather_files(weather: Any) -> list[Path]:
    """Return the files of weather: of paths and patterns, or one with a data frame."""
    if weather is None:
        return [default_weather()]
    if hasattr(weather, "columns"):
        return [_kept(_csv(weather), "weather.csv")]
    names = [weather] if isinstance(weather, (str, os.PathLike)) else weather
    return find_files(map(os.fspath, names), "weather")


def _csv(frame: Any) -> str:
    """Return a data frame of polars or pandas as CSV, exactly; an index of times is ``time``."""
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
    try:
        return choose(os.fspath(forecast))
    except ValueError as error:
        raise ConfigurationError(str(error), key="forecast", value=str(forecast)) from error


def _initial(
    site: Site, initial: str | Sequence[float] | None
) -> tuple[str, tuple[float, float]]:
    """Return the name of an initial state, and its volumes (m3)."""
    if initial is None:
        return default_state(site)
    if isinstance(initial, str):
        if initial not in INITIAL_STATES:
            raise ConfigurationError(
                f"must be one of {', '.join(INITIAL_STATES)}, or the volumes in cistern and roof "
                "(m3)", key="initial", value=initial,
            )
        return initial, initial_state(site, initial)
    cistern, roof = map(float, initial)
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
                f"{did_you_mean(name, [*_INPUTS, *known])}", key=name, value=value,
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
    start: str | datetime | None = None,
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
    begin = start.isoformat() if isinstance(start, datetime) else start
    return build_run(
        file, site, read_weather(_weather_files(weather), site, evapotranspiration, gaps),
        begin or DEFAULT_START, count_ticks(site, hours, "hours"), choice, values, name, volumes,
        _forecast(forecast),
    )
