"""The designs that are compared: cistern volumes, targets and outlets of one site."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, describe_choices
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.outlet import DRAIN, PLAN
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.cistern import EMPTIED_H, find_outlet_radius
from greenroof_ros.physics.storm_water import connected_area
from greenroof_ros.site.file import check_site
from greenroof_ros.site.site import WITHOUT_VALVE, Site

NONE = "none"
OUTLETS = (NONE, DRAIN, PLAN)
"""What makes room in the cistern for storms: nothing, or a valve with one of two policies."""
CONTROLLER = "onoff"
TAU = 60.0
"""duration of a tick (s)"""

VOLUMES, TARGETS = Range(0.05, 1e5, "m3"), Range(1.0, 1000.0, "mm")
# Preferred numbers, series R5 of ISO 3: each is 60 % larger than the one before.
_PREFERRED = (1.0, 1.6, 2.5, 4.0, 6.3)
# The smallest default volume holds at least this depth of rain on the connected area [assumed].
_SMALLEST_M, _COUNT = 0.004, 8
# The default targets are the site's own, and one day's irrigation in summer above and below it, as
# assumed for the reserve of drain.
_DAY_MM = 4.0

# What sizing needs and a site file may not contain [assumed, as new-site does].
_MAINS_ABOVE_SUCTION_M, _MAINS_MM_PER_H = 0.02, 10.0
_OUTLET_ABOVE_MAINS_M = 0.03


@dataclass(frozen=True)
class Design:
    """A site with one cistern, target and outlet.

    Attributes:
        volume: volume of the cistern up to its overflow (m3).
        target: target for the water on the roof, as a depth (mm).
        outlet: one of :data:`OUTLETS`.
        site: the site with this cistern, target and outlet.
        parameters: parameters of the controller, and of the outlet's policy if there is a valve.
    """

    volume: float
    target: float
    outlet: str
    site: Site
    parameters: Mapping[str, Any]


def choose_volumes(site: Site) -> list[float]:
    """Return the default volumes (m3).

    The volumes are eight preferred numbers, which correspond to rain of 4 to about 100 mm on the
    connected area.
    """
    smallest = _SMALLEST_M * connected_area(site)
    decade = math.floor(math.log10(smallest))
    numbers = (
        float(f"{number * 10.0**power:.3g}")
        for power in range(decade, decade + 4) for number in _PREFERRED
    )
    larger = (volume for volume in numbers if volume >= smallest and volume in VOLUMES)
    return list(itertools.islice(larger, _COUNT))


def choose_targets(site: Site) -> list[float]:
    """Return the default targets (mm): the site's, and a day's irrigation below and above it."""
    own, full = 1000 * site.z_veg, 1000 * site.roof_level(site.z_cap)
    wilting = 1000 * site.roof_level(site.wilting_volume)
    return [
        float(f"{target:.6g}") for target in (own - _DAY_MM, own, own + _DAY_MM)
        if target == own or wilting + _DAY_MM < target < full
    ]


def read_numbers(values: Sequence[Any] | None, key: str, allowed: Range) -> list[float] | None:
    """Return the numbers under a key in ascending order.

    Raises:
        ConfigurationError: if a number is out of range or appears twice, or if there is no number.
    """
    if values is None:
        return None
    if isinstance(values, str) or not hasattr(values, "__iter__"):
        values = [values]
    numbers = sorted(allowed.read(value, key=key) for value in values)
    if not numbers:
        raise ConfigurationError("must list at least one number", key=key)
    for one, other in itertools.pairwise(numbers):
        if one == other:
            raise ConfigurationError("appears twice", key=key, value=one)
    return numbers


def read_outlets(names: Sequence[str] | None) -> list[str]:
    """Return the named outlets in the order of :data:`OUTLETS`, or all outlets if none is named.

    Raises:
        ConfigurationError: if a name is not that of an outlet.
    """
    given = [names] if isinstance(names, str) else list(names or OUTLETS)
    for name in given:
        if name not in OUTLETS:
            raise ConfigurationError(
                describe_choices(OUTLETS, str(name)), key="outlets", value=name
            )
    return [name for name in OUTLETS if name in given]


def choose_outlet(site: Site, outlets: Sequence[str]) -> str:
    """Return the recommended outlet: ``plan`` if the site file has a valve, or else ``none``."""
    own = PLAN if site.low_outlet_valve else NONE
    return own if own in outlets else outlets[0]


def make_designs(
    site: Site, volumes: Sequence[float], targets: Sequence[float], outlets: Sequence[str]
) -> tuple[list[Design], list[str]]:
    """Return the designs, sorted by outlet, target and volume, and the assumptions as sentences.

    Args:
        site: the site; only the height of its own cistern is used.
        volumes: volumes of the cistern (m3), in ascending order.
        targets: targets (mm), in ascending order.
        outlets: names from :data:`OUTLETS`.

    Raises:
        ConfigurationError: if the soil cannot hold a target, or plants cannot take up the water
            at a target.
    """
    full, wilting = site.roof_level(site.z_cap), site.roof_level(site.wilting_volume)
    for target in targets:
        if not wilting < target / 1000 < full:
            raise ConfigurationError(
                f"must be above {1000 * wilting:.4g} mm, below which plants take up no water, and "
                f"below {1000 * full:.4g} mm, above which the soil drains (field_capacity and "
                "z_soil of the site)", key="targets", value=target,
            )
    notes = [
        f"All cisterns have the height of the cistern in the site file, {site.z_o:g} m up to the "
        "overflow, and differ in their area. A season begins with the cistern half full and the "
        "roof at its target.",
        f"An on/off controller, which fills the roof to its target, decides every {TAU:g} s "
        "whether the pump runs. No forecast is used: plan keeps the water that the roof needs "
        "for 20 days, and makes room in dry weather.",
    ]
    topped_up = _add_mains(site, notes)
    designs = []
    for outlet in outlets:
        if outlet == NONE:
            valved = replace(
                topped_up, low_outlet_level=None, low_outlet_radius=None, **WITHOUT_VALVE
            )
        else:
            valved = _add_valve(topped_up, notes)
        for target, volume in itertools.product(targets, volumes):
            designs.append(_make_design(valved, volume, target, outlet))
    return designs, list(dict.fromkeys(notes))


def _make_design(site: Site, volume: float, target: float, outlet: str) -> Design:
    sized = replace(
        site, a1=volume / site.z_o, z_veg=target / 1000, x2_star=site.a2 * target / 1000,
        tau=TAU, M=1, initial_cistern=None, initial_roof=None,
    )
    parameters: dict[str, Any] = {}
    if outlet != NONE:
        parameters["outlet"] = outlet
        if math.isnan(site.low_outlet_radius or 0.0):
            radius = find_outlet_radius(
                sized, sized.a1, sized.z_o - (sized.low_outlet_level or 0.0), 3600 * EMPTIED_H
            )
            sized = replace(sized, low_outlet_radius=max(0.001, radius))
    sized = check_site(sized)
    complete = find_controller(CONTROLLER).complete_parameters(sized, parameters)
    return Design(volume, target, outlet, sized, complete)


def _add_mains(site: Site, notes: list[str]) -> Site:
    """Return a site with a mains top-up, which is needed to compute the share of demand met."""
    if site.mains_level is not None:
        return site
    above = min(_MAINS_ABOVE_SUCTION_M, (site.min_outlet_level - site.suction_level) / 2)
    level, flow = site.suction_level + above, _MAINS_MM_PER_H / 1000 / 3600 * site.a2
    notes.append(
        "Assumed, because the site file has no mains top-up: below a level of "
        f"{level:.3g} m, {1000 * above:.3g} mm above the pumps' suction level, mains water flows "
        f"in at {3600 * flow:.3g} m³/h, which is {_MAINS_MM_PER_H:g} mm/h over the roof."
    )
    return replace(site, mains_level=level, mains_flow=flow)


def _add_valve(site: Site, notes: list[str]) -> Site:
    """Return a site with a valve on a low outlet.

    The radius of the outlet is NaN if it is not in the site file, because it depends on the
    cistern.
    """
    assert site.mains_level is not None
    if site.low_outlet_valve:
        return site
    if site.low_outlet_level is not None:
        notes.append(
            "Assumed: the low outlet of the site file, which has no valve, gets a valve for "
            "drain and plan, and is closed for none."
        )
        return replace(site, low_outlet_valve=True)
    above = min(_OUTLET_ABOVE_MAINS_M, (site.z_o - site.mains_level) / 2)
    level = site.mains_level + above
    notes.append(
        "Assumed, because the site file has no low outlet: drain and plan have a valve at a level "
        f"of {level:.3g} m, {1000 * above:.3g} mm above the level of the mains top-up. The valve "
        f"is large enough to empty a full cistern down to its level in {EMPTIED_H:g} h."
    )
    return replace(
        site, low_outlet_level=level, low_outlet_radius=math.nan, low_outlet_valve=True
    )
