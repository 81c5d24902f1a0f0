"""What reaches the sewer, event by event: by hand."""

from __future__ import annotations

import numpy as np
import pytest
from paper import site_with

from greenroof_ros.model.storm_water import (
    Intervals,
    find_events,
    find_peak,
    find_wet_weather,
)

# 100 m2 in all.
SITE = site_with(a_in=50.0, a2=50.0)
PER_HOUR = 12


def intervals(hours: int, rain: dict[int, float], discharge: dict[int, float]) -> Intervals:
    """Return five-minute sums: rain in mm and discharge in m3, by index."""
    result = Intervals(300.0, np.zeros(PER_HOUR * hours), np.zeros(PER_HOUR * hours))
    for at, depth in rain.items():
        result.rain[at] = depth / 1000
    for at, volume in discharge.items():
        result.discharge[at] = volume
    return result


def test_wet_weather_is_rain_and_two_hours_after() -> None:
    """0.09 mm in an hour are none; rain within the hour counts from its first five minutes on."""
    found = find_wet_weather(SITE, intervals(8, {3: 0.09, 14: 0.06, 20: 0.05}, {}))
    assert np.flatnonzero(found).tolist() == list(range(14, 20 + 24 + 1))


def test_peaks() -> None:
    """0.3 m3 in five minutes are 1 L/s; over 15 minutes a third of it, over an hour 0.5 m3."""
    run = intervals(2, {}, {5: 0.3, 14: 0.2})
    assert 1000 * find_peak(run, 5) == pytest.approx(1.0)
    assert 1000 * find_peak(run, 15) == pytest.approx(1 / 3)
    assert 1000 * find_peak(run, 60) == pytest.approx(0.5 / 3.6)
    hourly = Intervals(3600.0, run.rain, run.discharge)
    assert 1000 * find_peak(hourly, 5) == pytest.approx(0.3 / 3.6)


def test_events_by_hand() -> None:
    """Two storms six hours and five minutes apart; the second one's peak comes 15 minutes late."""
    second = 10 + 6 * PER_HOUR + 1
    run = intervals(
        20, {4: 2.0, 10: 4.0, second: 6.0, second + 1: 3.0},
        {11: 0.3, second + 3: 0.09, second + 90: 5.0},
    )
    first, other = find_events(SITE, run)
    assert (first.start_h, first.hours) == pytest.approx((4 / 12, 7 / 12))
    assert first.rain_mm == pytest.approx(6.0)
    assert first.max_rain_5min_mm_h == pytest.approx(48.0)
    assert first.max_rain_60min_mm_h == pytest.approx(6.0)
    # Of 0.6 m3 on 100 m2, 0.3 reached the sewer; the peak was 1 L/s of 4 mm in 300 s, 1.333 L/s.
    assert (first.discharge_m3, first.volume_reduction) == pytest.approx((0.3, 0.5))
    assert (first.peak_l_s, first.peak_reduction) == pytest.approx((1.0, 0.25))
    assert first.peak_delay_min == 5.0
    # What is let out more than six hours after the rain does not belong to it.
    assert (other.discharge_m3, other.volume_reduction) == pytest.approx((0.09, 0.9))
    assert other.peak_delay_min == 15.0


def test_what_is_one_event_or_none() -> None:
    """Six dry hours separate, five hours and 55 minutes do not; 0.09 mm are no event."""
    at = 2 + 6 * PER_HOUR
    assert len(find_events(SITE, intervals(10, {2: 1.0, at: 1.0}, {}))) == 1
    assert len(find_events(SITE, intervals(10, {2: 1.0, at + 1: 1.0}, {}))) == 2
    assert find_events(SITE, intervals(10, {2: 0.09}, {})) == []
    (dry,) = find_events(SITE, intervals(10, {2: 1.0}, {}))
    assert dry.volume_reduction == dry.peak_reduction == 1.0
    assert np.isnan(dry.peak_delay_min)
