"""Measurements of a roof or of weather at regular time steps, and the storms in them."""

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
    """Measurements in time steps of equal length; NaN for missing measurements.

    The time of a step is its start. Depths (mm) are averages over the roof's area, and totals for
    the whole step.

    Attributes:
        source: the file or bag that contains the measurements.
        start: start of the first step, with a UTC offset.
        step_s: duration of a step (s).
        rain: rain (mm), shape (steps,).
        reference: evapotranspiration of the FAO-56 reference grass (mm); never NaN.
        pumped: water pumped onto the roof (mm).
        runoff: runoff from the roof (mm); None if it was not measured.
        level: water level in the substrate at the start of the step (m); None if it was not
            measured.
        last_decimal: resolution of the runoff's last decimal place (mm); 0 if the runoff was not
            rounded.
        reference_column: column of the file that contains the evapotranspiration; empty if it was
            computed.
        notes: sentences about data that could not be used unchanged.
        contents: lines that show what the record contains; see
            :mod:`greenroof_ros.weather.summary`.
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
    reference_column: str = ""
    notes: tuple[str, ...] = ()
    contents: tuple[str, ...] = ()

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
        """Start of every step on the record's own clock (s since 1970-01-01 on that clock)."""
        first = round(self.start.timestamp() + self.offset_s)
        return first + np.round(self.step_s * np.arange(self.steps)).astype(np.int64)

    @property
    def times(self) -> NDArray[np.datetime64]:
        """Start of every step on the record's own clock."""
        return self.seconds.astype("datetime64[s]")

    def time(self, step: int) -> str:
        """Return the start of a step as text; for a step beyond the last, that of the last step."""
        return str(self.times[min(step, self.steps - 1)]).replace("T", " ")

    @property
    def water(self) -> Values:
        """Sum of the rain and the pumped water on the roof (mm); unknown amounts count as 0."""
        return np.asarray(np.nan_to_num(self.rain) + np.nan_to_num(self.pumped))

    @property
    def measured(self) -> dict[str, Values]:
        """Measured series for comparison with a simulation: ``runoff`` (mm) and ``level`` (m)."""
        columns = {"runoff": self.runoff, "level": self.level}
        return {name: series for name, series in columns.items() if series is not None}

    def select(self, steps: Steps) -> StepRecord:
        """Return the record with NaN for rain, runoff and level outside the given steps."""
        series = {"rain": self.rain, **self.measured}
        there = {name: np.where(steps, values, np.nan) for name, values in series.items()}
        return replace(self, **there)  # type: ignore[arg-type]

    @property
    def complete(self) -> Steps:
        """Steps with no missing measurement in the step itself or in its two neighbors.

        The measurements are rain, pumped water and :attr:`measured`. A sensor that fails in one
        step has often recorded only part of the neighboring step.
        """
        series = [self.rain, self.pumped, *self.measured.values()]
        missing = np.isnan(series).any(axis=0)
        near = np.convolve(missing, np.ones(3), "same") > 0
        return np.asarray(~near)


def name_time(seconds: float) -> str:
    """Return the name of a duration in whole seconds: ``5 min``, ``1 h``, ``1 day``, ``2 days``."""
    whole = round(seconds)
    units = {"day": DAY_S, "h": HOUR_S, "min": 60, "s": 1}
    unit = next(unit for unit, size in units.items() if whole % size == 0)
    count = whole // units[unit]
    return f"{count} {'days' if unit == 'day' and count > 1 else unit}"


def prolong_steps(steps: Steps, count: int) -> Steps:
    """Return a mask of the marked steps and of the ``count`` - 1 steps after each of them."""
    return np.asarray(np.convolve(steps, np.ones(count), "full")[: len(steps)] > 0)


def find_storms(record: StepRecord) -> list[slice]:
    """Return the steps of every storm, from its first rain to one day after its last rain.

    Storms are separated by at least six hours, and at least one step, without rain. A storm ends at
    the latest when the next storm begins.
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
