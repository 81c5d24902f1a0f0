"""Run directories and bags as runs of a report.

A run directory has a bag; of a simulation in one process it has the trajectory, or results alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.analysis.report.run import About, Row, read_about
from greenroof_ros.common.alarm_log import read_alarms
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import default_site_file, file_digest
from greenroof_ros.common.times import to_people
from greenroof_ros.experiment.summary import site_file_of
from greenroof_ros.model.metrics import Samples, totals_of
from greenroof_ros.model.plant import mains_flow
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.model.soil import soil_of
from greenroof_ros.recording.bag_reader import load_bag
from greenroof_ros.recording.bag_writer import METADATA, recovered_bag
from greenroof_ros.recording.results_table import shortest
from greenroof_ros.recording.trajectory import CSV, TRAJECTORY, Trajectory, read_trajectory


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A run directory or a bag.

    Attributes:
        directory: with its configuration.
        site: where it was recorded.
        site_name: of its file.
        about: what its summary contains.
        trajectory: None if only results were kept.
        bag: the bag that was read; None if the trajectory is from another file.
        notes: what a reader should know, beside ``about.notes``.
        alarms: recorded ones, each a row for a table.
    """

    directory: Path
    site: Site
    site_name: str
    about: About
    trajectory: Trajectory | None
    bag: Path | None
    notes: list[str]
    alarms: list[dict[str, str]]


def run_directory(path: Path) -> Path:
    """Return the directory with a run's configuration: the path, or the parent of its bag."""
    # The path may be the bag in a run directory.
    return next((place for place in (path, _bag_in(path).resolve().parent)
                 if (place / "configuration").is_dir()), path)


def _bag_in(path: Path) -> Path:
    return path / "bag" if (path / "bag").is_dir() else path


def _closed_and_repair(path: Path, bag: Path) -> tuple[Path | None, str]:
    """Return the closed bag of a run to read, if any, and what repairs it, for a message.

    What ``recover`` made counts until something is recorded after it. A single file is a bag.
    """
    if path.is_file():
        return path, f"greenroof recover {path.parent} makes a whole bag of what is left"
    new = recovered_bag(bag)
    closed = bag if (bag / METADATA).is_file() else None
    if any(bag.glob("*.db3")):
        return closed, f"ros2 bag reindex {bag} writes its metadata.yaml again"
    if not (new / METADATA).is_file():
        return closed, f"greenroof recover {path} makes a whole one of what is left"
    recorded = max((file.stat().st_mtime for file in bag.glob("*")), default=0.0)
    if (new / METADATA).stat().st_mtime < recorded:
        return closed or new, f"remove {new}, and greenroof recover {path} makes a new one"
    return new, ""


def read_recording(path: Path, site_file: Path | None = None) -> Recording:
    """Read a run directory, a bag or an .mcap file.

    Args:
        path: its path.
        site_file: the site; by default the one next to the bag, or else the paper's.

    Raises:
        ConfigurationError: the bag is damaged or foreign, or there is neither bag nor result; of a
            run that was not done it begins with how that ended.
    """
    about = read_about(run_directory(path))
    try:
        return _read_recording(path, site_file, about)
    except ConfigurationError as error:
        if about.ending:
            raise ConfigurationError(f"{about.ending}; {error}") from error
        raise


def _read_recording(path: Path, site_file: Path | None, about: About) -> Recording:
    run, notes = run_directory(path), list[str]()
    own_site = site_file_of(run)
    file = site_file or (own_site if own_site.is_file() else None)
    site = read_site(file or default_site_file())
    if file is None:
        notes.append("no site file came with the bag: the site is the paper's, config/site.yaml")
    bag, repair = _closed_and_repair(path, _bag_in(path))
    kept = next((path / name for name in (TRAJECTORY, CSV) if (path / name).is_file()), None)
    trajectory = None
    if bag is not None:
        if bag == recovered_bag(_bag_in(path)):
            notes.append(f"{bag.name} is what greenroof recover found whole")
        zone = about.start.tzinfo if about.start is not None else None
        if zone is None and own_site.is_file() and site.utc_offset is not None:
            zone = timezone(timedelta(hours=site.utc_offset))
        if zone is None:
            notes.append("times are in UTC: no configuration gives the offset")
        trajectory, further = load_bag(
            bag, site, zone or timezone.utc, own=about.own, external_pump=about.external_pump,
            repair=repair,
        )
        notes += further
    elif kept is not None:
        trajectory = load_trajectory(kept)
    elif any(_bag_in(path).glob("*.mcap")) or any(_bag_in(path).glob("*.db3")):
        raise ConfigurationError(
            f"has no metadata.yaml: it is being recorded, or was cut off; {repair}",
            file=_bag_in(path),
        )
    elif about.ending:
        raise ConfigurationError("no bag", file=path)
    elif "total_deviation_m3" not in about.row:
        raise ConfigurationError(
            "must be a study (with results.csv), a run (with bag/, or a simulation that is done), "
            "a bag (with metadata.yaml) or an .mcap file", file=path,
        )
    zone = trajectory.start.tzinfo if trajectory is not None else timezone.utc
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
        notes.append(f"the alarms next to the bag are damaged, and not used: {error}")
        alarms = []
    return Recording(
        directory=run, site=site, site_name="the paper's" if file is None else file.name,
        about=about, trajectory=trajectory, bag=bag, notes=notes, alarms=alarms,
    )


def _moment(seconds: float, zone: Any) -> str:
    return to_people(datetime.fromtimestamp(seconds, zone).replace(microsecond=0))


def row_of(recording: Recording, name: str) -> tuple[Row, tuple[object, ...]]:
    """Return a recording's row of results, and what identifies its window.

    Results of a finished run are its summary's; all others are computed from the trajectory. Sums
    are Euler's: a value holds from its sample to the next, over the difference of their times. The
    flows of the last sample count in no sum, because the run ends in its state.
    """
    about, trajectory, site = recording.about, recording.trajectory, recording.site
    row: Row = {**about.row, "run": name, "site": recording.site_name, "season": ""}
    if trajectory is not None:
        row = {
            "cistern_m3": float(trajectory.cistern[0]), "roof_m3": float(trajectory.roof[0]),
            **totals_of(site, samples_of(site, trajectory)), **row,
            "start": trajectory.start.isoformat(),
            "hours": float(trajectory.time[-1] - trajectory.time[0]) / 3600,
        }
        frost = trajectory.frost[:-1] > 0
        pumped = trajectory.pump_flow[:-1] * np.diff(trajectory.time)
        row["frost_pumped_m3"] = float(pumped[frost].sum())
    elif about.start is not None:
        row["start"] = about.start.isoformat()
    start, hours = row.get("start"), row.get("hours")
    row["window"] = ", ".join([
        row["site"], row["weather"] if about.own else name,
        *([f"from {to_people(datetime.fromisoformat(start))}"] if start else []),
        *([f"{shortest(round(hours, 5))} h"] if hours else []),
        f"{row['evapotranspiration']} evapotranspiration",
    ])
    weather = sorted((recording.directory / "configuration" / "weather").glob("*"))
    return row, (site, row["cistern_m3"], row["roof_m3"], *map(file_digest, weather))


def load_trajectory(path: Path) -> Trajectory:
    """Read the trajectory of a simulation in one process."""
    trajectory = read_trajectory(path)
    if len(trajectory.time) < 2 or not (np.diff(trajectory.time) > 0).all():
        raise ConfigurationError("must have two or more samples, in order of time", file=path)
    return trajectory


def samples_of(site: Site, trajectory: Trajectory) -> Samples:
    """Return a whole run as samples. Whether a tank's flows were limited is unknown.

    The drainage layer of a measured soil is computed from percolation; it begins with the site's
    ``initial_layer``.
    """
    dt = np.append(np.diff(trajectory.time), site.tau)
    values = {
        "pump": trajectory.pump_flow, "potential": trajectory.evapotranspiration,
        "mains": mains_flow(site, trajectory.cistern), **{
            name: getattr(trajectory, name)
            for name in ("command", "precipitation", "outflow", "drainage")
        },
    }
    # The run ends at the last sample: nothing flows after it.
    flows: dict[str, Any] = {name: np.append(flow[:-1], 0.0) for name, flow in values.items()}
    followed = soil_of(site).follow(
        site.initial_layer, trajectory.roof, flows["precipitation"], flows["pump"],
        flows["potential"], flows["drainage"], dt,
    )
    return Samples(
        **flows, duration=dt, cistern=trajectory.cistern, roof=trajectory.roof,
        evapotranspiration=followed.evaporated, layer=followed.layer, time=trajectory.time,
    )
