"""Rows at a regular step, as loggers write them."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.formats.cells import Table

CLOCK_ERROR = 0.1
"""A row further than this from whole steps (share of a step) is off."""
# At most this share of rows may be off: a clock that is set each week makes two in a thousand.
_MAX_OFF = 0.01
_HOUR_S = 3600.0


def find_steps(
    read: Callable[[], Table], column: str, since: NDArray[np.float64]
) -> tuple[NDArray[np.int64], float]:
    """Return the step of each row, counted from the first row, and the duration of steps (s).

    The duration is the median spacing of the rows; if they are no whole number of such steps apart,
    the minimum; of a single row an hour. A row belongs to the step that begins nearest to its time,
    at most half a step away, so errors of a clock do not add up. Two rows can then belong to one
    step.

    Args:
        read: reads the file, for messages.
        column: its column of times.
        since: times of the rows since the first (s), each later than the one before.

    Raises:
        ConfigurationError: more than one spacing in a hundred is not a whole number of steps.
    """
    spacing = np.diff(since)
    if not spacing.size:
        return np.zeros(1, dtype=np.int64), _HOUR_S
    step_s = float(np.median(spacing))
    off = _find_off(spacing, step_s)
    if len(off) > _MAX_OFF * len(spacing) and not _find_off(spacing, float(spacing.min())).size:
        step_s, off = float(spacing.min()), off[:0]
    if len(off) > _MAX_OFF * len(spacing):
        table = read()  # again, for the row's line and text
        row = next(itertools.islice(table.rows, int(off[0]) + 1, None))
        raise table.refuse(
            f"must be {step_s:g} s after the row before, or a whole number of such steps, not "
            f"{spacing[off[0]]:g} s; {len(off)} of {len(since)} rows are like this, too many for a "
            "clock that was set: write rows at a regular step", column, row,
        )
    return np.floor(since / step_s + 0.5).astype(np.int64), step_s


def _find_off(spacing: NDArray[np.float64], step_s: float) -> NDArray[np.intp]:
    """Return which spacings are not a whole number of steps."""
    counts = np.maximum(1.0, np.round(spacing / step_s))
    return np.flatnonzero(np.abs(spacing / step_s - counts) > CLOCK_ERROR)
