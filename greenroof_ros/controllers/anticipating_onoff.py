"""An on/off controller that anticipates the weather with a single sum, without a solver."""

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
from greenroof_ros.controllers.roof_prediction import RoofPrediction
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.site.site import Site

Array = NDArray[np.float64]

# Interval at which it checks whether to go on waiting (s).
_CHECK_S = 60.0


class AnticipatingOnOff:
    """Pumps like the on/off controller, except when forecast rain makes pumping unnecessary.

    The paper's Conclusion calls for a 'less expensive, hybrid' design: an on/off controller that
    anticipates the weather. The paper's on/off controller, Eq. (12), fills the roof to its target
    x2*. If rain follows, the roof stays too wet for days. This controller predicts the volume of
    water on an unwatered roof from rain, evapotranspiration and, on field-capacity soil,
    percolation. The controller pumps as long as the following holds for every t:

        an unwatered roof would be too dry for more than half of the time from now to t,

    where t is the end of a step up to the horizon, or of one of the days after the horizon
    (:class:`~greenroof_ros.controllers.after_forecast.AfterForecast`).

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
    updated in every tick: :class:`~greenroof_ros.controllers.roof_observer.RoofObserver` averages
    the level readings, and :class:`~greenroof_ros.controllers.regret_budget.RegretBudget` limits
    the cost of forecast rain that never comes.

    Attributes:
        fraction: v, the command when pumping (share of the maximum flow).
        horizon: length of the forecast that is used (h).
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
            horizon: length of the forecast that is used (h).
            days_after: number of days after the horizon for which the deviation counts.
            fraction: v, the command when pumping (share of the maximum flow).
            observer_time_constant: averaging time of the roof's level readings (s).
            waiting_budget: maximum cost of waiting for rain (hours of an empty roof).
            waiting_share: allowed additional cost of waiting, as a share of the cost of
                plain on/off control.
        """
        self._site, self._p = site, plant_parameters(site)
        self._roof = RoofPrediction(self._p)
        self.fraction, self.horizon = fraction, horizon
        self._after = AfterForecast(site, horizon, days_after)
        self._lengths = np.diff(self._after.edges)
        self._observer = RoofObserver(site, observer_time_constant)
        self._regret_budget = RegretBudget(site, waiting_budget, waiting_share)
        self._waited = math.inf  # time since a check found that it should wait (s)

    @property
    def learned(self) -> dict[str, float]:
        """The costs of waiting and of plain on/off control so far."""
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
        """Compute the command from the levels and the forecast.

        See :class:`greenroof_ros.controllers.protocol.Controller`.

        The forecasts are means over the steps of
        :func:`greenroof_ros.site.horizon.growing_steps`.
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
        pumped = 0.0
        if command:
            state = State(x1, x2, site.initial_layer)
            pumped = step(self._p, state, *now, command, 1.0, OWN_PUMPS)[1].pump
        self._observer.predict(x2, *now, pumped)
        self._regret_budget.move(x1, x2, self.fraction, command, *now)
        return command

    def skip(self) -> None:
        """Skip a tick without a reading."""
        self._observer.skip()
        self._regret_budget.skip()

    def _stays_dry(self, x2: float, rain: Array, evaporated: Array) -> bool:
        """Return whether an unwatered roof is too dry most of the time up to the end of each step.

        On field-capacity soil, each step is weighted by the share of the water pumped now that
        would still be on the roof.
        """
        (rain,), evaporated = self._after.lengthen(rain, evaporated)
        weather = rain, evaporated, self._lengths
        changes = self._roof.predict_changes(x2, *weather)
        # At the middle of every step, where the course equals the step's mean.
        course = x2 + np.cumsum(changes) - changes / 2
        dry_s = np.where(course < self._site.x2_star, self._lengths, -self._lengths)
        dry_s = dry_s * self._roof.predict_lasting_share(x2, changes, *weather)
        if np.cumsum(dry_s).min() > 0:
            return True
        self._waited = 0.0
        return False

    def statistics(self) -> None:
        """Return None, because the controller has no solver."""
