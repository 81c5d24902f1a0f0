"""Policies for the valve of the low outlet, which work alongside any controller of the pump.

The cistern keeps storm water out of the sewer only if it has room when the rain comes. A policy
decides in every tick how far to open the valve (as a share from 0 to 1). ``closed`` keeps the valve
closed, and ``open`` turns it into an orifice without a valve. ``drain`` makes room in dry weather.
``plan`` makes room before forecast rain, and otherwise keeps the water that the roof will need.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.decide import OwnCode, valid_number
from greenroof_ros.controllers.outlet_plan import HORIZON_H, PlanClock, find_levels
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import PlantParameters, plant_parameters
from greenroof_ros.physics.storm_water import is_wet, time_without_rain
from greenroof_ros.site.site import Site

POLICIES = CLOSED, OPEN, DRAIN, PLAN = "closed", "open", "drain", "plan"
PRICE = 0.3
"""Usual cost of one m3 of mains water, in m3 of discharge in wet weather (1)."""

# The policies from this place on drain the cistern; the place of the others is their share.
_DRAINS = 2

# The default reserve: ten days of irrigation at 4 mm a day [assumed], but no more than half of the
# cistern.
_RESERVE_M, _MAX_RESERVE = 0.04, 0.5

OutletPolicy: TypeAlias = Callable[[float, float, Any, Any], float]
"""what decides in each tick how far to open the valve of the low outlet, from the levels and the
forecasts of rain and of evapotranspiration: :meth:`Policy.command` or :func:`requested_share`
"""

SHARE = Range(0.0, 1.0, "1")
"""the commands to the valve"""

PARAMETERS = (
    Parameter(
        "outlet", DRAIN, "", meaning="policy of the outlet valve, which never moves or, in dry "
        "weather, opens until the cistern is down to the reserve (drain), or before forecast rain "
        "for which there is no room (plan; without a forecast like drain)", among=POLICIES,
    ),
    Parameter(
        "outlet_reserve", math.nan, "m3", 0.0, 1e9, "volume that drain leaves in the cistern, and "
        "plan if outlet_reach needs less; by default, ten days of irrigation at 4 mm a day, but at "
        "most half the cistern",
    ),
    Parameter(
        "outlet_price", PRICE, "1", 0.0, 1e3, "for plan: cost of 1 m3 of mains water, in m3 of "
        "discharge in wet weather",
    ),
    Parameter(
        "outlet_reach", 20.0, "days", 0.0, 365.0, "for plan: period for which the water that the "
        "roof needs is kept, unless there is no room for forecast rain",
    ),
)
"""parameters of every controller at a site with a valve"""


def find_reserve(site: Site) -> float:
    """Return the default of ``outlet_reserve`` at a site (m3)."""
    return min(_RESERVE_M * site.a2, _MAX_RESERVE * site.cistern_volume(site.z_o))


def find_horizon(parameters: Mapping[str, Any]) -> float:
    """Return the look-ahead (h) of the policy that the parameters select; 0 without a plan."""
    return float(HORIZON_H) if parameters.get("outlet") == PLAN else 0.0


def requested_share(controller: Any, *_: object) -> float:
    """Return the share to which a controller that commands the valve itself opens it.

    Args:
        controller: the controller, after it has decided or skipped the tick.

    Raises:
        ControllerError: if the share is not a number from 0 to 1, or the controller's code raised
            an error.
    """
    kind = type(controller)
    with OwnCode(kind):
        share = controller.outlet
    return valid_number(kind, "outlet", "the attribute outlet", share, SHARE)


def outlet_share(
    p: PlantParameters, policy: float, wet: bool, volume: float, cistern_level: float
) -> float:
    """Return the share to which a policy opens the valve (1).

    Args:
        p: numbers of the site.
        policy: place of the policy in :data:`POLICIES`.
        wet: whether the weather is wet; then the valve does not open, except with ``open``.
        volume: volume to which ``drain`` and ``plan`` drain the cistern (m3).
        cistern_level: level in the cistern (m).
    """
    if policy < _DRAINS:
        return policy
    if wet:
        return 0.0
    x1 = cistern_level * p.a1
    full = p.tau * low_outlet_flow(p, x1)
    return min(1.0, max(0.0, x1 - volume) / full) if full > 0 else 0.0


class Policy:
    r"""One of the policies of :data:`POLICIES`.

    :mod:`greenroof_ros.physics.storm_water` states which weather is wet. In dry weather, ``drain``
    opens the valve until the cistern is down to a reserve. Water that is released in dry weather
    enters a sewer that carries no storm water. ``plan`` drains the cistern to the level of its last
    plan, and until the first plan to the reserve.

    The plan is a stochastic dynamic program over the cistern's volume v, hour by hour to the end of
    the forecast, but no more than 48 h ahead. For every member of the forecast,

        V_t(v) = min over y of  U_t(y),  y from v less an hour's discharge of the open valve to v,
        U_t(y) = c_t max(v' - full, 0) + p max(floor - v', 0) + V_{t+1}(v'),
        v' = y + inflow - need of the roof,

    where c is 1 in wet weather and 0 in dry weather. The cost is the discharge in wet weather (m3)
    plus p per m3 of mains water. In wet weather, y is v, because a release then costs at least as
    much as it can save. At the end of the plan, water is worth its price if the roof needs this
    water within ``outlet_reach``. Additional water is worth nothing, so it is released in dry
    weather, which makes room for rain that no forecast has predicted.

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
        self, site: Site, ends: NDArray[np.float64], without_rain: float, outlet: str,
        outlet_reserve: float, outlet_price: float, outlet_reach: float,
    ) -> None:
        """Set the site and the policy; see :data:`PARAMETERS` for the units and meanings.

        Args:
            site: site with a valve.
            ends: boundaries of the forecasts' steps (s from now), starting at 0.
            without_rain: time without rain before the first tick (s).
            outlet: name of the policy.
            outlet_reserve: volume that ``drain`` leaves in the cistern.
            outlet_price: price of mains water.
            outlet_reach: time for which stored water has a value.
        """
        self._site, self._p = site, plant_parameters(site)
        self._policy, self._volume = float(POLICIES.index(outlet)), outlet_reserve
        self._without_rain = without_rain
        self._clock, self._plans = PlanClock(site.tau), outlet == PLAN
        options = np.array([[outlet_reserve, outlet_price, outlet_reach, 1.0]])
        self._given = [self._p], options, ends

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Any,
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the share to which the valve is open in the current tick (1).

        A forecast with a missing value is treated as lost.

        Args:
            cistern_level: water depth in the cistern (m).
            roof_level: water in the roof's substrate, as a depth (m).
            precipitation: forecast of rain (m/s), in the shape that the controller receives; the
                first entry is the current rain.
            evapotranspiration: forecast of evapotranspiration (m3/s); the first entry is the
                current value.
        """
        site, forecast = self._site, np.asarray(precipitation, dtype=float)
        rain = float(forecast.flat[0]) if forecast.size else math.nan
        self._without_rain = time_without_rain(self._without_rain, rain, site.tau)
        wet = is_wet(self._without_rain, site.tau, self._p.wet_after_s)
        if self._plans and self._clock.is_due(wet):
            (self._volume,) = find_levels(
                *self._given, np.array([site.cistern_volume(cistern_level)]),
                np.array([site.roof_volume(roof_level)]), np.atleast_2d(forecast),
                np.asarray(evapotranspiration, dtype=float),
            ).tolist()
        return outlet_share(self._p, self._policy, wet, self._volume, cistern_level)
