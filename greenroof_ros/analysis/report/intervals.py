"""The statistics of a report: the uncertainty of the difference between two controllers.

The years form the sample. Hours within a year depend on each other, and forecasts with several
seeds depend on the same weather. Therefore, each year contributes one value, the mean over its
seeds, and whole years are resampled. Seeds are not resampled within years, because this would count
their variance twice: the mean over the seeds already contains it.

Each interval is valid only for a single comparison. If a table contains many intervals, some
exclude 1 by chance: even if there are no differences at all, one interval in twenty does.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_RESAMPLES = 2000
"""number of bootstrap resamples, which determine the ends of intervals to some hundredths of their
width"""

_SEED = 1

Array = NDArray[np.float64]


class Ratio(NamedTuple):
    """The ratio of one controller's value to another's (1), and its 95 % interval."""

    value: float
    low: float
    high: float


class SeasonComparison(NamedTuple):
    """A controller compared with another in the same years."""

    difference: float
    """difference between the mean total deviations of a season (m3), negative if the controller
    deviates less"""
    mean: Ratio
    """ratio of the mean total deviations of a season"""
    better: int
    """number of years in which the controller deviated less"""
    years: int
    """number of years in which both ran"""


def compare(own: Mapping[int, Array], other: Mapping[int, Array]) -> SeasonComparison | None:
    """Compare two controllers in one season of several years.

    Args:
        own: total deviation of every seed (m3), shape (seeds,), by year.
        other: the same of the other controller.

    Returns:
        The comparison; None if they share fewer than two years, or a divisor is 0.
    """
    years = [year for year in own if year in other]
    means, others = (np.array([of[year].mean() for year in years]) for of in (own, other))
    counts = np.vstack((np.ones(len(years)), _draws(len(years))))
    if len(years) < 2 or not (counts @ others).all():
        return None
    return SeasonComparison(
        difference=float(np.mean(means - others)),
        mean=_ratio(counts @ means / (counts @ others), len(years)),
        better=int((means < others).sum()),
        years=len(years),
    )


@cache
def _draws(years: int) -> Array:
    """Return the number of times that each year occurs in each resample.

    Years are drawn with replacement. The seed is fixed, so the same runs always yield the same
    report.
    """
    drawn = np.random.default_rng(_SEED).integers(years, size=(years, _RESAMPLES))
    counts: Array = (drawn[:, :, None] == np.arange(years)).sum(axis=0).astype(np.float64)
    return counts


def _ratio(ratios: Array, years: int) -> Ratio:
    """Return an estimate with its 95 % interval, the widened percentiles of its resamples.

    With few years, the percentiles are too close to the estimate, because the spread of the years
    is measured about their own mean, and treated as known. With eleven years, nine of a hundred
    intervals missed the mean of a normal distribution. Therefore, the distance of the percentiles
    from the estimate is multiplied by the ratio of Student's interval of a mean to the percentile
    interval,

        t(0.975, n - 1) / z(0.975) sqrt(n / (n - 1))

    This is the correction of the expanded percentile interval: Hesterberg (2015), What Teachers
    Should Know About the Bootstrap, The American Statistician 69(4), 371-386. Hesterberg uses more
    extreme percentiles instead, which do not exist for four years. A ratio cannot be negative: a
    lower end below 0 becomes 0.

    Args:
        ratios: ratio of the original years, followed by those of the resamples.
        years: n, the number of years.
    """
    from scipy.special import ndtri, stdtrit  # a fifth of the import time; few reports need it

    value = ratios[0]
    low, high = np.percentile(ratios[1:], [2.5, 97.5])
    wider = stdtrit(years - 1, 0.975) / ndtri(0.975) * np.sqrt(years / (years - 1))
    low, high = value + wider * (low - value), value + wider * (high - value)
    return Ratio(float(value), float(max(0.0, low)), float(high))
