"""The same season in several years: means, the worst of them, and ratios that are no luck.

They are judged by the study's table alone, as runs of many seeds are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.forecast.skill import SKILLS
from greenroof_ros.model.site import Site
from greenroof_ros.recording.results_table import shortest
from greenroof_ros.report.entries import Parameters, RunEntry, Season
from greenroof_ros.report.results import NO_ERRORS, Facts, Report

RESAMPLES = 2000
"""of the bootstrap: the ends of its intervals are then sure to some hundredths of their width"""

MAY_BE_LUCK = "may be luck"
"""the verdict on an interval that holds 1"""

_SEED = 1

Array = NDArray[np.float64]
Counts = NDArray[np.int32]


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
        parameters: its own; no entry where it is not known, or there is no bound.
        forecast: without the seed of its errors.
        years: the runs of each year, in the order of their seeds.
    """

    place: Place
    site: Site
    controller: str
    setting: str
    parameters: Parameters
    forecast: str
    years: dict[int, tuple[Season, ...]]

    def of_years(self, metric: str) -> dict[int, float]:
        """Return the mean of a metric over the seeds, by year; of those that have it."""
        known = {
            year: [run.metrics[metric] for run in runs if metric in run.metrics]
            for year, runs in self.years.items()
        }
        return {year: float(np.mean(values)) for year, values in known.items() if values}

    def mean(self, metric: str) -> float:
        """Return the mean of a metric over the years that have it; 0 where none has."""
        return float(np.mean(list(self.of_years(metric).values()) or 0.0))

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
    """Return the mean of the largest tenth; of the value at its edge counts the part within.

    Of fewer than ten values it is the largest. Rounded to whole values, a tenth of one year's
    weeks would be less than a tenth of those of ten seeds.
    """
    one_run = np.ones((1, 1), dtype=np.int32)
    return float(_worst_tenths(one_run, values[None, :])[0])


def seasons(report: Report) -> list[Seasons]:
    """Return the seasons of a report, place by place, in the order of its controllers."""
    groups: dict[tuple[Place, str, str, str], list[RunEntry]] = {}
    for entry in report.seasons:
        setting = report.settings[entry.controller].full_label(entry) if entry.parameters else ""
        key = (_place(entry), entry.controller, setting, _season(entry).forecast)
        groups.setdefault(key, []).append(entry)
    places = list(dict.fromkeys(map(_place, report.seasons)))

    def order(key: tuple[Place, str, str, str]) -> tuple[int, int, int, int]:
        place, controller, _, forecast = key
        settings = report.settings[controller]
        known = [number for number, skill in enumerate(SKILLS) if skill in forecast.split()]
        return (
            places.index(place), report.controllers.index(controller),
            settings.labels.index(settings.label(groups[key][0])), known[0] if known else -1,
        )

    found = []
    for key in sorted(groups, key=order):
        years: dict[int, list[Season]] = {}
        for entry in groups[key]:
            years.setdefault(_season(entry).year, []).append(_season(entry))
        place, controller, setting, forecast = key
        found.append(Seasons(
            place, groups[key][0].site, controller, setting, groups[key][0].parameters, forecast,
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
        """Whether a ratio below 1 is no luck."""
        if self.low <= 1 <= self.high:
            return MAY_BE_LUCK
        return "better" if self.high < 1 else "worse"


@dataclass(frozen=True)
class Comparison:
    """What a controller has over another in the same years.

    Attributes:
        of: the controller.
        than: the other.
        difference: in the total deviation of a season (m3), negative where it has less.
        mean: the total deviation of all seasons over that of the other (1).
        worst_weeks: the mean deviation of the worst tenth of weeks over that of the other (1).
        better: in how many years it had less.
        years: in how many both ran.
    """

    of: Seasons
    than: Seasons
    difference: float
    mean: Interval
    worst_weeks: Interval
    better: int
    years: int


def plain_onoff(found: Sequence[Seasons]) -> dict[Place, Seasons]:
    """Return in each place the on/off that fills to the target, as the paper's does.

    Of several with a share of the flow each, it is the one with the least mean deviation: in ticks
    of some seconds full flow goes beyond the target, which no site would have.
    """
    (level,) = (each.default for each in OnOff.parameters if each.name == "level")
    return _least(
        one for one in found
        if one.controller == "onoff" and one.parameters.get("level", level) == level
    )


def least_deviation(found: Sequence[Seasons]) -> dict[Place, Seasons]:
    """Return in each place the controller with the least mean deviation that a site could have.

    One that was given perfect forecasts is none, unless no forecasts in the report have errors.
    """
    looking = given_errors(found)

    def foreseeing(one: Seasons) -> bool:
        looks = one.controller in looking or "horizon" in one.parameters
        return bool(looking) and one.forecast == PERFECT and looks

    return _least(one for one in found if not foreseeing(one))


def _least(found: Iterable[Seasons]) -> dict[Place, Seasons]:
    """Return in each place the one with the least mean deviation."""
    least: dict[Place, Seasons] = {}
    for one in found:
        metric = "total_deviation_m3"
        if one.place not in least or one.mean(metric) < least[one.place].mean(metric):
            least[one.place] = one
    return least


def given_errors(found: Sequence[Seasons]) -> set[str]:
    """Return the controllers that ran with forecasts that are not perfect.

    Another beside them may look at none, as on/off does: it stands for itself with all of them.
    """
    return {one.controller for one in found if one.forecast != PERFECT}


def comparisons(
    found: Sequence[Seasons], references: Mapping[Place, Seasons]
) -> Iterator[Comparison]:
    """Yield what each has over another in its place.

    Args:
        found: the seasons.
        references: the other, in each place; where there is none, or none of the years has any
            deviation, nothing is compared.
    """
    for one in found:
        reference = references.get(one.place)
        if reference is None or one is reference:
            continue
        years = [year for year in one.years if year in reference.years]
        if len(years) < 2:
            continue
        own, other = _resampled(one, years), _resampled(reference, years)
        if not (other.means.all() and other.worst.all()):
            continue
        yield Comparison(
            of=one,
            than=reference,
            difference=own.mean - other.mean,
            mean=_interval(own.mean / other.mean, own.means / other.means, len(years)),
            worst_weeks=_interval(
                own.worst_weeks / other.worst_weeks, own.worst / other.worst, len(years)
            ),
            better=sum(one.totals(year).mean() < reference.totals(year).mean() for year in years),
            years=len(years),
        )


class _Resampled(NamedTuple):
    """Mean deviation of years and of their worst tenth of weeks (m3), and in each resample."""

    mean: float
    worst_weeks: float
    means: Array
    worst: Array


def _resampled(one: Seasons, years: Sequence[int]) -> _Resampled:
    totals = [one.totals(year) for year in years]
    weeks = np.concatenate([one.weeks(year) for year in years])
    runs = _draws(tuple(len(each) for each in totals))
    share_of_mean = np.concatenate([each / len(each) for each in totals]) / len(years)
    return _Resampled(
        float(np.mean([each.mean() for each in totals])), worst_tenth(weeks.ravel()),
        runs @ share_of_mean, _worst_tenths(runs, weeks),
    )


@cache
def _draws(seeds: tuple[int, ...]) -> Counts:
    """Draw years with replacement, and for each year drawn as many of its seeds as it has.

    A bootstrap in two stages: Davison and Hinkley, Bootstrap Methods and their Application (1997),
    section 3.8. The draws begin anew each time, so that a report is the same each time it is made.
    The years drawn are the same for all; so are the seeds for two that have as many, which
    were given the same forecasts by them. Others' are drawn each for itself.

    Args:
        seeds: how many each year has.

    Returns:
        How often each run, in the order of years and seeds, is in each resample, shape
        (RESAMPLES, runs).
    """
    years = np.random.default_rng(_SEED).integers(len(seeds), size=(len(seeds), RESAMPLES))
    random = np.random.default_rng([_SEED, *seeds])
    counts = np.array(seeds)
    first = np.cumsum(counts) - counts
    resample = np.arange(RESAMPLES)
    runs = np.zeros((RESAMPLES, counts.sum()), dtype=np.int32)
    for year in years:
        for seed in range(max(seeds)):
            run = first[year] + random.integers(counts[year])
            drawn = seed < counts[year]
            runs[resample[drawn], run[drawn]] += 1
    return runs


def _worst_tenths(runs: Counts, weeks: Array) -> Array:
    """Return the mean of the worst tenth of the weeks of each resample.

    Args:
        runs: how often each is in each resample, shape (resamples, runs).
        weeks: of each run, shape (runs, weeks).
    """
    order = np.argsort(-weeks, axis=None)
    often = runs[:, order // weeks.shape[1]]
    count = np.maximum(1.0, often.sum(axis=1) / 10)
    worse = np.cumsum(often, axis=1, dtype=np.int32) - often
    taken = np.clip(count[:, None] - worse, 0, often)
    means: Array = taken @ weeks.ravel()[order] / count
    return means


def _interval(value: float, resampled: Array, years: int) -> Interval:
    """Return an estimate with its 95 % interval: its resamples' percentiles, widened.

    The percentiles of few years are too near to the estimate, since the years' spread is taken
    about their own mean, and as if it were known: for eleven years nine of a hundred intervals
    missed a normal mean. They are moved off the estimate by the ratio of Student's interval of a
    mean to theirs,

        t(0.975, n - 1) / z(0.975) sqrt(n / (n - 1))

    That is the correction of the expanded percentile interval: Hesterberg (2015), What Teachers
    Should Know About the Bootstrap, The American Statistician 69(4), 371-386. He takes percentiles
    further out instead, which four years do not have.

    Args:
        value: the estimate.
        resampled: of each resample.
        years: n.
    """
    from scipy.special import ndtri, stdtrit  # a fifth of what a report imports; few need it

    low, high = np.percentile(resampled, [2.5, 97.5])
    wider = stdtrit(years - 1, 0.975) / ndtri(0.975) * np.sqrt(years / (years - 1))
    return Interval(
        value, float(value + wider * (low - value)), float(value + wider * (high - value))
    )
