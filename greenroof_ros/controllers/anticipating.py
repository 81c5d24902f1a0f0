"""What the controllers that wait for forecast rain share: their parameters, forecasts and ticks.

A tick of :class:`Anticipating` estimates the water on the roof, limits the cost of waiting, and
leaves the decision to a subclass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.regret_budget import WAITING_BUDGET, WAITING_SHARE, RegretBudget
from greenroof_ros.controllers.roof import OBSERVER_TIME_CONSTANT, RoofObserver
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.site.horizon import MAX_HORIZON, MAX_MEMBERS, Array, growing_steps
from greenroof_ros.site.site import Site

_DAY_S = 86_400.0
# Mean net loss of a roof as a share of its evapotranspiration. 1 - rain / evapotranspiration has a
# mean of 0.31 over Toronto's seasons (May to October) of 2015 to 2025, and is 0.04 to 0.55 in
# single seasons.
_NET_DRYING = 0.3

# Maximum horizon at which a service's forecasts are worth using (h): doc/results.md.
_PAYS, _PAYS_ON_FIELD_CAPACITY = 120.0, 48.0
OF_FORECAST = (
    Parameter(
        "horizon", _PAYS, "h", 0.1, MAX_HORIZON,
        f"length of the forecast that is used; {_PAYS_ON_FIELD_CAPACITY:g} by default on a "
        "field-capacity soil; the weather node needs the same value",
        on_field_capacity=_PAYS_ON_FIELD_CAPACITY,
    ),
    # By default, as many days as the longest forecast covers.
    Parameter(
        "days_after", 10, "days", 0, 10,
        "days of slow drying by which the plan extends the forecast; 0 if the run ends with it",
    ),
)
OF_WAITING = (OBSERVER_TIME_CONSTANT, WAITING_BUDGET, WAITING_SHARE)

Forecasts: TypeAlias = tuple[Array, Array]
"""rain (m/s), shape (members, steps), and evapotranspiration (m3/s), shape (steps,)"""


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
        lengths: lengths of these steps (s).
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
        self.lengths = np.diff(self.edges)
        first_day = np.diff(np.minimum(edges, _DAY_S))
        self._first_day = first_day / first_day.sum()
        self._gain = -math.expm1(-site.tau / _DAY_S)
        self._begun, self.mean = False, 0.0

    def read(
        self, rain: Sequence[Any], evapotranspiration: Sequence[float], max_members: int
    ) -> Forecasts | None:
        """Return the forecasts of this tick as arrays, without copying, and update the mean.

        Args:
            rain: forecast of rain (m/s), for all members or for a single member.
            evapotranspiration: forecast of evapotranspiration (m3/s).
            max_members: maximum number of members.

        Returns:
            The forecasts; None without a forecast, or if a value is missing.

        Raises:
            ConfigurationError: if the shape of a forecast is wrong, or if there are too many
                members.
        """
        if not (np.size(rain) or np.size(evapotranspiration)):
            return None
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
        if not math.isfinite(float(rains.sum() + evaporated.sum())):
            return None
        if not self._begun:
            # No dot product: its order of summation can depend on the memory address.
            self._begun, self.mean = True, float((self._first_day * evaporated).sum())
        self.mean += self._gain * (float(evaporated[0]) - self.mean)
        return rains, evaporated

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


class Anticipating:
    """A controller that waits for forecast rain instead of pumping; a subclass decides.

    An observer filters the roof's level, and a budget limits the cost of waiting:
    :class:`~greenroof_ros.controllers.roof.RoofObserver` and
    :class:`~greenroof_ros.controllers.regret_budget.RegretBudget`. A forecast with a missing value
    is treated as lost.

    Attributes:
        horizon: length of the forecast that is used (h).
        fraction: command of on/off control, with which the cost of waiting is compared.
        gauge_rain: rain measured by the gauge of a live site (m/s); 0 without a gauge.
    """

    ensemble: ClassVar[bool] = False
    needs_forecast: ClassVar[bool] = True

    def __init__(
        self, site: Site, fraction: float, horizon: float, days_after: float,
        observer_time_constant: float, waiting_budget: float, waiting_share: float,
    ) -> None:
        """Set the site, and the parameters in :data:`OF_FORECAST` and :data:`OF_WAITING`."""
        self._site, self._p = site, plant_parameters(site)
        self.horizon, self.fraction = horizon, fraction
        self._after = AfterForecast(site, horizon, days_after)
        self._observer = RoofObserver(site, observer_time_constant)
        self._regret_budget = RegretBudget(site, waiting_budget, waiting_share)
        self._tick, self._last = 0, -1  # the current tick, and the last one with a reading
        self._quiet, self.gauge_rain = False, 0.0
        # Rain (m/s) and evapotranspiration (m3/s) now, and whether forecasts of rain are used.
        self._now, self._rain_counts = (0.0, 0.0), True

    @property
    def learned(self) -> dict[str, float]:
        """The costs so far (m3 s), which must survive a restart of a live controller."""
        budget = self._regret_budget
        return {"waiting_loss_m3_s": budget.loss, "onoff_cost_m3_s": budget.onoff_cost}

    @learned.setter
    def learned(self, values: Mapping[str, float]) -> None:
        budget = self._regret_budget
        budget.loss, budget.onoff_cost = (values[name] for name in self.learned)

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Sequence[Any],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Compute the command from the levels and the forecast.

        See :class:`greenroof_ros.controllers.protocol.Controller`.

        The forecasts are means over the steps of
        :func:`greenroof_ros.site.horizon.growing_steps`; rain can have shape (members, steps).
        """
        forecast = self._after.read(
            precipitation, evapotranspiration, MAX_MEMBERS if self.ensemble else 1
        )
        x1 = self._site.cistern_volume(cistern_level)
        lost = forecast is None and self.needs_forecast
        if lost or not math.isfinite(x1 + roof_level):
            self.skip()
            return 0.0
        seconds, self._last = self._seconds_since(self._last), self._tick
        x2 = self._observer.correct(roof_level, seconds)
        self._rain_counts = not self._regret_budget.judge(x1, x2, self.fraction, seconds)
        self._now = self.gauge_rain, self._after.mean
        if forecast is not None:
            self._now = float(forecast[0][0, 0]), float(forecast[1][0])
        command = self._decide(x1, x2, forecast)
        onoff = 0.0 if self._quiet else self.fraction
        after = self._regret_budget.move(x1, x2, onoff, command, *self._now)
        self._observer.predicted = after.roof
        self._tick += 1
        return command

    def _decide(self, x1: float, x2: float, forecast: Forecasts | None) -> float:
        """Return the command for the volumes in the cistern and on the roof (m3)."""
        raise NotImplementedError

    def skip(self) -> None:
        """Skip a tick without a reading."""
        self._tick += 1

    def _seconds_since(self, tick: float) -> float:
        """Return the time since a tick (s)."""
        return (self._tick - tick) * self._site.tau
