"""Runs of a report: from run directories, bags and the directories of single-process simulations.

A run directory contains a bag. The directory of a simulation contains the trajectory instead, or
only the results.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.report.recorded import compute_results
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file, read_text
from greenroof_ros.base.times import to_minutes
from greenroof_ros.results.bag_read import load_bag
from greenroof_ros.results.bag_write import METADATA, name_recovered_bag
from greenroof_ros.results.table import format_exactly, summary_columns
from greenroof_ros.results.trajectory import CSV, TRAJECTORY, Trajectory, read_trajectory
from greenroof_ros.simulation import summary
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.summary import as_lines

_TOTAL = "total_deviation_m3"


@dataclass(frozen=True)
class ReportedRun:
    """A run with results.

    Attributes:
        site: site of the run.
        row: results of the run, as the columns of a study's ``results.csv``. For an unfinished run,
            ``error`` states how it ended.
        kept: trajectory of the run, or the file that contains it; None if it was not kept.
        notes: notes about the recording for the reader.
        read: sentences on the run's controller and its weather.
    """

    site: Site
    row: dict[str, Any]
    kept: Trajectory | Path | None = None
    notes: Sequence[str] = ()
    read: Sequence[str] = ()

    def trajectory(self) -> Trajectory | None:
        """Return the trajectory of the run, if there is one.

        Raises:
            ConfigurationError: if the file is damaged.
        """
        return read_trajectory(self.kept) if isinstance(self.kept, Path) else self.kept


def read_about(run: Path) -> dict[str, Any]:
    """Return the content of the summary in a run directory, empty if there is none.

    Raises:
        ConfigurationError: if the summary is damaged.
    """
    file = run / summary.SUMMARY
    try:
        return {**json.loads(read_text(file))} if file.is_file() else {}
    except (ValueError, TypeError) as error:
        raise ConfigurationError(f"is not the summary of a run: {error}", file=file) from error


def describe_ending(about: Mapping[str, Any]) -> str:
    """Return how an unfinished run ended, from its summary; empty for a finished run."""
    status = about.get("status", summary.DONE)
    if status == summary.DONE:
        return ""
    told = "has not ended, or was killed" if status == summary.RUNNING else str(status)
    reason = " ".join((about.get("reason") or "").split())  # it can include lines of a log
    return f"{told}: {reason}" if reason else told


def run_directory(path: Path) -> Path:
    """Return the directory with a run's configuration: the path, or the parent of its bag."""
    return next((place for place in (path, path.resolve().parent)
                 if (place / "configuration").is_dir()), path)


def read_run(path: Path, site: Path | Site | None = None) -> ReportedRun:
    """Read a run directory, a bag or an .mcap file.

    The results of a finished run are taken from its summary; all other results are computed from
    the trajectory. If ``greenroof recover`` has made a bag, this bag is read.

    Args:
        path: path of the run directory, bag or file.
        site: the site, or its file; by default the site file next to the bag, or else the paper's
            site.

    Raises:
        ConfigurationError: if the bag is damaged or was not recorded by this package, or if there
            is neither a bag nor a result.
    """
    run, file, notes = run_directory(path), "", list[str]()
    about = read_about(run)
    if not isinstance(site, Site):
        own = run / "configuration" / summary.SITE_FILE
        if site is None and not own.is_file():
            notes.append("there is no site file beside the bag: the paper's site is assumed")
        place = site or (own if own.is_file() else default_site_file())
        site, file = read_site(place), place.name
    results, begun = summary_columns(about), about.get("start")
    trajectory, unknown = None, frozenset[str]()
    hours = about.get("steps", 0) * about.get("tau_s", 0) / 3600
    bag = path / "bag" if (path / "bag").is_dir() else path
    recovered = name_recovered_bag(bag)
    repair = f"greenroof recover {run} recovers a complete bag from the remaining data"
    if recovered.is_dir():
        bag, repair = recovered, ""
        notes.append(f"{bag.name} contains the data that greenroof recover could recover")
    kept = next((path / name for name in (TRAJECTORY, CSV) if (path / name).is_file()), None)
    if bag.is_file() or (bag / METADATA).is_file() or any(bag.glob("*.mcap")):
        trajectory, further, unknown = load_bag(
            bag, site, (begun and datetime.fromisoformat(begun).tzinfo) or site.zone,
            own=bool(about) and "drive_at" not in about,  # live sensors can report anything
            external_pump="/pump/flow" in (about.get("refused") or {}), repair=repair,
        )
        notes += further
    elif kept is not None:
        trajectory = read_trajectory(kept)
    if trajectory is not None:
        begun, hours = trajectory.start.isoformat(), float(trajectory.time[-1]) / 3600
        if _TOTAL not in results:
            results |= compute_results(site, trajectory, unknown)
    elif _TOTAL not in results:
        raise ConfigurationError(
            "must be the directory of a study (with results.csv), of a run (with a bag, or with "
            "the results of a finished simulation) or of a bag, or an .mcap file", file=path,
        )
    if changes := about.get("parameter_change_count"):
        notes.append(f"{changes} changes of parameters during the run, listed in summary.json")
    initial = about.get("initial") or {"name": "the recorded volumes"}
    settings = {"controller": about.get("controller", "unknown"), **about.get("parameters", {})}
    weather = about.get("weather_summary")
    return ReportedRun(site, {
        "site": file, "start": begun, "initial": initial["name"] or "other volumes",
        "season": None, **results, "error": describe_ending(about),
        "window": f"from {to_minutes(datetime.fromisoformat(str(begun)))}, "
        f"{format_exactly(round(hours, 5))} h",
    }, trajectory, notes, [
        ", ".join(f"{name} {value}" for name, value in settings.items()),
        *(as_lines({**weather, "notes": []}) if weather else ()),
    ])
