"""A run in one process, without ROS: the controller and the site in a closed loop.

:func:`simulate` takes the compiled season for on/off control and the built-in policies of the
valve, and steps any other controller tick by tick, with the same results.
"""

from __future__ import annotations

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.controllers.decide import decide, read_statistics
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.protocol import Controller, set_optional
from greenroof_ros.physics.parameters import Flows
from greenroof_ros.physics.virtual_site import VirtualSite
from greenroof_ros.recording.trajectory import Trajectory, recorded_columns
from greenroof_ros.results.metrics import Metrics
from greenroof_ros.simulation import summary
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import KEPT, Batch, SeasonWeather, simulate_season

# Makes a named tuple from a tuple in half the time of its own class.
_new = tuple.__new__
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
    """command to the valve of the low outlet, the share to which it is open; 1 without a valve"""


class Simulation:
    """A run that is simulated once, tick by tick, with any controller.

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
        self.site = VirtualSite(
            run.site, run.x1, run.x2, run.time_ns(0), run.sensor_and_pump, run.steps + 1
        )
        self.metrics = Metrics(run.site, run.steps, run.time_ns(0) / 1e9, run.without_rain_s)
        self._wall_s = 0.0

    def ticks(self) -> Iterator[Tick]:
        """Run the ticks from the current tick to N, and yield each tick after its step."""
        began = time.monotonic()
        run, site, controller, until = self._run, self.site, self._controller, self.site.tick
        policy, outlet, own_steps = self._outlet, 1.0, self._own_steps
        closes, irrigated = run.site.valve_closed_in_frost, run.site.irrigated
        forecast, has_quiet_hours = run.forecast, run.site.quiet is not None
        for k in range(until, run.steps + 1):
            if k == until:
                precipitation, evapotranspiration, frost, until = run.series.at(k)
                site.frost = frost
            if has_quiet_hours:
                set_optional(controller, time_ns=site.time_ns)
            cistern_level, roof_level = site.observe()
            rain, evaporated = forecast.precipitation(k), forecast.evapotranspiration(k)
            own = rain, evaporated
            if own_steps is not None:
                own = run.controller.own_forecast(own_steps, *own)
            command = decide(
                controller, irrigated and not frost, cistern_level, roof_level, *own, site.quiet
            )
            if policy is not None:
                # Also called in frost, because it counts the time without rain.
                outlet = policy(cistern_level, roof_level, rain, evaporated)
                if closes and frost:
                    outlet = 0.0
            state = site.state
            flows = site.act(precipitation, evapotranspiration, command, outlet=outlet)
            tick = _new(Tick, (
                k, *state, cistern_level, roof_level,
                precipitation, evapotranspiration, frost, command, flows, outlet,
            ))
            if k < run.steps:
                self.metrics.add(state, command, precipitation, evapotranspiration, flows)
                site.step()
            yield tick
        self._wall_s = time.monotonic() - began

    def summary(self) -> dict[str, Any]:
        """Return the content of ``summary.json``; call this after the last tick."""
        state = self.site.state
        return summary.make_summary(
            self._run, self.metrics.results(state), self.metrics.weekly_deviations(state),
            self.metrics.events(state), wall_s=self._wall_s,
            solver=read_statistics(self._controller),
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
    values = attrgetter("k", "layer", *(column.tick for column in recorded))
    rows = array("d")
    for tick in ticks:
        if tick.k % every == 0 or tick.k == run.steps:
            rows.extend(values(tick))
    names = "k", "layer", *(column.attribute for column in recorded)
    columns = np.frombuffer(rows).reshape(-1, len(names)).T
    return _make_trajectory(run, dict(zip(names, columns, strict=True)))


def _make_trajectory(run: Run, columns: Mapping[str, Any]) -> Trajectory:
    """Make a trajectory from its columns and the numbers of their ticks, ``k``, by name."""
    names = "layer", *(column.attribute for column in recorded_columns(run.site))
    return Trajectory(
        start=run.start, time=run.site.tau * columns["k"],
        **{name: columns[name] for name in names},
    )


def simulate(
    run: Run, controller: Controller | None = None, every: int = 0,
    progress: Callable[[float], None] | None = None,
) -> tuple[dict[str, Any], Trajectory | None]:
    """Simulate a run; return the content of its ``summary.json``, and its trajectory if wanted.

    Args:
        run: the run.
        controller: controller to use; if None, a new controller of the run's class.
        every: interval between the ticks of the trajectory (ticks); 0 for no trajectory.
        progress: callback that regularly receives the completed share of the run (1); an error that
            it raises ends the run.
    """
    instance = run.make_controller() if controller is None else controller
    if type(instance) is OnOff and run.controller.kind is OnOff:
        return _simulate_season(run, instance, every, progress)
    simulation = Simulation(run, instance)
    ticks: Iterable[Tick] = simulation.ticks()
    if progress is not None:
        ticks = _reported(ticks, run.steps, progress)
    trajectory = record(run, ticks, every) if every else None
    deque(ticks, maxlen=0)
    return simulation.summary(), trajectory


def _reported(
    ticks: Iterable[Tick], steps: int, progress: Callable[[float], None]
) -> Iterator[Tick]:
    for tick in ticks:
        yield tick
        if tick.k % _REPORTED == 0:
            progress(tick.k / max(1, steps))


def _simulate_season(
    run: Run, controller: OnOff, every: int, progress: Callable[[float], None] | None
) -> tuple[dict[str, Any], Trajectory | None]:
    """Simulate a run under on/off control with the compiled plant; see :func:`simulate`."""
    began = time.monotonic()
    weather = SeasonWeather.of_run(run, 1.0)
    parameters = {**run.parameters, "fraction": controller.fraction, "level": controller.level}
    result = simulate_season(Batch(
        [run.site], [weather], np.zeros(1, np.intp), [parameters], np.array([run.x1]),
        np.array([run.x2]), np.ones(1), sensor_and_pump=run.sensor_and_pump,
    ), every, progress)
    made = summary.make_summary(
        run, result.metrics[0], result.weeks[0], result.events[0],
        wall_s=time.monotonic() - began, solver=None,
    )
    if not every:
        return made, None
    ticks = np.minimum(every * np.arange(result.kept.shape[1]), run.steps)
    return made, _make_trajectory(run, {
        "k": ticks, "precipitation": weather.rain[ticks],
        "evapotranspiration": weather.evapotranspiration[ticks],
        "frost": weather.frost[ticks].astype(float),
        **dict(zip(KEPT, result.kept[0].T, strict=True)),
    })
