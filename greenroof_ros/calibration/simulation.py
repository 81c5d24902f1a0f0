"""A measured roof under a record's rain, pumping and evapotranspiration, and what meters show."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import MeasuredSoil

# Less in the drainage layer does not count: its outflow falls with the square (m3 per m2).
_EMPTY = 1e-9
# Within less the drainage layer's inflow hardly changes, and within less the soil dries so little
# that its water stress stays (s).
_WET_S, _DRY_S = 600.0, 3600.0
# So far a reading may be off by the digits of other programs, as a share: five digits.
_DIGITS = 5e-5


class Simulated(NamedTuple):
    """What a record of the simulated roof would hold."""

    runoff: Values
    """off the roof in each step (mm), shape (steps,)"""
    level: Values
    """of the water in the substrate at the beginning of each step (m), shape (steps,)"""


def simulate(site: Site, record: Record, filled: float, least: float = 0.0) -> Simulated:
    """Follow a measured roof through a record's steps.

    It is the roof of :class:`greenroof_ros.model.plant.Plant` with short ticks: how much percolates
    is solved for the whole of a step. So is what runs off, but for an inflow that is constant:
    steps longer than ten minutes are parted while water arrives, and those longer than an hour
    always. What comes in a step comes evenly. Rain that was not measured counts as none. The soil
    is asked only in steps in which something moves, which are few in a dry week.

    Args:
        site: with a ``field_capacity``.
        record: rain, pumped water and reference evapotranspiration.
        filled: share of the available water that is there at first, 0 to 1.
        least: runoff of a step (mm) below which a meter shows none.
    """
    volume_flow = site.a2 / 1000 / record.step_s  # m3/s of a mm in a step
    came = record.came
    wet, dry = (math.ceil(record.step_s / longest) for longest in (_WET_S, _DRY_S))
    parts = np.where(came > 0, wet, dry)
    starts = np.cumsum(parts) - parts
    durations = np.repeat(record.step_s / parts, parts)
    arriving = np.repeat(came * volume_flow, parts)
    asked = np.repeat(record.reference * site.crop_coefficient * volume_flow, parts)
    soil, capacity, empty = MeasuredSoil(site), site.z_cap, _EMPTY * site.a2
    x2, layer = site.wilting_volume + filled * site.available_volume, 0.0
    volumes = np.empty(len(durations))
    flows = np.zeros(len(durations))
    for part, (comes, wanted, seconds) in enumerate(
        zip(arriving.tolist(), asked.tolist(), durations.tolist(), strict=True)
    ):
        volumes[part] = x2
        percolated = 0.0
        if comes > 0 or x2 > capacity:
            percolated = soil.mean_percolation(x2, comes, seconds)
        evaporated = 0.0
        if wanted > 0:
            left = x2 / seconds + comes - percolated
            evaporated = max(0.0, min(wanted * soil.water_stress(x2), left))
        if percolated > 0 or layer > empty:
            drained = soil.layer_outflow(layer, percolated, seconds)
            flows[part] = drained
            layer = max(0.0, layer + seconds * (percolated - drained))
        x2 = max(0.0, x2 + seconds * (comes - percolated - evaporated))
    runoff = np.add.reduceat(flows * durations, starts) * 1000 / site.a2
    runoff = np.where(runoff < least, 0.0, runoff)
    return Simulated(runoff, volumes[starts] / site.a2)


def least_reading(record: Record) -> float:
    """Return the runoff of a step (mm) below which a record's meter shows none.

    It is the least reading above 0. A counter of tips misses nothing: what is less than a tip adds
    up to the next. For it, and without a meter, it is 0.
    """
    if record.runoff is None:
        return 0.0
    readings = np.unique(record.runoff[record.runoff > 0])
    if not len(readings) or _counted(readings, record.last_decimal):
        return 0.0
    return float(readings[0])


def _counted(readings: Values, last_decimal: float) -> bool:
    """Whether readings, in rising order, are multiples of one tip, but for their rounding.

    A reading of n tips, rounded by h at most, says that a tip is (reading - h) / n to
    (reading + h) / n. Each is asked for its n at the tip that those before it allow, as the least
    reading alone can be half a tip off by its rounding.
    """
    low, high = 0.0, 2 * float(readings[0])
    for reading in readings.tolist():
        off = last_decimal / 2 + _DIGITS * reading
        tips = max(1, round(2 * reading / (low + high)))
        low, high = max(low, (reading - off) / tips), min(high, (reading + off) / tips)
        if low > high:
            return False
    return True
