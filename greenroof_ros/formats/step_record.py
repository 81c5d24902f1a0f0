"""Measurements step by step: of a roof, or of weather alone, and the storms in them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
Steps = NDArray[np.bool_]
HOUR_S, DAY_S = 3600, 86400

# The minimum time between two storms, and how long a roof responds after rain (s).
_STORM_GAP_S, AFTER_STORM_S = 6 * HOUR_S, DAY_S


@dataclass(frozen=True)
class StepRecord:
    """Steps of equal length, each beginning at its time, with NaN for missing measurements.

    Depths (mm) are averages over the roof's area, and totals for the whole step.

    Attributes:
        source: the file or bag.
        start: time of the first step, with its offset from UTC.
        step_s: duration of a step (s).
        rain: rain (mm), shape (steps,).
        reference: evapotranspiration of FAO-56's reference grass (mm); never NaN.
        pumped: water pumped onto the roof (mm).
        runoff: water that ran off the roof (mm); None if not measured.
        level: water level in the substrate at the beginning of the step (m); None if not measured.
        temperature: air temperature (degC); None if not measured.
        last_decimal: unit of the last decimal place of the runoff (mm); 0 if it was not rounded.
        cistern: level of the cistern at the beginning of the step (m); None if not measured.
        command: mean share of the pumps' maximum flow (1); None if unknown.
        reference_column: column of the evapotranspiration in the file; empty if it was computed.
        notes: what could not be used unchanged, in sentences.
        all_rain: rain including the steps that :meth:`select` left out; None before that.
        dew_point: dew point of the air (degC); None if not measured.
        radiation: solar radiation (W/m2); None if not measured.
        wind: wind speed (km/h); None if not measured.
    """

    source: Path
    start: datetime
    step_s: float
    rain: Values
    reference: Values
    pumped: Values
    runoff: Values | None
    level: Values | None
    temperature: Values | None = None
    last_decimal: float = 0.0
    cistern: Values | None = None
    command: Values | None = None
    reference_column: str = ""
    notes: tuple[str, ...] = ()
    all_rain: Values | None = None
    dew_point: Values | None = None
    radiation: Values | None = None
    wind: Values | None = None

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
        """Start of every step on the record's own clock, in seconds since 1970-01-01 there."""
        first = round(self.start.timestamp() + self.offset_s)
        return first + np.round(self.step_s * np.arange(self.steps)).astype(np.int64)

    @property
    def times(self) -> NDArray[np.datetime64]:
        """Start of every step on the record's own clock."""
        return self.seconds.astype("datetime64[s]")

    def time(self, step: int) -> str:
        """Return the start of a step as text; for a step after the last, the start of the last."""
        return str(self.times[min(step, self.steps - 1)]).replace("T", " ")

    @property
    def water(self) -> Values:
        """Rain and pumped water on the roof (mm); unknown amounts count as 0."""
        return np.asarray(np.nan_to_num(self.rain) + np.nan_to_num(self.pumped))

    @property
    def measured(self) -> dict[str, Values]:
        """The series to compare a simulation with, by name: ``runoff`` (mm) and ``level`` (m)."""
        columns = {"runoff": self.runoff, "level": self.level}
        return {name: series for name, series in columns.items() if series is not None}

    def select(self, steps: Steps) -> StepRecord:
        """Return the record with NaN for rain, runoff and level outside the given steps."""
        series = {"rain": self.rain, **self.measured}
        there = {name: np.where(steps, values, np.nan) for name, values in series.items()}
        return replace(self, all_rain=self.rain, **there)  # type: ignore[arg-type]

    @property
    def complete(self) -> Steps:
        """Steps with rain, pumped water and :attr:`measured`, and with all of them one step around.

        A sensor that failed in a step often recorded only part of the step next to it.
        """
        series = [self.rain, self.pumped, *self.measured.values()]
        missing = np.isnan(series).any(axis=0)
        near = np.convolve(missing, np.ones(3), "same") > 0
        return np.asarray(~near)


def name_time(seconds: float) -> str:
    """Name a time of whole seconds: ``5 min``, ``1 h``, ``1 day``, ``2 days``."""
    whole = round(seconds)
    units = {"day": DAY_S, "h": HOUR_S, "min": 60, "s": 1}
    unit = next(unit for unit, size in units.items() if whole % size == 0)
    count = whole // units[unit]
    return f"{count} {'days' if unit == 'day' and count > 1 else unit}"


def prolong_steps(steps: Steps, count: int) -> Steps:
    """Return which steps are marked, or follow a marked step by less than ``count``."""
    return np.asarray(np.convolve(steps, np.ones(count), "full")[: len(steps)] > 0)


def find_storms(record: StepRecord) -> list[slice]:
    """Return the steps of every storm, from its first rain to a day after its last.

    Storms are separated by six hours without rain, and by at least one step. A storm ends where the
    next one begins.
    """
    wet = np.flatnonzero(record.rain > 0)
    gap_steps = max(1.0, _STORM_GAP_S / record.step_s)
    firsts = wet[np.diff(wet, prepend=-np.inf) > gap_steps].tolist()
    lasts = wet[np.diff(wet, append=np.inf) > gap_steps].tolist()
    after = 1 + math.ceil(AFTER_STORM_S / record.step_s)
    return [
        slice(first, min(last + after, following))
        for first, last, following in zip(firsts, lasts, [*firsts[1:], record.steps], strict=False)
    ]
