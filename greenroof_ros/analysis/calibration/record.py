"""Measured records of roofs: their files and bags, the steps that are compared, and scores."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import duration
from greenroof_ros.results.bag_read import load_bag
from greenroof_ros.site.site import Site
from greenroof_ros.weather.description import END
from greenroof_ros.weather.evapotranspiration import (
    HARGREAVES,
    check_place,
    find_extremes,
    spread_hargreaves,
)
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, ROOF, TEMPERATURE
from greenroof_ros.weather.read import expand
from greenroof_ros.weather.records import bridge_gaps, describe_rows, find_gaps, make_hours
from greenroof_ros.weather.summary import as_lines, summarize
from greenroof_ros.weather.table import read_rows

Values = NDArray[np.float64]
Steps = NDArray[np.bool_]
HOUR_S, DAY_S = 3600, 86400

# The minimum time between two storms, and how long a roof responds after rain (s).
_STORM_GAP_S, _AFTER_STORM_S = 6 * HOUR_S, DAY_S
# An unknown storm is forgotten after this long (s) and this much reference evapotranspiration (mm).
_FORGOTTEN_S, _FORGOTTEN_MM = 7 * DAY_S, 20.0
# More rain than a drizzle in the hours next to a short outage (mm).
_RAINED_MM = 1.0
# The hours to which a value of each amount refers, in the units of the weather readers.
_AMOUNTS = {PRECIPITATION: 1, "runoff": 1, "pumped": 1, EVAPOTRANSPIRATION: 24}
_EXTREMES = "minimum temperature", "maximum temperature"
# Fewer temperatures of a day miss its extremes: three hours apart they show at least 0.92 of a
# sine's range, six hours apart 0.71.
_MIN_A_DAY = 6
# Duration of a bag's steps (s): short relative to storms, long relative to a sensor's noise.
_STEP_S = 300.0
# A longer time without messages is a gap (s).
_GAP_S = 600.0


@dataclass(frozen=True)
class StepRecord:
    """Measurements in time steps of equal length; NaN for missing measurements.

    The time of a step is its start. Depths (mm) are averages over the roof's area, and totals for
    the whole step.

    Attributes:
        source: the file or bag that contains the measurements.
        start: start of the first step, with a UTC offset.
        step_s: duration of a step (s).
        rain: rain (mm), shape (steps,).
        reference: evapotranspiration of the FAO-56 reference grass (mm).
        pumped: water pumped onto the roof (mm).
        measured: what a simulation is compared with: ``runoff`` from the roof (mm), and the water
            ``level`` in the substrate at the start of the step (m), or one of them.
        notes: sentences about what the record contains (see
            :mod:`greenroof_ros.weather.summary`), and about data that could not be used unchanged.
    """

    source: Path
    start: datetime
    step_s: float
    rain: Values
    reference: Values
    pumped: Values
    measured: dict[str, Values]
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> NDArray[np.int64]:
        """Start of every step on the record's own clock (s since 1970-01-01 on that clock)."""
        first = self.start.replace(tzinfo=None) - datetime(1970, 1, 1)  # noqa: DTZ001
        steps = np.arange(len(self.rain))
        return round(first.total_seconds()) + np.round(self.step_s * steps).astype(np.int64)

    def time(self, step: int) -> str:
        """Return the start of a step on the record's own clock, such as ``2021-07-07 14:00``."""
        return str(self.seconds[step].astype("datetime64[s]"))[:16].replace("T", " ")

    @property
    def water(self) -> Values:
        """Sum of the rain and the pumped water on the roof (mm); unknown amounts count as 0."""
        return np.asarray(np.nan_to_num(self.rain) + np.nan_to_num(self.pumped))

    @property
    def drying(self) -> Values:
        """The reference evapotranspiration, or its mean where it is unknown (mm)."""
        unknown = np.isnan(self.reference)
        return np.where(unknown, np.nanmean(self.reference), self.reference)

    @property
    def complete(self) -> Steps:
        """Steps with no missing measurement in the step itself or in its two neighbors.

        The measurements are rain, pumped water and :attr:`measured`. A sensor that fails in one
        step has often recorded only part of the neighboring step.
        """
        missing = np.isnan([self.rain, self.pumped, *self.measured.values()]).any(axis=0)
        return np.asarray(np.convolve(missing, np.ones(3), "same") == 0)


def combine(quantity: str, values: Values, seconds: NDArray[np.int64], span_s: int) -> Values:
    """Return sums of runoff or means of the level over the clock spans in which steps begin.

    Sums of levels would depend on the length of the gaps in a span. Spans without steps are left
    out.

    Args:
        quantity: a name of :attr:`StepRecord.measured`.
        values: values in steps, without NaN.
        seconds: start of every step on a clock (s since 1970-01-01 on that clock).
        span_s: length of a span (s).
    """
    _, index, counts = np.unique(seconds // span_s, return_inverse=True, return_counts=True)
    sums = np.bincount(index, values).astype(np.float64)
    return sums if quantity == "runoff" else sums / counts


def find_storms(record: StepRecord) -> list[slice]:
    """Return the steps of every storm, from its first rain to one day after its last rain.

    Storms are separated by at least six hours, and at least one step, without rain. A storm ends at
    the latest when the next storm begins.
    """
    wet = np.flatnonzero(record.rain > 0)
    parts = np.split(wet, 1 + np.flatnonzero(np.diff(wet) > max(1, _STORM_GAP_S / record.step_s)))
    after = 1 + math.ceil(_AFTER_STORM_S / record.step_s)
    ends = [*(part[0] for part in parts[1:]), len(record.rain)]
    return [
        slice(int(part[0]), min(int(part[-1]) + after, int(end)))
        for part, end in zip(parts, ends, strict=True) if len(part)
    ]


def find_outages(record: StepRecord) -> list[slice]:
    """Return the steps from each outage to the end of its effect on the roof.

    In an outage, rain, pumped water or evapotranspiration is unknown. A storm may have occurred in
    it. The water of such a storm is gone after about a week, but not before 20 mm could have
    evaporated. Outages of up to an hour count only if it rained in the hour before or after them.
    """
    evaporated = np.cumsum(record.drying)
    week, hour = (math.ceil(time / record.step_s) for time in (_FORGOTTEN_S, HOUR_S))
    found = []
    for first, end in find_gaps(np.isnan(record.rain + record.pumped + record.reference)):
        near = np.nansum(record.rain[max(0, first - hour):end + hour])
        if (end - first) * record.step_s > HOUR_S or near > _RAINED_MM:
            dried = int(np.searchsorted(evaporated, evaporated[end - 1] + _FORGOTTEN_MM)) + 1
            found.append(slice(first, min(max(end + week, dried), len(record.rain))))
    return found


def select_comparable(record: StepRecord) -> Steps:
    """Return the steps in which a simulation is compared: complete steps outside broken storms.

    A storm is broken if rain, pumped water or runoff is missing during it, because unrecorded water
    affects the roof for the whole storm. In addition, meters tend to fail when runoff is largest,
    and their values can then be incomplete for an unknown time before and after the gap. Steps
    after an outage are left out until the unrecorded water no longer affects the roof
    (:func:`find_outages`).
    """
    steps = record.complete
    missing = np.isnan(record.rain + record.pumped + record.measured.get("runoff", 0.0))
    broken = (storm for storm in find_storms(record) if missing[storm].any())
    for span in (*find_outages(record), *broken):
        steps[span] = False
    return steps


def halve_steps(record: StepRecord, steps: Steps) -> dict[str, Steps]:
    """Split the comparable steps on the first dry day after half of the water has arrived.

    The halves receive equal amounts of rain and pumped water, because only water reveals the
    properties of a roof: with halves of equal duration, one half could contain all the storms. A
    storm in both halves would make the validation depend on data used in the fit. Without a dry
    day, all steps are in the earlier half.

    Args:
        record: the measurements.
        steps: steps that may be used.

    Returns:
        The steps of each half by its purpose: ``fit`` for the earlier half, and ``validation`` for
        the later half.
    """
    steps = steps & select_comparable(record)
    total = np.cumsum(np.where(steps, record.water, 0.0))
    day = np.ones(math.ceil(_AFTER_STORM_S / record.step_s))
    dry = np.convolve(record.water > 0, day)[:len(steps)] == 0
    later = np.cumsum((total >= total[-1] / 2) & dry) > 0
    return {"fit": steps & ~later, "validation": steps & later}


def select_months(record: StepRecord, span: str | None) -> Steps:
    """Return a mask of the steps that begin in a span of months on the record's own clock.

    A span is written as ``4-10``, or as ``11-3`` across the new year; both ends are included. None
    selects all steps.

    Raises:
        ConfigurationError: if the text is not a span of months.
    """
    if span is None:
        return np.full(len(record.rain), True)
    try:
        first, last = (range(1, 13).index(int(month)) for month in span.split("-"))
    except ValueError:
        raise ConfigurationError(
            "must be the first and the last month to use, such as 4-10, or 11-3 across the new "
            "year", key="months", value=span,
        ) from None
    month = record.seconds.astype("datetime64[s]").astype("datetime64[M]").astype(np.int64) % 12
    return np.asarray((month - first) % 12 <= (last - first) % 12)


class FitScores(NamedTuple):
    """The scores of one series in one half of a record."""

    quantity: str
    """``runoff`` or ``level``"""
    part: str
    """``fit`` or ``validation``"""
    nse: dict[int, float]
    """Nash-Sutcliffe efficiency of the sums of runoff, or means of levels, by the length of the
    time span (s): 1 is perfect, 0 is no better than the mean of the measurements (Nash and
    Sutcliffe 1970, doi:10.1016/0022-1694(70)90255-6, Eq. 3)"""
    volume_error: float
    """simulated minus measured volume of all steps, as a share of the measured volume"""


def efficiency(simulated: Values, measured: Values) -> float:
    """Return the NSE: 1 minus the squared errors over the squared deviations from the mean.

    If the measurements do not vary, they cannot be used to judge a simulation, and the result is
    NaN.
    """
    if np.ptp(measured) == 0:
        return float("nan")
    errors = np.sum((simulated - measured) ** 2)
    return float(1 - errors / np.sum((measured - np.mean(measured)) ** 2))


def score(
    quantity: str, part: str, simulated: Values, record: StepRecord, steps: Steps
) -> FitScores:
    """Score a series over its steps, and over hours and days if these are longer than the steps.

    Args:
        quantity: ``runoff`` or ``level``.
        part: ``fit`` or ``validation``.
        simulated: simulated values, shape (steps,).
        record: record with the measured values.
        steps: mask of the steps of the part.
    """
    seconds, step = record.seconds[steps], round(record.step_s)
    pair = simulated[steps], record.measured[quantity][steps]
    nse = {
        span_s: efficiency(*(combine(quantity, series, seconds, span_s) for series in pair))
        for span_s in (step, *(time for time in (HOUR_S, DAY_S) if time > step))
    }
    ours, theirs = (float(np.sum(series)) for series in pair)
    return FitScores(quantity, part, nse, ours / theirs - 1 if theirs > 0 else np.nan)


def read_csv_record(file: Path, site: Site) -> StepRecord:
    """Read a measured record from CSV; see :func:`greenroof_ros.weather.table.read_rows`.

    Each row covers the step that begins at the time given (or, with ``rows: end``, ends at it);
    levels are measured at that time. Rows are no more than a day apart. Rain, ``level`` or
    ``runoff``, and evapotranspiration are required. Evapotranspiration is taken from the column
    ``reference evapotranspiration``, in which gaps of no more than an hour, or of a single step,
    are interpolated. Alternatively, it is computed with Hargreaves' equation from ``temperature``,
    or from ``minimum temperature`` and ``maximum temperature`` in any row of the day. Pumped water
    is taken from the column ``pumped``; without this column it is 0.

    Args:
        file: the record, or a description of it.
        site: site with its location, clock and area.

    Raises:
        ConfigurationError: if the file breaks a rule; the message names the line, the column and
            the value.
    """
    (file, described), *more = expand([file])
    if more:
        raise ConfigurationError("must be a single record", file=more[0][0])
    rows = read_rows(
        file, site, (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE, *ROOF), described
    )
    there = rows.columns.keys() - ({EVAPOTRANSPIRATION} if rows.method != "reference" else set())
    if not (
        PRECIPITATION in there and there & {"runoff", "level"}
        and (there & {EVAPOTRANSPIRATION, TEMPERATURE} or there >= {*_EXTREMES})
    ):
        raise rows.table.refuse(
            "must have the columns 'rain [mm]', 'runoff [mm]' or 'level [m]', and 'reference "
            "evapotranspiration [mm]', 'temperature [degC]', or both 'minimum temperature [degC]' "
            "and 'maximum temperature [degC]'"
        )
    step_s, steps = rows.step_s, int(rows.steps[-1]) + 1
    # A roof drains within hours, so longer sums show no more than the rain does.
    if step_s > DAY_S:
        raise rows.table.refuse(
            f"the rows are {duration(step_s)} apart; they must be no more than a day apart"
        )
    series, step_h = {}, step_s / HOUR_S
    for name, values in rows.values.items():
        series[name] = np.full(steps, np.nan)
        series[name][rows.steps] = values * step_h / _AMOUNTS[name] if name in _AMOUNTS else values
        if rows.described.rows == END and name == "level":
            series[name] = np.append(np.nan, series[name][:-1])
    late = round(rows.described.rain_late / step_h)
    record = StepRecord(
        source=file, start=rows.first, step_s=step_s,
        rain=np.append(series[PRECIPITATION][late:], np.full(late, np.nan)),
        reference=np.zeros(steps), pumped=series.get("pumped", np.zeros(steps)),
        measured={name: series[name] for name in ("runoff", "level") if name in series},
        notes=(describe_rows(rows),) if step_h > 1
        else tuple(as_lines(summarize(make_hours([rows]), site))),
    )
    reference = (
        bridge_gaps(series[EVAPOTRANSPIRATION], max(1, round(HOUR_S / step_s)))
        if EVAPOTRANSPIRATION in there else _compute_from_temperatures(record, site, series)
    )
    if np.isnan(reference).all():
        raise rows.table.refuse(
            "has no evapotranspiration; if it is computed, each day needs temperatures at most "
            "three hours apart, or a row with its minimum and maximum temperature"
        )
    return replace(record, reference=reference)


def _compute_from_temperatures(
    record: StepRecord, site: Site, series: Mapping[str, Values]
) -> Values:
    """Return Hargreaves' reference evapotranspiration in every step (mm), shape (steps,).

    Days follow the record's own clock. The temperatures of a day without values, with fewer than
    six or than 75 % of its ``temperature`` values, or with a minimum above its maximum, are
    interpolated over no more than three days; on other days, the result is NaN.
    """
    check_place(site, HARGREAVES)
    (low, high), needed = _EXTREMES, 1.0
    if TEMPERATURE in series:
        low, high, needed = TEMPERATURE, TEMPERATURE, max(_MIN_A_DAY, 0.75 * DAY_S / record.step_s)
    days, day = np.unique(record.seconds // DAY_S, return_inverse=True)
    extremes = find_extremes(day, series[low], series[high], needed)
    extremes[:, ~(extremes[0] <= extremes[1])] = np.nan
    offset_s = float(record.seconds[0] - record.start.timestamp())
    return spread_hargreaves(
        replace(site, utc_offset=offset_s / HOUR_S), days.astype("datetime64[D]"), extremes,
        record.seconds, record.step_s,
    )


def read_bag_record(bag: Path, site: Site) -> StepRecord:
    """Read a bag as steps of five minutes.

    Rain, evapotranspiration and pumped water are summed over every step; the level is
    ``/roof/level`` at the beginning of the step. If ``/roof/drainage`` is not recorded, or is
    always 0, the record has no runoff. Evapotranspiration is used unchanged, as the forecasts of a
    live site contain that of the reference grass.

    Raises:
        ConfigurationError: if the bag cannot be read, or is shorter than five minutes.
    """
    trajectory, notes, _ = load_bag(bag, site, site.zone, own=False)
    if trajectory.time[-1] < _STEP_S:
        raise ConfigurationError("must be at least five minutes long", file=bag)
    edges = _STEP_S * np.arange(trajectory.time[-1] // _STEP_S + 1)
    spacing = np.diff(trajectory.time)

    def summed(flow: Values | Steps) -> Values:
        """Return the volume of a flow in every step, with the flow constant between samples."""
        total = np.concatenate(([0.0], np.cumsum(flow[:len(spacing)] * spacing)))
        return np.diff(np.interp(edges, trajectory.time, total))

    gap = summed(spacing > _GAP_S) > 0

    def known(flow: Values) -> Values:
        return np.where(gap, np.nan, summed(flow))

    mm = 1000 / site.a2
    first = np.searchsorted(trajectory.time, edges[:-1], side="right") - 1
    measured = {"level": np.where(gap, np.nan, trajectory.roof[first] / site.a2)}
    if np.any(trajectory.drainage > 0):
        measured["runoff"] = known(trajectory.drainage) * mm
    return StepRecord(
        source=bag, start=trajectory.start, step_s=_STEP_S,
        rain=known(trajectory.precipitation) * 1000,
        reference=known(trajectory.evapotranspiration) * mm,
        pumped=known(trajectory.pump_flow) * mm, measured=measured, notes=notes,
    )
