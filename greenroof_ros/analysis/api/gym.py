"""The environment ``GreenRoof-v0`` of Gymnasium, the interface of reinforcement learning.

This module registers it, so import it before:

    import gymnasium
    import greenroof_ros as gr

    gymnasium.register_envs(gr.gym)
    environment = gymnasium.make("GreenRoof-v0")
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.api.control import SiteState
from greenroof_ros.analysis.api.environment import Environment
from greenroof_ros.common.errors import require_extra
from greenroof_ros.common.interface import read_topics
from greenroof_ros.experiment.closed_loop import Tick

with require_extra("gym"):
    import gymnasium
    from gymnasium.spaces import Box

Values = NDArray[np.float64]

_TO_MM_PER_H = 3.6e6
_TO_M3_PER_H = 3600.0


def minus_deviation(tick: Tick, state: SiteState) -> float:
    """Return the default reward: minus the deviation of the state that a tick leads to (m3)."""
    return -abs(state.roof - state.site.x2_star)


class GreenRoofEnv(gymnasium.Env[Values, Values]):
    """A green roof over a window of weather, for Gymnasium.

    - Observation: a vector of float64: level of the cistern (m), level of the roof (m), then the
      forecast: mean rain in each step (mm/h), then mean evapotranspiration off the whole bed in
      each step (m3/h). The steps grow, see :attr:`ends`; the first is now.
    - Action: the command, a vector with one number from 0 to 1, the share of the pumps' maximum
      flow. In frost and in quiet hours it acts as 0.
    - Reward: minus the deviation from the target volume (m3) of the state that the tick leads to.
      So the sum of an episode is minus ``total_deviation_m3`` without the first tick, which no
      action changes.
    - Episode: the N ticks of the window, each ``site.tau`` long. It ends with ``truncated``, since
      the roof goes on; ``terminated`` is always false. The ``info`` of the last step has the
      ``metrics`` of the run, by their names in ``summary.json``.
    - Seeds: with ``forecast="errors"`` or ``"ensemble"`` each ``reset`` draws the errors of its
      forecasts from the environment's random numbers, which ``reset(seed=...)`` seeds. Nothing
      else is random.

    Example:
        >>> import gymnasium, greenroof_ros as gr
        >>> gymnasium.register_envs(gr.gym)
        >>> roof = gymnasium.make("GreenRoof-v0", hours=1)
        >>> observation, info = roof.reset(seed=1)
        >>> observation, reward, terminated, truncated, info = roof.step(roof.action_space.sample())
        >>> reward < 0, truncated
        (True, False)

    Attributes:
        site: its parameters.
        ends: ends of the forecast's steps (s from now), the first 0, shape (steps + 1,).
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as the base class has it)

    def __init__(
        self, *, reward: Callable[[Tick, SiteState], float] = minus_deviation,
        render_mode: str | None = None, **inputs: Any,
    ) -> None:
        """Take the inputs of :class:`.Environment`.

        Args:
            reward: returns the reward of a tick, given what happened in it and the state that it
                leads to.
            render_mode: None, the only one.
            inputs: site, weather, start, hours, forecast, horizon (h) and others.

        Raises:
            ConfigurationError: an input is wrong.
        """
        self.render_mode = render_mode
        self._roof = Environment(**inputs)
        self._reward = reward
        self.site = self._roof.site
        self.ends: Values = self._roof.forecast.ends
        steps, topics = len(self.ends) - 1, read_topics()
        maximum = [topics[name].high for name in (
            "/cistern/level", "/roof/level", "/weather/precipitation", "/weather/evapotranspiration"
        )]
        high = np.array([
            *maximum[:2], *[maximum[2] * _TO_MM_PER_H] * steps, *[maximum[3] * _TO_M3_PER_H] * steps
        ])
        self.observation_space = Box(np.zeros_like(high), high, dtype=np.float64)
        self.action_space = Box(0.0, 1.0, (1,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Values, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of the environment's random numbers.
            options: none.
        """
        super().reset(seed=seed)
        self._roof.reset(int(self.np_random.integers(2**31)))
        return self._observation(), {}

    def step(self, action: Values) -> tuple[Values, float, bool, bool, dict[str, Any]]:
        """Run a tick with a command."""
        roof = self._roof
        tick = roof.step(float(action[0]))
        info = {"metrics": roof.metrics} if roof.done else {}
        return self._observation(), self._reward(tick, roof.state), False, roof.done, info

    def _observation(self) -> Values:
        state, forecast = self._roof.state, self._roof.forecast
        return np.concatenate((
            (state.cistern_level, state.roof_level), forecast.rain * _TO_MM_PER_H,
            forecast.evapotranspiration * _TO_M3_PER_H,
        ))


gymnasium.register("GreenRoof-v0", f"{__name__}:GreenRoofEnv")
