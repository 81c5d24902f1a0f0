"""Inputs of the runs: sites, the gauge's rain, and forecasts as they were issued."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from greenroof_ros.common.files import shared_directory
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.formats.records import Archive
from greenroof_ros.model.site import Site, edited, read_site


@dataclass(frozen=True)
class Roof:
    """A site file of ``config/``, and the target level (m) that the controllers hold."""

    file: str
    target: float


# At the paper's target; and the Neubrandenburg roof at the target of its own site file.
ROOFS = {
    "measured": Roof("site_catchment.yaml", 0.0457),
    "measured, target 39 mm": Roof("site_catchment.yaml", 0.039),
    "paper": Roof("site.yaml", 0.0457),
}
_MAINS = {"mains_level": 0.85, "mains_flow": 5e-4}
_TICK_S = 60.0

SERVICES = {"GEM": "gem_global", "KNMI": "knmi_seamless", "GFS": "gfs_seamless"}
# The fifth day of GFS has half the water of its fourth: an error of the archive.
_HOURS_OF = {"GFS": 96}
NO_RAIN, TOGETHER = "no rain", "the three as one"


def write_inputs(archives: Path, directory: Path) -> None:
    """Write the sites and the weather of the runs, which :mod:`real_seasons.runs` reads."""
    for roof in ROOFS:
        file = shared_directory() / "config" / ROOFS[roof].file
        mains = {} if read_site(file).mains_level is not None else _MAINS
        values = {"tau": _TICK_S, "M": 1, "z_veg": ROOFS[roof].target, **mains}
        site_file(directory, roof).write_text(edited(file, values), encoding="utf-8")
    site = read_site(site_file(directory, "measured"))
    weather_file(directory).write_text(_weather(archives / "gauge_2024.csv", site), "utf-8")


def site_file(directory: Path, roof: str) -> Path:
    """Return the site file of a roof: with ticks of a minute, and with mains."""
    return directory / (re.sub(r"\W+", "_", roof) + ".yaml")


def weather_file(directory: Path) -> Path:
    """Return the weather file of all runs."""
    return directory / "gauge.csv"


def _weather(file: Path, site: Site) -> str:
    """Return the gauge's rain with assumed evapotranspiration.

    That is the site file's monthly mean as a half sine over the day, which begins at 05:00 UTC.
    """
    monthly = site.monthly_evapotranspiration
    assert monthly is not None
    lines = ["time,precipitation [mm/h],assumed evapotranspiration [mm/day]"]
    with file.open(encoding="utf-8", newline="") as stream:
        for text, rain in list(csv.reader(stream))[1:]:
            time = datetime.fromisoformat(text).replace(tzinfo=timezone.utc)
            sun = math.pi * max(0.0, math.sin(math.pi * (time.hour + 0.5 - 5) / 12))
            lines.append(f"{time.isoformat()},{rain},{monthly[time.month - 1] * sun:.4f}")
    return "\n".join([*lines, ""])


def read_issued(archives: Path, site: Site, forecast: str) -> Archive:
    """Return the issues of a service, of the three as one ensemble, or of no rain."""
    if forecast == TOGETHER:
        return together([read_issued(archives, site, service) for service in SERVICES])
    service = "GEM" if forecast == NO_RAIN else forecast
    archive = read_archive(archives / f"{SERVICES[service]}_previous_runs.csv", site)
    share = 0.0 if forecast == NO_RAIN else 1.0
    return replace(archive, issues=tuple(
        replace(issue, rain=share * issue.rain[:, : _HOURS_OF.get(service, issue.hours)])
        for issue in archive.issues
    ))


def together(archives: Sequence[Archive]) -> Archive:
    """Return the issues that all archives have as one ensemble, cut to the shortest of them."""
    by_time = [{issue.issued: issue for issue in archive.issues} for archive in archives]
    issues = []
    for time in sorted(set.intersection(*map(set, by_time))):
        of_time = [issues_of[time] for issues_of in by_time]
        hours = min(issue.hours for issue in of_time)
        rain = np.vstack([issue.rain[:, :hours] for issue in of_time])
        issues.append(replace(of_time[0], rain=rain))
    return replace(archives[0], issues=tuple(issues))
