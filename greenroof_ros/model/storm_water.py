"""Storm water: what reaches the sewer, when it rains and after, event by event.

All figures come from the sums of intervals of five minutes, or the whole ticks that last as long.

**Wet weather** is a time with rain, in an hour with at least 0.1 mm, and ``wet_after`` of the site
after it: the sewer still carries storm water then. What is let out later meets a sewer with room.

**Events** are separated by at least six hours without rain, the inter-event time of SWMM's
statistics (Rossman and Huber 2016, SWMM Reference Manual Volume I, EPA/600/R-15/162A, Sec. 2.5).
What reaches the sewer until these six hours are over belongs to the event. It is compared with the
same area without roof and cistern, from which all rain runs off at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.site import Site

Values = NDArray[np.float64]

WET_RAIN = 1e-4 / 3600
"""Rain of at least this rate (m/s), 0.1 mm in an hour, is wet weather."""
DRY_HOURS = 6.0
"""Events are separated by at least this time without rain (h)."""

_HOUR_S = 3600.0
_INTERVAL_S = 300.0
# More than the rounding errors of an interval's sums (m3), and no water that matters.
_NOTHING = 1e-9


class Intervals(NamedTuple):
    """Sums of the intervals of a run; each array has shape (n,)."""

    seconds: float
    """duration of an interval (s)"""
    rain: Values
    """depth (m)"""
    discharge: Values
    """to the sewer (m3)"""


class Event(NamedTuple):
    """An event of rain, and what of it reached the sewer."""

    start_h: float
    """since the run's start (h)"""
    hours: float
    """from the first rain to the last (h)"""
    rain_mm: float
    """depth"""
    max_rain_5min_mm_h: float
    """of the wettest five minutes"""
    max_rain_60min_mm_h: float
    """of the wettest 60 minutes"""
    discharge_m3: float
    """what reached the sewer"""
    peak_l_s: float
    """of it in the five minutes with the most"""
    volume_reduction: float
    """share of the area's runoff without roof and cistern that did not reach the sewer (1)"""
    peak_reduction: float
    """the same of the peak (1)"""
    peak_delay_min: float
    """how much later than without them the peak came (min); NaN if nothing reached the sewer"""


def interval_seconds(site: Site) -> float:
    """Return the duration of an interval (s): five minutes, up to a whole number of ticks."""
    return site.tau * math.ceil(_INTERVAL_S / site.tau - 1e-9)


def connected_area(site: Site) -> float:
    """Return the area whose rain reaches the sewer without roof and cistern (m2)."""
    return site.effective_catchment + site.a2


def find_wet_weather(site: Site, intervals: Intervals) -> NDArray[np.bool_]:
    """Return which intervals are in wet weather, shape (n,)."""
    per_hour = max(1, round(_HOUR_S / intervals.seconds))
    rains, count = intervals.rain > 0, len(intervals.rain)
    hour = np.arange(count) // per_hour
    fallen = np.bincount(hour, intervals.rain)
    rains &= fallen[hour] >= per_hour * intervals.seconds * WET_RAIN * (1 - 1e-9)
    after = round(site.wet_after * _HOUR_S / intervals.seconds)
    last = np.maximum.accumulate(np.where(rains, np.arange(count), -after - 1))
    return np.asarray(np.arange(count) - last <= after)


def find_peak(intervals: Intervals, minutes: float) -> float:
    """Return the maximum mean discharge over some minutes (m3/s); over an interval if longer."""
    return _find_maximum(intervals.discharge, intervals.seconds, minutes)[0] / intervals.seconds


def _find_maximum(values: Values, seconds: float, minutes: float) -> tuple[float, int]:
    """Return the maximum of the moving mean, and the first interval of its window."""
    size = min(len(values), max(1, round(minutes * 60 / seconds)))
    sums = np.convolve(values, np.ones(size), "valid")
    first = int(sums.argmax())
    return float(sums[first]) / size, first


def find_events(site: Site, intervals: Intervals, dry_hours: float = DRY_HOURS) -> list[Event]:
    """Return the events of a run in the order of time; traces below 0.1 mm are none.

    Args:
        site: of the run.
        intervals: of the run.
        dry_hours: minimum time without rain between two events (h).
    """
    seconds, area = intervals.seconds, connected_area(site)
    wet, dry = np.flatnonzero(intervals.rain > 0), round(dry_hours * _HOUR_S / seconds)
    firsts = wet[np.diff(wet, prepend=-np.inf) > dry]
    lasts = wet[np.diff(wet, append=np.inf) > dry]
    events = []
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        rain = intervals.rain[first : last + 1 + dry]  # no rain falls after the event
        discharge = intervals.discharge[first : last + 1 + dry]
        depth, volume = float(rain.sum()), float(discharge.sum())
        if depth < _HOUR_S * WET_RAIN:
            continue
        heaviest, at = _find_maximum(rain, seconds, 5.0)
        peak, later = _find_maximum(discharge, seconds, 5.0)
        events.append(Event(
            first * seconds / _HOUR_S, (last + 1 - first) * seconds / _HOUR_S, 1000 * depth,
            1000 * heaviest * _HOUR_S / seconds,
            1000 * _find_maximum(rain, seconds, 60.0)[0] * _HOUR_S / seconds,
            volume, 1000 * peak / seconds,
            1 - volume / (depth * area), 1 - peak / (heaviest * area),
            (later - at) * seconds / 60 if volume > _NOTHING else np.nan,
        ))
    return events
