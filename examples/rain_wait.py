"""A controller of your own: it fills the roof, but does not water if enough rain is coming.

    greenroof simulate --controller examples.rain_wait:RainWait
    greenroof run --controller examples.rain_wait:RainWait --horizon 6
    greenroof check-controller examples.rain_wait:RainWait

Over the paper's window the roof stays closer to its target than with mpc or onoff.
"""

from __future__ import annotations

import numpy as np

from greenroof_ros import Parameter, Site


class RainWait:
    """Pumps while more water is missing on the roof than the forecast has within the horizon.

    Attributes:
        command_on: the command when it pumps (share of the maximum flow).
        forecast_ends: ends of the forecast's steps (s from now), the first 0; is set before a run.
    """

    parameters = (
        Parameter("horizon", 3.0, "h", 0.1, 240.0, "how long it waits for rain"),
        Parameter("command_on", 1.0, "1", 0.0, 1.0, "command when it pumps", may_change=True),
    )
    needs_forecast = False  # without one it fills the roof as on/off does
    forecast_ends = np.empty(0)

    def __init__(self, site: Site, horizon: float, command_on: float) -> None:
        self._site, self.command_on = site, command_on

    def command(self, cistern_level, roof_level, precipitation, evapotranspiration) -> float:
        """Decide from the levels (m) and the forecast of rain (m/s), a mean for each step."""
        missing = self._site.z_veg - roof_level
        if missing <= 0 or cistern_level < self._site.suction_level:
            return 0.0
        lengths = np.diff(self.forecast_ends)
        known = len(precipitation) == len(lengths)
        coming = float(np.dot(precipitation, lengths)) if known else 0.0  # m
        return 0.0 if coming >= missing else self.command_on  # NaN is not enough

    def skip(self) -> None:
        """Do nothing: there is no state to keep."""

    def statistics(self) -> None:
        """Return nothing: it has no solver."""
