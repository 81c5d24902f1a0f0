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
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of

Array = NDArray[np.float64]

# Interval at which it checks whether to go on waiting (s).
_CHECK_S = 60.0


class AnticipatingOnOff:
    """Pumps like the on/off controller, but not if rain will do the work.

    The paper's Conclusion asks for a 'less expensive, hybrid' design: an on/off controller that
    anticipates the weather. The paper's on/off controller, Eq. (12), fills the roof to its target
    x2*. If rain then comes, the roof stays too wet for days. This controller predicts the roof's
    volume without pumping, from rain and evapotranspiration, and on field-capacity soil also from
    percolation. It pumps while the roof would be

        too dry for more than half of the time from now to t, for every t,

    where t is the end of any step up to the horizon, or of any of the days after it
    (:class:`~greenroof_ros.controllers.after_forecast.AfterForecast`).

    The reason: water pumped now makes the roof that much wetter at every later time. This is a gain
    whenever the roof would otherwise be below its target, and a loss whenever it would be above.
    Water that is not pumped now can still be pumped at t; then only the time until t counts. So it
    is best to pump if the gain exceeds the loss for every t, and otherwise to wait. For pumps of
    any flow, this is the plan with the minimum sum of |x2 - x2*|: if y_i is the volume missing in
    step i, the volumes pumped by then are the isotonic regression of y in L1, whose first value is
    the minimum over t of the medians of y until t. It is above zero exactly if the rule is to
    pump (Stout 2008, Unimodal regression via prefix isotonic regression, Comput. Stat. Data Anal.
    53:289-297).

    It checks the rule once a minute, and in every tick while it pumps.

    The rule ignores that pumping takes time (a minute and a half at full flow for the paper's
    site). With a dry forecast, it is the paper's controller.

    On a microcontroller: once a minute, go through the hours of the forecast, and add the rain on
    the bed's area minus evapotranspiration to the water on the roof. Add up the hours with too
    little water minus those with too much. Do not pump if this sum is zero or less at even one
    hour. A real site needs two more parts, updated in every tick:
    :class:`~greenroof_ros.controllers.roof_observer.RoofObserver` averages the level's readings,
    and :class:`~greenroof_ros.controllers.regret_budget.RegretBudget` limits the cost of forecast
    rain that never comes.

    Attributes:
        fraction: v, the command when pumping (share of the maximum flow).
        horizon: how far it looks ahead (h).
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
        """Set the site and the parameters.

        Args:
            site: parameters of the site (Table I).
            horizon: how far to look ahead (h).
            days_after: days after the horizon that count.
            fraction: v, the command when pumping (share of the maximum flow).
            observer_time_constant: averaging time of the roof's level readings (s).
            waiting_budget: what waiting for rain may cost (hours of an empty roof).
            waiting_share: what it may cost in addition, as a share of the cost of plain on/off.
        """
        self._site, self._soil = site, soil_of(site)
        self.fraction, self.horizon = fraction, horizon
        self._after = AfterForecast(site, horizon, days_after)
        self._lengths = np.diff(self._after.edges)
        self._observer = RoofObserver(site, observer_time_constant)
        self._regret_budget = RegretBudget(site, waiting_budget, waiting_share)
        self._waited = math.inf  # time since a check found that it should wait (s)

    @property
    def learned(self) -> dict[str, float]:
        """The costs of waiting and of plain on/off so far."""
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
        rain, evaporated = self._after.check(precipitation, evapotranspiration, max_members=1)
        x1 = site.cistern_volume(cistern_level)
        if not math.isfinite(x1 + roof_level + float(rain.sum() + evaporated.sum())):
            self.skip()
            return 0.0
        self._after.pass_tick(evaporated)
        x2 = self._observer.correct(roof_level)
        exhausted = self._regret_budget.judge(x1, x2, self.fraction)
        dry = x2 < site.x2_star and cistern_level >= site.suction_level
        if dry and not exhausted:
            dry = self._waited >= _CHECK_S and self._stays_dry(x2, rain, evaporated)
        command = self.fraction if dry else 0.0
        self._waited += site.tau
        now = float(rain[0, 0]), float(evaporated[0])
        pumped = Plant(site, x1, x2).flows(*now, command).pump if command else 0.0
        self._observer.predict(x2, *now, pumped)
        self._regret_budget.move(x1, x2, self.fraction, command, *now)
        return command

    def skip(self) -> None:
        """Let a tick pass without a reading."""
        self._observer.skip()
        self._regret_budget.skip()

    def _stays_dry(self, x2: float, rain: Array, evaporated: Array) -> bool:
        """Whether the roof without pumping is too dry for most of the time until every step's end.

        On field-capacity soil, each time is weighted by the share of water pumped now that is left
        then.
        """
        (rain,), evaporated = self._after.lengthen(rain, evaporated)
        weather = rain, evaporated, self._lengths
        changes = self._soil.predict_changes(x2, *weather)
        # At the middle of every step, where the course equals the step's mean.
        course = x2 + np.cumsum(changes) - changes / 2
        dry_s = np.where(course < self._site.x2_star, self._lengths, -self._lengths)
        dry_s = dry_s * self._soil.predict_lasting_share(x2, changes, *weather)
        if np.cumsum(dry_s).min() > 0:
            return True
        self._waited = 0.0
        return False

    def statistics(self) -> None:
        """Return None: it has no solver."""
