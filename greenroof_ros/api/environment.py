"""A run in which a program sets the command at every step."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from datetime import datetime, timedelta
from numbers import Integral
from typing import Any

import numpy as np

from greenroof_ros.api.roofs import Roofs
from greenroof_ros.api.simulate import (
    ForecastSteps,
    FunctionController,
    SiteState,
    build_run,
    read_number,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.outlet import SHARE
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.forecast.steps import make_forecast
from greenroof_ros.physics.compiled import pays_to_compile
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.loop import Tick
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.weather.series import WeatherSeries


def restart(run: Run, start: datetime, seed: int | None) -> Run:
    """Return a run with another start, and with another seed of its forecasts' errors if given."""
    choice, series = run.forecast_choice, run.series
    if seed is not None and "seed" in choice.options():
        choice = replace(choice, seed=seed)
    if (start, choice) == (run.start, run.forecast_choice):
        return run
    if start != run.start:
        series = WeatherSeries(run.weather, run.site, start, run.steps)
    return replace(
        run, start=start, series=series, forecast_choice=choice, forecast=make_forecast(
            run.weather, series, run.site, start, run.parameters["horizon"], choice,
            *find_needs(run.controller, run.parameters),
        ),
    )


def foresee(run: Run, tick: int) -> tuple[Any, Any]:
    """Return the rain (m/s) and the evapotranspiration (m3/s) in the steps of a forecast."""
    rain, evaporated, *_ = run.forecast.at(tick)
    own_steps = run.controller.count_own_steps(run.site, run.parameters)
    return run.controller.own_forecast(own_steps, rain, evaporated)


class Environment:
    """A site with its weather, for which a program sets the command at every tick.

    During frost and quiet hours, and on a roof without irrigation, the command is treated as 0. At
    a site with a valve on its low outlet, the program can also command the valve. Copies made with
    ``copy`` or ``pickle`` continue from the same tick with bit-identical results.

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

    __copy__ = copy.deepcopy  # otherwise both would go on with one state

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
        run = build_run(choose_class(FunctionController), inputs, set())
        self._begin(run, pays_to_compile(run.steps))

    def _begin(self, run: Run, compiles: bool) -> None:
        """Begin a run, whose ticks are compiled or not."""
        self._run, self.site, self._compiles = run, run.site, compiles
        self._ends = look_ahead_ends(run.site, run.parameters["horizon"])
        self._roofs = Roofs([run], compiles)
        self._policy = run.make_outlet(run.make_controller())

    def reset(self, seed: int | None = None) -> SiteState:
        """Restart the run, and return its initial state.

        Args:
            seed: seed of the forecast errors; None leaves it unchanged.

        Raises:
            ConfigurationError: if the seed is not a whole number, or is negative.

        Example:
            >>> import greenroof_ros as gr
            >>> roof = gr.Environment(hours=1)
            >>> roof.step(0.0) and roof.reset().time.isoformat()
            '2021-07-07T02:00:00-05:00'
        """
        if not (seed is None or (isinstance(seed, Integral) and seed >= 0)):
            raise ConfigurationError("must be a non-negative whole number", key="seed", value=seed)
        self._begin(restart(self._run, self._run.start, seed), self._compiles)
        return self.state

    def step(self, command: float, outlet: float | None = None) -> Tick:
        """Run one tick with the given command, and return the results of the tick.

        Args:
            command: share of the pumps' maximum flow (1), finite and non-negative.
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
        if self.done:
            raise ConfigurationError("has ended; call reset() to restart it", key="the run")
        share = read_number(command)
        if share is None or not 0 <= share < math.inf:
            raise ConfigurationError(
                "must be a finite, non-negative number", key="command", value=command
            )
        opening, readings = 1.0, self._roofs.levels[0]
        cistern, roof = map(float, readings)
        if self._policy is not None:
            outlook = self._run.forecast.at(self._roofs.tick)
            # The policy is called in every tick, because it counts the time without rain.
            opening = self._policy(cistern, roof, outlook.rain, outlook.evapotranspiration)
            if outlet is not None:
                number = read_number(outlet)
                opening = SHARE.read(outlet if number is None else number, key="outlet")
        elif outlet is not None:
            raise ConfigurationError(
                "commands the valve on the low outlet, which this site does not have "
                "(low_outlet_valve: true)", key="outlet", value=outlet,
            )
        self._roofs.follow([share], [opening], 1)
        return self._roofs.find_tick(readings)

    @property
    def state(self) -> SiteState:
        """The time and the levels at the current tick, or at the end of the run.

        Example:
            >>> import greenroof_ros as gr
            >>> roof = gr.Environment(hours=1)
            >>> roof.state.time.isoformat(), round(roof.state.cistern_level, 3)
            ('2021-07-07T02:00:00-05:00', 2.308)
        """
        time = self._run.start + timedelta(seconds=self._roofs.tick * self.site.tau)
        cistern, roof = map(float, self._roofs.levels[0])
        return SiteState(time, cistern, roof, self.site)

    @property
    def done(self) -> bool:
        """Whether the run has ended; :meth:`reset` restarts it.

        Example:
            >>> import greenroof_ros as gr
            >>> gr.Environment(hours=1).done
            False
        """
        return self._roofs.tick == self._run.steps

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
        rain, evaporated = foresee(self._run, self._roofs.tick)
        return ForecastSteps(np.asarray(rain), np.asarray(evaporated), self._ends)

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
        return self._roofs.metrics()[0]
