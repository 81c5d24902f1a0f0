"""The designs that are compared: cistern volumes, targets and outlets of one site.

The target is chosen by lost evapotranspiration, and the cistern by savings.

The knee is the smallest cistern beyond which every additional m3 saves less than a stated amount.
For volumes V_1 < V_2 < ... that save the water S_1, S_2, ... in a season,

    knee = the smallest V_i with (S_{j+1} - S_j) / (V_{j+1} - V_j) < amount for all j >= i.

Saved water is mains water that is not used and storm water that does not reach the sewer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.tables import COLUMNS, Column, format_share
from greenroof_ros.base.errors import ConfigurationError, describe_choices
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.outlet import DRAIN, PLAN
from greenroof_ros.controllers.registry import find_controller
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
# Preferred numbers of ISO 3, series R20: each is 12 % larger than the one before. Every fourth is
# one of series R5.
_R20 = (
    1.0, 1.12, 1.25, 1.4, 1.6, 1.8, 2.0, 2.24, 2.5, 2.8, 3.15, 3.55, 4.0, 4.5, 5.0, 5.6, 6.3, 7.1,
    8.0, 9.0,
)
# Depths of rain on the connected area that the default cisterns hold (m) [assumed].
_DEPTHS_M = 0.004, 0.14
# Steps of the default targets, as a share of the water that the soil holds; and of these steps, the
# share by which the best target is refined.
_STEP, _FINE = 1 / 20, 1 / 4


class Design(NamedTuple):
    """One cistern, target and outlet, named as the columns of a table."""

    volume_m3: float
    """volume of the cistern up to its overflow"""
    target_mm: float
    """target for the water on the roof, as a depth"""
    outlet: str
    """one of :data:`OUTLETS`"""

    @property
    def described_outlet(self) -> str:
        """The outlet in words."""
        return "no valve" if self.outlet == NONE else f"valve with {self.outlet}"


BY_DESIGN = [*Design._fields]
"""columns that identify a design"""


def choose_volumes(site: Site) -> list[float]:
    """Return the default volumes (m3): that of the site's own cistern, and preferred numbers."""
    low, high = (depth * connected_area(site) for depth in _DEPTHS_M)
    return sorted({*_list_preferred(low, high, step=4), find_volume(site)})


def refine_volumes(volumes: Sequence[float], best: float) -> list[float]:
    """Return volumes (m3) in finer steps between the neighbours of the best of some volumes."""
    place = volumes.index(best)
    low, high = volumes[max(place - 1, 0)], volumes[min(place + 1, len(volumes) - 1)]
    return [volume for volume in _list_preferred(low, high) if volume not in volumes]


def _list_preferred(low: float, high: float, step: int = 1) -> list[float]:
    """Return the preferred numbers of a range, or every fourth of them."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    numbers = (float(f"{each * 10.0**decade:.3g}") for decade in decades for each in _R20[::step])
    return [number for number in numbers if low <= number <= high]


def find_volume(site: Site) -> float:
    """Return the volume of the site's own cistern up to its overflow (m3)."""
    return float(f"{site.a1 * site.z_o:.4g}")


def choose_targets(site: Site) -> list[float]:
    """Return the default targets (mm): steps of a twentieth of the soil's storage, and the site's.

    The targets are above the wilting point, and below the level at which the soil drains.
    """
    step, wilting = _find_step(site), 1000 * site.roof_level(site.wilting_volume)
    steps = (number * step for number in range(1, round(1 / _STEP)))
    own = 1000 * site.z_veg
    return sorted({own, *(float(f"{target:.3g}") for target in steps if target > wilting)})


def refine_targets(site: Site, best: float) -> list[float]:
    """Return targets (mm) in finer steps below the best of the default targets."""
    step = _find_step(site)
    return [float(f"{best - part * _FINE * step:.3g}") for part in (3, 2, 1)]


def _find_step(site: Site) -> float:
    return 1000 * _STEP * site.roof_level(site.z_cap)


def read_numbers(values: Any, key: str, allowed: Range) -> list[float]:
    """Return the numbers under a key in ascending order.

    Raises:
        ConfigurationError: if a number is out of range, or if there is no number.
    """
    given = values if hasattr(values, "__iter__") and not isinstance(values, str) else [values]
    if numbers := sorted({allowed.read(value, key=key) for value in given}):
        return numbers
    raise ConfigurationError("must list at least one number", key=key)


def read_outlets(names: Sequence[str] | None, site: Site) -> list[str]:
    """Return the named outlets in the order of :data:`OUTLETS`; by default those of the site.

    Raises:
        ConfigurationError: if a name is not that of an outlet, or if the site lacks the low outlet
            that a valve closes.
    """
    possible = (NONE,) if site.low_outlet_level is None else OUTLETS
    given = [names] if isinstance(names, str) else list(names or possible)
    for name in given:
        if name not in OUTLETS:
            raise ConfigurationError(describe_choices(OUTLETS, name), key="outlets", value=name)
        if name not in possible:
            raise ConfigurationError(
                "needs a low outlet in the site file, as in config/site_valve.yaml", key="outlets",
                value=name,
            )
    return [name for name in OUTLETS if name in given]


def choose_outlet(site: Site, outlets: Sequence[str]) -> str:
    """Return the recommended outlet: ``plan`` if the site file has a valve, or else ``none``."""
    own = PLAN if site.low_outlet_valve else NONE
    return own if own in outlets else outlets[0]


def check_mains(site: Site) -> None:
    """Refuse a site without a mains top-up, as its plants would dry out instead.

    Raises:
        ConfigurationError: if the site has none.
    """
    if site.mains_level is None:
        raise ConfigurationError(
            "has no mains top-up, so no share of its irrigation can be compared; set mains_level "
            "and mains_flow, as in config/site_valve.yaml", key="site",
        )


def check_target(site: Site, target: float) -> None:
    """Check a target (mm).

    Raises:
        ConfigurationError: if the soil cannot hold it, or plants cannot take up the water.
    """
    full, wilting = site.roof_level(site.z_cap), site.roof_level(site.wilting_volume)
    if not wilting < target / 1000 < full:
        raise ConfigurationError(
            f"must be above {1000 * wilting:.4g} mm, below which plants take up no water, and "
            f"below {1000 * full:.4g} mm, above which the soil drains (field_capacity and "
            "z_soil of the site)", key="targets", value=target,
        )


def build(site: Site, design: Design) -> tuple[Site, Mapping[str, Any]]:
    """Return the site of a design, and the parameters of its controller and its valve.

    Of the site's own cistern, only the height is used.
    """
    parameters: dict[str, Any] = {}
    if design.outlet == NONE:
        site = replace(site, low_outlet_level=None, low_outlet_radius=None, **WITHOUT_VALVE)
    else:
        site, parameters = replace(site, low_outlet_valve=True), {"outlet": design.outlet}
    depth = design.target_mm / 1000
    sized = check_site(replace(
        site, a1=design.volume_m3 / site.z_o, z_veg=depth, x2_star=site.a2 * depth, tau=TAU, M=1,
        initial_cistern=None, initial_roof=None,
    ))
    return sized, find_controller(CONTROLLER).complete_parameters(sized, parameters)


def list_assumed(site: Site) -> list[str]:
    """Return sentences about how the designs are simulated, and what is assumed in them."""
    notes = [
        f"All cisterns have the height of the cistern in the site file, {site.z_o:g} m up to the "
        "overflow, and differ in their area. A season begins with the cistern half full and the "
        "roof at its target.",
        f"An on/off controller, which fills the roof to its target, decides every {TAU:g} s "
        "whether the pump runs. No forecast of rain is used: plan keeps the water that plants take "
        "up in 20 days, at the evapotranspiration of the next two days, and makes room in dry "
        "weather.",
    ]
    if site.monthly_other_demand is not None:
        mean = sum(site.monthly_other_demand) / 12
        notes.append(f"Other uses than the roof need a mean of {mean:.4g} L a day.")
    if site.low_outlet_level is None:
        notes.append("No valve is compared, because the site has no low outlet.")
    elif not site.low_outlet_valve:
        notes.append("Assumed: drain and plan have a valve on the low outlet of the site.")
    return notes


KNEE = 1.0
"""Water that another m3 of cistern must save (m3 a season): one filling [assumed]."""

MAX_LOST = 0.001
"""share of the potential evapotranspiration that plants may lose at the recommended target, for
lack of water [assumed]"""


def find_knee(volumes: Sequence[float], saved: NDArray[np.float64], amount: float) -> int:
    """Return the index of the knee; that of the largest cistern if it is smaller than the knee.

    Args:
        volumes: volumes of the cisterns (m3), in ascending order.
        saved: water that each cistern saves in a season, relative to any one of them (m3), shape
            (n,).
        amount: minimum savings per additional m3 of cistern (m3).
    """
    brings = np.diff(saved) / np.diff(volumes)
    enough = np.flatnonzero(brings >= amount)
    return int(enough[-1]) + 1 if enough.size else 0


def find_target(targets: Sequence[float], lost: NDArray[np.float64]) -> float:
    """Return the lowest target at which plants lose at most 0.1 % of their evapotranspiration (mm).

    A higher target takes more water, also from the mains. If there is no such target, return the
    target at which plants lose least.

    Args:
        targets: targets to choose from (mm), in ascending order.
        lost: mean share of the potential evapotranspiration that is lost at each target (1), shape
            (n,).
    """
    fits = np.flatnonzero(lost <= MAX_LOST)
    return targets[int(fits[0] if fits.size else np.argmin(lost))]


PAGE, TABLE = "sizes.html", "sizes.csv"
BY_TEST = ["assumption", "value", "best_cistern_m3"]
"""columns that identify what is assumed, and the cistern that would be recommended then"""

KEPT, LOST = "storm_water_kept_share", "evapotranspiration_lost_share"
"""Results besides the metrics: the share of the rain on roof and catchment that does not reach the
sewer in wet weather; and the share of the potential evapotranspiration that is lost for lack of
water."""

SHOWN = COLUMNS | {
    KEPT: Column("rain kept out of the sewer in wet weather", "%", format_share),
    LOST: Column("lost evapotranspiration", "%", format_share),
}
"""the presentation of each result, by name"""
MAIN = ("mains_m3", "wet_discharge_m3", KEPT, "discharge_m3", "retention_share")
"""the results in tables of cisterns"""
