"""The run in one process, without ROS: the same parts in the same order as in the node graph.

:func:`closed_loop` runs with a controller, :func:`open_loop` with commands from outside, and
:class:`Simulation` from the first tick to the summary.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Generator, Iterable, Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.controllers.decide import decide, statistics_of
from greenroof_ros.controllers.protocol import Controller, set_time
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import Flows, Plant
from greenroof_ros.model.sensor_and_pump import Pump, RoofSensor
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


class TickInputs(NamedTuple):
    """What is known in a tick before its command."""

    k: int
    """index of 0..N"""
    cistern_level: float
    """m"""
    roof_level: float
    """m, as the sensor reads it"""


def closed_loop(run: Run, controller: Controller, metrics: Metrics) -> Iterator[Tick]:
    """Run the ticks 0..N, adding to ``metrics``; each tick is yielded before its step."""
    return _ticks(run, controller, metrics)


def open_loop(run: Run, metrics: Metrics) -> Generator[Any, float, None]:
    """Run the ticks 0..N, adding to ``metrics``, with commands that the caller sends.

    Each tick is yielded twice: a :class:`TickInputs`, for which the caller sends the command,
    finite and not negative, and the :class:`Tick` that follows, before its step. Where the pump may
    not run, the command is 0.
    """
    return _ticks(run, None, metrics)


def _ticks(
    run: Run, controller: Controller | None, metrics: Metrics
) -> Generator[Any, float, None]:
    site, series, steps, until = run.site, run.series, run.steps, 0
    plant = Plant(site, run.x1, run.x2)
    sensor, pump = RoofSensor(run.sensor_and_pump), Pump(run.sensor_and_pump, site.tau)
    forecast, hours, quiet = run.forecast, site.quiet, False
    for k in range(steps + 1):
        if k == until:
            precipitation, evapotranspiration, frost, until = series.at(k)
        cistern_level, roof_level = plant.levels()
        roof_level = sensor.reading(k, roof_level)
        if hours is not None:
            quiet = hours.quiet_at(run.time_ns(k))
            set_time(controller, run.time_ns(k))
        x1, x2, layer = plant.x1, plant.x2, plant.layer
        metrics.observe(site, x1, x2, layer)
        if controller is None:
            command = yield TickInputs(k, cistern_level, roof_level)
            command = 0.0 if frost or quiet else command
        else:
            command = decide(
                controller, not frost, cistern_level, roof_level,
                forecast.precipitation(k), forecast.evapotranspiration(k), quiet,
            )
        pumped = pump.flow(plant, command, frost > 0 or quiet)
        flows = plant.flows(precipitation, evapotranspiration, pumped)
        yield _new(Tick, (
            k, x1, x2, layer, cistern_level, roof_level,
            precipitation, evapotranspiration, frost, command, flows,
        ))
        if k < steps:
            metrics.step(command, precipitation, evapotranspiration, flows)
            plant.step(precipitation, flows)


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


class Simulation:
    """A run that is simulated once; studies, the command and Python all simulate with it."""

    def __init__(self, run: Run, controller: Controller | None = None) -> None:
        """Begin nothing yet.

        Args:
            run: what to simulate.
            controller: decides instead of a new one of the run's class.
        """
        self._run = run
        self._controller = run.make_controller() if controller is None else controller
        self._metrics = Metrics()
        self._wall_s = 0.0

    def ticks(self) -> Iterator[Tick]:
        """Run the ticks 0..N; each is yielded before its step."""
        began = time.monotonic()
        yield from closed_loop(self._run, self._controller, self._metrics)
        self._wall_s = time.monotonic() - began

    def summary(self) -> dict[str, Any]:
        """Return the content of ``summary.json``, after the last tick."""
        return summary.build(
            self._run, self._metrics.results(), self._metrics.weekly_deviations(),
            wall_s=self._wall_s, solver=statistics_of(self._controller),
        )
