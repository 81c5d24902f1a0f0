"""The run in one process, without ROS: controller and site in a closed loop."""

from __future__ import annotations

import time
from array import array
from collections.abc import Iterable, Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.controllers.decide import decide, read_statistics
from greenroof_ros.controllers.protocol import Controller, set_optional
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.plant import Flows
from greenroof_ros.model.virtual_site import VirtualSite
from greenroof_ros.recording.trajectory import RECORDED, Trajectory

# Makes a named tuple from a tuple in half the time of its own class.
_new = tuple.__new__


class Tick(NamedTuple):
    """What one tick of a run saw and did."""

    k: int
    """index of 0..N"""
    x1: float
    """volume in the cistern (m3)"""
    x2: float
    """volume on the roof (m3)"""
    layer: float
    """volume in the drainage layer of a measured soil (m3), else 0"""
    cistern_level: float
    """m"""
    roof_level: float
    """m, as the sensor reads it"""
    precipitation: float
    """m/s"""
    evapotranspiration: float
    """m3/s, before it is limited by the roof's water and by dry plants"""
    frost: float
    """1 in frost, when the command is 0; 0 without frost, or if unknown"""
    command: float
    """share of the maximum flow"""
    flows: Flows
    """m3/s; not applied in the last tick, since the run ends in its state"""


class Simulation:
    """A run that is simulated once, by :meth:`ticks` or step by step by :meth:`advance`.

    Attributes:
        site: the simulated site, in the present tick.
        metrics: of the ticks so far.
    """

    def __init__(self, run: Run, controller: Controller | None = None) -> None:
        """Begin with tick 0.

        Args:
            run: what to simulate.
            controller: decides instead of a new one of the run's class.
        """
        self._run = run
        self._controller = run.make_controller() if controller is None else controller
        self.site = VirtualSite(run.site, run.x1, run.x2, run.time_ns(0), run.sensor_and_pump)
        self.metrics = self.site.metrics
        self._read_weather()
        self._wall_s = 0.0

    def ticks(self) -> Iterator[Tick]:
        """Run the ticks 0..N with the controller, and yield each."""
        began = time.monotonic()
        for _ in range(self._run.steps + 1):
            yield self.advance(self._decide())
        self._wall_s = time.monotonic() - began

    def _decide(self) -> float:
        """Return the controller's command for the present tick."""
        site, forecast, controller = self.site, self._run.forecast, self._controller
        if self._run.site.quiet is not None:
            set_optional(controller, time_ns=site.time_ns)
        return decide(
            controller, not site.frost, *site.levels,
            forecast.precipitation(site.tick), forecast.evapotranspiration(site.tick), site.quiet,
        )

    def advance(self, command: float) -> Tick:
        """Run the present tick with a command, and go on to the next if there is one.

        Args:
            command: share of the pumps' maximum flow, finite and not negative. Where the pumps may
                not run, it acts as 0.
        """
        site = self.site
        k, plant = site.tick, site.plant
        precipitation, evapotranspiration, frost, until = self._weather
        if not site.may_pump:
            command = 0.0
        x1, x2, layer = plant.x1, plant.x2, plant.layer
        cistern_level, roof_level = site.levels
        flows = site.act(precipitation, evapotranspiration, command)
        if k < self._run.steps:
            site.step()
            if site.tick == until:
                self._read_weather()
        return _new(Tick, (
            k, x1, x2, layer, cistern_level, roof_level,
            precipitation, evapotranspiration, frost, command, flows,
        ))

    def _read_weather(self) -> None:
        """Read the weather of the ticks from the present one on that are in the same hour."""
        self._weather = self._run.series.at(self.site.tick)
        self.site.frost = self._weather.frost

    def summary(self) -> dict[str, Any]:
        """Return the content of ``summary.json``, after the last tick."""
        return summary.build(
            self._run, self.metrics.results(), self.metrics.weekly_deviations(),
            wall_s=self._wall_s, solver=read_statistics(self._controller),
        )


def record(run: Run, ticks: Iterable[Tick], every: int = 1) -> Trajectory:
    """Run the ticks to their end and return what happened.

    Args:
        run: the run.
        ticks: of the run.
        every: the first of this many ticks is kept, and the last one of the run.
    """
    values = attrgetter("k", *(column.tick for column in RECORDED))
    rows = array("d")
    for tick in ticks:
        if tick.k % every == 0 or tick.k == run.steps:
            rows.extend(values(tick))
    number, *columns = np.frombuffer(rows).reshape(-1, 1 + len(RECORDED)).T
    return Trajectory(
        start=run.start, time=run.site.tau * number,
        **{
            column.attribute: values
            for column, values in zip(RECORDED, columns, strict=True)
        },
    )
