"""The minimum total deviation of any controller, between two bounds.

A linear program yields a lower bound. The simulation of the plan that ``lookahead`` makes with
perfect knowledge of the weather yields an upper bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.order_up_to import BELOW_M3, OrderUpTo
from greenroof_ros.forecast.resampling import PerfectForecast
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.tick import command_to
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.simulation.roof_range import ROUNDING, RoofRange, roof_range
from greenroof_ros.simulation.run import Run

Values = NDArray[np.float64]

# The tightest that HiGHS accepts: a tick's evapotranspiration is usually only 1e-7 of x2*.
_TOLERANCES = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}

# Length of a step of the plan (s); maximum number of steps, because their levels need memory;
# numbers of nodes below and above the target.
_STEP_S, _MAX_STEPS = 300.0, 10_000
_NODES = 3000, 1000

BLOCK_S = 60.0
"""time that usually shares a variable (s)"""


class NoBoundError(Exception):
    """Error raised if the solver finds no optimum; the solver's message states the reason."""


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
    volume before it. The drainage layer does not matter. The proof is in doc/explanation/bound.md.

    The program neglects four facts, so there can be a gap between the bound and the best run. The
    cistern can overflow, and the pump flow falls with the cistern's level. Pumping stops at z_veg,
    even if the range of the roof's volume also extends below it. Drainage and dryness follow from
    the roof's actual volume. A simulated plan (:func:`simulate_plan`) shows the gap.

    For each block of n ticks, the program has a single volume, the mean. The sum of \|x - x*\| over
    the block is at least n \|mean - x*\| (Jensen). If G_k is the sum of the largest changes before
    tick k, G_k - x_{k,2} never decreases. Its mean therefore does not fall from block to block
    either, so the mean volume rises by at most as much as the mean of G. The same argument holds
    for the smallest changes, and the limits of the volume hold for its mean. The bound therefore
    stays valid. On the paper's soil, the bound never rises if the length of a block is increased to
    a multiple of itself. On a field-capacity soil, whose limits depend on the size of the blocks,
    the bound can rise by up to 0.4 %.

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
    block = max(1, round(block_s / run.site.tau))
    return _solve(run, _limits(run, max_command), np.arange(0, run.steps + 1, block))


def _conditions(run: Run) -> tuple[Values, Values, NDArray[np.bool_]]:
    """Return rain, evapotranspiration and whether pumping is allowed in the ticks 0..N-1."""
    site, series = run.site, run.series
    rain, evapotranspiration, frost = (
        np.frombuffer(values[: run.steps])
        for values in (series.precipitation, series.evapotranspiration, series.frost)
    )
    may_pump = np.asarray(frost == 0)
    if site.quiet is not None:
        may_pump &= ~site.quiet.quiet_ticks(run.time_ns(0), round(site.tau * 1e9), run.steps)
    return rain, evapotranspiration, may_pump


def _sums(first: float, changes: Values) -> Values:
    return np.concatenate([[first], first + np.cumsum(changes)])


def _limits(run: Run, max_command: float) -> RoofRange:
    """Return the limits of every run; :func:`clairvoyant_bound` derives them."""
    site, tau = run.site, run.site.tau
    rain, evapotranspiration, may_pump = _conditions(run)
    # This assumes that the mains' valve is always open.
    received = _sums(run.x1, tau * (site.effective_catchment * rain + (site.mains_flow or 0.0)))
    # In a short tick the pumps lift water that was there before it.
    p = plant_parameters(site)
    held = received[:-1] if p.has_short_ticks else received[1:]
    flow = np.fromiter((maximum_pump_flow(p, x1) for x1 in held), float, run.steps)
    usable = held - site.a1 * site.suction_level
    full = np.where(usable < -ROUNDING * held, 0, tau * max_command * flow)
    mains = np.where(full > 0, np.minimum(usable + full, received[1:]), 0)
    pumped = np.where(may_pump, full, 0)

    roof = roof_range(site, run.x2, rain, evapotranspiration, pumped)
    supplied = _sums(run.x2, roof.unpumped) + np.concatenate([[0], mains])
    # The plant adds in another order, so its last digits differ.
    slack = ROUNDING * (site.x2_star + roof.high.max())
    high = np.minimum(roof.high, supplied) + slack
    return roof._replace(low=roof.low - slack, high=high)


def _solve(run: Run, limits: RoofRange, edges: NDArray[np.int64]) -> float:
    """Solve the program of :func:`clairvoyant_bound`.

    Let y_b be the mean of x2 - x2* in block b, in units of x2*, and n_b the number of ticks in the
    block. The program minimises the sum of n_b (p_b + m_b) subject to y_b = p_b - m_b = y_{b-1} +
    c_b, where y_{-1} is 0, and p, m and c have bounds. On a field-capacity soil, y_{b-1} is
    multiplied by a factor. In the optimum either p_b or m_b is 0, so the limits of y_b are limits
    of both p_b and m_b.

    The result is the cost of the dual program. Every variable z is between two limits, and the
    balance A z is 0. For any multipliers v, the sum of the minimum values of (w - A'v) z is a lower
    bound on w z, regardless of the solver's tolerance.

    Args:
        run: the run.
        limits: limits of the run.
        edges: first tick of each block, shape (B,).

    Returns:
        A lower bound on the cost (m3).

    Raises:
        NoBoundError: if the solver finds no optimum.
    """
    # Imported here because it takes half a second, and the first process of a study solves nothing.
    from scipy.optimize import linprog
    from scipy.sparse import diags, hstack, identity

    unit = run.site.x2_star
    ticks = np.diff(edges, append=run.steps + 1)

    def means(volumes: Values) -> Values:
        return np.asarray(np.add.reduceat(volumes / unit - 1, edges) / ticks)

    floor, ceiling = means(limits.low), means(limits.high)
    if limits.slope is None:
        factors = np.ones(len(edges))
        minimum = np.diff(means(_sums(run.x2, limits.minimum)), prepend=0)
        maximum = np.diff(means(_sums(run.x2, limits.maximum)), prepend=0)
    else:
        factors, minimum, maximum = _changes(limits, limits.slope, edges)
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
    result = linprog(
        weights, A_eq=balance, b_eq=zero, bounds=np.column_stack([lower, upper]), method="highs",
        options=_TOLERANCES,
    )
    if result.status != 0:
        raise NoBoundError(result.message)
    prices = weights - balance.T @ result.eqlin.marginals
    cost = unit * float(ticks[0]) * float(np.minimum(prices * lower, prices * upper).sum())
    # Anything less is the rounding error of a sum of zeros.
    return cost if cost > ROUNDING * unit * run.steps else 0.0


def _changes(
    limits: RoofRange, slope: Values, edges: NDArray[np.int64]
) -> tuple[Values, Values, Values]:
    """Return the limits of a block's mean volume, given the previous one (field-capacity soil).

    Returns:
        A factor, and the minimum and the maximum of a block's mean minus this factor times the
        previous block's mean (m3), each of shape (B,). The factor is 0 for a block that does not
        follow a block of the same length; the minimum and maximum are then the limits of the
        volume.
    """
    floor, ceiling = limits.low, limits.high
    sizes = np.diff(edges, append=len(floor))
    factors = np.zeros(len(edges))
    minimum, maximum = (
        np.add.reduceat(volumes, edges) / sizes for volumes in (floor, ceiling)
    )
    block = sizes[0]
    following = int(np.count_nonzero(sizes == block)) - 1
    if following > 0:
        count = following * block
        factor, low, high = _compose(slope, limits.minimum, limits.maximum, block)
        factor, low, high = factor[:count], low[:count], high[:count]
        mean = factor.reshape(following, block).mean(axis=1)
        # A tick's factor differs a little from its block's.
        off = factor - np.repeat(mean, block)
        ends = off * floor[:count], off * ceiling[:count]
        factors[1 : following + 1] = mean
        minimum[1 : following + 1] = (low + np.minimum(*ends)).reshape(-1, block).mean(axis=1)
        maximum[1 : following + 1] = (high + np.maximum(*ends)).reshape(-1, block).mean(axis=1)
    return factors, minimum, maximum


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


def simulate_plan(run: Run, max_command: float = 1.0) -> dict[str, float]:
    """Carry out a plan for a whole run, with an exact sensor and a perfect forecast.

    :class:`~greenroof_ros.controllers.order_up_to.OrderUpTo` plans the run in steps of five
    minutes, or of a ten-thousandth of a long run. The time after the run is not considered, and the
    soil is not simplified. For every site, the total deviation of the plan is an upper bound on the
    minimum possible total deviation.

    Args:
        run: weather, site, pumps, initial state and length; its controller, its forecast and the
            errors of its sensor have no effect.
        max_command: maximum command (share of the maximum flow).

    Returns:
        The metrics of the run, by name.
    """
    known = replace(
        run, forecast=PerfectForecast(run.series, 1),
        sensor_and_pump=replace(run.sensor_and_pump, roof_noise=0.0, roof_offset=0.0),
    )
    simulation = Simulation(known, _PlanController(run, max_command))
    for _ in simulation.ticks():
        pass
    return simulation.metrics.results(simulation.site.state)


class _PlanController:
    """Controller that fills the roof to the levels of a plan for the whole run."""

    parameters: ClassVar[tuple[Parameter, ...]] = ()

    def __init__(self, run: Run, max_command: float) -> None:
        """Make the plan; see :func:`simulate_plan`."""
        site, n = run.site, run.steps
        self._site, self._p, self._steps = site, plant_parameters(site), n
        self._max_command = max_command
        self._tick = -1
        self._block = max(1, round(_STEP_S / site.tau), -(-n // _MAX_STEPS))
        starts = np.arange(0, n, self._block)
        rain, evaporated, pumping = (
            np.add.reduceat(values.astype(float), starts) / np.diff(starts, append=n)
            for values in _conditions(run)
        )
        flow = max_command * maximum_pump_flow(self._p, run.x1) * pumping
        self._program, edges = OrderUpTo(site, fine=_NODES), site.tau * np.append(starts, n)
        together = np.zeros((1, len(starts)), dtype=np.intp)
        self._policy = self._program.solve(
            edges, run.x1, run.x2, rain[None], evaporated, flow, together
        )

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the command for the current tick, which is 0 in the last tick of the run."""
        self._tick += 1
        if self._tick == self._steps:
            return 0.0
        site = self._site
        x1, x2 = site.cistern_volume(cistern_level), site.roof_volume(roof_level)
        level = self._program.level(self._policy, self._tick * site.tau, x1, x2)
        if level < x2:
            return 0.0
        now = precipitation[0], evapotranspiration[0]
        command = command_to(self._p, x1, x2, level - BELOW_M3, *now)
        return min(command, self._max_command)

    def skip(self) -> None:
        """Count a tick in which the pumps must not run."""
        self._tick += 1

    def statistics(self) -> None:
        """Return None, because there is no solver."""
