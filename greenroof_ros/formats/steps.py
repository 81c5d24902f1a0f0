"""The regular time step of a logger's rows, and the rows at which this step changes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.formats.cells import Table
from greenroof_ros.formats.hourly import find_gaps

Values = NDArray[np.float64]

CLOCK_ERROR = 0.1
"""maximum deviation of a row's time from a whole number of steps (share of a step)"""
# At most this share of rows may be off: a clock that is set every week makes two in a thousand.
_MAX_OFF = 0.01
# Single rows may be further off their times than that, if they are no more than this share.
_MAX_JITTER = 0.3
# A step that is as near to one of these (s) as clocks are accurate is that one.
_USUAL_S = np.array([
    *(1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0),
    *(60.0 * minutes for minutes in (1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30)),
    *(3600.0 * hours for hours in (1, 2, 3, 4, 6, 8, 12, 24)),
])
_NEAR_USUAL = 2e-3
# The step has changed where this many spacings are alike, and unlike the others. Fewer are gaps.
_MIN_ALIKE, _UNLIKE = 6, 0.2
_HOUR_S = 3600.0


class RowSteps(NamedTuple):
    """The start and duration of the rows of a file."""

    steps: NDArray[np.int64]
    """index of every row's step, from 0, shape (rows,); two rows can have the same step"""
    step_s: float
    """duration of a step (s), the largest common divisor of all intervals between rows"""
    durations: Values
    """duration of every row (s), shape (rows,)"""
    late: float = 0.0
    """delay of the first row relative to step 0, because of an irregular clock (s)"""
    ended: bool = False
    """whether the original time stamps were the ends of the rows"""
    clock_error: float = CLOCK_ERROR
    """maximum deviation of a row's time from its step (share of a step)"""

    @property
    def changes(self) -> list[int]:
        """Indices of the rows at which the duration changes."""
        return [int(row) + 1 for row in np.flatnonzero(np.diff(self.durations))]


def find_steps(read: Callable[[], Table], column: str, since: Values) -> RowSteps:
    """Return the time steps of rows; a single row has a duration of one hour.

    The step is the median interval between rows. If the intervals are not multiples of the median,
    the step is the minimum interval. A row belongs to the step that begins closest to its time, at
    most half a step away, so that clock errors do not accumulate. If at least six consecutive
    intervals are equal but differ from the median, the step has changed.

    Args:
        read: function that reads the file again, for error messages.
        column: name of the column that contains the times.
        since: times of the rows, relative to the first row, in ascending order (s).

    Raises:
        ConfigurationError: if more than 1 % of the intervals are not a whole number of steps.
    """
    spacing = np.diff(since)
    if not spacing.size:
        return RowSteps(np.zeros(1, dtype=np.int64), _HOUR_S, np.array([_HOUR_S]))
    usual = _find_usual(spacing)
    values = np.unique(usual)
    step_s = float(values[0])
    if len(values) > 1:
        step_s = float(math.gcd(*(round(value) for value in values)))
    durations = np.append(usual, usual[-1])
    off = _find_off(spacing, step_s)
    if len(off) <= _MAX_OFF * len(spacing):
        return RowSteps(np.floor(since / step_s + 0.5).astype(np.int64), step_s, durations)
    late = 0.0
    for _ in range(2):
        steps = np.floor((since + late) / step_s + 0.5)
        late -= float(np.median(since + late - steps * step_s))
    jitter = np.abs(since + late - steps * step_s)
    if np.count_nonzero(jitter > _MAX_JITTER * step_s) <= _MAX_OFF * len(since):
        return RowSteps(
            (steps - steps[0]).astype(np.int64), step_s, durations, late, clock_error=_MAX_JITTER,
        )
    minimum_s = float(spacing.min())
    if not _find_off(spacing, minimum_s).size:
        steps = np.floor(since / minimum_s + 0.5)
        return RowSteps(steps.astype(np.int64), minimum_s, np.full(len(since), minimum_s))
    table = read()  # again, for the row's line and text
    row = next(itertools.islice(table.rows, int(off[0]) + 1, None))
    raise table.refuse(
        f"must be {step_s:g} s after the previous row, or a multiple of this step, not "
        f"{spacing[off[0]]:g} s; {len(off)} of {len(since)} rows are irregular, which are too many "
        "to be adjustments of a clock: write rows at a regular time step", column, row,
    )


def _find_usual(spacing: Values) -> Values:
    """Return the usual step (s) in the neighborhood of every interval."""
    usual = np.full(len(spacing), _round_step(spacing, float(np.median(spacing))))
    median = float(usual[0])
    alike = np.abs(np.diff(np.log(spacing))) < CLOCK_ERROR
    for low, high in find_gaps(alike):
        step_s = float(np.median(spacing[low : high + 1]))
        if high + 1 - low >= _MIN_ALIKE and abs(step_s / median - 1) > _UNLIKE:
            usual[low : high + 1] = _round_step(spacing[low : high + 1], step_s)
    return usual


def _round_step(spacing: Values, step_s: float) -> float:
    """Return a common step if the mean interval agrees with it within the accuracy of clocks."""
    near = spacing[np.abs(spacing / step_s - 1) < 0.5]
    if not near.size:
        return step_s
    usual = float(_USUAL_S[np.argmin(np.abs(_USUAL_S / near.mean() - 1))])
    return usual if abs(near.mean() / usual - 1) < _NEAR_USUAL else step_s


def _find_off(spacing: Values, step_s: float) -> NDArray[np.intp]:
    """Return the indices of the intervals that are not a whole number of steps."""
    counts = np.maximum(1.0, np.round(spacing / step_s))
    return np.flatnonzero(np.abs(spacing / step_s - counts) > CLOCK_ERROR)
