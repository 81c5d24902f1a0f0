"""Measurements of a roof, step by step, with their storms, months and two halves."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats.records import gaps

Values = NDArray[np.float64]
Steps = NDArray[np.bool_]
HOUR_S, DAY_S = 3600, 86400

# The minimum time between two storms, and how long a roof responds after rain (s). The halves of a
# record are also split after that long without water.
_STORM_GAP_S, _AFTER_S = 6 * HOUR_S, DAY_S
# An unknown storm is forgotten after this long (s) and this much reference evapotranspiration (mm).
_FORGOTTEN_S, _FORGOTTEN_MM = 7 * DAY_S, 20.0
# More rain than a drizzle in the hours next to a short outage (mm).
_RAINED_MM = 1.0


@dataclass(frozen=True)
class RoofRecord:
    """Steps of equal length, each beginning at its time, with NaN for missing measurements.

    Depths (mm) are over the roof's area and for the whole step.

    Attributes:
        source: the file or bag.
        start: time of the first step, with its offset from UTC.
        step_s: duration of a step (s).
        rain: mm, shape (steps,).
        reference: evapotranspiration of FAO-56's reference grass (mm); never NaN.
        pumped: water pumped onto the roof (mm).
        runoff: water that ran off the roof (mm); None if not measured.
        level: water level in the substrate at the beginning of the step (m); None if not measured.
        last_decimal: unit of the last decimal place of the runoff (mm); 0 if it was not rounded.
        cistern: level of the cistern at the beginning of the step (m); None if not measured.
        command: mean share of the pumps' maximum flow (1); None if unknown.
        reference_column: column of the evapotranspiration in the file; empty if it was computed.
        notes: what could not be used as it is.
    """

    source: Path
    start: datetime
    step_s: float
    rain: Values
    reference: Values
    pumped: Values
    runoff: Values | None
    level: Values | None
    last_decimal: float = 0.0
    cistern: Values | None = None
    command: Values | None = None
    reference_column: str = ""
    notes: tuple[str, ...] = ()

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.rain)

    @property
    def offset_s(self) -> float:
        """Offset of the record's own clock from UTC (s)."""
        offset = self.start.utcoffset()
        assert offset is not None
        return offset.total_seconds()

    @property
    def seconds(self) -> NDArray[np.int64]:
        """Start of each step on the record's own clock, in seconds since 1970-01-01 there."""
        first = round(self.start.timestamp() + self.offset_s)
        return first + np.round(self.step_s * np.arange(self.steps)).astype(np.int64)

    @property
    def times(self) -> NDArray[np.datetime64]:
        """Start of each step on the record's own clock."""
        return self.seconds.astype("datetime64[s]")

    def time(self, step: int) -> str:
        """Return when a step begins, as text; for a step after the last, when the last begins."""
        return str(self.times[min(step, self.steps - 1)]).replace("T", " ")

    @property
    def water(self) -> Values:
        """Rain and pumped water on the roof (mm); unknown amounts are treated as 0."""
        return np.asarray(np.nan_to_num(self.rain) + np.nan_to_num(self.pumped))

    @property
    def measured(self) -> dict[str, Values]:
        """The series to compare a simulation with, by name: ``runoff`` (mm) and ``level`` (m)."""
        columns = {"runoff": self.runoff, "level": self.level}
        return {name: series for name, series in columns.items() if series is not None}

    def only(self, steps: Steps) -> RoofRecord:
        """Return the record with NaN instead of rain, runoff and level outside of some steps."""
        series = {"rain": self.rain, **self.measured}
        there = {name: np.where(steps, values, np.nan) for name, values in series.items()}
        return replace(self, **there)  # type: ignore[arg-type]

    @property
    def complete(self) -> Steps:
        """Steps with rain, pumped and :attr:`measured`, also one step before and after.

        A sensor that failed in a step often recorded only a part of the step next to it.
        """
        series = [self.rain, self.pumped, *self.measured.values()]
        missing = np.isnan(series).any(axis=0)
        near = np.convolve(missing, np.ones(3), "same") > 0
        return np.asarray(~near)


def time_name(seconds: float) -> str:
    """Name a time of whole seconds: ``5 min``, ``1 h``, ``1 day``, ``2 days``."""
    whole = round(seconds)
    units = {"day": DAY_S, "h": HOUR_S, "min": 60, "s": 1}
    unit = next(unit for unit, size in units.items() if whole % size == 0)
    count = whole // units[unit]
    return f"{count} {'days' if unit == 'day' and count > 1 else unit}"


def sums(values: Values | Steps, seconds: NDArray[np.int64], span_s: int) -> Values:
    """Add up values by the clock span of ``span_s`` seconds that each begins in.

    Spans without values are left out.
    """
    _, index = np.unique(seconds // span_s, return_inverse=True)
    return np.bincount(index, values).astype(np.float64)


def means(values: Values, seconds: NDArray[np.int64], span_s: int) -> Values:
    """Average values by the clock span that each begins in, as :func:`sums` adds them up.

    NaN do not count; the mean of a span with only NaN is NaN.
    """
    count = sums(~np.isnan(values), seconds, span_s)
    total = sums(np.nan_to_num(values), seconds, span_s)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


COMBINE = {"runoff": sums, "level": means}
"""How to combine the values of a span, by the names of :attr:`RoofRecord.measured`.

Amounts add up. Levels do not: their sum would depend on the length of gaps in the span.
"""


def prolonged(steps: Steps, count: int) -> Steps:
    """Return which steps are marked, or follow a marked step by less than ``count``."""
    return np.asarray(np.convolve(steps, np.ones(count), "full")[: len(steps)] > 0)


def storms(record: RoofRecord) -> list[slice]:
    """Return the steps of each storm, from its first rain to a day after its last.

    Storms are separated by six hours without rain, and at least one step. One ends where the next
    begins.
    """
    wet = np.flatnonzero(record.rain > 0)
    gap_steps = max(1.0, _STORM_GAP_S / record.step_s)
    firsts = wet[np.diff(wet, prepend=-np.inf) > gap_steps].tolist()
    lasts = wet[np.diff(wet, append=np.inf) > gap_steps].tolist()
    after = 1 + math.ceil(_AFTER_S / record.step_s)
    return [
        slice(first, min(last + after, following))
        for first, last, following in zip(firsts, lasts, [*firsts[1:], record.steps], strict=False)
    ]


def outages(record: RoofRecord) -> list[slice]:
    """Return the steps of each outage of a meter of water, until the roof has forgotten it.

    A storm may have come in them. Its water is gone after about a week, and not before 20 mm could
    evaporate. Outages of at most an hour count only if it rained in the hours next to them.
    """
    lost = gaps(np.isnan(record.rain) | np.isnan(record.pumped))
    evaporated = np.concatenate(([0.0], np.cumsum(record.reference)))
    week, hour = (math.ceil(time / record.step_s) for time in (_FORGOTTEN_S, HOUR_S))
    found = []
    for first, end in lost:
        near = np.nansum(record.rain[max(0, first - hour):end + hour])
        if (end - first) * record.step_s <= HOUR_S and near <= _RAINED_MM:
            continue
        dried = int(np.searchsorted(evaporated, evaporated[end] + _FORGOTTEN_MM))
        found.append(slice(first, min(max(end + week, dried), record.steps)))
    return found


def comparable(record: RoofRecord) -> Steps:
    """Return the steps in which a simulation is compared: known steps outside of broken storms.

    A storm is broken if rain, pumped water or runoff is missing in it. Unrecorded water affects the
    roof for the whole storm. And meters fail when runoff is largest; their values before and after
    the gap can then be incomplete, for an unknown time. Nor do steps count until a roof has
    forgotten the water of an outage (:func:`outages`).
    """
    steps = record.complete
    for outage in outages(record):
        steps[outage] = False
    missing = np.isnan(record.rain) | np.isnan(record.pumped)
    if record.runoff is not None:
        missing |= np.isnan(record.runoff)
    for storm in storms(record):
        if missing[storm].any():
            steps[storm] = False
    return steps


def halve(record: RoofRecord, steps: Steps) -> dict[str, Steps]:
    """Split steps on the first dry day after half of all rain and pumped water.

    Only water tells something about a roof: with halves of equal time, one could have all storms. A
    storm in both halves would make the validation depend on data of the fit. Without a dry day all
    steps are in the earlier half.

    Args:
        record: its rain and pumped water.
        steps: that count.

    Returns:
        The steps of each half by its purpose: ``fit``, the earlier half, and ``validation``.
    """
    total = np.cumsum(np.where(steps, record.water, 0.0))
    dry = ~prolonged(record.water > 0, math.ceil(_AFTER_S / record.step_s))
    later = np.cumsum((total >= total[-1] / 2) & dry) > 0
    return {"fit": steps & ~later, "validation": steps & later}


def in_months(record: RoofRecord, span: str | None) -> Steps:
    """Return which steps begin in a span of months, by the record's own clock; None means all.

    A span is such as ``4-10``, or ``11-3`` over new year, ends included.

    Raises:
        ConfigurationError: no step does, or the text is not a span.
    """
    if span is None:
        return np.full(record.steps, True)
    match = re.fullmatch(r"(\d{1,2})-(\d{1,2})", span)
    first, last = map(int, match.groups()) if match else (0, 0)
    if not (1 <= first <= 12 and 1 <= last <= 12):
        raise ConfigurationError(
            "must be the first and the last month that count, such as 4-10, or 11-3 over new year",
            key="--months", value=span,
        )
    number = record.times.astype("datetime64[M]").astype(np.int64) % 12 + 1
    within = (number - first) % 12 <= (last - first) % 12
    if not within.any():
        raise ConfigurationError(
            f"has no row in the months {span} of --months: it is from "
            f"{str(record.times[0])[:10]} to {str(record.times[-1])[:10]}", file=record.source,
        )
    return within
