"""The rain forecast and the controller's plan for the hours ahead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.interface.topics import read_topics
from greenroof_ros.site.horizon import MAX_MEMBERS
from greenroof_ros.watch.history import Values

AHEAD_S = 12 * 3600.0
"""Length of the future that is shown (s)."""

# With fewer members than this there is no tenth: their range is from the minimum to the maximum.
_TENTHS = 10
# A smaller flow is a rounding error of the solver (m3/s): 6 mL/min.
_PUMPS = 1e-7
# Maximum number of steps of a forecast or a plan, which is that of the longest look-ahead, and the
# greatest number in either, in any unit.
_MAX_STEPS, _MAX_VALUE = 1000, 1e9


class RainAmount(NamedTuple):
    """Forecast rain (m): the mean of the members, and their range."""

    mean: float
    low: float
    high: float
    reach_s: float
    """Time that the forecast covers from now on (s)."""
    members: int


class PlannedPumping(NamedTuple):
    """Planned pumping."""

    volume: float
    """Volume to be pumped (m3)."""
    begin: float
    """Time at which pumping begins (s since 1970)."""
    level: float
    """Highest roof level that is expected at the end of a step with pumping (m)."""


@dataclass(frozen=True)
class Steps:
    """A forecast or a plan, in steps.

    Attributes:
        at: beginning of the first step (s since 1970).
        ends: ends of the steps (s since 1970), shape (steps,).
    """

    at: float
    ends: Values

    @property
    def begins(self) -> Values:
        """Beginnings of the steps (s since 1970), shape (steps,)."""
        return np.append(self.at, self.ends[:-1])

    def lengths(self, now: float) -> Values:
        """Return the part of each step that is between now and 12 h ahead (s), shape (steps,)."""
        until = now + AHEAD_S
        return np.clip(self.ends, now, until) - np.clip(self.begins, now, until)

    def rows(self, values: Values, now: float) -> list[tuple[float, float, float]]:
        """Return the start, end (s since 1970) and value of each step that has not ended."""
        begins = np.maximum(self.begins, now)
        return [
            row for row in zip(begins.tolist(), self.ends.tolist(), values.tolist(), strict=True)
            if row[1] > now
        ]


@dataclass(frozen=True)
class Forecast(Steps):
    """The latest rain forecast.

    Attributes:
        rain: mean rain rate in each step (m/s), shape (members, steps).
        issued: time of issue (s since 1970); the beginning of the first step if unknown.
    """

    rain: Values
    issued: float

    def amount(self, now: float) -> RainAmount | None:
        """Return the rain from now to 12 h ahead; None if the forecast has ended."""
        reach = min(float(self.ends[-1]) - now, AHEAD_S)
        if reach <= 0:
            return None
        amounts = self.rain @ self.lengths(now)
        # 10th to 90th percentile, or minimum to maximum for few members.
        low, high = map(float, np.percentile(
            amounts, (10, 90) if len(amounts) >= _TENTHS else (0, 100)
        ))
        return RainAmount(float(amounts.mean()), low, high, reach, len(amounts))


@dataclass(frozen=True)
class Plan(Steps):
    """The controller's pumping plan.

    Attributes:
        flow: mean flow in each step (m3/s).
        level: expected roof level at the end of each step (m).
    """

    flow: Values
    level: Values

    def pumped(self, now: float) -> PlannedPumping | None:
        """Return the pumping planned from now to 12 h ahead; None if no pumping is planned."""
        lengths = self.lengths(now)
        pumps = np.flatnonzero((self.flow > _PUMPS) & (lengths > 0))
        if not len(pumps):
            return None
        begin = max(now, float(self.begins[pumps[0]]))
        return PlannedPumping(float(self.flow @ lengths), begin, float(self.level[pumps].max()))


def _rise(ends: Values) -> bool:
    """Return whether the ends of steps (s after the beginning) are plausible."""
    return bool(
        0 < len(ends) <= _MAX_STEPS and np.all(np.diff(ends, prepend=0.0) > 0)
        and ends[-1] < _MAX_VALUE
    )


def read_forecast(at: float, values: Any, front: Any) -> Forecast | None:
    """Return a forecast that begins at a time (s since 1970); None if a value is impossible.

    For the values see :meth:`greenroof_ros.watch.store.GraphStore.add_forecast`.
    """
    rain, front = np.atleast_2d(np.asarray(values, np.float64)), np.asarray(front, np.float64)
    limits, ends = read_topics()["/forecast/precipitation"].range, front[1:]
    if (
        rain.ndim != 2 or rain.shape[1] != len(ends) or not 0 < len(rain) <= MAX_MEMBERS
        or not _rise(ends) or not np.all((rain >= limits.low) & (rain <= limits.high))
    ):
        return None
    return Forecast(at, at + ends, rain, float(front[0]) if 0 < front[0] <= at else at)


def read_plan(at: float, rows: Any) -> Plan | None:
    """Return a plan made at a time (s since 1970); None if a value is impossible."""
    plan = np.asarray(rows, np.float64)
    if plan.ndim != 2 or plan.shape[1] != 4 or not _rise(plan[:, 0]) or not np.all(
        (plan >= 0) & (plan <= _MAX_VALUE)
    ):
        return None
    return Plan(at, at + plan[:, 0], plan[:, 1], plan[:, 2])
