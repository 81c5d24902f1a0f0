"""What a runoff meter shows of what runs off."""

from __future__ import annotations

import numpy as np

from greenroof_ros.calibration.record import Record, Values

# So far a reading may be from a whole number of tips, in tips.
_ROUNDING = 0.02


def least_reading(record: Record) -> float:
    """Return the runoff of a step (mm) below which a record's meter shows none.

    It is the least reading above 0. A counter of tips, all of whose readings are multiples of one
    tip, misses nothing: what is less than a tip adds up to the next. For it, and without a meter,
    it is 0.
    """
    if record.runoff is None:
        return 0.0
    readings = record.runoff[record.runoff > 0]
    if not len(readings):
        return 0.0
    tips = readings / readings.min()
    counted = np.all(np.abs(tips - np.round(tips)) <= _ROUNDING)
    return 0.0 if counted else float(readings.min())


def through_meter(runoff: Values, least: float) -> Values:
    """Return what a meter shows of a runoff (mm in each step): none of what is below its least."""
    return np.where(runoff < least, 0.0, runoff)
