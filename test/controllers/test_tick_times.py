"""Times of ticks, of any number of them in the same memory."""

from __future__ import annotations

import numpy as np
import pytest

from greenroof_ros.controllers.tick_times import TickTimes


def test_few_are_exact() -> None:
    """As numpy has them."""
    times = TickTimes()
    assert (len(times), times.mean, times.largest, times.percentile(99)) == (0, 0, 0, 0)
    drawn = np.random.default_rng(3).exponential(1e-4, 5000)
    for seconds in drawn:
        times.append(float(seconds))
    assert len(times) == 5000
    assert times.mean == pytest.approx(drawn.mean(), rel=1e-12)
    assert times.largest == drawn.max()
    assert times.percentile(99) == np.percentile(drawn, 99)


def test_many_are_thinned() -> None:
    """A million: mean and largest are exact, percentiles within what every 16th tells."""
    times = TickTimes()
    drawn = np.random.default_rng(4).exponential(1e-4, 1_000_000)
    for seconds in drawn.tolist():
        times.append(seconds)
    assert len(times) == 1_000_000
    assert times.mean == pytest.approx(drawn.mean(), rel=1e-9)
    assert times.largest == drawn.max()
    # Of an exponential the p-quantile is -ln(1 - p); its standard error at n = 62,500 is
    # sqrt(p / (1 - p) / n), 0.9 % of the 99th.
    for share in (50, 90, 99):
        p = share / 100
        expected, error = -np.log(1 - p) * 1e-4, np.sqrt(p / (1 - p) / 62_500) * 1e-4
        assert abs(times.percentile(share) - expected) < 5 * error
