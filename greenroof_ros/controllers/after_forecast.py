"""What a controller that looks ahead expects of the days after its forecast."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.look_ahead import LONGEST_HORIZON, growing_steps
from greenroof_ros.model.site import Site

_DAY_S = 86_400.0
# What a roof loses in the mean, as a share of the evapotranspiration: 1 - rain / evapotranspiration
# is 0.31 in the mean over Toronto's seasons of 2015 to 2025, May to October, and 0.04 to 0.55 each.
_NET_DRYING = 0.3

# As far as forecasts of a service pay: doc/running/seasons.md.
_PAYS, _PAYS_MEASURED = 120.0, 48.0
HORIZON = Parameter(
    "horizon", _PAYS, "h", 0.1, LONGEST_HORIZON,
    f"how far it looks ahead; on a roof with a measured soil {_PAYS_MEASURED:g} unless given; the "
    "weather node needs the same", measured=_PAYS_MEASURED,
)
# By default as many days as the longest forecast has.
DAYS_AFTER = Parameter(
    "days_after", 10, "days", 0, 10,
    "days after the forecast that count, too, in which the roof dries slowly; 0 for a roof whose "
    "time ends with the forecast",
)

Array = NDArray[np.float64]


class AfterForecast:
    """Lengthens a forecast by days in which the roof dries slowly.

    What is on the roof at the end of the forecast does not vanish: without rain it stays for days,
    since only evapotranspiration takes it off. Who plans for the forecast's time alone fills the
    roof before a rain at its end, at no cost to the plan, and has too much on it afterwards. The
    shorter the forecast, the more of that. So the deviation counts for ``days_after`` more
    days, in which there is no rain, and evapotranspiration is 0.3 of its mean over the past day:
    what rain and evapotranspiration leave between them in a usual summer. The mean is over a
    whole day, so that it is right at night, too; at first it is the forecast's first day's.

    Without these days the forecast's end is the end of all. That is right for a study whose runs
    end there, as the paper's 12 h do, and for no roof that lives on.

    Attributes:
        edges: ends of all steps (s from now), of the forecast and of the days after it, the
            first 0, shape (steps + days_after + 1,).
        steps: of the forecast.
    """

    def __init__(self, site: Site, horizon: float, days_after: float) -> None:
        """Take the site, how far the forecast reaches (h), and how many whole days follow."""
        edges = growing_steps(horizon)
        self.steps = len(edges) - 1
        self._days = int(days_after)
        self.edges = np.concatenate((edges, edges[-1] + _DAY_S * np.arange(1, self._days + 1)))
        first_day = np.diff(np.minimum(edges, _DAY_S))
        self._first_day = first_day / first_day.sum()
        self._gain = -math.expm1(-site.tau / _DAY_S)
        self._mean = math.nan

    def checked(
        self, rain: Sequence[Any], evapotranspiration: Sequence[float], most: int
    ) -> tuple[Array, Array]:
        """Return forecasts as arrays, of shape (members, steps) and (steps,).

        Args:
            rain: (m/s), of all members or of one.
            evapotranspiration: (m3/s).
            most: members at most.

        Raises:
            ConfigurationError: they are not of this shape.
        """
        rains = np.array(rain, dtype=float, order="C", ndmin=2)
        evaporated = np.array(evapotranspiration, dtype=float)
        if (rains.shape[1], *evaporated.shape) != (self.steps, self.steps) or len(rains) > most:
            raise ConfigurationError(
                f"the forecasts of rain have {len(rains)} members of {rains.shape[1]} entries, "
                f"evapotranspiration has {len(evaporated)}; there are {self.steps} steps to "
                f"the horizon, and members at most {most}; give weather and controller the same "
                "horizon, and only lookahead all members"
            )
        return rains, evaporated

    def pass_tick(self, evapotranspiration: Array) -> None:
        """Take a tick's forecast into the mean (m3/s, shape (steps,)); its first entry is now."""
        if math.isnan(self._mean):
            # No dot product: the order of its sums may follow where in memory they lie.
            self._mean = float((self._first_day * evapotranspiration).sum())
        self._mean += self._gain * (float(evapotranspiration[0]) - self._mean)

    def lengthen(self, rain: Array, evapotranspiration: Array) -> tuple[Array, Array]:
        """Return rain (m/s) and evapotranspiration (m3/s) of all steps.

        Args:
            rain: that is forecast, shape (members, steps).
            evapotranspiration: likewise, shape (steps,).

        Returns:
            Shape (members, steps + days_after) and (steps + days_after,).
        """
        no_rain = np.zeros((len(rain), self._days))
        drying = np.full(self._days, _NET_DRYING * self._mean)
        return np.hstack((rain, no_rain)), np.concatenate((evapotranspiration, drying))
