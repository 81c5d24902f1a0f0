"""The starts of episodes, drawn from all full hours of a record at which an episode can start."""

from __future__ import annotations

import math
from datetime import datetime, timedelta

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.forecast.models import make_model
from greenroof_ros.physics.storm_water import HOUR_S
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, TEMPERATURE

_MAX_DRAWS = 100
_HOUR, _HOUR_NS = timedelta(hours=1), 3_600_000_000_000


class Starts:
    """Full hours from which on the record covers an episode without a missing hour."""

    def __init__(self, run: Run) -> None:
        """Set one of the episodes, which are all equally long."""
        self._weather, site, ticks = run.weather, run.site, run.steps + run.site.M
        values = self._weather.values
        missing = np.any([
            np.isnan(values[name]) for name in (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE)
            if name in values
        ], axis=0)
        self._missing_before = np.concatenate(([0], np.cumsum(missing)))
        self._hours = (ticks - 1) * round(site.tau * 1e9) // _HOUR_NS + 1
        record = self._weather.end - self._weather.first
        self._count = (record - timedelta(seconds=ticks * site.tau)) // _HOUR + 1
        self._forecasts = make_model(run.forecast_choice, self._weather, site, False)
        ahead = float(look_ahead_ends(site, run.parameters["horizon"])[-1])
        self._hours_foreseen = math.ceil((run.steps * site.tau + ahead) / HOUR_S)
        self._known: dict[int, bool] = {}

    def __deepcopy__(self, _: object) -> Starts:
        """Return the starts themselves, because they never change."""
        return self

    def draw(self, random: np.random.Generator) -> datetime:
        """Draw a start.

        Raises:
            ConfigurationError: if the record is too short, or contains too many missing hours.
        """
        if self._count < 1:
            raise ConfigurationError("is shorter than an episode", key="weather")
        for _ in range(_MAX_DRAWS):
            hour = int(random.integers(self._count))
            if hour not in self._known:
                self._known[hour] = self._is_complete(hour)
            if self._known[hour]:
                return self._weather.first + hour * _HOUR
        raise ConfigurationError(
            f"{_MAX_DRAWS} randomly drawn episodes all contained missing hours; gaps='fill' "
            "fills missing hours", key="weather"
        )

    def _is_complete(self, hour: int) -> bool:
        """Return whether an episode from an hour on lacks neither weather nor a forecast."""
        before = self._missing_before
        if before[hour + self._hours] > before[hour]:
            return False
        try:
            self._forecasts.check(range(hour, hour + self._hours_foreseen))
        except ConfigurationError:
            return False
        return True
