"""A controller of your own: the less water the roof contains, the higher the command.

greenroof simulate --controller examples.proportional:Proportional
greenroof run --controller examples.proportional:Proportional --gain 40
greenroof check-controller examples.proportional:Proportional
"""

from __future__ import annotations

import numpy as np

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.site.site import Site


class Proportional:
    """Command gain x (target - level), between 0 and 1, while the cistern contains enough water.

    Attributes:
        gain: command for each metre below the target (1/m).
    """

    parameters = (
        Parameter(
            "gain", 20.0, "1/m", 0.0, 1e4, "command per metre below the target", may_change=True
        ),
    )

    def __init__(self, site: Site, gain: float) -> None:
        self._site = site
        self.gain = gain

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: np.ndarray,
        evapotranspiration: np.ndarray,
    ) -> float:
        """Return the command. It depends only on the levels (m), not on the forecasts."""
        if not cistern_level >= self._site.suction_level:
            return 0.0
        command = self.gain * (self._site.z_veg - roof_level)
        return min(command, 1.0) if command > 0 else 0.0

    def skip(self) -> None:
        """Do nothing, since the controller has no state."""

    def statistics(self) -> None:
        """Return nothing, since the controller has no solver."""
