"""Lines of the charts: the past week in 20 s stretches, with its file, and what is ahead, in steps.

An unknown value is NaN; the line has a gap from this value to the next known value.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.files import replace_file
from greenroof_ros.base.processes import LockedError, lock_file
from greenroof_ros.base.standard_error import print_line
from greenroof_ros.site.horizon import MAX_MEMBERS, Array

# Length of a stretch (ns), short enough for 400 points in 12 h; how many are kept, of a week (s).
STRETCH_NS, WEEK_S = 20_000_000_000, 7 * 24 * 3600
MAX_STRETCHES = WEEK_S * 1_000_000_000 // STRETCH_NS + 2  # with those that are cut

# The fields of a stretch: when its last value arrived (ns since 1970), its lowest, highest and
# last value.
ROW = np.dtype([("ended", "<i8"), ("low", "<f8"), ("high", "<f8"), ("last", "<f8")])
END_S = 1e-3
"""Time (s) between two points of a line at the same time, or from a point to the line's end."""

AHEAD_S = 12 * 3600.0
"""Length of the future that is shown (s)."""

# A smaller flow is a rounding error of the solver (m3/s): 6 mL/min.
_PUMPS = 1e-7
# Maximum number of steps of a forecast or a plan, which is that of the longest look-ahead, and the
# greatest number in either, in any unit.
_MAX_STEPS, _MAX_VALUE = 1000, 1e9


class History:
    """History of one value over the past week, in bounded memory."""

    def __init__(self, rows: NDArray[np.void] | None = None) -> None:
        """Start with the rows of an earlier history, or with none; the oldest row is the first."""
        self.rows = np.empty(0, ROW) if rows is None else rows

    def value_at(self, time_ns: int) -> float:
        """Return the last value at a time (ns since 1970); 0 if there was none yet."""
        number = int(np.searchsorted(self.rows["ended"], time_ns, "right"))
        return float(self.rows["last"][number - 1]) if number else 0.0

    def add(self, time_ns: int, value: float) -> None:
        """Add a value; if the clock was set back, later values are removed.

        Args:
            time_ns: time of the value (ns since 1970).
            value: the value; NaN if the value is unknown from this time on.
        """
        while len(self.rows) and self.rows["ended"][-1] > time_ns:
            self.rows = self.rows[:-1]
        row = self.rows[-1] if len(self.rows) else None
        if row is not None and row["ended"] // STRETCH_NS == time_ns // STRETCH_NS:
            row["low"], row["high"] = np.fmin(row["low"], value), np.fmax(row["high"], value)
            row["ended"], row["last"] = time_ns, value
        else:
            new = np.array([(time_ns, value, value, value)], ROW)
            self.rows = np.append(self.rows, new)[-MAX_STRETCHES:]

    def line(self, first: int, last: int, stretch_ns: int, gap_s: float) -> list[list[Any]]:
        """Return the line of the values from ``first`` to ``last``, inclusive.

        Every stretch has a point for its lowest, highest and last value, if they differ; so no
        short run of a pump is lost.

        Args:
            first: beginning (ns).
            last: end (ns).
            stretch_ns: time that each stretch of the line covers (ns), a multiple of 20 s.
            gap_s: longest time between two points that belong together (s).

        Returns:
            Points, each with a time (s) and a value, or None from where the value is unknown.
        """
        rows = self.rows
        rows = rows[slice(*np.searchsorted(rows["ended"], (first, last + 1)))]
        points: list[list[Any]] = []
        # Whole stretches, which begin at the same times in every call, so a redrawn line does not
        # jitter.
        begins = np.flatnonzero(np.diff(rows["ended"] // stretch_ns, prepend=-1))
        for begin, end in pairwise([*begins, len(rows)]):
            stretch = rows[begin:end]
            at, value = float(stretch["ended"][-1]) / 1e9, float(stretch["last"][-1])
            if points and points[-1][1] is not None and at - points[-1][0] > gap_s:
                points.append([points[-1][0] + END_S, None])
            low = float(np.fmin.reduce(stretch["low"]))
            high = float(np.fmax.reduce(stretch["high"]))
            if low < high:
                points += [[at - 2 * END_S, low], [at - END_S, high]]
            points.append([at, value if math.isfinite(value) else None])
        return points


# --- what is ahead -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Steps:
    """A forecast or a plan.

    Attributes:
        at: beginning of the first step (s since 1970).
        ends: ends of the steps (s since 1970), shape (steps,).
        values: of a forecast, the rain rate of each member (m/s), shape (members, steps); of a
            plan, the mean flow (m3/s) and the level at the end (m), shape (2, steps).
    """

    at: float
    ends: Array
    values: Array

    @property
    def begins(self) -> Array:
        """Beginnings of the steps (s since 1970), shape (steps,)."""
        return np.append(self.at, self.ends[:-1])

    def lengths(self, now: float) -> Array:
        """Return the part of each step that is between now and 12 h ahead (s), shape (steps,)."""
        until = now + AHEAD_S
        return np.clip(self.ends, now, until) - np.clip(self.begins, now, until)

    def reach(self, now: float) -> float:
        """Return how much of the next 12 h is covered (s)."""
        return min(float(self.ends[-1]) - now, AHEAD_S)

    def line(self, values: Array, now: float, until: float) -> list[list[float]]:
        """Return the line of values that each hold for a step, from now until a time."""
        begins, ends = (np.clip(times, now, until) for times in (self.begins, self.ends))
        seen = ends > begins
        points = [*zip(begins[seen], values[seen], strict=True),
                  *zip(ends[seen][-1:], values[seen][-1:], strict=True)]
        return [[float(at), float(value)] for at, value in points]

    def pumped(self, now: float) -> tuple[float, float, float] | None:
        """Return what a plan pumps in the next 12 h; None if it pumps nothing.

        Returns:
            The volume (m3), the time at which pumping begins (s since 1970), and the highest level
            that is expected at the end of a step with pumping (m).
        """
        (flow, level), lengths = self.values, self.lengths(now)
        pumps = np.flatnonzero((flow > _PUMPS) & (lengths > 0))
        if not len(pumps):
            return None
        begin = max(now, float(self.begins[pumps[0]]))
        return float(flow @ lengths), begin, float(level[pumps].max())


def read_steps(at: float, ends: Any, values: Any) -> Steps | None:
    """Return a forecast or a plan; None if a value is impossible.

    Args:
        at: beginning of the first step (s since 1970).
        ends: ends of the steps (s after ``at``).
        values: see :class:`Steps`; one row needs no second dimension.
    """
    ends, values = np.asarray(ends, np.float64), np.atleast_2d(np.asarray(values, np.float64))
    if (
        values.shape[1:] != ends.shape or not 0 < len(values) <= MAX_MEMBERS
        or not 0 < len(ends) <= _MAX_STEPS or not np.all(np.diff(ends, prepend=0.0) > 0)
        or not np.all((values >= 0) & (values <= _MAX_VALUE)) or ends[-1] > _MAX_VALUE
    ):
        return None
    return Steps(at, at + ends, values)


# --- the file -------------------------------------------------------------------------------------


def write_histories(file: Path, rows: Mapping[str, NDArray[np.void]]) -> None:
    """Write the rows of histories to a file, replacing the file as a whole; print a failure.

    Args:
        file: NumPy file (``.npz``); its directory is created if necessary.
        rows: rows of each history, by the name of the history.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        # If another watcher is just writing the file, its rows are as good.
        with suppress(LockedError), lock_file(file.with_suffix(".lock")):
            replace_file(file, lambda stream: np.savez(stream, **rows))  # type: ignore[arg-type]
    except OSError as error:
        print_line(f"the history cannot be saved: {file}: {error.strerror or error}")


def read_last_seen(file: Path) -> float | None:
    """Return the time of a file's newest value (s since 1970); None if not in the past week."""
    rows = [each.rows for each in read_histories(file).values() if len(each.rows)]
    last = max((float(each["ended"][-1]) / 1e9 for each in rows), default=0.0)
    return last if time.time() - last < WEEK_S else None


def read_histories(file: Path) -> dict[str, History]:
    """Return the histories in a file; print why if the file cannot be read or is damaged."""
    rows: dict[str, NDArray[np.void]] = {}
    try:
        with np.load(file, allow_pickle=False) as content:
            rows = {name: content[name] for name in content if content[name].dtype == ROW}
        if not all(each.ndim == 1 and np.all(np.diff(each["ended"]) > 0) for each in rows.values()):
            raise ValueError("its values are not plausible")
    except FileNotFoundError:
        pass
    except Exception as error:  # NumPy's errors depend on what the file contains
        print_line(f"the charts start empty: {file} cannot be read ({error})")
        rows = {}
    return {name: History(each) for name, each in rows.items()}
