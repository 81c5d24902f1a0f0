"""History of each chart line over the past week, in 20 s stretches, and the history file.

An unknown value is NaN; the line has a gap from this value to the next known value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.files import replace_file
from greenroof_ros.base.processes import LockedError, lock_file
from greenroof_ros.base.standard_error import print_line

Values = NDArray[np.float64]

# Length of a stretch (ns), short enough for 400 points in 12 h; how many are kept, which is a week.
STRETCH_NS = 20_000_000_000
MAX_STRETCHES = 7 * 24 * 3600 * 1_000_000_000 // STRETCH_NS + 2  # with those that are cut

# The fields of a stretch: when its last value arrived (ns since 1970), its lowest, highest and
# last value.
ROW = np.dtype([("ended", "<i8"), ("low", "<f8"), ("high", "<f8"), ("last", "<f8")])
END_S = 1e-3
"""Time (s) between two points of a line at the same time, or from a point to the line's end."""


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
        while self._count and self._rows["ended"][self._count - 1] > time_ns:
            self._count -= 1
        row = self._rows[self._count - 1] if self._count else None
        if row is not None and row["ended"] // STRETCH_NS == time_ns // STRETCH_NS:
            row["low"], row["high"] = np.fmin(row["low"], value), np.fmax(row["high"], value)
            row["ended"], row["last"] = time_ns, value
            return
        if self._count == len(self._rows):
            self._rows[:MAX_STRETCHES] = self._rows[MAX_STRETCHES:]
            self._count = MAX_STRETCHES
        self._rows[self._count] = (time_ns, value, value, value)
        self._count += 1

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
                near_high = high - value < value - low
                points.append([at - 2 * END_S, low if near_high else high])
                points.append([at - END_S, high if near_high else low])
            points.append([at, value if math.isfinite(value) else None])
        return points


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


def read_histories(file: Path) -> dict[str, History]:
    """Return the histories in a file; print why if the file cannot be read or is damaged."""
    rows: dict[str, NDArray[np.void]] = {}
    try:
        with np.load(BytesIO(file.read_bytes()), allow_pickle=False) as content:
            rows = {name: content[name] for name in content if content[name].dtype == ROW}
        if not all(each.ndim == 1 and np.all(np.diff(each["ended"]) > 0) for each in rows.values()):
            raise ValueError("its values are not plausible")
    except FileNotFoundError:
        pass
    except Exception as error:  # NumPy's errors depend on what the file contains
        print_line(f"the charts start empty: {file} cannot be read ({error})")
        rows = {}
    return {name: History(each) for name, each in rows.items()}
