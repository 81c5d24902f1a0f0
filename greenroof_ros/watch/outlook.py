"""The rain forecast and the controller's plan for the hours ahead, both in steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from greenroof_ros.site.horizon import MAX_MEMBERS
from greenroof_ros.watch.history import Values

AHEAD_S = 12 * 3600.0
"""Length of the future that is shown (s)."""

# A smaller flow is a rounding error of the solver (m3/s): 6 mL/min.
_PUMPS = 1e-7
# Maximum number of steps of a forecast or a plan, which is that of the longest look-ahead, and the
# greatest number in either, in any unit.
_MAX_STEPS, _MAX_VALUE = 1000, 1e9


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
    ends: Values
    values: Values

    @property
    def begins(self) -> Values:
        """Beginnings of the steps (s since 1970), shape (steps,)."""
        return np.append(self.at, self.ends[:-1])

    def lengths(self, now: float) -> Values:
        """Return the part of each step that is between now and 12 h ahead (s), shape (steps,)."""
        until = now + AHEAD_S
        return np.clip(self.ends, now, until) - np.clip(self.begins, now, until)

    def reach(self, now: float) -> float:
        """Return how much of the next 12 h is covered (s)."""
        return min(float(self.ends[-1]) - now, AHEAD_S)

    def line(self, values: Values, now: float, until: float) -> list[list[float]]:
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
