"""The plan of :class:`.outlet.Policy`, for one or more sites with the same weather.

All arrays of the dynamic program have shape (sites, members, nodes).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.roof_prediction import ABOVE_M
from greenroof_ros.physics.parameters import PlantParameters
from greenroof_ros.physics.storm_water import is_wet, time_without_rain

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

HORIZON_H = 48
"""time for which a plan looks ahead (h)"""

_HOUR_S, _DAY_S = 3600.0, 86_400.0
# Number of nodes for the cistern's volume in a plan.
_NODES = 121
# Levels count as equally expensive if their costs differ by less than this share of the cistern.
_TIE = 1e-3
# Number of sites times members that are computed together, which fits in the processor's cache.
_TOGETHER = 256


def columns(parameters: Sequence[PlantParameters]) -> Any:
    """Return the numbers of sites as arrays of shape (sites,), under the same names."""
    make: Any = PlantParameters
    return make(*map(np.array, zip(*parameters, strict=True)))


class PlanClock:
    """Decides when a plan is made: at the start of dry weather, and every hour of dry weather."""

    def __init__(self, tau: float) -> None:
        """Set the duration of a tick (s)."""
        self._tau, self._age = tau, math.inf

    def is_due(self, wet: bool) -> bool:
        """Return whether a plan is made in a tick; call this once per tick."""
        self._age = math.inf if wet else self._age + self._tau
        due = not wet and self._age > _HOUR_S - self._tau / 2
        if due:
            self._age = 0.0
        return due


class PlannedLevels:
    """Volumes to which cisterns are drained, from plans made in the same ticks for all sites.

    Attributes:
        levels: volumes according to the last plan (m3), shape (sites,); at first, the reserves.
    """

    def __init__(
        self, sites: Any, wet_after: float, ends: Array, reserves: Array, prices: Array,
        reaches: Array, areas: Array,
    ) -> None:
        """Set the sites and parameters; each array except ``ends`` has one entry per site.

        Args:
            sites: :func:`columns` of sites with valves.
            wet_after: time after rain that counts as wet weather at all sites (h).
            ends: boundaries of the forecasts' steps (s from now), starting at 0.
            reserves: volumes to which the cisterns are drained without a forecast (m3).
            prices: prices of mains water, in m3 of discharge in wet weather per m3 (1).
            reaches: time for which stored water is worth its price (days).
            areas: areas to which the forecast's evapotranspiration applies (m2).
        """
        self._areas, self._sites, self._wet_after = areas, sites, wet_after * _HOUR_S
        self._ends, self._lengths = ends, np.diff(ends)
        self._reserves, self._prices, self._reaches_s = reserves, prices, reaches * _DAY_S
        hours = max(1, min(HORIZON_H, round(float(ends[-1]) / _HOUR_S)))
        self._hour_ends = np.minimum(_HOUR_S * np.arange(hours + 1), ends[-1])
        self._full = sites.a1 * sites.z_o
        self._floor = sites.a1 * np.maximum(sites.suction_level, sites.mains_level)
        self._nodes = np.linspace(self._floor, self._full, _NODES, axis=-1)
        self._outlet = sites.a1 * sites.low_outlet_level
        of_soil, above = sites.z_cap - sites.x2_star, sites.a2 * ABOVE_M
        self._room = np.where(sites.has_field_capacity, of_soil, above)
        # The square root of the head above the outlet falls linearly with time, at this rate
        # (m^0.5/s).
        self._fall = sites.c_low / (2 * sites.a1)
        self._drained = self._drain_hour(np.arange(len(reserves)), self._nodes)
        self._unreachable = np.where(self._nodes < self._outlet[:, None], math.inf, 0.0)
        root = np.sqrt(np.maximum(reserves - self._outlet, 0.0) / sites.a1)
        root += self._fall * float(self._hour_ends[-1])
        self._max_levels = np.minimum(self._full, self._outlet + sites.a1 * root**2)
        self.levels: Array = reserves

    def plan(self, x1: Array, x2: Array, rain: Array, evaporated: Array) -> None:
        """Make a plan; without a usable forecast, the levels are the reserves.

        Args:
            x1: volumes in the cisterns (m3), shape (sites,).
            x2: volumes on the roofs (m3), shape (sites,).
            rain: forecast of rain (m/s), shape (members, steps).
            evaporated: forecast of evapotranspiration from the areas (m/s), shape (steps,).
        """
        self.levels = self._reserves
        if not rain.shape[1] == evaporated.size == len(self._lengths):
            return
        if not math.isfinite(float(x1.sum() + x2.sum() + rain.sum() + evaporated.sum())):
            return
        mean = float(evaporated @ self._lengths) / float(self._ends[-1])
        needed = self._reaches_s * self._areas * mean
        levels = self._find_levels(x1, x2, self._hourly(rain), self._hourly(evaporated), needed)
        levels = np.minimum(levels, np.maximum(self._reserves, self._floor + needed))
        self.levels = np.asarray(np.minimum(levels, self._max_levels))

    def _hourly(self, rates: Array) -> Array:
        """Return hourly totals from rates per second, along the last axis."""
        totals = np.cumsum(rates * self._lengths, axis=-1)
        place = self._ends[1:].searchsorted(self._hour_ends[1:])
        before = np.concatenate((np.zeros_like(totals[..., :1]), totals), axis=-1)
        since = self._hour_ends[1:] - self._ends[place]
        at_ends = before[..., place] + rates[..., place] * since
        return np.asarray(np.diff(at_ends, axis=-1, prepend=0.0))

    def _find_levels(
        self, x1: Array, x2: Array, rain: Array, evaporated: Array, needed: Array
    ) -> Array:
        """Return the volumes to which the cisterns are drained in the first hour (m3).

        Args:
            x1: volume in each cistern (m3).
            x2: volume on each roof (m3).
            rain: depth of rain in each hour (m), shape (members, hours).
            evaporated: depth of evapotranspiration in each hour (m), shape (hours,).
            needed: water that each roof needs within the reach (m3).
        """
        sites, kept = self._sites, self._sites.drainage_to_cistern
        most = float(rain.sum(axis=1).max()) * (sites.effective_catchment + kept * sites.a2)
        comes = most + kept * np.maximum(x2 - sites.x2_star, 0.0)
        levels: Array = self._full.copy()
        # Sites whose cistern could overflow are planned; the others keep all their water.
        planned = np.flatnonzero((comes > 0) & (x1 + comes > self._full))
        size = max(1, _TOGETHER // len(rain))
        for first in range(0, len(planned), size):
            rows = planned[first : first + size]
            levels[rows] = self._solve(
                rows, x1[rows], x2[rows], rain, self._areas[rows, None] * evaporated, needed[rows]
            )
        return levels

    def _solve(
        self, rows: Rows, x1: Array, x2: Array, rain: Array, evaporated: Array, needed: Array
    ) -> Array:
        """Solve the dynamic program for the given sites; see :meth:`_find_levels`.

        Args:
            rows: indices of the sites to which the other arrays belong.
            x1: volume in each cistern (m3).
            x2: volume on each roof (m3).
            rain: depth of rain in each hour (m), shape (members, hours).
            evaporated: evapotranspiration of each roof in each hour (m3), shape (sites, hours).
            needed: water that each roof needs within the reach (m3).
        """
        sites, nodes, price = self._sites, self._nodes[rows, None], self._prices[rows, None, None]
        floor, full = nodes[..., :1], nodes[..., -1:]
        inflow = rain * sites.effective_catchment[rows, None, None]
        flows = inflow - self._find_needs(rows, x2, rain, evaporated)
        wet: Array = np.array([self._find_wet(member) for member in rain], float)
        worth = price * np.minimum(nodes - floor, needed[:, None, None])
        value = np.repeat(-worth, len(rain), axis=1)
        for hour in reversed(range(rain.shape[1])):
            held = nodes + flows[:, :, hour, None]
            inside = np.minimum(np.maximum(held, floor), full)
            value = (
                _value_at(nodes, value, inside) + price * (inside - np.minimum(held, inside))
                + wet[:, hour, None] * (np.maximum(held, inside) - inside)
            )
            if hour:
                value = self._before(rows, value, wet[:, hour, None])
        x1 = np.minimum(np.maximum(x1, floor[:, 0, 0]), full[:, 0, 0])
        reached = self._drain_hour(rows, x1[:, None])
        left = np.minimum(np.maximum(nodes[:, 0], reached), x1[:, None])
        left = np.repeat(left[:, None], len(rain), axis=1)
        costs = _value_at(nodes, value, left).mean(axis=1)
        ties = costs <= costs.min(axis=1, keepdims=True) + _TIE * (full - floor)[:, 0]
        highest = _NODES - 1 - ties[:, ::-1].argmax(axis=1)
        return np.asarray(nodes[np.arange(len(rows)), 0, highest])

    def _find_wet(self, rain: Array) -> list[bool]:
        """Return whether each hour is wet, from its rain (m)."""
        wet, without_rain = [], math.inf
        for depth in rain.tolist():
            without_rain = time_without_rain(without_rain, depth / _HOUR_S, _HOUR_S)
            wet.append(is_wet(without_rain, _HOUR_S, self._wet_after))
        return wet

    def _before(self, rows: Rows, value: Array, wet: Array) -> Array:
        """Compute V from U of :class:`.outlet.Policy`, with the best use of the valve in an hour.

        Args:
            rows: indices of the sites.
            value: U at each node, shape (sites, members, nodes).
            wet: 1 for members whose weather is wet in this hour, otherwise 0, shape (members, 1).
        """
        nodes = self._nodes[rows, None]
        node = (value + self._unreachable[rows, None]).argmin(axis=2, keepdims=True)
        node = np.where(wet > 0, _NODES - 1, node)
        level = np.take_along_axis(nodes, node, axis=2)
        level = np.minimum(np.maximum(level, self._drained[rows, None]), nodes)
        return _value_at(nodes, value, level)

    def _drain_hour(self, rows: Rows, volumes: Array) -> Array:
        """Return the volumes that remain after the valves have been open for an hour (m3).

        Args:
            rows: indices of the sites.
            volumes: volumes in the cisterns (m3), shape (sites, n).
        """
        outlet, a1 = self._outlet[rows, None], self._sites.a1[rows, None]
        root = np.sqrt(np.maximum(volumes - outlet, 0.0) / a1)
        root = np.maximum(root - self._fall[rows, None] * _HOUR_S, 0.0)
        return np.asarray(np.minimum(volumes, outlet + a1 * root**2))

    def _find_needs(self, rows: Rows, x2: Array, rain: Array, evaporated: Array) -> Array:
        """Return the water (m3) that roofs need from cisterns each hour, minus the roofs' drainage.

        Args:
            rows: indices of the sites.
            x2: volume on each roof (m3).
            rain: depth of rain in each hour (m), shape (members, hours).
            evaporated: evapotranspiration of each roof in each hour (m3), shape (sites, hours).

        Returns:
            The water, with shape (sites, members, hours).
        """
        sites, kept = self._sites, self._sites.drainage_to_cistern[rows, None]
        room, fallen = self._room[rows, None], rain * sites.a2[rows, None, None]
        above = np.repeat((x2 - sites.x2_star[rows])[:, None], len(rain), axis=1)
        needs: Array = np.empty_like(fallen)
        for hour in range(rain.shape[1]):
            above = above + fallen[..., hour] - evaporated[:, hour, None]
            drained = np.maximum(above - room, 0.0)
            needs[..., hour] = np.maximum(-above, 0.0) - kept * drained
            above = np.minimum(np.maximum(above, 0.0), room)
        return needs


def _value_at(nodes: Array, value: Array, volumes: Array) -> Array:
    """Interpolate values between the nodes; the result has shape (sites, members, n).

    Args:
        nodes: volumes at the nodes (m3).
        value: values at the nodes, shape (sites, members, nodes).
        volumes: volumes at which to interpolate (m3), shape (sites, members, n).
    """
    first, last = nodes[..., :1], nodes[..., -1:]
    place = (volumes - first) * ((_NODES - 1) / (last - first))
    node = np.minimum(place.astype(np.intp), _NODES - 2)
    sites, members, count = value.shape
    start = (np.arange(sites * members) * count).reshape(sites, members, 1) + node
    low = value.take(start)
    return np.asarray(low + (place - node) * (value.take(start + 1) - low))
