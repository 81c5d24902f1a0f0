"""How sure a difference between two controllers is: all statistics of a report, stated once.

Years are the sample. Within a year hours depend on each other, and so do forecasts of several
seeds on the year's weather; so a year has one value, the mean of its seeds, and whole years are
resampled. Seeds that were drawn again within each year would count their variance twice: a mean
over them has it already.

Each interval is for one comparison alone. Where a table has many, some leave 1 out by chance: with
no difference anywhere, one in twenty does.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 2000
"""of the bootstrap: the ends of its intervals are then sure to some hundredths of their width"""

CONTAINS_1 = "contains 1"
"""the verdict on such an interval"""

_SEED = 1

Array = NDArray[np.float64]


class Ratio(NamedTuple):
    """What one has over another (1), and its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """Whether the interval is below 1, above it, or contains it."""
        if self.low <= 1 <= self.high:
            return CONTAINS_1
        return "better" if self.high < 1 else "worse"


class Deviations:
    """Of a controller in the same season of several years.

    Attributes:
        totals: total deviation of each seed (m3), shape (seeds,), by year.
        weeks: deviation of each week of each seed (m3), shape (seeds, weeks), by year.
    """

    def __init__(self) -> None:
        self.totals: dict[int, Array] = {}
        self.weeks: dict[int, Array] = {}
        self._resampled: dict[tuple[int, ...], tuple[Array, Array]] = {}

    def worst_weeks(self) -> float:
        """Return the mean deviation of the worst tenth of weeks (m3); seeds share their year's."""
        return float(self._of_weeks(tuple(self.weeks), np.ones((1, len(self.weeks))))[0])

    def resampled(self, years: tuple[int, ...]) -> tuple[Array, Array]:
        """Return mean and worst tenth of weeks (m3) of some years, then of each resample."""
        if years not in self._resampled:
            counts = np.vstack((np.ones(len(years)), _draws(len(years))))
            means = counts @ [self.totals[year].mean() for year in years] / len(years)
            self._resampled[years] = means, self._of_weeks(years, counts)
        return self._resampled[years]

    def _of_weeks(self, years: tuple[int, ...], counts: Array) -> Array:
        """Return the worst tenth of weeks where each year counts so often, shape (n, years)."""
        weeks = [self.weeks[year] for year in years]
        place = np.repeat(np.arange(len(years)), [seasons.size for seasons in weeks])
        seeds = np.array(list(map(len, weeks)))
        return _worst_tenths(
            counts[:, place] / seeds[place], np.concatenate(list(map(np.ravel, weeks)))
        )


class Comparison(NamedTuple):
    """What a controller has over another in the same years."""

    difference: float
    """in the total deviation of a season (m3), negative where it has less"""
    mean: Ratio
    """of the total deviation of all seasons"""
    worst_weeks: Ratio
    """of the mean deviation of the worst tenth of weeks"""
    better: int
    """in how many years it had less"""
    years: int
    """in how many both ran"""


def worst_tenth(values: Array) -> float:
    """Return the mean of the largest tenth; of the value at its edge counts the part within.

    A tenth is at least one whole value: of fewer than ten it is the largest.
    """
    return float(_worst_tenths(np.ones((1, values.size)), values)[0])


def _worst_tenths(weights: Array, values: Array) -> Array:
    """Return the worst tenth for each row of weights, shape (n, values)."""
    order = np.argsort(-values)
    often = weights[:, order]
    count = np.maximum(1.0, often.sum(axis=1) / 10)
    worse = np.cumsum(often, axis=1) - often
    within = np.clip(count[:, None] - worse, 0, often)
    means: Array = within @ values[order] / count
    return means


def compare(own: Deviations, other: Deviations) -> Comparison | None:
    """Return what one has over another; None of fewer than two years, or over no deviation."""
    years = tuple(year for year in own.totals if year in other.totals)
    if len(years) < 2:
        return None
    (mean, worst), (others_mean, others_worst) = own.resampled(years), other.resampled(years)
    if not (others_mean.all() and others_worst.all()):
        return None
    return Comparison(
        difference=float(mean[0] - others_mean[0]),
        mean=_ratio(mean / others_mean, len(years)),
        worst_weeks=_ratio(worst / others_worst, len(years)),
        better=sum(bool(own.totals[y].mean() < other.totals[y].mean()) for y in years),
        years=len(years),
    )


@cache
def _draws(years: int) -> Array:
    """Draw as many years with replacement: how often each is in each resample.

    The draws begin again each time, so that a report is the same each time it is made.
    """
    drawn = np.random.default_rng(_SEED).integers(years, size=(years, RESAMPLES))
    counts: Array = (drawn[:, :, None] == np.arange(years)).sum(axis=0).astype(np.float64)
    return counts


def _ratio(ratios: Array, years: int) -> Ratio:
    """Return an estimate with its 95 % interval: its resamples' percentiles, widened.

    The percentiles of few years are too near to the estimate, since the years' spread is measured
    about their own mean, and as if it were known: for eleven years nine of a hundred intervals
    missed a normal mean. They are moved off the estimate by the ratio of Student's interval of a
    mean to theirs,

        t(0.975, n - 1) / z(0.975) sqrt(n / (n - 1))

    That is the correction of the expanded percentile interval: Hesterberg (2015), What Teachers
    Should Know About the Bootstrap, The American Statistician 69(4), 371-386. He takes percentiles
    further out instead, which four years do not have.

    Args:
        ratios: of the years as they are, then of each resample.
        years: n.
    """
    from scipy.special import ndtri, stdtrit  # a fifth of what a report imports; few need it

    value = ratios[0]
    low, high = np.percentile(ratios[1:], [2.5, 97.5])
    wider = stdtrit(years - 1, 0.975) / ndtri(0.975) * np.sqrt(years / (years - 1))
    return Ratio(
        float(value), float(value + wider * (low - value)), float(value + wider * (high - value))
    )
