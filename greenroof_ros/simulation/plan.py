"""A simulation of the plan that ``lookahead`` makes with perfect knowledge of the weather."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.order_up_to import BELOW_M3, OrderUpTo
from greenroof_ros.forecast.resampling import PerfectForecast
from greenroof_ros.physics.plant import command_to, maximum_pump_flow
from greenroof_ros.physics.soil import soil_of
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.simulation.run import Run

# Length of a step (s); maximum number of steps, because their levels need memory; numbers of nodes
# below and above the target.
_STEP_S, _MAX_STEPS = 300.0, 10_000
_NODES = 3000, 1000


class PlanResult(NamedTuple):
    """The result of the simulation of a plan."""

    total_m3: float
    """total deviation (m3, summed over the ticks)"""
    pumped_m3: float
    """volume pumped (m3)"""


class _PlanController:
    """Controller that fills the roof to the levels of a plan for the whole run."""

    parameters: ClassVar[tuple[Parameter, ...]] = ()

    def __init__(self, run: Run, max_command: float) -> None:
        """Make the plan; see :func:`simulate_plan`."""
        site, n = run.site, run.steps
        self._site, self._soil, self._steps = site, soil_of(site), n
        self._max_command = max_command
        self._tick = -1
        self._block = max(1, round(_STEP_S / site.tau), -(-n // _MAX_STEPS))
        starts = np.arange(0, n, self._block)
        rain, evaporated, pumping = (
            np.add.reduceat(values, starts) / np.diff(starts, append=n)
            for values in (
                np.frombuffer(run.series.precipitation[:n]),
                np.frombuffer(run.series.evapotranspiration[:n]),
                find_pumping_ticks(run).astype(float),
            )
        )
        flow = max_command * maximum_pump_flow(site, run.x1) * pumping
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
        site, program = self._site, self._program
        x1, x2 = site.cistern_volume(cistern_level), site.roof_volume(roof_level)
        step = self._tick // self._block
        level = float(program.levels(self._policy, step, 0, program.usable(x1), x2))
        if level < x2:
            return 0.0
        now = precipitation[0], evapotranspiration[0]
        command = command_to(site, self._soil, x1, x2, level - BELOW_M3, *now)
        return min(command, self._max_command)

    def skip(self) -> None:
        """Count a tick in which the pumps must not run."""
        self._tick += 1

    def statistics(self) -> None:
        """Return None, because there is no solver."""


def simulate_plan(run: Run, max_command: float = 1.0) -> PlanResult:
    """Carry out a plan for a whole run, with an exact sensor and a perfect forecast.

    :class:`~greenroof_ros.controllers.order_up_to.OrderUpTo` plans the run in steps of five
    minutes, or of a ten-thousandth of a long run. The time after the run is not considered, and the
    soil is not simplified. For every site, the total deviation of the plan is an upper bound on the
    minimum possible total deviation.

    Args:
        run: weather, site, pumps, initial state and length; its controller, its forecast and the
            errors of its sensor have no effect.
        max_command: maximum command (share of the maximum flow).
    """
    known = replace(
        run, forecast=PerfectForecast(run.series, 1),
        sensor_and_pump=replace(run.sensor_and_pump, roof_noise=0.0, roof_offset=0.0),
    )
    simulation = Simulation(known, _PlanController(run, max_command))
    for _ in simulation.ticks():
        pass
    results = simulation.metrics.results()
    return PlanResult(results["total_deviation_m3"], results["pumped_m3"])


def find_pumping_ticks(run: Run, first: int = 0, last: int | None = None) -> NDArray[np.bool_]:
    """Return for each tick whether frost and quiet hours allow pumping, shape (ticks,).

    Args:
        run: the run.
        first: first tick.
        last: end of the range of ticks (exclusive); N by default.
    """
    n, hours = run.steps if last is None else last, run.site.quiet
    may_pump = np.asarray(np.frombuffer(run.series.frost[first:n]) == 0)
    if hours is not None:
        times = range(run.time_ns(first), run.time_ns(n), run.time_ns(1) - run.time_ns(0))
        may_pump &= ~np.fromiter(map(hours.quiet_at, times), bool, n - first)
    return may_pump
