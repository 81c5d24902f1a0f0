"""A run in which a program sets the command at every step."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from datetime import timedelta
from numbers import Integral
from typing import Any

import numpy as np

from greenroof_ros.api.arguments import build_run
from greenroof_ros.api.commanded import CommandedSites, Surroundings
from greenroof_ros.api.control import (
    ForecastSteps,
    FunctionController,
    SiteState,
    read_number,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.outlet import SHARE
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.forecast.steps import make_forecast
from greenroof_ros.physics.compiled import pays_to_compile
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.loop import Tick
from greenroof_ros.site.horizon import look_ahead_ends


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
    _pays_to_compile = staticmethod(pays_to_compile)

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
        self._run = run = build_run(choose_class(FunctionController), inputs, set())
        self.site = run.site
        self._ends = look_ahead_ends(self.site, run.parameters["horizon"])
        frost = run.series.frost
        self._surroundings = Surroundings.of_run(
            run, run.series.precipitation, range(frost.step(0), frost.step(run.steps) + 1),
            self._pays_to_compile(run.steps),
        )
        self.reset()

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
        if seed is not None:
            if not (isinstance(seed, Integral) and seed >= 0):
                raise ConfigurationError(
                    "must be a non-negative whole number", key="seed", value=seed
                )
            run = self._run
            choice = replace(run.forecast_choice, seed=seed)
            self._run = replace(run, forecast_choice=choice, forecast=make_forecast(
                run.weather, run.series, self.site, run.start, run.parameters["horizon"], choice,
                *find_needs(run.controller, run.parameters),
            ))
        run = self._run
        self._sites = CommandedSites(
            self._surroundings, [run.start], np.array([run.x1]), np.array([run.x2])
        )
        self._policy = run.make_outlet(run.make_controller())
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
        opening = 1.0
        if self._policy is not None:
            outlook = self._run.forecast.at(self._sites.tick)
            cistern, roof = map(float, self._sites.levels[0])
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
        self._follow(share, 1, opening)
        return self._sites.find_last_tick(0)

    def _follow(self, command: float, ticks: int, outlet: float = 1.0) -> float:
        """Run some ticks with the same commands, or fewer up to the end of the run.

        Args:
            command: as for :meth:`step`.
            ticks: number of ticks.
            outlet: opening of the valve (1); 1 without a valve. Its policy is not called.

        Returns:
            The negative deviation of the roof's reading from its target, summed over the states
            after the ticks (m3).
        """
        sites = self._sites
        sites.commands[0][0], sites.commands[0][1] = command, outlet
        last = min(sites.tick + ticks, self._run.steps)
        sites.follow(last, 0, 1)
        sites.tick = last
        return float(sites.rewards[0])

    @property
    def state(self) -> SiteState:
        """The time and the levels at the current tick, or at the end of the run.

        Example:
            >>> import greenroof_ros as gr
            >>> roof = gr.Environment(hours=1)
            >>> roof.state.time.isoformat(), round(roof.state.cistern_level, 3)
            ('2021-07-07T02:00:00-05:00', 2.308)
        """
        sites = self._sites
        time = self._run.start + timedelta(seconds=sites.tick * self.site.tau)
        cistern, roof = map(float, sites.levels[0])
        return SiteState(time, cistern, roof, self.site)

    @property
    def done(self) -> bool:
        """Whether the run has ended; :meth:`reset` restarts it.

        Example:
            >>> import greenroof_ros as gr
            >>> gr.Environment(hours=1).done
            False
        """
        return self._sites.tick == self._run.steps

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
        rain, evaporated, *_ = run.forecast.at(self._sites.tick)
        own_steps = run.controller.count_own_steps(self.site, run.parameters)
        rain, evaporated = run.controller.own_forecast(own_steps, rain, evaporated)
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
        return self._sites.compute_metrics()[0]
