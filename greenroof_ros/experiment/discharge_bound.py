"""The minimum discharge in wet weather for an amount of mains water, with all weather known.

A linear program over the hours of a run, solved by HiGHS. The roof takes the water that a given
run pumps; outlet and mains are free. Weights of mains water, from little to much, give the points
of the frontier: no control of the outlet can have less discharge in wet weather with as little
mains water, for the same irrigation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.experiment.clairvoyant import NoBoundError
from greenroof_ros.experiment.closed_loop import Simulation
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.plant import low_outlet_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.storm_water import Intervals, find_wet_weather

Values = NDArray[np.float64]

WEIGHTS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Costs of a m3 of mains water, in m3 of discharge in wet weather, one for each point."""

_HOUR_S = 3600.0


class FrontierPoint(NamedTuple):
    """A point of the frontier."""

    weight: float
    """of mains water"""
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


def simulate_frontier(run: Run) -> Frontier:
    """Simulate a run, and return the frontier for the irrigation that it had.

    Args:
        run: at a site with a valve, whose ticks divide an hour; of at least an hour.

    Raises:
        ConfigurationError: the site has no valve, or a tick that does not divide an hour.
        NoBoundError: the solver found no optimum.
    """
    site, per_hour = run.site, round(_HOUR_S / run.site.tau)
    if not site.low_outlet_valve:
        raise ConfigurationError(
            "needs a valve that lets storm water out (low_outlet_valve: true)", key="site"
        )
    if per_hour * site.tau != _HOUR_S or run.steps < per_hour:
        raise ConfigurationError("must divide an hour", key="tau", value=site.tau)
    simulation = Simulation(run)
    flows = np.array([
        (tick.precipitation, tick.flows.pump, site.drainage_to_cistern * tick.flows.drainage)
        for tick in simulation.ticks()
    ])
    hours = run.steps // per_hour
    sums = site.tau * flows[: hours * per_hour].reshape(hours, per_hour, 3).sum(axis=1)
    rain, pumped, kept = sums.T
    wet = find_wet_weather(site, Intervals(_HOUR_S, rain, rain))
    points = find_frontier(site, run.x1, rain * site.effective_catchment + kept, pumped, wet)
    results = simulation.metrics.results()
    return Frontier(points, results["wet_discharge_m3"], results.get("mains_m3", 0.0))


def find_frontier(
    site: Site, x1: float, inflow: Values, pumped: Values, wet: NDArray[np.bool_],
) -> list[FrontierPoint]:
    """Return the frontier, the point with the most mains water first.

    In each hour, with the volume v at its beginning,

        v' = v + inflow + mains - pumped - released - overflow,

    released is at most what the open valve takes from a full cistern, overflow at most what has
    flowed in within two hours, mains at most what its pipe gives. The volume stays above the
    suction level, and above the outlet only with what flowed in within the hour. So each run of
    the site is a solution, but for what lies between two hours.

    Args:
        site: with a valve.
        x1: in the cistern at the beginning (m3).
        inflow: in each hour (m3), shape (n,).
        pumped: in each hour (m3), shape (n,).
        wet: whether an hour is in wet weather, shape (n,).

    Raises:
        NoBoundError: the solver found no optimum.
    """
    from scipy.optimize import linprog
    from scipy.sparse import diags, hstack, identity

    n = len(inflow)
    full, before = site.cistern_volume(site.z_o), np.append(0.0, inflow[:-1])
    released = _HOUR_S * low_outlet_flow(site, full + float(inflow.max(initial=0.0)))
    floor = min(x1, site.cistern_volume(site.suction_level))
    mains = _HOUR_S * (site.mains_flow or 0.0)
    step = diags([np.ones(n), -np.ones(n - 1)], [0, -1])
    balance = hstack([step, identity(n), identity(n), -identity(n)], format="csc")
    change = inflow - pumped
    change[0] += x1
    bounds = np.column_stack((
        np.concatenate((np.full(n, floor), np.zeros(3 * n))),
        np.concatenate((
            full + inflow, np.full(n, released), inflow + before, np.full(n, mains),
        )),
    ))
    points = []
    for weight in WEIGHTS:
        costs = np.concatenate((np.zeros(n), wet, wet, np.full(n, weight)))
        result = linprog(costs, A_eq=balance, b_eq=change, bounds=bounds, method="highs")
        if result.status != 0:
            raise NoBoundError(result.message)
        _, out, over, let_in = np.split(result.x, 4)
        points.append(FrontierPoint(
            weight, float((out + over)[wet].sum()), float(let_in.sum())
        ))
    return points
