"""The numbers of the plant: its parameters, made once from a site, its state and its flows.

The same parameters serve the sums of a run (:mod:`greenroof_ros.results.sums`).

The functions of this package take and return nothing but numbers and these named tuples, so that
the same text runs in Python and compiled (:mod:`greenroof_ros.physics.compiled`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from greenroof_ros.physics.storm_water import HOUR_S, interval_ticks
from greenroof_ros.site.site import Site

# A short tick: see plant_parameters.
_SHORT_HEAD = 1e-4
SHORT_SHARE = 0.01
"""maximum share of the roof's target that pumps at full flow can deliver in a short tick (1)"""
# Eq. (4) with Euler's method takes no more than this (m) in a tick from a soil at its capacity.
_MAX_OVERDRAWN_M = 1e-4


class PlantParameters(NamedTuple):
    """The numbers of a site that determine the plant and its metrics, named as in :class:`.Site`.

    A part that the site does not have is a number without effect: no mains supply is a flow of 0, a
    cistern without a low outlet has one of coefficient 0 at the level of its overflow, a roof
    without a drainage layer has one of storage 0, and a site without pumps has b = 0.
    """

    tau: float
    a1: float
    a2: float
    effective_catchment: float
    z_o: float
    z_veg: float
    x2_star: float
    low_outlet_level: float
    suction_level: float
    c_out: float
    c_low: float
    b: float
    c_hat: float
    d: float
    mains_level: float
    mains_flow: float
    z_cap: float
    z_soil: float
    K: float
    wilting_volume: float
    available_volume: float
    stress_onset: float
    percolation_exponent: float
    layer_storage: float
    other_demand: float
    """mean flow of water that other uses need (m3/s), for plans"""
    layer_rate: float
    """k of the drainage layer, whose outflow is k V^2 (1/(m3 s)); 0 without a layer"""
    drainage_to_cistern: float
    epsilon: float
    always_drains: bool
    pipe_resistance: float
    g: float
    starts_per_hour: float
    valve_closed_in_frost: bool
    wet_after_s: float
    """time after rain that counts as wet weather (s)"""
    stress_volume: float
    """volume on the roof below which plants lack water: K_s < 1 (m3); 0 for the paper's soil"""
    interval_ticks: float
    """length of an interval for peaks and events (ticks)"""
    dry_intervals: float
    """intervals without rain that separate two events"""
    has_field_capacity: bool
    """whether the soil is a field-capacity soil, rather than that of Table I"""
    has_short_ticks: bool
    """whether Euler's method is accurate enough for a tick, as it is in Table I"""
    overdraws: bool
    """whether Eq. (4) would drain much more than the water above the capacity in a tick"""


class State(NamedTuple):
    """The water in the plant at the start of a tick (m3)."""

    cistern: float
    """x1, the water in the cistern"""
    roof: float
    """x2, the water on the roof; on a field-capacity soil, the water in its substrate"""
    layer: float
    """water in the drainage layer; 0 without one"""


class Flows(NamedTuple):
    """The mean flows during a tick (m3/s), limited to the water in each tank."""

    outflow: float
    """flow from the cistern to the sewer"""
    pump: float
    """flow from the cistern to the roof"""
    drainage: float
    """drainage from the roof"""
    evapotranspiration: float
    """evapotranspiration from the roof"""
    limited: bool
    """whether a tank contained less water than was demanded"""
    mains: float
    """flow of mains water into the cistern"""
    low_outlet: float
    """part of the outflow that leaves through the low outlet"""
    other: float
    """flow from the cistern to other uses than the roof"""
    other_demand: float
    """water that other uses need, the rest of which is mains water"""


def plant_parameters(site: Site) -> PlantParameters:
    """Return the numbers of a site.

    In a short tick, pumps at full flow deliver at most 1 % of the roof's target. With Euler's
    method, an outlet drains more than the water above it if the head is below (tau c / a1)^2, with
    c as in Eq. (2); in a short tick, this limit is at most 0.1 mm.
    """
    head = site.z_o + site.c_hat - site.d
    pumped = site.tau * site.b * math.sqrt(max(head, 0.0))
    overdrawn = (site.tau * max(site.c_out, site.c_low) / site.a1) ** 2
    has_field_capacity, interval = site.field_capacity is not None, interval_ticks(site.tau)
    numbers: dict[str, Any] = {
        "low_outlet_level": site.min_outlet_level,
        "stress_volume": (
            site.wilting_volume + site.stress_onset * site.available_volume
            if has_field_capacity else 0.0
        ),
        "other_demand": sum(site.other_flows or ()) / 12,
        "layer_rate": 1 / (site.layer_storage * (site.drainage_time or 0.0) or math.inf),
        "wet_after_s": site.wet_after * HOUR_S,
        "interval_ticks": interval,
        "dry_intervals": max(1, round(site.event_separation * HOUR_S / (site.tau * interval))),
        "has_field_capacity": has_field_capacity,
        "has_short_ticks": pumped <= SHORT_SHARE * site.x2_star and overdrawn <= _SHORT_HEAD,
        "overdraws": 2 * site.K * site.tau > _MAX_OVERDRAWN_M,
    }
    for name in PlantParameters._fields:
        if name not in numbers:
            numbers[name] = getattr(site, name) or 0.0
    return PlantParameters(**numbers)
