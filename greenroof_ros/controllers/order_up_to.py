"""A dynamic program that finds how far to fill the roof, for every roof volume and every step.

:func:`halve_by_rain` describes the assumption about when the members of an ensemble can be
distinguished.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.roof import Array, RoofPrediction, drain
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.site.site import Site

Indices = NDArray[np.intp]

# The roof is held this far below the target (m3), at which the plant stops the pumps, Eq. (3a).
BELOW_M3 = 1e-6
# Nodes below and above the target for an ensemble or scarce water, where forecasts err by more than
# the distance between nodes.
_COARSE = (60, 30)
# The same for a single forecast and enough water.
_FINE = (900, 300)
# A positive volume (m3) that avoids a division by 0.
_MINIMUM = 1e-300
# Nodes of the available water, if it can run short.
_WATER_NODES = 12


class OrderUpTo:
    r"""Dynamic program for the minimum mean of \|x2 - x2*\|, solved backwards from the last step.

    Pumps can fill a roof in minutes, so a plan gives a level for each step: the roof is filled to y
    and held there while it dries, or it is left alone. For every member of an ensemble, V_i(x) is
    the minimum cost of the deviation from step i on (m3 s) if the roof holds x. With h the length
    of the step (s),

        F(x) = h mean|path - x*| + V_{i+1}(z),  z = volume at the end if left alone,
        H(y) = F(y) if held at y instead of drying, as far as the pumps can,
        V_i(x) = min(F(x), H(y) + filling),  x <= y <= x*, and y within the pumps' reach.

    The path within a step is assumed to be straight. Filling from x to y takes t seconds. During
    this time, the roof holds (y - x)/2 less on average than H assumes, so filling costs t (y -
    x)/2.

    The decision to fill to y or to leave the roof alone is the same for all members of a group, and
    is based on their mean; every member has its own V. If V were averaged as well, it would be as
    if a new member were drawn in each step, and the total rain of a storm would be lost.

    V is stored at volume nodes that include the target and are dense around it, and is interpolated
    linearly between them.

    **Water.** If the cistern can run short, V depends on a second variable s, which is the usable
    water plus the water needed to fill an empty roof to its current volume. Filling does not change
    s. If there is always enough water, s has one node. Usable is the water above the suction level.
    A valve on the low outlet is assumed to be closed, because the water that it releases makes room
    for rain that refills the cistern.

    The program keeps the decisions of its last plan. For every step, these are the volume to which
    the roof is filled and at which it is held (m3), or -1 if the roof is left alone, shape (groups
    of the step, S, nodes up to the target); and the index of each member's group.
    """

    def __init__(self, site: Site) -> None:
        """Set the site."""
        self._p, self._target = plant_parameters(site), site.x2_star
        self._soil, self._always_drains = RoofPrediction(self._p), site.always_drains
        # Usable water of a cistern that is full, at its lowest open outlet, and at its mains valve.
        self._suction = site.cistern_volume(site.suction_level)
        self._capacity, self._low, self._mains = (
            site.cistern_volume(level) - self._suction for level in (
                site.z_o, site.min_outlet_level if site.always_drains else site.z_o,
                self._p.mains_level,
            )
        )

    def _place(self, below: int, above: int) -> None:
        """Place the nodes at x* plus or minus (k / n)^2 of the range."""
        self._below = below
        self._nodes = np.concatenate((
            self._target * (1 - (np.arange(below, 0, -1) / below) ** 2),
            self._target + self._soil.above_target * (np.arange(above + 1) / above) ** 2,
        ))
        self._contents = self._content(self._nodes)

    def _usable(self, x1: float) -> float:
        """Return the usable part of x1 (m3): without water above the outlet, which soon drains."""
        return min(max(x1 - self._suction, 0.0), self._capacity)

    def _predict_usable(self, water: Array, rain: Array, seconds: float) -> Array:
        """Return the usable water (m3) after a step with rain (m/s), from Eq. (2) without pumping.

        Rain and mains water are added first. Then the low outlet drains the cistern.
        """
        p = self._p
        water = water + rain * (p.effective_catchment * seconds)
        water = np.maximum(water, np.minimum(water + p.mains_flow * seconds, self._mains))
        water = np.minimum(water, self._capacity)
        if self._always_drains:
            water = drain(p, water + self._suction, seconds) - self._suction
        return water

    def level(self, age: float, x1: float, x2: float) -> float:
        """Return the volume up to which the roof is filled now (m3); a fuller one is left alone.

        Args:
            age: time since the plan was made (s), before members can be distinguished.
            x1: volume in the cistern (m3).
            x2: volume on the roof (m3).
        """
        step = int(self._edges[1:-1].searchsorted(age, side="right"))
        return float(self._levels(self._decisions[step][0], 0, self._usable(x1), x2))

    def _levels(self, table: Array, group: Any, usable: Any, x2: Any) -> Any:
        """Return the volumes up to which roofs are filled (m3), or -1.

        Between two nodes of the roof's volume, the decision at the lower node applies. Between two
        nodes of the water, the volume is interpolated; if the decision at either node is to leave
        the roof alone, the decision at the upper node applies. This rule allows the last of the
        water to be pumped, although there is no water at the node below.

        Args:
            table: volumes of a step of the plan.
            group: index of a group of the step, either one for each roof or one for all roofs.
            usable: usable water in the cistern (m3), either one value for each roof or one for all
                roofs.
            x2: volume on each roof (m3).
        """
        node = self._nodes[1 : table.shape[2]].searchsorted(x2, side="right")
        if len(self._water) == 1:
            return table[group, 0, node]
        row, part = _between(self._water, usable + self._content(x2))
        low, high = table[group, row, node], table[group, row + 1, node]
        return np.where(np.minimum(low, high) < 0, high, low + part * (high - low))

    def solve(
        self, edges: Array, x1: float, x2: float, rain: Array, evapotranspiration: Array,
        flow: Array, groups: Indices,
    ) -> float:
        """Find the plan with the minimum cost: the mean deviation over steps and members (m3).

        Args:
            edges: boundaries of the steps (s from now), starting at 0, shape (n + 1,).
            x1: volume in the cistern (m3).
            x2: volume on the roof (m3).
            rain: rain in every step (m/s), shape (members, n).
            evapotranspiration: evapotranspiration from the whole bed (m3/s), shape (n,).
            flow: maximum pump flow in every step (m3/s), which can be 0, shape (n,).
            groups: index of every member's group in every step, as returned by
                :func:`halve_by_rain`, shape (members, n).
        """
        members, steps = rain.shape
        self._edges, self._begin, lengths = edges, (x1, x2), np.diff(edges)
        full = float(self._content(self._target))
        potential = evapotranspiration * lengths
        self._limits = np.column_stack((flow, potential, lengths)).tolist()
        demand = full + float(potential.sum())
        supplied = min(self._usable(x1), self._low) + self._p.mains_flow * float(edges[-1])
        scarce = 0.0  # the maximum relevant volume of water; 0 if there will always be enough
        if supplied < demand:
            scarce = self._capacity if self._low < self._capacity else min(demand, self._capacity)
        self._place(*(_FINE if members == 1 and not scarce else _COARSE))
        self._water = np.zeros(1)
        if scarce:
            self._water = (full + scarce) * np.linspace(0.0, 1.0, _WATER_NODES) ** 2
        # Neither pumps nor water are a limit: even an empty roof can be filled within the step.
        reached = self._soil.predict_volume(np.zeros(steps), flow * lengths, potential, lengths)
        strong = (reached >= self._target) & (scarce == 0)
        # Steps after the last rain are the same for all members.
        wet = int(np.flatnonzero(rain.any(axis=0)).max(initial=-1)) + 1
        value = np.zeros((1, len(self._water), len(self._nodes)))
        self._decisions: list[tuple[Array, Indices]] = []
        for step in reversed(range(steps)):
            if step < wet and len(value) < members:
                value = np.repeat(value, members, axis=0)
            group = groups[: len(value), step]
            value, levels = self._before(
                value, rain[: len(value), step, None, None], group, strong[step],
                *self._limits[step],
            )
            self._decisions.insert(0, (levels, np.broadcast_to(group, members)))
        stored = np.full((1, 1, 1), self._usable(x1) + self._content(x2))
        return float(self._at(value, np.full((1, 1, 1), x2), stored).mean()) / float(edges[-1])

    def simulate(self, rain: Array, member: int | None = None) -> tuple[Array, Array, Array]:
        """Simulate the last plan; return the pump flow and the volumes on the roof, step by step.

        Args:
            rain: rain in every step (m/s), shape (members, n), which may differ from the plan's.
            member: index of the member whose decisions are followed; None if each member follows
                its own.

        Returns:
            The pump flow (m3/s), the volume on the roof at the end of the step (m3), and the volume
            to which the roof is filled (m3), or 0 if it is left alone; each of shape (members, n).
        """
        soil, content, (x1, x2) = self._soil, self._content, self._begin
        roof, water = np.full(len(rain), x2), np.full(len(rain), self._usable(x1))
        pumped, volumes, aimed = np.empty_like(rain), np.empty_like(rain), np.empty_like(rain)
        for step, (levels, groups) in enumerate(self._decisions):
            flow, potential, seconds = self._limits[step]
            level = self._levels(levels, groups if member is None else groups[member], water, roof)
            aimed[:, step] = np.where(level >= roof, level, 0.0)
            lifted = np.minimum(flow * seconds, water + self._p.mains_flow * seconds)
            reached = soil.predict_volume(roof, lifted, potential, seconds)
            filled = np.maximum(roof, np.minimum(level, reached))
            fallen = rain[:, step] * self._p.a2 * seconds
            alone = soil.predict_volume(filled, fallen, potential, seconds)
            held = np.minimum(filled, soil.predict_volume(filled, lifted, potential, seconds))
            held = np.where(level >= filled, np.maximum(alone, held), alone)
            uptake = content(filled) - content(roof) + content(held) - content(alone)
            uptake, roof = np.minimum(uptake, lifted), held
            water = self._predict_usable(water - uptake, rain[:, step], seconds)
            pumped[:, step], volumes[:, step] = uptake / seconds, roof
        return pumped, volumes, aimed

    def _content(self, x2: Any) -> Any:
        """Return the water (m3) needed to fill an empty roof to x2 or x*, whichever is less."""
        return self._soil.water_to_fill(np.minimum(x2, self._target))

    def _before(
        self, value: Array, rain: Array, group: Indices, strong: bool, flow: float,
        potential: float, seconds: float,
    ) -> tuple[Array, Array]:
        """Compute V before a step from V after it.

        Args:
            value: V after the step, shape (members, S, N).
            rain: rain in the step (m/s), shape (members, 1, 1).
            group: index of the group of each member.
            strong: whether neither the pumps nor the available water can limit the filling.
            flow: flow of the pumps (m3/s).
            potential: evapotranspiration from the whole bed in the step (m3).
            seconds: length of the step (s).

        Returns:
            V before the step, and the levels of the step, shape (groups, S, nodes to x*).
        """
        soil, dry = self._soil, slice(self._below + 1)
        nodes, roof = self._nodes, self._nodes[dry]
        scarce = len(self._water) > 1
        reach = roof if strong else soil.predict_volume(roof, flow * seconds, potential, seconds)
        # Left alone: computed once if it is the same for all members.
        if not rain.any():
            rain = rain[:1]
        alone = soil.predict_volume(nodes, rain * (self._p.a2 * seconds), potential, seconds)
        stored = remaining = self._water
        if scarce:
            remaining = np.maximum(self._water[:, None] - self._contents, 0.0)
            stored = self._predict_usable(remaining, rain, seconds) + self._content(alone)
        free = seconds * self._deviation(nodes, alone) + self._at(value, alone, stored)
        # Held.
        alone = alone[..., dry]
        if strong:
            held = seconds * (self._target - roof) + value[..., dry]
            holding = np.where(alone < roof, held, free[..., dry])
        else:
            held = np.maximum(alone, np.minimum(roof, reach))
            if scarce:
                first = self._content(alone)
                uptake = np.minimum(self._content(held) - first, remaining[..., dry])
                uptake = np.maximum(uptake, 0.0)
                held = np.where(uptake > 0, soil.fill_empty(first + uptake), alone)
                stored = self._predict_usable(remaining[..., dry] - uptake, rain, seconds)
                stored = stored + first + uptake
            holding = seconds * self._deviation(roof, held) + self._at(value, held, stored)
        # Filled.
        within = np.maximum(reach, roof)[None]
        if scarce:
            within = np.minimum(within, soil.fill_empty(self._water)[:, None])
            within = np.maximum(within, roof)
        levels = np.empty((group.max() + 1, len(self._water), len(roof)))
        result = free
        for index, level in enumerate(levels):
            members: Any = slice(None) if len(levels) == 1 else group == index
            ours, waiting = holding[members], free[members][..., dry]
            place = _find_minimum_onward(ours.mean(axis=0))
            best = roof[place]
            filled = best
            if strong:
                costs, contents = ours[..., place[0]], self._contents[place]
            else:
                filled = np.minimum(best, within)
                costs = self._at(ours, filled[None], self._water[:, None])
                # Exact if nothing is filled: rounding must not make holding look like a gain.
                costs = np.where(filled > roof, costs, ours)
                contents = self._content(filled)
            if flow > 0:
                costs = costs + (filled - roof) * (contents - self._contents[dry]) / (2 * flow)
            fills = costs.mean(axis=0) < waiting.mean(axis=0)
            level[:] = np.where(fills, best, -1.0)
            result[members, :, dry] = np.where(fills, costs, waiting)
        return result, levels

    def _deviation(self, before: Array, after: Array) -> Array:
        r"""Return the mean of \|x - x*\| on a straight path between two volumes (m3)."""
        first, last = before - self._target, after - self._target
        total = np.abs(first) + np.abs(last)
        # A path that crosses x* encloses two triangles.
        crossing = np.minimum(first * last, 0.0)
        return np.asarray(total / 2 + crossing / np.maximum(total, _MINIMUM))

    def _at(self, value: Array, x2: Array, water: Array) -> Array:
        """Return V at volumes on the roof and at s (m3); V is constant beyond the nodes.

        Args:
            value: V at the nodes, shape (members, S, nodes).
            x2: volumes on the roof (m3), shape (members or 1, S or 1, any).
            water: s (m3), of the same shape; not used if s has only one node.
        """
        members, rows, count = value.shape
        node, part = _between(self._nodes[:count], x2)

        def along(row: Any) -> Array:
            start = (np.arange(members)[:, None, None] * rows + row) * count + node
            low = value.take(start)
            return np.asarray(low + part * (value.take(start + 1) - low))

        if rows == 1:
            return along(0)
        row, share = _between(self._water, water)
        low = along(row)
        return np.asarray(low + share * (along(row + 1) - low))


def _between(nodes: Array, values: Any) -> tuple[Any, Any]:
    """Return the node at or below each value, and the fraction of the way to the next node."""
    row = nodes[1:-1].searchsorted(values, side="right")
    share = (values - nodes[row]) / np.diff(nodes)[row]
    return row, np.minimum(np.maximum(share, 0.0), 1.0)


def _find_minimum_onward(values: Array) -> Indices:
    """Return, for each position, the index of the first minimum from that position to the end."""
    minimum = np.minimum.accumulate(values[..., ::-1], axis=-1)[..., ::-1]
    places = np.where(values == minimum, np.arange(values.shape[-1]), values.shape[-1])
    return np.asarray(np.minimum.accumulate(places[..., ::-1], axis=-1)[..., ::-1])


def halve_by_rain(rain: Array, edges: Array, recourse: float) -> Indices:
    """Return the index of every member's group in every step, by its lowest member.

    The members of a group cannot be distinguished yet, so the pumping is the same for all of them.
    At first, all members form one group. After every period of ``recourse``, each group is split
    into halves: the members with less rain so far, and those with more. Ties are broken by the rain
    up to the next step, and so on. If the number of members is odd, the wetter half has one more
    member. Groups therefore only split, and in the end every member has a group of its own.

    No forecast reveals immediately which member will come true. A controller that assumed otherwise
    would wait, because it would expect to know everything soon. Heitsch and Roemisch (2009,
    Scenario tree modeling for multistage stochastic programs, doi:10.1007/s10107-007-0197-2) build
    a tree from scenarios that are identical up to each stage; here the members are split by rank,
    so that the size of the tree does not depend on the rain. The order in which the members are
    given does not matter.

    Args:
        rain: forecast of rain (m/s), shape (members, n).
        edges: boundaries of the steps (s from now), starting at 0, shape (n + 1,).
        recourse: time from one halving to the next (s).

    Returns:
        Indices from 0 on, without gaps in a step, shape (members, n).
    """
    members, n = rain.shape
    groups = np.zeros((members, n), dtype=np.intp)
    fallen = np.cumsum(rain * np.diff(edges), axis=1)
    halvings = np.diff(edges[:-1] // recourse)
    for step in np.repeat(np.arange(1, n), halvings.astype(int)):
        before = groups[:, step].copy()
        if before.max() == members - 1:
            break
        order = np.lexsort(fallen[:, step - 1 :].T[::-1])
        for label in range(before.max() + 1):
            together = order[before[order] == label]
            for half in np.split(together, [len(together) // 2]):
                groups[half, step] = half.min(initial=members)
        groups[:, step:] = np.unique(groups[:, step], return_inverse=True)[1][:, None]
    return groups
