"""Sites that a program commands: one or many, with equal parameters, over ticks of one record.

The ticks are compiled, and one call simulates all ticks during which the commands stay the same.
The results equal those of :class:`greenroof_ros.simulation.loop.Simulation` bit for bit, because
the same functions of numbers step the plant and add up the sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.compiled import compiled, records
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.sensor_and_pump import (
    make_switch,
    observe_pump,
    read_errors,
    switch_pump,
)
from greenroof_ros.physics.storm_water import Event, is_wet, time_without_rain
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.physics.valve import make_valve, move_valve
from greenroof_ros.results.metrics import compute_metrics, find_new_days
from greenroof_ros.results.sums import add, count_places, finish
from greenroof_ros.simulation.loop import Tick
from greenroof_ros.simulation.run import Run
from greenroof_ros.weather.series import PerTick

Values = NDArray[np.float64]

_HOUR_NS, _MINUTE_NS = 3_600_000_000_000, 60_000_000_000
# Places of the times: a tick, a step of the rain (ns); the last steps of rain and hours in the
# record; the first minute of the quiet hours' mask.
_TICK, _STEP, _LAST_STEP, _LAST_HOUR, _FIRST_MINUTE = range(5)


def follow(
    parameters: Any, times: Any, rain: Any, potential: Any, frost: Any, quiet: Any,
    errors: Any, begins: Any, new_days: Any, commands: Any, state: Any, levels: Any, switches: Any,
    valves: Any, without_rain: Any, days: Any, sums: Any, events: Any, ticks: Any, rewards: Any,
    first_row: int, last_row: int, first: int, last: int,
) -> None:
    """Simulate sites with constant commands from a tick to another (exclusive).

    Args:
        parameters: :class:`.PlantParameters` of all sites, shape (1,).
        times: numbers that find a tick in the record, shape (5,).
        rain: rain rate in each step of the record (m/s).
        potential: evapotranspiration in each hour of the record (m3/s).
        frost: 1 in each hour of the record with frost, otherwise 0.
        quiet: whether each minute is in the quiet hours, or (0,) without them.
        errors: error of the roof's sensor (m), shape (steps + 1,), or (0,) without errors.
        begins: time of tick 0 since the start of the first hour and of the first step of rain (ns),
            shape (n, 2).
        new_days: first ticks of the days of the site's clock, shape (n, days), ended by -1.
        commands: command to the pumps (share of the maximum flow) and to the valve, 1 without a
            valve, shape (n, 2).
        state: water in cistern, roof and layer (m3), shape (n, 3).
        levels: readings of the sensors in the cistern and on the roof (m), shape (n, 2).
        switches: switches of the pumps, see :func:`.make_switch`, shape (n, 5).
        valves: valves, see :func:`.make_valve`, shape (n, 3).
        without_rain: time without rain until now (s), shape (n,).
        days: number of days that have begun, shape (n,).
        sums: sums of the runs, shape (n, places).
        events: an empty table of events.
        ticks: values of the last tick in the order of :class:`.Tick`, without its number, shape
            (n, 17).
        rewards: negative deviation of the roof's reading from its target, summed over the states
            after the ticks (m3), shape (n,).
        first_row: first site.
        last_row: end of the sites.
        first: first tick.
        last: end of the ticks.
    """
    p, tick_ns, step_ns = parameters[0], times[_TICK], times[_STEP]
    minute = times[_FIRST_MINUTE]
    for row in range(first_row, last_row):
        switch, valve, own, begin = switches[row], valves[row], sums[row], begins[row]
        now = State(state[row][0], state[row][1], state[row][2])
        dry, day, reward = without_rain[row], days[row], 0.0
        asked, of_valve, roof = commands[row][0], commands[row][1], levels[row][1]
        hour_ends, step_ends, falls, demand, frozen = 0, 0, 0.0, 0.0, False
        for k in range(first, last):
            since, since_step = begin[0] + k * tick_ns, begin[1] + k * tick_ns
            if since >= hour_ends:
                hour = min(since // _HOUR_NS, times[_LAST_HOUR])
                demand, frozen = potential[hour], frost[hour] != 0
                hour_ends = (since // _HOUR_NS + 1) * _HOUR_NS
            if since_step >= step_ends:
                falls = rain[min(since_step // step_ns, times[_LAST_STEP])]
                step_ends = (since_step // step_ns + 1) * step_ns
            hushed = len(quiet) > 0 and quiet[since // _MINUTE_NS - minute]
            may_run = p.b > 0 and not (frozen or hushed)
            command = asked if may_run else 0.0
            outlet = 0.0 if frozen and p.valve_closed_in_frost else of_valve
            opening = move_valve(valve, p.tau, outlet)
            dry = time_without_rain(dry, falls, p.tau)
            wet = is_wet(dry, p.tau, p.wet_after_s)
            switched = switch_pump(switch, command, may_run)
            after, flows = step(p, now, falls, demand, switched, opening, OWN_PUMPS)
            observe_pump(switch, flows.pump)
            new_day = new_days[row][day] == k
            if new_day:
                day += 1
            add(p, own, events, now, command, falls, demand, flows, wet, new_day)
            if k == last - 1:
                place = ticks[row]
                place[0], place[1], place[2] = now.cistern, now.roof, now.layer
                place[3], place[4], place[5], place[6] = now.cistern / p.a1, roof, falls, demand
                place[7], place[8] = 1.0 if frozen else 0.0, command
                place[9], place[10], place[11] = flows.outflow, flows.pump, flows.drainage
                place[12], place[13] = flows.evapotranspiration, 1.0 if flows.limited else 0.0
                place[14], place[15], place[16] = flows.mains, flows.low_outlet, outlet
            now, roof = after, after.roof / p.a2
            if len(errors) > 0:
                roof = max(0.0, roof + errors[k + 1])
            reward -= abs(roof * p.a2 - p.x2_star)
        state[row][0], state[row][1], state[row][2] = now.cistern, now.roof, now.layer
        levels[row][0], levels[row][1] = now.cistern / p.a1, roof
        without_rain[row], days[row], rewards[row] = dry, day, reward


def finish_all(parameters: Any, sums: Any, events: Any, state: Any) -> None:
    """End the runs of all sites; see :func:`.sums.finish` and :func:`follow`."""
    for row in range(len(sums)):
        last = State(state[row][0], state[row][1], state[row][2])
        finish(parameters[0], sums[row], events, last)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the sites have in common, and commands do not change.

    Attributes:
        run: a run with the site and the weather.
        rain_offset_ns: time of tick 0 of this run since the first step of the rain.
        compiles: whether the ticks are compiled.
        fixed: the first arguments of :func:`follow`.
        earlier: what is known of the starts so far; see :meth:`find_before`.
    """

    run: Run
    rain_offset_ns: int
    compiles: bool
    fixed: tuple[Any, ...]
    earlier: dict[datetime, tuple[float, list[int]]] = field(default_factory=dict)

    @classmethod
    def of_run(cls, run: Run, rain: PerTick, hours: range, compiles: bool) -> Surroundings:
        """Make the surroundings of a run, and of others at other times of its record.

        Args:
            run: the run.
            rain: rain of all these runs, with the clock of this one.
            hours: hours of the record that the runs may reach.
            compiles: whether to compile the ticks, for which numba must be installed.
        """
        site, series, sensor = run.site, run.series, run.sensor_and_pump
        frost, quiet = series.frost, np.empty(0, np.bool_)
        if site.quiet is not None:
            first = run.time_ns(0) - frost.offset_ns + hours.start * _HOUR_NS
            quiet = site.quiet.quiet_ticks(first, _MINUTE_NS, 60 * len(hours))
        lasts = len(rain.values) - 1, len(frost.values) - 1
        times = [frost.tick_ns, rain.step_ns, *lasts, 60 * hours.start]
        parameters = [plant_parameters(site)]
        arrays = (
            np.array(times), rain.values, series.evapotranspiration.values, frost.values,
            quiet, read_errors(sensor, run.steps + 1),
        )
        if compiles:
            return cls(run, rain.offset_ns, True, (records(parameters), *arrays))
        return cls(run, rain.offset_ns, False, (
            parameters, *map(np.ndarray.tolist, arrays)
        ))

    def as_taken(self, array: NDArray[Any]) -> Any:
        """Return an array as :func:`follow` takes it; plain Python is faster with lists."""
        return array if self.compiles else array.tolist()

    def find_before(self, start: datetime) -> tuple[float, list[int]]:
        """Return the time without rain before a run (s), and the first ticks of its days."""
        if start not in self.earlier:
            run = replace(self.run, start=start)
            days = find_new_days(run.site, run.time_ns(0) / 1e9, run.steps)
            self.earlier[start] = run.without_rain_s, days
        return self.earlier[start]

    def __deepcopy__(self, _: object) -> Surroundings:
        """Return the surroundings themselves, because they never change."""
        return self


class CommandedSites:
    """Sites in common surroundings, which begin at different times and with different water.

    Attributes:
        tick: number of the current tick, which is set by the caller after :meth:`follow`.
        commands: command to the pumps and to the valve of each site, shape (n, 2).
        levels: readings of the sensors in the cistern and on the roof (m), shape (n, 2).
        without_rain: time without rain until now (s), shape (n,).
        rewards: rewards of the last ticks, see :func:`follow`, shape (n,).
    """

    def __init__(
        self, surroundings: Surroundings, starts: Sequence[datetime], x1: Values, x2: Values
    ) -> None:
        """Begin with tick 0.

        Args:
            surroundings: surroundings of all sites.
            starts: times of tick 0, in the surroundings' hours.
            x1: initial volume in each cistern (m3).
            x2: initial volume on each roof (m3).
        """
        self._surroundings, run, self.tick = surroundings, surroundings.run, 0
        as_taken = surroundings.as_taken
        site, count = run.site, len(starts)
        earlier = [surroundings.find_before(start) for start in starts]
        later = np.array([
            1000 * round((start - run.start) / timedelta(microseconds=1)) for start in starts
        ])
        hours = run.series.evapotranspiration.offset_ns + later
        new_days = np.full((count, 1 + max(len(days) for _, days in earlier)), -1)
        for row, (_, days) in enumerate(earlier):
            new_days[row, : len(days)] = days
        self._begins = as_taken(np.column_stack((hours, surroundings.rain_offset_ns + later)))
        self._new_days, self._events = as_taken(new_days), np.zeros((0, len(Event._fields)))
        layers, roof = np.full(count, site.initial_layer), x2 / site.a2
        if len(surroundings.fixed[-1]):
            roof = np.maximum(0.0, roof + surroundings.fixed[-1][0])
        switch = make_switch(run.sensor_and_pump, site.tau)
        valve = make_valve(site.valve_moves_per_hour)
        self.commands, self._state, self.levels, self._switches, self._valves = map(as_taken, (
            np.zeros((count, 2)), np.column_stack((x1, x2, layers)),
            np.column_stack((x1 / site.a1, roof)), np.tile(switch, (count, 1)),
            np.tile(valve, (count, 1)),
        ))
        self.without_rain, self._days, self.rewards = map(as_taken, (
            np.array([before for before, _ in earlier]), np.zeros(count, np.int64),
            np.zeros(count),
        ))
        self._sums, self._ticks = map(as_taken, (
            np.zeros((count, count_places(plant_parameters(site)))),
            np.zeros((count, 17)),
        ))

    def follow(self, last: int, first_row: int, last_row: int) -> None:
        """Simulate some sites from the current tick to another (exclusive); see :func:`follow`."""
        function: Any = compiled(follow) if self._surroundings.compiles else follow
        function(
            *self._surroundings.fixed, self._begins, self._new_days, self.commands, self._state,
            self.levels, self._switches, self._valves, self.without_rain, self._days, self._sums,
            self._events, self._ticks, self.rewards, first_row, last_row, self.tick, last,
        )

    def find_weather(self, tick: int) -> Values:
        """Return the rain (m/s) and evapotranspiration (m3/s) of a tick, shape (2, n)."""
        times, rain, potential = map(np.asarray, self._surroundings.fixed[1:4])
        hours, steps = np.asarray(self._begins).T + tick * times[_TICK]
        return np.array([
            rain[np.minimum(steps // times[_STEP], times[_LAST_STEP])],
            potential[np.minimum(hours // _HOUR_NS, times[_LAST_HOUR])],
        ])

    def find_last_tick(self, row: int) -> Tick:
        """Return the last tick that was simulated."""
        values = [*map(float, self._ticks[row])]
        flows = Flows._make((*values[9:13], values[13] > 0, *values[14:16]))
        return Tick._make((self.tick - 1, *values[:9], flows, values[16]))

    def compute_metrics(self) -> list[dict[str, float]]:
        """Return the metrics of every site, as if the runs ended now."""
        sums, state = np.array(self._sums), np.asarray(self._state)
        function = compiled(finish_all) if self._surroundings.compiles else finish_all
        function(self._surroundings.fixed[0], sums, self._events, state)
        site = self._surroundings.run.site
        return [compute_metrics(site, row) for row in sums.tolist()]
