"""Your own controller: the command grows with the water that is missing on the roof.

greenroof simulate --controller examples.proportional:Proportional
greenroof run --controller examples.proportional:Proportional --gain 40
greenroof check-controller examples.proportional:Proportional
"""

from __future__ import annotations

from collections.abc import Sequence

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.site import Site


class Proportional:
    """Commands gain x (target - level), between 0 and 1, while the cistern holds enough.

    Attributes:
        gain: command for a metre below the target (1/m).
    """

    parameters = (
        Parameter(
            "gain", 20.0, "1/m", 0.0, 1e4, "command for a metre below the target", may_change=True
        ),
    )

    def __init__(self, site: Site, gain: float) -> None:
        self._site = site
        self.gain = gain

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Decide from the levels (m) alone; the forecasts are not used."""
        if not cistern_level >= self._site.suction_level:
            return 0.0
        command = self.gain * (self._site.z_veg - roof_level)
        return min(command, 1.0) if command > 0 else 0.0

    def skip(self) -> None:
        """Do nothing: there is no state to keep."""

    def statistics(self) -> None:
        """Return nothing: it has no solver."""
