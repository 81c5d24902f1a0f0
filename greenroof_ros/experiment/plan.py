"""Plans made with perfect knowledge of the weather, and run in the exact plant."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from greenroof_ros.controllers.order_up_to import BELOW_M3, OrderUpTo
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import Plant, command_to, maximum_pump_flow
from greenroof_ros.model.soil import soil_of

TargetVolume = Callable[[int, float, float], float]

# For the recursion: length of a step (s); largest number of steps, since their levels need memory;
# nodes below and above the target.
_STEP_S, _MOST_STEPS = 300.0, 10_000
_NODES = 3000, 1000


class PlanResult(NamedTuple):
    """A plan that was run through the exact plant."""

    total_m3: float
    """total deviation (m3, summed over the ticks)"""
    pumped_m3: float
    """volume pumped (m3)"""


def run_plan(run: Run, target: TargetVolume, max_command: float) -> PlanResult:
    """Run a plan through the exact plant, without the run's errors of sensor and pumps.

    Args:
        run: weather, site, initial state and length; its controller and forecast do not matter.
        target: returns the volume that the roof shall have at the end of a tick (m3), given the
            tick's index and the volumes in cistern and on roof (m3).
        max_command: largest command (share of the maximum flow).
    """
    site, soil, series, n = run.site, soil_of(run.site), run.series, run.steps
    plant, metrics = Plant(site, run.x1, run.x2), Metrics()
    weather = series.precipitation[:n], series.evapotranspiration[:n], series.frost[:n]
    for k, (rain, potential, frost) in enumerate(zip(*weather, strict=True)):
        command = 0.0
        if not frost:
            # As a controller sees them: from levels, which are rounded.
            cistern, roof = plant.levels()
            x1, x2 = site.cistern_volume(cistern), site.roof_volume(roof)
            command = command_to(site, soil, x1, x2, target(k, x1, x2), rain, potential)
            command = min(command, max_command)
        moved = plant.flows(rain, potential, plant.pump_flow(command))
        metrics.observe(site, plant.x1, plant.x2, plant.layer)
        metrics.step(command, rain, potential, moved)
        plant.step(rain, moved)
    metrics.observe(site, plant.x1, plant.x2, plant.layer)
    results = metrics.results()
    return PlanResult(results["total_deviation_m3"], results["pumped_m3"])


def recursion_plan(run: Run, max_command: float = 1.0) -> PlanResult:
    """Carry out the plan of ``lookahead``'s recursion for a run with known weather.

    :class:`~greenroof_ros.controllers.order_up_to.OrderUpTo` plans the whole run, after which
    nothing counts, in steps of five minutes, or of a ten-thousandth of a long run. It does not
    simplify the soil. Its total bounds the minimum possible total from above, on every site.

    Args:
        run: as for :func:`run_plan`.
        max_command: largest command (share of the maximum flow).
    """
    site, n = run.site, run.steps
    block = max(1, round(_STEP_S / site.tau), -(-n // _MOST_STEPS))
    starts = np.arange(0, n, block)
    rain, evaporated, frost = (
        np.add.reduceat(np.frombuffer(series[:n]), starts) / np.diff(starts, append=n)
        for series in (run.series.precipitation, run.series.evapotranspiration, run.series.frost)
    )
    flow = max_command * maximum_pump_flow(site, run.x1) * (1 - frost)
    program, edges = OrderUpTo(site, fine=_NODES), site.tau * np.append(starts, n)
    together = np.zeros((1, len(starts)), dtype=np.intp)
    policy = program.solve(edges, run.x1, run.x2, rain[None], evaporated, flow, together)

    def target(k: int, x1: float, x2: float) -> float:
        level = float(program.levels(policy, k // block, 0, program.usable(x1), x2))
        return level - BELOW_M3 if level >= x2 else -math.inf

    return run_plan(run, target, max_command)
