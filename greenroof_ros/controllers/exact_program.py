"""The planners' program for one forecast without prices, solved exactly and without a solver."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.cistern_ahead import CisternAhead

Array = NDArray[np.float64]


class ExactProgram:
    """The least sum of absolute deviations, by following how the least cost depends on the volume.

    With P_i what is pumped until the middle of step i, at which the roof deviates by m_i without
    pumping, the program is

        minimise    sum_i h_i |m_i + P_i|
        subject to  0 <= P_i - P_{i-1} <= u_max q (h_{i-1} + h_i) / 2,  P_i <= most_i.

    f_i(P), the least cost of the steps to i if P is pumped by then, is convex and made of straight
    lines. From f_{i-1} it comes in three moves: the part right of its minimum goes to the right by
    what the pumps can do; beyond most_i it is infinite; h_i |m_i + P| is added. Kept are the places
    at which its slope changes, those left and those right of the minimum apart, each in a heap. The
    volumes follow backwards: P_{i-1} is as near to the minimum of f_{i-1} as P_i allows. For n
    steps that takes n log n operations. Without limits of the pumps this is isotonic regression in
    L1, and the way to solve it that of Rote (2019, Isotonic Regression by Dynamic Programming,
    doi:10.4230/OASIcs.SOSA.2019.1).

    Of water that does not stay, the share l_i of what is pumped now being left in step i, the roof
    has l_i V_i of all that is pumped, where V_i - V_{i-1} = (P_i - P_{i-1}) / l_i: what is pumped
    later has faded less. It is the same program in V, with l_i h_i, m_i / l_i and limits over l_i.

    Attributes:
        status: 1, as OSQP says of a program that is solved; 0 before the first.
        cost: mean deviation over all steps (m3); NaN before the first.
    """

    def __init__(self, edges: Array, max_command: float) -> None:
        """Take the ends of the steps (s from now), the first 0, and the commands' upper bound."""
        lengths = np.diff(edges)
        self.status = 0
        self.cost = math.nan
        self._max_command = max_command
        self._edges = edges
        self._lengths = lengths
        self._middles = np.concatenate(([0.0], edges[:-1] + lengths / 2))
        self._spans = np.diff(self._middles)

    def solve(
        self, mean: Array, most: Array, full: float, flow: float = 0.0, guess: Array | None = None,
        ahead: CisternAhead | None = None, lasting: Array | None = None,
    ) -> Array:
        """Solve it; see :class:`greenroof_ros.controllers.objective.Program`.

        There always is a solution; flow and guess do not matter. It is not for low outlets.
        """
        # Where the pumps cannot lift, no bound on their commands makes them.
        rises = self._spans * (full * self._max_command if full else 0.0)
        lengths = self._lengths
        if lasting is not None:
            mean, most, rises = mean / lasting, most / lasting, rises / lasting[0]
            lengths = lengths * lasting[0]
        able = rises.tolist()
        least = self._minima(mean[0].tolist(), most[0].tolist(), lengths.tolist(), able)
        volumes = [least[-1]]
        for before, rise in zip(reversed(least[:-1]), reversed(able[1:]), strict=True):
            volumes.append(min(max(before, volumes[-1] - rise), volumes[-1]))
        volumes.reverse()
        self.status = 1
        deviations = lengths * np.abs(mean[0] + volumes)
        self.cost = float(deviations.sum() / self._edges[-1])
        if lasting is not None:
            volumes = np.cumsum(np.diff(volumes, prepend=0.0) * lasting[0]).tolist()
        at_ends = np.interp(self._edges[1:], self._middles, [0.0, *volumes])
        return np.asarray(np.minimum(at_ends, most[0])[None])

    def _minima(
        self, mean: list[float], most: list[float], lengths: list[float], able: list[float]
    ) -> list[float]:
        """Return for each step where f_i is least, and of several places the lowest."""
        # (place, change of the slope) left of the minimum, with the places' signs turned, and
        # right of it, where all places are less by `moved`. The walls at 0: nothing pumped yet.
        left, right = [(0.0, math.inf)], [(0.0, math.inf)]
        moved = 0.0
        minima = []
        for deviation, limit, length, rises in zip(mean, most, lengths, able, strict=True):
            moved += rises
            _end_at(left, right, moved, limit)
            _add_right(left, right, moved, -deviation, length)
            _add_left(left, right, moved, -deviation, length)
            minima.append(-left[0][0])
        return minima


Breaks = list[tuple[float, float]]


def _end_at(left: Breaks, right: Breaks, moved: float, place: float) -> None:
    """Make it infinite right of a place, which is not left of the wall at 0."""
    beyond = 0.0
    while -left[0][0] > place:
        beyond += heapq.heappop(left)[1]
    if beyond:
        heapq.heappush(left, (-place, beyond))
    heapq.heappush(right, (place - moved, math.inf))


def _add_right(left: Breaks, right: Breaks, moved: float, place: float, slope: float) -> None:
    """Add a line that rises right of a place."""
    heapq.heappush(left, (-place, slope))
    while slope > 0:
        at, change = heapq.heappop(left)
        part = min(change, slope)
        if change > part:
            heapq.heappush(left, (at, change - part))
        heapq.heappush(right, (-at - moved, part))
        slope -= part


def _add_left(left: Breaks, right: Breaks, moved: float, place: float, slope: float) -> None:
    """Add a line that rises left of a place."""
    heapq.heappush(right, (place - moved, slope))
    while slope > 0:
        at, change = heapq.heappop(right)
        part = min(change, slope)
        if change > part:
            heapq.heappush(right, (at, change - part))
        heapq.heappush(left, (-at - moved, part))
        slope -= part
