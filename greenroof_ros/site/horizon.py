"""The look-ahead of the controllers: horizon, steps and maximum size of a forecast ensemble."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.site.site import Site

Array = NDArray[np.float64]

# Steps (s) for the first day; later steps are six hours each. Steps are fine where decisions are
# carried out, and coarse where a plan only has to leave room.
_FIRST_DAY = [10] * 6 + [30] * 2 + [60] * 3 + [300] * 3 + [900] * 4 + [1800] * 6 + [3600] * 20
_LATER = 21_600
_HOUR = 3600

MAX_HORIZON = 240.0
"""maximum horizon of a controller (h): ten days"""

MAX_MEMBERS = 100
"""maximum number of members in an ensemble of forecasts"""


def growing_steps(horizon: float) -> Array:
    """Return the boundaries of steps of increasing length, from now to the horizon.

    From 4 h 20 min on, each step lasts one hour, and from 24 h 20 min on, six hours. The last
    step ends at the horizon.

    Args:
        horizon: length of the look-ahead (h).

    Returns:
        Boundaries of the steps (s from now), from 0 to the horizon, shape (steps + 1,).
    """
    seconds = horizon * _HOUR
    more = max(0, int(np.ceil((seconds - sum(_FIRST_DAY)) / _LATER)))
    ends = np.cumsum([*_FIRST_DAY, *[_LATER] * more])
    return np.concatenate(([0.0], ends[ends < seconds], [seconds]))


def look_ahead_ends(site: Site, horizon: float, outlet_horizon: float = 0.0) -> Array:
    """Return the boundaries of a look-ahead's steps (s from now, first 0), shape (steps + 1,).

    Args:
        site: site with the duration of a tick and the look-ahead M.
        horizon: length of the look-ahead (h), in steps of increasing length; 0 for M steps of one
            tick.
        outlet_horizon: length of the look-ahead for planning the outlet valve (h), for which steps
            are appended; 0 for no plan.
    """
    ends = growing_steps(horizon) if horizon else site.tau * np.arange(site.M + 1.0)
    further = growing_steps(outlet_horizon) if outlet_horizon else ends
    return np.concatenate((ends, further[further > ends[-1]]))
