"""Times of ticks, in constant memory for any number of them."""

from __future__ import annotations

import numpy as np
import pytest

from greenroof_ros.controllers.tick_times import TickTimes


@pytest.mark.parametrize("count", [0, 1, 5000, 100_000])
def test_times_of_ticks(count: int) -> None:
    """They equal numpy's; for 100,000 ticks the percentile covers the last 65,536."""
    times, drawn = TickTimes(), np.random.default_rng(4).exponential(1e-4, count)
    for seconds in drawn.tolist():
        times.append(seconds)
    statistics = times.statistics(7, 2)
    assert (len(times), statistics["solves"], statistics["fallbacks"]) == (count, 7, 2)
    assert statistics["max_s"] == drawn.max(initial=0)
    assert statistics["mean_s"] == pytest.approx(drawn.mean() if count else 0, rel=1e-9)
    assert statistics["p99_s"] == (np.percentile(drawn[-65_536:], 99) if count else 0)
