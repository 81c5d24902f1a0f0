"""Runs of the pumps, and the levels of the cistern that show what they took."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.site import Site

# So long after rain a catchment still runs (s), and so far from the levels of outlet, valve and
# suction a sensor's noise does not matter (m).
_WET_S = 3600
_APART_M = 0.05
_STANDING_STEPS, _STANDING_S = 2, 600
_FEWEST_LEVELS = 3


class Runs(NamedTuple):
    """The levels of each run, from before its beginning to after its end, one run after another."""

    step: NDArray[np.int64]
    """that each level is at the beginning of, shape (n,)"""
    level: Values
    """m, shape (n,)"""
    number: NDArray[np.int64]
    """of the run that each level is of, from 0"""
    counts: NDArray[np.bool_]
    """whether a level counts in the fit, shape (n,)"""

    @property
    def sizes(self) -> NDArray[np.int64]:
        """How many levels of each run count."""
        return np.bincount(self.number, self.counts).astype(np.int64)

    @property
    def between(self) -> Values:
        """Mean of each level and the next (m); at the end of a run that level itself."""
        last = np.append(self.number[1:] != self.number[:-1], True)
        return np.where(last, self.level, (self.level + np.append(self.level[1:], 0.0)) / 2)

    def only(self, kept: NDArray[np.bool_]) -> Runs:
        """Return the runs that are kept, numbered anew; ``kept`` has an entry for each run."""
        here = kept[self.number]
        number = (np.cumsum(kept) - 1)[self.number[here]]
        return Runs(self.step[here], self.level[here], number, self.counts[here])

    def without(self, levels: NDArray[np.bool_]) -> Runs:
        """Return runs in which these levels do not count, those of three others at least."""
        fewer = self._replace(counts=self.counts & ~levels)
        return fewer.only(fewer.sizes >= _FEWEST_LEVELS)

    def less_means(self, values: Values) -> Values:
        """Return values of levels, less their mean over each run; 0 where they do not count."""
        means = np.bincount(self.number, values * self.counts) / self.sizes
        return np.where(self.counts, values - means[self.number], 0.0)

    def typical(self, residuals: Values) -> Values:
        """Return the standard deviation in each run of what :meth:`less_means` has left."""
        return np.sqrt(np.bincount(self.number, residuals**2) / (self.sizes - 1))

    def lasting(self, command: Values) -> Values:
        """Return of each run in how many steps the pumps ran."""
        return np.asarray(np.bincount(self.number, command[self.step] > 0))

    def rises(self) -> Values:
        """Return by how much in each run a level is above an earlier one, at most (m)."""
        ends = np.cumsum(np.bincount(self.number))[:-1]
        each = np.split(self.level, ends)
        return np.array([np.max(one - np.minimum.accumulate(one)) for one in each])


def standing_steps(step_s: float) -> int:
    """Return from how many steps before a run to how many after it levels count.

    By so much the pump state may be late or early: that of a logger by a step or two, that of a
    drive by minutes.
    """
    return max(_STANDING_STEPS, round(_STANDING_S / step_s))


def find_runs(site: Site, record: Record, command: Values, cistern: Values) -> Runs:
    """Return the runs in which nothing but the pumps moves the cistern.

    A run counts as far as it did not rain for an hour, the level is between the outlet and the
    lowest at which pumps and mains leave it, and all is known. Where two runs are near each other,
    each has half of the levels between them.
    """
    standing = standing_steps(record.step_s)
    quiet = _quiet(site, record, command, cistern, standing)
    found = gaps(quiet & (command > 0))
    still = quiet & (command == 0)
    levels = []
    for place, (first, end) in enumerate(found):
        low, high = max(0, first - standing), min(end + standing, record.steps - 1)
        if place > 0:
            low = max(low, (found[place - 1][1] + first + 1) // 2)
        if place + 1 < len(found):
            high = min(high, (end + found[place + 1][0] - 1) // 2)
        busy_before = np.flatnonzero(~still[low:first])
        busy_after = np.flatnonzero(~still[end:high])
        low += busy_before[-1] + 1 if len(busy_before) else 0
        high = end + busy_after[0] if len(busy_after) else high
        levels.append(np.arange(low, high + 1))
    if not levels:
        empty = np.zeros(0, dtype=np.int64)
        return Runs(empty, np.zeros(0), empty, empty > 0)
    step = np.concatenate(levels)
    number = np.repeat(np.arange(len(levels)), [len(one) for one in levels])
    return Runs(step, cistern[step], number, step >= 0)


def _quiet(
    site: Site, record: Record, command: Values, level: Values, standing: int
) -> NDArray[np.bool_]:
    """Return in which steps nothing but the pumps moves the cistern."""
    wet = ~(record.rain == 0)
    recent = np.convolve(wet, np.ones(round(_WET_S / record.step_s) + 1), "full")[:record.steps] > 0
    reach = standing + 2
    unknown = np.convolve(np.isnan(command), np.ones(2 * reach + 1), "full")
    low = max(site.suction_level, site.mains_level or 0.0) + _APART_M
    between = (level > low) & (level < site.lowest_outlet - _APART_M)
    return np.asarray(
        between & np.append(between[1:], False) & ~recent
        & (unknown[reach:reach + record.steps] == 0)
    )
