"""The parameters of many sites as arrays, with one entry per :class:`.site.Site`.

Functions that only perform arithmetic on a site's parameters also accept these arrays. A device
that a site does not have is represented by values that have no effect, such as a float valve
without flow, or a low outlet without area at the level of the upper outlet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.plant import has_short_ticks
from greenroof_ros.physics.soil import soil_of
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Parameters that are not simply the attributes of a site with the same name.
_FROM_SITE: dict[str, Callable[[Site], Any]] = {
    "low_outlet_level": lambda site: site.min_outlet_level,
    "mains_level": lambda site: site.mains_level or 0.0,
    "mains_flow": lambda site: site.mains_flow or 0.0,
    "drainage_time": lambda site: site.drainage_time or 0.0,
    "has_layer": lambda site: site.drainage_storage is not None,
    "above_target": lambda site: soil_of(site).above_target,
    "stress_volume": lambda site: soil_of(site).stress_volume,
    "overdraws": lambda site: soil_of(site).overdraws,
    "has_field_capacity": lambda site: soil_of(site).has_field_capacity,
    "has_short_ticks": has_short_ticks,
}


@dataclass(frozen=True, eq=False)
class Sites:
    """Parameters of n sites, each of shape (n,), as described in :class:`.site.Site`.

    Attributes:
        above_target: volume by which rain can raise the water above the roof's target (m3), see
            :mod:`.soil`.
        stress_volume: volume on the roof below which plants lack water (m3), see :mod:`.soil`.
        overdraws: whether Eq. (4) would drain too much in a tick, see :mod:`.soil`.
        has_field_capacity: whether the soil is a field-capacity soil.
        has_short_ticks: whether the ticks are short; see :func:`.plant.has_short_ticks`.
    """

    a1: Values
    a2: Values
    z_o: Values
    z_veg: Values
    z_soil: Values
    x2_star: Values
    z_cap: Values
    K: Values
    d: Values
    c_hat: Values
    tau: Values
    b: Values
    c_out: Values
    c_low: Values
    low_outlet_level: Values
    suction_level: Values
    effective_catchment: Values
    crop_coefficient: Values
    mains_level: Values
    mains_flow: Values
    wilting_volume: Values
    available_volume: Values
    stress_onset: Values
    layer_storage: Values
    drainage_time: Values
    drainage_to_cistern: Values
    above_target: Values
    stress_volume: Values
    initial_layer: Values
    wet_after: Values
    low_outlet_valve: Flags
    valve_closed_in_frost: Flags
    has_layer: Flags
    overdraws: Flags
    has_field_capacity: Flags
    has_short_ticks: Flags

    @classmethod
    def of(cls, sites: Sequence[Site]) -> Sites:
        """Return the parameters of the given sites as arrays."""
        return cls(**{
            field.name: np.array([
                _FROM_SITE[field.name](site) if field.name in _FROM_SITE
                else getattr(site, field.name) for site in sites
            ]) for field in fields(cls)
        })

    def take(self, rows: NDArray[np.intp] | Flags) -> Sites:
        """Return the parameters of the selected sites."""
        return Sites(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def __len__(self) -> int:
        """Return the number of sites."""
        return len(self.a1)
