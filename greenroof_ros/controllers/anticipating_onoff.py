"""An on/off controller that anticipates the weather: no model, no solver, one level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greenroof_ros.errors import ConfigurationError
from greenroof_ros.look_ahead import growing_steps
from greenroof_ros.site import Site


class AnticipatingOnOff:
    """Pumps as the on/off controller does, but up to a level that leaves room for what comes.

    The paper asks for it: a 'less expensive, hybrid' design, an on/off controller that anticipates
    the weather (Conclusion). The paper's on/off controller, Eq. (12), fills the roof to its target
    x2*. If rain comes then, the roof stays too wet for the rest of the day, since nothing but
    evapotranspiration takes water off it. This one fills it to x2* - m only, where

        m = max(0, median of C(t) over the horizon),
        C(t) = what rain less evapotranspiration bring to the roof from now until t.

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
    switch at is the target less that volume over the bed's area.

    Attributes:
        fraction: v, the command when pumping (share of the maximum flow).
    """

    def __init__(self, site: Site, horizon: float, fraction: float) -> None:
        """Take the site, how far to look ahead (h), and v."""
        self._site = site
        self.fraction = fraction
        self._lengths = np.diff(growing_steps(horizon))

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Decide from levels and forecast; see :class:`greenroof_ros.controllers.Controller`.

        The forecasts are means over the steps of :func:`greenroof_ros.look_ahead.growing_steps`.
        """
        site = self._site
        if not len(precipitation) == len(evapotranspiration) == len(self._lengths):
            raise ConfigurationError(
                f"the forecasts have {len(precipitation)} and {len(evapotranspiration)} entries, "
                f"but there are {len(self._lengths)} steps to the horizon; give weather and "
                "controller the same"
            )
        if not (roof_level < site.z_veg and cistern_level >= site.suction_level):
            return 0.0
        rates = np.asarray(precipitation) * site.a2 - np.asarray(evapotranspiration)
        sums = np.cumsum(rates * self._lengths)
        # Half-way through each step, since there the sum is the step's mean.
        room = max(0.0, _median(sums - rates * self._lengths / 2, self._lengths))
        return self.fraction if roof_level < site.z_veg - site.roof_level(room) else 0.0

    def statistics(self) -> None:
        """It has no solver."""


def _median(values: np.ndarray[tuple[int], np.dtype[np.float64]],
            weights: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return the value below which half of the weights lie."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(reached, reached[-1] / 2)]])
