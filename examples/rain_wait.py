"""A controller of your own: it fills the roof, but does not water if enough rain is coming.

greenroof simulate --controller examples.rain_wait:RainWait
greenroof check-controller examples.rain_wait:RainWait
"""

from __future__ import annotations

import numpy as np

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.site import Site


class RainWait:
    """Pumps while more water is missing on the roof than the forecast has within the horizon."""

    parameters = (
        Parameter("horizon", 3.0, "h", 0.1, 240.0, "how long it waits for rain"),
        Parameter("command_on", 1.0, "1", 0.0, 1.0, "command when it pumps", may_change=True),
    )
    needs_forecast = False  # without one it fills the roof as on/off does
    forecast_ends = np.empty(0)  # is set: ends of the forecast's steps (s from now), the first 0

    def __init__(self, site: Site, horizon: float, command_on: float) -> None:
        self._site, self.command_on = site, command_on

    def command(self, cistern_level, roof_level, precipitation, evapotranspiration) -> float:
        """Decide from the levels (m) and the forecast of rain (m/s), a mean for each step."""
        missing = self._site.z_veg - roof_level
        known = len(precipitation) == len(self.forecast_ends) - 1
        coming = precipitation @ np.diff(self.forecast_ends) if known else 0.0  # m
        short = missing > 0 and not coming >= missing  # NaN is not enough
        return self.command_on if short and cistern_level >= self._site.suction_level else 0.0

    def skip(self) -> None:
        """Do nothing: there is no state to keep."""

    def statistics(self) -> None:
        """Return nothing: it has no solver."""
