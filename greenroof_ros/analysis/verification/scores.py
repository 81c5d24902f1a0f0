"""Scores of rain forecasts.

The scores are implemented here, in a few lines each. Among the libraries that offer these scores,
``scores`` needs xarray, pandas and bottleneck; ``scoringrules`` needs Python 3.11, and
``properscoring`` had its only release in 2015. The tests compare the scores with worked examples,
closed forms and other methods of computation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def compute_event_scores(
    hits: int, false_alarms: int, misses: int, correct_negatives: int
) -> tuple[float, float, float]:
    """Return POD, FAR and ETS of an event from its contingency table.

    The probability of detection is hits over observed events, the false alarm ratio is false alarms
    over forecast events (Wilks 2011, Sect. 8.2.2). The equitable threat score (Sect. 8.2.3, Gilbert
    skill score) is hits over all events that were forecast or observed, after subtracting the hits
    expected by chance from both:

        (hits - a) / (hits + misses + false alarms - a),
        a = (hits + misses) (hits + false alarms) / n

    ETS is 1 for a perfect forecast, and 0 for a forecast without skill.

    Args:
        hits: number of pairs in which the event was both forecast and observed.
        false_alarms: number of pairs in which the event was forecast but not observed.
        misses: number of pairs in which the event was observed but not forecast.
        correct_negatives: number of pairs without the event.
    """
    observed, forecast = hits + misses, hits + false_alarms
    chance = _ratio(observed * forecast, observed + false_alarms + correct_negatives)
    return (
        _ratio(hits, observed), _ratio(false_alarms, forecast),
        _ratio(hits - chance, observed + false_alarms - chance),
    )


class ForecastScores(NamedTuple):
    """Scores of pairs of forecast and observed sums; NaN if undefined.

    Bias, r, POD, FAR and ETS are scores of member 0, which is the forecast given to controllers
    that use a single member. The Brier score and CRPS are scores of all members.
    """

    n: int
    """number of pairs"""
    bias: float
    """total of the forecasts over the total of the observations"""
    r: float
    """Pearson's correlation"""
    pod: float
    far: float
    ets: float
    brier: float
    """mean squared difference between the event's probability and its outcome, 1 or 0"""
    crps: float
    """mean fair continuous ranked probability score (mm); the mean absolute error of one member"""

    def shown(self, name: str) -> str:
        """Return a score as it is displayed; a dash if it is undefined."""
        value = getattr(self, name)
        return "-" if math.isnan(value) else format(value, SHOWN[name][1])


SHOWN = {
    "n": ("n", "d"), "bias": ("bias", ".2f"), "r": ("r", ".2f"), "pod": ("POD", ".2f"),
    "far": ("FAR", ".2f"), "ets": ("ETS", ".2f"), "brier": ("Brier", ".3f"),
    "crps": ("CRPS mm", ".3f"),
}
"""heading and format of every score"""


class Tally:
    """Sums that suffice for all scores, so that memory does not grow with the number of pairs.

    Attributes:
        table: counts of hits, false alarms, misses and correct negatives, shape (4,).
    """

    def __init__(self, event: float) -> None:
        """Start without pairs; an event is a sum of at least ``event`` (mm)."""
        self._event = event
        self._moments = np.zeros(5)
        self._errors = np.zeros(2)
        self.table = np.zeros(4, dtype=np.int64)

    def add(self, forecast: Array, observed: Array) -> None:
        """Add pairs of sums.

        Args:
            forecast: forecast sums (mm), shape (members, pairs); a pair with NaN is left out.
            observed: observed sums (mm), shape (pairs,); a pair with NaN is left out.
        """
        known = ~(np.isnan(observed) | np.isnan(forecast).any(axis=0))
        forecast, observed = forecast[:, known], observed[known]
        single = forecast[0]
        self._moments += [
            np.sum(term)
            for term in (single, observed, single**2, observed**2, single * observed)
        ]
        event, warned = observed >= self._event, single >= self._event
        self.table += [
            np.count_nonzero(cases)
            for cases in (event & warned, ~event & warned, event & ~warned, ~event & ~warned)
        ]
        probability = np.mean(forecast >= self._event, axis=0)
        self._errors += [np.sum((probability - event) ** 2), np.sum(crps(forecast, observed))]

    def scores(self) -> ForecastScores:
        """Return the scores of all pairs added so far."""
        n = int(self.table.sum())
        if not n:
            return ForecastScores(0, *[math.nan] * 7)
        forecast, observed, forecast_2, observed_2, product = self._moments / n
        variances = (forecast_2 - forecast**2) * (observed_2 - observed**2)
        # The variance of a constant series is only rounding error.
        varies = variances > 1e-12 * (forecast_2 * observed_2)
        r = (product - forecast * observed) / math.sqrt(variances) if varies else math.nan
        brier, error = (self._errors / n).tolist()
        return ForecastScores(
            n, _ratio(forecast, observed), float(r), *compute_event_scores(*self.table.tolist()),
            brier, error,
        )


def crps(forecast: Array, observed: Array) -> Array:
    """Return the fair continuous ranked probability score of every pair (mm).

    The score is the integral over x of the squared difference between the members' distribution and
    the observation's step function (Hersbach 2000, Eq. 1). For M members x_i and the observation y,
    the fair score is

        sum_i |x_i - y| / M - sum_ij |x_i - x_j| / (2 M (M - 1))

    (Ferro 2014, doi:10.1002/qj.2270). Its mean is the CRPS of infinitely many members, so ensembles
    of different sizes can be compared. With one member it is the absolute error, so single
    forecasts can be compared, too. The second sum is computed from the sorted members x_(1) to
    x_(M) as 2 sum_i (2 i - M - 1) x_(i).

    Args:
        forecast: forecast sums (mm), shape (members, pairs).
        observed: observed sums (mm), shape (pairs,).
    """
    members = len(forecast)
    errors = np.mean(np.abs(forecast - observed), axis=0)
    spread = np.arange(1.0 - members, members, 2.0) @ np.sort(forecast, axis=0)
    score: Array = errors - spread / max(members * (members - 1), 1)
    return score


def _ratio(part: float, whole: float) -> float:
    """Return a ratio; NaN if the denominator is 0."""
    return float(part / whole) if whole else math.nan
