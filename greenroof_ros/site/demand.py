"""Water that is drawn from the cistern besides the roof's: for toilets, a garden or washing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.site.site import Site

_LITRES_PER_DAY = 1 / 1000 / 86_400  # in m3/s
_HOUR_NS = 3_600_000_000_000


def other_demand(site: Site, first_ns: int, tick_ns: int, ticks: int) -> NDArray[np.float64]:
    """Return what other uses than the roof need in consecutive ticks (m3/s), shape (ticks,).

    Months begin at midnight of standard time.

    Args:
        site: the site.
        first_ns: time of the first tick (ns since 1970).
        tick_ns: duration of a tick (ns).
        ticks: number of ticks.
    """
    if site.monthly_other_demand is None:
        return np.zeros(ticks)
    times = first_ns + round(site.clock_offset * _HOUR_NS) + tick_ns * np.arange(ticks)
    months = times.astype("datetime64[ns]").astype("datetime64[M]").astype(np.intp) % 12
    return np.array(site.monthly_other_demand)[months] * _LITRES_PER_DAY
