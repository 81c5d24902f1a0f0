"""How far controllers look ahead, in which steps, and with how many forecasts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.site import Site

# Steps (s) for the first day; later steps are six hours each. Steps are fine where decisions are
# carried out, and coarse where a plan only has to leave room.
_FIRST_DAY = [10] * 6 + [30] * 2 + [60] * 3 + [300] * 3 + [900] * 4 + [1800] * 6 + [3600] * 20
_LATER = 21_600
_HOUR = 3600

MAX_HORIZON = 240.0
"""the maximum horizon (h): ten days"""

MAX_MEMBERS = 100
"""the maximum number of members of an ensemble of forecasts"""


def growing_steps(horizon: float) -> NDArray[np.float64]:
    """Return the ends of growing steps, from now to the horizon.

    From 4 h 20 min on, steps are an hour each; from 24 h 20 min on, six hours; the last one ends at
    the horizon.

    Args:
        horizon: how far to look ahead (h).

    Returns:
        Seconds from now, the first 0, the last at the horizon, shape (steps + 1,).
    """
    seconds = horizon * _HOUR
    more = max(0, int(np.ceil((seconds - sum(_FIRST_DAY)) / _LATER)))
    ends = np.cumsum([*_FIRST_DAY, *[_LATER] * more])
    return np.concatenate(([0.0], ends[ends < seconds], [seconds]))


def look_ahead_ends(
    site: Site, horizon: float, outlet_horizon: float = 0.0
) -> NDArray[np.float64]:
    """Return the ends of the steps of a look-ahead (s from now), the first 0, shape (steps + 1,).

    Args:
        site: site with tick and look-ahead.
        horizon: 0 for the next M ticks one by one; otherwise hours, in steps that grow.
        outlet_horizon: hours that a plan of the outlet valve looks ahead, in further steps.
    """
    ends = growing_steps(horizon) if horizon else site.tau * np.arange(site.M + 1.0)
    further = growing_steps(outlet_horizon) if outlet_horizon else ends
    return np.concatenate((ends, further[further > ends[-1]]))
