"""Assumptions of the look-ahead controllers about the days after a forecast ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.site.horizon import MAX_HORIZON, growing_steps
from greenroof_ros.site.site import Site

_DAY_S = 86_400.0
# Mean net loss of a roof as a share of its evapotranspiration. 1 - rain / evapotranspiration has a
# mean of 0.31 over Toronto's seasons (May to October) of 2015 to 2025, and is 0.04 to 0.55 in
# single seasons.
_NET_DRYING = 0.3

# Maximum horizon at which a service's forecasts are worth using (h): doc/results.md.
_PAYS, _PAYS_ON_FIELD_CAPACITY = 120.0, 48.0
HORIZON = Parameter(
    "horizon", _PAYS, "h", 0.1, MAX_HORIZON,
    f"length of the forecast that is used; the default is {_PAYS_ON_FIELD_CAPACITY:g} on a roof "
    "with field-capacity soil, and the weather node needs the same value",
    on_field_capacity=_PAYS_ON_FIELD_CAPACITY,
)
# By default, as many days as the longest forecast covers.
DAYS_AFTER = Parameter(
    "days_after", 10, "days", 0, 10,
    "number of days by which the plan extends the forecast and during which the roof dries "
    "slowly; set 0 if the run ends with the forecast",
)

Array = NDArray[np.float64]


class AfterForecast:
    """Extends a forecast by days during which the roof dries slowly.

    Water on the roof at the end of the forecast does not vanish: without rain, this water stays for
    days, since only evapotranspiration removes it. A controller that plans only up to the end of
    the forecast fills the roof even if rain is forecast for the last hours, because the excess
    costs nothing in the plan. The roof then holds too much water. The shorter the forecast, the
    larger this error. The plan therefore also covers the deviation over the following
    ``days_after`` days, for which it assumes no rain and 0.3 times the mean evapotranspiration of
    the past day. In summer, evapotranspiration minus rain amounts to about this share of
    evapotranspiration. The mean covers a whole day, so that the time of day does not matter, and is
    initialized with the mean over the first day of the forecast.

    With ``days_after`` = 0, the deviation after the end of the forecast is not counted. This
    setting suits a study whose runs end with the forecast, such as the paper's 12 h runs, but not a
    real roof.

    Attributes:
        edges: boundaries of the steps of the forecast and of the days after it (s from now),
            starting at 0, shape (steps + days_after + 1,).
        steps: number of steps in the forecast.
        mean: exponential moving average of evapotranspiration with a time constant of one day
            (m3/s); 0 before the first forecast.
    """

    def __init__(self, site: Site, horizon: float, days_after: float) -> None:
        """Set the site, the length of the forecast (h), and the number of days after it."""
        edges = growing_steps(horizon)
        self.steps = len(edges) - 1
        self._days = int(days_after)
        self.edges = np.concatenate((edges, edges[-1] + _DAY_S * np.arange(1, self._days + 1)))
        first_day = np.diff(np.minimum(edges, _DAY_S))
        self._first_day = first_day / first_day.sum()
        self._gain = -math.expm1(-site.tau / _DAY_S)
        self.mean = 0.0
        self._begun = False

    def check(
        self, rain: Sequence[Any], evapotranspiration: Sequence[float], max_members: int
    ) -> tuple[Array, Array]:
        """Return the forecasts as arrays of shape (members, steps) and (steps,), without copying.

        Args:
            rain: forecast of rain (m/s), for all members or for a single member.
            evapotranspiration: forecast of evapotranspiration (m3/s).
            max_members: maximum number of members.

        Raises:
            ConfigurationError: if the shape of a forecast is wrong, or if there are too many
                members.
        """
        rains = np.atleast_2d(np.asarray(rain, dtype=float, order="C"))
        evaporated = np.asarray(evapotranspiration, dtype=float)
        fits = (rains.shape[1], *evaporated.shape) == (self.steps, self.steps)
        if not fits or len(rains) > max_members:
            raise ConfigurationError(
                f"the rain forecast has {len(rains)} x {rains.shape[1]} values (members x steps), "
                f"and the evapotranspiration forecast has {len(evaporated)}, but at most "
                f"{max_members} x {self.steps} and exactly {self.steps} values are allowed; set "
                "the same horizon for the weather node and the controller, and use all members "
                "only with lookahead"
            )
        return rains, evaporated

    def pass_tick(self, evapotranspiration: Array) -> None:
        """Update the mean with a forecast (m3/s, shape (steps,)) that starts in this tick."""
        if not self._begun:
            # No dot product: its order of summation can depend on the memory address.
            self.mean = float((self._first_day * evapotranspiration).sum())
            self._begun = True
        self.mean += self._gain * (float(evapotranspiration[0]) - self.mean)

    def lengthen(self, rain: Array, evapotranspiration: Array) -> tuple[Array, Array]:
        """Return rain (m/s) and evapotranspiration (m3/s) for the forecast and the days after it.

        Args:
            rain: forecast of rain (m/s), shape (members, steps).
            evapotranspiration: forecast of evapotranspiration (m3/s), shape (steps,).

        Returns:
            Arrays of shape (members, steps + days_after) and (steps + days_after,).
        """
        no_rain = np.zeros((len(rain), self._days))
        drying = np.full(self._days, _NET_DRYING * self.mean)
        return np.hstack((rain, no_rain)), np.concatenate((evapotranspiration, drying))
