"""The minimum wet-weather discharge for a given volume of mains water, if the weather is known.

HiGHS solves a linear program over the hours of a run. The roof receives the water that the run
pumps, while the valve of the low outlet and the mains can be controlled freely. Each weight of
mains water, from small to large, yields a point of the frontier. With the same irrigation and as
little mains water as at this point, no way of controlling the valve leads to less discharge in wet
weather. The proof is in doc/explanation/bound.md.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.storm_water import (
    HOUR_S,
    interval_seconds,
    is_wet,
    time_without_rain,
)
from greenroof_ros.physics.tick import step
from greenroof_ros.recording.trajectory import Trajectory
from greenroof_ros.simulation.bound import NoBoundError
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

WEIGHTS = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Costs of a m3 of mains water, in m3 of discharge in wet weather, one per point."""

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


def simulate_frontier(
    run: Run, weights: Sequence[float] = WEIGHTS,
    progress: Callable[[float], None] | None = None,
) -> Frontier:
    """Simulate a run, and return the frontier for the irrigation of the run.

    Args:
        run: run at a site with a valve.
        weights: weights of mains water, in ascending order.
        progress: as for :func:`.loop.simulate`.

    Raises:
        ConfigurationError: if the site has no valve.
        NoBoundError: if the solver finds no optimum.
    """
    if not run.site.low_outlet_valve:
        raise ConfigurationError(
            "must have a valve that releases storm water (low_outlet_valve: true)", key="site"
        )
    summary, trajectory = simulate(run, every=1, progress=progress)
    assert trajectory is not None
    points = bound_discharge(run, trajectory, weights)
    return Frontier(points, summary["wet_discharge_m3"], summary.get("mains_m3", 0.0))


def bound_discharge(
    run: Run, trajectory: Trajectory, weights: Sequence[float]
) -> list[FrontierPoint]:
    """Return the frontier for the irrigation of a run.

    Args:
        run: run at a site with a valve.
        trajectory: every tick of the run.
        weights: weights of mains water, in ascending order.

    Raises:
        NoBoundError: if the solver finds no optimum.
    """
    site, tau, seconds = run.site, run.site.tau, interval_seconds(run.site)
    rain, potential, pumped, drained = (
        values[: run.steps] for values in (
            trajectory.precipitation, trajectory.evapotranspiration, trajectory.pump_flow,
            trajectory.drainage,
        )
    )
    p, closed = plant_parameters(site), State(run.x1, run.x2, site.initial_layer)
    highest, wet, without_rain = array("d", [run.x1]), array("b"), run.without_rain_s
    for fell, evaporates, pumps in zip(
        rain.tolist(), potential.tolist(), pumped.tolist(), strict=True
    ):
        without_rain = time_without_rain(without_rain, fell, tau)
        wet.append(is_wet(without_rain, tau, site.wet_after * HOUR_S))
        closed = step(p, closed, fell, evaporates, 0.0, 0.0, pumps)[0]
        highest.append(closed.cistern)
    # An interval is in wet weather if all its ticks are, which can only lower the bound.
    starts = np.arange(0, run.steps, round(seconds / tau))
    is_wet_interval = np.logical_and.reduceat(wet, starts)
    begins = np.arange(len(starts)) % max(1, round(HOUR_S / seconds)) == 0
    begins |= np.diff(is_wet_interval, prepend=is_wet_interval[0])
    edges = np.append(starts[begins], run.steps)
    fallen, to_roof, from_roof = (
        tau * np.add.reduceat(values, edges[:-1]) for values in (rain, pumped, drained)
    )
    kept = site.drainage_to_cistern * from_roof
    # The last tick in which the pumps run begins at the suction level or above.
    lowest = min(run.x1, site.cistern_volume(site.suction_level)) - tau * pumped.max()
    steps = Steps(
        tau * np.diff(edges), is_wet_interval[begins], fallen * site.effective_catchment + kept,
        to_roof, np.array(highest)[edges], lowest,
    )
    of_roof = float((from_roof - kept)[steps.wet].sum())
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
    p = plant_parameters(site)
    released = seconds * [low_outlet_flow(p, volume + overdrawn) for volume in peaks.tolist()]
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
