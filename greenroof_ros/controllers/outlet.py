"""Policies for the valve of the low outlet, which work alongside any controller of the pump.

The cistern keeps storm water out of the sewer only if it has room when the rain comes. A policy
decides in every tick how far to open the valve (as a share from 0 to 1). ``closed`` keeps the valve
closed, and ``open`` turns it into an orifice without a valve. ``drain`` makes room in dry weather.
``plan`` makes room before forecast rain, and otherwise keeps the water that the roof will need.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import HangError, describe_value
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.ranges import Range
from greenroof_ros.controllers.failure import ControllerError, find_place, locate_error
from greenroof_ros.controllers.outlet_plan import HORIZON_H, PlannedLevels
from greenroof_ros.model.sites import Sites
from greenroof_ros.physics.plant import low_outlet_flow
from greenroof_ros.physics.storm_water import WET_RAIN
from greenroof_ros.site.site import Site

Array = NDArray[np.float64]

POLICIES = CLOSED, OPEN, DRAIN, PLAN = "closed", "open", "drain", "plan"
PRICE = 0.3
"""Usual cost of one m3 of mains water, in m3 of discharge in wet weather (1)."""

_HOUR_S = 3600.0
MIN_RAIN = WET_RAIN * (1 - 1e-9)
"""Rain of 0.1 mm/h (m/s): rates are rounded, and an hour with 0.1 mm must not fall below it."""

# The default reserve: ten days of irrigation at 4 mm a day [assumed], but no more than half of the
# cistern.
_RESERVE_M, _MAX_RESERVE = 0.04, 0.5

SHARE = Range(0.0, 1.0, "1")
"""the commands to the valve"""

PARAMETERS = (
    Parameter(
        "outlet", DRAIN, "", meaning="policy of the outlet valve. closed and open: the valve never "
        "moves; drain: the valve opens in dry weather, until the cistern is down to the reserve; "
        "plan: the valve opens in dry weather before forecast rain for which the cistern has no "
        "room; without a forecast, plan behaves like drain", among=POLICIES,
    ),
    Parameter(
        "outlet_reserve", math.nan, "m3", 0.0, 1e9, "volume that drain leaves in the cistern; plan "
        "keeps this volume, or the water that the roof needs for outlet_reach if this is more, "
        "unless the cistern has no room for the forecast rain; by default, ten days of "
        "irrigation at 4 mm a day, but at most half the volume of the cistern",
    ),
    Parameter(
        "outlet_price", PRICE, "1", 0.0, 1e3, "for plan: cost of one m3 of mains water, "
        "expressed in m3 of discharge in wet weather",
    ),
    Parameter(
        "outlet_reach", 20.0, "days", 0.0, 365.0, "for plan: period for which plan keeps the "
        "water that the roof needs; in dry weather, plan releases all water above this need and "
        "above outlet_reserve",
    ),
)
"""parameters of every controller at a site with a valve"""


def parameters_on(site: Site, policy: str) -> list[Parameter]:
    """Return :data:`PARAMETERS` with their defaults at a site.

    Args:
        site: site with a valve.
        policy: default policy of the controller.
    """
    reserve = min(_RESERVE_M * site.a2, _MAX_RESERVE * site.cistern_volume(site.z_o))
    defaults = {"outlet": policy, "outlet_reserve": reserve}
    return [
        replace(parameter, default=defaults.get(parameter.name, parameter.default))
        for parameter in PARAMETERS
    ]


def find_horizon(parameters: Mapping[str, Any]) -> float:
    """Return the look-ahead (h) of the policy that the parameters select; 0 without a plan."""
    return float(HORIZON_H) if parameters.get("outlet") == PLAN else 0.0


class OutletPolicy(Protocol):
    """Decides how far to open the valve of the low outlet."""

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Any,
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the share to which the valve is open in the current tick (1).

        Args:
            cistern_level: water depth in the cistern (m).
            roof_level: water in the roof's substrate, as a depth (m).
            precipitation: forecast of rain (m/s), in the shape that the controller receives; the
                first entry is the current rain.
            evapotranspiration: forecast of evapotranspiration (m3/s); the first entry is the
                current value.
        """
        ...


def make_outlet(
    site: Site, ends: Array, outlet: str, outlet_reserve: float, outlet_price: float,
    outlet_reach: float,
) -> OutletPolicy:
    """Make a policy; see :data:`PARAMETERS` for the units and meanings.

    Args:
        site: site with a valve.
        ends: boundaries of the forecasts' steps (s from now), starting at 0.
        outlet: name of the policy.
        outlet_reserve: reserve of the ``drain`` policy.
        outlet_price: price of mains water.
        outlet_reach: time for which stored water has a value.
    """
    if outlet in (CLOSED, OPEN):
        return Fixed(float(outlet == OPEN))
    drain = Drain(site, outlet_reserve)
    return drain if outlet == DRAIN else Plan(site, ends, drain, outlet_price, outlet_reach)


class OfController:
    """Policy of a controller that commands the valve itself, in its attribute ``outlet``."""

    def __init__(self, controller: Any) -> None:
        """Set the controller, which decides or skips the tick before this policy is called."""
        self._controller = controller

    def command(self, *inputs: Any) -> float:
        """Return the share that the controller requests; see :class:`OutletPolicy`.

        Raises:
            ControllerError: if the share is not a number from 0 to 1, or the controller's code
                raised an error.
        """
        kind = type(self._controller)
        try:
            share = self._controller.outlet
        except HangError:
            raise
        except (Exception, SystemExit) as error:
            raise locate_error(kind, error) from error
        if share in SHARE:
            return float(share)
        place = find_place(kind, "outlet")
        file, line = place if place[0] is not None else find_place(kind, "command")
        raise ControllerError(
            f"{SHARE.expected(share)} (greenroof check-controller detects this before a run)",
            file=file, line=line,
            key=f"the attribute outlet of {kind.__name__} = {describe_value(share)}",
        )


class Fixed:
    """Policy that never moves the valve."""

    def __init__(self, share: float) -> None:
        """Set the share to which the valve is open (1)."""
        self._share = share

    def command(self, *inputs: Any) -> float:
        """Return the share; see :class:`OutletPolicy`."""
        return self._share


class Drain:
    """Opens the valve in dry weather, until the cistern is down to a reserve.

    The weather counts as wet while it rains at 0.1 mm/h or more, during lighter rain within an hour
    of such rain, and for ``wet_after`` hours afterwards. Water that is released in dry weather
    enters a sewer that carries no storm water.
    """

    def __init__(self, site: Site, reserve: float) -> None:
        """Set the site, and the volume that has to remain in the cistern (m3)."""
        self._site, self.reserve = site, reserve
        self._without_rain_s = 0.0  # time without rain until the end of the current tick (s)
        self._only_drizzle_s = math.inf  # the same, without rain of 0.1 mm/h or more (s)

    def observe(self, rain: float) -> None:
        """Count the time without rain; call this once per tick, with the current rain (m/s)."""
        tau = self._site.tau
        self._only_drizzle_s = 0.0 if rain >= MIN_RAIN else self._only_drizzle_s + tau
        rains = rain > 0 and self._only_drizzle_s < _HOUR_S
        self._without_rain_s = 0.0 if rains else self._without_rain_s + tau

    @property
    def wet_hours(self) -> float:
        """Return the time for which the weather remains wet if there is no more rain (h)."""
        before = max(0.0, self._without_rain_s - self._site.tau)
        return max(0.0, self._site.wet_after - before / _HOUR_S)

    @property
    def dry(self) -> bool:
        """Whether the weather is dry in the current tick."""
        return self._without_rain_s > 0 and not self.wet_hours

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Any,
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the share that drains the cistern to the reserve; see :class:`OutletPolicy`."""
        self.observe(find_present(precipitation))
        return self.drain_to(self.reserve, cistern_level) if self.dry else 0.0

    def drain_to(self, volume: float, cistern_level: float) -> float:
        """Return the largest share that keeps the cistern at or above a volume (m3) in the tick."""
        x1 = self._site.cistern_volume(cistern_level)
        full = self._site.tau * low_outlet_flow(self._site, x1)
        return min(1.0, max(0.0, x1 - volume) / full) if full > 0 else 0.0


class Plan:
    r"""Opens the valve in dry weather to make room for forecast rain; otherwise keeps the water.

    The plan is a stochastic dynamic program over the cistern's volume v, hour by hour to the end of
    the forecast, but no more than 48 h ahead. For every member of the forecast,

        V_t(v) = min over y of  U_t(y),  y from v less an hour's discharge of the open valve to v,
        U_t(y) = c_t max(v' - full, 0) + p max(floor - v', 0) + V_{t+1}(v'),
        v' = y + inflow - need of the roof,

    where c is 1 in wet weather and 0 in dry weather. The cost is the discharge in wet weather (m3)
    plus p per m3 of mains water. In wet weather, y is v, because a release then costs at least as
    much as it can save. At the end of the plan, water is worth its price if the roof needs this
    water within ``reach``. Additional water is worth nothing, so it is released in dry weather,
    which makes room for rain that no forecast has predicted.

    Above the outlet, U falls to its minimum and then rises. The best y is therefore a level to
    which the cistern is drained, as far as the valve allows. The level of the first hour is the
    same for all members, and is based on the mean of their U; for later hours, the plan assumes
    that it is known which member comes true. Among levels that cost the same, the highest is
    chosen, so that water is kept until it has to be released.

    Once the water above the target is used up, the need of the roof is evapotranspiration minus
    rain. A forecast says nothing about the weather after its end. The plan therefore keeps no more
    water than the open valve could drain down to the reserve of ``drain`` by that time. With a
    short forecast or a small valve, the plan is equivalent to ``drain``.
    """

    def __init__(
        self, site: Site, ends: Array, drain: Drain, price: float, reach: float
    ) -> None:
        """Set the site, the steps of the forecasts, and the policy without a forecast.

        Args:
            site: site with a valve.
            ends: boundaries of the forecasts' steps (s from now), starting at 0.
            drain: policy that counts the dry hours, and decides without a forecast.
            price: price of one m3 of mains water, in m3 of discharge in wet weather (1).
            reach: number of days for which stored water is worth its price.
        """
        self._site, self._drain = site, drain
        self._levels = PlannedLevels(
            Sites.of([site]), ends, np.array([drain.reserve]), np.array([price]),
            np.array([reach]), np.ones(1),
        )

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Any,
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the share that drains the cistern to the plan's level; 0 in wet weather.

        See :class:`OutletPolicy`. A forecast with a missing value is treated as lost.
        """
        site = self._site
        self._drain.observe(find_present(precipitation))
        level = self._levels.update(
            self._drain.dry, lambda: (
                np.array([site.cistern_volume(cistern_level)]),
                np.array([site.roof_volume(roof_level)]),
                np.atleast_2d(np.asarray(precipitation, dtype=float)),
                np.asarray(evapotranspiration, dtype=float),
            ),
        )
        if not self._drain.dry:
            return 0.0
        return self._drain.drain_to(float(level[0]), cistern_level)


def find_present(precipitation: Any) -> float:
    """Return the current rain (m/s) from a forecast; NaN if the forecast is empty."""
    if not len(precipitation):
        return math.nan
    first = precipitation[0]
    if isinstance(first, float):
        return first
    return float(first[0]) if len(first) else math.nan
