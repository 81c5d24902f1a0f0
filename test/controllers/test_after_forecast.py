"""How far controllers look ahead: the steps of a forecast, and the days after it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from paper import PAPER_SITE, site_with

from greenroof_ros.controllers.anticipating import AfterForecast
from greenroof_ros.site.horizon import growing_steps

EDGES = growing_steps(12)
STEPS = len(EDGES) - 1


def test_steps() -> None:
    """They begin with seconds, end at the horizon, and never shrink, except the last."""
    for hours in (0.1, 1.0, 4.0, 12.0, 48.0, 240.0):
        edges = growing_steps(hours)
        lengths = np.diff(edges)
        assert (edges[0], edges[-1]) == (0.0, hours * 3600)
        assert lengths[0] == 10
        assert (np.diff(lengths)[:-1] >= 0).all()


def test_after_the_forecast_the_roof_dries_slowly() -> None:
    """Ten days without rain, at 0.3 of the mean evapotranspiration of the past day."""
    after = AfterForecast(site_with(tau=3600.0), 12, 10)
    assert after.edges[: STEPS + 1].tolist() == EDGES.tolist()
    assert np.diff(after.edges[STEPS:]).tolist() == [86_400.0] * 10
    day = [8e-6 * max(0.0, math.sin(math.pi * (hour - 6) / 12)) for hour in range(24)]
    mean = float(np.mean(day))
    ends = []
    for hour in range(240):
        after.read(np.zeros(STEPS), np.full(STEPS, day[hour % 24]), 1)
        rain, evaporated = after.lengthen(np.full((2, STEPS), 1e-6), np.full(STEPS, 3e-6))
        assert rain.shape == (2, STEPS + 10) and not rain[:, STEPS:].any()
        assert evaporated[:STEPS].tolist() == [3e-6] * STEPS
        ends.append(evaporated[STEPS:])
    assert np.ptp(ends[-1]) == 0
    last_day = [float(end[0]) for end in ends[-24:]]
    assert np.mean(last_day) == pytest.approx(0.3 * mean, rel=0.01)
    # A first-order lag of a day leaves 16 % of a daily wave, here of 1.6 times the mean.
    assert np.ptp(last_day) / 2 == pytest.approx(0.3 * mean * 1.57 * 0.157, rel=0.15)


def test_after_the_forecast_the_first_mean_is_the_forecasts_own() -> None:
    """Of its first day, with any later steps."""
    edges = growing_steps(48)
    after = AfterForecast(PAPER_SITE, 48, 10)
    forecast = np.where(edges[1:] <= 86_400, 2e-6, 9e-6)
    forecast[np.searchsorted(edges, 86_400) - 1] = 2e-6
    after.read(0 * forecast, forecast, 1)
    _, evaporated = after.lengthen(np.zeros((1, after.steps)), forecast)
    assert evaporated[-1] == pytest.approx(0.3 * 2e-6, rel=1e-4)
