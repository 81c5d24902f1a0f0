"""The planners' program without prices, solved exactly and without a solver."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.cistern_ahead import CisternAhead
from greenroof_ros.controllers.scenario_tree import Groups, least_of_groups, means_of_groups

Array = NDArray[np.float64]


class ExactProgram:
    """The least sum of absolute deviations, by following how the least cost depends on the volume.

    With P_i what is pumped until the middle of step i, at which the roof deviates by m_i without
    pumping, the program of one forecast is

        minimise    sum_i h_i |m_i + P_i|
        subject to  0 <= P_i - P_{i-1} <= u_max q (h_{i-1} + h_i) / 2,  P_i <= most_i.

    That of several is the sum over all of them, where those in one group at step i have one P_i: a
    tree, see :mod:`greenroof_ros.controllers.scenario_tree`.

    f_i(P), the least cost of a group from step i on if P is pumped until then, is convex and made
    of straight lines. It comes from the groups into which it splits at step i + 1 in three moves:
    in each, the part left of its minimum goes to the left by what the pumps can do; these are
    added up, with h_i |m_i + P| of each member; beyond the least most_i of the members it is
    infinite. Kept are the places at which its slope changes, those left and those right of the
    minimum apart, each in a heap. The volumes follow forwards: P_i is as near to the minimum of f_i
    as P_{i-1} allows, and of several minima the lowest is taken. That is the least of all answers
    at each step, and so there is one.

    For n steps and members in all that takes n log n operations, but for the splits. For one
    forecast without limits of the pumps it is isotonic regression in L1, and the way to solve it
    that of Rote (2019, Isotonic Regression by Dynamic Programming,
    doi:10.4230/OASIcs.SOSA.2019.1), from the other end.

    Of water that does not stay, the share l_i of what is pumped now being left in step i, the roof
    has l_i V_i of all that is pumped, where V_i - V_{i-1} = (P_i - P_{i-1}) / l_i: what is pumped
    later has faded less. It is the same program in V, with l_i h_i, m_i / l_i and limits over l_i.
    Members in one group have one share, the mean of theirs. But what the cistern has is a limit of
    P_i, which is no limit of V_i alone. The minima know it as one of what is left, l_i V_i <= P_i;
    the volumes that follow them forwards keep it: when the cistern is empty nothing is pumped. So
    where the cistern runs empty the answer is a plan that can be followed, and not quite the best.

    Attributes:
        status: 1, as OSQP says of a program that is solved; 0 before the first.
        cost: mean deviation over all steps and members (m3); NaN before the first.
    """

    def __init__(self, edges: Array, max_command: float) -> None:
        """Take the ends of the steps (s from now), the first 0, and the commands' upper bound."""
        self.status = 0
        self.cost = math.nan
        self._max_command = max_command
        self._edges = edges
        self._lengths = np.diff(edges)
        self._middles = np.concatenate(([0.0], edges[:-1] + self._lengths / 2))

    def solve(
        self, mean: Array, most: Array, full: float, flow: float, guess: Array | None,
        groups: Groups, ahead: CisternAhead | None = None, lasting: Array | None = None,
        there: Array | None = None,
    ) -> Array:
        """Solve it; see :class:`greenroof_ros.controllers.objective.Program`.

        There always is a solution; flow, guess and a low outlet do not matter. ``lasting`` is the
        share of what is pumped now that is still on the roof in each step (1), shape (members, n);
        None where it is all of it. ``most`` is of what is left then, and ``there`` the upper bound
        of the volumes pumped (m3), not falling, shape (members, n).
        """
        # Where the pumps cannot lift, no bound on their commands makes them.
        largest = full * self._max_command if full else 0.0
        able = np.broadcast_to(np.diff(self._middles) * largest, mean.shape)
        lengths = np.broadcast_to(self._lengths, mean.shape)
        if lasting is not None:
            lasting = means_of_groups(lasting, groups)
            mean, most, able = mean / lasting, most / lasting, able / lasting
            lengths = lengths * lasting
            # In a group that parts the share of one may grow, and nothing is taken back.
            most = np.minimum.accumulate(most[:, ::-1], axis=1)[:, ::-1]
        most = least_of_groups(most, groups)
        rises = np.minimum(able, most.max()).T.tolist()
        labels = groups.T.tolist()
        least = self._minima(
            (-mean).T.tolist(), most.T.tolist(), lengths.T.tolist(), rises, labels
        )
        if there is not None:
            there = least_of_groups(there, groups)
        pumped = self._followed(least, rises, labels, lasting, there)
        self.status = 1
        self.cost = float((lengths * np.abs(mean + pumped)).sum(axis=1).mean())
        self.cost /= float(self._edges[-1])
        if lasting is not None:
            pumped = np.cumsum(np.diff(pumped, prepend=0.0) * lasting, axis=1)
        at_ends = [np.interp(self._edges[1:], self._middles, [0.0, *each]) for each in pumped]
        ends = np.minimum(at_ends, most if there is None else np.minimum(most, there))
        if math.isinf(largest):
            return np.asarray(ends)
        # What a bound has cut cannot be made up for faster than the pumps can.
        reach = np.cumsum(self._lengths * largest)
        behind = np.minimum.accumulate(ends - reach, axis=1)
        caught_up = np.hstack((np.zeros((len(ends), 1)), np.minimum(behind, 0.0)[:, :-1])) + reach
        return np.asarray(np.minimum(ends, caught_up))

    def _followed(
        self, least: list[list[float]], rises: list[list[float]], labels: list[list[int]],
        lasting: Array | None, there: Array | None,
    ) -> Array:
        """Return V_i of each member, as near to the least as V_{i-1} and the cistern allow.

        Args:
            least: where f_i of each group is least; see :meth:`_minima`, as for the next two.
            rises: what may be pumped from the step before.
            labels: of the members' groups.
            lasting: l_i, alike within a group, shape (members, n).
            there: what the cistern has for P_i (m3), likewise; None where it is in ``least``.
        """
        now = pumped = [0.0] * len(labels[0])
        shares = has = None
        if lasting is not None and there is not None:
            shares, has = lasting.T.tolist(), there.T.tolist()
        volumes = []
        for step, (places, rise, group) in enumerate(zip(least, rises, labels, strict=True)):
            before = now
            if shares is not None and has is not None:
                rise = [
                    min(more, max(most - so_far, 0.0) / share)
                    for more, most, so_far, share
                    in zip(rise, has[step], pumped, shares[step], strict=True)
                ]
            now = [
                min(max(places[label], volume), volume + more)
                for label, volume, more in zip(group, before, rise, strict=True)
            ]
            if shares is not None:
                pumped = [
                    so_far + share * (volume - earlier)
                    for so_far, share, volume, earlier
                    in zip(pumped, shares[step], now, before, strict=True)
                ]
            volumes.append(now)
        return np.array(volumes).T

    def _minima(
        self, places: list[list[float]], most: list[list[float]], lengths: list[list[float]],
        rises: list[list[float]], labels: list[list[int]],
    ) -> list[list[float]]:
        """Return for each step where f_i of each group is least, and of several places the lowest.

        Args:
            places: at which a member deviates by nothing, -m_i, a list of members for each step.
            most: upper bounds, likewise; alike within a group.
            lengths: slopes of the deviations, likewise; alike within a group.
            rises: what may be pumped from the step before, likewise; alike within a group.
            labels: of the members' groups, likewise.
        """
        members = len(places[0])
        # (place, change of the slope) of each group, left of its minimum, where all places are less
        # by what it has `moved` and their signs are turned, and right of it.
        left: list[Breaks] = [[] for _ in range(members)]
        right: list[Breaks] = [[] for _ in range(members)]
        moved = [0.0] * members
        minima = []
        for step in reversed(range(len(places))):
            _join(left, right, moved, labels[step])
            of_step = zip(labels[step], places[step], most[step], lengths[step], strict=True)
            for label, place, limit, length in of_step:
                # Between 0 and the limit it is the same line.
                at = min(max(place, 0.0), limit)
                heapq.heappush(left[label], (-at - moved[label], length))
                heapq.heappush(right[label], (at, length))
            least = [-math.inf] * members
            for label in set(labels[step]):
                _part(left[label], right[label], moved[label])
                _end_at(left[label], right[label], moved[label], most[step][label])
                if left[label]:
                    least[label] = -left[label][0][0] - moved[label]
                moved[label] += rises[step][label]
            minima.append(least)
        minima.reverse()
        return minima


Breaks = list[tuple[float, float]]
# Places that are no further apart are the same (m3).
_SAME_M3 = 1e-9


def _join(
    left: list[Breaks], right: list[Breaks], moved: list[float], labels: list[int]
) -> None:
    """Add up the functions of groups that have become one."""
    for member, label in enumerate(labels):
        if label == member or not (left[member] or right[member]):
            continue
        more = moved[member] - moved[label]
        left[label] += [(turned + more, change) for turned, change in left[member]]
        right[label] += right[member]
        left[member], right[member] = [], []
        heapq.heapify(left[label])
        heapq.heapify(right[label])


def _part(left: Breaks, right: Breaks, moved: float) -> None:
    """Exchange changes of the slope until all on the left are left of those on the right.

    c (a - P)^+ + c (P - b)^+ with b < a is c (b - P)^+ + c (P - a)^+ and a constant. Places that
    differ by rounding alone are the same, or they would be exchanged without end.
    """
    while left and right and -left[0][0] - moved > right[0][0] + _SAME_M3:
        (turned, falling), (lower, rising) = heapq.heappop(left), heapq.heappop(right)
        part, upper = min(falling, rising), -turned - moved
        if falling > part:
            heapq.heappush(left, (turned, falling - part))
        if rising > part:
            heapq.heappush(right, (lower, rising - part))
        heapq.heappush(left, (-lower - moved, part))
        heapq.heappush(right, (upper, part))


def _end_at(left: Breaks, right: Breaks, moved: float, place: float) -> None:
    """Make it infinite right of a place."""
    beyond = 0.0
    while left and -left[0][0] - moved > place:
        beyond += heapq.heappop(left)[1]
    if beyond:
        heapq.heappush(left, (-place - moved, beyond))
        right.clear()
