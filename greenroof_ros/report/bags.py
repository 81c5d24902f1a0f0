"""A run directory or a bag as a run of a report."""

from __future__ import annotations

from datetime import timedelta, timezone
from functools import partial
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import file_digest, shared_directory
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.clairvoyant import NoBoundError, clairvoyant_bound
from greenroof_ros.experiment.run import build_run
from greenroof_ros.experiment.summary import site_file_of
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.recording.bag_reader import load_bag
from greenroof_ros.recording.bag_writer import recovered_bag
from greenroof_ros.recording.trajectory import Trajectory
from greenroof_ros.report.about import read_about
from greenroof_ros.report.entries import FailedRun, Note, RunEntry, Sources, known_bound
from greenroof_ros.weather.reading import read_weather

_WEATHER = Path("configuration") / "weather"


def run_directory(path: Path) -> Path:
    """Return the directory in which a run wrote about itself: the path, or that of its bag."""
    # The bag in a run directory may be named itself.
    bag = path / "bag" if (path / "bag").is_dir() else path
    return next((place for place in (path, bag.resolve().parent)
                 if (place / "configuration").is_dir()), path)


def read_run(
    path: Path, name: str, site_file: Path | None, given: Site | None, sources: Sources
) -> None:
    """Add the run of a run directory or a bag, under a name."""
    bag = path / "bag" if (path / "bag").is_dir() else path
    if not _is_closed(bag) and _is_closed(recovered_bag(bag)):
        bag = recovered_bag(bag)
    run = run_directory(path)
    about = read_about(run)
    repair = f"greenroof recover {path} makes a whole one"
    if not _is_closed(bag):
        if any(bag.glob("*.mcap")) or any(bag.glob("*.db3")):
            raise ConfigurationError(
                f"has no metadata.yaml: it is being recorded, or was cut off; {repair}", file=bag
            )
        if about.ending is not None:
            error = f"{about.ending.sentence}; no bag"
            sources.failed.append(FailedRun(name, about.controller, error))
            return
        raise ConfigurationError(
            "must be a study (with results.csv), a run (with bag/) or a bag (with metadata.yaml)",
            file=path,
        )
    own_site = site_file_of(run)
    notes = []
    if given is not None:
        site, site_name = given, str(site_file)
    elif own_site.is_file():
        site, site_name = read_site(own_site), own_site.name
    else:
        site = read_site(shared_directory() / "config" / "site.yaml")
        site_name = "the paper's"
        notes.append(
            Note("no site file came with the bag: the site is the paper's, config/site.yaml")
        )
    zone = about.zone
    if zone is None and own_site.is_file() and site.utc_offset is not None:
        zone = timezone(timedelta(hours=site.utc_offset))
    if zone is None:
        notes.append(Note("times are in UTC: no configuration says the offset"))
    sources.runs.append(RunEntry(
        name=name,
        site_name=site_name,
        site=site,
        weather=about.weather,
        method=about.method,
        controller=about.controller,
        parameters=about.parameters,
        initial=about.initial,
        notes=(*notes, *about.notes),
        load=partial(
            load_bag, bag, site, zone or timezone.utc,
            own=about.own, external_pump=about.external_pump, repair=repair,
        ),
        forecast=about.forecast,
        # What a sensor reads is neither the roof's initial volume nor its deviation.
        bound=(
            partial(_own_bound, run / _WEATHER, own_site, site,
                    about.method, about.gaps)
            if about.exact_sensor else known_bound(None)
        ),
        sensor_pump_errors=about.sensor_pump_errors,
        changes=about.changes,
        ending=about.ending,
        incidents=about.incidents,
        source=name,
        meant={
            "site_name": site,
            "weather": "".join(map(file_digest, sorted((run / _WEATHER).glob("*")))),
            "forecast": "".join(
                map(file_digest, sorted((run / "configuration" / "forecast").rglob("*")))
            ),
            "initial": about.what_initial,
        },
    ))


def _is_closed(bag: Path) -> bool:
    return (bag / "metadata.yaml").is_file()


def _own_bound(
    weather: Path, site_file: Path, site: Site, method: str, gaps: str, trajectory: Trajectory
) -> float | None:
    """Return the least total deviation (m3) that a controller could reach in a run's own weather.

    None where that is unknown: there are no weather files, or they are not what the bag has.
    """
    steps = len(trajectory.time) - 1
    weather_files = sorted(weather.glob("*"))
    if not weather_files or not np.allclose(
        trajectory.time, site.tau * np.arange(steps + 1), rtol=0, atol=1e-6
    ):
        return None
    try:
        run = build_run(
            site_file, site, read_weather(weather_files, site, method, gaps),
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
