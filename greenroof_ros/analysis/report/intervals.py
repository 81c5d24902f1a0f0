"""How certain a difference between two controllers is: all statistics of a report.

Years are the sample. Hours within a year depend on each other, and forecasts with several seeds
depend on the same weather. So a year has one value, the mean over its seeds, and whole years are
resampled. Seeds are not resampled within years: that would count their variance twice, because the
mean over them already contains it.

Each interval is for one comparison alone. If a table has many, some exclude 1 by chance: with no
difference anywhere, one in twenty does.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_RESAMPLES = 2000
"""of the bootstrap: enough to know the ends of intervals to some hundredths of their width"""

_SEED = 1

Array = NDArray[np.float64]


class Ratio(NamedTuple):
    """The ratio of one controller's value to another's (1), and its 95 % interval."""

    value: float
    low: float
    high: float


class Deviations:
    """Deviations of a controller in the same season of several years.

    Attributes:
        totals: total deviation of each seed (m3), shape (seeds,), by year.
        weeks: deviation of each week of each seed (m3), shape (seeds, weeks), by year.
    """

    def __init__(self) -> None:
        self.totals: dict[int, Array] = {}
        self.weeks: dict[int, Array] = {}
        self._resampled: dict[tuple[int, ...], tuple[Array, Array]] = {}

    def worst_weeks(self) -> float:
        """Mean deviation of the worst tenth of weeks (m3); seeds share a year's weight."""
        return float(self._of_weeks(tuple(self.weeks), np.ones((1, len(self.weeks))))[0])

    def resampled(self, years: tuple[int, ...]) -> tuple[Array, Array]:
        """Return mean and worst tenth of weeks (m3), each for the years, then for each resample."""
        if years not in self._resampled:
            counts = np.vstack((np.ones(len(years)), _draws(len(years))))
            means = counts @ [self.totals[year].mean() for year in years] / len(years)
            self._resampled[years] = means, self._of_weeks(years, counts)
        return self._resampled[years]

    def _of_weeks(self, years: tuple[int, ...], counts: Array) -> Array:
        """Return the worst tenth of weeks (m3) for each row of ``counts``, shape (n, years)."""
        weeks = [self.weeks[year] for year in years]
        place = np.repeat(np.arange(len(years)), [seasons.size for seasons in weeks])
        seeds = np.array(list(map(len, weeks)))
        return _worst_tenths(
            counts[:, place] / seeds[place], np.concatenate(list(map(np.ravel, weeks)))
        )


class Comparison(NamedTuple):
    """A controller compared with another in the same years."""

    difference: float
    """in the mean total deviation of a season (m3), negative if the controller has less"""
    mean: Ratio
    """ratio of the mean total deviations of a season"""
    worst_weeks: Ratio
    """ratio of the mean deviations of the worst tenth of weeks"""
    better: int
    """number of years in which it had less"""
    years: int
    """number of years in which both ran"""


def worst_tenth(values: Array) -> float:
    """Return the mean of the largest tenth; the value at its edge counts in part.

    A tenth is at least one whole value: with fewer than ten values it is the largest.
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
    """Compare two controllers; None if they share fewer than two years, or a divisor is 0."""
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
    """Return how often each year is in each resample: as many years, drawn with replacement.

    The seed is fixed, so a report is the same each time it is made.
    """
    drawn = np.random.default_rng(_SEED).integers(years, size=(years, _RESAMPLES))
    counts: Array = (drawn[:, :, None] == np.arange(years)).sum(axis=0).astype(np.float64)
    return counts


def _ratio(ratios: Array, years: int) -> Ratio:
    """Return an estimate with its 95 % interval: the percentiles of its resamples, widened.

    With few years the percentiles are too near to the estimate: the years' spread is measured about
    their own mean, and treated as known. With eleven years, nine of a hundred intervals missed a
    normal mean. The distance of the percentiles from the estimate is multiplied by the ratio of
    Student's interval of a mean to the percentile interval,

        t(0.975, n - 1) / z(0.975) sqrt(n / (n - 1))

    This is the correction of the expanded percentile interval: Hesterberg (2015), What Teachers
    Should Know About the Bootstrap, The American Statistician 69(4), 371-386. He uses percentiles
    further out instead, which do not exist for four years. A ratio cannot be negative: a lower end
    below 0 is 0.

    Args:
        ratios: of the original years, then of each resample.
        years: n, the number of years.
    """
    from scipy.special import ndtri, stdtrit  # a fifth of all import time; few reports need it

    value = ratios[0]
    low, high = np.percentile(ratios[1:], [2.5, 97.5])
    wider = stdtrit(years - 1, 0.975) / ndtri(0.975) * np.sqrt(years / (years - 1))
    low, high = value + wider * (low - value), value + wider * (high - value)
    return Ratio(float(value), float(max(0.0, low)), float(high))
