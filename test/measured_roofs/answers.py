"""Storm by storm: greatest runoff, its delay, and volume."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from roofs import STEP_S

from greenroof_ros.calibration.record import Record, Storm

Values = NDArray[np.float64]


class Answer(NamedTuple):
    """What a roof makes of a storm."""

    peak: float
    """greatest runoff of a quarter of an hour (mm/h)"""
    delay: float
    """from when half of the rain has fallen to that peak (min)"""
    volume: float
    """mm"""


def answer(storm: Storm, record: Record, runoff: Values) -> Answer:
    """Return what a runoff (mm in each step) is in a storm."""
    within = runoff[storm.first:storm.end]
    fallen = np.cumsum(np.nan_to_num(record.rain[storm.first:storm.end]))
    half = int(np.searchsorted(fallen, fallen[-1] / 2))
    quarters = np.convolve(within, np.ones(3), "valid")
    peak = int(np.argmax(quarters))
    delay = (peak + 1 - half) * STEP_S / 60 if quarters[peak] > 0 else np.nan
    return Answer(float(quarters[peak]) * 4, delay, float(within.sum()))
