"""Which step each row of a file is of, though its logger's clock was set now and then."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Values
from greenroof_ros.calibration.scores import time_name
from greenroof_ros.common.errors import ConfigurationError

Slots = NDArray[np.int64]

# A roof's drainage is of hours; of longer sums nothing can be told that rain does not say alone.
_LONGEST_STEP_S = 86400.0
# Rows may be so much off a step (share of it) without being counted as off; and of those that are,
# so many may be there (share of the rows): a clock that is set each week has two in a thousand.
_LOOSENESS, _MOST_OFF = 0.1, 0.01


def steps_of_rows(
    file: Path, column: str, times: list[datetime], lines: list[int]
) -> tuple[Slots, float]:
    """Return the step that each row is of, counted from the first row, and its duration (s).

    The duration is the median of the rows' spacings. Each row is of the step that begins nearest to
    its time, half a step off at most: so a clock that was set moves no row that comes after. Two
    rows can be of one step then.

    Args:
        file: for messages.
        column: the same, of the times.
        times: of the rows.
        lines: of the rows in the file.

    Raises:
        ConfigurationError: a time is not later than the one before, the rows are more than a day
            apart, or more than one in a hundred is off a regular step.
    """
    since = np.array([time.timestamp() for time in times]) - times[0].timestamp()
    spacing = np.diff(since)

    def error(row: int, text: str) -> ConfigurationError:
        return ConfigurationError(
            text, file=file, line=lines[row], key=column, value=times[row].isoformat()
        )

    back = np.flatnonzero(spacing <= 0)
    if len(back):
        raise error(int(back[0]) + 1, "must be later than the time of the row before")
    step_s = float(np.median(spacing))
    if step_s > _LONGEST_STEP_S:
        raise error(
            1, f"the rows are {time_name(round(step_s))} apart; they must be a day apart at most"
        )
    counts = np.maximum(1.0, np.round(spacing / step_s))
    off = np.flatnonzero(np.abs(spacing / step_s - counts) > _LOOSENESS)
    if len(off) > _MOST_OFF * len(spacing):
        row = int(off[0]) + 1
        raise error(
            row,
            f"must be {step_s:g} s after the row before, or a whole number of such steps, not "
            f"{spacing[row - 1]:g} s; so are {len(off)} of {len(times)} rows, more than clocks "
            "that were set explain: write rows a regular step apart",
        )
    return np.floor(since / step_s + 0.5).astype(np.int64), step_s


def sums_of_steps(values: Values, slots: Slots) -> Values:
    """Add up the rows of each step; NaN where it has none, or one of them has no value."""
    total = np.bincount(slots, values).astype(np.float64)
    total[np.bincount(slots) == 0] = np.nan
    return total


def means_of_steps(values: Values, slots: Slots) -> Values:
    """Average the values that the rows of each step have; NaN where there is none."""
    there = ~np.isnan(values)
    steps = int(slots[-1]) + 1
    count = np.bincount(slots[there], minlength=steps)
    total = np.bincount(slots[there], values[there], minlength=steps)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
