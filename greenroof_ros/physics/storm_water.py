"""Wet weather, and the rain events of a run.

**Rain** counts if it falls at 0.1 mm/h or more, or within an hour after rain that counted. Unknown
rain counts, too. **Wet weather** is the time while rain counts, and the period ``wet_after``
afterwards, during which the sewer still carries storm water. Water that is released later reaches a
sewer with free capacity. A valve and the metrics of a run use this same rule, which looks only
back: a rain gauge cannot know whether light rain will become stronger.

**Events** are separated by a period ``event_separation`` without rain. The default is six hours,
which is usual in studies of green roofs, and for the separation time in SWMM's statistics (Rossman
2015, SWMM User's Manual Version 5.1, EPA-600/R-14/413b, Statistics Report). Water that reaches the
sewer before the end of this dry period belongs to the event. Only the volume and the peak in wet
weather are compared with the reference, because the purpose of a valve is to release water some
hours after rain.

**The reference** is the same area without a green roof and a cistern, from which all rain runs off
immediately: the whole area of the roof, and the area of the catchment times its runoff coefficient,
which corresponds to A_u in DWA-A 117 and DWA-A 138. Therefore the runoff of the reference in mm/h
equals the rain, as in Johannessen, Muthanna and Braskerud (2018, Water 10, 671), who compare the
five-minute peaks of rain and runoff.

A valve of the low outlet that can only be fully open or closed rests after it closed. A motor or a
solenoid withstands a limited number of operations. Closing is never delayed, because an open valve
can do harm; only the next opening waits.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.site.site import Site

MIN_DEPTH = 1e-4
"""minimum depth of a rain event or an overflow (m): 0.1 mm, the resolution of a rain gauge"""
HOUR_S = 3600.0
# Rates are rounded, and an hour with 0.1 mm must not fall below it (m/s).
_MIN_RAIN = MIN_DEPTH / HOUR_S * (1 - 1e-9)
_INTERVAL_S = 60.0
ROUNDING = 1 - 1e-9
"""share of a time that is not less than it, apart from rounding (1)"""

WITHOUT_RAIN = Parameter(
    "time_without_rain", math.inf, "s", 0.0, math.inf, "time without rain before tick 0, which "
    "determines whether a run starts in wet weather; by default, in dry weather",
)
"""parameter of the nodes that distinguish wet from dry weather"""


class Event(NamedTuple):
    """A rain event, and its discharge to the sewer.

    Attributes:
        start_h: time of the first rain, relative to the start of the run (h).
        hours: time from the first to the last rain (h).
        rain_mm: depth of the rain (mm).
        max_rain_5min_mm_h: mean rain rate of the wettest five minutes, which equals the peak of the
            reference.
        max_rain_60min_mm_h: mean rain rate of the wettest 60 minutes.
        discharge_m3: discharge from the first rain until the end of the dry hours that follow.
        wet_discharge_m3: part of the discharge that reached the sewer in wet weather.
        peak_l_s: maximum five-minute mean of the discharge in wet weather.
        peak_mm_h: this peak, divided by the connected area.
        volume_reduction: reduction of the volume in wet weather, relative to the reference (1).
        peak_reduction: reduction of the peak, relative to the reference (1).
        peak_delay_min: delay of the peak after that of the reference; None without discharge.
        complete: whether the run covers the whole event, and ``event_separation`` before and after.
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


def time_without_rain(before: float, rain: float, tau: float) -> float:
    """Return the time without rain until the end of a tick (s); 0 if rain counts in the tick.

    Args:
        before: time without rain until the end of the tick before (s); ``math.inf`` if none is
            known to have fallen.
        rain: rain in the tick (m/s), NaN if unknown.
        tau: duration of the tick (s).
    """
    if not rain < _MIN_RAIN or (rain > 0 and before < HOUR_S * ROUNDING):
        return 0.0
    return before + tau


def is_wet(without_rain: Any, tau: float, wet_after: float) -> Any:
    """Return whether the weather is wet in a tick, or in each tick.

    Args:
        without_rain: time without rain until the end of the tick (s), or an array of these times.
        tau: duration of the tick (s).
        wet_after: time after rain that counts as wet weather (s).
    """
    return without_rain - tau < wet_after * ROUNDING


def find_wet(rain: Any, tau: float, wet_after: float, without_rain: float) -> tuple[Any, float]:
    """Return whether the weather is wet in each tick, shape (n,), and the time without rain (s).

    Args:
        rain: rain in each tick (m/s), shape (n,).
        tau: duration of a tick (s).
        wet_after: time after rain that counts as wet weather (s).
        without_rain: time without rain before the first tick (s); the result is that after the
            last one.
    """
    wet = np.empty(len(rain), np.bool_)
    for tick in range(len(rain)):
        without_rain = time_without_rain(without_rain, rain[tick], tau)
        wet[tick] = is_wet(without_rain, tau, wet_after)
    return wet, without_rain


def interval_ticks(tau: float) -> int:
    """Return the length of an interval (ticks of tau seconds): a minute, rounded up.

    Peaks and events are computed from sums over these intervals.
    """
    return math.ceil(_INTERVAL_S / tau - 1e-9)


def interval_seconds(site: Site) -> float:
    """Return the duration of an interval (s)."""
    return site.tau * interval_ticks(site.tau)


def connected_area(site: Site) -> float:
    """Return the area whose rain would reach the sewer without a green roof and a cistern (m2)."""
    return site.effective_catchment + site.a2


OPENS_AT = 0.5
"""command (share) at which such a valve opens; at a smaller one, it closes"""
# A valve: whether it is open, the time since it last closed, and the time for which it then stays
# closed (s); the latter is 0 for a valve that follows every command.
OPEN, SINCE, REST = range(3)
# An opening that is due, apart from rounding, must not wait for another tick.
_ROUNDING = 1 - 1e-9


def make_valve(moves_per_hour: float | None) -> tuple[float, ...]:
    """Return a closed valve that may open at once.

    Args:
        moves_per_hour: ``valve_moves_per_hour`` of the site; None for a valve that follows every
            command.
    """
    rest = 0.0 if moves_per_hour is None else 2 * HOUR_S / moves_per_hour
    return 0.0, rest, rest


def move_valve(valve: Any, seconds: float, command: float) -> float:
    """Return the opening of a valve from now on (share), and record whether it moves.

    The valve closes at once, and at a command that is NaN, too. It opens again as soon as it has
    been closed for long enough, if it is commanded to. No hour therefore has more moves than its
    maximum.

    Args:
        valve: the valve, from :func:`make_valve`, as a list or an array.
        seconds: time since the last call (s).
        command: command to the valve (share); 0 if frost closes the valve.
    """
    if valve[REST] == 0:
        return command
    valve[SINCE] += seconds
    if not command >= OPENS_AT:
        if valve[OPEN] > 0:
            valve[OPEN], valve[SINCE] = 0.0, 0.0
    elif valve[SINCE] >= valve[REST] * _ROUNDING:
        valve[OPEN] = 1.0
    opening: float = valve[OPEN]
    return opening
