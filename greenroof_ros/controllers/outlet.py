"""What commands the valve of the low outlet, beside any controller of the pump.

The cistern keeps storm water out of the sewer only if there is room in it when the rain comes. A
policy decides in each tick how far the valve is open (share, 0 to 1): ``closed``; ``open``, an
orifice without a valve; ``drain``, which makes room in dry weather; and ``plan``, which makes it
before forecast rain, and otherwise keeps what the roof will need.
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
from greenroof_ros.model.plant import low_outlet_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of
from greenroof_ros.model.storm_water import WET_RAIN, Intervals, find_wet_weather

Array = NDArray[np.float64]

POLICIES = CLOSED, OPEN, DRAIN, PLAN = "closed", "open", "drain", "plan"
HORIZON_H = 48
"""How far a plan looks ahead (h)."""
PRICE = 0.3
"""Usual cost of a m3 of mains water, in m3 of discharge in wet weather (1)."""

_HOUR_S, _DAY_S = 3600.0, 86_400.0
# Nodes of the cistern's volume in a plan.
_NODES = 121
# A plan is made each hour, or if a member's total rain has changed by more than this (m).
_CHANGED_M = 1e-3
# Interval (s) at which it checks whether they have.
_CHECK_S = 60.0
# Levels whose costs differ by less than this share of the cistern cost the same.
_TIE = 1e-3
# Rates are rounded: an hour with 0.1 mm must not be one with less.
_MIN_RAIN = WET_RAIN * (1 - 1e-9)
# The reserve, unless given: ten days of irrigation at 4 mm a day [assumed], but at most half of
# the cistern.
_RESERVE_M, _MAX_RESERVE = 0.04, 0.5

SHARE = Range(0.0, 1.0, "1")
"""the commands to the valve"""

PARAMETERS = (
    Parameter(
        "outlet", DRAIN, "", meaning="what commands the outlet's valve. closed and open: always; "
        "drain: opens in dry weather, down to the reserve; plan: opens in dry weather before "
        "forecast rain that would not fit, and is drain without a forecast", among=POLICIES,
    ),
    Parameter(
        "outlet_reserve", math.nan, "m3", 0.0, 1e9, "drain leaves this volume in the cistern, "
        "and so does plan unless more rain is forecast than fits; by default ten days of "
        "irrigation at 4 mm a day, or half of a smaller cistern",
    ),
    Parameter(
        "outlet_price", PRICE, "1", 0.0, 1e3, "plan: cost of a m3 of mains water, in m3 of "
        "discharge in wet weather",
    ),
    Parameter(
        "outlet_reach", 20.0, "days", 0.0, 365.0, "plan: keeps what the roof needs for this long; "
        "more than that, and more than the reserve, it lets out in dry weather",
    ),
)
"""of every controller at a site with a valve"""


def parameters_on(site: Site, policy: str) -> list[Parameter]:
    """Return :data:`PARAMETERS` with their defaults at a site.

    Args:
        site: with a valve.
        policy: that a controller has unless another is asked for.
    """
    reserve = min(_RESERVE_M * site.a2, _MAX_RESERVE * site.cistern_volume(site.z_o))
    defaults = {"outlet": policy, "outlet_reserve": reserve}
    return [
        replace(parameter, default=defaults.get(parameter.name, parameter.default))
        for parameter in PARAMETERS
    ]


def find_horizon(parameters: Mapping[str, Any]) -> float:
    """Return how far the policy of a controller's parameters looks ahead (h)."""
    return float(HORIZON_H) if parameters.get("outlet") == PLAN else 0.0


class OutletPolicy(Protocol):
    """Decides how far the valve of the low outlet is open."""

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Any,
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the share to which the valve is open in the present tick (1).

        Args:
            cistern_level: water depth in the cistern (m).
            roof_level: water in the roof's substrate, as a depth (m).
            precipitation: forecast of rain (m/s), as the controller gets it; the first entry is
                now.
            evapotranspiration: forecast (m3/s), likewise.
        """
        ...


def make_outlet(
    site: Site, ends: Array, outlet: str, outlet_reserve: float, outlet_price: float,
    outlet_reach: float,
) -> OutletPolicy:
    """Make a policy; :data:`PARAMETERS` has the units and meanings.

    Args:
        site: with a valve.
        ends: of the steps of the forecasts (s from now), the first 0.
        outlet: name of the policy.
        outlet_reserve: of drain.
        outlet_price: of mains water.
        outlet_reach: of the value of stored water.
    """
    if outlet in (CLOSED, OPEN):
        return Fixed(float(outlet == OPEN))
    drain = Drain(site, outlet_reserve)
    return drain if outlet == DRAIN else Plan(site, ends, drain, outlet_price, outlet_reach)


class OfController:
    """Opens the valve as a controller says that commands it itself, in its attribute ``outlet``."""

    def __init__(self, controller: Any) -> None:
        """Set the controller, which decides or skips the tick before this is asked."""
        self._controller = controller

    def command(self, *inputs: Any) -> float:
        """Return the controller's share; see :class:`OutletPolicy`.

        Raises:
            ControllerError: it is not a number from 0 to 1, or its code raised an error.
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
            f"{SHARE.expected(share)} (greenroof check-controller finds this before a run)",
            file=file, line=line,
            key=f"the attribute outlet of {kind.__name__} = {describe_value(share)}",
        )


class Fixed:
    """Leaves the valve as it is."""

    def __init__(self, share: float) -> None:
        """Set the share to which it is open (1)."""
        self._share = share

    def command(self, *inputs: Any) -> float:
        """Return the share; see :class:`OutletPolicy`."""
        return self._share


class Drain:
    """Opens the valve in dry weather, until the cistern is down to a reserve.

    Weather is dry ``wet_after`` hours after the last rain of 0.1 mm/h or more, or of less within an
    hour of such rain: what is let out then meets a sewer without storm water.
    """

    def __init__(self, site: Site, reserve: float) -> None:
        """Set the site, and what is left in the cistern (m3)."""
        self._site, self.reserve = site, reserve
        self._without_rain_s = 0.0  # until the end of the present tick
        self._only_drizzle_s = math.inf  # likewise: without rain of 0.1 mm/h or more

    def observe(self, rain: float) -> None:
        """Count the time without rain; call it once a tick, with the present rain (m/s)."""
        tau = self._site.tau
        self._only_drizzle_s = 0.0 if rain >= _MIN_RAIN else self._only_drizzle_s + tau
        rains = rain > 0 and self._only_drizzle_s < _HOUR_S
        self._without_rain_s = 0.0 if rains else self._without_rain_s + tau

    @property
    def wet_hours(self) -> float:
        """How long the weather remains wet if there is no rain from now on (h)."""
        before = max(0.0, self._without_rain_s - self._site.tau)
        return max(0.0, self._site.wet_after - before / _HOUR_S)

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Any,
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the share that drains the cistern to the reserve; see :class:`OutletPolicy`."""
        self.observe(find_present(precipitation))
        return self.drain_to(self.reserve, cistern_level) if not self.wet_hours else 0.0

    def drain_to(self, volume: float, cistern_level: float) -> float:
        """Return the share with which a cistern is not below a volume (m3) after the tick."""
        x1 = self._site.cistern_volume(cistern_level)
        full = self._site.tau * low_outlet_flow(self._site, x1)
        return min(1.0, max(0.0, x1 - volume) / full) if full > 0 else 0.0


class Plan:
    r"""Opens the valve in dry weather for forecast rain that would not fit; else it keeps water.

    A stochastic dynamic program over the cistern's volume v, hour by hour to the forecast's end or
    48 h. For each member of the forecast,

        V_t(v) = min over y of  U_t(y),  with y from what the open valve leaves of v to v,
        U_t(y) = c_t max(v' - full, 0) + p max(floor - v', 0) + V_{t+1}(v'),
        v' = y + what flows in - what the roof needs,

    where c is 1 in wet weather and 0 in dry weather: the cost is the discharge in wet weather (m3),
    and p per m3 of mains water. In wet weather y is v: what is let out then costs as much as the
    most that it can save. At the end, water is worth its price as long as the roof needs it within
    the reach. Beyond that it is worth nothing, so it is let out in dry weather: the room is there
    if rain comes that no forecast has shown.

    Above the outlet U falls to its minimum and then rises, so that the best y is a level: the
    cistern is drained down to it as far as the valve can. The level of the first hour is the same
    for all members, by the mean of their U; later hours assume that it is known which member comes
    true. Of levels that cost the same the highest is taken, so that water is kept until it must go.

    What the roof needs is what evaporates, less the rain, once the water above the target is gone.

    A forecast shows only what comes until it ends. So the plan keeps at most what the open valve
    could drain to drain's reserve until then: with a short forecast or a small valve it is drain.
    """

    def __init__(
        self, site: Site, ends: Array, drain: Drain, price: float, reach: float
    ) -> None:
        """Set the site, the ends of the forecasts' steps (s), and what decides without a forecast.

        Args:
            site: with a valve.
            ends: of the steps of the forecasts (s from now), the first 0.
            drain: counts the dry hours, and decides without a forecast.
            price: of mains water, in m3 of discharge in wet weather (1).
            reach: days for which stored water is worth its price.
        """
        self._site, self._soil, self._drain = site, soil_of(site), drain
        self._ends, self._lengths = ends, np.diff(ends)
        self._price, self._reach_s = price, reach * _DAY_S
        hours = max(1, min(HORIZON_H, round(float(ends[-1]) / _HOUR_S)))
        self._hour_ends = np.minimum(_HOUR_S * np.arange(hours + 1), ends[-1])
        full = site.cistern_volume(site.z_o)
        floor = site.cistern_volume(max(site.suction_level, site.mains_level or 0.0))
        self._nodes = np.linspace(floor, full, _NODES)
        self._outlet = site.cistern_volume(site.min_outlet_level)
        # The square root of the head over the outlet falls linearly in time.
        self._fall = site.c_low / (2 * site.a1)  # of that root (m^0.5/s)
        self._drained = self._drain_hour(self._nodes)
        self._first = int(self._nodes.searchsorted(self._outlet))  # node that can be drained to
        root = math.sqrt(max(0.0, drain.reserve - self._outlet) / site.a1)
        root += self._fall * float(self._hour_ends[-1])
        self._max_level = min(full, self._outlet + site.a1 * root**2)
        self._level = full
        self._age = math.inf  # of the level (s)
        self._unchecked = math.inf  # since the forecast was last compared (s)
        self._total = np.zeros(0)  # rain of each member in the last plan (m)

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Any,
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the share that drains the cistern to the plan's level; 0 in wet weather.

        See :class:`OutletPolicy`. A forecast with a missing value is treated as lost.
        """
        site = self._site
        self._drain.observe(find_present(precipitation))
        self._age += site.tau
        self._unchecked += site.tau
        if self._drain.wet_hours:
            self._age = math.inf
            return 0.0
        if max(self._age - _HOUR_S, self._unchecked - _CHECK_S) > -site.tau / 2:
            self._update_level(
                cistern_level, roof_level, np.atleast_2d(np.asarray(precipitation, dtype=float)),
                np.asarray(evapotranspiration, dtype=float),
            )
        return self._drain.drain_to(self._level, cistern_level)

    def _update_level(
        self, cistern_level: float, roof_level: float, rain: Array, evaporated: Array
    ) -> None:
        """Make a plan, if the last one is old or the forecast has changed."""
        self._unchecked, old = 0.0, self._age > _HOUR_S - self._site.tau / 2
        usable = rain.shape[1] == evaporated.size == len(self._lengths)
        total = rain @ self._lengths if usable else np.full(1, math.nan)
        if not math.isfinite(cistern_level + roof_level + float(total.sum() + evaporated.sum())):
            if old:
                self._age, self._level = math.inf, self._drain.reserve
            return
        changed = total.shape != self._total.shape or (
            float(np.abs(total - self._total).max()) > _CHANGED_M
        )
        if old or changed:
            self._age, self._total = 0.0, total
            needed = self._reach_s * float(evaporated @ self._lengths) / float(self._ends[-1])
            self._level = min(
                self._max_level, max(self._drain.reserve, float(self._nodes[0]) + needed),
                self._find_level(
                    self._site.cistern_volume(cistern_level), self._site.roof_volume(roof_level),
                    self._hourly(rain), self._hourly(evaporated), needed,
                ),
            )

    def _hourly(self, rates: Array) -> Array:
        """Return the total of each hour, of rates per second on the last axis."""
        totals = np.cumsum(rates * self._lengths, axis=-1)
        place = self._ends[1:].searchsorted(self._hour_ends[1:])
        before = np.concatenate((np.zeros_like(totals[..., :1]), totals), axis=-1)
        since = self._hour_ends[1:] - self._ends[place]
        at_ends = before[..., place] + rates[..., place] * since
        return np.asarray(np.diff(at_ends, axis=-1, prepend=0.0))

    def _find_level(
        self, x1: float, x2: float, rain: Array, evaporated: Array, needed: float
    ) -> float:
        """Return the volume to which the cistern is drained in the first hour (m3).

        Args:
            x1: in the cistern (m3).
            x2: on the roof (m3).
            rain: in each hour (m), shape (members, hours).
            evaporated: off the roof in each hour (m3), shape (hours,).
            needed: what the roof needs within the reach (m3).
        """
        site, nodes = self._site, self._nodes
        floor, full = float(nodes[0]), float(nodes[-1])
        inflow, kept = rain * site.effective_catchment, site.drainage_to_cistern
        most = float(rain.sum(axis=1).max()) * (site.effective_catchment + kept * site.a2)
        if x1 + most + kept * max(0.0, x2 - site.x2_star) <= full:
            return full  # whatever comes, it fits
        flows = inflow - self._find_needs(x2, rain * site.a2, evaporated)
        hourly = (Intervals(_HOUR_S, member, member) for member in rain)
        wet = np.array([find_wet_weather(site, intervals) for intervals in hourly], float)
        worth = self._price * np.minimum(nodes - floor, needed)
        value = np.repeat(-worth[None], len(rain), axis=0)
        for hour in reversed(range(rain.shape[1])):
            held = nodes + flows[:, hour, None]
            inside = np.minimum(np.maximum(held, floor), full)
            value = (
                self._at(value, inside) + self._price * (inside - np.minimum(held, inside))
                + wet[:, hour, None] * (np.maximum(held, inside) - inside)
            )
            if hour:
                value = self._before(value, wet[:, hour])
        x1 = min(max(x1, floor), full)
        reached = float(self._drain_hour(np.array([x1]))[0])
        left = np.minimum(np.maximum(nodes, reached), x1)
        costs = self._at(value, np.repeat(left[None], len(value), axis=0)).mean(axis=0)
        return float(nodes[np.flatnonzero(costs <= costs.min() + _TIE * (full - floor))[-1]])

    def _before(self, value: Array, wet: Array) -> Array:
        """Return V from U of the class: the best that the valve can do in an hour.

        Args:
            value: U at each node, shape (members, nodes).
            wet: 1 for each member for which the hour is in wet weather, else 0.
        """
        best = self._nodes[self._first + value[:, self._first :].argmin(axis=1)]
        level = np.where(wet > 0, self._nodes[-1], best)[:, None]
        return self._at(value, np.minimum(np.maximum(level, self._drained), self._nodes))

    def _drain_hour(self, volumes: Array) -> Array:
        """Return what the open valve leaves of volumes (m3) in an hour."""
        root = np.sqrt(np.maximum(volumes - self._outlet, 0.0) / self._site.a1)
        root = np.maximum(root - self._fall * _HOUR_S, 0.0)
        return np.asarray(np.minimum(volumes, self._outlet + self._site.a1 * root**2))

    def _at(self, value: Array, volumes: Array) -> Array:
        """Return values at volumes between the nodes (m3), both of shape (members, n)."""
        nodes, count = self._nodes, len(self._nodes)
        place = (volumes - nodes[0]) * ((count - 1) / (nodes[-1] - nodes[0]))
        node = np.minimum(place.astype(np.intp), count - 2)
        start = np.arange(len(value))[:, None] * count + node
        low = value.take(start)
        return np.asarray(low + (place - node) * (value.take(start + 1) - low))

    def _find_needs(self, x2: float, rain: Array, evaporated: Array) -> Array:
        """Return what the roof takes from the cistern in each hour (m3), less what drains back."""
        site, room = self._site, self._soil.above_target
        above, needs = np.full(len(rain), x2 - site.x2_star), np.empty_like(rain)
        for hour in range(rain.shape[1]):
            above = above + rain[:, hour] - evaporated[hour]
            drained = np.maximum(above - room, 0.0)
            needs[:, hour] = np.maximum(-above, 0.0) - site.drainage_to_cistern * drained
            above = np.clip(above, 0.0, room)
        return needs


def find_present(precipitation: Any) -> float:
    """Return the present rain of a forecast (m/s): its first entry, NaN without one."""
    if not len(precipitation):
        return math.nan
    first = precipitation[0]
    if isinstance(first, float):
        return first
    return float(first[0]) if len(first) else math.nan
