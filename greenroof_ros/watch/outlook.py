"""The rain forecast and the controller's plan for the hours ahead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from greenroof_ros.watch.history import Values

AHEAD_S = 12 * 3600.0
"""Length of the future that is shown (s)."""

# With fewer members than this there is no tenth: their range is from the minimum to the maximum.
_TENTHS = 10
# A smaller flow is a rounding error of the solver (m3/s): 6 mL/min.
_PUMPS = 1e-7


class RainAmount(NamedTuple):
    """Forecast rain (m): the mean of the members, and their range."""

    mean: float
    low: float
    high: float
    reach_s: float
    """Time that the forecast covers from now on (s)."""
    fallen_at: float
    """Time by which nine tenths of the mean will have fallen (s since 1970)."""
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
class _Steps:
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

    def coming(self, now: float) -> list[tuple[int, float, float]]:
        """Return each step that has not ended: its number, start, and end (s since 1970)."""
        return [
            (step, max(now, begin), end)
            for step, (begin, end) in enumerate(
                zip(self.begins.tolist(), self.ends.tolist(), strict=True)
            ) if end > now
        ]

    def lengths(self, now: float) -> Values:
        """Return the part of each step that is between now and 12 h ahead (s), shape (steps,)."""
        until = now + AHEAD_S
        return np.clip(self.ends, now, until) - np.clip(self.begins, now, until)


@dataclass(frozen=True)
class Forecast(_Steps):
    """The latest rain forecast.

    Attributes:
        rain: mean rain rate in each step (m/s), shape (members, steps).
        issued: time of issue (s since 1970); None if unknown.
    """

    rain: Values
    issued: float | None

    def amount(self, now: float) -> RainAmount | None:
        """Return the rain from now to 12 h ahead; None if the forecast has ended."""
        until, lengths = now + AHEAD_S, self.lengths(now)
        reach = min(float(self.ends[-1]), until) - now
        if reach <= 0:
            return None
        amounts = self.rain @ lengths
        fallen = np.cumsum(self.rain.mean(axis=0) * lengths)
        last = int(np.searchsorted(fallen, 0.9 * fallen[-1]))
        fallen_at = min(float(self.ends[last]), until)
        # 10th to 90th percentile, or minimum to maximum for few members.
        low, high = map(float, np.percentile(
            amounts, (10, 90) if len(amounts) >= _TENTHS else (0, 100)
        ))
        return RainAmount(float(amounts.mean()), low, high, reach, fallen_at, len(amounts))

    def rows(self, now: float) -> list[tuple[float, float, float]]:
        """Return the start, end (s since 1970) and mean rain (m/s) of each future step."""
        rain = self.rain.mean(axis=0)
        return [(begin, end, float(rain[step])) for step, begin, end in self.coming(now)]


@dataclass(frozen=True)
class Plan(_Steps):
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

    def rows(self, now: float) -> list[tuple[float, float, float, float]]:
        """Return the start, end (s since 1970), flow and final roof level of each future step."""
        return [
            (begin, end, float(self.flow[step]), float(self.level[step]))
            for step, begin, end in self.coming(now)
        ]
