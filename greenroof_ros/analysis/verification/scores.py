"""Scores of rain forecasts.

The scores are implemented here, in a few lines each. Among the libraries that offer these scores,
``scores`` needs xarray, pandas and bottleneck; ``scoringrules`` needs Python 3.11, and
``properscoring`` had its only release in 2015. The tests compare the scores with worked examples,
closed forms and other methods of computation.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCORES = {
    "n": ("n", "d"), "bias": ("bias", ".2f"), "r": ("r", ".2f"), "pod": ("POD", ".2f"),
    "far": ("FAR", ".2f"), "ets": ("ETS", ".2f"), "brier": ("Brier", ".3f"),
    "crps_mm": ("CRPS mm", ".3f"),
}
"""heading and format of every score"""


def score_pairs(forecast: Array, observed: Array, event: float) -> dict[str, float]:
    """Return the scores of pairs of forecast and observed sums, by name; NaN if undefined.

    The scores are the number of pairs (``n``), the total of the forecasts over that of the
    observations (``bias``), Pearson's correlation (``r``), three scores of events (Wilks 2011,
    Sect. 8.2), the mean squared difference between the event's probability and its outcome, 1 or 0
    (``brier``), and the mean of :func:`crps` (``crps_mm``). The Brier score and the CRPS are scores
    of all members. The others are scores of member 0, which is the forecast given to controllers
    that use a single member.

    The probability of detection (``pod``) is hits over observed events, the false alarm ratio
    (``far``) is false alarms over forecast events. The equitable threat score (``ets``, Gilbert
    skill score) is hits over all events that were forecast or observed, after subtracting the hits
    expected by chance from both: (hits - a) / (observed + forecast - hits - a), where a is observed
    events times forecast events over pairs. It is 1 for a perfect forecast, and 0 for a forecast
    without skill.

    Args:
        forecast: forecast sums (mm), shape (members, pairs); a pair with NaN is left out.
        observed: observed sums (mm), shape (pairs,); a pair with NaN is left out.
        event: minimum sum of an event (mm).
    """
    known = ~(np.isnan(observed) | np.isnan(forecast).any(axis=0))
    forecast, observed = forecast[:, known], observed[known]
    if not observed.size:
        return dict.fromkeys(SCORES, math.nan) | {"n": 0}
    single = forecast[0]
    varies = np.ptp(single) > 0 and np.ptp(observed) > 0
    fell, warned = observed >= event, single >= event
    events, alarms, hits = (int(each.sum()) for each in (fell, warned, fell & warned))
    chance = events * alarms / observed.size
    probability = np.mean(forecast >= event, axis=0)
    return {
        "n": observed.size, "bias": _ratio(single.sum(), observed.sum()),
        "r": float(np.corrcoef(single, observed)[0, 1]) if varies else math.nan,
        "pod": _ratio(hits, events), "far": _ratio(alarms - hits, alarms),
        "ets": _ratio(hits - chance, events + alarms - hits - chance),
        "brier": float(np.mean((probability - fell) ** 2)),
        "crps_mm": float(np.mean(crps(forecast, observed))),
    }


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
