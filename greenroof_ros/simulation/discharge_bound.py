"""The minimum wet-weather discharge for a given volume of mains water, if the weather is known.

HiGHS solves a linear program over the hours of a run. The roof receives the water that the run
pumps, while the valve of the low outlet and the mains can be controlled freely. Each weight of
mains water, from small to large, yields a point of the frontier. With the same irrigation and as
little mains water as at this point, no way of controlling the valve leads to less discharge in wet
weather. The proof is in doc/explanation/bound.md.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.physics.plant import Plant, low_outlet_flow
from greenroof_ros.physics.storm_water import Intervals, find_wet_weather, interval_seconds
from greenroof_ros.simulation.bound import NoBoundError
from greenroof_ros.simulation.loop import Simulation, Tick
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

WEIGHTS = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Costs of a m3 of mains water, in m3 of discharge in wet weather, one per point."""

_HOUR_S = 3600.0
# In a short tick an outlet can take what stands this far above the water (m).
_OVERDRAWN = 1e-4
# Points that differ by less are one (m3).
_SAME = 1e-3


class FrontierPoint(NamedTuple):
    """A point of the frontier."""

    weight: float
    """weight of mains water: no run has a smaller sum of discharge and weighted mains water"""
    wet_discharge_m3: float
    """discharge in wet weather (m3)"""
    mains_m3: float
    """mains water"""


class Frontier(NamedTuple):
    """The frontier of a run, and the run itself."""

    points: list[FrontierPoint]
    """points, beginning with the one with the most mains water"""
    wet_discharge_m3: float
    """discharge of the run in wet weather (m3)"""
    mains_m3: float
    """mains water used in the run (m3)"""

    def at(self, weight: float) -> FrontierPoint:
        """Return the point for a weight of mains water, one of :data:`WEIGHTS`."""
        return max(
            (point for point in self.points if point.weight <= weight),
            key=lambda point: point.weight,
        )


class Steps(NamedTuple):
    """Steps of up to an hour, each in either wet or dry weather; arrays have shape (n,)."""

    seconds: Values
    """duration (s)"""
    wet: NDArray[np.bool_]
    """whether the step is in wet weather"""
    inflow: Values
    """rain and kept drainage into the cistern (m3)"""
    pumped: Values
    """water pumped to the roof (m3)"""
    highest: Values
    """volume in the cistern at the beginning if the valve is always closed (m3), shape (n + 1,)"""
    lowest: float
    """volume that the pumps leave in the cistern (m3)"""


def simulate_frontier(run: Run, watch: Callable[[Tick], object] | None = None) -> Frontier:
    """Simulate a run, and return the frontier for the irrigation of the run.

    Args:
        run: run at a site with a valve.
        watch: callback that receives every tick.

    Raises:
        ConfigurationError: if the site has no valve.
        NoBoundError: if the solver finds no optimum.
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
    """Return the frontier for the irrigation of a run.

    Args:
        run: run at a site with a valve.
        flows: rain (m/s), evapotranspiration, pumped water and drainage of the roof (m3/s) in the
            ticks 0..N.
        weights: weights of mains water, in ascending order.

    Raises:
        ConfigurationError: if the site has no valve.
        NoBoundError: if the solver finds no optimum.
    """
    site, tau = run.site, run.site.tau
    if not site.low_outlet_valve:
        raise ConfigurationError(
            "must have a valve that releases storm water (low_outlet_valve: true)", key="site"
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
    # The last tick in which the pumps run begins at the suction level or above.
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
    """Return the frontier without the roof's drainage, beginning with the most mains water.

    In each step, with the volume v at its beginning,

        v' = v + inflow + mains - pumped - released - overflow.

    - v' is at most the full volume, or the volume with a closed valve if this is larger. v' is at
      least the volume that the pumps leave.
    - The water released is at most the volume that the open valve drains from the highest level in
      the step.
    - The overflow is at most the inflow plus the volume above the upper outlet at the beginning.
    - The mains water is at most the volume that the mains can supply.

    Every run with the same irrigation satisfies these conditions, so its discharge in wet weather
    plus the weighted mains water cannot be below the optimum.

    Args:
        site: site with a valve.
        x1: volume in the cistern at the beginning (m3).
        steps: steps of the run.
        weights: weights of mains water, in ascending order.

    Raises:
        NoBoundError: if the solver finds no optimum.
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
