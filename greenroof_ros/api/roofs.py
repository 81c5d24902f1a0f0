"""Sites that a program commands, one or many: their ticks are those of a compiled season."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise, starmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.compiled import compiled, records
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.sensor_and_pump import make_switch, read_errors
from greenroof_ros.physics.storm_water import Event, is_wet, time_without_rain
from greenroof_ros.physics.valve import make_valve
from greenroof_ros.results.metrics import end_run, find_new_days
from greenroof_ros.results.sums import count_places
from greenroof_ros.simulation.loop import Tick
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import ALL_KEPT, Control, Sites, Ticks, run_ticks

Values = NDArray[np.float64]

# What a command from outside does not change.
_CONTROL = Control(0.0, math.inf, -math.inf, 1.0, 1.0)
# Ticks that are read together.
_BLOCK = 1024


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

    The results equal those of :class:`.loop.Simulation` bit for bit.

    Attributes:
        runs: the different runs.
        run_of: place in ``runs`` of each of n sites, shape (n,).
        tick: number of the current tick.
    """

    def __init__(self, runs: Sequence[Run], compiles: bool, parts: int = 1) -> None:
        """Begin with tick 0.

        Args:
            runs: the run of each site; sites with the same run object share its weather.
            compiles: whether to compile the ticks, for which numba must be installed.
            parts: number of parts into which the sites are divided for as many threads.
        """
        run, site, count = runs[0], runs[0].site, len(runs)
        self.runs = [*{id(each): each for each in runs}.values()]
        places = {id(each): place for place, each in enumerate(self.runs)}
        self.run_of = np.array([places[id(each)] for each in runs])
        self.tick = self._first = self._end = 0
        self._compiles, self._plant = compiles, plant_parameters(site)
        self._errors = read_errors(run.sensor_and_pump, run.steps + 1)
        self._without_rain = np.array([[each.without_rain_s] for each in self.runs])
        self._days = [find_new_days(site, each.time_ns(0) / 1e9, run.steps) for each in self.runs]
        plants, controls, taken = [self._plant] * count, [_CONTROL] * count, self._as_taken
        in_form: Callable[[Any], Any] = records if compiles else list
        self._sites = Sites(
            in_form(plants), in_form(controls), self.run_of, np.zeros(count, np.intp),
            np.zeros((count, 4)), np.zeros(count),
            taken(np.array([(each.x1, each.x2, site.initial_layer) for each in runs])),
            taken(np.tile(make_switch(run.sensor_and_pump, site.tau), (count, 1))),
            taken(np.tile(make_valve(site.valve_moves_per_hour), (count, 1))),
            taken(np.zeros((count, count_places(self._plant)))), np.zeros(count),
            np.zeros((count, 0, len(Event._fields))), np.zeros((count, 0, len(ALL_KEPT))),
        )
        intervals = -(-run.steps // int(self._plant.interval_ticks))
        bounds = np.linspace(0, count, parts + 1).astype(int).tolist()
        self._read(0)
        self._parts = [
            (rows, taken(np.zeros((1, 2, intervals)))) for rows in starmap(slice, pairwise(bounds))
        ]

    def _as_taken(self, array: NDArray[Any]) -> Any:
        """Return an array as the ticks take it: plain Python is faster with lists."""
        return array if self._compiles else array.tolist()

    def _read(self, last: int) -> None:
        """Read the ticks from the current one to another (exclusive) or more, up to the end's."""
        run, site, first = self.runs[0], self.runs[0].site, self.tick
        last = min(max(last, first + _BLOCK), run.steps + 1)
        rain, potential, frost, quiet = (np.array(values) for values in zip(
            *(each.read_ticks(first, last, site) for each in self.runs), strict=True
        ))
        follow: Any = compiled(follow_rain) if self._compiles else follow_rain
        before = self._without_rain[:, first - self._first].tolist()
        self._without_rain = np.array([
            follow(self._as_taken(of_run), site.tau, dry)
            for of_run, dry in zip(rain, before, strict=True)
        ])
        new_day = np.zeros(rain.shape, np.bool_)
        for starts, days in zip(new_day, self._days, strict=True):
            starts[[day - first for day in days if first <= day < last]] = True
        rule: Any = is_wet  # of numbers, and of arrays
        wet = rule(self._without_rain[:, 1:], site.tau, self._plant.wet_after_s)
        values = rain, potential, frost, wet, quiet, new_day, self._errors[first:last]
        self._rain, self._potential = rain, potential
        self._ticks = Ticks(first, *map(self._as_taken, values))
        self._first, self._end = first, last

    def follow(
        self, commands: Sequence[float], outlets: Sequence[float], ticks: int,
        spread: Callable[..., Any] = map,
    ) -> Values:
        """Simulate some ticks with the same commands, or fewer up to the end of the runs.

        Args:
            commands: command to the pumps of each site (share of the maximum flow).
            outlets: opening of each valve (share); 1 without a valve.
            ticks: number of ticks.
            spread: ``map`` of a pool with a thread for each part of the sites.

        Returns:
            The negative deviation of each roof's reading from its target, summed over the states
            after the ticks (m3), shape (n,).
        """
        first, last = self.tick, min(self.tick + ticks, self.runs[0].steps)
        if last >= self._end:
            self._read(last + 1)
        controls = self._sites.controls
        if self._compiles:
            controls["fraction"], controls["policy"] = commands, outlets
        else:
            controls = [
                _CONTROL._replace(fraction=command, policy=outlet)
                for command, outlet in zip(commands, outlets, strict=True)
            ]
        # A single tick is kept: it is a multiple of itself.
        kept = np.zeros((len(controls), 2 if ticks == 1 else 0, len(ALL_KEPT)))
        self._sites = sites = self._sites._replace(controls=controls, kept=kept)
        function: Any = compiled(run_ticks) if self._compiles else run_ticks

        def simulate(part: tuple[slice, Any]) -> None:
            rows, discharged = part
            function(
                Sites(*(each[rows] for each in sites)), self._ticks, first, last, discharged,
                max(1, first), -1,
            )

        list(spread(simulate, self._parts))
        self.tick, p = last, self._plant
        rewards: Values = -(sites.missed + abs(self.levels[:, 1] * p.a2 - p.x2_star))
        return rewards

    @property
    def levels(self) -> Values:
        """Readings of the sensors in the cisterns and on the roofs (m), shape (n, 2)."""
        levels: Values = np.array(self._sites.state)[:, :2] / (self._plant.a1, self._plant.a2)
        if len(self._errors):
            levels[:, 1] = np.maximum(0.0, levels[:, 1] + self._errors[self.tick])
        return levels

    @property
    def weather(self) -> tuple[Values, Values]:
        """Rain (m/s) and evapotranspiration (m3/s) of the runs in this tick, shapes (runs, 1)."""
        place = self.tick - self._first
        return self._rain[:, place, None], self._potential[:, place, None]

    @property
    def wet_left(self) -> Values:
        """Time for which the weather will stay wet without more rain, as a share, shape (n,)."""
        after = self._plant.wet_after_s
        left = np.maximum(0.0, after - self._without_rain[self.run_of, self.tick - self._first])
        shares: Values = np.divide(left, after, out=np.zeros_like(left), where=left > 0)
        return shares

    def find_tick(self, readings: Values) -> Tick:
        """Return the last tick of the first site, if it was simulated alone.

        Args:
            readings: the levels before it (m), shape (2,).
        """
        k = self.tick - 1
        v = dict(zip(ALL_KEPT, self._sites.kept[0][min(k, 1)].tolist(), strict=True))
        flows = Flows(
            v["outflow"], v["pump_flow"], v["drainage"], v["evaporated"], v["limited"] > 0,
            v["mains"], v["low_outlet"],
        )
        return Tick._make((
            k, v["cistern"], v["roof"], v["layer"], *readings.tolist(), v["precipitation"],
            v["evapotranspiration"], v["frost"], v["command"], flows, v["outlet"],
        ))

    def metrics(self) -> list[dict[str, float]]:
        """Return the metrics of every site, as if the runs ended now."""
        site, now = self.runs[0].site, self._sites
        return [
            end_run(site, [*map(float, sums)], events, State(*map(float, state))).metrics
            for sums, events, state in zip(now.sums, now.events, now.state, strict=True)
        ]
