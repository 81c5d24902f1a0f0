"""Depths of rain by duration and return period, from the annual maxima of a record.

Gumbel's distribution is fitted by the method of moments, as in the tables of Environment and
Climate Change Canada.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gumbel_r

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.weather.records import Records

Values = NDArray[np.float64]

# Durations (min), those of Environment and Climate Change Canada.
_DURATIONS = 5, 10, 15, 30, 60, 120, 360, 720, 1440
# Minimum share of a year for which rain must be known, and minimum number of such years [assumed].
_ENOUGH, _MIN_YEARS = 0.9, 5


def fit_record(records: Records, periods: Sequence[float]) -> tuple[Values, Values, str]:
    """Return durations (min), depths (mm) of shape (durations, periods), and a note on their fit.

    Args:
        records: a record of rain.
        periods: return periods (years).

    Raises:
        ConfigurationError: if rain is known in fewer than five years.
    """
    rain = records.finest_rain
    size = 60 // rain.shape[1]
    changes = np.flatnonzero(np.diff(np.nan_to_num(rain, nan=-1.0), axis=1).any(axis=0))
    step = size * math.gcd(rain.shape[1], *(1 + changes).tolist())
    first = np.datetime64(records.first.replace(tzinfo=None), "h")
    years = (first + np.arange(records.hours)).astype("datetime64[Y]")
    least = _ENOUGH * 8760 * rain.shape[1]
    there = {year: (~np.isnan(rain[years == year])).sum() for year in np.unique(years)}
    known = [year for year in there if there[year] >= least]
    if (count := len(known)) < _MIN_YEARS:
        expected = f"must have {_MIN_YEARS} years with rain for {_ENOUGH:.0%} of the time"
        raise ConfigurationError(f"{expected}, but has {count}", file=records.source)
    total = np.append(0.0, np.cumsum(np.nan_to_num(rain) * size / 60))
    durations, of_sum = [each for each in _DURATIONS if each >= step], np.repeat(years, 60 // size)
    maxima = np.array([[
        (total[width:] - total[:-width])[of_sum[: len(total) - width] == year].max()
        for year in known
    ] for width in np.array(durations) // size])
    return np.array(durations, float), fit_gumbel(maxima, periods), (
        f"{records.source}: Gumbel's distribution, fitted by moments to the annual maxima of "
        f"{count} years, {known[0]} to {known[-1]}, in steps of {step} min. The largest sum over "
        f"{durations[0]} min is {maxima[0].max():.1f} mm. By Weibull's plotting position, "
        f"m / ({count} + 1), it has a return period of {count + 1} years; longer ones are "
        f"extrapolated. Sums over {step} min begin at fixed times, and are lower "
        "than those that begin at any time, by about an eighth"
    )


def fit_gumbel(maxima: Values, periods: Sequence[float]) -> Values:
    """Return the depths of return periods, shape (durations, periods).

    Args:
        maxima: annual maxima, shape (durations, years).
        periods: return periods (years).
    """
    scale = maxima.std(axis=1, ddof=1, keepdims=True) * math.sqrt(6) / math.pi
    place = maxima.mean(axis=1, keepdims=True) - np.euler_gamma * scale
    return np.asarray(gumbel_r.isf(1 / np.array(periods), place, scale))
