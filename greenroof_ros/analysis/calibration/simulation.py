"""Simulation of field-capacity soil with the weather and the pumped water of a record."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from greenroof_ros.formats.step_record import StepRecord, Values
from greenroof_ros.physics.soil import FieldCapacitySoil
from greenroof_ros.site.site import Site

# Less water than this in the drainage layer does not count: outflow falls with its square (m3 per
# m2).
_EMPTY = 1e-9
# Longest parts of steps (s): with water, within which the drainage layer's inflow hardly changes;
# and in dry weather, within which the soil's water stress hardly changes.
_WET_S, _DRY_S = 600.0, 3600.0
# Other programs may round readings to five digits: the largest error, as a share.
_DIGITS = 5e-5


class Simulated(NamedTuple):
    """The measurements that the simulated roof would produce."""

    runoff: Values
    """runoff in every step (mm), shape (steps,)"""
    level: Values
    """water level in the substrate at the beginning of every step (m), shape (steps,)"""


def simulate(site: Site, record: StepRecord, filled: float, minimum: float = 0.0) -> Simulated:
    """Simulate field-capacity soil over a record's steps.

    The result matches :class:`greenroof_ros.physics.plant.Plant` with short ticks, because
    percolation is solved for a whole step. Runoff is solved for a constant inflow. Therefore, steps
    longer than ten minutes are subdivided while water arrives, and steps longer than an hour are
    always subdivided. Water arrives evenly within a step. Unknown rain is treated as 0. The soil is
    computed only in steps in which water moves, which are few in a dry week.

    Args:
        site: site with a ``field_capacity``.
        record: record of rain, pumped water and reference evapotranspiration.
        filled: share of the available water capacity that is filled at the beginning, 0 to 1.
        minimum: runoff in a step (mm) below which a meter shows 0.
    """
    volume_flow = site.a2 / 1000 / record.step_s  # m3/s for one mm per step
    water = record.water
    wet, dry = (math.ceil(record.step_s / longest) for longest in (_WET_S, _DRY_S))
    parts = np.where(water > 0, wet, dry)
    starts = np.cumsum(parts) - parts
    durations = np.repeat(record.step_s / parts, parts)
    arriving = np.repeat(water * volume_flow, parts)
    potential = np.repeat(record.reference * site.crop_coefficient * volume_flow, parts)
    soil, capacity, empty = FieldCapacitySoil(site), site.z_cap, _EMPTY * site.a2
    x2, layer = site.wilting_volume + filled * site.available_volume, 0.0
    volumes = np.empty(len(durations))
    flows = np.zeros(len(durations))
    for part, (inflow, demand, seconds) in enumerate(
        zip(arriving.tolist(), potential.tolist(), durations.tolist(), strict=True)
    ):
        volumes[part] = x2
        percolated = 0.0
        if inflow > 0 or x2 > capacity:
            percolated = soil.drained(x2, inflow, seconds)
        evaporated = 0.0
        if demand > 0:
            available = x2 / seconds + inflow - percolated
            evaporated = max(0.0, min(demand * soil.water_stress(x2), available))
        if percolated > 0 or layer > empty:
            drained = soil.layer_outflow(layer, percolated, seconds)
            flows[part] = drained
            layer = max(0.0, layer + seconds * (percolated - drained))
        x2 = max(0.0, x2 + seconds * (inflow - percolated - evaporated))
    runoff = np.add.reduceat(flows * durations, starts) * 1000 / site.a2
    runoff = np.where(runoff < minimum, 0.0, runoff)
    return Simulated(runoff, volumes[starts] / site.a2)


def find_min_reading(record: StepRecord) -> float:
    """Return the runoff in a step (mm) below which a record's meter shows 0.

    The limit is the minimum reading above 0. A tipping bucket misses no water, because any
    remainder is carried over to the next tip. For a tipping bucket, and without a meter, the result
    is 0.
    """
    if record.runoff is None:
        return 0.0
    readings = np.unique(record.runoff[record.runoff > 0])
    if not len(readings) or _is_counted(readings, record.last_decimal):
        return 0.0
    return float(readings[0])


def _is_counted(readings: Values, last_decimal: float) -> bool:
    """Return whether readings in ascending order are multiples of one tip, apart from rounding.

    If a reading of n tips has a rounding error of up to h, the volume of a tip is between
    (reading - h) / n and (reading + h) / n. The number n follows from the volumes of a tip that the
    earlier readings allow, because rounding can change the minimum reading by half a tip.
    """
    low, high = 0.0, 2 * float(readings[0])
    for reading in readings.tolist():
        off = last_decimal / 2 + _DIGITS * reading
        tips = max(1, round(2 * reading / (low + high)))
        low, high = max(low, (reading - off) / tips), min(high, (reading + off) / tips)
        if low > high:
            return False
    return True
