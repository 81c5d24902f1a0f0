"""What a runoff meter shows of what runs off."""

from __future__ import annotations

import numpy as np

from greenroof_ros.calibration.record import Record, Values

# So far a reading may be off by the digits of other programs, as a share: five digits.
_DIGITS = 5e-5


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


def through_meter(runoff: Values, least: float) -> Values:
    """Return what a meter shows of a runoff (mm in each step): none of what is below its least."""
    return np.where(runoff < least, 0.0, runoff)
