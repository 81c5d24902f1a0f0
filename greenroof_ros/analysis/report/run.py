"""A run in a report: its row of results, its trajectory, and the contents of its summary."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text, read_yaml
from greenroof_ros.base.times import hours_minutes_seconds
from greenroof_ros.forecast.choice import OPTIONS
from greenroof_ros.physics.storm_water import WITHOUT_RAIN
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import (
    EventRow,
    check_event,
    parameter_columns,
    read_events,
    summary_columns,
)
from greenroof_ros.results.trajectory import Trajectory, read_trajectory
from greenroof_ros.simulation import summary
from greenroof_ros.site.site import Site
from greenroof_ros.weather.summary import as_lines

Row = dict[str, Any]
"""a run's row of results: the columns of a study's ``results.csv``"""


@dataclass(frozen=True, kw_only=True)
class ReportedRun:
    """A run with results.

    Attributes:
        site: site of the run.
        row: results of the run, as the columns of a study's ``results.csv``. ``case`` is the label
            of the run; for an unfinished run, ``ended`` states how it ended.
        notes: notes about the run for the reader.
        alarms: recorded alarms, each a row for a table.
        kept: trajectory of the run, or the file that contains it; None if it was not kept.
        kept_events: rain events of the run, or the file that contains them.
    """

    site: Site
    row: Row
    notes: Sequence[str] = ()
    alarms: Sequence[dict[str, str]] = ()
    kept: Trajectory | Path | None = None
    kept_events: Sequence[EventRow] | Path = ()

    @property
    def name(self) -> str:
        """Name of the run, unique within the report."""
        return str(self.row["run"])

    def trajectory(self) -> Trajectory | None:
        """Return the trajectory of the run, if there is one.

        Raises:
            ConfigurationError: if the file is damaged.
        """
        return load_trajectory(self.kept) if isinstance(self.kept, Path) else self.kept

    def events(self) -> Sequence[EventRow]:
        """Return the rain events of the run.

        Raises:
            ConfigurationError: if the file is damaged.
        """
        events = self.kept_events
        return read_events(events) if isinstance(events, Path) else events


def load_trajectory(path: Path) -> Trajectory:
    """Read the trajectory of a simulation in one process."""
    trajectory = read_trajectory(path)
    if len(trajectory.time) < 2 or not (np.diff(trajectory.time) > 0).all():
        raise ConfigurationError(
            "must contain at least two samples, in chronological order", file=path
        )
    return trajectory


# How an unfinished run ended, according to the status in its summary.
_NOT_DONE = {
    summary.FAILED: "failed", summary.INTERRUPTED: "was interrupted",
    summary.RUNNING: "has not ended, or bringup was killed",
}


@dataclass(frozen=True, kw_only=True)
class About:
    """A run as described by its summary; the defaults are for a bag without a summary.

    Attributes:
        row: settings of the run and, if it is finished, its results.
        own: whether the run is a simulation by this package.
        external_pump: whether a pump driver reported the pump flow.
        without_rain: time without rain at the start of the run (s).
        ending: how an unfinished run ended, as a sentence without its subject and full stop.
        notes: notes about the run for the reader.
        events: rain events of the run; None if it has no results.
    """

    row: Row = field(default_factory=lambda: {
        "controller": "unknown", "weather": "as recorded", "evapotranspiration": "unknown",
        "initial": "the recorded volumes",
    })
    own: bool = False
    external_pump: bool = False
    without_rain: float = math.inf
    ending: str = ""
    notes: tuple[str, ...] = ()
    events: Sequence[EventRow] | None = None


def read_about(run: Path) -> About:
    """Read the summary of a run directory; if it cannot be used, a note is returned instead."""
    file = run / summary.SUMMARY
    if not file.is_file():
        return About()
    try:
        return _understood(json.loads(read_text(file)), run)
    except Exception:  # a foreign file can be wrong in any way
        return About(notes=(
            f"{file.name} next to the bag is damaged or was written by another program, and was "
            "not used",
        ))


def _understood(content: Mapping[str, Any], run: Path) -> About:
    """Return the run that a summary describes.

    Raises:
        Exception: if the content is not a summary; the exception can be of any type.
    """
    controller, live = content["controller"], "drive_at" in content
    plant = {} if live else _read_plant_parameters(run)
    if not isinstance(controller, str):
        raise TypeError
    status = content.get("status", summary.DONE)
    errors = content.get("sensor_and_pump") or {}
    forecast = {"file": content.get("forecast")} if live else content.get("forecast") or {}
    results = summary_columns(content)
    if status != summary.DONE:  # they are for whole runs
        results = {
            name: value for name, value in results.items()
            if name not in {metric.name for metric in METRICS}
        }
    row: Row = {
        "controller": controller,
        "weather": Path(content.get("weather") or "").name,
        "evapotranspiration": content.get("evapotranspiration_method"),
        "forecast": forecast.get("file") or forecast.get("model"),
        **{f"forecast_{option}": forecast.get(option) for option in OPTIONS},
        **parameter_columns(content.get("parameters") or {}),
        **{name: value for name, value in errors.items() if value},
        **results,
    }
    if content.get("start"):
        row["start"] = datetime.fromisoformat(content["start"]).isoformat()
    if "steps" in content:
        row["hours"] = content["steps"] * content["tau_s"] / 3600
    initial = content.get("initial") or {}
    if initial:
        row |= {key: float(initial[key]) for key in ("cistern_m3", "roof_m3")}
        row["initial"] = initial.get("name") or "custom"
    return About(
        row=About().row | {name: value for name, value in row.items() if value not in (None, "")},
        own=not live,  # live sensors can report anything
        external_pump=plant.get("pump") == "external",
        without_rain=float(plant.get(WITHOUT_RAIN.name, math.inf)),
        ending="" if status == summary.DONE else _ending(content),
        notes=(*_changes(content), *_weather(content)),
        events=list(map(check_event, content["events"])) if "events" in content else None,
    )


def _read_plant_parameters(run: Path) -> dict[str, Any]:
    """Return the parameters of a run's plant node; empty without a file that contains them."""
    try:
        nodes = read_yaml(run / "configuration" / "parameters.yaml")
        return {**nodes["/**/plant"]["ros__parameters"]}
    except Exception:  # no such file, or a foreign one, which can be wrong in any way
        return {}


def _changes(content: Mapping[str, Any]) -> list[str]:
    """Return a note for every parameter change that the summary lists."""
    changes = content.get("parameter_changes") or []
    left_out = int(content.get("parameter_change_count") or len(changes)) - len(changes)
    return [
        *([f"{left_out} earlier parameter changes are not listed"] if left_out > 0 else []),
        *(f"{change['parameter']} was changed from {change['before']} to {change['value']} at tick "
          f"{change['tick']}" for change in changes),
    ]


def _weather(content: Mapping[str, Any]) -> list[str]:
    """Return the lines that show what the weather of the run contains; a live site has none."""
    contained = content.get("weather_summary")
    if contained is None:
        return []
    # Notes on it are among the run's notes on the weather.
    return [f"weather: {line}" for line in as_lines({**contained, "notes": []})]


def _ending(content: Mapping[str, Any]) -> str:
    ending, tick = _NOT_DONE[content["status"]], content.get("last_tick")
    if tick is not None:
        time = hours_minutes_seconds(tick * content["tau_s"])
        ending += f" at tick {tick} of {content['steps']} ({time})"
    # The reason can include the last lines of a log.
    reason = " ".join((content.get("reason") or "").split())
    return f"{ending}: {reason}" if reason else ending
