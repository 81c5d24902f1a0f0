"""The plan of :class:`.outlet.Policy`, for one or more sites with the same weather."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from greenroof_ros.controllers.roof import ABOVE_M, drain
from greenroof_ros.physics.parameters import PlantParameters
from greenroof_ros.physics.storm_water import find_wet

HORIZON_H = 48
"""time for which a plan looks ahead (h)"""

_HOUR_S, _DAY_S = 3600.0, 86_400.0
# Number of nodes for the cistern's volume in a plan.
_NODES = 121
# Levels count as equally expensive if their costs differ by less than this share of the cistern.
_TIE = 1e-3


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


def find_levels(
    sites: Any, options: Any, ends: Any, x1: Any, x2: Any, rain: Any, evaporated: Any
) -> Any:
    """Return the volumes to which the cisterns of sites are drained in the first hour (m3).

    Without a forecast, these are the reserves. The function can be compiled.

    Args:
        sites: :class:`.PlantParameters` of n sites with valves.
        options: for each of them, the reserve without a forecast (m3), the price of mains water in
            m3 of discharge in wet weather per m3 (1), the time for which stored water is worth its
            price (days), and the area to which the forecast's evapotranspiration applies (m2),
            shape (n, 4).
        ends: boundaries of the forecast's steps (s from now), starting at 0.
        x1: volumes in the cisterns (m3), shape (n,).
        x2: volumes on the roofs (m3), shape (n,).
        rain: forecast of rain (m/s), shape (members, steps).
        evaporated: forecast of evapotranspiration from the areas (m/s), shape (steps,).
    """
    levels = options[:, 0].copy()
    fits = rain.shape[1] == len(evaporated) == len(ends) - 1
    if not (fits and math.isfinite(x1.sum() + x2.sum() + rain.sum() + evaporated.sum())):
        return levels
    span, lengths, most = ends[-1], np.diff(ends), 0.0
    hours = max(1, min(HORIZON_H, round(span / _HOUR_S)))
    drawn = np.cumsum(evaporated * lengths)[-1]  # a sum whose order is the same if compiled
    hourly, evaporation = np.empty((len(rain), hours)), find_hourly(evaporated, ends, hours)
    for member in range(len(rain)):
        hourly[member] = find_hourly(rain[member], ends, hours)
        most = max(most, np.cumsum(rain[member] * lengths)[-1])
    for row in range(len(sites)):
        p, reserve, price, area = sites[row], options[row][0], options[row][1], options[row][3]
        floor, full = p.a1 * max(p.suction_level, p.mains_level), p.a1 * p.z_o
        outlet, needed = p.a1 * p.low_outlet_level, options[row][2] * _DAY_S * area * drawn / span
        needed += options[row][2] * _DAY_S * p.other_demand
        kept = p.drainage_to_cistern
        comes = most * (p.effective_catchment + kept * p.a2) + kept * max(x2[row] - p.x2_star, 0.0)
        level = full
        # A cistern that cannot overflow keeps all its water.
        if comes > 0 and x1[row] + comes > full:
            level = solve(
                p, floor, price, needed, x1[row], x2[row], hourly, area * evaporation
            )
        root = math.sqrt(max(reserve - outlet, 0.0) / p.a1) + p.c_low / (2 * p.a1) * span
        most_left = min(full, outlet + p.a1 * root * root)
        levels[row] = min(level, max(reserve, floor + needed), most_left)
    return levels


def solve(
    p: PlantParameters, floor: float, price: float, needed: float, x1: float, x2: float,
    rain: Any, evaporated: Any,
) -> float:
    """Return the level of the first hour (m3) by the dynamic program of :class:`.outlet.Policy`.

    Args:
        p: numbers of the site.
        floor: volume below which the cistern needs mains water or the pumps stop (m3).
        price: price of mains water (1).
        needed: water that roof and other uses need within the reach (m3).
        x1: volume in the cistern (m3).
        x2: volume on the roof (m3).
        rain: depth of rain in each hour (m), shape (members, hours).
        evaporated: evapotranspiration of the roof in each hour (m3), shape (hours,).
    """
    full = p.a1 * p.z_o
    nodes = floor + (full - floor) / (_NODES - 1) * np.arange(_NODES)
    drained = drain(p, nodes, _HOUR_S)
    first = int(np.searchsorted(nodes, p.a1 * p.low_outlet_level))  # no node below is reached
    volume = min(max(x1, floor), full)
    left = np.minimum(np.maximum(nodes, drain(p, volume, _HOUR_S)), volume)
    costs = np.zeros(_NODES)
    for member in range(len(rain)):
        flows = find_flows(p, x2, rain[member], evaporated)
        wet, _ = find_wet(rain[member] / _HOUR_S, _HOUR_S, p.wet_after_s, math.inf)
        value = -price * np.minimum(nodes - floor, needed)
        for hour in range(len(flows) - 1, -1, -1):
            held = nodes + flows[hour]
            inside = np.minimum(np.maximum(held, floor), full)
            spilled = wet[hour] * (np.maximum(held, inside) - inside)
            bought = price * (inside - np.minimum(held, inside))
            value = value_at(nodes, value, inside) + bought + spilled
            # With the best use of the valve, U becomes V.
            if hour > 0 and wet[hour] == 0:
                best = nodes[first + value[first:].argmin()]
                value = value_at(nodes, value, np.minimum(np.maximum(drained, best), nodes))
        costs += value_at(nodes, value, left) / len(rain)
    ties = np.flatnonzero(costs <= costs.min() + _TIE * (full - floor))
    return float(nodes[ties[-1]])


def find_hourly(rates: Any, ends: Any, hours: int) -> Any:
    """Return hourly totals of a forecast, shape (hours,); the last hour may end with the forecast.

    Args:
        rates: rates per second, shape (steps,).
        ends: boundaries of the steps (s), starting at 0.
        hours: number of hours.
    """
    totals = np.zeros(hours)
    for step in range(len(rates)):
        for hour in range(int(ends[step] // _HOUR_S), hours):
            end = min(ends[step + 1], (hour + 1) * _HOUR_S)
            totals[hour] += rates[step] * (end - max(ends[step], hour * _HOUR_S))
            if end == ends[step + 1]:
                break
    return totals


def find_flows(p: PlantParameters, x2: float, rain: Any, evaporated: Any) -> Any:
    """Return what flows into the cistern in each hour, minus what roof and other uses need (m3).

    Args:
        p: numbers of the site.
        x2: volume on the roof (m3).
        rain: depth of rain in each hour (m), shape (hours,).
        evaporated: evapotranspiration of the roof in each hour (m3), shape (hours,).
    """
    room = p.z_cap - p.x2_star if p.has_field_capacity else p.a2 * ABOVE_M
    above, flows = x2 - p.x2_star, np.empty(len(rain))
    for hour in range(len(rain)):
        above += rain[hour] * p.a2 - evaporated[hour]
        drained = max(above - room, 0.0)
        flows[hour] = (
            rain[hour] * p.effective_catchment + p.drainage_to_cistern * drained
            - max(-above, 0.0) - _HOUR_S * p.other_demand
        )
        above = min(max(above, 0.0), room)
    return flows


def value_at(nodes: Any, value: Any, volumes: Any) -> Any:
    """Interpolate values between equidistant nodes.

    Args:
        nodes: volumes at the nodes (m3), shape (nodes,).
        value: values at the nodes, shape (nodes,).
        volumes: volumes at which to interpolate (m3), shape (n,).
    """
    place = (volumes - nodes[0]) * ((_NODES - 1) / (nodes[-1] - nodes[0]))
    node = np.minimum(place.astype(np.intp), _NODES - 2)
    low = value[node]
    return low + (place - node) * (value[node + 1] - low)
