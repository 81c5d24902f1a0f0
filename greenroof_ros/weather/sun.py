"""Extraterrestrial radiation according to FAO-56, computed by the package ``eto``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.weather.records import number_days

MM_PER_MJ = 0.408
"""depth of water that solar radiation could evaporate (mm per MJ/m2), FAO-56 Eq. 20"""


def extraterrestrial_radiation(
    latitude: float, days: NDArray[np.datetime64]
) -> NDArray[np.float64]:
    """Return the daily Ra (MJ/m2) at a latitude (degrees north), FAO-56 Eq. 21, shape (days,)."""
    from eto import ETo  # takes long, and most files do not need it

    zero = np.zeros(len(days))
    model = ETo(
        {"T_min": zero, "T_max": zero}, freq="D", day_of_year=number_days(days), z_msl=0.0,
        lat=latitude, validate=False,
    )
    return np.asarray(model.ts_param["R_a"], dtype=np.float64)
