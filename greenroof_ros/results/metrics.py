"""The metrics of a run, as used by all summaries, tables and reports.

A metric consists of two functions: the first returns a number for every sample of a run, and the
second combines these numbers into their sum or maximum, or selects the last one. Durations are
counted in ticks, and then converted to hours. A ratio is computed from two sums, and the share of
retained rain from hourly sums. The same functions process a run in progress, block by block
(:class:`BlockMetrics`), and a recorded run (:func:`totals_of`). All sums are sequential Euler sums:
a value holds from its sample to the next sample, and every summation starts from the previous
total. Therefore the sums are bit-identical, regardless of the blocks in which they were computed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import date, datetime
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.plant import (
    MIN_RUN_S,
    RUNNING_SHARE,
    Flows,
    Plant,
    has_short_ticks,
    head_loss,
    pumps_run,
)
from greenroof_ros.physics.soil import soil_of
from greenroof_ros.physics.storm_water import (
    MIN_DEPTH,
    Event,
    Intervals,
    connected_area,
    find_events,
    find_peak,
    find_wet_weather,
    interval_seconds,
)
from greenroof_ros.site.site import Site

_HOUR_S = 3600.0
_WEEK_S = 7 * 24 * _HOUR_S
_WATER_DENSITY = 1000.0  # kg/m3
_JOULES_PER_KWH = 3.6e6
_RUNS = f"above {RUNNING_SHARE:.0%} of the maximum flow or of the commanded flow"
# A roof drains water that came within this many hours; the same number of dry hours ends an event.
_DRAINS_H = 6
# Sums of rain are rounded: 20 mm must not be treated as more than 20 mm.
_ROUNDING_MM = 1e-6

NEAR_TARGET = 0.05
"""half width of the band around the roof's target in which a level is near the target (share of the
target)
"""

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """The samples of a part of a run; every array has shape (n,).

    The last sample of a run contains the final state; its flows and its command are 0. The last
    sample has the duration of a tick, so that it contributes to the deviation, as in the paper.

    Attributes:
        duration: time from every sample to the next sample (s).
        cistern: water volume x1 (m3).
        roof: water volume x2 (m3).
        command: command of the controller (1), which a pump driver may execute only in part.
        precipitation: rain rate (m/s).
        outflow: flow from the cistern to the sewer (m3/s).
        pump: flow from the cistern to the roof (m3/s).
        drainage: drainage from the roof (m3/s).
        evapotranspiration: evapotranspiration from the roof, limited to the available water (m3/s).
        layer: water volume in the drainage layer of a field-capacity soil (m3); 0 for other soils.
        potential: potential evapotranspiration (m3/s).
        time: start of every sample, relative to the start of the run (s).
        start: start of the run (s since 1970).
        mains: flow of mains water into the cistern (m3/s); 0 without a mains valve.
        low_outlet: part of the outflow that leaves through the low outlet (m3/s); None if unknown.
        limited: 1 if a tank contained less water than was demanded, otherwise 0; None if unknown.
        discharge_known: whether outflow and drainage were recorded.
        pumping_before: whether the pumps were running before the first sample.
        earlier_starts: times of pump starts in the hour before the first sample (s from that
            sample, negative).
    """

    duration: Values
    cistern: Values
    roof: Values
    command: Values
    precipitation: Values
    outflow: Values
    pump: Values
    drainage: Values
    evapotranspiration: Values
    layer: Values
    potential: Values
    time: Values
    mains: Values
    start: float = 0.0
    low_outlet: Values | None = None
    limited: Values | None = None
    discharge_known: bool = True
    pumping_before: bool = False
    earlier_starts: Values = field(default_factory=lambda: np.empty(0))


# --- how the numbers of the samples are combined -------------------------------------------------


def _sum(before: float, values: Values) -> float:
    # Not numpy's sum: its order of summation depends on the length of the block.
    return float(np.cumsum(np.append(before, values))[-1])


def _count(before: float, values: Values) -> float:
    return int(before) + int(np.count_nonzero(values))


def _maximum(before: float, values: Values) -> float:
    return max(before, float(values.max()))


def _last(before: float, values: Values) -> float:
    return float(values[-1])


def _sums(before: Values | float, values: Values) -> Values:
    first = np.broadcast_to(before, len(values))
    return np.asarray(np.cumsum(np.column_stack((first, values)), axis=1)[:, -1])


class _Sums(NamedTuple):
    """Sums by minute, hour, day or week; each row of the arrays contains one quantity."""

    earlier: tuple[Values, ...]
    """final sums, to which no later sample belongs, and which are not copied again"""
    first: int
    """index of the first sum in ``open``"""
    open: Values

    def whole(self) -> Values:
        """Return all sums, shape (m, n)."""
        return np.concatenate((*self.earlier, self.open), axis=1)


# Sums are set aside when there are this many.
_MANY = 4096


def _sums_by(before: _Sums | float, values: Values) -> _Sums:
    """Add up all rows except the first, which contains each sample's minute, hour, day or week."""
    places = values[0].astype(np.intp)
    if not isinstance(before, _Sums):
        before = _Sums((), 0, np.empty((len(values) - 1, 0)))
    earlier, first, known = before
    over = int(places[0]) - first
    if min(over, known.shape[1]) >= _MANY:
        over = min(over, known.shape[1])
        earlier, first, known = (*earlier, known[:, :over]), first + over, known[:, over:]
    sums = np.zeros((len(known), max(known.shape[1], int(places.max()) + 1 - first)))
    sums[:, : known.shape[1]] = known
    for row, amounts in zip(sums, values[1:], strict=True):
        np.add.at(row, places - first, amounts)  # sequentially, like _sum
    return _Sums(earlier, first, sums)


def _whole(total: Any) -> Any:
    """Return the combined number in the form that :attr:`Metric.finish` expects."""
    return total.whole() if isinstance(total, _Sums) else total


# --- the metric from the combined number ---------------------------------------------------------


def _as_it_is(site: Site, total: float) -> float:
    return total


def _hours(site: Site, ticks: float) -> float:
    return ticks * site.tau / 3600


def _ratio(site: Site, sums: Values) -> float | None:
    return float(sums[0] / sums[1]) if sums[1] else None


def _rolling(values: Values, hours: int) -> Values:
    """Return, for every value, the sum of this value and the ``hours`` - 1 values before it."""
    padded = np.concatenate((np.zeros(hours - 1), values))
    return np.asarray(sum(padded[k : k + len(values)] for k in range(hours)))


def _retained(site: Site, by_hour: Values, above: float = -1.0, hours: int = 1) -> float | None:
    """Return the share of the rain on the roof that did not drain in the same hours (1).

    The drainage of an hour is attributed to rain and pumped water in proportion to their amounts in
    the six hours that end with this hour. Rain and its share of the drainage are counted in every
    hour that belongs to a period of ``hours`` hours with more rain than ``above``.

    Args:
        site: site with the area of the roof.
        by_hour: rain on the roof, pumped water and drained water (m3), shape (3, n).
        above: depth of rain that a period must exceed to be counted (mm).
        hours: length of a period (h).

    Returns:
        The share, from 0 to 1; None if no such rain fell.
    """
    rain, pumped, drained = by_hour
    rained, watered = _rolling(rain, _DRAINS_H), _rolling(pumped, _DRAINS_H)
    of_rain = np.divide(rained, rained + watered, out=np.zeros_like(rained), where=rained > 0)
    storm = _rolling(rain, hours) / site.a2 * 1000 > above + _ROUNDING_MM
    within = _rolling(storm[::-1].astype(float), hours)[::-1] > 0
    fallen = _sum(0.0, rain[within])
    return 1 - min(1.0, _sum(0.0, (of_rain * drained)[within]) / fallen) if fallen else None


@dataclass(frozen=True)
class Metric:
    """A metric of a run.

    Attributes:
        name: key in ``summary.json``, and column in ``results.csv``.
        unit: unit in tables; 1 for a dimensionless number.
        label: name in tables.
        meaning: short description.
        function: function that returns a value for every sample, or None if the samples lack the
            data.
        combine: function that combines the running value, initially 0, with the values of
            additional samples.
        form: format of the number in tables.
        max: highest acceptable value; higher values are shown as warnings.
        finish: function that computes the metric from the combined number, or returns None if the
            metric is undefined for the run. Ticks are converted to hours here, because sums of
            ticks are exact, whereas sums of hours are not.
    """

    name: str
    unit: str
    label: str
    meaning: str
    function: Callable[[Site, Samples], Values | None]
    combine: Callable[[Any, Values], Any] = _sum
    form: str = ".4g"
    max: float = math.inf
    finish: Callable[[Site, Any], float | None] = _as_it_is

    @property
    def description(self) -> str:
        """Unit and meaning, as shown in tables next to the number."""
        return self.meaning if self.unit == "1" else f"{self.unit}, {self.meaning}"


# --- the values of all samples -------------------------------------------------------------------


def _running_share(site: Site, samples: Samples) -> Values:
    """Return the share of every sample during which the pumps run (1).

    The pumps count as running if their flow exceeds 1 % of their maximum flow or of the commanded
    flow. In a tick that is not short, the pumps can stop at the target or at the suction
    level; their flow is then a mean over the tick, and the share is the ratio of this mean to the
    commanded flow.
    """
    flow, tau = samples.pump, site.tau
    head = samples.cistern / site.a1 + site.c_hat - site.d
    commanded = samples.command * site.b * np.sqrt(np.maximum(head, 0.0))
    # In a long tick they can run for less than 1 % of it.
    min_share = min(RUNNING_SHARE, MIN_RUN_S / tau / 2)
    running = pumps_run(site, flow) | ((commanded > 0) & (flow > min_share * commanded))
    if has_short_ticks(site):
        return np.asarray(running, dtype=float)
    arriving = tau * (commanded + samples.precipitation * site.a2)
    stops = samples.roof + arriving >= site.a2 * site.z_veg
    # Both outlets together take no more than what is there.
    stops |= samples.cistern - tau * (commanded + samples.outflow) <= site.a1 * site.suction_level
    share = np.divide(flow, commanded, out=np.ones_like(flow), where=stops & (commanded > 0))
    return np.asarray(running * np.minimum(share, 1.0))


def _by_interval(
    site: Site, samples: Samples, seconds: float, *amounts: Values
) -> Values:
    """Assign every sample to an interval of the run; return the intervals' indices and the amounts.

    A tick belongs to the interval that contains its midpoint, because times are subject to
    rounding. A longer sample of a recorded run is divided among the intervals that it covers.

    Args:
        site: site with the duration of a tick.
        samples: samples with their start times.
        seconds: duration of an interval (s).
        amounts: one or more quantities of every sample, each of shape (n,).
    """
    half, time, duration = site.tau / 2, samples.time, samples.duration
    first = (time + half) // seconds
    last = np.maximum(first, (time + duration - half) // seconds)
    if not (last > first).any():
        return np.stack((first, *amounts))
    pieces = (last - first + 1).astype(np.intp)
    whole = np.repeat(np.arange(len(time)), pieces)
    interval = first[whole] + np.arange(len(whole)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    begin = np.maximum(time[whole], interval * seconds)
    end = np.minimum((time + duration)[whole], (interval + 1) * seconds)
    share = np.where(pieces[whole] == 1, 1.0, np.maximum(end - begin, 0.0) / duration[whole])
    return np.stack((interval, *(share * amount[whole] for amount in amounts)))


def _discharge(site: Site, samples: Samples) -> Values | None:
    """Return the discharge to the sewer in every sample (m3); None if unknown."""
    if not samples.discharge_known:
        return None
    flow = samples.outflow + (1 - site.drainage_to_cistern) * samples.drainage
    return samples.duration * flow


def _storm_water(site: Site, samples: Samples) -> Values | None:
    """Return the interval, the rain (m) and the discharge to the sewer (m3) of every sample."""
    discharge = _discharge(site, samples)
    if discharge is None:
        return None
    rain = samples.duration * samples.precipitation
    return _by_interval(site, samples, interval_seconds(site), rain, discharge)


def _intervals_of(site: Site, sums: Values) -> Intervals:
    """Return the storm water of a run from the sums of :func:`_storm_water`."""
    return Intervals(interval_seconds(site), *sums)


def _wet_discharge(site: Site, sums: Values) -> float:
    intervals = _intervals_of(site, sums)
    return _sum(0.0, intervals.discharge[find_wet_weather(site.wet_after, intervals)])


def _peak(site: Site, sums: Values, minutes: float) -> float:
    """Return the peak discharge (L/s)."""
    return 1000 * find_peak(_intervals_of(site, sums), minutes)


def _peak_depth(site: Site, sums: Values, minutes: float) -> float:
    """Return the peak discharge per connected area (mm/h)."""
    return _peak(site, sums, minutes) * _HOUR_S / connected_area(site)


def _overflow(site: Site, samples: Samples) -> Values | None:
    """Return the calendar day of every sample, and the flow through the upper outlet (m3)."""
    if samples.low_outlet is None or not samples.discharge_known:
        return None
    return np.stack((
        find_calendar_days(site, samples.start, samples.time),
        samples.duration * (samples.outflow - samples.low_outlet)
    ))


def _overflow_days(site: Site, days: Values) -> int:
    return int(np.count_nonzero(days[0] >= MIN_DEPTH * connected_area(site)))


def find_calendar_days(site: Site, start: float, times: Values) -> Values:
    """Return the day of every tick on the site's clock, 0 for the day on which the run starts.

    Args:
        site: site with the duration of a tick.
        start: start of the run (s since 1970).
        times: start times of the ticks (s since the start of the run), shape (n,).
    """
    middles = start + times + site.tau / 2
    begins, first, last = (
        datetime.fromtimestamp(float(time), site.zone).toordinal()
        for time in (start, middles[0], middles[-1])
    )
    midnights = [
        datetime.combine(date.fromordinal(day), datetime.min.time(), site.zone).timestamp()
        for day in range(first + 1, last + 1)
    ]
    return np.asarray(first - begins + np.searchsorted(midnights, middles, "right"), float)


def _rain_and_discharge(site: Site, samples: Samples) -> Values | None:
    """Return every sample's discharge to the sewer and rain on the connected area (m3)."""
    discharge = _discharge(site, samples)
    if discharge is None:
        return None
    return np.stack((
        discharge, samples.duration * samples.precipitation * connected_area(site)
    ))


def _share_without(site: Site, sums: Values) -> float | None:
    """Return 1 minus the ratio of the first sum to the second sum, at least 0."""
    return max(0.0, float(1 - sums[0] / sums[1])) if sums[1] else None


def _pump_starts(site: Site, samples: Samples) -> Values:
    pumping = _running_share(site, samples) > 0
    return np.asarray(pumping & ~np.append(samples.pumping_before, pumping[:-1]), dtype=float)


def _start_times(site: Site, samples: Samples) -> Values:
    """Return the times of pump starts (s from the first sample), with the earlier starts first."""
    times = np.cumsum(samples.duration) - samples.duration
    return np.concatenate((samples.earlier_starts, times[_pump_starts(site, samples) > 0]))


def _starts_in_hour(site: Site, samples: Samples) -> Values:
    """Return the number of starts in the hour that ends with each start; 0 for other samples."""
    times = _start_times(site, samples)
    # Half a tick less than an hour: the times are rounded sums.
    first = np.searchsorted(times, times - _HOUR_S + site.tau / 2)
    counts = _pump_starts(site, samples)
    counts[counts > 0] = (np.arange(1, len(times) + 1) - first)[len(samples.earlier_starts) :]
    return counts


def _excess_starts(site: Site, samples: Samples) -> Values:
    return np.asarray(_starts_in_hour(site, samples) > site.starts_per_hour, dtype=float)


def _hydraulic_energy(site: Site, samples: Samples) -> Values:
    # The head while they run; a mean over a tick in which they stop would be too low.
    share = _running_share(site, samples)
    flow = np.divide(samples.pump, share, out=samples.pump.copy(), where=share > 0)
    head = head_loss(site, samples.cistern, flow)
    return _WATER_DENSITY * site.g * samples.pump * head * samples.duration / _JOULES_PER_KWH


def _deviation(site: Site, samples: Samples) -> Values:
    # Samples that are not a tick long have the weight duration / tau.
    return np.abs(samples.roof - site.x2_star) * (samples.duration / site.tau)


def _volume(flow: str) -> Callable[[Site, Samples], Values]:
    return lambda site, samples: samples.duration * getattr(samples, flow)


def _ticks_where(condition: Callable[[Site, Samples], Any]) -> Callable[[Site, Samples], Values]:
    """Return a function that counts the ticks in which a condition holds."""
    return lambda site, samples: samples.duration / site.tau * condition(site, samples)


def _roof_water(site: Site, samples: Samples) -> Values:
    """Return the hour of every sample, and its rain, pumped water and drained water (m3)."""
    return _by_interval(
        site, samples, _HOUR_S, samples.duration * samples.precipitation * site.a2,
        samples.duration * samples.pump, samples.duration * samples.drainage,
    )


METRICS = (
    Metric(
        "total_deviation_m3", "m3", "total deviation",
        "absolute deviation of the water on the roof from its target, summed over the time steps",
        _deviation, form=".2f",
    ),
    Metric(
        "near_target_hours", "h", "near the target",
        f"time during which the water on the roof is within {NEAR_TARGET:.0%} of its target",
        _ticks_where(
            lambda site, samples: np.abs(samples.roof - site.x2_star) <= NEAR_TARGET * site.x2_star
        ),
        form=".2f", finish=_hours,
    ),
    Metric(
        "mean_deviation_mm", "mm", "mean deviation",
        "mean absolute deviation of the water on the roof from its target, as a depth",
        lambda site, samples: np.stack((_deviation(site, samples), samples.duration / site.tau)),
        _sums, ".2f", finish=lambda site, sums: 1000 * float(sums[0] / sums[1]) / site.a2,
    ),
    Metric(
        "stress_hours", "h", "water stress",
        "time during which the plants lack water: the stress coefficient K_s of FAO-56 is below "
        "1, or the roof contains no water",
        _ticks_where(
            lambda site, samples: (samples.roof < soil_of(site).stress_volume) | (samples.roof <= 0)
        ),
        form=".2f", finish=_hours,
    ),
    Metric(
        "evapotranspiration_ratio", "1", "evapotranspiration ratio",
        "actual evapotranspiration divided by potential evapotranspiration",
        lambda site, samples: (
            samples.duration * np.stack((samples.evapotranspiration, samples.potential))
        ),
        _sums, ".1%", finish=_ratio,
    ),
    Metric(
        "rain_kept_share", "1", "rain kept", "share of the rain on the roof that did not drain",
        _roof_water, _sums_by, ".1%", finish=_retained,
    ),
    Metric(
        "rain_kept_share_hour", "1", "rain kept in hours with more than 20 mm",
        "share of the rain that did not drain in the same hour, over all hours with more than 20 "
        "mm of rain",
        _roof_water, _sums_by, ".1%", finish=partial(_retained, above=20.0),
    ),
    Metric(
        "rain_kept_share_day", "1", "rain kept in 24 h periods with more than 10 mm",
        "share of the rain that did not drain within these periods, over all periods of 24 hours "
        "with more than 10 mm of rain",
        _roof_water, _sums_by, ".1%", finish=partial(_retained, above=10.0, hours=24),
    ),
    Metric(
        "mains_m3", "m3", "mains water used",
        "mains water that flowed into the cistern, if the site has a mains supply",
        lambda site, samples: (
            None if site.mains_level is None else samples.duration * samples.mains
        ),
    ),
    Metric(
        "demand_met_share", "1", "irrigation without mains water",
        "share of the pumped water that was not replaced by mains water, if the site has a mains "
        "supply",
        lambda site, samples: None if site.mains_level is None else (
            samples.duration * np.stack((samples.mains, samples.pump))
        ),
        _sums, ".1%", finish=_share_without,
    ),
    Metric(
        "final_cistern_m3",
        "m3", "cistern at the end", "water volume in the cistern at the end of the run",
        lambda site, samples: samples.cistern, _last, ".6g",
    ),
    Metric(
        "final_roof_m3", "m3", "roof at the end", "water volume on the roof at the end of the run",
        lambda site, samples: samples.roof, _last, ".6g",
    ),
    Metric(
        "final_layer_m3", "m3", "drainage layer at the end",
        "water volume in the drainage layer at the end of the run, for a field-capacity soil",
        lambda site, samples: None if site.drainage_storage is None else samples.layer,
        _last, ".6g",
    ),
    Metric(
        "pumped_m3", "m3", "pumped", "water pumped from the cistern to the roof", _volume("pump"),
    ),
    Metric(
        "outflow_m3",
        "m3", "outflow", "water that flowed from the cistern to the sewer", _volume("outflow"),
    ),
    Metric("drainage_m3", "m3", "drainage", "water that drained off the roof", _volume("drainage")),
    Metric(
        "discharge_m3", "m3", "discharge",
        "water that reached the sewer: the outflow, and the drainage that did not flow into the "
        "cistern",
        _discharge,
    ),
    Metric(
        "wet_discharge_m3", "m3", "discharge in wet weather",
        "water that reached the sewer during rain or within wet_after hours after rain",
        _storm_water, _sums_by,
        finish=_wet_discharge,
    ),
    *(
        Metric(
            f"peak_discharge_{minutes}min_l_s", "L/s", f"peak discharge, {minutes} min",
            f"highest mean discharge over {minutes} min", _storm_water, _sums_by,
            finish=partial(_peak, minutes=minutes),
        )
        for minutes in (5, 15, 60)
    ),
    *(
        Metric(
            f"peak_discharge_{minutes}min_mm_h", "mm/h", f"peak discharge per area, {minutes} min",
            "highest mean discharge divided by the connected area, which is the area of the roof "
            "plus the area of the catchment times its runoff coefficient",
            _storm_water, _sums_by, finish=partial(_peak_depth, minutes=minutes),
        )
        for minutes in (5, 15, 60)
    ),
    Metric(
        "overflow_m3",
        "m3", "overflow", "water that left the cistern through its upper outlet",
        _overflow, _sums_by,
        finish=lambda site, days: _sum(0.0, days[0]),
    ),
    Metric(
        "overflow_days", "1", "days of overflow",
        "number of calendar days, on the site's clock, with an overflow of at least 0.1 mm over "
        "the connected area",
        _overflow,
        _sums_by, "d", finish=_overflow_days,
    ),
    Metric(
        "retention_share", "1", "retention",
        "share of the rain on the roof and the catchment that did not reach the sewer",
        _rain_and_discharge, _sums, ".1%", finish=_share_without,
    ),
    Metric(
        "rain_m3", "m3", "rain", "rain that flowed into the cistern or fell on the roof",
        lambda site, samples: (
            samples.duration * samples.precipitation * (site.effective_catchment + site.a2)
        ),
    ),
    Metric(
        "rain_cistern_m3",
        "m3", "rain into the cistern", "rain that flowed into the cistern from the catchment",
        lambda site, samples: samples.duration * samples.precipitation * site.effective_catchment,
    ),
    Metric(
        "rain_roof_m3", "m3", "rain on the roof", "rain that fell on the whole roof",
        lambda site, samples: samples.duration * samples.precipitation * site.a2,
    ),
    Metric(
        "evapotranspiration_m3", "m3", "evapotranspiration",
        "water that evaporated from the soil and the plants",
        _volume("evapotranspiration"),
    ),
    Metric(
        "max_command", "1", "maximum command", "highest command, as a share of the maximum flow",
        lambda site, samples: samples.command, _maximum, ".6g", max=1,
    ),
    Metric(
        "beyond_hours", "h", "beyond the pump", "time during which the command is above 1",
        _ticks_where(lambda site, samples: samples.command > 1), form=".4f", max=0, finish=_hours,
    ),
    Metric(
        "limited_steps", "1", "limited ticks",
        "time steps in which a tank contained less water than was demanded",
        lambda site, samples: samples.limited, _count, "d", max=0,
    ),
    Metric(
        "pump_starts", "1", "pump starts",
        f"number of times that the flow of the pumps rose {_RUNS}",
        _pump_starts, _count, "d",
    ),
    Metric(
        "busiest_hour_starts",
        "1", "starts in an hour", "maximum number of pump starts in 60 minutes",
        _starts_in_hour, lambda before, values: int(_maximum(before, values)), "d",
    ),
    Metric(
        "excess_starts", "1", "too many starts",
        "number of pump starts in excess of starts_per_hour, counted over the hour "
        "before each start",
        _excess_starts, _count, "d", max=0,
    ),
    Metric(
        "pump_hours", "h", "pump running", f"time during which the flow of the pumps is {_RUNS}",
        _ticks_where(_running_share), form=".3f", finish=_hours,
    ),
    Metric(
        "hydraulic_energy_kwh", "kWh", "hydraulic energy",
        "energy that the pumps add to the water: the product of density, gravitational "
        "acceleration, flow and head, integrated over time",
        _hydraulic_energy,
    ),
    Metric(
        "electric_energy_kwh", "kWh", "electric energy",
        "electric energy of the pumps: hydraulic energy divided by pump_efficiency",
        lambda site, samples: _hydraulic_energy(site, samples) / site.pump_efficiency,
    ),
)


def totals_of(
    site: Site, samples: Samples, before: Mapping[str, Any] | None = None
) -> dict[str, float]:
    """Return the metrics of a whole run by name, except metrics for which the samples lack data.

    Args:
        site: parameters of the site.
        samples: at least one sample.
        before: combined numbers of all earlier samples.
    """
    totals = _add(before or {}, site, samples)
    values = (
        (metric.name, metric.finish(site, _whole(totals[metric.name])))
        for metric in METRICS if metric.name in totals
    )
    return {name: value for name, value in values if value is not None}


def events_of(
    site: Site, samples: Samples, before: Mapping[str, Any] | None = None
) -> list[Event]:
    """Return the rain events of a whole run, or an empty list if the discharge is unknown.

    The arguments are those of :func:`totals_of`.
    """
    totals = _add(before or {}, site, samples)
    if "wet_discharge_m3" not in totals:
        return []
    return find_events(site, _intervals_of(site, _whole(totals["wet_discharge_m3"])))


def _add(totals: Mapping[str, Any], site: Site, samples: Samples) -> dict[str, Any]:
    """Add samples to the combined numbers of a run; ``totals`` is initially empty."""
    result: dict[str, Any] = {}
    combined: dict[Any, Any] = {}  # several metrics can share a number
    for metric in METRICS:
        key = metric.function, metric.combine
        if key not in combined:
            values, before = metric.function(site, samples), totals.get(metric.name, 0.0)
            combined[key] = None if values is None else metric.combine(before, values)
        if combined[key] is not None:
            result[metric.name] = combined[key]
    return result


TICK = ("cistern", "roof", "layer", "command", "precipitation", "potential", *Flows._fields)
"""names in :class:`Samples` of the values of a tick: the state, and the flows until the next tick
"""
BLOCK = 4096
"""number of ticks that are added up together, which takes less than half the time"""

_pack_tick = struct.Struct(f"{len(TICK)}d").pack
_BLOCK_BYTES = BLOCK * 8 * len(TICK)


class BlockMetrics:
    """The metrics of a run in progress, to which blocks of ticks are added.

    The final state of a run is passed as a last tick without flows.
    """

    def __init__(self, site: Site, start: float = 0.0) -> None:
        """Start with the pumps stopped.

        Args:
            site: parameters of the site.
            start: start of the run (s since 1970).
        """
        self._site, self._start = site, start
        self._totals: dict[str, Any] = {}
        self._weeks: _Sums | float = 0.0
        self._done = 0  # number of ticks in the totals
        self._pumping = False
        self._starts = np.empty(0)

    def add(self, ticks: Values) -> None:
        """Add a block of ticks.

        Args:
            ticks: values of at least one tick, shape (:data:`TICK`, n).
        """
        samples = self._samples(ticks, self._done)
        self._totals = _add(self._totals, self._site, samples)
        self._weeks = self._weekly(samples)
        self._done += len(samples.roof)
        self._pumping = bool(_running_share(self._site, samples)[-1])
        starts = _start_times(self._site, samples) - float(samples.duration.sum())
        self._starts = starts[starts > -_HOUR_S]

    def results(self, end: Values) -> dict[str, float]:
        """Return all metrics by name, given the final state of the run, shape (:data:`TICK`, 1)."""
        return totals_of(self._site, self._end(end), self._totals)

    def weekly_deviations(self, end: Values) -> list[float]:
        """Return the total deviation in every week of the run (m3), summed over the ticks.

        The sum of a season would conceal a bad fortnight. The last week can be shorter; it
        includes the last tick, so that the weeks add up to the total.

        Args:
            end: final state of the run, as for :meth:`results`.
        """
        return [float(week) for week in self._weekly(self._end(end)).whole()[0]]

    def events(self, end: Values) -> list[Event]:
        """Return the rain events of a run with the given final state, as for :meth:`results`."""
        return events_of(self._site, self._end(end), self._totals)

    def _end(self, state: Values) -> Samples:
        """Return the samples of the final state of the run.

        The final state belongs to the hour and week of the previous tick, and does not begin a new
        hour or week.
        """
        return self._samples(state, max(0, self._done - 1))

    def _samples(self, ticks: Values, first: int) -> Samples:
        columns = dict(zip(TICK, ticks, strict=True))
        count, site = len(columns["roof"]), self._site
        return Samples(
            duration=np.full(count, site.tau), pumping_before=self._pumping,
            earlier_starts=self._starts, time=site.tau * (first + np.arange(count, dtype=float)),
            start=self._start, discharge_known=True, **columns,
        )

    def _weekly(self, samples: Samples) -> _Sums:
        """Return the deviation in every week, including that of the given samples."""
        week = (samples.time + self._site.tau / 2) // _WEEK_S
        return _sums_by(self._weeks, np.stack((week, _deviation(self._site, samples))))


def end_state(cistern: float, roof: float, layer: float) -> Values:
    """Return a final state as the values of a tick without flows, shape (:data:`TICK`, 1)."""
    return np.array([[cistern], [roof], [layer], *[[0.0]] * (len(TICK) - 3)])


class Metrics:
    """The metrics of a run in progress, by name, as in ``metrics["pumped_m3"]``."""

    def __init__(self, site: Site, plant: Plant, start: float = 0.0) -> None:
        """Begin with the pumps stopped.

        Args:
            site: parameters of the site.
            plant: cistern and roof, in the state of the current tick.
            start: start of the run (s since 1970).
        """
        self._plant, self._blocks = plant, BlockMetrics(site, start)
        self._ticks = bytearray()

    def step(
        self, command: float, precipitation: float, potential: float, flows: Flows
    ) -> None:
        """Add the current tick; must be called for every tick 0..N-1.

        Args:
            command: command of the controller (1).
            precipitation: rain rate (m/s).
            potential: potential evapotranspiration (m3/s).
            flows: flows in the tick (m3/s).
        """
        plant = self._plant
        self._ticks += _pack_tick(
            plant.x1, plant.x2, plant.layer, command, precipitation, potential, *flows
        )
        if len(self._ticks) == _BLOCK_BYTES:
            self._add_ticks()

    def results(self) -> dict[str, float]:
        """Return all metrics by name, as if the run ended with the current tick."""
        return self._blocks.results(self._end())

    def weekly_deviations(self) -> list[float]:
        """Return every week's total deviation (m3), as if the run ended with the current tick."""
        return self._blocks.weekly_deviations(self._end())

    def events(self) -> list[Event]:
        """Return the rain events, as if the run ended with the current tick."""
        return self._blocks.events(self._end())

    def __getitem__(self, name: str) -> float:
        """Return the metric with the given name."""
        return self.results()[name]

    def _end(self) -> Values:
        """Add up all ticks, and return the final state of the run."""
        if self._ticks:
            self._add_ticks()
        return end_state(self._plant.x1, self._plant.x2, self._plant.layer)

    def _add_ticks(self) -> None:
        self._blocks.add(np.frombuffer(self._ticks).reshape(-1, len(TICK)).T)
        self._ticks = bytearray()
