"""History of each chart line over the past week, in 20 s stretches, and the history file.

An unknown value is NaN; the line has a gap from this value to the next known value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.files import replace_file
from greenroof_ros.base.processes import LockedError, lock_file

Values = NDArray[np.float64]

# Length of a stretch (ns), short enough for 400 points in 12 h; how many are kept, which is a week.
STRETCH_NS = 20_000_000_000
MAX_STRETCHES = 7 * 24 * 3600 * 1_000_000_000 // STRETCH_NS + 2  # with those that are cut

# The fields of a stretch: when its last value arrived (ns since 1970), its lowest, highest and
# last value.
ROW = np.dtype([("ended", "<i8"), ("low", "<f8"), ("high", "<f8"), ("last", "<f8")])
END_S = 1e-3
"""Time (s) between two points of a line at the same time, or from a point to the line's end."""

_FORMAT = "format"
_VERSION = 2


class History:
    """History of one value over the past week, in bounded memory."""

    def __init__(self, rows: NDArray[np.void] | None = None) -> None:
        """Start with the rows of an earlier history, or with none.

        Args:
            rows: rows of the earlier history, as in :attr:`rows`.
        """
        kept = np.empty(0, ROW) if rows is None else rows[-MAX_STRETCHES:]
        self._rows = np.empty(2 * MAX_STRETCHES, ROW)
        self._count = len(kept)
        self._rows[:self._count] = kept

    @property
    def rows(self) -> NDArray[np.void]:
        """The stretches, oldest first, as a view that the next :meth:`add` changes."""
        return self._rows[max(0, self._count - MAX_STRETCHES):self._count]

    @property
    def first_ns(self) -> int | None:
        """Time of the end of the first stretch (ns since 1970); None if there are no values."""
        return int(self.rows["ended"][0]) if self._count else None

    @property
    def last(self) -> float:
        """The last value; 0 if there are no values."""
        return float(self.rows["last"][-1]) if self._count else 0.0

    def value_at(self, time_ns: int) -> float:
        """Return the last value at a time (ns since 1970); 0 if there was none yet."""
        rows = self.rows
        number = int(np.searchsorted(rows["ended"], time_ns, "right"))
        return float(rows["last"][number - 1]) if number else 0.0

    def add(self, time_ns: int, value: float) -> None:
        """Add a value that is newer than all previous values.

        Args:
            time_ns: time of the value (ns since 1970).
            value: the value; NaN if the value is unknown from this time on.
        """
        row = self._rows[self._count - 1] if self._count else None
        if row is None or row["ended"] // STRETCH_NS != time_ns // STRETCH_NS:
            if self._count == len(self._rows):
                self._rows[:MAX_STRETCHES] = self._rows[MAX_STRETCHES:]
                self._count = MAX_STRETCHES
            self._rows[self._count] = (time_ns, value, value, value)
            self._count += 1
            return
        row["low"], row["high"] = np.fmin(row["low"], value), np.fmax(row["high"], value)
        row["ended"], row["last"] = time_ns, value

    def line(self, first: int, last: int, stretch_ns: int, gap_s: float) -> list[list[Any]]:
        """Return the line of the values from ``first`` to ``last``, inclusive.

        Every stretch has a point for its last value and, if it has several values, points for its
        lowest and highest; so no short run of a pump is lost.

        Args:
            first: beginning (ns).
            last: end (ns).
            stretch_ns: length of a stretch (ns), from :func:`choose_stretch`.
            gap_s: longest time between two points that belong together (s).

        Returns:
            Points, each with a time (s) and a value, or None from where the value is unknown.
        """
        rows = self.rows
        rows = rows[slice(*np.searchsorted(rows["ended"], (first, last + 1)))]
        points: list[list[Any]] = []
        # Whole stretches, which begin at the same times in every call, so a redrawn line does not
        # jitter.
        for ended, low, high, value in (
            _condense(rows, stretch_ns).tolist() if len(rows) else ()
        ):
            at, (until, before) = ended / 1e9, points[-1] if points else (math.inf, None)
            if at - until > gap_s and before is not None:
                points.append([until + END_S, None])
            if low < high and not math.isnan(value):
                extremes = (low, high) if high - value < value - low else (high, low)
                points += [[at - 2 * END_S, extremes[0]], [at - END_S, extremes[1]]]
            points.append([at, None if math.isnan(value) else value])
        return points


def _condense(rows: NDArray[np.void], stretch_ns: int) -> NDArray[np.void]:
    """Combine the rows into longer stretches."""
    begins = np.flatnonzero(np.diff(rows["ended"] // stretch_ns, prepend=-1))
    ends = np.append(begins[1:], len(rows)) - 1
    condensed: NDArray[np.void] = rows[ends].copy()
    condensed["low"] = np.fmin.reduceat(rows["low"], begins)
    condensed["high"] = np.fmax.reduceat(rows["high"], begins)
    return condensed


def choose_stretch(first: int, last: int, points: int) -> int:
    """Return the time that each row of a window covers (ns).

    Args:
        first: beginning (ns).
        last: end (ns).
        points: approximate maximum number of rows.
    """
    return STRETCH_NS * max(1, -(-(last - first) // (STRETCH_NS * points)))


# --- the file -------------------------------------------------------------------------------------


def write_histories(file: Path, rows: Mapping[str, NDArray[np.void]]) -> None:
    """Write the rows of histories to a file, replacing the file as a whole.

    Args:
        file: NumPy file (``.npz``); its directory is created if necessary.
        rows: rows of each history, by the name of the history.

    Raises:
        OSError: if the file cannot be written.
    """
    content: dict[str, Any] = {_FORMAT: np.array(_VERSION), **rows}
    file.parent.mkdir(parents=True, exist_ok=True)
    # If another watcher is just writing the file, its rows are as good.
    with suppress(LockedError), lock_file(file.with_suffix(".lock")):
        replace_file(file, lambda stream: np.savez(stream, **content))


def read_histories(file: Path, names: Iterable[str], until_ns: int) -> dict[str, History]:
    """Return the histories in a file; empty if the file does not exist.

    Args:
        file: file that :func:`write_histories` wrote.
        names: names of the histories to read; any other histories in the file are ignored.
        until_ns: current time (ns since 1970). Later values are ignored, since they were recorded
            before the clock was set back.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if the file is damaged or was written by another program.
    """
    histories = {}
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return {}
    try:
        with np.load(BytesIO(data), allow_pickle=False) as content:
            if _FORMAT not in content or content[_FORMAT].tolist() != _VERSION:
                raise ValueError("its format is unknown")
            for name in content.keys() & set(names):
                rows = _check_rows(content[name])
                histories[name] = History(rows[rows["ended"] <= until_ns])
    except Exception as error:  # NumPy's errors depend on what the file contains instead
        raise ValueError(str(error) or "it is damaged") from error
    return histories


def _check_rows(rows: NDArray[Any]) -> NDArray[np.void]:
    if rows.dtype != ROW or rows.ndim != 1:
        raise ValueError("it does not contain rows of a history")
    times, values = rows["ended"], np.array([rows[name] for name in ("low", "high", "last")])
    if np.any(np.diff(times, prepend=0) <= 0) or np.isinf(values).any():
        raise ValueError("its values are not plausible")
    return rows
