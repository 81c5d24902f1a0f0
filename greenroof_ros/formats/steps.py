"""Rows at a regular step, as loggers write them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.formats.records import Table

# A row further than this from whole steps (share of a step) is off; at most this share of rows may
# be: a clock that is set each week makes two in a thousand.
_LOOSENESS, _MOST_OFF = 0.1, 0.01


def steps_of_rows(table: Table, times: Sequence[datetime]) -> tuple[NDArray[np.int64], float]:
    """Return the step of each row, counted from the first row, and the duration of steps (s).

    The duration is the median spacing of the rows. A row belongs to the step that begins nearest to
    its time, at most half a step away, so errors of a clock do not add up. Two rows can then belong
    to one step.

    Args:
        table: for messages.
        times: of its rows, each later than the one before.

    Raises:
        ConfigurationError: more than one spacing in a hundred is not a whole number of steps.
    """
    since = np.array([time.timestamp() for time in times]) - times[0].timestamp()
    spacing = np.diff(since)
    step_s = float(np.median(spacing))
    counts = np.maximum(1.0, np.round(spacing / step_s))
    off = np.flatnonzero(np.abs(spacing / step_s - counts) > _LOOSENESS)
    if len(off) > _MOST_OFF * len(spacing):
        raise table.refuse(
            f"must be {step_s:g} s after the row before, or a whole number of such steps, not "
            f"{spacing[off[0]]:g} s; {len(off)} of {len(times)} rows are like this, too many for a "
            "clock that was set: write rows at a regular step", "time", int(off[0]) + 1,
        )
    return np.floor(since / step_s + 0.5).astype(np.int64), step_s
