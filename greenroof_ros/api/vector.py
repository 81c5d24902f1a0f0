"""The environment ``GreenRoofVector-v1`` for Gymnasium: many green roofs that are stepped at once.

Any process can find the environment by its name with the package as a prefix:

    import gymnasium

    roofs = gymnasium.make_vec("greenroof_ros.gym:GreenRoofVector-v1", num_envs=1000)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.api.commanded import CommandedSites, Surroundings, Values, follow
from greenroof_ros.api.gym import RANDOM, GreenRoofEnv, read_actions
from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.processes import count_cores
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.forecast.models import make_model
from greenroof_ros.physics.compiled import can_compile, compiled
from greenroof_ros.physics.storm_water import HOUR_S
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.simulation.run import Run
from greenroof_ros.weather.series import PerTick, rain_per_tick

with require_extra("gym"):
    from gymnasium.error import ResetNeeded
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

Array = NDArray[np.float32]
Flags = NDArray[np.bool_]

_HOUR_NS, _MINUTE_NS = 3_600_000_000_000, 60_000_000_000
# Fewer sites than this are not worth another thread.
_MIN_SITES = 64


def observe(
    levels: Any, without_rain: Any, wet_after: float, now: Any, rates: Any, firsts: Any,
    places: Any, hours: Any, counts: Any, sinces: Any, ends: Any, held: Any, lengths: Any,
    scale: Any, result: Any, first_row: int, last_row: int,
) -> None:
    """Write the observations of some sites, as :class:`.GreenRoofEnv` makes them.

    The means of the forecasts are those of :class:`.HourForecast`, bit for bit.

    Args:
        levels: readings of the sensors in the cistern and on the roof (m), shape (n, 2).
        without_rain: time without rain until now (s), shape (n,).
        wet_after: time after rain that counts as wet weather (s).
        now: current rain (m/s) and evapotranspiration (m3/s), shape (2, n).
        rates: hourly forecasts of both, shape (forecasts, 2, hours).
        firsts: hour of the record in which each forecast begins, shape (forecasts,).
        places: place of each site's forecast, shape (n,).
        hours: current hour of each site, shape (n,).
        counts: number of hours for which each site has a forecast, shape (n,).
        sinces: time since the start of the current hour (s), shape (n,).
        ends: boundaries of the steps, the first of which is where the current value ends
            to hold (s from now), shape (steps + 1,).
        held: share of each step for which the current value holds, shape (steps,).
        lengths: lengths of the steps (s), shape (steps,).
        scale: values that become 1 in an observation, shape (2 + 2 steps,).
        result: observations, shape (n, entries), whose last entry may be the wet weather.
        first_row: first site.
        last_row: end of the sites.
    """
    steps, known, later = len(lengths), -1.0, np.zeros(len(ends), np.int64)
    fallen, rate = np.zeros(len(ends)), np.zeros(len(ends))
    for row in range(first_row, last_row):
        values, since, place, last_hour = result[row], sinces[row], places[row], counts[row] - 1
        if since != known:
            known = since
            for i in range(steps + 1):
                later[i] = int((since + ends[i]) // HOUR_S)
        for i in range(2):
            values[i] = min(max(levels[row][i] / scale[i], 0.0), 1.0)
        for kind in range(2):
            hourly, current = rates[place][kind], now[kind][row]
            begin, entry = hours[row] - firsts[place], 2 + kind * steps
            done, total = 0, 0.0
            for i in range(steps + 1):
                hour = min(later[i], last_hour)
                while done < hour:
                    total += hourly[begin + done] * HOUR_S
                    done += 1
                rate[i] = hourly[begin + hour]
                fallen[i] = total + rate[i] * (ends[i] - hour * HOUR_S)
            for i in range(steps):
                # np.divide, because a check for 0 would prevent vectorization.
                mean = np.divide(fallen[i + 1] - fallen[i], lengths[i]) + held[i] * current
                mean += np.divide(rate[i + 1] - rate[i], lengths[i]) * since
                values[entry + i] = min(np.divide(max(mean, 0.0), scale[entry + i]), 1.0)
        if len(values) > len(scale):
            left = max(0.0, wet_after - without_rain[row])  # s
            values[len(scale)] = left / wet_after if left > 0 else 0.0


class _Forecasts:
    """The forecasts of all sites, each in its current hour."""

    def __init__(self, run: Run, ends: Values) -> None:
        """Set a run with the site, the weather and the choice of forecasts.

        Args:
            run: the run.
            ends: boundaries of the forecasts' steps (s from now), starting at 0.
        """
        self._run, weather, self._last_end = run, run.weather, float(ends[-1])
        hold, lengths = max(run.site.tau, float(ends[1])), np.diff(ends)
        self._steps = np.maximum(ends, hold), np.diff(np.minimum(ends, hold)) / lengths, lengths
        self._width = math.ceil(self._last_end / HOUR_S) + 2
        self._has_seeds = "seed" in run.forecast_choice.options()
        self._models = [make_model(run.forecast_choice, weather, run.site, False)]
        self._made: dict[tuple[int, ...], Values] = {}
        if run.forecast_choice.model == PERFECT:
            hours = np.minimum(np.arange(weather.hours + self._width), weather.hours - 1)
            rain = weather.precipitation[None, hours]
            self._rates = self._make_rates((rain, weather.evapotranspiration[hours]))[None]

    def begin(self, starts: Sequence[datetime], seeds: Sequence[int]) -> None:
        """Begin an episode of every site, with the start of each and the seed of its forecasts."""
        run, count, self._hours = self._run, len(starts), np.empty(0, np.int64)
        first, choice = run.weather.first, run.forecast_choice
        self._offsets = np.array([(start - first).total_seconds() for start in starts])
        self._firsts, self._places = np.zeros(1, np.int64), np.zeros(count, np.int64)
        if self._has_seeds:
            self._models = [
                make_model(replace(choice, seed=seed), run.weather, run.site, False)
                for seed in seeds
            ]

    def find_arguments(self, tick: int) -> tuple[Any, ...]:
        """Return the arguments of :func:`observe` from ``rates`` to ``lengths`` in a tick."""
        run, tau = self._run, self._run.site.tau
        times = self._offsets + tick * tau
        hours = (times // HOUR_S).astype(np.int64)
        ends = np.minimum((hours + 1) * HOUR_S, self._offsets + run.steps * tau) + self._last_end
        counts = np.ceil(ends / HOUR_S).astype(np.int64) - hours
        if run.forecast_choice.model != PERFECT and not np.array_equal(hours, self._hours):
            self._forecast(hours, counts)
        self._hours = hours
        return (
            self._rates, self._firsts, self._places, hours, counts, times - hours * HOUR_S,
            *self._steps,
        )

    def _forecast(self, hours: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Make the forecasts of the current hours, one for sites that have it in common."""
        known: dict[tuple[int, ...], int] = {}
        own = [0] * len(hours)
        if self._has_seeds:
            own, self._made = [*range(len(hours))], {}
        keys = [*zip(own, hours.tolist(), counts.tolist(), strict=True)]
        self._places = np.array([known.setdefault(key, len(known)) for key in keys])
        self._rates = np.zeros((len(known), 2, self._width))
        self._firsts = np.array([hour for _, hour, _ in known])
        for place, (model, hour, count) in enumerate(known):
            key = model, hour, count
            if key not in self._made:
                self._made[key] = self._make_rates(self._models[model].forecast(hour, count)[:2])
            self._rates[place, :, :count] = self._made[key]

    def _make_rates(self, forecast: tuple[Values, Values]) -> Values:
        """Return hourly rain (m/s) and evapotranspiration (m3/s), shape (2, hours)."""
        rates = np.vstack(forecast)
        rates[0] /= 1000 * HOUR_S
        rates[1] *= self._run.site.a2 / 1000 / 86400
        return rates


class GreenRoofVectorEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """A Gymnasium vector environment of green roofs, which threads step at once.

    Environment i equals a ``GreenRoof-v1`` that is seeded with the i-th seed, bit for bit: its
    observations, actions, rewards and ``info`` are those that :class:`.GreenRoofEnv` describes,
    with the default reward. All episodes have the same length, and end in the same step. In the
    next step, the actions are ignored and all environments are reset
    (``AutoresetMode.NEXT_STEP``).

    Ticks, rewards and observations are compiled with numba; without it, Gymnasium's own vector of
    ``GreenRoof-v1`` is faster. With ``errors`` or ``ensemble``, every roof has forecasts of its
    own, and drawing them takes most of the time.

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
        self._shape = num_envs, len(single._scale) + self.site.low_outlet_valve
        self.action_space = batch_space(single.action_space, num_envs)
        self._forecasts = _Forecasts(single._roof._run, self.ends)
        self._randoms = [np_random()[0] for _ in range(num_envs)]
        self._begun: dict[str, Any] = {}
        self._surroundings: Surroundings
        self._sites: CommandedSites | None = None
        threads = max(1, min(count_cores(), num_envs // _MIN_SITES))
        bounds = np.linspace(0, num_envs, threads + 1).astype(int).tolist()
        self._parts, self._pool = [*pairwise(bounds)], ThreadPoolExecutor(threads)
        for function in (follow, observe):  # before threads use them
            compiled(function)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
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
        places, count = self._single._read_options(options), self.num_envs
        seeds = [None] * count if seed is None else seed
        if isinstance(seeds, (int, np.integer)):
            seeds = [int(seeds) + number for number in range(count)]
        if len(seeds) != count:
            raise ConfigurationError(f"must be one number, or {count} numbers", key="seed")
        for row, own in enumerate(seeds):
            if own is not None:
                self._randoms[row] = np_random(own)[0]
        drawn = [self._single._draw(random, places) for random in self._randoms]
        self._surround(places)
        run, site = self._surroundings.run, self.site
        starts, volumes = [run.start] * count, np.tile((run.x1, run.x2), (count, 1))
        if places["start"] == RANDOM:
            starts = [begin["start"] for begin, _ in drawn]
        if places["initial"] == RANDOM:
            volumes = np.array([begin["initial"] for begin, _ in drawn])
        x1, x2 = volumes.T
        self._sites = sites = CommandedSites(self._surroundings, starts, x1, x2)
        self._forecasts.begin(starts, [number for _, number in drawn])
        observations, levels = self._advance(sites, 0), np.array(sites.levels)
        return observations, self._describe({
            "start": np.array([start.isoformat() for start in starts], object),
            "cistern_m3": levels[:, 0] * site.a1, "roof_m3": levels[:, 1] * site.a2,
        })

    def step(self, actions: Array) -> tuple[Array, Values, Flags, Flags, dict[str, Any]]:
        """Apply an action of each environment, or reset all of them after the end of an episode.

        Raises:
            ConfigurationError: if an action is not one number from 0 to 1 (two numbers at sites
                with a valve).
            gymnasium.error.ResetNeeded: if the environments have not been reset yet.
        """
        count, sites = self.num_envs, self._sites
        if sites is None:
            raise ResetNeeded("call reset() before step()")
        never, steps = np.zeros(count, np.bool_), self._surroundings.run.steps
        if sites.tick == steps:
            observations, infos = self.reset()
            return observations, np.zeros(count), never, never.copy(), infos
        commands = read_actions(actions, (count, 1 + self.site.low_outlet_valve))
        given = np.ones((count, 2))
        given[:, : commands.shape[1]] = commands
        sites.commands[:] = self._surroundings.as_taken(given)
        observations = self._advance(sites, min(sites.tick + self._single._decision_ticks, steps))
        ended = sites.tick == steps
        infos = self._describe_metrics(sites) if ended else {}
        return observations, np.array(sites.rewards), never, np.full(count, ended), infos

    def close_extras(self, **_: Any) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _surround(self, places: Mapping[str, Any]) -> None:
        """Make the surroundings of episodes with a start and an initial state, or random ones."""
        if places == self._begun:
            return
        run = self._single._make_roof({
            key: value for key, value in places.items() if value not in (None, RANDOM)
        })._run
        rain, frost = run.series.precipitation, run.series.frost
        hours = range(frost.step(0), frost.step(run.steps) + 1)
        if places["start"] == RANDOM:
            rain, hours = _rain_of_record(run), range(run.weather.hours)
        self._surroundings = Surroundings.of_run(run, rain, hours, can_compile())
        self._begun = dict(places)

    def _advance(self, sites: CommandedSites, last: int) -> Array:
        """Simulate all sites up to a tick, and return the observations."""
        arguments = (
            sites.levels, sites.without_rain, self.site.wet_after * HOUR_S,
            sites.find_weather(last),
            *self._forecasts.find_arguments(last), self._single._scale,
        )
        result = np.empty(self._shape, np.float32)

        def run(part: tuple[int, int]) -> None:
            if last > sites.tick:
                sites.follow(last, *part)
            compiled(observe)(*arguments, result, *part)

        list(self._pool.map(run, self._parts))
        sites.tick = last
        return result

    def _describe_metrics(self, sites: CommandedSites) -> dict[str, Any]:
        """Return the ``info`` of the last step, in which some sites may lack a metric."""
        rows, metrics = sites.compute_metrics(), {}
        for name in (metric.name for metric in METRICS):
            known = np.array([name in row for row in rows])
            if known.any():
                metrics[name] = np.array([row.get(name, 0) for row in rows])
                metrics[f"_{name}"] = known
        return self._describe({"metrics": metrics})

    def _describe(self, infos: dict[str, Any]) -> dict[str, Any]:
        """Return infos together with masks of the environments that have them, which are all."""
        return infos | {f"_{name}": np.ones(self.num_envs, np.bool_) for name in infos}


def _rain_of_record(run: Run) -> PerTick:
    """Return the rain of a whole record with the clock of a run that starts at a full hour.

    Raises:
        ConfigurationError: if the ticks of runs that start at other hours have other means of the
            rain.
    """
    rain, tick_ns = run.series.precipitation, run.series.frost.tick_ns
    if run.weather.minutes is None or _MINUTE_NS % tick_ns == 0:
        return rain
    if _HOUR_NS % tick_ns:
        raise ConfigurationError(
            "must divide an hour, because the starts are random and the rain has a resolution of "
            "one minute", key="tau", value=run.site.tau,
        )
    ticks = range(run.weather.hours * (_HOUR_NS // tick_ns))
    rain = rain_per_tick(run.weather, 0, tick_ns, ticks)
    return replace(rain, offset_ns=run.series.frost.offset_ns)
