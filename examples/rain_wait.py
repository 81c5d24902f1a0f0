"""Example of a controller that fills the roof unless enough rain is forecast.

greenroof simulate --controller examples.rain_wait:RainWait
greenroof check-controller examples.rain_wait:RainWait
"""

from __future__ import annotations

import numpy as np

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.site.site import Site


class RainWait:
    """Pump while the roof lacks more water than is forecast to fall within the horizon."""

    parameters = (
        Parameter("horizon", 3.0, "h", 0.1, 240.0, "period within which forecast rain counts"),
        Parameter("command_on", 1.0, "1", 0.0, 1.0, "command while the pump runs", may_change=True),
    )
    needs_forecast = False  # without a forecast, it works like on/off control
    forecast_ends = np.empty(0)  # boundaries of the forecast's steps (s from now), set from outside

    def __init__(self, site: Site, horizon: float, command_on: float) -> None:
        self._site, self.command_on = site, command_on

    def command(
        self, cistern_level: float, roof_level: float, precipitation: np.ndarray,
        evapotranspiration: np.ndarray,
    ) -> float:
        """Return the command for the levels (m) and the mean rain of each forecast step (m/s)."""
        missing = self._site.z_veg - roof_level
        known = len(precipitation) == len(self.forecast_ends) - 1
        coming = precipitation @ np.diff(self.forecast_ends) if known else 0.0  # m
        short = missing > 0 and not coming >= missing  # NaN does not count as enough
        return self.command_on if short and cistern_level >= self._site.suction_level else 0.0
