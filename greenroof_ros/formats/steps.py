"""Rows at a regular step, as loggers write them, and the places where the step changes."""

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
"""A row that is further than this from a whole number of steps (share of a step) is off."""
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
    """When the rows of a file begin, and how long they last."""

    steps: NDArray[np.int64]
    """step of every row, counted from the first, shape (rows,); two rows can be in one step"""
    step_s: float
    """duration of a step (s), the largest of which all spacings of rows are multiples"""
    durations: Values
    """duration of every row (s), shape (rows,)"""
    late: float = 0.0
    """how much later than step 0 the first row is, because of an irregular clock (s)"""
    ended: bool = False
    """whether rows ended at their times"""
    clock_error: float = CLOCK_ERROR
    """how far from its step a row's time may be (share of a step)"""

    @property
    def changes(self) -> list[int]:
        """The first row of every later duration."""
        return [int(row) + 1 for row in np.flatnonzero(np.diff(self.durations))]


def find_steps(read: Callable[[], Table], column: str, since: Values) -> RowSteps:
    """Return the steps of rows; a single row lasts an hour.

    The step is the median spacing of the rows; if they are not a whole number of such steps apart,
    it is the minimum spacing. A row belongs to the step that begins nearest to its time, no more
    than half a step away, so errors of a clock do not add up. Where at least six spacings in
    succession are alike but differ from the median, the step has changed.

    Args:
        read: reads the file, for messages.
        column: column of times in the file.
        since: times of the rows since the first (s), each later than the previous one.

    Raises:
        ConfigurationError: if more than one spacing in a hundred is not a whole number of steps.
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
        f"must be {step_s:g} s after the previous row, or a whole number of such steps, not "
        f"{spacing[off[0]]:g} s; {len(off)} of {len(since)} rows are like this, which is too many "
        "for a clock that was merely set: write rows at a regular step", column, row,
    )


def _find_usual(spacing: Values) -> Values:
    """Return the step (s) that is usual around every spacing."""
    usual = np.full(len(spacing), _round_step(spacing, float(np.median(spacing))))
    median = float(usual[0])
    alike = np.abs(np.diff(np.log(spacing))) < CLOCK_ERROR
    for low, high in find_gaps(alike):
        step_s = float(np.median(spacing[low : high + 1]))
        if high + 1 - low >= _MIN_ALIKE and abs(step_s / median - 1) > _UNLIKE:
            usual[low : high + 1] = _round_step(spacing[low : high + 1], step_s)
    return usual


def _round_step(spacing: Values, step_s: float) -> float:
    """Return a usual step if the mean spacing is as near to one as clocks are accurate."""
    near = spacing[np.abs(spacing / step_s - 1) < 0.5]
    if not near.size:
        return step_s
    usual = float(_USUAL_S[np.argmin(np.abs(_USUAL_S / near.mean() - 1))])
    return usual if abs(near.mean() / usual - 1) < _NEAR_USUAL else step_s


def _find_off(spacing: Values, step_s: float) -> NDArray[np.intp]:
    """Return which spacings are not a whole number of steps."""
    counts = np.maximum(1.0, np.round(spacing / step_s))
    return np.flatnonzero(np.abs(spacing / step_s - counts) > CLOCK_ERROR)
