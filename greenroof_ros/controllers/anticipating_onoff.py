"""An on/off controller that anticipates the weather: no model, no solver, one sum."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.after_forecast import DAYS_AFTER, HORIZON, AfterForecast
from greenroof_ros.controllers.onoff import FRACTION
from greenroof_ros.controllers.regret_budget import WAITING_BUDGET, WAITING_SHARE, RegretBudget
from greenroof_ros.controllers.roof_observer import OBSERVER_TIME_CONSTANT, RoofObserver
from greenroof_ros.model.plant import pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of

Array = NDArray[np.float64]

# So often it looks whether to wait on (s).
_LOOK_S = 60.0


class AnticipatingOnOff:
    """Pumps as the on/off controller does, but not where rain will do it.

    The paper asks for it: a 'less expensive, hybrid' design, an on/off controller that anticipates
    the weather (Conclusion). The paper's on/off controller, Eq. (12), fills the roof to its target
    x2*. If rain comes then, the roof stays too wet for days. This one looks at how the roof would
    be if it were left alone, by rain and evapotranspiration, of a measured roof also by what
    percolates. It pumps while the roof would be

        too dry for more than half of the time from now to t, for every t,

    t being the ends of the steps to the horizon and of the days after it
    (:class:`~greenroof_ros.controllers.after_forecast.AfterForecast`).

    Why: pump a little now, and the roof is that much wetter at every later time. That is a gain at
    those times at which it would otherwise be below its target, and a loss at those at which it
    would be above. What is not pumped now can still be pumped at t; then only the time until t
    counts. So it is best to pump where the gain is larger than the loss for every t, and to wait
    where it is not for one of them. This is the plan of the least sum of |x2 - x2*| for pumps of
    any flow: with y_i what is missing in step i, the volumes pumped by then are the isotonic
    regression of y in L1, and its first value is the least, over t, of the medians of y until t.
    It is above zero where the rule says so (Stout 2008, Unimodal regression via prefix isotonic
    regression, Comput. Stat. Data Anal. 53:289-297).

    It looks once a minute, and while it pumps in each tick.

    One thing this leaves out: that pumping takes time (a minute and a half at full flow for the
    paper's site). Of a dry forecast it makes the paper's controller.

    For a microcontroller: once a minute go through the hours of the forecast, adding up rain times
    the bed's area less evapotranspiration to what is on the roof. Add up the hours with too little,
    less those with too much, and stop, not pumping, if that sum is not above zero. Two sums more,
    kept tick by tick, make it fit for a real site:
    :class:`~greenroof_ros.controllers.roof_observer.RoofObserver` averages the level's readings,
    :class:`~greenroof_ros.controllers.regret_budget.RegretBudget` limits what a forecast of rain
    that never comes can do.

    Attributes:
        fraction: v, the command when pumping (share of the maximum flow).
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (
        HORIZON, DAYS_AFTER, FRACTION, OBSERVER_TIME_CONSTANT, WAITING_BUDGET, WAITING_SHARE,
    )

    def __init__(
        self,
        site: Site,
        horizon: float,
        days_after: float,
        fraction: float,
        observer_time_constant: float,
        waiting_budget: float,
        waiting_share: float,
    ) -> None:
        """Take the site and the parameters.

        Args:
            site: the parameters of Table I.
            horizon: how far to look ahead (h).
            days_after: days that count after it.
            fraction: v.
            observer_time_constant: over how long (s) readings of the roof's level are averaged.
            waiting_budget: what waiting for rain may cost (h of an empty roof).
            waiting_share: and besides, as a share of what plain on/off costs.
        """
        self._site, self._soil = site, soil_of(site)
        self.fraction = fraction
        self._after = AfterForecast(site, horizon, days_after)
        self._lengths = np.diff(self._after.edges)
        self._observer = RoofObserver(site, observer_time_constant)
        self._regret_budget = RegretBudget(site, waiting_budget, waiting_share)
        self._waited = math.inf  # since it looked and did not pump (s)

    @property
    def learned(self) -> dict[str, float]:
        """What waiting has cost."""
        return self._regret_budget.learned

    @learned.setter
    def learned(self, values: Mapping[str, float]) -> None:
        self._regret_budget.learned = values

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Decide from levels and forecast.

        See :class:`greenroof_ros.controllers.protocol.Controller`.

        The forecasts are means over the steps of
        :func:`greenroof_ros.model.look_ahead.growing_steps`.
        """
        site = self._site
        rain, evaporated = self._after.checked(precipitation, evapotranspiration, most=1)
        x1 = site.cistern_volume(cistern_level)
        if not math.isfinite(x1 + roof_level + float(rain.sum() + evaporated.sum())):
            self.skip()
            return 0.0
        self._after.pass_tick(evaporated)
        x2 = self._observer.correct(roof_level)
        exhausted = self._regret_budget.judge(x1, x2, self.fraction)
        dry = x2 < site.x2_star and cistern_level >= site.suction_level
        if dry and not exhausted:
            dry = self._waited >= _LOOK_S and self._stays_dry(x2, rain, evaporated)
        command = self.fraction if dry else 0.0
        self._waited += site.tau
        pumped, now = pump_flow(site, x1, x2, command), (float(rain[0, 0]), float(evaporated[0]))
        predicted = max(0.0, self._observer.predict(x2, *now, pumped))
        self._regret_budget.move(x1, x2, predicted, self.fraction, pumped, *now)
        return command

    def skip(self) -> None:
        """Wait for the next reading."""
        self._observer.skip()
        self._regret_budget.skip()

    def _stays_dry(self, x2: float, rain: Array, evaporated: Array) -> bool:
        """Whether the roof, left alone, is too dry for most of the time until each step's end.

        Of a measured roof a time counts by the share of what is pumped now that is left then.
        """
        (rain,), evaporated = self._after.lengthen(rain, evaporated)
        weather = rain, evaporated, self._lengths
        changes = self._soil.free_changes(x2, *weather)
        # Half-way through each step, since there the sum is the step's mean.
        course = x2 + np.cumsum(changes) - changes / 2
        dry_s = np.where(course < self._site.x2_star, self._lengths, -self._lengths)
        dry_s = dry_s * self._soil.lasting_share(x2, changes, *weather)
        if np.cumsum(dry_s).min() > 0:
            return True
        self._waited = 0.0
        return False

    def statistics(self) -> None:
        """It has no solver."""
