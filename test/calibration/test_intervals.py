"""Intervals of the jackknife, against those of a mean that every textbook has."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student

from greenroof_ros.calibration.intervals import half_intervals, moves


def test_a_mean_has_the_interval_of_students_t() -> None:
    """The jackknife of a mean is its standard error, s / sqrt(n) (Efron 1982, chapter 3)."""
    values = np.array([2.0, 3.5, 1.0, 4.0, 2.5, 6.0])
    count = len(values)
    residuals = values.mean() - values
    moved = moves(np.ones((count, 1)), residuals, np.arange(count))
    expected = student.ppf(0.975, count - 1) * values.std(ddof=1) / np.sqrt(count)
    assert half_intervals(moved) == pytest.approx([expected])


def test_one_group_says_nothing() -> None:
    moved = moves(np.ones((3, 1)), np.array([1.0, -2.0, 1.0]), np.zeros(3, dtype=np.int64))
    assert half_intervals(moved).tolist() == [np.inf]
