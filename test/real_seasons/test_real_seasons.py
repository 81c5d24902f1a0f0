"""The campaign's own part: intervals."""

from __future__ import annotations

import numpy as np
import pytest
from real_seasons.tables import interval


def test_intervals_of_sums_over_weeks() -> None:
    """Nothing but a factor between two: no width. Otherwise the ratio lies within it."""
    weeks = np.random.default_rng(1).gamma(2.0, size=40)
    assert interval(0.9 * weeks, weeks) == pytest.approx((0.9, 0.9, 0.9))
    value, low, high = interval(weeks, np.ones(40))
    assert value == pytest.approx(weeks.mean())
    assert low < value < high
