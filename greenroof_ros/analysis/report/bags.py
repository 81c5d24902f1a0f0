"""Runs of a report: from run directories, bags and the directories of single-process simulations.

A run directory contains a bag. The directory of a simulation contains the trajectory instead, or
only the results.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone, tzinfo
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.analysis.report.recorded import compute_results
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file, read_text, read_yaml
from greenroof_ros.base.times import hours_minutes_seconds, to_people
from greenroof_ros.forecast.choice import OPTIONS
from greenroof_ros.physics.storm_water import WITHOUT_RAIN
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.results.bag_read import load_bag
from greenroof_ros.results.bag_write import METADATA, name_recovered_bag
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import format_exactly, parameter_columns, summary_columns
from greenroof_ros.results.trajectory import CSV, TRAJECTORY, Trajectory, read_trajectory
from greenroof_ros.simulation import summary
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.summary import as_lines

Row = dict[str, Any]
"""a run's row of results: the columns of a study's ``results.csv``"""

# Columns without which results alone do not make a run of a report.
_NEEDED = {"start", "hours", "cistern_m3", "total_deviation_m3"}


@dataclass(frozen=True, kw_only=True)
class ReportedRun:
    """A run with results.

    Attributes:
        site: site of the run.
        row: results of the run, as the columns of a study's ``results.csv``. ``case`` is the label
            of the run; for an unfinished run, ``ended`` states how it ended.
        notes: notes about the run for the reader.
        weather: sentences on what the weather of the run contains.
        alarms: recorded alarms: part, begin, end, level, sentence, and what they follow from.
        kept: trajectory of the run, or the file that contains it; None if it was not kept.
    """

    site: Site
    row: Row
    notes: Sequence[str] = ()
    weather: Sequence[str] = ()
    alarms: Sequence[Sequence[str]] = ()
    kept: Trajectory | Path | None = None

    @property
    def name(self) -> str:
        """Name of the run."""
        return str(self.row["run"])

    def trajectory(self) -> Trajectory | None:
        """Return the trajectory of the run, if there is one.

        Raises:
            ConfigurationError: if the file is damaged, or contains fewer than two samples.
        """
        if not isinstance(self.kept, Path):
            return self.kept
        trajectory = read_trajectory(self.kept)
        if len(trajectory.time) < 2 or not (np.diff(trajectory.time) > 0).all():
            raise ConfigurationError(
                "must contain at least two samples, in chronological order", file=self.kept
            )
        return trajectory


# --- the summary ----------------------------------------------------------------------------------

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
        weather: sentences on what the weather of the run contains.
    """

    row: Row = field(default_factory=lambda: {
        "controller": "unknown", "weather": "as recorded", "evapotranspiration": "unknown",
        "initial": "the recorded volumes",
    })
    own: bool = False
    external_pump: bool = False
    without_rain: float = math.inf
    ending: str = ""
    notes: Sequence[str] = ()
    weather: Sequence[str] = ()


def read_about(run: Path) -> About:
    """Read the summary of a run directory; a note replaces one that is not by this package."""
    file, parameters = run / summary.SUMMARY, run / "configuration" / "parameters.yaml"
    if not file.is_file():
        return About()
    try:
        content = json.loads(read_text(file))
    except (ConfigurationError, ValueError, RecursionError):
        content = None
    if not isinstance(content, dict) or not isinstance(content.get("controller"), str):
        return About(notes=[
            f"{file.name} next to the bag is damaged or was written by another program, and was "
            "not used",
        ])
    live, contained = "drive_at" in content, content.get("weather_summary")
    plant = {} if live or not parameters.is_file() else (
        read_yaml(parameters)["/**/plant"]["ros__parameters"]
    )
    return About(
        row=About().row | _make_row(content, live),
        own=not live,  # live sensors can report anything
        external_pump=plant.get("pump") == "external",
        without_rain=float(plant.get(WITHOUT_RAIN.name, math.inf)),
        ending=_describe_ending(content),
        notes=[
            f"{change['parameter']} was changed from {change['before']} to {change['value']} at "
            f"tick {change['tick']}" for change in content.get("parameter_changes") or ()
        ],
        weather=as_lines({**contained, "notes": []}) if contained else [],
    )


def _make_row(content: Mapping[str, Any], live: bool) -> Row:
    forecast = {"file": content.get("forecast")} if live else content.get("forecast") or {}
    initial, results = content.get("initial") or {}, summary_columns(content)
    if _describe_ending(content):  # metrics are for whole runs
        results = {key: results[key] for key in results.keys() - {each.name for each in METRICS}}
    row = {
        "controller": content["controller"], "weather": Path(content.get("weather") or "").name,
        "evapotranspiration": content.get("evapotranspiration_method"),
        "forecast": forecast.get("file") or forecast.get("model"),
        **{f"forecast_{option}": forecast.get(option) for option in OPTIONS},
        **parameter_columns(content.get("parameters") or {}),
        **{name: each or None for name, each in (content.get("sensor_and_pump") or {}).items()},
        **results, "start": content.get("start"),
        "hours": content["steps"] * content["tau_s"] / 3600 if "steps" in content else None,
        "cistern_m3": initial.get("cistern_m3"), "roof_m3": initial.get("roof_m3"),
        "initial": initial and (initial["name"] or "custom"),
    }
    return {name: value for name, value in row.items() if value not in (None, "", {})}


def _describe_ending(content: Mapping[str, Any]) -> str:
    if (status := content.get("status", summary.DONE)) == summary.DONE:
        return ""
    ending, tick = _NOT_DONE[status], content.get("last_tick")
    if tick is not None:
        time = hours_minutes_seconds(tick * content["tau_s"])
        ending += f" at tick {tick} of {content['steps']} ({time})"
    # The reason can include the last lines of a log.
    reason = " ".join((content.get("reason") or "").split())
    return f"{ending}: {reason}" if reason else ending


# --- the directory --------------------------------------------------------------------------------


def run_directory(path: Path) -> Path:
    """Return the directory with a run's configuration: the path, or the parent of its bag."""
    return next((place for place in (path, _bag_in(path).resolve().parent)
                 if (place / "configuration").is_dir()), path)


def _bag_in(path: Path) -> Path:
    return path / "bag" if (path / "bag").is_dir() else path


def _closed_and_repair(bag: Path, run: Path) -> tuple[Path | None, str]:
    """Return the closed bag to read, if any, and a repair instruction for a message.

    The bag that ``recover`` made is used if nothing has been recorded since, or if no other bag is
    closed. A single file is treated as a bag.
    """
    new = name_recovered_bag(bag)
    repair = f"greenroof recover {run} recovers a complete bag from the remaining data"
    closed = bag if bag.is_file() or (bag / METADATA).is_file() else None
    if not (new / METADATA).is_file():
        return closed, repair
    recorded = max((file.stat().st_mtime for file in bag.glob("*")), default=0.0)
    if (new / METADATA).stat().st_mtime < recorded:
        return closed or new, f"remove {new}, and {repair}"
    return new, ""


def read_run(path: Path, site: Path | Site | None = None) -> ReportedRun:
    """Read a run directory, a bag or an .mcap file.

    The results of a finished run are taken from its summary; all other results are computed from
    the trajectory.

    Args:
        path: path of the run directory, bag or file.
        site: the site, or its file; by default the site file next to the bag, or else the paper's
            site.

    Raises:
        ConfigurationError: if the bag is damaged or was not recorded by this package, or if there
            is neither a bag nor a result. If the run was not finished, the message begins with a
            statement of how the run ended.
    """
    about = read_about(run_directory(path))
    try:
        return _read_run(path, site, about)
    except ConfigurationError as error:
        if about.ending:
            raise ConfigurationError(f"{about.ending}; {error}") from error
        raise


def _read_run(path: Path, given: Path | Site | None, about: About) -> ReportedRun:
    run, bag, notes = run_directory(path), _bag_in(path), list(about.notes)
    own_site = run / "configuration" / summary.SITE_FILE
    file = given if isinstance(given, Path) else own_site if own_site.is_file() else None
    site = given if isinstance(given, Site) else read_site(file or default_site_file())
    if file is None and given is None:
        notes.append(
            "the bag contains no site file: the paper's site, config/site.yaml, is assumed"
        )
    name = run.resolve().name
    row: Row = {
        **about.row, "run": name, "site": file.name if file else "the paper's", "season": "",
    }
    zone = _zone(row, site if file else None)
    closed, repair = _closed_and_repair(bag, run if run.is_dir() else run.parent)
    kept = next((path / name for name in (TRAJECTORY, CSV) if (path / name).is_file()), None)
    trajectory, unknown = None, frozenset[str]()
    if closed is not None:
        if closed == name_recovered_bag(bag):
            notes.append(f"{closed.name} contains the data that greenroof recover could recover")
            if repair:
                notes.append(f"more data have been recorded since: {repair}")
        if zone is None:
            notes.append("times are in UTC, because no configuration states the offset")
        notes += [
            f"the roof level is the reading of its sensor ({key} {row[key]:g} m)"
            for key in ("roof_noise", "roof_offset") if key in row
        ]
        trajectory, further, unknown = load_bag(
            closed, site, zone or timezone.utc, own=about.own, external_pump=about.external_pump,
            repair=repair,
        )
        notes += further
    elif kept is not None:
        trajectory = ReportedRun(site=site, row=row, kept=kept).trajectory()
    elif any(bag.glob("*.mcap")):
        raise ConfigurationError(
            "has no metadata.yaml: it is still being recorded, or its recording was cut off; "
            f"{repair}", file=bag
        )
    elif about.ending:
        raise ConfigurationError("no bag", file=path)
    elif not row.keys() >= _NEEDED:
        raise ConfigurationError(
            "must be the directory of a study (with results.csv), of a run (with bag/, or with "
            "the results of a finished simulation) or of a bag (with metadata.yaml), or an .mcap "
            "file", file=path,
        )
    if trajectory is not None:
        if "total_deviation_m3" not in row:
            row = {**compute_results(site, trajectory, unknown, about.without_rain), **row}
        row = {
            "cistern_m3": float(trajectory.cistern[0]), "roof_m3": float(trajectory.roof[0]), **row,
            "start": trajectory.start.isoformat(), "hours": float(trajectory.time[-1]) / 3600,
        }
        zone = trajectory.start.tzinfo
    row["window"] = ", ".join([
        row["site"], row["weather"] if about.own else name,
        f"from {to_people(datetime.fromisoformat(row['start']))}",
        f"{format_exactly(round(row['hours'], 5))} h",
        f"{row['evapotranspiration']} evapotranspiration",
    ])
    if about.ending:
        row["ended"] = about.ending
        notes.append(f"{about.ending}: all results are for the recorded part only")
    alarms = list[Sequence[str]]()
    try:
        for alarm in read_alarms(run):
            begin, end = (
                "not over" if each is None else
                to_people(datetime.fromtimestamp(int(each), zone or timezone.utc))
                for each in (alarm.since, alarm.ended)
            )
            alarms.append((alarm.name, begin, end, alarm.level, alarm.sentence, alarm.follows))
    except (OSError, ValueError) as error:
        notes.append(f"the file of alarms next to the bag is damaged and was not used: {error}")
    return ReportedRun(
        site=site, row=row, notes=notes, weather=about.weather, alarms=alarms, kept=trajectory,
    )


def _zone(row: Row, site: Site | None) -> tzinfo | None:
    """Return the time zone of a run, which is that of its start or else that of the site."""
    if "start" in row:
        return datetime.fromisoformat(row["start"]).tzinfo
    if site is not None and (site.time_zone, site.utc_offset) != (None, None):
        return site.zone
    return None
