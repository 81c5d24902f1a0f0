"""The running sums of a run, to which each tick is added: the basis of all metrics.

The same text adds the ticks of a simulation, a graph, a bag, a study or a district, plain or
compiled. All sums are sequential Euler sums: a value holds from its tick to the next one. Flows
before and after a run are unknown, and are assumed to be 0.

The sums of a run are one array of numbers, whose places have names here. After them come buffers of
the last 64 intervals (of a minute, rounded up to a whole number of ticks) and of the last pump
starts. Rain events are rows of a table of their own.

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

_WATER_DENSITY = 1000.0  # kg/m3
# More than the rounding errors of an interval's sums (m3), but no water that matters.
_NOTHING = 1e-9
_FIRST = 1 + 1e-9  # of equal peaks, the first one counts

# Places of the sums. Volumes are in m3, depths in m, times of events in intervals.
(
    TICKS, DEVIATION, NEAR, STRESSED, RAIN, WET_DISCHARGE, DISCHARGE, EVAPORATED, POTENTIAL,
    DRAINED, PUMPED, MAINS, OUTFLOW, OVERFLOW, MAX_COMMAND, BEYOND, LIMITED, PUMP_TICKS, STARTS,
    BUSIEST_HOUR, EXCESS_STARTS, ENERGY_J, OVERFLOW_DAYS, PEAK_5, PEAK_15, PEAK_60, EVENTS,
    FIRST_CISTERN, CISTERN, ROOF, LAYER, INTERVALS, _DAY_OVERFLOW, _RUNNING, _OPEN, _BEGIN, _END,
    _GAP, _RAIN_BEFORE, _WET_BEFORE, _DISCHARGE_BEFORE, _MAX_5, _AT_5, _PEAK, _PEAK_AT, _MAX_60,
    _AT_60, _OLDEST, OTHER, OTHER_MAINS, _PLACES,
) = range(51)
# Buffers: rain, discharge in wet weather and discharge since the start, at the ends of the last
# intervals; ticks of the last pump starts.
_RING, _SUMS = 64, 3
_LAST_STARTS = _PLACES + _SUMS * _RING
# Windows of an event: places of the maximum, which precedes the window's start, and of the sum, and
# the width (min).
_WINDOWS = ((_MAX_5, RAIN, 5), (_PEAK, WET_DISCHARGE, 5), (_MAX_60, RAIN, 60))


def _count_starts(p: PlantParameters) -> int:
    """Return the number of pump starts that are kept: one in every other tick of an hour."""
    return math.ceil(HOUR_S / 2 / p.tau) + 1


def count_places(p: PlantParameters) -> int:
    """Return the number of places of a run's sums."""
    return _LAST_STARTS + _count_starts(p)


def count_events(p: PlantParameters, ticks: int) -> int:
    """Return the maximum number of events in a run."""
    return int(ticks / p.interval_ticks / (p.dry_intervals + 1)) + 2


def is_stressed(p: PlantParameters, roof: float) -> bool:
    """Return whether the plants lack water with a volume on the roof (m3)."""
    return roof < p.stress_volume or roof <= 0


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
    outflow, pump, drainage, evaporated, limited, mains, low_outlet, other, other_demand = flows
    if ticks == 0:
        sums[FIRST_CISTERN] = state.cistern
    if new_day:
        sums[_DAY_OVERFLOW] = 0.0
    sums[TICKS] = ticks + 1
    deviation = abs(roof - p.x2_star)
    sums[DEVIATION] += deviation
    sums[NEAR] += deviation <= NEAR_TARGET * p.x2_star
    sums[STRESSED] += is_stressed(p, roof)
    sums[EVAPORATED] += tau * evaporated
    sums[POTENTIAL] += tau * potential
    if rain > 0:
        if sums[_OPEN] == 0:
            _begin_event(sums)
        sums[RAIN] += tau * rain
        sums[_END] = sums[INTERVALS] + 1
    discharge = (1 - p.drainage_to_cistern) * drainage
    if drainage > 0:
        sums[DRAINED] += tau * drainage
    if outflow > 0:
        discharge += outflow
        over = tau * (outflow - low_outlet)
        sums[OUTFLOW] += tau * outflow
        sums[OVERFLOW] += over
        # A day counts from the tick in which its overflow reaches the minimum.
        before, least = sums[_DAY_OVERFLOW], MIN_DEPTH * (p.effective_catchment + p.a2)
        sums[_DAY_OVERFLOW] += over
        sums[OVERFLOW_DAYS] += before < least <= sums[_DAY_OVERFLOW]
    if discharge > 0:
        sums[DISCHARGE] += tau * discharge
        if wet:
            sums[WET_DISCHARGE] += tau * discharge
    if mains > 0:
        sums[MAINS] += tau * mains
    if other_demand > 0:
        sums[OTHER] += tau * other
        sums[OTHER_MAINS] += tau * (other_demand - other)
    sums[LIMITED] += limited
    sums[MAX_COMMAND] = max(sums[MAX_COMMAND], command)
    sums[BEYOND] += command > 1
    if pump > 0:
        _add_pump(p, sums, state, command, rain, flows)
    else:
        sums[_RUNNING] = 0.0
    if ticks + 1 == (sums[INTERVALS] + 1) * p.interval_ticks:
        _end_interval(p, sums, events)


def _add_pump(
    p: PlantParameters, sums: Any, state: State, command: float, rain: float, flows: Flows
) -> None:
    """Add the pumps in a tick with a flow; see :func:`_running_share`."""
    sums[PUMPED] += p.tau * flows.pump
    share = _running_share(p, state, command, rain, flows)
    flow = flows.pump / share if share > 0 else flows.pump
    # The head while they run, Eq. (3c); a mean over a tick in which they stop would be too low.
    head = max(0.0, p.pipe_resistance * (flow * flow) + p.d - state.cistern / p.a1)
    sums[ENERGY_J] += _WATER_DENSITY * p.g * flows.pump * head * p.tau
    sums[PUMP_TICKS] += share
    if share > 0 and sums[_RUNNING] == 0:
        count, oldest = int(sums[STARTS]), int(sums[_OLDEST])
        kept, now = _count_starts(p), sums[TICKS]
        while oldest < count and now - sums[_LAST_STARTS + oldest % kept] > HOUR_S / p.tau - 0.5:
            oldest += 1
        sums[_LAST_STARTS + count % kept] = now
        sums[STARTS], sums[_OLDEST], busy = count + 1, oldest, count + 1 - oldest
        sums[BUSIEST_HOUR] = max(sums[BUSIEST_HOUR], busy)
        sums[EXCESS_STARTS] += busy > p.starts_per_hour
    sums[_RUNNING] = share


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


def _find_ring(place: int) -> int:
    """Return the first place of the buffer of a sum: rain, or discharge of either kind."""
    return _PLACES + _RING * (place - RAIN)


def _end_interval(p: PlantParameters, sums: Any, events: Any) -> None:
    """End an interval: keep its sums, and compare the peaks."""
    sums[INTERVALS] += 1
    now = int(sums[INTERVALS])
    for place in range(RAIN, RAIN + _SUMS):
        sums[_find_ring(place) + now % _RING] = sums[place]
    # The shortest window has the smallest peak, and none contains more than the buffer.
    oldest = sums[_find_ring(DISCHARGE) + (now + 1) % _RING]
    if sums[DISCHARGE] - oldest > sums[PEAK_5] * ROUNDING:
        for number, minutes in enumerate(PEAKS_MIN):
            volume, _ = _find_maximum(p, sums, DISCHARGE, 0.0, now, minutes)
            sums[PEAK_5 + number] = max(sums[PEAK_5 + number], volume)
    if sums[_OPEN] == 0:
        return
    for maximum, place, minutes in _WINDOWS:
        before = sums[_RAIN_BEFORE + place - RAIN]
        # No window contains more than the buffer.
        if sums[place] - max(before, sums[_find_ring(place) + (now + 1) % _RING]) > sums[maximum]:
            volume, start = _find_maximum(p, sums, place, before, now, minutes)
            if volume > sums[maximum] * _FIRST:
                sums[maximum], sums[maximum + 1] = volume, start
    if now - sums[_END] >= p.dry_intervals:
        _end_event(p, sums, events)


def _find_maximum(
    p: PlantParameters, sums: Any, place: int, before: float, now: int, minutes: int
) -> tuple[float, float]:
    """Return the largest volume in a window that ends in the last interval.

    The mean of constant pieces is largest where the window begins or ends with one of them.

    Args:
        p: parameters of the plant.
        sums: sums of the run.
        place: place of the sum, see :func:`_find_ring`.
        before: sum before an event, of which nothing counts.
        now: number of intervals so far.
        minutes: width of the window (min).

    Returns:
        The volume, and the start of its window (intervals since the start of the run).
    """
    width, ring = 60.0 * minutes / (p.tau * p.interval_ticks), _find_ring(place)
    whole, last = int(width), sums[place]
    part, first = width - whole, max(before, sums[ring + (now - whole) % _RING])
    earlier = max(before, sums[ring + (now - whole - 1) % _RING])
    previous = max(before, sums[ring + (now - 1) % _RING])
    ends = last - first + part * (first - earlier)
    begins = previous - earlier + part * (last - previous)
    if begins > ends * _FIRST:
        return begins, float(now - 1 - whole)
    return ends, now - width


def _begin_event(sums: Any) -> None:
    """Begin an event before the first rain is added, in an interval that is not over."""
    now = sums[INTERVALS]
    sums[_OPEN], sums[_BEGIN], sums[_GAP] = 1.0, now, now - sums[_END]
    for number in range(_SUMS):
        sums[_RAIN_BEFORE + number] = sums[RAIN + number]
    for place in range(_MAX_5, _AT_60 + 1):
        sums[place] = 0.0


def _end_event(p: PlantParameters, sums: Any, events: Any) -> None:
    """End the open event, and write it into the table unless it is a trace below 0.1 mm."""
    sums[_OPEN] = 0.0
    rain, number = sums[RAIN] - sums[_RAIN_BEFORE], int(sums[EVENTS])
    if rain < MIN_DEPTH * (1 - 1e-9):
        return
    sums[EVENTS] = number + 1
    if number >= len(events):
        return
    area, seconds = p.effective_catchment + p.a2, p.tau * p.interval_ticks
    begin, end, wet = sums[_BEGIN], sums[_END], sums[WET_DISCHARGE] - sums[_WET_BEFORE]
    heaviest, peak = sums[_MAX_5] / 300, sums[_PEAK] / 300
    delay = sums[_PEAK_AT] - sums[_AT_5]
    dry = min(sums[_GAP], sums[INTERVALS] - end)
    events[number] = (
        begin * seconds / HOUR_S, (end - begin) * seconds / HOUR_S, 1000 * rain,
        1000 * HOUR_S * heaviest, 1000 * sums[_MAX_60],
        sums[DISCHARGE] - sums[_DISCHARGE_BEFORE], wet, 1000 * peak, 1000 * HOUR_S * peak / area,
        1 - wet / (rain * area), 1 - peak / (heaviest * area),
        delay * seconds / 60 if wet > _NOTHING else math.nan,
        1.0 if dry >= p.dry_intervals else 0.0,
    )


def finish(p: PlantParameters, sums: Any, events: Any, state: State) -> None:
    """End the interval and the event that are open at the end of a run.

    Args:
        p: parameters of the plant.
        sums: sums of the run.
        events: table of the events.
        state: state after the last tick, which counts in the deviation, as in the paper's sum over
            N + 1 states.
    """
    sums[DEVIATION] += abs(state.roof - p.x2_star)
    sums[CISTERN], sums[ROOF], sums[LAYER] = state.cistern, state.roof, state.layer
    if sums[TICKS] > sums[INTERVALS] * p.interval_ticks:
        _end_interval(p, sums, events)
    if sums[_OPEN] > 0:
        _end_event(p, sums, events)
