"""A measured roof under a record's rain, pumping and evapotranspiration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import layer_outflow, percolation, water_stress

# Less in the drainage layer does not count: its outflow falls with the square (m3 per m2).
_EMPTY = 1e-9


class Simulated(NamedTuple):
    """What a record of the simulated roof would hold."""

    runoff: Values
    """off the roof in each step (mm), shape (steps,)"""
    level: Values
    """of the water in the substrate at the beginning of each step (m), shape (steps,)"""


def simulate(site: Site, record: Record, filled: float) -> Simulated:
    """Step a measured roof as :class:`greenroof_ros.model.plant.Plant` does, by a record's steps.

    Rain that was not measured counts as none. The soil is asked only in steps in which something
    moves, which are few in a dry week.

    Args:
        site: with a ``field_capacity``.
        record: rain, pumped water and reference evapotranspiration.
        filled: share of the available water that is there at first, 0 to 1.
    """
    seconds = record.step_s
    volume_flow = site.a2 / 1000 / seconds  # m3/s of a mm in a step
    arriving = (np.nan_to_num(record.rain) + np.nan_to_num(record.pumped)) * volume_flow
    asked = record.reference * site.crop_coefficient * volume_flow
    capacity, empty = site.z_cap, _EMPTY * site.a2
    x2, layer = site.wilting_volume + filled * site.available_volume, 0.0
    volumes = np.empty(record.steps)
    flows = np.zeros(record.steps)
    for step, (comes, wanted) in enumerate(zip(arriving.tolist(), asked.tolist(), strict=True)):
        volumes[step] = x2
        percolated = 0.0
        if comes > 0 or x2 > capacity:
            percolated = percolation(site, x2, comes, seconds)
        evaporated = 0.0
        if wanted > 0:
            left = x2 / seconds + comes - percolated
            evaporated = max(0.0, min(wanted * water_stress(site, x2), left))
        if percolated > 0 or layer > empty:
            drained = layer_outflow(site, layer, percolated, seconds)
            flows[step] = drained
            layer = max(0.0, layer + seconds * (percolated - drained))
        x2 = max(0.0, x2 + seconds * (comes - percolated - evaporated))
    return Simulated(flows / volume_flow, volumes / site.a2)
