"""The paper's on/off controller, Eq. (12).

Another one anticipates the weather with a single sum, without a solver.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.anticipating import OF_FORECAST, OF_WAITING, Anticipating, Forecasts
from greenroof_ros.controllers.roof import Array, RoofPrediction
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


# Interval at which it checks whether to go on waiting (s).
_CHECK_S = 60.0


class AnticipatingOnOff(Anticipating):
    """Pumps like the on/off controller, except when forecast rain makes pumping unnecessary.

    The paper's Conclusion calls for a 'less expensive, hybrid' design: an on/off controller that
    anticipates the weather. The paper's on/off controller, Eq. (12), fills the roof to its target
    x2*. If rain follows, the roof stays too wet for days. This controller predicts the volume of
    water on an unwatered roof from rain, evapotranspiration and, on field-capacity soil,
    percolation. The controller pumps as long as the following holds for every t:

        an unwatered roof would be too dry for more than half of the time from now to t,

    where t is the end of a step up to the horizon, or of one of the days after the horizon
    (:class:`~greenroof_ros.controllers.anticipating.AfterForecast`).

    Water pumped now makes the roof wetter by the same amount at every later time. The extra water
    is a gain whenever the roof would otherwise be below its target, and a loss whenever it would be
    above the target. Water that is not pumped now can still be pumped at t, so only the time until
    t counts in the decision. It is therefore best to pump if the gain exceeds the loss for every t,
    and otherwise to wait. If the pumps can deliver any flow, this rule yields the plan with the
    minimum sum of |x2 - x2*|. If y_i is the volume missing in step i, the total volumes pumped up
    to each step are the L1 isotonic regression of y. Its first value is the minimum over t of the
    median of y up to t. This value is positive exactly when the rule calls for pumping (Stout 2008,
    Unimodal regression via prefix isotonic regression, Comput. Stat. Data Anal. 53:289-297).

    The controller checks the rule once a minute, and in every tick while it pumps.

    The rule neglects the time that pumping takes (a minute and a half at full flow at the paper's
    site). With a dry forecast, the controller acts like the paper's on/off controller.

    A microcontroller can implement the rule as follows. Once a minute, go through the hours of the
    forecast, and add the rain on the bed minus evapotranspiration to the water on the roof. Keep a
    running sum of the hours with too little water minus the hours with too much. Do not pump if
    this sum is zero or negative after any hour. A real site needs two more components, which are
    updated in every tick: :class:`~greenroof_ros.controllers.roof.RoofObserver` averages
    the level readings, and :class:`~greenroof_ros.controllers.regret_budget.RegretBudget` limits
    the cost of forecast rain that never comes.

    Attributes:
        fraction: v, the command when pumping (share of the maximum flow).
        horizon: length of the forecast that is used (h).
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (*OF_FORECAST, FRACTION, *OF_WAITING)

    def __init__(self, site: Site, fraction: float, **waiting: float) -> None:
        """Set the site (Table I) and the parameters.

        Args:
            site: the site.
            fraction: v, the command when pumping (share of the maximum flow).
            waiting: the other parameters, as for :class:`.Anticipating`.
        """
        super().__init__(site, fraction, **waiting)
        self._roof = RoofPrediction(self._p)
        self._waits_since = -math.inf  # tick of the last check that found that it should wait

    def _decide(self, x1: float, x2: float, forecast: Forecasts | None) -> float:
        site = self._site
        dry = x2 < site.x2_star and x1 / site.a1 >= site.suction_level
        if dry and self._rain_counts and forecast is not None:
            checks = self._seconds_since(self._waits_since) >= _CHECK_S
            dry = checks and self._stays_dry(x2, *forecast)
            if checks and not dry:
                self._waits_since = self._tick
        return self.fraction if dry else 0.0

    def _stays_dry(self, x2: float, rain: Array, evaporated: Array) -> bool:
        """Return whether an unwatered roof is too dry most of the time up to the end of each step.

        On field-capacity soil, each step is weighted by the share of the water pumped now that
        would still be on the roof.
        """
        (rain,), evaporated = self._after.lengthen(rain, evaporated)
        lengths = self._after.lengths
        changes = self._roof.predict_changes(x2, rain, evaporated, lengths)
        # At the middle of every step, where the course equals the step's mean.
        course = x2 + np.cumsum(changes) - changes / 2
        dry_s = np.where(course < self._site.x2_star, lengths, -lengths)
        dry_s *= self._roof.predict_lasting_share(x2, changes, rain, evaporated, lengths)
        return bool(np.cumsum(dry_s).min() > 0)

    def statistics(self) -> None:
        """Return None, because the controller has no solver."""
