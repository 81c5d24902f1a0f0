"""Compare the lower bound on a run's total deviation with a plan that knows all weather in advance.

``python tools/plan_of_a_run.py [OPTIONS]`` takes the options of ``greenroof bound`` that describe
the run, and prints the bound, the total deviation of the plan in the exact plant, and the gap. The
minimum possible total deviation lies within this gap.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from greenroof_ros.base.command_line import Parser, command, make_number_type
from greenroof_ros.controllers.order_up_to import BELOW_M3, OrderUpTo
from greenroof_ros.forecast.steps import PerfectForecast
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.tick import command_to
from greenroof_ros.simulation.bound import BLOCK_S, clairvoyant_bound
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.simulation.options import add_site_arguments, build_run
from greenroof_ros.simulation.run import Run

# Length of a step of the plan (s). Shorter steps widen the gap, since the errors of interpolation
# between the nodes of OrderUpTo add up.
_STEP_S = 600.0


def simulate_plan(run: Run, max_command: float = 1.0) -> dict[str, float]:
    """Carry out a plan for a whole run, with an exact sensor and a perfect forecast.

    :class:`~greenroof_ros.controllers.order_up_to.OrderUpTo` plans the run in steps of ten minutes.
    The time after the run is not considered, and the soil is not simplified. For every site, the
    total deviation of the plan is an upper bound on the minimum possible total deviation.

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
    simulation = Simulation(known, PlanController(run, max_command))
    for _ in simulation.ticks():
        pass
    return simulation.metrics.results(simulation.site.state).metrics


class PlanController:
    """Controller that fills the roof to the levels of a plan for the whole run."""

    def __init__(self, run: Run, max_command: float) -> None:
        """Make the plan; see :func:`simulate_plan`."""
        site, n = run.site, run.steps
        self._site, self._p, self._max_command = site, plant_parameters(site), max_command
        self._tick = -1
        starts = np.arange(0, n, max(1, round(_STEP_S / site.tau)))
        rain, evaporated, *stopped = run.read_ticks(0, n, site)
        rain, evaporated, pumping = (
            np.add.reduceat(values, starts) / np.diff(starts, append=n)
            for values in (rain, evaporated, 1.0 - np.any(stopped, axis=0))
        )
        flow = max_command * maximum_pump_flow(self._p, run.x1) * pumping
        self._program, edges = OrderUpTo(site), site.tau * np.append(starts, n)
        together = np.zeros((1, len(starts)), dtype=np.intp)
        self._program.solve(edges, run.x1, run.x2, rain[None], evaporated, flow, together)

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the command for the current tick."""
        self._tick += 1
        site = self._site
        x1, x2 = site.cistern_volume(cistern_level), site.roof_volume(roof_level)
        level = self._program.level(self._tick * site.tau, x1, x2)
        if level < x2:
            return 0.0
        now = precipitation[0], evapotranspiration[0]
        command = command_to(self._p, x1, x2, level - BELOW_M3, *now)
        return min(command, self._max_command)

    def skip(self) -> None:
        """Count a tick in which the pumps must not run."""
        self._tick += 1


def compare(run: Run, max_command: float = 1.0) -> dict[str, str]:
    """Return the bound, the total deviation of the plan, and the gap between them, as texts."""
    bound = clairvoyant_bound(run, BLOCK_S, max_command)
    plan = simulate_plan(run, max_command)["total_deviation_m3"]
    return {
        "bound": f"{bound:.2f} m3", "plan": f"{plan:.2f} m3",
        "gap": f"{100 * (plan / bound - 1):.4f} %" if bound > 0 else "-",
    }


@command
def main() -> None:
    """Print the comparison for the run that the command line describes."""
    parser = Parser(prog="plan_of_a_run.py", description=__doc__)
    add_site_arguments(parser.add_argument_group("the run"))
    parser.add_argument(
        "--max-command", type=make_number_type(1e-9, 100.0), default=1.0, metavar="U",
        help="maximum command, as a share of the maximum flow (default: %(default)g)",
    )
    arguments = parser.parse_args()
    for name, value in compare(build_run(arguments), arguments.max_command).items():
        print(f"{name:6}{value:>14}")


if __name__ == "__main__":
    main()
