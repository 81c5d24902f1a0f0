"""Runs under forecast errors of many seeds: their mean, and that of the worst tenth.

They are judged by the study's table alone: to read and to draw each of hundreds of trajectories
would take minutes, and show nothing that these numbers do not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from greenroof_ros.forecast.skill import SKILLS
from greenroof_ros.recording.results_table import differing, shortest
from greenroof_ros.report.entries import RunEntry
from greenroof_ros.report.results import NO_ERRORS, Facts, Report, heading


class Place(NamedTuple):
    """What runs of several skills can be compared within."""

    site_name: str
    weather: str
    start: str
    hours: float
    method: str
    model: str
    """of the forecasts"""
    sensor_pump_errors: str
    """of level sensor and pumps; empty where there were none"""
    initial: str

    @property
    def facts(self) -> Facts:
        """What it is but for the initial state, as :func:`.results.heading` takes it."""
        return {
            "site": self.site_name, "weather": self.weather, "start": self.start,
            "length": f"{shortest(self.hours)} h", "evapotranspiration": self.method,
            "forecast": self.model,
            "sensor and pump errors": self.sensor_pump_errors or NO_ERRORS,
        }


@dataclass(frozen=True)
class Spread:
    """The results of a controller with one setting over the seeds.

    Attributes:
        place: where and whence.
        controller: its name.
        setting: what distinguishes it from the controller's others.
        skill: of the forecasts.
        totals: total deviation of each run (m3), the worst first.
        bound_m3: the least that any controller could reach; None if unknown.
    """

    place: Place
    controller: str
    setting: str
    skill: str
    totals: tuple[float, ...]
    bound_m3: float | None

    @property
    def mean(self) -> float:
        """Mean total deviation (m3)."""
        return float(np.mean(self.totals))

    @property
    def worst_tenth(self) -> float:
        """Mean total deviation (m3) of the worst tenth of the runs, rounded down; one at least."""
        return float(np.mean(self.totals[: max(1, len(self.totals) // 10)]))

    @property
    def worst(self) -> float:
        """Largest total deviation (m3)."""
        return self.totals[0]


def place(entry: RunEntry) -> Place:
    """Return where a run under random errors belongs, whatever their skill and seed."""
    assert entry.seeded is not None
    return Place(
        site_name=entry.site_name, weather=entry.weather, start=entry.seeded.start,
        hours=entry.seeded.hours, method=entry.method, model=entry.seeded.model,
        sensor_pump_errors=entry.sensor_pump_errors, initial=entry.initial,
    )


def split_by_seeds(entries: Sequence[RunEntry]) -> tuple[list[RunEntry], list[RunEntry]]:
    """Return the runs that are judged one by one, and those of windows with several seeds."""
    seeds: dict[tuple[Place, str], set[str]] = {}

    def window(entry: RunEntry) -> tuple[Place, str] | None:
        if entry.seeded is None:
            return None
        # A window is for all initial states.
        return place(entry)._replace(initial=""), entry.seeded.skill

    for entry in entries:
        key = window(entry)
        if entry.seeded is not None and key is not None:
            seeds.setdefault(key, set()).add(entry.seeded.seed)
    several = {key for key, found in seeds.items() if len(found) > 1}
    return (
        [entry for entry in entries if window(entry) not in several],
        [entry for entry in entries if window(entry) in several],
    )


def spreads(report: Report) -> list[Spread]:
    """Return the results of the seeded runs, controller by controller, the best forecasts first."""
    groups: dict[tuple[object, ...], list[RunEntry]] = {}
    for entry in report.seeded:
        assert entry.seeded is not None
        key = (
            place(entry), entry.controller, tuple(entry.parameters.items()), entry.seeded.skill,
        )
        groups.setdefault(key, []).append(entry)
    places = list(dict.fromkeys(map(place, report.seeded)))
    skills = best_first(entry.seeded.skill for entry in report.seeded if entry.seeded is not None)

    def order(entries: list[RunEntry]) -> tuple[int, int, int, int]:
        first = entries[0]
        assert first.seeded is not None
        settings = report.settings[first.controller]
        return (
            places.index(place(first)), report.controllers.index(first.controller),
            settings.labels.index(settings.label(first)), skills.index(first.seeded.skill),
        )

    return [_spread(report, entries) for entries in sorted(groups.values(), key=order)]


def seeded_windows(report: Report) -> list[str]:
    """Name the windows of the seeded runs, each with its number of seeds."""
    apart = differing([place(entry).facts for entry in report.seeded])
    seeds: dict[str, set[str]] = {}
    for entry in report.seeded:
        assert entry.seeded is not None
        of = entry.seeded
        facts = place(entry).facts
        facts["forecast"] += f" skill {of.skill}"
        seeds.setdefault(heading(facts, apart), set()).add(of.seed)
    return [f"{window}, {len(found)} seeds" for window, found in seeds.items()]


def best_first(skills: Iterable[str]) -> list[str]:
    """Return different skills, those with a name from the best to the worst, then the files."""
    found = dict.fromkeys(skills)
    named = [name for name in SKILLS if name in found]
    return [*named, *(one for one in found if one not in SKILLS)]


def _spread(report: Report, entries: Sequence[RunEntry]) -> Spread:
    """Sum up the runs that differ in the seed alone."""
    first = entries[0]
    known = [entry.seeded for entry in entries if entry.seeded is not None]
    totals = sorted((one.total_deviation_m3 for one in known), reverse=True)
    setting = report.settings[first.controller].full_label(first) if first.parameters else ""
    bound = next((one.bound_m3 for one in known if one.bound_m3 is not None), None)
    return Spread(
        place=place(first), controller=first.controller, setting=setting, skill=known[0].skill,
        totals=tuple(totals), bound_m3=bound,
    )
