"""Scores, compared with published examples."""

from __future__ import annotations

import numpy as np
import pytest

from greenroof_ros.analysis.calibration.scores import efficiency, kling_gupta, score


def test_nash_and_sutcliffe_kling_and_gupta() -> None:
    """The example in the documentation of the package HydroErr, with its results."""
    simulated = np.array([5, 7, 9, 2, 4.5, 6.7])
    measured = np.array([4.7, 6, 10, 2.5, 4, 7])
    assert efficiency(simulated, measured) == pytest.approx(0.922093023255814, rel=1e-12)
    measured[-1] = 6.8
    assert kling_gupta(simulated, measured) == pytest.approx(0.9181073779138655, rel=1e-12)


def test_the_mean_is_worth_0_and_minus_0_41() -> None:
    """Knoben et al. 2019, doi:10.5194/hess-23-4323-2019: KGE of the mean is 1 - sqrt(2)."""
    measured = np.tile([1.0, 2.0, 6.0], 1000)
    mean = np.full(3000, 3.0)
    almost = mean + 1e-9 * np.tile([1.0, 1.0, -2.0, -1.0, -1.0, 2.0], 500)
    assert efficiency(mean, measured) == 0.0
    assert kling_gupta(almost, measured) == pytest.approx(1 - np.sqrt(2), abs=1e-3)
    # Constant data give no score.
    assert np.isnan(efficiency(measured, mean)) and np.isnan(kling_gupta(mean, measured))


def test_longer_sums_forgive_a_delay() -> None:
    """A day's runoff an hour late scores below 0 by the hour, and perfectly by the day."""
    measured = np.zeros(4 * 24)
    measured[[10, 60]] = 5.0, 2.0
    seconds = 3600 * np.arange(96)
    scores = score("runoff", "fit", np.roll(measured, 1), measured, seconds, 3600.0)
    assert scores.nse[3600] < 0
    assert scores.nse[86400] == 1.0
    for step_s, times in ((60, [60, 3600, 86400]), (21600, [21600, 86400])):
        less = score("runoff", "fit", 0.9 * measured, measured, step_s * np.arange(96), step_s)
        assert list(less.nse) == list(less.kge) == times  # none shorter than a step
        assert less.volume_error == pytest.approx(-0.1)


def test_gaps_say_nothing_of_a_level() -> None:
    """Days of 4, 1 and 2 values with levels of 1, 3 and 2 cm: the daily mean has NSE 0."""
    days = np.array([0, 0, 0, 0, 1, 2, 2])
    measured = np.array([0.01, 0.03, 0.02])[days]
    seconds = 86400 * days + 3600 * np.array([0, 1, 2, 3, 5, 0, 9])
    scores = score("level", "fit", np.full(7, 0.02), measured, seconds, 3600.0)
    assert scores.nse[86400] == pytest.approx(0.0, abs=1e-12)
