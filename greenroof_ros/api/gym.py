"""The environment ``GreenRoof-v1`` for Gymnasium, the interface for reinforcement learning.

With the prefix ``greenroof_ros.gym:``, any process can find the environment:

    import gymnasium

    environment = gymnasium.make("greenroof_ros.gym:GreenRoof-v1")

:mod:`greenroof_ros.api.vector` steps many of them at once.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.api.arguments import read_weather
from greenroof_ros.api.control import FunctionController, SiteState
from greenroof_ros.api.environment import Environment
from greenroof_ros.api.starts import Starts
from greenroof_ros.base.errors import ConfigurationError, require_extra, suggest_names
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.physics.compiled import can_compile
from greenroof_ros.physics.storm_water import HOUR_S
from greenroof_ros.simulation.loop import Tick

with require_extra("gym"):
    import gymnasium
    from gymnasium.spaces import Box

Values = NDArray[np.float32]

_TO_MM_PER_H = 3.6e6
# What becomes 1 in an observation: rain (mm/h) and evapotranspiration (mm/day), both rarely
# exceeded; higher values are 1, too.
_MAX_RAIN, _MAX_EVAPOTRANSPIRATION = 50.0, 12.0
_TICKS = Range(1, 1e9, whole=True)
RANDOM = "random"
"""a start or an initial state that every episode draws"""


class _Roof(Environment):
    """The environment of an episode; one of many, for which it pays to compile the ticks."""

    _pays_to_compile = staticmethod(lambda ticks: can_compile())


def minus_deviation(tick: Tick, state: SiteState) -> float:
    """Return the default reward: the negative deviation of the state after a tick (m3)."""
    return -abs(state.roof - state.site.x2_star)


def read_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return actions as numbers.

    Args:
        actions: one or two numbers from 0 to 1, of one environment or of many.
        shape: shape that they must have.

    Raises:
        ConfigurationError: if the shape or a number is invalid.
    """
    commands = np.asarray(actions)
    if not (
        commands.shape == shape and np.issubdtype(commands.dtype, np.number)
        and not np.iscomplexobj(commands) and ((commands >= 0) & (commands <= 1)).all()
    ):
        numbers = "two numbers" if shape[-1] == 2 else "one number"
        what = f"must be {numbers} from 0 to 1"
        if len(shape) > 1:
            raise ConfigurationError(f"{what} for each site, of shape {shape}", key="action")
        raise ConfigurationError(f"{what}, of shape {shape}", key="action", value=actions)
    return commands.astype(np.float64)


class GreenRoofEnv(gymnasium.Env[Values, Values]):
    """A Gymnasium environment of a green roof in a window of weather.

    - Observation: a vector of float32 from 0 to 1. The first entries are the level of the cistern
      as a share of 1.5 times the level of its outlet, and the level on the roof as a share of twice
      the target level. The forecast follows: the mean rain in every step as a share of 50 mm/h,
      then the mean evapotranspiration in every step as a share of 12 mm/day. Higher values are
      clipped to 1. The first step begins now, and the steps become longer; see :attr:`ends`. At a
      site with a valve on its low outlet, the last entry is the time for which the weather will
      still count as wet if no more rain falls, as a share of ``wet_after``.
    - Action: a vector with one number from 0 to 1, the command as a share of the pumps' maximum
      flow. During frost and quiet hours the command is treated as 0. At a site with a valve on its
      low outlet, a second number is the opening of the valve as a share. Numbers outside this range
      are rejected.
    - Reward: the negative deviation from the target volume (m3) after a tick, summed over the ticks
      of the step. The sum over an episode is therefore the negative of ``total_deviation_m3``
      without the first tick, which no action can change.
    - Episode: the N ticks of the window, each ``site.tau`` long. A step with one action lasts
      ``decision_ticks`` ticks, and the pumps' minimum times and the roof's limits apply in every
      tick. An episode ends with ``truncated``, because the roof has no terminal state;
      ``terminated`` is always false. The ``info`` of the last step contains the ``metrics`` of the
      run, under their names in ``summary.json``.
    - Random numbers, seeded by ``reset(seed=...)``: with ``forecast="errors"`` or ``"ensemble"``,
      they determine the forecast errors. With ``start="random"``, they determine the start, which
      is on a full hour covered by the weather. With ``initial="random"``, they determine the
      volumes, which are uniformly distributed: in the cistern up to the level of its outlet, and on
      the roof up to twice the target or up to the soil's capacity, whichever is less.

    Example:
        >>> import gymnasium
        >>> roof = gymnasium.make("greenroof_ros.gym:GreenRoof-v1", hours=1, decision_ticks=60)
        >>> observation, info = roof.reset(seed=1)
        >>> observation, reward, terminated, truncated, info = roof.step(roof.action_space.sample())
        >>> reward < 0, truncated
        (True, False)

    Attributes:
        site: parameters of the site.
        ends: boundaries of the forecast's steps (s from now), the first of which is 0, shape (steps
            + 1,).
    """

    __copy__ = copy.deepcopy  # otherwise both would go on with one state
    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as the base class has it)

    def __init__(
        self, *, reward: Callable[[Tick, SiteState], float] = minus_deviation,
        decision_ticks: int = 1, render_mode: str | None = None, **inputs: Any,
    ) -> None:
        """Create the environment from the inputs of :class:`.Environment`.

        Args:
            reward: function that returns the reward for a tick from the results of the tick and the
                state after it.
            decision_ticks: number of ticks for which an action applies; the last action may be cut
                short by the end of the window.
            render_mode: None, the only mode.
            inputs: site, weather, start, hours, forecast, horizon (h) and others; start and initial
                can also be ``"random"``.

        Raises:
            ConfigurationError: if an input is invalid.
        """
        for name in map(attrgetter("name"), choose_class(FunctionController).of_valve):
            if inputs.get(name) is not None:
                raise ConfigurationError(
                    "selects the policy for the outlet valve; in this environment, the action "
                    "commands the valve", key=name, value=inputs[name],
                )
        self.render_mode, self._reward = render_mode, reward
        self._decision_ticks = int(_TICKS.read(decision_ticks, key="decision_ticks"))
        self._places = {key: inputs.get(key) for key in ("start", "initial")}
        self._inputs = {
            key: value for key, value in inputs.items() if self._places.get(key) != RANDOM
        }
        self._begun: dict[str, Any] = {}
        if self._places["start"] == RANDOM:  # until the first one is drawn
            self._inputs["weather"] = read_weather(self._inputs)
            self._inputs["start"] = self._inputs["weather"].first
        self._roof = self._make_roof({})
        self._inputs["weather"] = self._roof._run.weather
        self.site = self._roof.site
        self.ends: NDArray[np.float64] = self._roof.forecast.ends
        steps = len(self.ends) - 1
        self._scale = np.array([
            1.5 * self.site.z_o, 2.0 * self.site.z_veg, *[_MAX_RAIN / _TO_MM_PER_H] * steps,
            *[_MAX_EVAPOTRANSPIRATION / 1000 / 86400 * self.site.a2] * steps,
        ])
        self._has_valve = self.site.low_outlet_valve
        entries = len(self._scale) + self._has_valve
        self.observation_space = Box(0.0, 1.0, (entries,), np.float32)
        self.action_space = Box(0.0, 1.0, (1 + self._has_valve,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Values, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: seed of the environment's random numbers.
            options: ``start`` and ``initial`` of this episode, which replace the environment's own.

        Returns:
            The observation, and a dictionary with ``start``, ``cistern_m3`` and ``roof_m3`` of the
            episode.

        Raises:
            ConfigurationError: if an option is unknown, or its value is invalid.
        """
        super().reset(seed=seed)
        begin, seed_of_forecasts = self._draw(self.np_random, self._read_options(options))
        if begin != self._begun:
            self._roof, self._begun = self._make_roof(begin), begin
        self._roof.reset(seed_of_forecasts)
        return self._observe(), {
            "start": self._roof.state.time.isoformat(), "cistern_m3": self._roof.state.cistern,
            "roof_m3": self._roof.state.roof,
        }

    def step(self, action: Values) -> tuple[Values, float, bool, bool, dict[str, Any]]:
        """Apply an action during the ticks of one step.

        Raises:
            ConfigurationError: if the action is not one number from 0 to 1 (two numbers at a site
                with a valve), or if the episode has ended.
        """
        commands = read_actions(action, (1 + self._has_valve,))
        (command, *outlet), roof, reward = commands.tolist(), self._roof, 0.0
        if roof.done or self._reward is not minus_deviation:
            for number in range(self._decision_ticks):
                if number and roof.done:
                    break
                tick = roof.step(command, *outlet)
                reward += self._reward(tick, roof.state)
        else:
            reward = roof._follow(command, self._decision_ticks, *outlet)
        info = {"metrics": roof.metrics} if roof.done else {}
        return self._observe(), reward, False, roof.done, info

    def _observe(self) -> Values:
        state, forecast = self._roof.state, self._roof.forecast
        values = np.concatenate((
            (state.cistern_level, state.roof_level), forecast.rain, forecast.evapotranspiration
        ))
        values /= self._scale
        if self._has_valve:
            wet_after = self.site.wet_after * HOUR_S
            left = max(0.0, wet_after - float(self._roof._sites.without_rain[0]))  # s
            values = np.append(values, left / wet_after if left > 0 else 0.0)
        return np.asarray(np.clip(values, 0.0, 1.0), np.float32)

    @cached_property
    def _starts(self) -> Starts:
        """The starts of random episodes."""
        return Starts(self._roof._run)

    def _read_options(self, options: Mapping[str, Any] | None) -> dict[str, Any]:
        """Return the start and the initial state of an episode, or how they are drawn.

        Raises:
            ConfigurationError: if an option is unknown.
        """
        for key in options or {}:
            if key not in self._places:
                raise ConfigurationError(
                    f"is not an option of reset; {suggest_names(key, self._places)}", key=key
                )
        return {**self._places, **(options or {})}

    def _draw(
        self, random: np.random.Generator, places: Mapping[str, Any]
    ) -> tuple[dict[str, Any], int]:
        """Draw an episode: the inputs that differ from other episodes, and the forecasts' seed."""
        begin = {key: value for key, value in places.items() if value is not None}
        if places["start"] == RANDOM:
            begin["start"] = self._starts.draw(random)
        if places["initial"] == RANDOM:
            site = self.site
            high = site.cistern_volume(site.z_o), min(site.z_cap, 2.0 * site.x2_star)
            begin["initial"] = tuple(float(random.uniform(0.0, top)) for top in high)
        return begin, int(random.integers(2**31))

    def _make_roof(self, begin: Mapping[str, Any]) -> _Roof:
        """Return an environment; all environments share the weather that the first of them read."""
        return _Roof(**{**self._inputs, **begin})
