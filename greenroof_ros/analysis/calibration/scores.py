"""Scores for the agreement of a simulated series with a measured one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.calibration.record import COMBINE
from greenroof_ros.analysis.calibration.step_record import DAY_S, HOUR_S, Values


class FitScores(NamedTuple):
    """The scores of one series in one half of a record.

    The efficiencies are computed for sums of runoff, or means of levels, over time spans, and are
    listed by the length of the span (s). A value of 1 is perfect; an NSE of 0 is no better than the
    mean of the measurements.
    """

    quantity: str
    """``runoff`` or ``level``"""
    part: str
    """``fit`` or ``validation``"""
    nse: dict[int, float]
    """Nash and Sutcliffe 1970, doi:10.1016/0022-1694(70)90255-6, Eq. 3"""
    kge: dict[int, float]
    """Gupta et al. 2009, doi:10.1016/j.jhydrol.2009.08.003, Eq. 9"""
    volume_error: float
    """simulated minus measured total, as a share of the measured total"""


def efficiency(simulated: Values, measured: Values) -> float:
    """Return the NSE: 1 minus the squared errors over the squared deviations from the mean.

    The mean is that of the measurements. If these do not vary, they cannot be used to judge a
    simulation, and the result is NaN.
    """
    if np.ptp(measured) == 0:
        return float("nan")
    errors = np.sum((simulated - measured) ** 2)
    return float(1 - errors / np.sum((measured - np.mean(measured)) ** 2))


def kling_gupta(simulated: Values, measured: Values) -> float:
    """Return the Kling-Gupta efficiency (KGE).

    The KGE is 1 minus the Euclidean distance between (correlation, ratio of spreads, ratio of
    means) and (1, 1, 1). The result is NaN if either series does not vary, because the correlation
    is then undefined.
    """
    if np.ptp(measured) == 0 or np.ptp(simulated) == 0:
        return float("nan")
    correlation = np.corrcoef(simulated, measured)[0, 1]
    spread = np.std(simulated) / np.std(measured)
    mean = np.mean(simulated) / np.mean(measured)
    return float(1 - np.sqrt((correlation - 1) ** 2 + (spread - 1) ** 2 + (mean - 1) ** 2))


def score(
    quantity: str, part: str, simulated: Values, measured: Values, seconds: NDArray[np.int64],
    step_s: float,
) -> FitScores:
    """Score a series over its steps, and over hours and days if these are longer than the steps.

    Args:
        quantity: ``runoff`` or ``level``.
        part: ``fit`` or ``validation``.
        simulated: simulated values, shape (n,).
        measured: measured values in the same steps, without NaN.
        seconds: start of every step on a clock (s since 1970-01-01 on that clock).
        step_s: duration of a step (s).
    """
    step = round(step_s)
    nses, kges = {}, {}
    for span_s in (step, *(time for time in (HOUR_S, DAY_S) if time > step)):
        ours, theirs = (
            COMBINE[quantity](series, seconds, span_s) for series in (simulated, measured)
        )
        nses[span_s], kges[span_s] = efficiency(ours, theirs), kling_gupta(ours, theirs)
    total = float(np.sum(measured))
    error = float(np.sum(simulated)) / total - 1 if total > 0 else np.nan
    return FitScores(quantity, part, nses, kges, error)
