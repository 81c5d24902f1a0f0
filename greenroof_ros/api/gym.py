"""The environments for Gymnasium: ``GreenRoof-v1``, and ``GreenRoofVector-v1`` for many at once.

With the prefix ``greenroof_ros.gym:``, any process can find them:

    import gymnasium

    environment = gymnasium.make("greenroof_ros.gym:GreenRoof-v1")
    environments = gymnasium.make_vec("greenroof_ros.gym:GreenRoofVector-v1", num_envs=1000)
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import timedelta
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.api.environment import Environment, foresee, restart
from greenroof_ros.api.roofs import Roofs
from greenroof_ros.api.simulate import FunctionController, SiteState, build_run
from greenroof_ros.base.errors import ConfigurationError, require_extra, suggest_names
from greenroof_ros.base.processes import count_cores
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.forecast.steps import SteppedForecast
from greenroof_ros.physics.compiled import can_compile
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.loop import Tick
from greenroof_ros.simulation.run import Run
from greenroof_ros.weather.records import HOUR

with require_extra("gym"):
    import gymnasium
    from gymnasium.error import ResetNeeded
    from gymnasium.spaces import Box
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

Values = NDArray[np.float32]
Flags = NDArray[np.bool_]

_TO_MM_PER_H = 3.6e6
# What becomes 1 in an observation: rain (mm/h) and evapotranspiration (mm/day), both rarely
# exceeded; higher values are 1, too.
_MAX_RAIN, _MAX_EVAPOTRANSPIRATION = 50.0, 12.0
_TICKS = Range(1, 1e9, whole=True)
_RANDOM, _MAX_DRAWS = "random", 100
# Fewer sites than this are not worth another thread.
_MIN_SITES = 64


class _Roof(Environment):
    """The environment of an episode; one of many, for which it pays to compile the ticks."""

    def __init__(self, run: Run) -> None:
        self._begin(run, can_compile())


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
        raise ConfigurationError(f"must be numbers from 0 to 1, of shape {shape}", key="action")
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
      is on a full hour from which weather and forecasts cover an episode.

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
            inputs: site, weather, start, hours, forecast, horizon (h) and others; start can also
                be ``"random"``.

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
        self._is_random, self._inputs = inputs.get("start") == _RANDOM, inputs
        if self._is_random:  # until the first one is drawn
            known = make_inputs(choose_class(FunctionController), {**inputs, "start": None})
            weather, _ = known.read_records(known.read_site())
            self._inputs = {**inputs, "weather": weather, "start": weather.first}
        self._warned: set[str] = set()
        self._own = self._build({})
        self._inputs["weather"] = self._own.weather
        self._roof = _Roof(self._own)
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
        self._roof = _Roof(*self._draw([self.np_random], options))
        (info,) = _describe_starts(self._roof._roofs)
        return self._observe(self._roof._roofs)[0], info

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
            opening = outlet or [1.0]
            reward = float(roof._roofs.follow([command], opening, self._decision_ticks)[0])
        info = {"metrics": roof.metrics} if roof.done else {}
        return self._observe(roof._roofs)[0], reward, False, roof.done, info

    def _observe(self, roofs: Roofs) -> Values:
        """Return the observations of roofs, shape (n, entries)."""
        runs, tick = roofs.runs, roofs.tick
        if len(runs) > 1 and runs[0].forecast_choice.model == PERFECT:
            forecasts = SteppedForecast.at_once([run.forecast for run in runs], tick, roofs.weather)
        else:
            forecasts = np.array([np.concatenate(foresee(run, tick)) for run in runs])
        values = np.hstack((roofs.levels, forecasts[roofs.run_of]))
        values /= self._scale
        if self._has_valve:
            values = np.column_stack((values, roofs.wet_left))
        return np.asarray(np.clip(values, 0.0, 1.0), np.float32)

    def _build(self, options: Mapping[str, Any]) -> Run:
        inputs = {**self._inputs, **options}
        return build_run(choose_class(FunctionController), inputs, self._warned)

    def _draw(
        self, randoms: Sequence[np.random.Generator], options: Mapping[str, Any] | None
    ) -> list[Run]:
        """Draw an episode with each of some random number generators.

        Raises:
            ConfigurationError: if an option of :meth:`reset` is invalid, or if the record is too
                short or contains too many missing hours.
        """
        known = "start", "initial"
        given = {key: value for key, value in (options or {}).items() if value is not None}
        for key in given:
            if key not in known:
                raise ConfigurationError(
                    f"is not an option of reset; {suggest_names(key, known)}", key=key
                )
        is_random = self._is_random
        if "start" in given:
            is_random = isinstance(given["start"], str) and given["start"] == _RANDOM
            if is_random:
                del given["start"]
        run = self._build(given) if given else self._own
        if is_random:
            return [_draw_start(run, random) for random in randoms]
        return [restart(run, run.start, _draw_seed(random)) for random in randoms]


def _describe_starts(roofs: Roofs) -> Iterator[dict[str, Any]]:
    """Yield the ``info`` of the beginning of each episode."""
    for place, (cistern, roof) in zip(roofs.run_of, roofs.levels.tolist(), strict=True):
        run = roofs.runs[place]
        yield {
            "start": run.start.isoformat(), "cistern_m3": run.site.cistern_volume(cistern),
            "roof_m3": run.site.roof_volume(roof),
        }


def _draw_seed(random: np.random.Generator) -> int:
    return int(random.integers(2**31))


def _draw_start(run: Run, random: np.random.Generator) -> Run:
    """Draw a full hour from which on weather and forecasts cover a run, and the forecasts' seed."""
    record, ticks = run.weather.end - run.weather.first, run.steps + run.site.M
    count = (record - timedelta(seconds=ticks * run.site.tau)) // HOUR + 1
    if count < 1:
        raise ConfigurationError("is shorter than an episode", key="weather")
    for _ in range(_MAX_DRAWS):
        start = run.weather.first + int(random.integers(count)) * HOUR
        with suppress(ConfigurationError):
            return restart(run, start, _draw_seed(random))
    raise ConfigurationError(
        f"{_MAX_DRAWS} randomly drawn episodes all contained missing hours; gaps='fill' fills "
        "missing hours", key="weather",
    )


class GreenRoofVectorEnv(VectorEnv[Values, Values, NDArray[Any]]):
    """A Gymnasium vector environment of green roofs, which threads step at once.

    Environment i equals a ``GreenRoof-v1`` that is seeded with the i-th seed, bit for bit: its
    observations, actions, rewards and ``info`` are those that :class:`.GreenRoofEnv` describes,
    with the default reward. All episodes have the same length, and end in the same step. In the
    next step, the actions are ignored and all environments are reset
    (``AutoresetMode.NEXT_STEP``).

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

    def __init__(
        self, num_envs: int = 1, *, decision_ticks: int = 1, render_mode: str | None = None,
        **inputs: Any,
    ) -> None:
        """Create the environments from the inputs of :class:`.GreenRoofEnv`.

        Args:
            num_envs: number of environments.
            decision_ticks: number of ticks for which an action applies.
            render_mode: None, the only mode.
            inputs: as for :class:`.GreenRoofEnv`, but without a reward.

        Raises:
            ConfigurationError: if an input is invalid.
        """
        if "reward" in inputs:
            raise ConfigurationError(
                "is that of GreenRoof-v1 by default; make_vec of GreenRoof-v1 takes a function",
                key="reward",
            )
        self._single = single = GreenRoofEnv(decision_ticks=decision_ticks, **inputs)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.site, self.ends = single.site, single.ends
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(single.observation_space, num_envs)
        self.action_space = batch_space(single.action_space, num_envs)
        self._randoms = [np_random()[0] for _ in range(num_envs)]
        self._roofs: Roofs | None = None
        self._threads = max(1, min(count_cores(), num_envs // _MIN_SITES))
        self._pool = ThreadPoolExecutor(self._threads)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Values, dict[str, Any]]:
        """Begin an episode of every environment.

        Args:
            seed: seed of the first environment, to which their numbers are added for the others; or
                the seeds of all. With None, an environment goes on with its random numbers.
            options: as for :meth:`.GreenRoofEnv.reset`; they apply to all environments.

        Returns:
            The observations, and the ``info`` of all environments as arrays.

        Raises:
            ConfigurationError: if an option or the number of seeds is invalid.
        """
        count = self.num_envs
        if isinstance(seed, (int, np.integer)):
            seed = range(int(seed), int(seed) + count)
        seeds = [None] * count if seed is None else seed
        if len(seeds) != count:
            raise ConfigurationError(f"must be one number, or {count} numbers", key="seed")
        self._randoms = [
            random if own is None else np_random(own)[0]
            for own, random in zip(seeds, self._randoms, strict=True)
        ]
        runs = self._single._draw(self._randoms, options)
        self._roofs = roofs = Roofs(runs, can_compile(), self._threads)
        return self._single._observe(roofs), self._collect(_describe_starts(roofs))

    def step(
        self, actions: Values
    ) -> tuple[Values, NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        """Apply an action of each environment, or reset all of them after the end of an episode.

        Raises:
            ConfigurationError: if an action is not one number from 0 to 1 (two numbers at sites
                with a valve).
            gymnasium.error.ResetNeeded: if the environments have not been reset yet.
        """
        count, roofs = self.num_envs, self._roofs
        if roofs is None:
            raise ResetNeeded("call reset() before step()")
        never, steps = np.zeros(count, np.bool_), roofs.runs[0].steps
        if roofs.tick == steps:
            observations, infos = self.reset()
            return observations, np.zeros(count), never, never.copy(), infos
        commands = read_actions(actions, (count, 1 + self.site.low_outlet_valve))
        outlets = commands[:, 1] if self.site.low_outlet_valve else np.ones(count)
        rewards = roofs.follow(
            commands[:, 0].tolist(), outlets.tolist(), self._single._decision_ticks,
            self._pool.map,
        )
        ended = roofs.tick == steps
        infos = self._collect({"metrics": each} for each in (roofs.metrics() if ended else []))
        return self._single._observe(roofs), rewards, never, np.full(count, ended), infos

    def close_extras(self, **_: Any) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _collect(self, infos: Iterable[dict[str, Any]]) -> dict[str, Any]:
        """Return the ``info`` of every environment as arrays, as Gymnasium's own vectors do."""
        arrays: dict[str, Any] = {}
        for row, info in enumerate(infos):
            arrays = self._add_info(arrays, info, row)
        return arrays
