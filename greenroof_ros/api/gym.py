"""The environments for Gymnasium: ``GreenRoof-v1``, and ``GreenRoofVector-v1`` for many at once.

With the prefix ``greenroof_ros.gym:``, any process can find them:

    import gymnasium

    environment = gymnasium.make("greenroof_ros.gym:GreenRoof-v1")
    environments = gymnasium.make_vec("greenroof_ros.gym:GreenRoofVector-v1", num_envs=1000)
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.api.environment import COUNTED, Roofs, play_again, restart
from greenroof_ros.api.scenarios import STORM_WATER, find_scenario, weigh
from greenroof_ros.api.simulate import FunctionController, Result, SiteState, warn
from greenroof_ros.base.errors import ConfigurationError, require_extra, suggest_names
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.forecast.choice import ENSEMBLE, ERRORS, ForecastChoice
from greenroof_ros.simulation.inputs import INPUTS, make_inputs
from greenroof_ros.simulation.loop import Tick
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.weather.records import HOUR

with require_extra("gym"):
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

Values = NDArray[np.float32]

# What becomes 1 in an observation: rain of 50 mm/h and evapotranspiration of 12 mm/day (m/s), both
# rarely exceeded; higher values are 1, too.
_MAX_RAIN, _MAX_EVAPOTRANSPIRATION = 50.0 / 3.6e6, 12.0 / 1000 / 86400
_TICKS = Range(1, 1e9, whole=True)
_RANDOM, _MAX_DRAWS = "random", 100
_OWN = "scenario", "draw", "reward", "decision_ticks"


class _Agent(FunctionController):
    """The controller of a run: actions, which also command the valve."""

    outlet = 1.0


_AGENT = choose_class(_Agent)
# What may be given with a scenario, and with random starts in its years to train on.
_FREE, _IN_TRAINING = {"horizon"}, {"horizon", "start", "hours"}


def read_actions(actions: Any, shape: Any) -> NDArray[np.float64]:
    """Return actions as commands to the pumps and to the valve, shape (n, 2).

    Args:
        actions: one or two numbers from 0 to 1, of one environment or of many.
        shape: shape that they must have.

    Raises:
        ConfigurationError: if the shape or a number is invalid.
    """
    numbers = np.asarray(actions, np.float64)
    if numbers.shape != shape or not ((numbers >= 0) & (numbers <= 1)).all():
        raise ConfigurationError(f"must be numbers from 0 to 1, of shape {shape}", key="action")
    commands = np.ones((numbers.size // shape[-1], 2))
    commands[:, : shape[-1]] = numbers
    return commands


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
      without the first tick, which no action can change. At a site with a valve, it is the negative
      score for storm water: of the discharge in wet weather (m3), plus 0.3 times the mains water
      (m3), plus 0.01 times the water stress (h).
      In each case, the ``initial_score`` in the ``info`` of ``reset`` minus the sum of the rewards
      is the ``score`` in the last ``info``.
    - Scenario: with ``scenario="dry-month"``, an episode is what :func:`.score` judges, whatever
      the seed of ``reset``, and its rewards are parts of this score. With ``start="random"`` as
      well, an episode is a season of one of the scenario's years to train on.
    - Episode: the N ticks of the window, each ``site.tau`` long. A step with one action lasts
      ``decision_ticks`` ticks, and the pumps' minimum times and the roof's limits apply in every
      tick. An episode ends with ``truncated``, because the roof has no terminal state;
      ``terminated`` is always false. Every ``info`` contains the ``wet_discharge_m3``, ``mains_m3``
      and ``stress_hours`` of the step, and the last one the ``metrics`` of the run, under their
      names in ``summary.json``.
    - Random numbers, seeded by ``reset(seed=...)``: with ``forecast="errors"`` or ``"ensemble"``,
      they determine the forecast errors, unless ``forecast_seed`` is given. With
      ``start="random"``, they determine the start, which is on a full hour from which weather and
      forecasts cover an episode.

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

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as the base class has it)

    def __init__(
        self, *, scenario: str | None = None, draw: int | None = None,
        reward: Callable[[Tick, SiteState], float] | None = None, decision_ticks: int = 1,
        **inputs: Any,
    ) -> None:
        """Create the environment from the inputs of :class:`.Environment`.

        Args:
            scenario: name of one of ``gr.scenarios``, which fixes all inputs except ``horizon``;
                and, with ``start="random"``, ``hours``, the length of an episode.
            draw: seed of the forecasts' errors, as one of ``seeds`` in :func:`.score`.
            reward: function that returns the reward for a tick from the results of the tick and the
                state after it; None for the default.
            decision_ticks: number of ticks for which an action applies; the last action may be cut
                short by the end of the window.
            inputs: site, weather, start, hours, forecast, horizon (h) and others; start can also
                be ``"random"``.

        Raises:
            ConfigurationError: if an input is invalid.
        """
        self._decision_ticks = int(_TICKS.read(decision_ticks, key="decision_ticks"))
        self._reward, self._is_random = reward, inputs.get("start") == _RANDOM
        self._scenario = None if scenario is None else find_scenario(scenario)
        names = [*_OWN, *INPUTS, *_AGENT.parameters]
        for name in inputs.keys() - names:
            wrong = f"is not an input; {suggest_names(name, names)}"
            raise ConfigurationError(wrong, key=name, value=inputs[name])
        if (fixed := self._scenario) is not None:
            for name in inputs.keys() - (_IN_TRAINING if self._is_random else _FREE):
                raise ConfigurationError("is fixed by the scenario", key=name, value=inputs[name])
            inputs = (fixed.training_inputs if self._is_random else fixed.inputs) | inputs
        if draw is not None:
            inputs["forecast_seed"] = draw
        if self._is_random:  # until the first one is drawn
            known = make_inputs(_AGENT, {**inputs, "start": None})
            weather, _ = known.read_records(known.read_site())
            inputs.update(weather=weather, start=weather.first)
        self._has_seed = inputs.get("forecast_seed") is not None
        self._own = self._make_run(inputs)
        if self._scenario is None and not self._is_random:
            warn([*self._own.notes(), *self._own.weather_notes()], level=3)
        self._inputs, self.site = {**inputs, "weather": self._own.weather}, self._own.site
        self._weigh()
        self.ends = look_ahead_ends(self.site, self._own.parameters["horizon"])
        steps, has_valve = len(self.ends) - 1, self.site.low_outlet_valve
        self._scale = np.array([
            1.5 * self.site.z_o, 2.0 * self.site.z_veg, *[_MAX_RAIN] * steps,
            *[_MAX_EVAPOTRANSPIRATION * self.site.a2] * steps, *[1.0] * has_valve,
        ])
        self.observation_space = Box(0.0, 1.0, self._scale.shape, np.float32)
        self.action_space = Box(0.0, 1.0, (1 + has_valve,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Values, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: seed of the environment's random numbers.
            options: ``start`` and ``initial`` of this episode, which replace the environment's own.

        Returns:
            The observation, and a dictionary with ``start``, ``cistern_m3`` and ``roof_m3`` of the
            episode, and with ``initial_score``, which is what the initial state would cost.

        Raises:
            ConfigurationError: if an option is invalid.
        """
        super().reset(seed=seed)
        self._roofs, self._played = self.begin([self.np_random], options), array("d")
        (info,) = self.describe(self._roofs)
        return self.observe(self._roofs)[0], info

    def step(self, action: Values) -> tuple[Values, float, bool, bool, dict[str, Any]]:
        """Apply an action during the ticks of one step.

        Raises:
            ConfigurationError: if the action is not one number from 0 to 1 (two numbers at a site
                with a valve), or if the episode has ended.
        """
        roofs, commands = self._roofs, read_actions(action, self.action_space.shape)
        begin = roofs.tick
        rewards, storm_water = self.play(roofs, commands)
        self._played.extend((*commands[0], roofs.tick - begin))
        info = dict(zip(COUNTED, storm_water[0].tolist(), strict=True))
        if not roofs.left:
            info |= self.judge(roofs)[0]
        return self.observe(roofs)[0], float(rewards[0]), False, not roofs.left, info

    def result(self) -> Result:
        """Return the result of an episode that has ended; see :meth:`.Environment.result`.

        Raises:
            ConfigurationError: if the episode has not ended.
        """
        return play_again(self._roofs.runs[0], self._played)

    def _make_run(self, inputs: Mapping[str, Any]) -> Run:
        """Build a run; for random starts, the errors of its forecasts are drawn with the start."""
        made = make_inputs(_AGENT, inputs)
        if self._has_seed or not (self._is_random and made.forecast.model in (ERRORS, ENSEMBLE)):
            return made.build()
        run = replace(made, forecast=ForecastChoice()).build()
        return replace(run, forecast_choice=made.forecast)

    def _weigh(self) -> None:
        """Set what a deviation (m3) and each of :data:`.COUNTED` cost."""
        m3_per_mm = (self._own.steps + 1) * self.site.a2 / 1000
        self._weights: Mapping[str, float] = {"mean_deviation_mm": m3_per_mm}
        if self._scenario is not None:
            self._weights = self._scenario.weights
        elif self.site.low_outlet_valve:
            self._weights = STORM_WATER
        self._of_deviation = self._weights.get("mean_deviation_mm", 0.0) / m3_per_mm
        self._of_storm_water = [self._weights.get(name, 0.0) for name in COUNTED]

    def begin(
        self, randoms: Iterable[np.random.Generator], options: Mapping[str, Any] | None
    ) -> Roofs:
        """Begin an episode with each of some random number generators; see :meth:`reset`."""
        options = options or {}
        for name in options.keys() - {"start", "initial"}:
            raise ConfigurationError("must be start or initial", key="option", value=name)
        if options and self._scenario is not None and not self._is_random:
            raise ConfigurationError("is fixed by the scenario", key="option", value=[*options])
        run = self._make_run({**self._inputs, **options}) if options else self._own
        starts, hours = [run.start], 1
        if self._is_random and "start" not in options:
            record = run.weather.end - run.weather.first
            length = (run.steps + run.site.M) * run.site.tau
            last = (record - timedelta(seconds=length)) // HOUR
            starts, hours = [run.weather.first], 1 + max(0, last)
            if self._scenario is not None:
                starts, hours = self._scenario.training_starts(run.steps * run.site.tau / 3600)
        return Roofs([_draw_run(run, random, starts, hours, self._has_seed) for random in randoms])

    def play(
        self, roofs: Roofs, commands: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Apply commands during the ticks of one step.

        Returns:
            The rewards, shape (n,), and the :data:`.COUNTED` of the step, shape (n,
            3).

        Raises:
            ConfigurationError: if a reward is not finite.
        """
        if self._reward is None:
            rewards = self._of_deviation * roofs.follow(commands, self._decision_ticks)
            storm_water = roofs.count_storm_water()
            for weight, values in zip(self._of_storm_water, storm_water.T, strict=True):
                if weight:
                    rewards -= weight * values
            return rewards, storm_water
        rewards = np.zeros(len(commands))
        for _ in range(min(self._decision_ticks, max(1, roofs.left))):
            rewards += [*map(self._reward, roofs.act(commands), roofs.states)]
        if not np.isfinite(rewards).all():
            raise ConfigurationError("must be finite numbers", key="rewards", value=rewards)
        return rewards, roofs.count_storm_water()

    def judge(self, roofs: Roofs) -> list[dict[str, Any]]:
        """Return what the ``info`` of the last step of each episode contains."""
        ends = roofs.results()
        return [{"metrics": each, "score": weigh(self._weights, each)} for each, _ in ends]

    def observe(self, roofs: Roofs) -> Values:
        """Return the observations of roofs, shape (n, entries)."""
        parts = [roofs.levels, roofs.forecasts]
        if self.site.low_outlet_valve:
            parts.append(roofs.wet_left[:, np.newaxis])
        shares: Values = np.minimum(np.hstack(parts) / self._scale, 1.0).astype(np.float32)
        return shares

    def describe(self, roofs: Roofs) -> list[dict[str, Any]]:
        """Return the ``info`` of the beginning of each episode."""
        return [
            {"start": each.time.isoformat(), "cistern_m3": each.cistern, "roof_m3": each.roof,
             "initial_score": self._of_deviation * abs(each.roof - self.site.x2_star)}
            for each in roofs.states
        ]


def _draw_run(
    run: Run, random: np.random.Generator, starts: Sequence[datetime], hours: int, has_seed: bool
) -> Run:
    """Draw the start of a run, and the seed of its forecasts unless it has one.

    Args:
        run: the run.
        random: the random numbers.
        starts: possible starts.
        hours: number of hours from each of them in which a run may start.
        has_seed: whether the seed of the forecasts is given.

    Raises:
        ConfigurationError: if the record contains too many missing hours.
    """
    for _ in range(_MAX_DRAWS):
        count = len(starts) * hours
        first, hour = divmod(int(random.integers(count)) if count > 1 else 0, hours)
        seed = None if has_seed else int(random.integers(2**31))
        with suppress(ConfigurationError):
            return restart(run, starts[first] + hour * HOUR, seed)
    raise ConfigurationError(
        f"lacks hours in {_MAX_DRAWS} random episodes; gaps='fill' fills them", key="weather"
    )


class GreenRoofVectorEnv(VectorEnv[Values, Values, NDArray[Any]]):
    """A Gymnasium vector environment of green roofs, which threads step at once.

    Environment i equals a ``GreenRoof-v1`` that is seeded with the i-th seed, bit for bit: its
    observations, actions, rewards and ``info`` are those that :class:`.GreenRoofEnv` describes. All
    episodes have the same length, and end in the same step. In the next step, the actions are
    ignored and all environments are reset (``AutoresetMode.NEXT_STEP``).

    Ticks and rewards are compiled with numba. With ``errors`` or ``ensemble``, every roof has
    forecasts of its own, and drawing them takes most of the time.

    Example:
        >>> import gymnasium
        >>> roofs = gymnasium.make_vec(
        ...     "greenroof_ros.gym:GreenRoofVector-v1", num_envs=3, hours=1, decision_ticks=900
        ... )
        >>> observations, infos = roofs.reset(seed=1)
        >>> observations, rewards, _, truncated, infos = roofs.step(roofs.action_space.sample())
        >>> observations.shape == roofs.observation_space.shape, truncated.tolist()
        (True, [False, False, False])

    Attributes:
        site: parameters of the sites.
        ends: boundaries of the forecasts' steps (s from now), starting at 0, shape (steps + 1,).
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as the base class has it)
        "render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, num_envs: int = 1, **inputs: Any) -> None:
        """Create the environments from the inputs of :class:`.GreenRoofEnv`.

        Args:
            num_envs: number of environments.
            inputs: as for :class:`.GreenRoofEnv`.

        Raises:
            ConfigurationError: if an input is invalid.
        """
        self._single = single = GreenRoofEnv(**inputs)
        self.num_envs, self.site, self.ends = num_envs, single.site, single.ends
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(single.observation_space, num_envs)
        self.action_space = batch_space(single.action_space, num_envs)
        self._randoms = [np_random()[0] for _ in range(num_envs)]

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Values, dict[str, Any]]:
        """Begin an episode of every environment.

        Args:
            seed: seed of the first environment, to which their numbers are added for the others; or
                the seeds of all. With None, an environment goes on with its random numbers.
            options: as for :meth:`.GreenRoofEnv.reset`; they apply to all environments.

        Returns:
            The observations, and the ``info`` of all environments as arrays.

        Raises:
            ConfigurationError: if an option is invalid.
            ValueError: if the number of seeds is not that of the environments.
        """
        if isinstance(seed, (int, np.integer)):
            seed = range(int(seed), int(seed) + self.num_envs)
        self._randoms = [
            random if own is None else np_random(own)[0] for own, random in
            zip(seed or [None] * self.num_envs, self._randoms, strict=True)
        ]
        self._roofs = roofs = self._single.begin(self._randoms, options)
        return self._single.observe(roofs), self._collect(self._single.describe(roofs))

    def step(self, actions: Values) -> tuple[Values, Any, Any, Any, dict[str, Any]]:
        """Apply an action of each environment, or reset all of them after the end of an episode.

        Raises:
            ConfigurationError: if an action is not one number from 0 to 1 (two numbers at sites
                with a valve).
        """
        roofs, never = self._roofs, np.zeros(self.num_envs, np.bool_)
        if not roofs.left:
            observations, infos = self.reset()
            return observations, np.zeros(self.num_envs), never, never.copy(), infos
        rewards, storm_water = self._single.play(
            roofs, read_actions(actions, self.action_space.shape)
        )
        judged, ended = ([], never.copy()) if roofs.left else (self._single.judge(roofs), ~never)
        infos = self._collect(judged)
        for name, values in zip(COUNTED, storm_water.T, strict=True):
            infos |= {name: values.copy(), f"_{name}": ~never}
        return self._single.observe(roofs), rewards, never, ended, infos

    def _collect(self, infos: Iterable[dict[str, Any]]) -> dict[str, Any]:
        """Return the ``info`` of every environment as arrays, as Gymnasium's own vectors do."""
        arrays: dict[str, Any] = {}
        for row, info in enumerate(infos):
            arrays = self._add_info(arrays, info, row)
        return arrays
