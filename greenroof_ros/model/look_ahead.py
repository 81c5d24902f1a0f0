"""How far controllers look ahead, in which steps, and at how many forecasts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Steps (s) for the first four hours and a half; further ones are an hour each. Fine where a
# decision is carried out, coarse where it only has to be made room for.
_FIRST = [10] * 6 + [30] * 2 + [60] * 3 + [300] * 3 + [900] * 4 + [1800] * 6
_HOUR = 3600

# Of an ensemble of forecasts.
MOST_MEMBERS = 100


def growing_steps(horizon: float) -> NDArray[np.float64]:
    """Return the ends of steps that grow, from now to the horizon.

    Args:
        horizon: how far (h).

    Returns:
        Seconds from now, the first 0, the last the horizon's, shape (steps + 1,).
    """
    seconds = horizon * _HOUR
    more = max(0, int(np.ceil((seconds - sum(_FIRST)) / _HOUR)))
    ends = np.cumsum([*_FIRST, *[_HOUR] * more])
    return np.concatenate(([0.0], ends[ends < seconds], [seconds]))
