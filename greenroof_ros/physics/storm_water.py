"""Storm water that reaches the sewer during and after rain, and the rain events of a run.

All results are computed from sums over intervals of one minute, rounded up to a whole number of
ticks. Within an interval, rain and discharge are assumed to be constant. Flows before and after a
run are unknown, and are assumed to be 0.

**Peaks** are maxima of a moving mean, whose window may begin at any time. Fixed intervals of five
minutes would underestimate the peak of a storm by an eighth on average (Weiss 1964, Ratio of true
to fixed-interval maximum rainfall, Journal of the Hydraulics Division 90(1), 77-82: 1.14).

**Wet weather** is any time with rain that is part of an hour with at least 0.1 mm of rain, and also
the period ``wet_after`` after this rain, during which the sewer still carries storm water. Water
that is released later reaches a sewer with free capacity.

**The reference** is the same area without a green roof and a cistern, from which all rain runs off
immediately: the whole area of the roof, and the area of the catchment times its runoff coefficient,
which corresponds to A_u in DWA-A 117 and DWA-A 138. Therefore the runoff of the reference in mm/h
equals the rain, as in Johannessen, Muthanna and Braskerud (2018, Water 10, 671), who compare the
five-minute peaks of rain and runoff.

**Events** are separated by a period ``event_separation`` without rain. The default is six hours,
which is usual in studies of green roofs, and for the separation time in SWMM's statistics (Rossman
2015, SWMM User's Manual Version 5.1, EPA-600/R-14/413b, Statistics Report). Water that reaches the
sewer before the end of this dry period belongs to the event. Only the volume and the peak in wet
weather are compared with the reference, because the purpose of a valve is to release water some
hours after rain.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

MIN_DEPTH = 1e-4
"""minimum depth of a rain event or an overflow (m): 0.1 mm, the resolution of a rain gauge"""
WET_RAIN = MIN_DEPTH / 3600
"""minimum rate of rain in wet weather (m/s): 0.1 mm in an hour"""

_HOUR_S = 3600.0
_INTERVAL_S = 60.0
# Peaks are means over these numbers of minutes.
_PEAK_MIN = 5.0
# More than the rounding errors of an interval's sums (m3), but no water that matters.
_NOTHING = 1e-9
# Relative difference of sums that are equal but for rounding: the first of them is the peak.
_ROUNDING = 1 - 1e-9


class Intervals(NamedTuple):
    """Sums over the intervals of a run; every array has shape (n,)."""

    seconds: float
    """duration of an interval (s)"""
    rain: Values
    """rain, as a depth (m)"""
    discharge: Values
    """discharge to the sewer (m3)"""


class Event(NamedTuple):
    """A rain event, and its discharge to the sewer.

    Attributes:
        start_h: time of the first rain, relative to the start of the run (h).
        hours: time from the first to the last rain (h).
        rain_mm: depth of the rain (mm).
        max_rain_5min_mm_h: mean rain rate of the wettest five minutes, which equals the peak of the
            reference.
        max_rain_60min_mm_h: mean rain rate of the wettest 60 minutes.
        discharge_m3: water that reached the sewer from the first rain until the end of the dry
            hours that follow.
        wet_discharge_m3: part of the discharge that reached the sewer in wet weather.
        peak_l_s: maximum five-minute mean of the discharge in wet weather.
        peak_mm_h: the peak ``peak_l_s`` divided by the connected area.
        volume_reduction: relative reduction of the volume in wet weather compared with the
            reference (1).
        peak_reduction: relative reduction of the peak compared with the reference (1).
        peak_delay_min: delay of the peak relative to the reference's peak; None if there was no
            discharge in wet weather.
        complete: whether the run covers the whole event, including the dry hours after it.
    """

    start_h: float
    hours: float
    rain_mm: float
    max_rain_5min_mm_h: float
    max_rain_60min_mm_h: float
    discharge_m3: float
    wet_discharge_m3: float
    peak_l_s: float
    peak_mm_h: float
    volume_reduction: float
    peak_reduction: float
    peak_delay_min: float | None
    complete: bool


def interval_seconds(site: Site) -> float:
    """Return the duration of an interval (s): a minute, rounded up to a whole number of ticks."""
    return site.tau * math.ceil(_INTERVAL_S / site.tau - 1e-9)


def connected_area(site: Site) -> float:
    """Return the area whose rain would reach the sewer without a green roof and a cistern (m2)."""
    return site.effective_catchment + site.a2


def find_wet_weather(wet_after: float, intervals: Intervals) -> NDArray[np.bool_]:
    """Return a mask of the intervals in wet weather, shape (n,).

    Args:
        wet_after: parameter ``wet_after`` of the site (h).
        intervals: intervals of the run.
    """
    seconds, rain = intervals.seconds, intervals.rain
    size, places = max(1, round(_HOUR_S / seconds)), np.arange(len(rain))
    # Which hours have enough rain, whenever they begin; and how many of these contain an interval.
    fallen = np.append(0.0, np.cumsum(np.pad(rain, size - 1)))
    enough = fallen[size:] - fallen[:-size] >= size * seconds * WET_RAIN * _ROUNDING
    hours = np.append(0, np.cumsum(enough))
    rains = (rain > 0) & (hours[size:] > hours[:-size])
    after = round(wet_after * _HOUR_S / seconds)
    last = np.maximum.accumulate(np.where(rains, places, -after - 1))
    return np.asarray(places - last <= after)


def find_peak(intervals: Intervals, minutes: float) -> float:
    """Return the maximum mean discharge over a number of minutes (m3/s)."""
    return _find_maximum(intervals.discharge, intervals.seconds, minutes)[0]


def _find_maximum(values: Values, seconds: float, minutes: float) -> tuple[float, float]:
    """Return the maximum of the moving mean (per second), and the start of its first window (s).

    Args:
        values: sums over intervals.
        seconds: duration of an interval (s).
        minutes: width of the window (min).
    """
    window, edges = 60 * minutes, seconds * np.arange(len(values) + 1.0)
    total = np.append(0.0, np.cumsum(values))
    # The mean of constant pieces is largest where the window begins or ends with one of them.
    starts = np.concatenate((edges - window, edges))
    sums = np.interp(starts + window, edges, total) - np.interp(starts, edges, total)
    maximum = float(sums.max())
    return maximum / window, float(starts[sums >= maximum * _ROUNDING].min())


def find_events(site: Site, intervals: Intervals) -> list[Event]:
    """Return the rain events of a run in chronological order, excluding traces below 0.1 mm."""
    seconds, rain, area = intervals.seconds, intervals.rain, connected_area(site)
    dry = max(1, round(site.event_separation * _HOUR_S / seconds))
    rains = np.flatnonzero(rain > 0)
    firsts = rains[np.diff(rains, prepend=-np.inf) > dry]
    lasts = rains[np.diff(rains, append=np.inf) > dry]
    wet = np.where(find_wet_weather(site.wet_after, intervals), intervals.discharge, 0.0)
    events = []
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        until = last + 1 + dry  # no rain falls after the event
        fallen, discharge = rain[first:until], wet[first:until]
        depth, volume = float(fallen.sum()), float(discharge.sum())
        if depth < MIN_DEPTH * _ROUNDING:
            continue
        heaviest, at = _find_maximum(fallen, seconds, _PEAK_MIN)
        peak, later = _find_maximum(discharge, seconds, _PEAK_MIN)
        events.append(Event(
            start_h=first * seconds / _HOUR_S,
            hours=(last + 1 - first) * seconds / _HOUR_S,
            rain_mm=1000 * depth,
            max_rain_5min_mm_h=1000 * _HOUR_S * heaviest,
            max_rain_60min_mm_h=1000 * _HOUR_S * _find_maximum(fallen, seconds, 60.0)[0],
            discharge_m3=float(intervals.discharge[first:until].sum()),
            wet_discharge_m3=volume,
            peak_l_s=1000 * peak,
            peak_mm_h=1000 * _HOUR_S * peak / area,
            volume_reduction=1 - volume / (depth * area),
            peak_reduction=1 - peak / (heaviest * area),
            peak_delay_min=(later - at) / 60 if volume > _NOTHING else None,
            complete=first > 0 and until <= len(rain),
        ))
    return events
