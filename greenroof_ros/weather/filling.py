"""Gaps in records: the short ones, which are filled, and the long ones, which are if asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.weather.records import PRECIPITATION, Records, gaps

REFUSE, FILL = "refuse", "fill"
GAPS = (REFUSE, FILL)
"""What is done about an hour that a run needs and that no short gap has: the first by default."""

# The longest gap that is filled, by a straight line between the hours before and after it (h).
# Temperature and wind follow the sun, so half a day must be left to see it by; dew point and
# pressure follow the air mass, which changes within days. Rain is never guessed.
LONGEST_GAP = {"temperature": 6, "wind speed": 6, "dew point": 24, "station pressure": 24}

# Hours from a missing one to those of the same time of day whose mean stands for it.
_SAME_TIME_OF_DAY = 24 * np.array([-3, -2, -1, 1, 2, 3])


def fill_short_gaps(records: Records) -> Records:
    """Fill the gaps of at most :data:`LONGEST_GAP` hours that have records on both sides."""
    values, filled = dict(records.values), dict(records.filled)
    for quantity, longest in LONGEST_GAP.items():
        if quantity not in values:
            continue
        series = values[quantity].copy()
        missing = np.isnan(series)
        for low, high in gaps(missing):
            if high - low <= longest and low > 0 and high < len(series):
                series[low:high] = np.interp(
                    np.arange(low, high), [low - 1, high], [series[low - 1], series[high]]
                )
        values[quantity] = series
        filled[quantity] = missing & ~np.isnan(series)
    return replace(records, values=values, filled=filled)


def fill_long_gaps(records: Records) -> Records:
    """Fill what is still missing: rain with none, all else with the mean of the days about it.

    That is the mean at the same time of day over the three days before and the three days after,
    of those hours that are known, be it by a short gap. Where none of them is, the hour stays
    missing. Years are worth more with a few hours guessed than cut into pieces; but rain that was
    not measured is lost, so that this must be asked for.
    """
    values, filled = {}, {}
    for quantity, series in records.values.items():
        missing = np.isnan(series)
        values[quantity] = series.copy()
        values[quantity][missing] = 0.0 if quantity == PRECIPITATION else _about(series, missing)
        short = records.filled.get(quantity, np.zeros_like(missing))
        filled[quantity] = short | missing & ~np.isnan(values[quantity])
    return replace(records, values=values, filled=filled)


def _about(series: NDArray[np.float64], missing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return for each missing hour the mean of the days about it; NaN where none is known."""
    padded = np.pad(series, -_SAME_TIME_OF_DAY[0], constant_values=np.nan)
    hours = np.flatnonzero(missing) - _SAME_TIME_OF_DAY[0]
    near = padded[hours[:, None] + _SAME_TIME_OF_DAY]
    known = np.count_nonzero(~np.isnan(near), axis=1)
    return np.where(known > 0, np.nansum(near, axis=1) / np.maximum(known, 1), np.nan)
