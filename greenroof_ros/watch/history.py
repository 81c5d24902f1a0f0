"""The past of a value for its chart: minimum, maximum and last value of short stretches of time."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]
Values = NDArray[np.float64]

# Length of a stretch (ns), short enough for 400 points in 12 h; how many are kept: a week.
STRETCH_NS = 20_000_000_000
MOST_STRETCHES = 7 * 24 * 3600 * 1_000_000_000 // STRETCH_NS
# The most gaps that are kept, and the most values that are ahead of the past.
_MOST_UNKNOWN = _MOST_AHEAD = 1000


class History:
    """One value over the past week, in stretches of 20 s; its memory is bounded."""

    def __init__(self) -> None:
        """Start without values."""
        # Of each stretch: the time of its maximum change, and of its last value (ns); its minimum,
        # maximum and last value, and how great that change was.
        self._times: Stamps = np.empty((0, 2), dtype=np.int64)
        self._rows: Values = np.empty((0, 4))
        self._first: tuple[int, float] | None = None  # time (ns) and value
        self._ahead: deque[tuple[int, float]] = deque(maxlen=_MOST_AHEAD)

    @property
    def first_ns(self) -> int | None:
        """Time of the first value (ns); None without values."""
        return None if self._first is None else self._first[0]

    def add(self, times: Stamps, values: Values) -> None:
        """Add finite values in the order of time, none older than those already there.

        Args:
            times: since 1970 (ns), shape (n,).
            values: shape (n,).
        """
        if not len(times):
            return
        self._first = self._first or (int(times[0]), float(values[0]))
        while self._ahead and self._ahead[0][0] <= times[-1]:
            self._ahead.popleft()
        spans, rows = self._raw(times, values)
        goes_on = len(self._times) and self._times[-1, 1] // STRETCH_NS == times[0] // STRETCH_NS
        if goes_on:
            spans = np.concatenate((self._times[-1:], spans))
            rows = np.concatenate((self._rows[-1:], rows))
        spans, rows = _condensed(spans, rows, STRETCH_NS)
        if goes_on:
            self._times[-1], self._rows[-1] = spans[0], rows[0]
            spans, rows = spans[1:], rows[1:]
        if len(spans):
            self._times = np.concatenate((self._times, spans))[-MOST_STRETCHES:]
            self._rows = np.concatenate((self._rows, rows))[-MOST_STRETCHES:]

    def add_ahead(self, time_ns: int, value: float | None) -> None:
        """Add a value that is ahead of the others, until they have come up to it.

        Args:
            time_ns: later than all times before.
            value: None if it is not plausible: it is left out.
        """
        if value is not None:
            self._ahead.append((time_ns, value))

    def window(self, first: int, last: int, points: int, *, steps: bool) -> list[list[float]]:
        """Return the values from ``first`` to ``last`` (both included).

        Args:
            first: begin (ns).
            last: end (ns).
            points: about how many rows there are at most.
            steps: whether the value changes in steps, rather than slowly.

        Returns:
            Rows of a time (s), and the minimum, the maximum, and the last value of a stretch. It is
            the time of the last value; for steps, of the maximum change, and the last value before
            a stretch without values, or of all, has another row: a step is where it happened. The
            first value has a row of its own.
        """
        if self._first is None:
            return []
        times, rows = self._times, self._rows
        if self._ahead:
            spans, singles = self._raw(*map(np.array, zip(*self._ahead, strict=True)))
            times, rows = np.concatenate((times, spans)), np.concatenate((rows, singles))
        place = slice(*np.searchsorted(times[:, 1], (first, last + 1)))
        if place.start == place.stop:
            return []
        # Whole stretches, which begin at the same times in each call: a line that is redrawn does
        # not jitter.
        stretch = stretch_of(first, last, points)
        times, rows = _condensed(times[place], rows[place], stretch)
        changes, ends = times.T
        at = changes if steps else ends
        window: list[list[float]] = np.column_stack((at / 1e9, rows[:, :3])).tolist()
        for row in np.flatnonzero((np.diff(ends // stretch, append=2**62) > 1) & (at < ends)):
            window.append(_single(ends[row], rows[row, 2]))
        if first <= self._first[0] < at[0]:
            window.append(_single(*self._first))
        return sorted(window)

    def _raw(self, times: Stamps, values: Values) -> tuple[Stamps, Values]:
        """Return values that follow the others as stretches of their own."""
        before = self._rows[-1, 2] if len(self._rows) else values[0]
        changes = np.abs(np.diff(values, prepend=before))
        return np.column_stack((times, times)), np.column_stack((values, values, values, changes))


class Gaps:
    """When a value was unknown, although its topic went on with another value in its place.

    Attributes:
        is_unknown: whether the value is unknown now.
    """

    def __init__(self) -> None:
        """Start without gaps."""
        self.is_unknown = False
        self._known_at = math.inf  # when it was known last (s)
        self._times: list[tuple[float, float]] = []

    def update(self, now: float, *, known: bool) -> None:
        """Update whether the value is known now.

        Args:
            now: s.
            known: whether it is. A gap begins when the value was last known.
        """
        if known:
            self._known_at = now
        if known == self.is_unknown:
            self.is_unknown = not known
            if known:
                self._times[-1] = self._times[-1][0], now
            else:
                self.add(min(now, self._known_at), math.inf)

    def add(self, begin: float, end: float) -> None:
        """Add that the value was unknown from one time to another (s)."""
        self._times = [*self._times[1 - _MOST_UNKNOWN:], (begin, end)]

    def at(self, times: Values) -> NDArray[np.bool_]:
        """Return for each of these times (s) whether the value was unknown."""
        unknown = np.zeros(len(times), dtype=bool)
        for begin, end in self._times:
            unknown |= (times > begin) & (times < end)
        return unknown

    def cut_out(self, rows: list[list[float]]) -> list[list[Any]]:
        """Return the rows of a window without the gaps; a row of None marks where a gap begins."""
        if not rows or not self._times:
            return rows
        unknown = self.at(np.array([row[0] for row in rows]))
        known_rows: list[list[Any]] = [
            row for row, cut in zip(rows, unknown, strict=True) if not cut
        ]
        # A gap that began by the system's clock, before the run's was known, is left out.
        times = ((begin, end) for begin, end in self._times if begin < end and end > rows[0][0])
        known_rows += [[begin, None, None, None] for begin, _ in times]
        return sorted(known_rows, key=lambda row: float(row[0]))


def _single(time_ns: int, value: float) -> list[float]:
    """Return the row of a single value."""
    return [time_ns / 1e9, value, value, value]


def _condensed(times: Stamps, rows: Values, stretch_ns: int) -> tuple[Stamps, Values]:
    """Return times and rows of longer stretches; of equal changes, the first counts."""
    begins = np.flatnonzero(np.diff(times[:, 1] // stretch_ns, prepend=-1))
    is_unknown = np.append(begins[1:], len(times)) - 1
    low, high = np.minimum.reduceat(rows[:, 0], begins), np.maximum.reduceat(rows[:, 1], begins)
    maximum = np.maximum.reduceat(rows[:, 3], begins)
    is_maximum = rows[:, 3] == np.repeat(maximum, is_unknown - begins + 1)
    changes = np.flatnonzero(is_maximum)
    changes = changes[np.searchsorted(changes, begins)]
    spans = np.column_stack((times[changes, 0], times[is_unknown, 1]))
    return spans, np.column_stack((low, high, rows[is_unknown, 2], maximum))


def stretch_of(first: int, last: int, points: int) -> int:
    """Return the time that a row of such a window covers (ns)."""
    return STRETCH_NS * max(1, -(-(last - first) // (STRETCH_NS * points)))
