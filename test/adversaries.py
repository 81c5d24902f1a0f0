"""Rain forecasts that are made to mislead a controller."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.forecast.steps import SteppedForecast
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.weather.series import Weather

Array = NDArray[np.float64]

TOGETHER = "all of them, a member each"
"""one ensemble with each kind as a member, for a controller that takes ensembles"""


class Adversary:
    """Hourly forecasts of one kind."""

    notes = ()

    def __init__(self, kind: str, weather: Weather) -> None:
        self._kind = kind
        self._weather = weather

    def forecast(self, hour: int, hours: int) -> tuple[Array, Array, None]:
        """Return rain (mm/h), shape (members, hours), the true evapotranspiration (mm/day), None.

        The last says that these forecasts have no times of issue.
        """
        last = len(self._weather.precipitation) - 1
        ahead = hour + np.arange(hours)
        now = np.minimum(ahead, last)
        records = self._weather.precipitation
        tomorrow = (ahead - hour >= 24) & (ahead - hour < 30)
        kinds = {
            "always dry": np.zeros(hours),
            "always rain": np.full(hours, 2.0),
            "a storm that is always tomorrow": np.where(tomorrow, 8.0, 0.0),
            "inverted": np.where(records[now] > 0, 0.0, 0.7),
            "a day early": records[np.minimum(ahead + 24, last)],
            "a day late": records[np.maximum(now - 24, 0)],
            "a false alarm each week": records[now] + np.where(ahead % 168 < 6, 8.0, 0.0),
        }
        members = kinds.values() if self._kind == TOGETHER else [kinds[self._kind]]
        return np.stack([*members]), self._weather.evapotranspiration[now], None

    def check(self, hours: range) -> None:
        """Accept all hours: these forecasts lack nothing."""

    def end(self, hour: int) -> datetime:
        """Return a time after every run: these forecasts have no end."""
        return self._weather.end + timedelta(days=366)


def with_forecasts(run: Run, kind: str) -> Run:
    """Return a run whose controller and valve get false forecasts."""
    all_members, outlet_horizon = find_needs(run.controller, run.parameters)
    ends = look_ahead_ends(run.site, run.parameters.get("horizon", 0.0), outlet_horizon)
    return replace(run, forecast=SteppedForecast(
        Adversary(kind, run.weather), run.weather, run.series, run.site, run.start, ends,
        all_members,
    ))
