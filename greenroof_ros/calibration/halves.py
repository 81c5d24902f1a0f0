"""Which steps of a record a fit may see, and which judge it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Record

Steps = NDArray[np.bool_]


class Halves(NamedTuple):
    """Two parts of a record, each in one piece but for its gaps."""

    earlier: Steps
    later: Steps


# So long without rain that the half before has run off.
_DRY_S = 86400


def halve(record: Record, steps: Steps) -> Halves:
    """Split steps on the first dry day after half of the rain and of what was pumped has come.

    Water is what tells something about a roof: halves of the time may have all storms in one. And a
    storm in both would be judged by those who have seen it.

    Args:
        record: its rain.
        steps: that count at all.
    """
    came = np.nan_to_num(record.rain) + np.nan_to_num(record.pumped)
    total = np.cumsum(np.where(steps, came, 0.0))
    enough = total >= total[-1] / 2
    since = np.ones(math.ceil(_DRY_S / record.step_s))
    dry = np.convolve(came > 0, since, "full")[:record.steps] == 0
    # Without a dry day there is no half: the caller sees that nothing is in it.
    later = np.cumsum(enough & dry) > 0
    return Halves(steps & ~later, steps & later)
