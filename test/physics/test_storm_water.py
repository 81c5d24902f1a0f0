"""Wet weather, tick by tick: by hand, and by the times of all rain before."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper import site_with

from greenroof_ros.physics.storm_water import interval_seconds, is_wet, time_without_rain

DRIZZLE = 0.05


def wet_ticks(
    rain: Sequence[float], tau: float = 300.0, wet_after_h: float = 2.0, before: float = math.inf
) -> list[int]:
    """Return the ticks in wet weather, from the rain in each (mm/h)."""
    wet = []
    for tick, rate in enumerate(rain):
        before = time_without_rain(before, rate / 3.6e6, tau)
        if is_wet(before, tau, wet_after_h * 3600):
            wet.append(tick)
    return wet


def rains(ticks: int, at: dict[int, float]) -> list[float]:
    """Return the rain of ticks that are dry but for some (mm/h)."""
    return [at.get(tick, 0.0) for tick in range(ticks)]


@pytest.mark.parametrize(("rain", "options", "expected"), [
    # Two hours after 0.1 mm/h, and until the run's end; 0.09 mm/h are none.
    (rains(60, {1: 0.09, 14: 0.1}), {}, range(14, 39)), (rains(24, {20: 9.0}), {}, range(20, 24)),
    # Drizzle counts within an hour after rain that counts, also if that was drizzle.
    (rains(96, {2: 1.0, 14: DRIZZLE, 26: DRIZZLE}), {}, range(2, 51)),
    # Unknown rain counts.
    (rains(60, {5: math.nan, 16: DRIZZLE}), {}, range(5, 41)),
    # Ticks of 7 s: 3598 s are within the hour, 3605 s are not; 515 ticks begin within an hour.
    (rains(1100, {0: 1.0, 515: DRIZZLE}), {"tau": 7.0, "wet_after_h": 1.0}, range(1031)),
    (rains(1100, {0: 1.0, 516: DRIZZLE}), {"tau": 7.0, "wet_after_h": 1.0}, range(516)),
    # It rained until 90 minutes or two hours before the start.
    (rains(36, {0: DRIZZLE}), {"before": 5400.0}, range(6)),
    (rains(36, {}), {"before": 7200.0}, []),
])
def test_wet_weather_by_hand(
    rain: list[float], options: dict[str, float], expected: Sequence[int]
) -> None:
    assert wet_ticks(rain, **options) == list(expected)


@given(
    rain=st.lists(
        st.sampled_from([0.0, 0.0, 0.0, DRIZZLE, 0.0999, 0.1, 20.0, math.nan]), max_size=60
    ),
    tau=st.sampled_from([7, 60, 300, 1000, 1800, 3600]), after=st.integers(0, 30_000),
)
def test_wet_weather_one_by_one(rain: list[float], tau: int, after: int) -> None:
    """From the seconds between a tick and all ticks before it in which rain counts."""
    counts: list[int] = []
    expected = []
    for tick, rate in enumerate(rain):
        passed = [(tick - other - 1) * tau for other in counts]
        if math.isnan(rate) or rate >= 0.1 or (rate > 0 and any(dry < 3600 for dry in passed)):
            counts.append(tick)
        if tick in counts or any(dry < after for dry in passed):
            expected.append(tick)
    assert wet_ticks(rain, tau, after / 3600) == expected


@pytest.mark.parametrize(("tau", "seconds"), [
    (0.1, 60), (7, 63), (60, 60), (90, 90), (3600, 3600),
])
def test_intervals_are_whole_ticks(tau: float, seconds: float) -> None:
    assert interval_seconds(site_with(tau=tau)) == pytest.approx(seconds)
