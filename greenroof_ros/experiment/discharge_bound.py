"""The minimum discharge in wet weather for an amount of mains water, with all weather known.

A linear program over the hours of a run, solved by HiGHS. The roof gets what a given run pumps;
the valve of the low outlet and the mains are free. Weights of mains water, from little to much,
give the points of the frontier: no control of the valve can have less discharge in wet weather with
as little mains water, for the same irrigation. doc/explanation/bound.md has the proof.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.experiment.clairvoyant import NoBoundError
from greenroof_ros.experiment.closed_loop import Simulation, Tick
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.plant import Plant, low_outlet_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.storm_water import Intervals, find_wet_weather, interval_seconds

Values = NDArray[np.float64]

WEIGHTS = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Costs of a m3 of mains water, in m3 of discharge in wet weather, one for each point."""

_HOUR_S = 3600.0
# In a short tick an outlet can take what stands this far above the water (m).
_OVERDRAWN = 1e-4
# Points that differ by less are one (m3).
_SAME = 1e-3


class FrontierPoint(NamedTuple):
    """A point of the frontier."""

    weight: float
    """of mains water: each run has at least this point's sum of discharge and weighted mains"""
    wet_discharge_m3: float
    """discharge in wet weather"""
    mains_m3: float
    """mains water"""


class Frontier(NamedTuple):
    """The frontier of a run, and the run itself."""

    points: list[FrontierPoint]
    """the one with the most mains water first"""
    wet_discharge_m3: float
    """the run's discharge in wet weather"""
    mains_m3: float
    """the run's mains water"""

    def at(self, weight: float) -> FrontierPoint:
        """Return the point for a weight of mains water, one of :data:`WEIGHTS`."""
        return max(
            (point for point in self.points if point.weight <= weight),
            key=lambda point: point.weight,
        )


class Steps(NamedTuple):
    """Steps of a run of up to an hour, each in wet or in dry weather; arrays have shape (n,)."""

    seconds: Values
    """duration (s)"""
    wet: NDArray[np.bool_]
    """whether it is in wet weather"""
    inflow: Values
    """rain and kept drainage into the cistern (m3)"""
    pumped: Values
    """to the roof (m3)"""
    highest: Values
    """in the cistern at the beginning, if the valve is always closed (m3); shape (n + 1,)"""
    lowest: float
    """what the pumps leave in the cistern (m3)"""


def simulate_frontier(run: Run, watch: Callable[[Tick], object] | None = None) -> Frontier:
    """Simulate a run, and return the frontier for the irrigation that it had.

    Args:
        run: at a site with a valve.
        watch: is called with each tick.

    Raises:
        ConfigurationError: the site has no valve.
        NoBoundError: the solver found no optimum.
    """
    simulation = Simulation(run)

    def flows() -> Iterator[tuple[float, float, float, float]]:
        for tick in simulation.ticks():
            if watch is not None:
                watch(tick)
            yield (
                tick.precipitation, tick.evapotranspiration, tick.flows.pump, tick.flows.drainage
            )

    points = bound_discharge(run, flows())
    results = simulation.metrics.results()
    return Frontier(points, results["wet_discharge_m3"], results.get("mains_m3", 0.0))


def bound_discharge(
    run: Run, flows: Iterable[tuple[float, float, float, float]],
    weights: Sequence[float] = WEIGHTS,
) -> list[FrontierPoint]:
    """Return the frontier for the irrigation that a run had.

    Args:
        run: at a site with a valve.
        flows: of the ticks 0..N: rain (m/s), evapotranspiration, and what was pumped and drained
            off the roof (m3/s).
        weights: weights of mains water, rising.

    Raises:
        ConfigurationError: the site has no valve.
        NoBoundError: the solver found no optimum.
    """
    site, tau = run.site, run.site.tau
    if not site.low_outlet_valve:
        raise ConfigurationError(
            "needs a valve that lets storm water out (low_outlet_valve: true)", key="site"
        )
    seconds = interval_seconds(site)
    ticks = round(seconds / tau)  # of an interval
    closed, rows = Plant(site, run.x1, run.x2), array("d")
    rain = pumped = drainage = most_pumped = 0.0
    for k, (rains, evaporates, pumps, drains) in enumerate(flows):
        if k % ticks == 0 or k == run.steps:
            rows.extend((k * tau, closed.x1, tau * rain, tau * pumped, tau * drainage))
            rain = pumped = drainage = 0.0
        rain, pumped, drainage = rain + rains, pumped + pumps, drainage + drains
        most_pumped = max(most_pumped, tau * pumps)
        closed.step(rains, closed.flows(rains, evaporates, 0.0, pumps, outlet=0.0))
    times, highest, *sums = np.frombuffer(rows).reshape(-1, 5).T
    depths = sums[0][1:]
    wet = find_wet_weather(site.wet_after, Intervals(seconds, depths, depths))
    begins = np.arange(len(wet)) % max(1, round(_HOUR_S / seconds)) == 0
    begins |= np.diff(wet, prepend=wet[0])
    firsts = np.flatnonzero(begins)
    fallen, to_roof, drained = (np.add.reduceat(values[1:], firsts) for values in sums)
    kept, ends = site.drainage_to_cistern * drained, [*firsts, len(wet)]
    # The last tick that pumps begins at the suction level or above.
    lowest = min(run.x1, site.cistern_volume(site.suction_level)) - most_pumped
    steps = Steps(
        np.diff(times[ends]), wet[firsts], fallen * site.effective_catchment + kept, to_roof,
        highest[ends], lowest,
    )
    of_roof = float((drained - kept)[steps.wet].sum())
    return [
        point._replace(wet_discharge_m3=of_roof + point.wet_discharge_m3)
        for point in find_frontier(site, run.x1, steps, weights)
    ]


def find_frontier(
    site: Site, x1: float, steps: Steps, weights: Sequence[float] = WEIGHTS
) -> list[FrontierPoint]:
    """Return the frontier without the roof's drainage, the point with the most mains water first.

    In each step, with the volume v at its beginning,

        v' = v + inflow + mains - pumped - released - overflow.

    - v' is at most full, or what it is with a closed valve if that is more. It is at least what the
      pumps leave.
    - Released is at most what the open valve takes from the highest volume in the step.
    - Overflow is at most what flows in and what stands above the upper outlet at the beginning.
    - Mains is at most what its pipe gives.

    Each run with this irrigation satisfies this, so its discharge in wet weather plus the weighted
    mains water is not below the optimum.

    Args:
        site: site with a valve.
        x1: volume in the cistern at the beginning (m3).
        steps: steps of the run.
        weights: weights of mains water, rising.

    Raises:
        NoBoundError: the solver found no optimum.
    """
    from scipy.optimize import linprog
    from scipy.sparse import diags, hstack, identity

    n, (seconds, wet, inflow, pumped, highest, lowest) = len(steps.wet), steps
    full, overdrawn = site.cistern_volume(site.z_o), site.cistern_volume(_OVERDRAWN)
    peaks = np.maximum(highest[:-1], full) + inflow
    released = seconds * [low_outlet_flow(site, volume + overdrawn) for volume in peaks.tolist()]
    step = diags([np.ones(n), -np.ones(n - 1)], [0, -1])
    balance = hstack([step, identity(n), identity(n), -identity(n)], format="csc")
    change = inflow - pumped
    change[0] += x1
    bounds = np.column_stack((
        np.concatenate((np.full(n, lowest - overdrawn), np.zeros(3 * n))),
        np.concatenate((
            np.maximum(highest[1:], full) + overdrawn, released,
            peaks - full + overdrawn, seconds * (site.mains_flow or 0.0),
        )),
    ))
    points: list[FrontierPoint] = []
    for weight in weights:
        costs = np.concatenate((np.zeros(n), wet, wet, np.full(n, weight)))
        result = linprog(costs, A_eq=balance, b_eq=change, bounds=bounds, method="highs")
        if result.status != 0:
            raise NoBoundError(result.message)
        _, out, over, let_in = np.split(result.x, 4)
        found = float((out + over)[wet].sum()), float(let_in.sum())
        if not points or max(map(abs, np.subtract(found, points[-1][1:]))) > _SAME:
            points.append(FrontierPoint(weight, *found))
    return points
