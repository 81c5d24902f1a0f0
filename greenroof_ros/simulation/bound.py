"""What no controller can beat, even if it knows the weather: two linear programs over a run.

No run has a smaller total deviation than the optimum of :func:`clairvoyant_bound`, and
``tools/plan_of_a_run.py`` shows how close a plan comes to it. :func:`bound_discharge` yields the
minimum discharge in wet weather for some volumes of mains water. doc/explanation/bound.md shows how
tight they are.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.base.errors import ConfigurationError, FailedError
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import PlantParameters, State, plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.soil import (
    ALMOST_FULL,
    fill,
    percolation,
    roof_after_tick,
    water_to_fill,
)
from greenroof_ros.physics.storm_water import HOUR_S, find_wet, interval_seconds
from greenroof_ros.physics.tick import step
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.simulation.run import Run, Values

# Larger than the rounding errors of a year of ticks, and far too small to show in a bound.
_ROUNDING = 1e-9
# Accuracy of a filled share at which a limit may have its extreme (1).
_SHARE_ERROR = 1e-9
# The tightest that HiGHS accepts: a tick's evapotranspiration is usually only 1e-7 of x2*.
_TOLERANCES = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}

BLOCK_S = 60.0
"""time that usually shares a variable (s)"""

WEIGHTS = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Costs of a m3 of mains water, in m3 of discharge in wet weather, one per point."""

# In a short tick an outlet can take what stands this far above the water (m).
_OVERDRAWN = 1e-4
# Points of a frontier that differ by less are one (m3).
_SAME = 1e-3


class NoBoundError(FailedError):
    """Error raised if the solver finds no optimum; the solver's message states the reason."""


def _minimise(costs: Values, balance: Any, right: Values, lower: Values, upper: Values) -> Any:
    """Return scipy's solution of a linear program: the least costs z with balance z = right.

    Raises:
        NoBoundError: if the solver finds no optimum.
    """
    # Imported here because it takes half a second, and the first process of a study solves nothing.
    from scipy.optimize import linprog

    result = linprog(
        costs, A_eq=balance, b_eq=right, bounds=np.column_stack([lower, upper]), method="highs",
        options=_TOLERANCES,
    )
    if result.status != 0:
        raise NoBoundError(f"no bound found; the solver reports: {result.message}")
    return result


def clairvoyant_bound(run: Run, block_s: float, max_command: float = 1.0) -> float:
    r"""Bound the total deviation sum_{k=0..N} \|x_{k,2} - x2*\| of a run from below.

    The bound is the optimum of a linear program in the roof's volume x2 alone. Every run that the
    plant allows satisfies the constraints of the program, so the bound is at most the deviation of
    the best run:

    - In a tick, the change in volume is at most tau (r a2 - e - q_drain) plus the volume that the
      pumps can lift. This volume is tau times the maximum command times the full flow, Eq. (3e), at
      the initial cistern volume plus all rain until then, since outflow and pumping only lower the
      cistern. The pumped volume is 0 in frost and quiet hours, below the pumps' suction level, and
      if even the roof's minimum volume reaches a2 z_veg. A roof that runs dry loses all the water
      that it held, which is at least its minimum volume.
    - In a tick, the change in volume is at least tau (r a2 - e - q_drain). The range of q_drain,
      Eq. (4), covers the volumes that the roof can have; q_drain is 0 if they are all below z_cap.
    - The volumes that the roof can have are found by following both ends of their range with the
      same balance. Pumping stops at z_veg, so it raises the upper end of the range above z_veg by
      at most one tick's flow.
    - The total volume pumped before a tick is at most the initial volume plus all rain until then,
      minus the volume below the suction level, plus one tick's flow, because the last tick with
      pumping began at the suction level or above. The total volume pumped is also at most the
      volume of all water that the cistern has ever held.

    On a field-capacity soil, the limits apply to the volume after a tick minus a slope times the
    volume before it, and all pumped water is assumed to stay. The drainage layer does not matter.

    The program neglects four facts, so there can be a gap between the bound and the best run. The
    cistern can overflow, and the pump flow falls with the cistern's level. Pumping stops at z_veg,
    even if the range of the roof's volume also extends below it. Drainage and dryness follow from
    the roof's actual volume. A simulated plan (``tools/plan_of_a_run.py``) shows the gap.

    For each block of n ticks, the program has a single volume, the mean. The sum of \|x - x*\| over
    the block is at least n \|mean - x*\| (Jensen). If G_k is the sum of the largest changes before
    tick k, G_k - x_{k,2} never decreases. Its mean therefore does not fall from block to block
    either, so the mean volume rises by at most as much as the mean of G. The same argument holds
    for the smallest changes, and the limits of the volume hold for its mean. The bound therefore
    stays valid. On the paper's soil, the bound never rises if the length of a block is increased to
    a multiple of itself. On a field-capacity soil, whose limits depend on the size of the blocks,
    the bound can rise by up to 0.4 %.

    Let y_b be the mean of x2 - x2* in block b, in units of x2*, and n_b the number of ticks in the
    block. The program minimises the sum of n_b (p_b + m_b) subject to y_b = p_b - m_b = y_{b-1} +
    c_b, where y_{-1} is 0, and p, m and c have bounds. On a field-capacity soil, y_{b-1} is
    multiplied by a factor. In the optimum either p_b or m_b is 0, so the limits of y_b are limits
    of both p_b and m_b.

    The result is the cost of the dual program. Every variable z is between two limits, and the
    balance A z is 0. For any multipliers v, the sum of the minimum values of (w - A'v) z is a lower
    bound on w z, regardless of the solver's tolerance.

    Args:
        run: weather, site, initial state and length; its controller and forecast have no effect.
        block_s: length of a block (s), which is rounded to whole ticks and is at least one tick.
        max_command: maximum command (share of the maximum flow), from 1e-9 to 100.

    Returns:
        A total deviation (m3, summed over the ticks). No run with these inputs has a smaller total
        deviation, unless a command exceeds the maximum.

    Raises:
        NoBoundError: if the solver finds no optimum.
    """
    from scipy.sparse import diags, hstack, identity

    block = min(run.steps + 1, max(1, round(block_s / run.site.tau)))
    low, high, *changes = _limits(run, max_command)
    edges = np.arange(0, run.steps + 1, block)
    ticks, unit = np.diff(edges, append=run.steps + 1), run.site.x2_star

    def means(volumes: Values) -> Values:
        return np.asarray(np.add.reduceat(volumes / unit - 1, edges) / ticks)

    floor, ceiling = means(low), means(high)
    if run.site.field_capacity is None:
        factors = np.ones(len(edges))
        minimum, maximum = (
            np.diff(means(_sums(run.x2, limit)), prepend=0) for limit in changes[:2]
        )
    else:
        factors, minimum, maximum = _changes(block, low, high, *changes)
        minimum, maximum = (part / unit + factors - 1 for part in (minimum, maximum))
    zero = np.zeros_like(floor)
    lower = np.concatenate([np.maximum(floor, 0), np.maximum(-ceiling, 0), minimum])
    # If nothing can be pumped both are equal, and rounding must not set them apart.
    upper = np.concatenate(
        [np.maximum(ceiling, 0), np.maximum(-floor, 0), np.maximum(maximum, minimum)]
    )
    blocks = len(edges)
    step = diags([np.ones(blocks), -factors[1:]], [0, -1])
    weights = np.concatenate([ticks, ticks, zero]) / ticks[0]
    balance = hstack([step, -step, -identity(blocks)], format="csc")
    result = _minimise(weights, balance, zero, lower, upper)
    prices = weights - balance.T @ result.eqlin.marginals
    cost = unit * float(ticks[0]) * float(np.minimum(prices * lower, prices * upper).sum())
    # Anything less is the rounding error of a sum of zeros.
    return cost if cost > _ROUNDING * unit * run.steps else 0.0


def _sums(first: float, changes: Values) -> Values:
    return np.concatenate([[first], first + np.cumsum(changes)])


def _limits(run: Run, max_command: float) -> tuple[Values, ...]:
    """Return limits on the roof's volume in every run; :func:`clairvoyant_bound` derives them.

    Returns:
        The minimum and the maximum volume (m3), each of shape (N+1,); the minimum and the maximum
        of the volume after each tick minus slope times the volume before it (m3); and the slopes
        from 0 to 1, which are 1 on the paper's soil, so that the limits are of the change; each of
        shape (N,).
    """
    site, tau = run.site, run.site.tau
    rain, evapotranspiration, frost, quiet, _ = run.read_ticks(0, run.steps, site)
    # This assumes that the mains' valve is always open.
    received = _sums(run.x1, tau * (site.effective_catchment * rain + (site.mains_flow or 0.0)))
    # In a short tick the pumps lift water that was there before it.
    p = plant_parameters(site)
    held = received[:-1] if p.has_short_ticks else received[1:]
    flow = np.fromiter((maximum_pump_flow(p, x1) for x1 in held), float, run.steps)
    usable = held - site.a1 * site.suction_level
    full = np.where(usable < -_ROUNDING * held, 0, tau * max_command * flow)
    mains = np.where(full > 0, np.minimum(usable + full, received[1:]), 0)
    pumped = np.where(frost | quiet, 0, full)
    target, low, high = (1 + _ROUNDING) * site.a2 * site.z_veg, run.x2, run.x2
    ticks = array("d")
    for fallen, potential, lifted in zip(
        array("d", rain * site.a2), array("d", evapotranspiration), array("d", pumped), strict=True
    ):
        # Nothing is pumped if even the roof's minimum volume is above its target.
        limits = _limits_of_tick(p, low, high, fallen, potential, lifted if low <= target else 0.0)
        low, high = limits[:2]
        ticks.extend(limits)
    lows, highs, minimum, maximum, unpumped, slope = np.ascontiguousarray(
        np.reshape(ticks, (run.steps, -1)).T
    )
    supplied = _sums(run.x2, unpumped) + np.concatenate([[0], mains])
    lows, highs = np.append(run.x2, lows), np.append(run.x2, highs)
    # The plant adds in another order, so its last digits differ.
    slack = _ROUNDING * (site.x2_star + highs.max())
    return lows - slack, np.minimum(highs, supplied) + slack, minimum, maximum, slope


def _limits_of_tick(
    p: PlantParameters, low: float, high: float, rain: float, potential: float, max_pumped: float
) -> tuple[float, ...]:
    """Compute the range of the roof's volume after a tick.

    On a field-capacity soil, the retained share of arriving water falls with the volume, while
    evaporation and the excess above field capacity rise with the volume. The change without pumping
    is therefore largest at the minimum volume, as on the paper's soil, which drains above z_cap.
    The volume after a tick rises with the volume before it, by about the slope of the chord over
    the range. After subtraction of the slope times the volume before the tick, the limits are close
    together.

    Args:
        p: numbers of the site.
        low: minimum volume before the tick (m3).
        high: maximum volume before the tick (m3).
        rain: rain on the roof (m3/s).
        potential: evapotranspiration of plants without water stress (m3/s).
        max_pumped: maximum volume that the pumps can lift in the tick (m3).

    Returns:
        The minimum and the maximum volume after the tick; those of the volume minus the slope times
        the volume before the tick; the maximum change without pumping (m3); and the slope, which
        is 1 on the paper's soil.
    """
    slope = 1.0
    if p.has_field_capacity and high - low > _ROUNDING * p.z_cap:
        first, last = (roof_after_tick(p, x2, rain, potential) for x2 in (low, high))
        slope = min(1.0, max(0.0, (last - first) / (high - low)))
    reached = {}
    for line in (0.0, slope):
        ends = _ends(p, low, high, rain, potential, line)
        reached[line] = min(ends), max(ends)
        if max_pumped > 0:
            end = max(low, min(high, p.a2 * p.z_veg))
            pumped_to = max(_ends(p, low, end, rain + max_pumped / p.tau, potential, line))
            if not p.has_short_ticks:  # the pumps stop at the target
                full = (1 + _ROUNDING) * p.a2 * p.z_veg
                filled = max(full, roof_after_tick(p, full, rain, potential))
                pumped_to = min(pumped_to, filled - line * low)
            reached[line] = reached[line][0], max(reached[line][1], pumped_to)
    unpumped = max(_ends(p, low, low, rain, potential, 1.0))
    # A roof that runs dry ends at 0 and not below it: it loses the water it held, at least low.
    return (
        max(0.0, reached[0.0][0]), max(0.0, reached[0.0][1]), reached[slope][0],
        max(reached[slope][1], -slope * low), max(unpumped, -low), slope,
    )


def _ends(
    p: PlantParameters, low: float, high: float, arriving: float, potential: float, line: float
) -> list[float]:
    """Return candidates for the minimum and maximum volume after a tick, minus a line (m3).

    The drainage of the paper's soil begins at z_cap with a jump, and is linear above z_cap. The
    extremes are therefore at the ends of the range and on both sides of z_cap.

    On a field-capacity soil, the volume after a tick is a continuous function of the volume before
    the tick. The function is concave between the wilting point, the onset of stress and field
    capacity, and linear elsewhere: percolation leads from a filled share S0 to S1 with the slope
    (1 - S1^beta) / (1 - S0^beta), which falls as S0 rises if beta is at least 1. Subtracting a line
    changes neither property. The minimum is therefore at an end of one of these pieces, and the
    maximum is at an end or where the slope is 0.

    Args:
        p: numbers of the site.
        low: minimum volume before the tick (m3).
        high: maximum volume before the tick (m3).
        arriving: rain and pumped water (m3/s).
        potential: evapotranspiration of plants without water stress (m3/s).
        line: slope of the line, by which the volume before the tick is multiplied.
    """
    if not p.has_field_capacity:
        full, ends = p.z_cap, []
        for x2 in (low, min(max(low, full), high), high):
            after = x2 - line * x2 + p.tau * (arriving - potential)
            if x2 < (1 + _ROUNDING) * full:
                ends.append(after)
            if x2 >= (1 - _ROUNDING) * full:
                drained = percolation(p, max(x2, full), arriving, p.tau)
                ends.append(after - p.tau * drained)
        return ends
    dry, available = p.wilting_volume, p.available_volume
    drying = p.stress_onset * available
    volumes = [low, high]
    volumes += [x2 for x2 in (dry, dry + drying, p.z_cap) if low < x2 < high]
    arrived, exponent = p.tau * arriving, p.percolation_exponent
    if arrived > 0:
        # Below the wilting point the slope is 1 - S'^beta, S' being the share after the tick.
        volumes.append(dry - arrived)
        if 0 < line < 1:
            u = water_to_fill(exponent, 0.0, (1 - line) ** (1 / exponent))
            volumes.append(dry - arrived + available * u)
        # Above it, (1 - S'^beta) / (1 - S^beta) = steep, for the two pieces.
        for steep in (line, line + p.tau * potential / drying):
            if steep > 0:
                volumes.append(dry + available * _share_of_slope(p, arrived / available, steep))
        volumes = [x2 for x2 in volumes if low <= x2 <= high]
    return [roof_after_tick(p, x2, arriving, potential) - line * x2 for x2 in volumes]


def _share_of_slope(p: PlantParameters, u: float, slope: float) -> float:
    """Return the filled share at which the share after a tick has a slope, which falls with it (1).

    Args:
        p: numbers of the site.
        u: water that arrives in the tick (as a share of TAW).
        slope: the slope.
    """
    exponent = p.percolation_exponent
    if exponent == 2:  # (1 - g^2) / (1 + S g)^2
        g = math.tanh(u)
        return (math.sqrt((1 - g * g) / slope) - 1) / g
    low, high = 0.0, ALMOST_FULL
    while high - low > _SHARE_ERROR:
        middle = (low + high) / 2
        after = fill(exponent, middle, u)
        if (1 - after**exponent) / (1 - middle**exponent) > slope:
            low = middle
        else:
            high = middle
    return low


def _changes(
    block: int, floor: Values, ceiling: Values, minimum: Values, maximum: Values, slope: Values
) -> tuple[Values, Values, Values]:
    """Return the limits of a block's mean volume, given the previous one (field-capacity soil).

    Args:
        block: number of ticks of a block; the last of B blocks can be shorter.
        floor: minimum volume, from :func:`_limits` like the other arrays.
        ceiling: maximum volume.
        minimum: minimum of the volume after a tick minus the slope times the volume before it.
        maximum: maximum of the same.
        slope: slope of each tick.

    Returns:
        A factor, and the minimum and the maximum of a block's mean minus this factor times the
        previous block's mean (m3), each of shape (B,). The factor is 0 for the first block and for
        a shorter last one; the minimum and maximum are then the limits of the volume.
    """
    edges = np.arange(0, len(floor), block)
    sizes, factors = np.diff(edges, append=len(floor)), np.zeros(len(edges))
    least, most = (np.add.reduceat(volumes, edges) / sizes for volumes in (floor, ceiling))
    following = len(floor) // block - 1
    ticks, last = slice(following * block), slice(1, following + 1)
    factor, low, high = (each[ticks] for each in _compose(slope, minimum, maximum, block))
    mean = factor.reshape(following, block).mean(axis=1)
    # A tick's factor differs a little from its block's.
    off = factor - np.repeat(mean, block)
    ends = off * floor[ticks], off * ceiling[ticks]
    factors[last] = mean
    least[last] = (low + np.minimum(*ends)).reshape(-1, block).mean(axis=1)
    most[last] = (high + np.maximum(*ends)).reshape(-1, block).mean(axis=1)
    return factors, least, most


def _compose(
    slope: Values, minimum: Values, maximum: Values, ticks: int
) -> tuple[Values, Values, Values]:
    """Return the slope, minimum and maximum over ``ticks`` consecutive ticks, from each tick on.

    Slopes are not negative, so the minimum volume leads to the minimum result.
    """
    factor, low, high = slope, minimum, maximum
    for done in range(1, ticks):
        following = slope[done:]
        factor = following * factor[:-1]
        low = following * low[:-1] + minimum[done:]
        high = following * high[:-1] + maximum[done:]
    return factor, low, high


class FrontierPoint(NamedTuple):
    """A point of the frontier."""

    weight: float
    """weight of mains water: no run has a smaller sum of discharge and weighted mains water"""
    wet_discharge_m3: float
    """discharge in wet weather (m3)"""
    mains_m3: float
    """mains water (m3)"""


def bound_discharge(
    run: Run, trajectory: Trajectory, weights: Sequence[float] = WEIGHTS
) -> list[FrontierPoint]:
    """Return the minimum discharge in wet weather for some volumes of mains water.

    The program has a step per hour of the run. The roof receives the water that the run pumps,
    while the valve of the low outlet and the mains can be controlled freely. Each weight of mains
    water, from small to large, yields a point of the frontier. With the same irrigation and as
    little mains water as at this point, no way of controlling the valve leads to less discharge in
    wet weather.

    In each step, with the volume v at its beginning,

        v' = v + inflow + mains - pumped - released - overflow - other uses.

    - v' is at most the full volume, or the volume with a closed valve if this is larger: of two
      cisterns with the same inflow and pumping, the fuller one never becomes the emptier one.
    - v' is at least the volume that the pumps leave, because a tick with pumping begins at the
      suction level or above, and the low outlet is above this level.
    - The water released is at most the volume that the open valve drains from the highest level in
      the step. Mains water does not raise this level, since it flows in only far below the full
      volume.
    - The overflow is at most the inflow plus the volume above the upper outlet at the beginning.
    - The mains water is at most the volume that the mains can supply.
    - Other uses draw at most what they need, and take the rest from the mains.

    Every run with the same irrigation satisfies these conditions, so its discharge in wet weather
    plus the weighted mains water cannot be below the optimum.

    Args:
        run: run at a site with a valve.
        trajectory: every tick of the run.
        weights: weights of mains water, in ascending order.

    Returns:
        The points of the frontier, beginning with the most mains water.

    Raises:
        ConfigurationError: if the site has no valve.
        NoBoundError: if the solver finds no optimum.
    """
    from scipy.sparse import diags, hstack, identity

    if not run.site.low_outlet_valve:
        raise ConfigurationError(
            "must have a valve that releases storm water (low_outlet_valve: true)", key="site"
        )
    site, tau, seconds = run.site, run.site.tau, interval_seconds(run.site)
    rain, potential, pumped, drained = (
        values[: run.steps] for values in (
            trajectory.precipitation, trajectory.evapotranspiration, trajectory.pump_flow,
            trajectory.drainage,
        )
    )
    p, state = plant_parameters(site), State(run.x1, run.x2, site.initial_layer)
    closed = array("d", [run.x1])  # the volume in the cistern if the valve is always closed
    demand = run.read_ticks(0, run.steps, site)[4]
    inputs = (values.tolist() for values in (rain, potential, pumped, demand))
    for fallen, evaporated, *given in zip(*inputs, strict=True):
        state, _ = step(p, state, fallen, evaporated, 0.0, 0.0, *given)
        closed.append(state.cistern)
    wet, _ = find_wet(rain.tolist(), tau, p.wet_after_s, run.without_rain_s)
    # An interval is in wet weather if all its ticks are, which can only lower the bound. A step of
    # the program has up to an hour, either in wet or in dry weather.
    starts = np.arange(0, run.steps, round(seconds / tau))
    wet = np.logical_and.reduceat(wet, starts)
    begins = np.arange(len(starts)) % max(1, round(HOUR_S / seconds)) == 0
    begins |= np.diff(wet, prepend=wet[0])
    edges, wet = np.append(starts[begins], run.steps), wet[begins]
    arriving, to_roof, from_roof, needed = (
        tau * np.add.reduceat(values, edges[:-1]) for values in (rain, pumped, drained, demand)
    )
    kept = site.drainage_to_cistern * from_roof
    inflow, of_roof = arriving * site.effective_catchment + kept, (from_roof - kept)[wet].sum()
    # The last tick in which the pumps run begins at the suction level or above.
    lowest = min(run.x1, site.cistern_volume(site.suction_level)) - tau * pumped.max()
    full, overdrawn = site.cistern_volume(site.z_o), site.cistern_volume(_OVERDRAWN)
    highest, lengths, n = np.maximum(np.array(closed)[edges], full), tau * np.diff(edges), len(wet)
    peaks = highest[:-1] + inflow
    released = lengths * [low_outlet_flow(p, volume + overdrawn) for volume in peaks.tolist()]
    balance = hstack([
        diags([np.ones(n), -np.ones(n - 1)], [0, -1]), identity(n), identity(n), -identity(n),
        identity(n),
    ], format="csc")
    change = inflow - to_roof
    change[0] += run.x1
    lower = np.concatenate((np.full(n, lowest - overdrawn), np.zeros(4 * n)))
    upper = np.concatenate((
        highest[1:] + overdrawn, released, peaks - full + overdrawn,
        lengths * (site.mains_flow or 0.0), needed,
    ))
    points: list[FrontierPoint] = []
    for weight in weights:
        costs = np.concatenate((np.zeros(n), wet, wet, np.full(n, weight), np.full(n, -weight)))
        _, out, over, let_in, other = np.split(
            _minimise(costs, balance, change, lower, upper).x, 5
        )
        mains = float((let_in + needed - other).sum())
        found = of_roof + float((out + over)[wet].sum()), mains
        if not points or max(map(abs, np.subtract(found, points[-1][1:]))) > _SAME:
            points.append(FrontierPoint(weight, *found))
    return points
