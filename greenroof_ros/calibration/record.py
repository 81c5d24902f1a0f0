"""What was measured on a roof, step by step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Record:
    """Steps of equal length, each beginning at its time; NaN where something was not measured.

    Depths (mm) are over the roof, and of the whole step.

    Attributes:
        source: the file or bag.
        start: of the first step, with its offset from UTC.
        step_s: duration of a step (s).
        rain: mm, shape (steps,).
        reference: evapotranspiration of FAO-56's reference grass (mm); never NaN.
        pumped: onto the roof (mm).
        runoff: off the roof (mm); None where it was not measured.
        level: water in the substrate at the beginning of the step (m); None likewise.
        last_decimal: what 1 in the last decimal place of the runoff is (mm); 0 where it was not
            rounded.
        cistern: level of the cistern at the beginning of the step (m); None where not measured.
        command: mean share of the pumps' maximum flow (1); None where not known.
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

    @property
    def steps(self) -> int:
        """How many there are."""
        return len(self.rain)

    @property
    def seconds(self) -> NDArray[np.int64]:
        """Start of each step on the record's own clock, in seconds since 1970-01-01 there."""
        offset = self.start.utcoffset()
        assert offset is not None
        first = round(self.start.timestamp() + offset.total_seconds())
        return first + np.round(self.step_s * np.arange(self.steps)).astype(np.int64)

    @property
    def times(self) -> NDArray[np.datetime64]:
        """Start of each step on the record's own clock."""
        return self.seconds.astype("datetime64[s]")

    @property
    def measured(self) -> dict[str, Values]:
        """What a simulation is compared with, by name: ``runoff`` (mm) and ``level`` (m)."""
        both = {"runoff": self.runoff, "level": self.level}
        return {name: series for name, series in both.items() if series is not None}

    def only(self, steps: NDArray[np.bool_]) -> Record:
        """Return the record with nothing measured outside of some steps: NaN is there instead."""
        def there(series: Values) -> Values:
            return np.where(steps, series, np.nan)

        return replace(
            self, rain=there(self.rain),
            runoff=None if self.runoff is None else there(self.runoff),
            level=None if self.level is None else there(self.level),
        )

    @property
    def known(self) -> NDArray[np.bool_]:
        """Steps whose water and all of whose :attr:`measured` are there, before and after, too.

        A sensor that failed in a step has often seen but a part of the step beside it.
        """
        series = (self.rain, self.pumped, *self.measured.values())
        missing = np.any([np.isnan(one) for one in series], axis=0)
        beside = np.convolve(missing, np.ones(3), "same") > 0
        return np.asarray(~beside)


def sums(values: Values, seconds: NDArray[np.int64], over_s: int) -> Values:
    """Add up values by the spans of the clock that they begin in, of ``over_s`` seconds each.

    Spans in which there is no value are left out.
    """
    _, index = np.unique(seconds // over_s, return_inverse=True)
    return np.bincount(index, values).astype(np.float64)


def means(values: Values, seconds: NDArray[np.int64], over_s: int) -> Values:
    """Average values by the spans of the clock that they begin in, as :func:`sums` adds them up."""
    return sums(values, seconds, over_s) / sums(np.ones(len(values)), seconds, over_s)


TOGETHER = {"runoff": sums, "level": means}
"""What the values of a span are together, by the names of :attr:`Record.measured`.

Amounts add up. Levels do not: of a span with gaps their sum would tell how long the gaps are.
"""
