"""The same season in several years: means, the worst of them, and differences that are no luck.

They are judged by the study's table alone, as runs of many seeds are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.forecast.skill import SKILLS
from greenroof_ros.model.site import Site
from greenroof_ros.recording.results_table import shortest
from greenroof_ros.report.entries import RunEntry, Season
from greenroof_ros.report.results import NO_ERRORS, Facts, Report

RESAMPLES = 2000
"""of the bootstrap: the ends of its intervals are then sure to some hundredths of their width"""

# What all others are held against.
_REFERENCE = "onoff"
_SEED = 1

Array = NDArray[np.float64]


class Place(NamedTuple):
    """What seasons of several years can be compared within."""

    site_name: str
    method: str
    begins: str
    hours: float
    sensor_pump_errors: str
    """of level sensor and pumps; empty where there were none"""
    initial: str

    @property
    def facts(self) -> Facts:
        """What it is, as :func:`greenroof_ros.report.results.heading` takes it."""
        return {
            "site": self.site_name, "from": self.initial, "begins": self.begins,
            "length": f"{shortest(self.hours)} h", "evapotranspiration": self.method,
            "sensor and pump errors": self.sensor_pump_errors or NO_ERRORS,
        }


def _season(entry: RunEntry) -> Season:
    assert entry.season is not None
    return entry.season


def _place(entry: RunEntry) -> Place:
    season = _season(entry)
    return Place(
        entry.site_name, entry.method, season.begins, season.hours, entry.sensor_pump_errors,
        entry.initial,
    )


def split_by_years(entries: Sequence[RunEntry]) -> tuple[list[RunEntry], list[RunEntry]]:
    """Return the runs that are judged otherwise, and those of the same season in several years."""
    years: dict[Place, set[int]] = {}
    for entry in entries:
        if entry.season is not None:
            years.setdefault(_place(entry), set()).add(entry.season.year)
    seasons = [
        entry for entry in entries
        if entry.season is not None and len(years[_place(entry)]) > 1
    ]
    names = {entry.name for entry in seasons}
    return [entry for entry in entries if entry.name not in names], seasons


@dataclass(frozen=True)
class Seasons:
    """A controller with one setting and one kind of forecasts, over years and seeds.

    Attributes:
        place: where.
        site: Table I.
        controller: its name.
        setting: what distinguishes it from the controller's others.
        forecast: without the seed of its errors.
        years: the runs of each year, in the order of their seeds.
    """

    place: Place
    site: Site
    controller: str
    setting: str
    forecast: str
    years: dict[int, tuple[Season, ...]]

    def of_years(self, metric: str) -> dict[int, float]:
        """Return the mean of a metric over the seeds, by year."""
        return {
            year: float(np.mean([run.metrics.get(metric, 0.0) for run in runs]))
            for year, runs in self.years.items()
        }

    def mean(self, metric: str) -> float:
        """Return the mean of a metric over the years."""
        return float(np.mean(list(self.of_years(metric).values())))

    @property
    def seeds(self) -> int:
        """The most that a year has; 1 where forecasts have none."""
        return max(len(runs) for runs in self.years.values())

    @property
    def worst_year(self) -> int:
        """In which the deviation was largest."""
        totals = self.of_years("total_deviation_m3")
        return max(totals, key=totals.__getitem__)

    @property
    def worst_weeks(self) -> float:
        """Mean deviation of the worst tenth of weeks, of all years and seeds (m3)."""
        return worst_tenth(np.concatenate([self.weeks(year).ravel() for year in self.years]))

    @property
    def ratio_to_bound(self) -> float | None:
        """Deviation of all years over the least possible; None where that is unknown, or 0."""
        bounds = [runs[0].bound_m3 for runs in self.years.values()]
        known = [bound for bound in bounds if bound]
        if len(known) < len(bounds):
            return None
        return sum(self.of_years("total_deviation_m3").values()) / sum(known)

    def totals(self, year: int) -> Array:
        """Return the total deviation of each seed (m3), shape (seeds,)."""
        return np.array([run.metrics["total_deviation_m3"] for run in self.years[year]])

    def weeks(self, year: int) -> Array:
        """Return the deviation of each week of each seed (m3), shape (seeds, weeks)."""
        return np.array([run.weeks for run in self.years[year]])


def worst_tenth(values: Array) -> float:
    """Return the mean of the largest tenth, rounded down to whole values, at least one."""
    count = max(1, len(values) // 10)
    return float(np.partition(values, -count)[-count:].mean())


def seasons(report: Report) -> list[Seasons]:
    """Return the seasons of a report, place by place, in the order of its controllers."""
    groups: dict[tuple[Place, str, str, str], list[RunEntry]] = {}
    for entry in report.seasons:
        setting = report.settings[entry.controller].full_label(entry) if entry.parameters else ""
        key = (_place(entry), entry.controller, setting, _season(entry).forecast)
        groups.setdefault(key, []).append(entry)
    places = list(dict.fromkeys(map(_place, report.seasons)))

    def order(key: tuple[Place, str, str, str]) -> tuple[int, int, str, int]:
        place, controller, setting, forecast = key
        known = [number for number, skill in enumerate(SKILLS) if skill in forecast.split()]
        return (
            places.index(place), report.controllers.index(controller), setting,
            known[0] if known else -1,
        )

    found = []
    for key in sorted(groups, key=order):
        years: dict[int, list[Season]] = {}
        for entry in groups[key]:
            years.setdefault(_season(entry).year, []).append(_season(entry))
        place, controller, setting, forecast = key
        found.append(Seasons(
            place, groups[key][0].site, controller, setting, forecast,
            {year: tuple(sorted(years[year], key=_by_seed)) for year in sorted(years)},
        ))
    return found


def _by_seed(season: Season) -> tuple[int, str]:
    return len(season.seed), season.seed


class Interval(NamedTuple):
    """An estimate, and between what it is with a probability of 95 %."""

    value: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """Whether less is no luck."""
        if self.low <= 0 <= self.high:
            return "may be luck"
        return "better" if self.high < 0 else "worse"


@dataclass(frozen=True)
class Difference:
    """What a controller has less (negative) or more than on/off in the same years.

    Attributes:
        of: the controller.
        mean: of the total deviation of a season (m3).
        share: the same as a share of that of on/off (1).
        worst_weeks: of the mean deviation of the worst tenth of weeks (m3).
        better: in how many years it had less.
        years: in how many both ran.
    """

    of: Seasons
    mean: Interval
    share: float
    worst_weeks: Interval
    better: int
    years: int


def differences(found: Sequence[Seasons]) -> Iterator[Difference]:
    """Yield the difference of each to the first on/off of its place; none where there is none."""
    references: dict[Place, Seasons] = {}
    for one in found:
        if one.controller == _REFERENCE:
            references.setdefault(one.place, one)
    for one in found:
        reference = references.get(one.place)
        if reference is None or one is reference:
            continue
        years = [year for year in one.years if year in reference.years]
        if len(years) < 2:
            continue
        theirs = {year: reference.totals(year).mean() for year in years}
        less = [one.totals(year) - theirs[year] for year in years]
        means = [float(each.mean()) for each in less]
        mean = _interval([len(each) for each in less], partial(_mean, less))
        weeks = [(one.weeks(year), reference.weeks(year)) for year in years]
        worst = _interval([len(own) for own, _ in weeks], partial(_worst_weeks, weeks))
        yield Difference(
            of=one, mean=mean, share=mean.value / float(np.mean(list(theirs.values()))),
            worst_weeks=worst, better=sum(each < 0 for each in means), years=len(years),
        )


Drawn = list[tuple[int, NDArray[np.intp]]]
"""the place of each year that was drawn, and which of its seeds"""


def _mean(years: Sequence[Array], drawn: Drawn) -> float:
    """Return the mean over the years drawn, of each over its seeds."""
    return float(np.mean([years[place][seeds].mean() for place, seeds in drawn]))


def _worst_weeks(years: Sequence[tuple[Array, Array]], drawn: Drawn) -> float:
    """Return by how much the worst tenth of one's weeks is above that of the other's."""
    own = [years[place][0][seeds].ravel() for place, seeds in drawn]
    others = [years[place][1].ravel() for place, _ in drawn]
    return worst_tenth(np.concatenate(own)) - worst_tenth(np.concatenate(others))


def _interval(seeds: Sequence[int], statistic: Callable[[Drawn], float]) -> Interval:
    """Return a statistic with its 95 % interval, by a percentile bootstrap in two stages.

    Years are drawn with replacement, and for each its seeds: Davison and Hinkley, Bootstrap
    Methods and their Application (1997), section 3.8. The draws begin anew each time, so that a
    report is the same each time it is made.

    Args:
        seeds: how many each year has.
        statistic: of years and seeds.
    """
    random = np.random.default_rng(_SEED)
    values = [
        statistic([
            (int(place), random.integers(seeds[place], size=seeds[place]))
            for place in random.integers(len(seeds), size=len(seeds))
        ])
        for _ in range(RESAMPLES)
    ]
    low, high = np.percentile(values, [2.5, 97.5])
    whole = statistic([(place, np.arange(count)) for place, count in enumerate(seeds)])
    return Interval(whole, float(low), float(high))
