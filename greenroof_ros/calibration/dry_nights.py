"""What the dry nights of a record say about its level sensor."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.formats.records import gaps

# A day after the last water nothing moves on a roof at night.
_DRY_S = 86400
_SHORTEST_NIGHT_S = 3 * 3600
_FEWEST_NIGHTS = 5
_DAY_S = 86400


class LevelSensor(NamedTuple):
    """A level sensor, as its dry nights show it."""

    nights: int
    noise: float
    """standard deviation within a night (m)"""
    drift: float
    """of measured less simulated, from night to night (m/day)"""
    half: float
    """half of the drift's 95 % interval (m/day)"""


def dry_nights(record: Record, simulated: Values) -> LevelSensor | None:
    """Return what is seen in nights in which neither rain nor evapotranspiration moves the level.

    The noise is what the level does within a night, about its mean; the drift the line through what
    the nights' means are above the simulated level. An offset cannot be told from the wilting
    point, which takes it up.

    Args:
        record: with a level.
        simulated: level (m), shape (steps,).

    Returns:
        None where there are fewer than five such nights.
    """
    assert record.level is not None
    water = np.nan_to_num(record.rain) + np.nan_to_num(record.pumped) > 0
    since = np.ones(math.ceil(_DRY_S / record.step_s))
    recent = np.convolve(water, since, "full")[:record.steps] > 0
    still = ~recent & (record.reference == 0) & ~np.isnan(record.level)
    times, errors, variances = [], [], []
    for low, high in gaps(still):
        if high - low > 1 and (high - low) * record.step_s >= _SHORTEST_NIGHT_S:
            times.append((low + high) / 2 * record.step_s / _DAY_S)
            errors.append(float(np.mean(record.level[low:high] - simulated[low:high])))
            variances.append(float(np.var(record.level[low:high], ddof=1)))
    if len(times) < _FEWEST_NIGHTS:
        return None
    from scipy.stats import linregress  # half of what the command imports, before it refuses
    from scipy.stats import t as student

    line = linregress(times, errors)
    half = float(line.stderr * student.ppf(0.975, len(times) - 2))
    return LevelSensor(len(times), float(np.sqrt(np.mean(variances))), float(line.slope), half)
