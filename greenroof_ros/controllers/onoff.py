"""The paper's on/off controller, Eq. (12)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.site.site import Site

FRACTION = Parameter(
    "fraction", 1.0, "1", 1e-9, 1e6,
    "v of Eq. (12): the command while pumping, as a share of the maximum flow", may_change=True,
)

LEVEL = Parameter(
    "level", 1.0, "1", 0.0, 1.0,
    "share of the target to which the roof is filled; 1 corresponds to Eq. (12)", may_change=True,
)


def onoff_command(
    fraction: float, level: float, suction_level: float, cistern_level: float, roof_level: float
) -> float:
    """Return the command of on/off control, Eq. (12).

    Args:
        fraction: command while pumping (share of the maximum flow).
        level: level on the roof below which the pumps run (m).
        suction_level: level in the cistern below which the pumps do not work (m).
        cistern_level: level in the cistern (m).
        roof_level: level on the roof (m).
    """
    return fraction if roof_level < level and cistern_level >= suction_level else 0.0


class OnOff:
    """Issues a fixed pump command while the roof is too dry and the cistern holds enough water.

    The roof counts as too dry if its volume is below ``level`` times the target. A level below 1
    leaves room for rain; without a forecast, there is no other way to do so.
    ``doc/explanation/controllers.md`` shows the benefit of a level below 1 for different roofs.

    Attributes:
        fraction: v, the command when pumping (share of the maximum flow).
        level: share of the target to which the roof is filled (1).
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (FRACTION, LEVEL)
    needs_forecast: ClassVar[bool] = False

    def __init__(self, site: Site, fraction: float, level: float = LEVEL.default) -> None:
        self._site = site
        self.fraction = fraction
        self.level = level

    def fits(self, site: Site) -> bool:
        """Return whether a controller of another site would issue the same commands."""
        own = self._site.z_veg, self._site.suction_level
        return own == (site.z_veg, site.suction_level)

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Compute the command from the levels (m) alone, without the forecasts."""
        level = self.level * self._site.z_veg
        return onoff_command(
            self.fraction, level, self._site.suction_level, cistern_level, roof_level
        )

    def skip(self) -> None:
        """Do nothing, because the controller has no memory."""

    def statistics(self) -> None:
        """Return None, because the controller has no solver."""
