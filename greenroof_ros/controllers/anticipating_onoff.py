"""An on/off controller that anticipates the weather: no model, no solver, one level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.onoff import FRACTION
from greenroof_ros.controllers.protocol import HORIZON
from greenroof_ros.controllers.regret_limit import MAX_WAITING_LOSS, RegretLimit
from greenroof_ros.controllers.roof_observer import OBSERVER_TIME_CONSTANT, RoofObserver
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.plant import pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import free_changes

Array = NDArray[np.float64]


class AnticipatingOnOff:
    """Pumps as the on/off controller does, but up to a level that leaves room for what comes.

    The paper asks for it: a 'less expensive, hybrid' design, an on/off controller that anticipates
    the weather (Conclusion). The paper's on/off controller, Eq. (12), fills the roof to its target
    x2*. If rain comes then, the roof stays too wet for the rest of the day, since nothing but
    evapotranspiration takes water off it. This one fills it to x2* - m only, where

        m = max(0, median of C(t) over the horizon),
        C(t) = what rain less evapotranspiration bring to the roof from now until t,
               of a measured roof without what percolates meanwhile.

    Why the median: pump a little now, and the roof is that much wetter at every later time. That is
    a gain at those times at which it would otherwise be below its target, and a loss at those at
    which it would be above. Gain and loss are equal - and the sum of |x2 - x2*| is least - when the
    roof, left alone from now on, spends half the horizon below its target and half above it. Left
    alone it holds x2 + C(t), so that is where x2 + median C = x2*. Were the sum of squares to be
    least, it would be the mean in place of the median.

    Two things this leaves out, and a planner does not: that one can still pump later (if the roof
    is to fall below its target in the second half only, it is better to wait), and that pumping
    takes time (a minute and a half at full flow for the paper's site, against half a day). A dry
    forecast has a negative median, which counts as 0, because the pumps do not work above the
    target (Eq. 3a): then it is the paper's controller.

    For a microcontroller: from the hourly forecast add up rain times the bed's area less
    evapotranspiration, sort the sums, take the one in the middle, once a minute. The level to
    switch at is the target less that volume over the bed's area. Two sums more, kept tick by tick,
    make it fit for a real site:
    :class:`~greenroof_ros.controllers.roof_observer.RoofObserver` averages the level's readings,
    :class:`~greenroof_ros.controllers.regret_limit.RegretLimit` limits what a forecast of rain that
    never comes can do.

    Attributes:
        fraction: v, the command when pumping (share of the maximum flow).
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (
        HORIZON, FRACTION, OBSERVER_TIME_CONSTANT, MAX_WAITING_LOSS,
    )

    def __init__(
        self,
        site: Site,
        horizon: float,
        fraction: float,
        observer_time_constant: float,
        max_waiting_loss: float,
    ) -> None:
        """Take the site and the parameters.

        Args:
            site: the parameters of Table I.
            horizon: how far to look ahead (h).
            fraction: v.
            observer_time_constant: over how long (s) readings of the roof's level are averaged.
            max_waiting_loss: what waiting for rain may cost (h of an empty roof).
        """
        self._site = site
        self.fraction = fraction
        self._lengths = np.diff(growing_steps(horizon))
        self._observer = RoofObserver(site, observer_time_constant)
        self._regret_limit = RegretLimit(site, max_waiting_loss)

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
        if not len(precipitation) == len(evapotranspiration) == len(self._lengths):
            raise ConfigurationError(
                f"the forecasts have {len(precipitation)} and {len(evapotranspiration)} entries, "
                f"but there are {len(self._lengths)} steps to the horizon; give weather and "
                "controller the same horizon, and only scenario_mpc all members"
            )
        rain, evaporated = np.asarray(precipitation), np.asarray(evapotranspiration)
        x1 = site.cistern_volume(cistern_level)
        if not math.isfinite(x1 + roof_level + float(rain.sum() + evaporated.sum())):
            self.skip()
            return 0.0
        x2 = self._observer.correct(roof_level)
        waited = self._regret_limit.judge(x1, x2, self.fraction)
        room = 0.0 if waited else self._room(x2, rain, evaporated)
        dry = x2 < site.x2_star - room and cistern_level >= site.suction_level
        command = self.fraction if dry else 0.0
        pumped = pump_flow(site, x1, x2, command)
        self._regret_limit.move(
            x1, x2, self.fraction, pumped, float(rain[0]), float(evaporated[0])
        )
        self._observer.predict(x2, float(rain[0]), float(evaporated[0]), pumped)
        return command

    def skip(self) -> None:
        """Wait for the next reading."""
        self._observer.skip()
        self._regret_limit.skip()

    def _room(self, x2: float, rain: Array, evaporated: Array) -> float:
        """Return m, what to leave room for (m3)."""
        (inflow,) = free_changes(self._site, x2, rain[None], evaporated, self._lengths)
        # Half-way through each step, since there the sum is the step's mean.
        return max(0.0, _median(np.cumsum(inflow) - inflow / 2, self._lengths))

    def statistics(self) -> None:
        """It has no solver."""


def _median(values: Array, weights: Array) -> float:
    """Return the value below which half of the weights lie."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(reached, reached[-1] / 2)]])
