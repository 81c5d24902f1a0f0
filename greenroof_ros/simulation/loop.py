"""A run in one process, without ROS: the controller and the site in a closed loop.

:func:`simulate` takes the compiled season for on/off control and the built-in policies of the
valve, and steps any other controller tick by tick, with the same results.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.decide import decide, read_statistics
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.protocol import Controller, set_optional
from greenroof_ros.physics.parameters import Flows, plant_parameters
from greenroof_ros.physics.virtual_site import VirtualSite
from greenroof_ros.results.metrics import Metrics
from greenroof_ros.results.sums import is_stressed
from greenroof_ros.results.trajectory import COLUMNS, Trajectory, columns_of
from greenroof_ros.simulation.output import make_summary
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import KEPT, Case, simulate_season

# Ticks between two reports of progress.
_REPORTED = 64


class Tick(NamedTuple):
    """The observations and actions of one tick of a run."""

    k: int
    """index of the tick, 0..N"""
    x1: float
    """volume in the cistern (m3)"""
    x2: float
    """volume on the roof (m3)"""
    layer: float
    """volume in the drainage layer of a field-capacity soil (m3), otherwise 0"""
    cistern_level: float
    """m"""
    roof_level: float
    """level that the sensor reads (m)"""
    precipitation: float
    """m/s"""
    evapotranspiration: float
    """evapotranspiration before the roof's water and dry plants limit it (m3/s)"""
    frost: float
    """1 in frost, when the command is 0; otherwise 0, or if it is unknown"""
    command: float
    """share of the maximum flow"""
    flows: Flows
    """m3/s; not applied in the last tick, since the run ends in its state"""
    outlet: float
    """command to the valve of the low outlet (share), to which it is open unless the site limits
    its moves; 1 without a valve"""
    wet: bool
    """whether the weather is wet, when discharge to the sewer counts"""
    stress: bool
    """whether the plants lack water at the start of the tick"""


class Simulation:
    """A run that is simulated once, tick by tick, with any controller.

    Attributes:
        site: the simulated site, in the current tick.
        metrics: metrics of the ticks that have been simulated.
    """

    def __init__(self, run: Run, controller: Controller | None = None) -> None:
        """Begin with tick 0.

        Args:
            run: run to simulate.
            controller: controller to use; if None, a new controller of the run's class.
        """
        self._run = run
        self._controller = run.make_controller() if controller is None else controller
        self._outlet = run.make_outlet(self._controller)
        self._own_steps = run.controller.count_own_steps(run.site, run.parameters)
        self.site = VirtualSite(
            run.site, run.x1, run.x2, run.time_ns(0), run.sensor_and_pump, run.steps + 1
        )
        self.metrics = Metrics(run.site, run.steps, run.time_ns(0) / 1e9, run.without_rain_s)
        self._began = time.monotonic()

    def ticks(self) -> Iterator[Tick]:
        """Run all ticks, and yield each tick after its step."""
        run, site, controller, until = self._run, self.site, self._controller, 0
        policy, outlet, own_steps = self._outlet, 1.0, self._own_steps
        forecast, irrigated, plant = run.forecast, run.site.irrigated, plant_parameters(run.site)
        for k in range(run.steps + 1):
            if k == until:
                precipitation, evapotranspiration, frost, other, until = run.series.at(k)
                site.frost = frost
            set_optional(controller, time_ns=site.time_ns)
            cistern_level, roof_level = site.observe()
            rain, evaporated, *_ = forecast.at(k)
            own = rain, evaporated
            if own_steps is not None:
                own = run.controller.own_forecast(own_steps, *own)
            command = decide(
                controller, irrigated and not frost, cistern_level, roof_level, *own, site.quiet
            )
            if policy is not None:
                # Also called in frost, because it counts the time without rain.
                outlet = policy(cistern_level, roof_level, rain, evaporated)
            state = site.state
            flows = site.act(
                precipitation, evapotranspiration, command, outlet=outlet, other_demand=other
            )
            tick = Tick(
                k, *state, cistern_level, roof_level,
                precipitation, evapotranspiration, frost, command, flows, site.outlet,
                self.metrics.is_wet(precipitation), is_stressed(plant, state.roof),
            )
            if k < run.steps:
                self.metrics.add(state, command, precipitation, evapotranspiration, flows)
                site.step()
            yield tick

    def summary(self) -> dict[str, Any]:
        """Return the content of ``summary.json``; call this after the last tick."""
        return make_summary(
            self._run, *self.metrics.results(self.site.state),
            wall_s=time.monotonic() - self._began, solver=read_statistics(self._controller),
        )


def record(
    run: Run, ticks: Iterable[Tick], every: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> Trajectory | None:
    """Run all ticks, and return the trajectory if it is wanted.

    Args:
        run: the run.
        ticks: ticks of the run.
        every: interval between the ticks that are kept (ticks), 0 for no trajectory; the last tick
            of the run is always kept.
        progress: as for :func:`simulate`.
    """
    names = (column.tick for column in COLUMNS if column.attribute)
    values, rows = attrgetter(*names), array("d")
    for tick in ticks:
        if every and (tick.k % every == 0 or tick.k == run.steps):
            rows.extend(values(tick))
        if tick.k % _REPORTED == 0:
            progress(tick.k / run.steps)
    kept = np.frombuffer(rows).reshape(-1, len(KEPT))
    return make_trajectory(run, kept, every) if every else None


def make_trajectory(run: Run, rows: NDArray[np.float64], every: int) -> Trajectory:
    """Make a trajectory from the values :data:`.KEPT` of every n-th tick, and of the last one."""
    own = {column.attribute for column in columns_of(run.site)}
    ticks = np.minimum(every * np.arange(len(rows)), run.steps)
    return Trajectory(start=run.start, time=run.site.tau * ticks, **{
        name: values for name, values in zip(KEPT, rows.T, strict=True) if name in own
    })


def simulate(
    run: Run, controller: Controller | None = None, every: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[dict[str, Any], Trajectory | None]:
    """Simulate a run; return the content of its ``summary.json``, and its trajectory if wanted.

    Args:
        run: the run.
        controller: controller to use; if None, a new controller of the run's class.
        every: interval between the ticks of the trajectory (ticks); 0 for no trajectory.
        progress: callback that regularly receives the completed share of the run (1); an error that
            it raises ends the run.
    """
    began, instance = time.monotonic(), run.make_controller() if controller is None else controller
    if type(instance) is OnOff and run.controller.kind is OnOff and instance.fits(run.site):
        own = {"fraction": instance.fraction, "level": instance.level}
        case = Case(run.site, run.parameters | own, run, run.x1, run.x2)
        ((results, kept),), _ = simulate_season([case], every=every, progress=progress)
        made = make_summary(run, *results, wall_s=time.monotonic() - began, solver=None)
        return made, make_trajectory(run, kept, every) if every else None
    simulation = Simulation(run, instance)
    trajectory = record(run, simulation.ticks(), every, progress)
    return simulation.summary(), trajectory
