"""The running sums of a run, to which each tick is added: the basis of all metrics.

The same text adds the ticks of a simulation, a graph, a bag, a study or a district, plain or
compiled. All sums are sequential Euler sums: a value holds from its tick to the next one. Flows
before and after a run are unknown, and are assumed to be 0.

The sums of a run are one array of numbers, whose places have names here. After them come buffers of
the last 64 intervals (of a minute, rounded up to a whole number of ticks), of the last 24 hours,
and of the pump starts in the last hour.

**Peaks** are maxima of a moving mean, whose window may begin at any time within the run. Fixed
intervals of five minutes would underestimate the peak of a storm by an eighth on average (Weiss
1964, Ratio of true to fixed-interval maximum rainfall, Journal of the Hydraulics Division 90(1),
77-82: 1.14). Within an interval, rain and discharge are assumed to be constant.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.cistern import MIN_RUN_S
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.pump import RUNNING_SHARE, running_flow
from greenroof_ros.physics.soil import stress_volume
from greenroof_ros.physics.storm_water import (
    HOUR_S,
    MIN_DEPTH,
    connected_area,
    interval_seconds,
)
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

NEAR_TARGET = 0.05
"""half width of the band around the roof's target in which a level is near the target (share of the
target)
"""
PEAKS_MIN = (5, 15, 60)
"""widths of the windows of peaks (min)"""

_WEEK_H, _DAY_H, _DRAINS_H = 168, 24, 6
_WATER_DENSITY = 1000.0  # kg/m3
# Rain in an hour and in a day (mm) from which their retention is reported. Sums of rain are
# rounded: 20 mm must not be treated as more than 20 mm.
_STORM_HOUR_MM, _STORM_DAY_MM, _ROUNDING_MM = 20.0, 10.0, 1e-6
# More than the rounding errors of an interval's sums (m3), but no water that matters.
_NOTHING = 1e-9
_FIRST = 1 + 1e-9  # of equal peaks, the first one counts

# Places of the sums. Volumes are in m3, depths in m.
(
    TICKS, DEVIATION, NEAR, STRESSED, RAIN, EVAPORATED, POTENTIAL, DRAINED, PUMPED, MAINS, OUTFLOW,
    OVERFLOW, DISCHARGE, WET_DISCHARGE, MAX_COMMAND, BEYOND, LIMITED, PUMP_TICKS, STARTS,
    BUSIEST_HOUR, EXCESS_STARTS, ENERGY_J, OVERFLOW_DAYS, PEAK_5, PEAK_15, PEAK_60, LOST, HOUR_RAIN,
    HOUR_LOST, DAY_RAIN, DAY_LOST, EVENTS, FIRST_CISTERN, CISTERN, ROOF, LAYER, _WEEK, _HOUR,
    _DAY_OVERFLOW, _RUNNING, _FIRST_START, _INTERVAL, _IN_INTERVAL, _HOUR_RAIN, _HOUR_PUMPED,
    _HOUR_DRAINED, _RAINED, _LAST_RAIN, _EVENT_OPEN, _EVENT_BEGIN, _EVENT_END, _EVENT_DISCHARGE,
    _EVENT_WET, _EVENT_MAX_5, _EVENT_AT_5, _EVENT_MAX_60, _EVENT_AT_60, _EVENT_PEAK,
    _EVENT_PEAK_AT, _PLACES,
) = range(60)
# Buffers: sums of discharge, of discharge in wet weather and of rain at the ends of the last
# intervals; rain, pumped water, drainage, drainage of rain, and whether the hour's rain is counted.
_RING = 64
_FLOW, _WET, _FALLEN = _PLACES, _PLACES + _RING, _PLACES + 2 * _RING
_HOURS = _PLACES + 3 * _RING
_STARTS = _HOURS + 4 * _DAY_H
# Columns of the table of events, in intervals, m and m3.
(
    BEGIN, END, DEPTH, MAX_5, MAX_60, VOLUME, WET_VOLUME, PEAK, DELAY, COMPLETE, EVENT_COLUMNS,
) = range(11)


class SumParameters(NamedTuple):
    """The numbers of a site that its sums need."""

    tau: float
    a1: float
    a2: float
    x2_star: float
    near: float
    """deviation up to which the roof is near its target (m3)"""
    stress_volume: float
    to_sewer: float
    """share of the roof's drainage that flows to the sewer (1)"""
    target: float
    suction: float
    """volumes on the roof and in the cistern at which the pumps stop (m3)"""
    b: float
    c_hat: float
    d: float
    running_flow: float
    min_share: float
    """share of the commanded flow above which the pumps count as running (1)"""
    has_short_ticks: bool
    pipe_resistance: float
    weight: float
    """density of water times the acceleration due to gravity (N/m3)"""
    starts_per_hour: float
    start_places: float
    """starts that are kept"""
    interval_ticks: float
    windows_5: float
    windows_15: float
    windows_60: float
    """widths of the windows of peaks (intervals)"""
    separation: float
    """time between events (intervals)"""
    overflow_of_day: float
    """overflow that makes a day one of overflow (m3)"""


def sum_parameters(site: Site) -> SumParameters:
    """Return the numbers of a site."""
    p, seconds = plant_parameters(site), interval_seconds(site)
    windows = [60.0 * minutes / seconds for minutes in PEAKS_MIN]
    return SumParameters(
        site.tau, site.a1, site.a2, site.x2_star, NEAR_TARGET * site.x2_star, stress_volume(p),
        1 - site.drainage_to_cistern, site.a2 * site.z_veg, site.a1 * site.suction_level, site.b,
        site.c_hat, site.d, running_flow(p),
        # In a long tick they can run for less than 1 % of it.
        min(RUNNING_SHARE, MIN_RUN_S / site.tau / 2), p.has_short_ticks, site.pipe_resistance,
        _WATER_DENSITY * site.g, site.starts_per_hour, math.ceil(HOUR_S / 2 / site.tau) + 1,
        round(seconds / site.tau), windows[0], windows[1], windows[2],
        max(1, round(site.event_separation * HOUR_S / seconds)),
        MIN_DEPTH * connected_area(site),
    )


def count_places(q: SumParameters) -> int:
    """Return the number of places of a site's sums."""
    return _STARTS + int(q.start_places)


def count_events(q: SumParameters, ticks: int) -> int:
    """Return the maximum number of events in a run."""
    return int(ticks / q.interval_ticks / (q.separation + 1)) + 2


def count_weeks(q: SumParameters, ticks: int) -> int:
    """Return the number of weeks of a run; the last one may be shorter."""
    return max(1, int((ticks - 0.5) * q.tau // (_WEEK_H * HOUR_S)) + 1)


def add(
    q: SumParameters, sums: Any, weeks: Any, events: Any, state: State, command: float,
    rain: float, potential: float, flows: Flows, wet: bool, new_day: bool,
) -> None:
    """Add a tick.

    Args:
        q: numbers of the site.
        sums: sums so far, at first zeros, shape (:func:`count_places`,).
        weeks: sums of the deviation in each week (m3), shape (weeks,).
        events: rain events, shape (n, :data:`EVENT_COLUMNS`); those beyond n are only counted.
        state: state at the start of the tick.
        command: command of the controller (share of the maximum flow).
        rain: rain rate (m/s).
        potential: potential evapotranspiration (m3/s).
        flows: flows in the tick (m3/s).
        wet: whether the weather is wet in the tick.
        new_day: whether the tick is the first of a day of the site's clock.
    """
    tau = q.tau
    if sums[TICKS] == 0:
        sums[FIRST_CISTERN] = state.cistern
    if (sums[TICKS] + 0.5) * tau >= (sums[_HOUR] + 1) * HOUR_S:
        _end_hours(q, sums, (sums[TICKS] + 0.5) * tau)
    if new_day:
        _end_day(q, sums)
    sums[TICKS] += 1
    deviation = abs(state.roof - q.x2_star)
    sums[DEVIATION] += deviation
    weeks[int(sums[_WEEK])] += deviation
    if deviation <= q.near:
        sums[NEAR] += 1
    if state.roof < q.stress_volume or state.roof <= 0:
        sums[STRESSED] += 1
    sums[EVAPORATED] += tau * flows.evapotranspiration
    sums[POTENTIAL] += tau * potential
    if rain > 0:
        sums[RAIN] += tau * rain
        if sums[_EVENT_OPEN] == 0:
            _begin_event(sums)
        sums[_EVENT_END] = sums[_INTERVAL]
    discharge = q.to_sewer * flows.drainage
    if flows.drainage > 0:
        sums[DRAINED] += tau * flows.drainage
    if flows.outflow > 0:
        discharge += flows.outflow
        over = tau * (flows.outflow - flows.low_outlet)
        sums[OUTFLOW] += tau * flows.outflow
        sums[OVERFLOW] += over
        sums[_DAY_OVERFLOW] += over
    if discharge > 0:
        sums[DISCHARGE] += tau * discharge
        if wet:
            sums[WET_DISCHARGE] += tau * discharge
    if flows.mains > 0:
        sums[MAINS] += tau * flows.mains
    if flows.limited:
        sums[LIMITED] += 1
    if command > sums[MAX_COMMAND]:
        sums[MAX_COMMAND] = command
    if command > 1:
        sums[BEYOND] += 1
    if flows.pump > 0:
        _add_pump(q, sums, state, command, rain, flows)
    else:
        sums[_RUNNING] = 0.0
    sums[_IN_INTERVAL] += 1
    if sums[_IN_INTERVAL] >= q.interval_ticks:
        end_interval(q, sums, events)


def _add_pump(
    q: SumParameters, sums: Any, state: State, command: float, rain: float, flows: Flows
) -> None:
    """Add the pumps in a tick with a flow; see :func:`running_share`."""
    sums[PUMPED] += q.tau * flows.pump
    share = running_share(q, state, command, rain, flows)
    flow = flows.pump / share if share > 0 else flows.pump
    # The head while they run, Eq. (3c); a mean over a tick in which they stop would be too low.
    head = q.pipe_resistance * (flow * flow) + q.d - state.cistern / q.a1
    sums[ENERGY_J] += q.weight * flows.pump * head * q.tau
    sums[PUMP_TICKS] += share
    if share > 0 and sums[_RUNNING] == 0:
        # The last starts, of which those within an hour count.
        first, count, kept = int(sums[_FIRST_START]), int(sums[STARTS]), int(q.start_places)
        now = sums[TICKS]
        sums[_STARTS + count % kept] = now
        sums[STARTS] = count + 1
        while sums[_STARTS + first % kept] < now - HOUR_S / q.tau + 0.5:
            first += 1
        sums[_FIRST_START] = first
        busy = count + 1 - first
        sums[BUSIEST_HOUR] = max(sums[BUSIEST_HOUR], busy)
        if busy > q.starts_per_hour:
            sums[EXCESS_STARTS] += 1
    sums[_RUNNING] = 1.0 if share > 0 else 0.0


def running_share(
    q: SumParameters, state: State, command: float, rain: float, flows: Flows
) -> float:
    """Return the share of a tick during which the pumps run (1).

    The pumps count as running if their flow exceeds 1 % of their maximum flow or of the commanded
    flow. In a tick that is not short, the pumps can stop at the target or at the suction level;
    their flow is then a mean over the tick, and the share is the ratio of this mean to the
    commanded flow.
    """
    head = state.cistern / q.a1 + q.c_hat - q.d
    commanded = command * q.b * math.sqrt(max(head, 0.0))
    if flows.pump <= q.running_flow and not (
        commanded > 0 and flows.pump > q.min_share * commanded
    ):
        return 0.0
    if q.has_short_ticks or commanded <= 0:
        return 1.0
    filled = state.roof + q.tau * (commanded + rain * q.a2) >= q.target
    # Both outlets together take no more than what is there.
    empty = state.cistern - q.tau * (commanded + flows.outflow) <= q.suction
    return min(flows.pump / commanded, 1.0) if filled or empty else 1.0


def end_interval(q: SumParameters, sums: Any, events: Any) -> None:
    """End an interval: keep its sums, and compare the peaks."""
    sums[_IN_INTERVAL] = 0.0
    sums[_INTERVAL] += 1
    now = int(sums[_INTERVAL])
    before, place = (now - 1) % _RING, now % _RING
    sums[_FLOW + place] = sums[DISCHARGE]
    if sums[_FLOW + before] != sums[DISCHARGE]:
        sums[PEAK_5] = max(sums[PEAK_5], _window(sums, _FLOW, now, q.windows_5)[0])
    if sums[_FLOW + (now - int(q.windows_60) - 1) % _RING] != sums[DISCHARGE]:
        sums[PEAK_15] = max(sums[PEAK_15], _window(sums, _FLOW, now, q.windows_15)[0])
        sums[PEAK_60] = max(sums[PEAK_60], _window(sums, _FLOW, now, q.windows_60)[0])
    if sums[_EVENT_OPEN] == 0:
        return
    sums[_WET + place], sums[_FALLEN + place] = sums[WET_DISCHARGE], sums[RAIN]
    _compare(sums, _EVENT_MAX_5, _EVENT_AT_5, _FALLEN, now, q.windows_5)
    _compare(sums, _EVENT_MAX_60, _EVENT_AT_60, _FALLEN, now, q.windows_60)
    _compare(sums, _EVENT_PEAK, _EVENT_PEAK_AT, _WET, now, q.windows_5)
    if now - 1 - sums[_EVENT_END] >= q.separation:
        end_event(q, sums, events, True)


def _compare(sums: Any, maximum: int, at: int, ring: int, now: int, width: float) -> None:
    """Keep the maximum of a window that ends now, and the start of the first such window."""
    volume, start = _window(sums, ring, now, width)
    if volume > sums[maximum] * _FIRST:
        sums[maximum], sums[at] = volume, start


def _window(sums: Any, ring: int, now: int, width: float) -> tuple[float, float]:
    """Return the largest sum in a window of some intervals that ends in the last one.

    The mean of constant pieces is largest where the window begins or ends with one of them.

    Args:
        sums: sums of the run.
        ring: first place of a buffer with the sums at the ends of intervals.
        now: number of intervals so far.
        width: width of the window (intervals).

    Returns:
        The sum, and the start of its window (intervals since the start of the run).
    """
    whole, last = int(width), sums[ring + now % _RING]
    part = width - whole
    first = sums[ring + (now - whole) % _RING]
    if part == 0:
        return last - first, float(now - whole)
    earlier = sums[ring + (now - whole - 1) % _RING]
    before = sums[ring + (now - 1) % _RING]
    ends = last - first + part * (first - earlier)
    begins = before - earlier + part * (last - before)
    if begins > ends * _FIRST:
        return begins, float(now - 1 - whole)
    return ends, now - width


def _begin_event(sums: Any) -> None:
    """Begin an event with the first rain, in an interval that is not over."""
    sums[_EVENT_OPEN] = 1.0
    sums[_EVENT_BEGIN] = sums[_INTERVAL]
    sums[_EVENT_DISCHARGE], sums[_EVENT_WET] = sums[DISCHARGE], sums[WET_DISCHARGE]
    for place in range(_RING):
        sums[_WET + place], sums[_FALLEN + place] = sums[WET_DISCHARGE], sums[_RAINED]
    for place in range(_EVENT_MAX_5, _EVENT_PEAK_AT + 1):
        sums[place] = 0.0


def end_event(q: SumParameters, sums: Any, events: Any, separated: bool) -> None:
    """End the open event, and write it into the table unless it is a trace below 0.1 mm.

    Args:
        q: numbers of the site.
        sums: sums of the run.
        events: table of the events.
        separated: whether the dry period after the event is over.
    """
    sums[_EVENT_OPEN] = 0.0
    rain = sums[RAIN] - sums[_RAINED]
    gap = sums[_EVENT_BEGIN] - sums[_LAST_RAIN]
    sums[_LAST_RAIN], sums[_RAINED] = sums[_EVENT_END] + 1, sums[RAIN]
    if rain < MIN_DEPTH * (1 - 1e-9):
        return
    number = int(sums[EVENTS])
    sums[EVENTS] = number + 1
    if number >= len(events):
        return
    wet = sums[WET_DISCHARGE] - sums[_EVENT_WET]
    events[number, BEGIN], events[number, END] = sums[_EVENT_BEGIN], sums[_EVENT_END] + 1
    events[number, DEPTH] = rain
    events[number, MAX_5], events[number, MAX_60] = sums[_EVENT_MAX_5], sums[_EVENT_MAX_60]
    events[number, VOLUME] = sums[DISCHARGE] - sums[_EVENT_DISCHARGE]
    events[number, WET_VOLUME], events[number, PEAK] = wet, sums[_EVENT_PEAK]
    events[number, DELAY] = math.nan
    if wet > _NOTHING:
        events[number, DELAY] = sums[_EVENT_PEAK_AT] - sums[_EVENT_AT_5]
    events[number, COMPLETE] = 1.0 if separated and gap >= q.separation else 0.0


def _end_day(q: SumParameters, sums: Any) -> None:
    if sums[_DAY_OVERFLOW] >= q.overflow_of_day:
        sums[OVERFLOW_DAYS] += 1
    sums[_DAY_OVERFLOW] = 0.0


def _end_hours(q: SumParameters, sums: Any, time: float) -> None:
    """End the hours that are over at a time (s since the start of the run)."""
    while time >= (sums[_HOUR] + 1) * HOUR_S:
        end_hour(q, sums)
        sums[_HOUR] += 1
        if sums[_HOUR] % _WEEK_H == 0:
            sums[_WEEK] += 1


def end_hour(q: SumParameters, sums: Any) -> None:
    """End an hour, and count the rain that the roof retained in it.

    The drainage of an hour is attributed to rain and pumped water in proportion to their amounts in
    the six hours that end with this hour. Rain and its share of the drainage are counted in every
    hour; in hours with much rain; and in every hour of a period of 24 hours with much rain.
    """
    hour = int(sums[_HOUR])
    place = _HOURS + 4 * (hour % _DAY_H)
    rain = (sums[RAIN] - sums[_HOUR_RAIN]) * q.a2
    sums[place], sums[place + 1] = rain, sums[PUMPED] - sums[_HOUR_PUMPED]
    drained = sums[DRAINED] - sums[_HOUR_DRAINED]
    sums[_HOUR_RAIN], sums[_HOUR_PUMPED] = sums[RAIN], sums[PUMPED]
    sums[_HOUR_DRAINED] = sums[DRAINED]
    sums[place + 2] = sums[place + 3] = 0.0
    fallen = came = of_day = 0.0
    for before in range(_DAY_H):
        earlier = _HOURS + 4 * ((hour - before) % _DAY_H)
        of_day += sums[earlier]
        if before < _DRAINS_H:
            fallen += sums[earlier]
            came += sums[earlier] + sums[earlier + 1]
    if fallen > 0:
        lost = fallen / came * drained
        sums[place + 2] = lost
        sums[LOST] += lost
        if rain / q.a2 * 1000 > _STORM_HOUR_MM + _ROUNDING_MM:
            sums[HOUR_RAIN] += rain
            sums[HOUR_LOST] += lost
    if of_day / q.a2 * 1000 > _STORM_DAY_MM + _ROUNDING_MM:
        for before in range(_DAY_H):
            earlier = _HOURS + 4 * ((hour - before) % _DAY_H)
            if sums[earlier + 3] == 0:
                sums[earlier + 3] = 1.0
                sums[DAY_RAIN] += sums[earlier]
                sums[DAY_LOST] += sums[earlier + 2]


def finish(q: SumParameters, sums: Any, weeks: Any, events: Any, state: State) -> None:
    """End the interval, the event, the hour and the day that are open at the end of a run.

    Args:
        q: numbers of the site.
        sums: sums of the run.
        weeks: deviation in each week (m3), to which that of the final state is added, as in the
            paper's sum over N + 1 states.
        events: table of the events.
        state: state after the last tick.
    """
    deviation = abs(state.roof - q.x2_star)
    sums[DEVIATION] += deviation
    weeks[int(sums[_WEEK])] += deviation
    sums[CISTERN], sums[ROOF], sums[LAYER] = state.cistern, state.roof, state.layer
    if sums[TICKS] == 0:
        sums[FIRST_CISTERN] = state.cistern
    if sums[_IN_INTERVAL] > 0:
        end_interval(q, sums, events)
    if sums[_EVENT_OPEN] > 0:
        end_event(q, sums, events, False)
    end_hour(q, sums)
    _end_day(q, sums)
