"""Run directories and bags as runs of a report: their results, and the curves to draw.

A run directory has a bag; of a simulation in one process it has the trajectory, or results alone.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.report.run import (
    Note,
    ReportedRun,
    Row,
    labels,
    meaning_of_initial,
    read_about,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import default_site_file, file_digest
from greenroof_ros.common.times import to_people
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.clairvoyant import NoBoundError, clairvoyant_bound
from greenroof_ros.experiment.run import build_run
from greenroof_ros.experiment.summary import site_file_of
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.model.metrics import Samples, totals_of
from greenroof_ros.model.plant import mains_flow
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.model.soil import soil_of
from greenroof_ros.recording.bag_reader import RecordedTrajectory, load_bag
from greenroof_ros.recording.bag_writer import METADATA, recovered_bag
from greenroof_ros.recording.trajectory import CSV, TRAJECTORY, Trajectory, read_trajectory
from greenroof_ros.weather.reading import read_weather

MOST_POINTS = 500
"""of a drawn line, about"""


def run_directory(path: Path) -> Path:
    """Return the directory with a run's configuration: the path, or the parent of its bag."""
    # The path may be the bag in a run directory.
    return next((place for place in (path, _bag_in(path).resolve().parent)
                 if (place / "configuration").is_dir()), path)


def _bag_in(path: Path) -> Path:
    return path / "bag" if (path / "bag").is_dir() else path


def _closed_and_repair(path: Path, bag: Path) -> tuple[list[Path], str]:
    """Return a run's closed bags, the one to read first, and what repairs it, for a message.

    What ``recover`` made counts until something is recorded after it. A single file is a bag.
    """
    if path.is_file():
        return [path], f"greenroof recover {path.parent} makes a whole bag of what is left"
    new = recovered_bag(bag)
    closed = [place for place in (new, bag) if (place / METADATA).is_file()]
    if any(bag.glob("*.db3")):
        return closed, f"ros2 bag reindex {bag} writes its metadata.yaml again"
    if new not in closed:
        return closed, f"greenroof recover {path} makes a whole one of what is left"
    recorded = max((file.stat().st_mtime for file in bag.glob("*")), default=0.0)
    if (new / METADATA).stat().st_mtime < recorded:
        return closed[::-1], f"remove {new}, and greenroof recover {path} makes a new one"
    return closed, ""


def read_run(path: Path, name: str, site_file: Path | None) -> ReportedRun | Row:
    """Return the run in a run directory or bag; a row with its error if it left nothing."""
    bag, run = _bag_in(path), run_directory(path)
    kept = next((path / name for name in (TRAJECTORY, CSV) if (path / name).is_file()), None)
    closed, repair = _closed_and_repair(path, bag)
    bag = next(iter(closed), bag)
    own_site, notes = site_file_of(run), list[Note]()
    if site_file is not None:
        site, site_name = read_site(site_file), str(site_file)
    elif own_site.is_file():
        site, site_name = read_site(own_site), own_site.name
    else:
        site = read_site(default_site_file())
        site_name = "the paper's"
        notes.append(
            Note("no site file came with the bag: the site is the paper's, config/site.yaml")
        )
    if bag == recovered_bag(_bag_in(path)):
        notes.append(Note(f"{bag.name} is what greenroof recover found whole in {name}"))
    about = read_about(run, site)
    if not closed and kept is None and "hours" not in about.row:
        if any(bag.glob("*.mcap")) or any(bag.glob("*.db3")):
            raise ConfigurationError(
                f"has no metadata.yaml: it is being recorded, or was cut off; {repair}", file=bag
            )
        if about.ending:
            error = f"{about.ending}; no bag"
            return {"run": name, "what": about.row["controller"], "error": error}
        raise ConfigurationError(
            "must be a study (with results.csv), a run (with bag/, or a simulation that is done), "
            "a bag (with metadata.yaml) or an .mcap file",
            file=path,
        )
    zone = about.zone
    if zone is None and own_site.is_file() and site.utc_offset is not None:
        zone = timezone(timedelta(hours=site.utc_offset))
    if zone is None:
        notes.append(Note("times are in UTC: no configuration gives the offset"))
    row = {**about.row, "run": name, "site": site_name, "status": "done"}
    if not closed and kept is None:
        row |= {"frost_pumped_m3": 0.0, "bound_m3": None}
    weather = sorted((run / "configuration" / "weather").glob("*"))
    forecast = sorted((run / "configuration" / "forecast").rglob("*"))
    return replace(
        about,
        row={**row, **labels(row), "seed": ""},  # a single run is no group of seeds
        notes=(*notes, *about.notes),
        load=partial(
            load_bag, bag, site, zone or timezone.utc,
            own=about.own, external_pump=about.external_pump, repair=repair,
        ) if closed else None if kept is None else partial(load_trajectory, kept),
        # A sensor with errors shows neither the roof's initial volume nor its deviation.
        bound=partial(
            _run_bound, weather, own_site, site, row["evapotranspiration"], row["gaps"]
        ) if about.exact_sensor else lambda _: None,
        source=name,
        meant={
            "site": site,
            "weather": "".join(map(file_digest, weather)),
            "forecast": "".join(map(file_digest, forecast)),
            "from": meaning_of_initial(row),
        },
    )


def load_trajectory(path: Path) -> RecordedTrajectory:
    """Read the trajectory of a simulation in one process."""
    trajectory = read_trajectory(path)
    if len(trajectory.time) < 2 or not (np.diff(trajectory.time) > 0).all():
        raise ConfigurationError("must have two or more samples, in order of time", file=path)
    return RecordedTrajectory(trajectory)


def _run_bound(
    weather: list[Path], site_file: Path, site: Site, method: str, gaps: str,
    recorded: RecordedTrajectory,
) -> float | None:
    """Return the minimum total deviation (m3) that a controller could reach in a run's own weather.

    None if that is unknown: there are no weather files, or the bag's weather or times differ.
    """
    trajectory = recorded.trajectory
    steps = len(trajectory.time) - 1
    if not weather or not np.allclose(
        trajectory.time, site.tau * np.arange(steps + 1), rtol=0, atol=1e-6
    ):
        return None
    try:
        run = build_run(
            site_file, site, read_weather(weather, site, method, gaps),
            trajectory.start.isoformat(), steps, find_controller("onoff"), {}, "custom",
            (float(trajectory.cistern[0]), float(trajectory.roof[0])), ForecastChoice(),
        )
        for ours, theirs in (
            (run.series.precipitation, trajectory.precipitation),
            (run.series.evapotranspiration, trajectory.evapotranspiration),
        ):
            if not np.allclose(ours[:steps], theirs[:-1], rtol=1e-9, atol=0):
                return None
        return clairvoyant_bound(run).bound_m3
    except (ConfigurationError, NoBoundError):
        return None


def measured(run: ReportedRun, recorded: RecordedTrajectory) -> Row:
    """Return the row of a bag's run with its results.

    Results in the summary of a finished run are kept; all others are computed from the bag. Sums
    are Euler's: a value holds from its sample to the next, over the difference of their times. The
    flows of the last sample count in no sum, because the run ends in its state.
    """
    trajectory, site = recorded.trajectory, run.site
    dt = np.diff(trajectory.time)
    frost = trajectory.frost[:-1] > 0
    row = {
        "cistern_m3": float(trajectory.cistern[0]),
        "roof_m3": float(trajectory.roof[0]),
        **totals_of(site, samples_of(site, trajectory)),
        "frost_hours": float(dt[frost].sum()) / 3600,
        **run.row,
        "start": to_people(trajectory.start),
        "hours": float(trajectory.time[-1] - trajectory.time[0]) / 3600,
        "frost_pumped_m3": float(np.sum((trajectory.pump_flow[:-1] * dt)[frost])),
        "bound_m3": run.bound(recorded) if run.bound is not None else None,
    }
    return {**row, "length": labels(row)["length"]}


def near_hours(site: Site, trajectory: Trajectory, band: float) -> float:
    """Return how long the roof is near its target (h).

    Args:
        site: the site, Table I.
        trajectory: of the run; the last sample counts for a tick.
        band: half width of the band about the target, as a share of the target (1).
    """
    near = np.abs(trajectory.roof - site.x2_star) <= band * site.x2_star
    return float(np.append(np.diff(trajectory.time), site.tau)[near].sum()) / 3600


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


class Drawn(NamedTuple):
    """The curves of a run that are drawn."""

    start: datetime
    """time of the first sample"""
    curves: dict[str, list[tuple[float, float]]]
    """time (s) and value of :data:`MOST_POINTS` samples, by attribute of the trajectory"""
    frost: list[tuple[float, float]]
    """start and end (s since the first sample) of each period of frost"""


def drawn(trajectory: Trajectory) -> Drawn:
    """Return the curves of a trajectory that are drawn."""
    curves = {}
    for name in ("command", "pump_flow", "cistern", "roof", "precipitation", "evapotranspiration"):
        values = getattr(trajectory, name)
        if name not in ("cistern", "roof"):
            # The run ends at the last sample: its flows never held, so draw the values before it.
            values = np.append(values[:-1], values[-2])
        index = thin(values)
        times = trajectory.time[index].tolist()
        curves[name] = list(zip(times, values[index].tolist(), strict=True))
    steps = np.diff(np.concatenate([[0], trajectory.frost[:-1] > 0, [0]]).astype(int))
    begins, ends = (trajectory.time[np.flatnonzero(steps == step)].tolist() for step in (1, -1))
    return Drawn(trajectory.start, curves, list(zip(begins, ends, strict=True)))


def thin(values: NDArray[np.float64], most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Return the samples to draw: the first, the last, and the smallest and largest of each bucket.

    Args:
        values: shape (n,).
        most: number of samples to keep, about; all are kept if there are no more than this.
    """
    count = len(values)
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, (most - 2) // 2 + 1).astype(np.intp)
    indices = {0, count - 1}
    for low, high in itertools.pairwise(edges):
        indices.add(int(low + np.argmin(values[low:high])))
        indices.add(int(low + np.argmax(values[low:high])))
    return np.array(sorted(indices), dtype=np.intp)
