"""Simulation of field-capacity soil with the weather and the pumped water of a record."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from greenroof_ros.analysis.calibration.step_record import StepRecord, Values
from greenroof_ros.physics.compiled import compiled
from greenroof_ros.physics.parameters import PlantParameters, plant_parameters
from greenroof_ros.physics.soil import layer_outflow, percolation, water_stress
from greenroof_ros.site.site import Site

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

    The result matches :func:`greenroof_ros.physics.tick.step` with short ticks, because percolation
    is solved for a whole step. Runoff is solved for a constant inflow. Therefore, steps longer than
    ten minutes are subdivided while water arrives, and steps longer than an hour are always
    subdivided. Water arrives evenly within a step. Unknown rain is treated as 0.

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
    volumes, flows = np.empty_like(durations), np.empty_like(durations)
    compiled(run_parts)(
        plant_parameters(site), arriving, potential, durations,
        site.wilting_volume + filled * site.available_volume, volumes, flows,
    )
    runoff = np.add.reduceat(flows * durations, starts) * 1000 / site.a2
    runoff = np.where(runoff < minimum, 0.0, runoff)
    return Simulated(runoff, volumes[starts] / site.a2)


def run_parts(
    p: PlantParameters, arriving: Values, potential: Values, durations: Values, x2: float,
    volumes: Values, flows: Values,
) -> None:
    """Simulate the parts of steps; all arrays have shape (parts,).

    Args:
        p: parameters of the plant.
        arriving: rain and pumped water (m3/s).
        potential: potential evapotranspiration from the whole bed (m3/s).
        durations: durations of the parts (s).
        x2: volume in the soil at the beginning (m3).
        volumes: array for the volume in the soil at the start of each part (m3).
        flows: array for the runoff (m3/s).
    """
    layer = 0.0
    for part in range(len(durations)):
        inflow, seconds = arriving[part], durations[part]
        volumes[part] = x2
        percolated = percolation(p, x2, inflow, seconds)
        available = x2 / seconds + inflow - percolated
        evaporated = max(0.0, min(potential[part] * water_stress(p, x2), available))
        flows[part] = layer_outflow(p, layer, percolated, seconds)
        layer = max(0.0, layer + seconds * (percolated - flows[part]))
        x2 = max(0.0, x2 + seconds * (inflow - percolated - evaporated))


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
