"""The past of a value for its chart: least, greatest and last value of short stretches of time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]
Values = NDArray[np.float64]

# Length of a stretch (ns), short enough for 400 points in 12 h; how many are kept: a week.
STRETCH_NS = 20_000_000_000
KEPT = 7 * 24 * 3600 * 1_000_000_000 // STRETCH_NS
# The most gaps that are kept.
_MOST_UNKNOWN = 1000


class History:
    """One value over the past week, in stretches of 20 s; its memory is bounded."""

    def __init__(self) -> None:
        """Start without values."""
        self._times: Stamps = np.empty(0, dtype=np.int64)
        self._rows: Values = np.empty((0, 3))

    @property
    def begin(self) -> int | None:
        """Time of the oldest row (ns); None without values."""
        return int(self._times[0]) if len(self._times) else None

    def add(self, times: Stamps, values: Values) -> None:
        """Take finite values in the order of time, none older than those already there.

        Args:
            times: since 1970 (ns), shape (n,).
            values: shape (n,).
        """
        if not len(times):
            return
        ends, rows = _condensed(times, np.column_stack((values, values, values)), STRETCH_NS)
        if len(self._times) and self._times[-1] // STRETCH_NS == times[0] // STRETCH_NS:
            low, high, _ = self._rows[-1]
            self._rows[-1] = min(rows[0, 0], low), max(rows[0, 1], high), rows[0, 2]
            self._times[-1] = ends[0]
            ends, rows = ends[1:], rows[1:]
        if len(ends):
            self._times = np.concatenate((self._times, ends))[-KEPT:]
            self._rows = np.concatenate((self._rows, rows))[-KEPT:]

    def window(self, first: int, last: int, points: int) -> list[list[float]]:
        """Return the values from ``first`` to ``last`` (both included).

        Args:
            first: begin (ns).
            last: end (ns).
            points: about how many rows there are at most.

        Returns:
            Rows of the time of the last value (s), the least, the greatest, and the last value.
        """
        place = slice(*np.searchsorted(self._times, (first, last + 1)))
        times, rows = self._times[place], self._rows[place]
        if not len(times):
            return []
        # Whole stretches, which begin at the same times in each call: a line that is redrawn does
        # not jitter.
        ends, rows = _condensed(times, rows, stretch_of(first, last, points))
        condensed: list[list[float]] = np.column_stack((ends / 1e9, rows)).tolist()
        return condensed


class Gaps:
    """When a value was not known, although its topic went on with another value in its place.

    Attributes:
        lasts: whether the value is not known now.
    """

    def __init__(self) -> None:
        """Start without gaps."""
        self.lasts = False
        self._known_at = math.inf  # when it was known last (s)
        self._times: list[tuple[float, float]] = []

    def say(self, now: float, *, known: bool) -> None:
        """Note whether the value is known now.

        Args:
            now: s.
            known: whether it is. A gap begins when the value was last noted as known.
        """
        if known:
            self._known_at = now
        if known == self.lasts:
            self.lasts = not known
            if known:
                self._times[-1] = self._times[-1][0], now
            else:
                self.add(min(now, self._known_at), math.inf)

    def add(self, begin: float, end: float) -> None:
        """Note that the value was not known from one time to another (s)."""
        self._times = [*self._times[1 - _MOST_UNKNOWN:], (begin, end)]

    def at(self, times: Values) -> NDArray[np.bool_]:
        """Return for each of these times (s) whether the value was not known."""
        unknown = np.zeros(len(times), dtype=bool)
        for begin, end in self._times:
            unknown |= (times > begin) & (times < end)
        return unknown

    def cut_out(self, rows: list[list[float]]) -> list[list[Any]]:
        """Return the rows of a window without the gaps; a row of None marks where a gap begins."""
        if not rows or not self._times:
            return rows
        unknown = self.at(np.array([row[0] for row in rows]))
        kept: list[list[Any]] = [row for row, cut in zip(rows, unknown, strict=True) if not cut]
        # A gap that began by the system's clock, before the run's was known, is left out.
        times = ((begin, end) for begin, end in self._times if begin < end and end > rows[0][0])
        kept += [[begin, None, None, None] for begin, _ in times]
        return sorted(kept, key=lambda row: float(row[0]))


def _condensed(times: Stamps, rows: Values, stretch_ns: int) -> tuple[Stamps, Values]:
    """Return the last time of each stretch of time, and its least, greatest and last value."""
    begins = np.flatnonzero(np.diff(times // stretch_ns, prepend=-1))
    lasts = np.append(begins[1:], len(times)) - 1
    low, high = np.minimum.reduceat(rows[:, 0], begins), np.maximum.reduceat(rows[:, 1], begins)
    return times[lasts], np.column_stack((low, high, rows[lasts, 2]))


def stretch_of(first: int, last: int, points: int) -> int:
    """Return the time that a row of such a window covers (ns)."""
    return STRETCH_NS * max(1, -(-(last - first) // (STRETCH_NS * points)))
