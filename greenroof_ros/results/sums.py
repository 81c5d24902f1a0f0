"""The running sums of a run, to which each tick is added: the basis of all metrics.

The same text adds the ticks of a simulation, a graph, a bag, a study or a district, plain or
compiled. All sums are sequential Euler sums: a value holds from its tick to the next one. Flows
before and after a run are unknown, and are assumed to be 0.

The sums of a run are one array of numbers, whose places have names here. After them come buffers of
the last 64 intervals (of a minute, rounded up to a whole number of ticks), of the last 24 hours,
and of the pump starts in the last hour, and the deviation of each week. Rain events are rows of a
table of their own.

**Peaks** are maxima of a moving mean, whose window may begin at any time within the run. Fixed
intervals of five minutes would underestimate the peak of a storm by an eighth on average (Weiss
1964, Ratio of true to fixed-interval maximum rainfall, Journal of the Hydraulics Division 90(1),
77-82: 1.14). Within an interval, rain and discharge are assumed to be constant.
"""

from __future__ import annotations

import math
from typing import Any

from greenroof_ros.physics.cistern import MIN_RUN_S
from greenroof_ros.physics.parameters import Flows, PlantParameters, State
from greenroof_ros.physics.pump import RUNNING_SHARE, running_flow
from greenroof_ros.physics.storm_water import HOUR_S, MIN_DEPTH, ROUNDING

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

# Places of the sums. Volumes are in m3, depths in m, times of events in intervals.
(
    TICKS, DEVIATION, NEAR, STRESSED, RAIN, EVAPORATED, POTENTIAL, DRAINED, PUMPED, MAINS, OUTFLOW,
    OVERFLOW, DISCHARGE, WET_DISCHARGE, MAX_COMMAND, BEYOND, LIMITED, PUMP_TICKS, STARTS,
    BUSIEST_HOUR, EXCESS_STARTS, ENERGY_J, OVERFLOW_DAYS, PEAK_5, PEAK_15, PEAK_60, LOST, HOUR_RAIN,
    HOUR_LOST, DAY_RAIN, DAY_LOST, EVENTS, FIRST_CISTERN, CISTERN, ROOF, LAYER, _HOUR,
    _WEEK_DEVIATION, _DAY_OVERFLOW, _RUNNING, _FIRST_START, _HOUR_RAIN, _HOUR_PUMPED,
    _HOUR_DRAINED, _EVENT_OPEN, _EVENT_BEGIN, _EVENT_END, _EVENT_GAP, _EVENT_DISCHARGE, _EVENT_WET,
    _EVENT_RAIN, _EVENT_MAX_5, _EVENT_AT_5, _EVENT_PEAK, _EVENT_PEAK_AT, _EVENT_MAX_60,
    _EVENT_AT_60, _COUNTED, _PLACES,
) = range(59)
# Buffers: sums of discharge, of discharge in wet weather and of rain at the ends of the last
# intervals; rain, pumped water and drainage of rain in the last hours (m3).
_RING = 64
_FLOW, _WET, _FALLEN = _PLACES, _PLACES + _RING, _PLACES + 2 * _RING
_HOURS = _PLACES + 3 * _RING
_STARTS = _HOURS + 3 * _DAY_H
# Windows of an event: places of the maximum and its start, of the buffer and of the sum before the
# event, and the width (min).
_WINDOWS = (
    (_EVENT_MAX_5, _EVENT_AT_5, _FALLEN, _EVENT_RAIN, 5),
    (_EVENT_PEAK, _EVENT_PEAK_AT, _WET, _EVENT_WET, 5),
    (_EVENT_MAX_60, _EVENT_AT_60, _FALLEN, _EVENT_RAIN, 60),
)


def _find_weeks(p: PlantParameters) -> int:
    """Return the first place of the weeks: pumps can start in every other tick of an hour."""
    return _STARTS + math.ceil(HOUR_S / 2 / p.tau) + 1


def count_places(p: PlantParameters, ticks: int) -> int:
    """Return the number of places of a run's sums."""
    return _find_weeks(p) + max(1, int((ticks - 0.5) * p.tau // (_WEEK_H * HOUR_S)) + 1)


def count_events(p: PlantParameters, ticks: int) -> int:
    """Return the maximum number of events in a run."""
    return int(ticks / p.interval_ticks / (p.dry_intervals + 1)) + 2


def read_weeks(p: PlantParameters, sums: Any) -> list[float]:
    """Return the deviation in each week of a run (m3); the last week may be shorter.

    The sum of a season would conceal a bad fortnight. The last week includes the final state, so
    that the weeks add up to the total.
    """
    return [float(week) for week in sums[_find_weeks(p):]]


def add(
    p: PlantParameters, sums: Any, events: Any, state: State, command: float, rain: float,
    potential: float, flows: Flows, wet: bool, new_day: bool,
) -> None:
    """Add a tick.

    Args:
        p: parameters of the plant.
        sums: sums so far, at first zeros, shape (:func:`count_places`,).
        events: rain events, shape (n, fields of :class:`.Event`); those beyond n are only counted.
        state: state at the start of the tick.
        command: command of the controller (share of the maximum flow).
        rain: rain rate (m/s).
        potential: potential evapotranspiration (m3/s).
        flows: flows in the tick (m3/s).
        wet: whether the weather is wet in the tick.
        new_day: whether the tick is the first of a day of the site's clock.
    """
    tau, ticks, roof = p.tau, sums[TICKS], state.roof
    outflow, pump, drainage, evaporated, limited, mains, low_outlet = flows
    if ticks == 0:
        sums[FIRST_CISTERN] = state.cistern
    if (ticks + 0.5) * tau >= (sums[_HOUR] + 1) * HOUR_S:
        _end_hour(p, sums)
    if new_day:
        _end_day(p, sums)
    sums[TICKS] = ticks + 1
    deviation = abs(roof - p.x2_star)
    sums[DEVIATION] += deviation
    sums[_WEEK_DEVIATION] += deviation
    if deviation <= NEAR_TARGET * p.x2_star:
        sums[NEAR] += 1
    if roof < p.stress_volume or roof <= 0:
        sums[STRESSED] += 1
    sums[EVAPORATED] += tau * evaporated
    sums[POTENTIAL] += tau * potential
    if rain > 0:
        if sums[_EVENT_OPEN] == 0:
            _begin_event(sums, ticks // p.interval_ticks)
        sums[RAIN] += tau * rain
        sums[_EVENT_END] = ticks // p.interval_ticks + 1
    discharge = (1 - p.drainage_to_cistern) * drainage
    if drainage > 0:
        sums[DRAINED] += tau * drainage
    if outflow > 0:
        discharge += outflow
        over = tau * (outflow - low_outlet)
        sums[OUTFLOW] += tau * outflow
        sums[OVERFLOW] += over
        sums[_DAY_OVERFLOW] += over
    if discharge > 0:
        sums[DISCHARGE] += tau * discharge
        if wet:
            sums[WET_DISCHARGE] += tau * discharge
    if mains > 0:
        sums[MAINS] += tau * mains
    if limited:
        sums[LIMITED] += 1
    if command > sums[MAX_COMMAND]:
        sums[MAX_COMMAND] = command
    if command > 1:
        sums[BEYOND] += 1
    if pump > 0:
        _add_pump(p, sums, state, command, rain, flows)
    else:
        sums[_RUNNING] = 0.0
    if (ticks + 1) % p.interval_ticks == 0:
        _end_interval(p, sums, events)


def _add_pump(
    p: PlantParameters, sums: Any, state: State, command: float, rain: float, flows: Flows
) -> None:
    """Add the pumps in a tick with a flow; see :func:`_running_share`."""
    sums[PUMPED] += p.tau * flows.pump
    share = _running_share(p, state, command, rain, flows)
    flow = flows.pump / share if share > 0 else flows.pump
    # The head while they run, Eq. (3c); a mean over a tick in which they stop would be too low.
    head = p.pipe_resistance * (flow * flow) + p.d - state.cistern / p.a1
    sums[ENERGY_J] += _WATER_DENSITY * p.g * flows.pump * head * p.tau
    sums[PUMP_TICKS] += share
    if share > 0 and sums[_RUNNING] == 0:
        # The last starts, of which those within an hour count.
        first, count, kept = int(sums[_FIRST_START]), int(sums[STARTS]), _find_weeks(p) - _STARTS
        now = sums[TICKS]
        sums[_STARTS + count % kept] = now
        sums[STARTS] = count + 1
        while sums[_STARTS + first % kept] < now - HOUR_S / p.tau + 0.5:
            first += 1
        sums[_FIRST_START] = first
        busy = count + 1 - first
        sums[BUSIEST_HOUR] = max(sums[BUSIEST_HOUR], busy)
        if busy > p.starts_per_hour:
            sums[EXCESS_STARTS] += 1
    sums[_RUNNING] = 1.0 if share > 0 else 0.0


def _running_share(
    p: PlantParameters, state: State, command: float, rain: float, flows: Flows
) -> float:
    """Return the share of a tick during which the pumps run (1).

    The pumps count as running if their flow exceeds 1 % of their maximum flow or of the commanded
    flow. In a tick that is not short, the pumps can stop at the target or at the suction level;
    their flow is then a mean over the tick, and the share is the ratio of this mean to the
    commanded flow.
    """
    head = state.cistern / p.a1 + p.c_hat - p.d
    commanded = command * p.b * math.sqrt(max(head, 0.0))
    # In a long tick they can run for less than 1 % of it.
    least = min(RUNNING_SHARE, MIN_RUN_S / p.tau / 2) * commanded
    if flows.pump <= running_flow(p) and not (commanded > 0 and flows.pump > least):
        return 0.0
    if p.has_short_ticks or commanded <= 0:
        return 1.0
    filled = state.roof + p.tau * (commanded + rain * p.a2) >= p.a2 * p.z_veg
    # Both outlets together take no more than what is there.
    usable = state.cistern - p.tau * (commanded + flows.outflow)
    return min(flows.pump / commanded, 1.0) if filled or usable <= p.a1 * p.suction_level else 1.0


def _end_interval(p: PlantParameters, sums: Any, events: Any) -> None:
    """End an interval: keep its sums, and compare the peaks."""
    now = math.ceil(sums[TICKS] / p.interval_ticks)
    place, oldest = now % _RING, (now + 1) % _RING
    sums[_FLOW + place], sums[_FALLEN + place] = sums[DISCHARGE], sums[RAIN]
    sums[_WET + place] = sums[WET_DISCHARGE]
    # The shortest window has the smallest peak, and none contains more than the buffer.
    if sums[DISCHARGE] - sums[_FLOW + oldest] > sums[PEAK_5] * ROUNDING:
        for number, minutes in enumerate(PEAKS_MIN):
            volume, _ = _find_maximum(p, sums, _FLOW, 0.0, now, minutes)
            sums[PEAK_5 + number] = max(sums[PEAK_5 + number], volume)
    if sums[_EVENT_OPEN] == 0:
        return
    for maximum, at, ring, before, minutes in _WINDOWS:
        volume, start = _find_maximum(p, sums, ring, sums[before], now, minutes)
        if volume > sums[maximum] * _FIRST:
            sums[maximum], sums[at] = volume, start
    if now - sums[_EVENT_END] >= p.dry_intervals:
        _end_event(p, sums, events, True)


def _find_maximum(
    p: PlantParameters, sums: Any, ring: int, before: float, now: int, minutes: int
) -> tuple[float, float]:
    """Return the largest sum in a window that ends in the last interval.

    The mean of constant pieces is largest where the window begins or ends with one of them.

    Args:
        p: parameters of the plant.
        sums: sums of the run.
        ring: first place of a buffer with the sums at the ends of intervals.
        before: sum before an event, of which nothing counts.
        now: number of intervals so far.
        minutes: width of the window (min).

    Returns:
        The sum, and the start of its window (intervals since the start of the run).
    """
    width = 60.0 * minutes / (p.tau * p.interval_ticks)
    whole, last = int(width), sums[ring + now % _RING]
    part, first = width - whole, max(before, sums[ring + (now - whole) % _RING])
    if part == 0:
        return last - first, now - width
    earlier = max(before, sums[ring + (now - whole - 1) % _RING])
    previous = max(before, sums[ring + (now - 1) % _RING])
    ends = last - first + part * (first - earlier)
    begins = previous - earlier + part * (last - previous)
    if begins > ends * _FIRST:
        return begins, float(now - 1 - whole)
    return ends, now - width


def _begin_event(sums: Any, interval: float) -> None:
    """Begin an event before the first rain is added, in an interval that is not over."""
    sums[_EVENT_OPEN], sums[_EVENT_BEGIN] = 1.0, interval
    sums[_EVENT_GAP] = interval - sums[_EVENT_END]
    sums[_EVENT_DISCHARGE], sums[_EVENT_WET] = sums[DISCHARGE], sums[WET_DISCHARGE]
    sums[_EVENT_RAIN] = sums[RAIN]
    for place in range(_EVENT_MAX_5, _EVENT_AT_60 + 1):
        sums[place] = 0.0


def _end_event(p: PlantParameters, sums: Any, events: Any, separated: bool) -> None:
    """End the open event, and write it into the table unless it is a trace below 0.1 mm.

    Args:
        p: parameters of the plant.
        sums: sums of the run.
        events: table of the events.
        separated: whether the dry period after the event is over.
    """
    sums[_EVENT_OPEN] = 0.0
    rain, number = sums[RAIN] - sums[_EVENT_RAIN], int(sums[EVENTS])
    if rain < MIN_DEPTH * (1 - 1e-9):
        return
    sums[EVENTS] = number + 1
    if number >= len(events):
        return
    area, seconds = p.effective_catchment + p.a2, p.tau * p.interval_ticks
    begin, end, wet = sums[_EVENT_BEGIN], sums[_EVENT_END], sums[WET_DISCHARGE] - sums[_EVENT_WET]
    heaviest, peak = sums[_EVENT_MAX_5] / 300, sums[_EVENT_PEAK] / 300
    delay = sums[_EVENT_PEAK_AT] - sums[_EVENT_AT_5]
    events[number] = (
        begin * seconds / HOUR_S, (end - begin) * seconds / HOUR_S, 1000 * rain,
        1000 * HOUR_S * heaviest, 1000 * sums[_EVENT_MAX_60],
        sums[DISCHARGE] - sums[_EVENT_DISCHARGE], wet, 1000 * peak, 1000 * HOUR_S * peak / area,
        1 - wet / (rain * area), 1 - peak / (heaviest * area),
        delay * seconds / 60 if wet > _NOTHING else math.nan,
        1.0 if separated and sums[_EVENT_GAP] >= p.dry_intervals else 0.0,
    )


def _end_day(p: PlantParameters, sums: Any) -> None:
    if sums[_DAY_OVERFLOW] >= MIN_DEPTH * (p.effective_catchment + p.a2):
        sums[OVERFLOW_DAYS] += 1
    sums[_DAY_OVERFLOW] = 0.0


def _end_hour(p: PlantParameters, sums: Any) -> None:
    """End an hour, and count the rain that the roof retained in it; a week may end with it.

    The drainage of an hour is attributed to rain and pumped water in proportion to their amounts in
    the six hours that end with this hour. Rain and its share of the drainage are counted in every
    hour; in hours with much rain; and in every hour of a period of 24 hours with much rain.
    """
    hour = int(sums[_HOUR])
    place, drained = _HOURS + 3 * (hour % _DAY_H), sums[DRAINED] - sums[_HOUR_DRAINED]
    rain, pumped = (sums[RAIN] - sums[_HOUR_RAIN]) * p.a2, sums[PUMPED] - sums[_HOUR_PUMPED]
    sums[place], sums[place + 1], sums[_HOUR_DRAINED] = rain, pumped, sums[DRAINED]
    sums[_HOUR_RAIN], sums[_HOUR_PUMPED] = sums[RAIN], sums[PUMPED]
    fallen = came = of_day = 0.0
    for before in range(_DAY_H):
        earlier = _HOURS + 3 * ((hour - before) % _DAY_H)
        of_day += sums[earlier]
        if before < _DRAINS_H:
            fallen += sums[earlier]
            came += sums[earlier] + sums[earlier + 1]
    lost = fallen / came * drained if fallen > 0 else 0.0
    sums[place + 2] = lost
    sums[LOST] += lost
    if rain / p.a2 * 1000 > _STORM_HOUR_MM + _ROUNDING_MM:
        sums[HOUR_RAIN] += rain
        sums[HOUR_LOST] += lost
    if of_day / p.a2 * 1000 > _STORM_DAY_MM + _ROUNDING_MM:
        for before in range(min(_DAY_H, hour + 1 - int(sums[_COUNTED]))):
            earlier = _HOURS + 3 * ((hour - before) % _DAY_H)
            sums[DAY_RAIN] += sums[earlier]
            sums[DAY_LOST] += sums[earlier + 2]
        sums[_COUNTED] = hour + 1
    sums[_HOUR] += 1
    sums[_find_weeks(p) + hour // _WEEK_H] = sums[_WEEK_DEVIATION]
    if sums[_HOUR] % _WEEK_H == 0:
        sums[_WEEK_DEVIATION] = 0.0


def finish(p: PlantParameters, sums: Any, events: Any, state: State) -> None:
    """End the interval, the event, the hour and the day that are open at the end of a run.

    Args:
        p: parameters of the plant.
        sums: sums of the run.
        events: table of the events.
        state: state after the last tick, which counts in the deviation, as in the paper's sum over
            N + 1 states.
    """
    deviation = abs(state.roof - p.x2_star)
    sums[DEVIATION] += deviation
    sums[_WEEK_DEVIATION] += deviation
    sums[CISTERN], sums[ROOF], sums[LAYER] = state.cistern, state.roof, state.layer
    if sums[TICKS] == 0:
        sums[FIRST_CISTERN] = state.cistern
    if sums[TICKS] % p.interval_ticks > 0:
        _end_interval(p, sums, events)
    if sums[_EVENT_OPEN] > 0:
        _end_event(p, sums, events, False)
    _end_hour(p, sums)
    _end_day(p, sums)
