"""A run in which a program sets the command at every step."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from datetime import timedelta
from numbers import Integral
from typing import Any, ClassVar

import numpy as np

from greenroof_ros.analysis.api.arguments import build_run
from greenroof_ros.analysis.api.control import (
    ForecastSteps,
    FunctionController,
    SiteState,
    read_number,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.decide import cut_forecast
from greenroof_ros.controllers.outlet import SHARE, OutletPolicy
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.forecast.resampling import PerfectForecast, make_forecast
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.loop import Simulation, Tick
from greenroof_ros.site.horizon import look_ahead_ends


class _Commanded:
    """A controller that returns the command set by a program, and ignores its inputs."""

    parameters: ClassVar[tuple[Parameter, ...]] = ()
    share = 0.0

    def command(self, *inputs: Any) -> float:
        """Return the command that the program has set."""
        return self.share

    def skip(self) -> None:
        """Do nothing, since the pumps must not run."""

    def statistics(self) -> None:
        """Return None, since the controller has no solver."""


def _read_share(outlet: Any) -> float:
    """Return a valve command as a number.

    Raises:
        ConfigurationError: if it is not a number from 0 to 1.
    """
    share = read_number(outlet)
    return float(SHARE.read(outlet if share is None else share, key="outlet"))


class _Valve:
    """Control of the outlet valve by a program, or by a policy if the program sets no command."""

    share: float | None = None

    def __init__(self, policy: OutletPolicy) -> None:
        self._policy = policy

    def command(self, *inputs: Any) -> float:
        """Return the share. The policy is called at every tick, since it counts dry hours."""
        share = self._policy.command(*inputs)
        return share if self.share is None else self.share


class Environment:
    """A site with its weather, for which a program sets the command at every tick.

    During frost and quiet hours the command is treated as 0. At a site with a valve on its low
    outlet, the program can also command the valve. Copies made with ``copy`` or ``pickle`` continue
    from the same tick with bit-identical results.

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
        state: current time and levels.
        done: whether the run has ended; :meth:`reset` restarts it.
    """

    state: SiteState
    done: bool
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
        self._run = build_run(choose_class(FunctionController), inputs, set())
        self.site = self._run.site
        self._ends = look_ahead_ends(self.site, self._run.parameters["horizon"])
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
        self._controller = _Commanded()
        policy, known = self._run.make_outlet(self._controller), self._run
        self._valve = None if policy is None else _Valve(policy)
        if policy is None:  # otherwise nothing in the simulation needs a forecast
            known = replace(known, forecast=PerfectForecast(known.series, 1))
        self._simulation = Simulation(known, self._controller, self._valve)
        self._ticks = self._simulation.ticks()
        self._observe()
        return self.state

    def __getstate__(self) -> dict[str, Any]:
        """Return the state from which a copy continues at the current tick."""
        return {name: value for name, value in self.__dict__.items() if name != "_ticks"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from the tick of the original."""
        self.__dict__.update(state)
        self._ticks = self._simulation.ticks()

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
        if self._valve is not None:
            self._valve.share = None if outlet is None else _read_share(outlet)
        elif outlet is not None:
            raise ConfigurationError(
                "commands the valve on the low outlet, which this site does not have "
                "(low_outlet_valve: true)", key="outlet", value=outlet,
            )
        self._controller.share = share
        tick = next(self._ticks)
        self._observe()
        return tick

    def _observe(self) -> None:
        """Set the state at the beginning of the current tick, or the final state of the run."""
        site = self._simulation.site
        time = self._run.start + timedelta(seconds=site.tick * self.site.tau)
        self.state = SiteState(time, *site.observe(), self.site)
        self.done = site.tick == self._run.steps

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
        run, tick = self._run, self._simulation.site.tick
        rain, evaporated = run.forecast.precipitation(tick), run.forecast.evapotranspiration(tick)
        own_steps = run.controller.count_own_steps(self.site, run.parameters)
        if own_steps is not None:
            rain, evaporated = cut_forecast(run.controller, own_steps, rain, evaporated)
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
        return self._simulation.metrics.results()
