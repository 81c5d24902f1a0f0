"""A forecast at a tick is the same whoever asked for which ticks before."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from paper import site_with, weather_of

from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.resampling import Forecast, PerfectForecast, make_forecast
from greenroof_ros.weather.series import Weather, WeatherSeries

CHANCE = np.random.default_rng(11)
FIRST = datetime(2021, 7, 1, tzinfo=timezone.utc)


def drawn(hours: int) -> Weather:
    """Return made up weather."""
    return weather_of(CHANCE.gamma(0.3, size=hours), CHANCE.gamma(2.0, size=hours), FIRST)


@pytest.mark.parametrize("tau", [1.0, 0.7, 613.0, 3600.0])
@pytest.mark.parametrize(("horizon", "members"), [(0.0, 1), (12.0, 1), (47.3, 3)])
def test_any_order(tau: float, horizon: float, members: int) -> None:
    """One tick after another, back, and by leaps: bit for bit what a new forecast gives."""
    site, weather = site_with(tau=tau), drawn(80)
    start, steps = FIRST + timedelta(minutes=37), int(12 * 3600 / tau)
    choice = ForecastChoice("ensemble", members=members) if members > 1 else ForecastChoice()
    series = WeatherSeries(weather, site, start, steps)

    def new() -> Forecast:
        return make_forecast(weather, series, site, start, horizon, choice, members > 1)

    asked, now = new(), steps // 3
    near = [tick for tick in range(now, now + 40) if tick <= steps]
    for tick in [*near, *reversed(near), *CHANCE.integers(0, steps + 1, 20).tolist(), steps, 0]:
        alone = new()
        for one, other in (
            (asked.precipitation(tick), alone.precipitation(tick)),
            (asked.evapotranspiration(tick), alone.evapotranspiration(tick)),
        ):
            assert np.array(one).tobytes() == np.array(other).tobytes()


@pytest.mark.parametrize("tau", [1.0, 0.7, 613.0, 3600.0])
def test_perfect_forecast_is_the_series(tau: float) -> None:
    """M ticks of it from each tick on, and its own each time: who changes it changes no other."""
    site, weather = site_with(tau=tau), drawn(30)
    steps = int(12 * 3600 / tau)
    series = WeatherSeries(weather, site, FIRST + timedelta(minutes=37), steps)
    forecast = PerfectForecast(series, site.M)
    edge = int(23 * 60 / tau)  # the first hour of the clock ends 23 minutes after the start
    for tick in [*range(max(0, edge - 15), min(edge + 5, steps + 1)), 0, steps]:
        for ahead, values in (
            (forecast.precipitation(tick), series.precipitation),
            (forecast.evapotranspiration(tick), series.evapotranspiration),
        ):
            assert ahead.tolist() == [values[tick + lead] for lead in range(site.M)]
            ahead[0] = -1.0
