"""Runs in which a program sets the commands at every step: of one site, or of many at once."""

from __future__ import annotations

import copy
import math
import time
from array import array
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from greenroof_ros.api.simulate import (
    NEEDS_VALVE,
    ForecastSteps,
    FunctionController,
    Result,
    SiteState,
    build_run,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.processes import count_cores
from greenroof_ros.controllers.outlet import SHARE
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.forecast.choice import PERFECT, ForecastChoice
from greenroof_ros.forecast.steps import SteppedForecast, make_forecast
from greenroof_ros.physics.compiled import can_compile, compiled, records
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.storm_water import HOUR_S, is_wet, time_without_rain
from greenroof_ros.results.metrics import Results, end_run, find_new_days
from greenroof_ros.results.sums import MAINS, OTHER_MAINS, STRESSED, WET_DISCHARGE, is_stressed
from greenroof_ros.simulation.inputs import find_needs, make_inputs
from greenroof_ros.simulation.loop import Tick, make_trajectory
from greenroof_ros.simulation.output import make_summary
from greenroof_ros.simulation.run import Run, Values
from greenroof_ros.simulation.season import ALL_KEPT, Case, Control, Season, Ticks, run_ticks
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.weather.series import WeatherSeries

# What a command from outside does not change, instead of the parameters of on/off control.
_PARAMETERS = {"fraction": 0.0, "level": 0.0}
_CONTROL = Control(0.0, math.inf, -math.inf, 1.0, 1.0, 1.0)
COUNTED = "wet_discharge_m3", "mains_m3", "stress_hours"
"""the metrics that :meth:`Roofs.count_storm_water` counts"""
_PLACES = np.array([WET_DISCHARGE, MAINS, STRESSED])
# Ticks that are read together, and number of sites that are worth threads.
_BLOCK, _MIN_SITES = 1024, 64


def restart(run: Run, start: datetime, seed: int | None) -> Run:
    """Return a run with another start, and with another seed of its forecasts' errors if given."""
    choice = run.forecast_choice
    if seed is not None and "seed" in choice.options():
        choice = replace(choice, seed=seed)
    if (start, choice) == (run.start, run.forecast_choice):
        return run
    return _rebuild(replace(run, start=start, forecast_choice=choice))


def _rebuild(run: Run) -> Run:
    """Return a run whose weather, start or choice of forecasts was replaced, with its series."""
    series = WeatherSeries(run.weather, run.site, run.start, run.steps)
    return replace(run, series=series, forecast=make_forecast(
        run.weather, series, run.site, run.start, run.parameters["horizon"], run.forecast_choice,
        *find_needs(run.controller, run.parameters),
    ))


def follow_rain(rain: Any, tau: float, without_rain: float) -> Any:
    """Return the time without rain (s) until the start of each tick, and until the end of the last.

    Args:
        rain: rain in each tick (m/s), shape (n,).
        tau: duration of a tick (s).
        without_rain: time without rain before the first tick (s).
    """
    times = np.full(len(rain) + 1, without_rain)
    for tick in range(len(rain)):
        times[tick + 1] = time_without_rain(times[tick], rain[tick], tau)
    return times


class Roofs:
    """Sites with equal parameters in equally long runs, which follow commands from outside.

    The ticks are those of a compiled season, and equal those of :class:`.loop.Simulation` bit for
    bit. They are compiled with numba, if it is installed.

    Attributes:
        runs: the run of each of n sites.
        sites: their states, sums and kept ticks.
        tick: number of the current tick.
        left: number of ticks until the end of the runs.
    """

    def __init__(self, runs: Sequence[Run], keeps: bool = False) -> None:
        """Begin with tick 0 of the run of each site.

        Args:
            runs: the runs.
            keeps: whether to keep all ticks and events of a single run.
        """
        run, self.runs, count = runs[0], runs, len(runs)
        self.tick, self.left = 0, run.steps
        self._ticks: Any = None
        self._first, self._until, self._plant = 0, 0, plant_parameters(run.site)
        cases = [Case(run.site, _PARAMETERS, each, each.x1, each.x2) for each in runs]
        self._keeps, self._units = keeps, np.array([1.0, 1.0, run.site.tau / HOUR_S])
        self._counted = np.zeros((count, len(COUNTED)))
        season = Season(cases, int(keeps), int(keeps), can_compile())
        # From an old pool, threads end by themselves.
        self._map: Any = ThreadPoolExecutor(count_cores()).map if count >= _MIN_SITES else map
        kind = np.ndarray if can_compile() else np.recarray
        self.sites = season.sites._replace(
            runs=np.arange(count), controls=records([_CONTROL] * count).view(kind)
        )
        self._errors, self._parts = season.errors, season.parts
        self._without_rain = np.array([[each.without_rain_s] for each in runs])
        begins = [each.time_ns(0) / 1e9 for each in runs]
        self._new_days = [find_new_days(run.site, begin, run.steps) for begin in begins]
        self.read(0)

    def read(self, last: int, certain: int = 0) -> None:
        """Read the ticks from the current one to another (exclusive) or more, up to the end's.

        The first ticks keep the rain and the evapotranspiration that were read before, if they are
        certain.
        """
        run, site, first = self.runs[0], self.runs[0].site, self.tick
        last = min(max(last, first + _BLOCK), run.steps + 1)
        rain, potential, frost, quiet, other = map(np.array, zip(
            *(each.read_ticks(first, last, site) for each in self.runs), strict=True
        ))
        place = first - self._first
        if certain:
            for new, old in (rain, self._ticks.rain), (potential, self._ticks.potential):
                known = old[:, place : place + certain]
                new[:, : known.shape[1]] = known
        self._without_rain = np.array([
            compiled(follow_rain)(of_run, site.tau, times[place])
            for of_run, times in zip(rain, self._without_rain, strict=True)
        ])
        wet = is_wet(self._without_rain[:, 1:], site.tau, self._plant.wet_after_s)
        new_day = np.array([np.isin(np.arange(first, last), days) for days in self._new_days])
        errors = self._errors[first:last]
        self._ticks = Ticks(first, rain, potential, frost, wet, quiet, new_day, other, errors)
        self._first, self._until = first, last

    def follow(self, commands: Any, ticks: int) -> Values:
        """Simulate some ticks with the same commands, or fewer up to the end of the runs.

        Args:
            commands: command to the pumps (share of the maximum flow) and opening of the valve
                (share; 1 without a valve) of each site, shape (n, 2).
            ticks: number of ticks.

        Returns:
            The negative deviation of each roof's reading from its target, summed over the states
            after the ticks (m3), shape (n,).

        Raises:
            ConfigurationError: if the runs have ended.
        """
        if not self.left:
            raise ConfigurationError("has ended; call reset() to restart it", key="the run")
        first, last = self.tick, self.tick + min(ticks, self.left)
        if last >= self._until:
            self.read(last + 1)
        controls = self.sites.controls
        controls["fraction"], controls["policy"] = np.transpose(commands)
        # A single tick is kept: it is a multiple of itself.
        every, rows_kept, steps = max(1, first), 2 if ticks == 1 else 0, -1
        if self._keeps:  # with the state at the end, whose flows are not applied
            every, steps = 1, self.runs[0].steps
        elif self.sites.kept.shape[1] != rows_kept:
            kept = np.zeros((len(controls), rows_kept, len(ALL_KEPT)))
            self.sites = self.sites._replace(kept=kept)
        simulate: Any = compiled(run_ticks)

        def run(part: tuple[slice, Any, Any]) -> None:
            rows, _, hydrograph = part
            sites = self.sites
            if len(self._parts) > 1:
                sites = type(sites)(*(each[rows] for each in sites))
            simulate(sites, self._ticks, first, last + (last == steps), hydrograph, every, steps)

        list(self._map(run, self._parts))
        self.tick, self.left, p = last, self.left - (last - first), self._plant
        rewards: Values = -(self.sites.missed + abs(self.levels[:, 1] * p.a2 - p.x2_star))
        return rewards

    def count_storm_water(self) -> Values:
        """Return :data:`COUNTED` since the last call, shape (n, 3)."""
        sums: Any = self.sites.sums
        if not isinstance(sums, np.ndarray):
            sums = np.array([row[: OTHER_MAINS + 1] for row in sums])
        totals = sums[:, _PLACES] * self._units
        totals[:, 1] += sums[:, OTHER_MAINS]
        counted: Values = totals - self._counted
        self._counted = totals
        return counted

    @property
    def levels(self) -> Values:
        """Readings of the sensors in the cisterns and on the roofs (m), shape (n, 2)."""
        levels: Values = np.array(self.sites.state)[:, :2] / (self._plant.a1, self._plant.a2)
        if len(self._errors):
            levels[:, 1] = np.maximum(0.0, levels[:, 1] + self._errors[self.tick])
        return levels

    @property
    def states(self) -> list[SiteState]:
        """The time and the levels of every site."""
        passed = timedelta(seconds=self.tick * self._plant.tau)
        return [
            SiteState._make((run.start + passed, *levels, run.site))
            for run, levels in zip(self.runs, self.levels.tolist(), strict=True)
        ]

    @property
    def forecasts(self) -> Values:
        """Rain (m/s) and then evapotranspiration (m3/s) in the steps, shape (n, 2 steps)."""
        forecasts, place = [run.forecast for run in self.runs], self.tick - self._first
        if len(forecasts) > 1 and self.runs[0].forecast_choice.model == PERFECT:
            now = self._ticks.rain[:, place, None], self._ticks.potential[:, place, None]
            return SteppedForecast.at_once(forecasts, self.tick, now)
        return np.array([np.concatenate(each.at(self.tick)[:2]) for each in forecasts])

    @property
    def wet_left(self) -> Values:
        """Time for which the weather will stay wet without more rain, as a share, shape (n,)."""
        after, place = self._plant.wet_after_s, self.tick - self._first
        return np.maximum(0.0, after - self._without_rain[:, place]) / (after or 1.0)

    def act(self, commands: Any) -> list[Tick]:
        """Simulate a tick with the commands of :meth:`follow`, and return it for every site."""
        readings, k, ticks = self.levels.tolist(), self.tick, list[Tick]()
        self.follow(commands, 1)
        for levels, kept in zip(readings, self.sites.kept[:, min(k, 1)].tolist(), strict=True):
            (
                cistern, roof, rain, demand, command, pump, outflow, drained, frost, layer, outlet,
                low_outlet, other, other_demand, mains, wet, evaporated, limited,
            ) = kept
            flows = Flows(
                outflow, pump, drained, evaporated, limited > 0, mains, low_outlet, other,
                other_demand,
            )
            ticks.append(Tick._make((
                k, cistern, roof, layer, *levels, rain, demand, frost, command, flows, outlet,
                wet > 0, is_stressed(self._plant, roof),
            )))
        return ticks

    def results(self) -> list[Results]:
        """Return the results of every site, as if the runs ended now."""
        site, now = self.runs[0].site, self.sites
        return [
            end_run(site, [*map(float, sums)], events, State(*map(float, state)))
            for sums, events, state in zip(now.sums, now.events, now.state, strict=True)
        ]


def play_again(run: Run, played: array[float]) -> Result:
    """Return the result of a run.

    Args:
        run: the run.
        played: command to the pumps, opening of the valve and number of ticks, again and again.

    Raises:
        ConfigurationError: if the run has not ended.
    """
    roofs, began = Roofs([run], keeps=True), time.monotonic()
    for command, outlet, ticks in np.reshape(played, (-1, 3)).tolist():
        roofs.follow([(command, outlet)], int(ticks))
    if roofs.left:
        raise ConfigurationError("has a result only after its last tick", key="the run")
    (results,) = roofs.results()
    made = make_summary(run, *results, wall_s=time.monotonic() - began, solver=None)
    return Result(run, made, make_trajectory(run, roofs.sites.kept[0], 1))


class _Program(FunctionController):
    """The controller of an environment's run: commands from outside."""


class Environment:
    """A site with its weather, for which a program sets the command at every tick.

    During frost and quiet hours, and on a roof without irrigation, the command is treated as 0. At
    a site with a valve on its low outlet, the program can also command the valve. Copies made with
    ``copy.deepcopy`` or ``pickle`` continue from the same tick with bit-identical results; such a
    copy knows the weather to come. For a search over commands, :meth:`model` predicts with the
    forecast.

    Example:
        >>> import greenroof_ros as gr
        >>> roof = gr.Environment(hours=2)
        >>> while not roof.done:
        ...     command = 1.0 if roof.state.roof_level < roof.site.z_veg else 0.0
        ...     tick = roof.step(command)
        >>> round(roof.metrics["total_deviation_m3"], 1)
        59.3

    Attributes:
        site: parameters of the site.
    """

    def __init__(self, **inputs: Any) -> None:
        """Begin a run.

        Args:
            inputs: inputs of :func:`.simulate`, except the controller and ``trajectory_every``,
                plus ``horizon``, the length of the forecasts (h). At a site with a valve on its low
                outlet, ``outlet`` and its parameters set the policy that commands the valve during
                ticks in which :meth:`step` does not command it.

        Raises:
            ConfigurationError: if an input is invalid.
        """
        self._run = run = build_run(make_inputs(choose_class(_Program), inputs))
        self.site, self._ends = run.site, look_ahead_ends(run.site, run.parameters["horizon"])
        self._own_steps = run.controller.count_own_steps(run.site, run.parameters)
        self.reset()

    def reset(self, seed: int | None = None) -> SiteState:
        """Restart the run, and return its initial state.

        Args:
            seed: seed of the forecast errors, a non-negative whole number; None leaves it
                unchanged.

        Example:
            >>> import greenroof_ros as gr
            >>> roof = gr.Environment(hours=1)
            >>> roof.step(0.0) and roof.reset().time.isoformat()
            '2021-07-07T02:00:00-05:00'
        """
        self._run = run = restart(self._run, self._run.start, seed)
        self._roofs = Roofs([run])
        self._policy, self._played = run.make_outlet(run.make_controller()), array("d")
        return self.state

    def step(self, command: float, outlet: float | None = None) -> Tick:
        """Run one tick with the given command, and return the results of the tick.

        Args:
            command: share of the pumps' maximum flow (1), from 0 to 1.
            outlet: opening of the valve on the low outlet as a share (1), from 0 to 1; None to
                leave the valve to its policy.

        Raises:
            ConfigurationError: if a command is invalid, if ``outlet`` is given at a site without a
                valve, or if the run has ended.

        Example:
            >>> import greenroof_ros as gr
            >>> tick = gr.Environment(hours=1).step(0.5)
            >>> tick.k, tick.command, round(1000 * tick.flows.pump, 2)
            (0, 0.5, 4.18)
        """
        share, opening = SHARE.read(float(command), key="command"), 1.0
        if self._policy is not None:
            # Called in every tick, because it counts the time without rain.
            rain, evaporated, *_ = self._run.forecast.at(self._roofs.tick)
            _, cistern, roof, _ = self.state
            opening = self._policy(cistern, roof, rain, evaporated)
        if outlet is not None:
            if self._policy is None:
                raise ConfigurationError(NEEDS_VALVE, key="outlet", value=outlet)
            opening = SHARE.read(float(outlet), key="outlet")
        (tick,) = self._roofs.act([(share, opening)])
        self._played.extend((share, opening, 1))
        return tick

    def model(self) -> Environment:
        """Return a copy that ends with the forecast of this tick, and in which it comes true.

        The present rain and evapotranspiration are those of the site. Frost is that of the record.
        A search over commands in the copy knows no more than :attr:`forecast`. The copy has no
        :meth:`result`.

        Example:
            >>> import greenroof_ros as gr
            >>> model = gr.Environment(hours=6, horizon=2, forecast="errors").model()
            >>> while not model.done:
            ...     tick = model.step(0.0)
            >>> tick.k, model.metrics["pumped_m3"]
            (7199, 0.0)
        """
        run, model, tau = self._run, copy.deepcopy(self), self.site.tau
        roofs = model._roofs
        assert isinstance(run.forecast, SteppedForecast)
        weather = run.forecast.as_records(roofs.tick)
        model._run = _rebuild(replace(run, weather=weather, forecast_choice=ForecastChoice()))
        roofs.runs, roofs.left = [model._run], min(roofs.left, int(self._ends[-1] / tau))
        roofs.read(roofs.tick, certain=max(1, round(float(self._ends[1]) / tau)))
        return model

    def result(self) -> Result:
        """Return the result of the run after its last tick, as :func:`.simulate` does.

        Raises:
            ConfigurationError: if the run has not ended.

        Example:
            >>> import greenroof_ros as gr
            >>> roof = gr.Environment(hours=1)
            >>> while not roof.done:
            ...     tick = roof.step(0.5)
            >>> roof.result().trajectory["command"].sum()
            1800.5
        """
        return play_again(self._run, self._played)

    @property
    def state(self) -> SiteState:
        """The time and the levels at the current tick, or at the end of the run.

        Example:
            >>> import greenroof_ros as gr
            >>> roof = gr.Environment(hours=1)
            >>> roof.state.time.isoformat(), round(roof.state.cistern_level, 3)
            ('2021-07-07T02:00:00-05:00', 2.308)
        """
        return self._roofs.states[0]

    @property
    def done(self) -> bool:
        """Whether the run has ended; :meth:`reset` restarts it.

        Example:
            >>> import greenroof_ros as gr
            >>> gr.Environment(hours=1).done
            False
        """
        return not self._roofs.left

    @property
    def forecast(self) -> ForecastSteps:
        """The forecast from the current tick onwards.

        Example:
            >>> import greenroof_ros as gr
            >>> forecast = gr.Environment(hours=1, horizon=3).forecast
            >>> lengths = forecast.ends[1:] - forecast.ends[:-1]
            >>> print(f"{1000 * forecast.rain @ lengths:.1f} mm of rain in 3 h")
            3.2 mm of rain in 3 h
        """
        run = self._run
        own = run.controller.own_forecast(self._own_steps, *run.forecast.at(self._roofs.tick)[:2])
        return ForecastSteps._make(map(np.asarray, (*own, self._ends)))

    @property
    def metrics(self) -> dict[str, float]:
        """The metrics so far, under their names in ``summary.json``.

        Example:
            >>> import greenroof_ros as gr
            >>> roof = gr.Environment(hours=1)
            >>> _ = roof.step(1.0)
            >>> roof.metrics["pump_starts"]
            1
        """
        return self._roofs.results()[0].metrics
