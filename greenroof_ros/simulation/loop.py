"""A run in one process, without ROS: the controller and the site in a closed loop."""

from __future__ import annotations

import time
from array import array
from collections.abc import Iterable, Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.controllers.decide import (
    cut_forecast,
    decide,
    decide_outlet,
    read_statistics,
)
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.protocol import Controller, set_optional
from greenroof_ros.physics.plant import Flows
from greenroof_ros.recording.trajectory import Trajectory, recorded_columns
from greenroof_ros.results.virtual_site import VirtualSite
from greenroof_ros.simulation import summary
from greenroof_ros.simulation.run import Run

# Makes a named tuple from a tuple in half the time of its own class.
_new = tuple.__new__


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
    """command to the valve of the low outlet, the share to which it is open; 1 without a valve"""


class Simulation:
    """A run that is simulated once.

    Attributes:
        site: the simulated site, in the current tick.
        metrics: metrics of the ticks that have been simulated.
    """

    def __init__(
        self, run: Run, controller: Controller | None = None, outlet: OutletPolicy | None = None,
    ) -> None:
        """Begin with tick 0.

        Args:
            run: run to simulate.
            controller: controller to use; if None, a new controller of the run's class.
            outlet: policy of the outlet valve to use; if None, the run's own policy.
        """
        self._run = run
        self._controller = run.make_controller() if controller is None else controller
        self._outlet = run.make_outlet(self._controller) if outlet is None else outlet
        self._own_steps = run.controller.count_own_steps(run.site, run.parameters)
        self.site = VirtualSite(run.site, run.x1, run.x2, run.time_ns(0), run.sensor_and_pump)
        self.metrics = self.site.metrics
        self._wall_s = 0.0

    def ticks(self) -> Iterator[Tick]:
        """Run the ticks from the current tick to N, and yield each tick after its step."""
        began = time.monotonic()
        run, site, controller, until = self._run, self.site, self._controller, self.site.tick
        policy, outlet, own_steps = self._outlet, 1.0, self._own_steps
        closes = run.site.valve_closed_in_frost
        plant, forecast, has_quiet_hours = site.plant, run.forecast, run.site.quiet is not None
        for k in range(until, run.steps + 1):
            if k == until:
                precipitation, evapotranspiration, frost, until = run.series.at(k)
                site.frost = frost
            if has_quiet_hours:
                set_optional(controller, time_ns=site.time_ns)
            cistern_level, roof_level = site.observe()
            rain, evaporated = forecast.precipitation(k), forecast.evapotranspiration(k)
            own_rain, own_evaporated = (rain, evaporated) if own_steps is None else cut_forecast(
                run.controller, own_steps, rain, evaporated
            )
            command = decide(
                controller, not frost, cistern_level, roof_level, own_rain, own_evaporated,
                site.quiet,
            )
            if policy is not None:
                closed = closes and frost != 0
                outlet = decide_outlet(
                    policy, closed, cistern_level, roof_level, rain, evaporated
                )
            x1, x2, layer = plant.x1, plant.x2, plant.layer
            flows = site.act(precipitation, evapotranspiration, command, outlet=outlet)
            tick = _new(Tick, (
                k, x1, x2, layer, cistern_level, roof_level,
                precipitation, evapotranspiration, frost, command, flows, outlet,
            ))
            if k < run.steps:
                site.step()
            yield tick
        self._wall_s = time.monotonic() - began

    def summary(self) -> dict[str, Any]:
        """Return the content of ``summary.json``; call this after the last tick."""
        return summary.make_summary(
            self._run, self.metrics.results(), self.metrics.weekly_deviations(),
            self.metrics.events(),
            wall_s=self._wall_s, solver=read_statistics(self._controller),
        )


def record(run: Run, ticks: Iterable[Tick], every: int = 1) -> Trajectory:
    """Run all ticks, and return the trajectory.

    Args:
        run: the run.
        ticks: ticks of the run.
        every: interval between the ticks that are kept (ticks); the last tick of the run is always
            kept.
    """
    recorded = recorded_columns(run.site)
    values = attrgetter("k", *(column.tick for column in recorded))
    rows = array("d")
    for tick in ticks:
        if tick.k % every == 0 or tick.k == run.steps:
            rows.extend(values(tick))
    number, *columns = np.frombuffer(rows).reshape(-1, 1 + len(recorded)).T
    return Trajectory(
        start=run.start, time=run.site.tau * number,
        **{
            column.attribute: values
            for column, values in zip(recorded, columns, strict=True)
        },
    )
