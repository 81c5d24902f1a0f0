"""The storms of a record, and which of its steps can be compared with a simulation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Record

Steps = NDArray[np.bool_]

# So long without rain parts two storms, and so long after it the roof still answers (s).
_APART_S, _AFTER_S = 6 * 3600, 24 * 3600


class Storm(NamedTuple):
    """The steps from its first rain to a day after its last, or to the next storm."""

    first: int
    end: int
    rain: float
    """mm"""


def storms(record: Record) -> list[Storm]:
    """Return all storms: rain with less than six hours between, and less than a dry step."""
    wet = np.flatnonzero(np.nan_to_num(record.rain) > 0)
    if not len(wet):
        return []
    after = math.ceil(_AFTER_S / record.step_s)
    apart = max(1.0, _APART_S / record.step_s)
    parts = np.split(wet, np.flatnonzero(np.diff(wet) > apart) + 1)
    starts = [int(part[0]) for part in parts] + [record.steps]
    return [
        Storm(
            int(part[0]), int(min(part[-1] + 1 + after, following)),
            float(np.nansum(record.rain[part[0]:part[-1] + 1])),
        )
        for part, following in zip(parts, starts[1:], strict=True)
    ]


def comparable(record: Record) -> Steps:
    """Return which steps a simulation is compared in: the known ones outside of broken storms.

    A storm is broken where rain, pumped water or runoff is missing in it. What came unseen stays on
    the roof for all of it. And meters fail when most runs off: what they show before and after
    their gap is then a part of it, and where that ends nobody knows.
    """
    steps = record.known
    missing = np.isnan(record.rain) | np.isnan(record.pumped)
    if record.runoff is not None:
        missing |= np.isnan(record.runoff)
    for storm in storms(record):
        if missing[storm.first:storm.end].any():
            steps[storm.first:storm.end] = False
    return steps
