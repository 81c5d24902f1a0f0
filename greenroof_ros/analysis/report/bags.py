"""Reading of run directories and bags as runs of a report.

A run directory contains a bag. The directory of a single-process simulation contains the trajectory
instead, or only the results.
"""

from __future__ import annotations

from datetime import datetime, timezone, tzinfo
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.report.recorded import compute_results
from greenroof_ros.analysis.report.run import About, ReportedRun, Row, load_trajectory, read_about
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.times import to_people
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.results.bag_read import load_bag
from greenroof_ros.results.bag_write import METADATA, name_recovered_bag
from greenroof_ros.results.table import event_rows, format_exactly
from greenroof_ros.results.trajectory import CSV, TRAJECTORY
from greenroof_ros.simulation.summary import SITE_FILE
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

# Columns without which results alone do not make a run of a report.
_NEEDED = {"start", "hours", "cistern_m3", "total_deviation_m3"}


def run_directory(path: Path) -> Path:
    """Return the directory with a run's configuration: the path, or the parent of its bag."""
    # The path may be the bag in a run directory.
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
    own_site = run / "configuration" / SITE_FILE
    file = given if isinstance(given, Path) else own_site if own_site.is_file() else None
    site = given if isinstance(given, Site) else read_site(file or default_site_file())
    if file is None and given is None:
        notes.append("the bag contains no site file: the paper's site, config/site.yaml, is "
            "assumed")
    name = run.resolve().name
    row: Row = {
        **about.row, "run": name, "site": file.name if file else "the paper's", "season": "",
    }
    zone = _zone(row, site if file else None)
    closed, repair = _closed_and_repair(bag, run if run.is_dir() else run.parent)
    kept = next((path / name for name in (TRAJECTORY, CSV) if (path / name).is_file()), None)
    trajectory, unknown, events = None, frozenset[str](), about.events
    if closed is not None:
        if closed == name_recovered_bag(bag):
            notes.append(f"{closed.name} contains the data that greenroof recover could recover")
            if repair:
                notes.append(f"more data have been recorded since: {repair}")
        if zone is None:
            notes.append("times are in UTC, because no configuration states the offset")
        trajectory, further, unknown = load_bag(
            closed, site, zone or timezone.utc, own=about.own, external_pump=about.external_pump,
            repair=repair,
        )
        notes += further
    elif kept is not None:
        trajectory = load_trajectory(kept)
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
        if events is None or "total_deviation_m3" not in row:
            results, found = compute_results(site, trajectory, unknown, about.without_rain)
            row = {**results, **row}
            events = event_rows(trajectory.start, found) if events is None else events
        pumped = trajectory.pump_flow[:-1] * np.diff(trajectory.time)
        row = {
            "cistern_m3": float(trajectory.cistern[0]), "roof_m3": float(trajectory.roof[0]), **row,
            "start": trajectory.start.isoformat(), "hours": float(trajectory.time[-1]) / 3600,
            "frost_pumped_m3": float(pumped[trajectory.frost[:-1] > 0].sum()),
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
    try:
        alarms = [
            {
                "part": alarm.name, "from": _moment(alarm.since, zone),
                "until": "not over" if alarm.ended is None else _moment(alarm.ended, zone),
                "level": alarm.level, "what": alarm.sentence, "follows from": alarm.follows,
            }
            for alarm in read_alarms(run)
        ]
    except (OSError, ValueError) as error:
        notes.append(f"the file of alarms next to the bag is damaged and was not used: {error}")
        alarms = []
    return ReportedRun(
        site=site, row=row, notes=notes, alarms=alarms, kept=trajectory, kept_events=events or (),
    )


def _zone(row: Row, site: Site | None) -> tzinfo | None:
    """Return the time zone of a run, which is that of its start or else that of the site."""
    if "start" in row:
        return datetime.fromisoformat(row["start"]).tzinfo
    if site is not None and (site.time_zone, site.utc_offset) != (None, None):
        return site.zone
    return None


def _moment(seconds: float, zone: tzinfo | None) -> str:
    return to_people(datetime.fromtimestamp(seconds, zone or timezone.utc).replace(microsecond=0))
