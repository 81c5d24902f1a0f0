"""Runs under on/off control and the policies of the valve: compiled, for one site or for many.

The results equal those of :class:`.loop.Simulation` bit for bit, whatever the site: the same
functions of numbers decide, step the plant and add up the sums. Threads share the sites of a batch.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.controllers.onoff import onoff_command
from greenroof_ros.controllers.outlet import OPEN, PLAN, POLICIES, outlet_share
from greenroof_ros.controllers.outlet_plan import HORIZON_H, PlanClock, find_levels, plan_levels
from greenroof_ros.forecast.resampling import Forecast, make_forecast
from greenroof_ros.physics.compiled import compiled, note_if_slow, pays_to_compile, records
from greenroof_ros.physics.parameters import PlantParameters, State, plant_parameters
from greenroof_ros.physics.sensor_and_pump import (
    SensorAndPump,
    min_ticks,
    observe_pump,
    read_errors,
    switch_pump,
)
from greenroof_ros.physics.storm_water import HOUR_S, Event, is_wet, time_without_rain
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.results import sums as s
from greenroof_ros.results.metrics import compute_metrics, find_new_days, list_events
from greenroof_ros.results.sums import add
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site
from greenroof_ros.weather.evapotranspiration import COMPUTED

Values = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

# Ticks between two reports of progress, and number of parts into which sites are divided, whatever
# the number of threads, so that sums over sites do not depend on it.
_BLOCK, _PARTS = 43_200, 8


class Control(NamedTuple):
    """The numbers that determine how a site is controlled."""

    fraction: float
    """command while pumping (share of the maximum flow)"""
    level: float
    """level below which the pumps run (m)"""
    min_on: float
    min_off: float
    """minimum times of the pumps (ticks)"""
    policy: float
    """index of the valve's policy in :data:`.outlet.POLICIES`; that of ``open`` without a valve"""
    closed_in_frost: bool
    """whether the valve stays closed during frost"""
    wet_after: float
    """time after rain that counts as wet weather (s)"""
    bed: float
    """area to which the weather's evapotranspiration applies (m2)"""
    weather: float
    """row of the site's weather"""
    clock: float
    """row of the site's clock"""


KEPT = (
    "cistern", "roof", "command", "outflow", "pump_flow", "drainage", "outlet", "low_outlet",
    "layer",
)
"""values that are kept of a tick, in this order, under their names in :class:`.Trajectory`"""


def run_ticks(
    parameters: Any, numbers: Any, controls: Any, groups: Any, levels: Any, state: Any,
    switches: Any, sums: Any, weeks: Any, events: Any, kept: Any, rain: Any, potential: Any,
    frost: Any, without_rain: Any, quiet: Any, new_day: Any, errors: Any, hydrograph: Any,
    every: int, first: int, last: int, steps: int,
) -> None:
    """Simulate sites, one after the other, from a tick to another (exclusive).

    Args:
        parameters: :class:`.PlantParameters` of n sites.
        numbers: :class:`.SumParameters` of n sites.
        controls: :class:`Control` of n sites.
        groups: row of each site's hydrograph, shape (n,).
        levels: volumes to which the valves drain the cisterns in dry weather (m3), shape (n,).
        state: water in cistern, roof and layer (m3), shape (n, 3).
        switches: switches of the pumps, see :mod:`.sensor_and_pump`, shape (n, 3).
        sums: sums of the runs, shape (n, places).
        weeks: deviation in each week (m3), shape (n, weeks).
        events: rain events, shape (n, events, columns).
        kept: values of some ticks and of the last one, see :data:`KEPT`, shape (n, ticks, values),
            or (n, 0, 0).
        rain: rain rate of each weather (m/s), shape (m, steps + 1).
        potential: evapotranspiration of each weather (m3/s for a bed of 1 m2), of the same shape.
        frost: whether there is frost, of the same shape.
        without_rain: time without rain until the end of each tick (s), of the same shape.
        quiet: whether each tick is in the quiet hours of each clock, shape (c, steps + 1).
        new_day: whether each tick is the first of a day of each clock, shape (c, steps + 1).
        errors: error of the roof's sensor (m), shape (steps + 1,), or (0,) without errors.
        hydrograph: discharge and its part through low outlets in each interval (m3), to which
            those of the sites are added, shape (groups, 2, intervals).
        every: interval between the ticks that are kept (ticks).
        first: first tick.
        last: end of the ticks, at most steps + 1; the run ends in the state of tick ``steps``.
        steps: N.
    """
    for row in range(len(parameters)):
        p, q, c = parameters[row], numbers[row], controls[row]
        weather, clock, of_group = int(c.weather), int(c.clock), hydrograph[groups[row]]
        falls, evaporates, frozen = rain[weather], potential[weather], frost[weather]
        dry, hushed, days = without_rain[weather], quiet[clock], new_day[clock]
        switch, own, own_weeks, own_events = switches[row], sums[row], weeks[row], events[row]
        now, level = State(state[row][0], state[row][1], state[row][2]), levels[row]
        for k in range(first, last):
            wet, cistern = is_wet(dry[k], p.tau, c.wet_after), now.cistern / p.a1
            roof = now.roof / p.a2
            if len(errors) > 0:
                roof = max(0.0, roof + errors[k])
            may_run, command = p.b > 0 and not (frozen[k] or hushed[k]), 0.0
            if may_run:
                command = onoff_command(c.fraction, c.level, p.suction_level, cistern, roof)
            switched = switch_pump(switch, c.min_on, c.min_off, command, may_run)
            outlet = outlet_share(p, c.policy, wet, level, cistern)
            if frozen[k] and c.closed_in_frost:
                outlet = 0.0
            demand = evaporates[k] * c.bed
            after, flows = step(p, now, falls[k], demand, switched, outlet, OWN_PUMPS)
            observe_pump(switch, flows.pump)
            if len(kept[row]) > 0 and (k % every == 0 or k == steps):
                place = kept[row][(k + every - 1) // every]
                place[0], place[1], place[2] = now.cistern, now.roof, command
                place[3], place[4], place[5] = flows.outflow, flows.pump, flows.drainage
                place[6], place[7], place[8] = outlet, flows.low_outlet, now.layer
            if k == steps:
                break
            add(
                q, own, own_weeks, own_events, now, command, falls[k], demand, flows, wet, days[k]
            )
            interval = int(k // q.interval_ticks)
            of_group[0][interval] += p.tau * (flows.outflow + q.to_sewer * flows.drainage)
            of_group[1][interval] += p.tau * flows.low_outlet
            now = after
        state[row][0], state[row][1], state[row][2] = now.cistern, now.roof, now.layer


def count_rain(rain: Any, tau: float, before: float, result: Any) -> None:
    """Write the time without rain until the end of each tick (s) into an array.

    Args:
        rain: rain rate in each tick (m/s), shape (n,).
        tau: duration of a tick (s).
        before: time without rain at the start (s).
        result: array of shape (n,).
    """
    for k in range(len(rain)):
        before = time_without_rain(before, rain[k], tau)
        result[k] = before


@dataclass(frozen=True, eq=False)
class SeasonWeather:
    """Weather, tick by tick, for sites with the same weather; arrays have shape (steps + 1,).

    Attributes:
        run: run with this weather; the plans use its forecasts.
        bed: area of the bed of the run, as for :meth:`of_run` (m2).
        rain: rain rate (m/s).
        evapotranspiration: evapotranspiration of 1 m2 of such a bed (m3/s).
        frost: whether there is frost.
        without_rain: time without rain until the end of each tick (s).
    """

    run: Run
    bed: float
    rain: Values
    evapotranspiration: Values
    frost: Flags
    without_rain: Values

    @classmethod
    def of_run(cls, run: Run, bed: float) -> SeasonWeather:
        """Return the weather of a run.

        Args:
            run: the run.
            bed: area of a bed that evaporates as much as the run's (m2), from :func:`find_bed`; 1
                to keep the evapotranspiration of the run's bed.
        """
        series, ticks = run.series, slice(0, run.steps + 1)
        rain, evaporated, frost = (
            np.array(values[ticks])
            for values in (series.precipitation, series.evapotranspiration, series.frost)
        )
        without_rain = np.empty_like(rain)
        count = compiled(count_rain) if pays_to_compile(run.steps) else count_rain
        count(rain, run.site.tau, run.without_rain_s, without_rain)
        return cls(run, bed, rain, evaporated / bed, frost != 0, without_rain)

    @cached_property
    def forecast(self) -> Forecast:
        """The weather forecasts that the plans use."""
        run = self.run
        return make_forecast(
            run.weather, run.series, run.site, run.start, 0.0, run.forecast_choice,
            all_members=True, outlet_horizon=HORIZON_H,
        )

    def foresee(self, tick: int, with_rain: bool) -> tuple[Values, Values]:
        """Return the forecast of a tick.

        Args:
            tick: number of the tick.
            with_rain: whether the forecast contains future rain; otherwise only the current rain is
                known.

        Returns:
            Rain (m/s), shape (members, steps), and evapotranspiration of 1 m2 (m3/s), shape
            (steps,).
        """
        rain = np.atleast_2d(np.asarray(self.forecast.precipitation(tick)))
        if not with_rain:
            rain = rain[:1].copy()
            rain[:, 1:] = 0.0
        return rain, np.asarray(self.forecast.evapotranspiration(tick)) / self.bed


def find_bed(method: str, site: Site) -> float:
    """Return the area (m2) that, with a crop coefficient of 1, evaporates as much as a site's bed.

    A crop coefficient applies only to computed evapotranspiration; values from a column of a file
    are used unchanged.
    """
    return site.a2 * site.crop_coefficient if method in COMPUTED else site.a2


@dataclass(frozen=True, eq=False)
class Batch:
    """Sites that are simulated under on/off control.

    Attributes:
        sites: n sites with the same tau.
        weather: weather of the sites; all entries have the same number of steps, but their start
            times may differ.
        weather_of: index of each site's weather, shape (n,).
        parameters: every parameter of each site's controller, ``onoff``, and of its outlet valve,
            if it has one.
        x1: initial volume in each cistern (m3), shape (n,).
        x2: initial volume on each roof (m3), shape (n,).
        beds: areas to which the evapotranspiration of the weather applies (m2), shape (n,).
        with_forecast: whether plans use the forecasts of the weather's run; otherwise the plans
            know the evapotranspiration and the current rain, and expect no further rain.
        groups: group of each site, for which a hydrograph is made; None for one of all sites.
        sensor_and_pump: errors of the roofs' sensors and of the pumps.
    """

    sites: Sequence[Site]
    weather: Sequence[SeasonWeather]
    weather_of: Rows
    parameters: Sequence[Mapping[str, Any]]
    x1: Values
    x2: Values
    beds: Values
    with_forecast: bool = True
    groups: Rows | None = None
    sensor_and_pump: SensorAndPump = field(default_factory=SensorAndPump)


@dataclass(frozen=True, eq=False)
class SeasonResult:
    """The results of a batch.

    Attributes:
        metrics: metrics of each site by their names in :data:`.metrics.METRICS`.
        weeks: deviation of each site in each week (m3).
        events: rain events of each site; empty for more than one site.
        hydrograph: discharge of each group and its part through low outlets in each interval of
            :func:`.storm_water.interval_seconds` (m3), shape (groups, 2, intervals).
        kept: values of the kept ticks, see :data:`KEPT`, shape (sites, ticks, values).
    """

    metrics: list[dict[str, float]]
    weeks: list[list[float]]
    events: list[list[Event]]
    hydrograph: Values
    kept: Values


def simulate_season(
    batch: Batch, every: int = 0, progress: Callable[[float], None] | None = None,
    threads: int = 1,
) -> SeasonResult:
    """Simulate a batch.

    Args:
        batch: the batch.
        every: interval between the ticks that are kept (ticks); 0 to keep none.
        progress: callback that regularly receives the completed share of the work (1); an error
            that it raises ends the simulation.
        threads: number of threads that share the sites.

    Raises:
        ConfigurationError: if the sites differ in tau or in their number of steps.
    """
    steps, count, done = batch.weather[0].run.steps, len(batch.sites), 0
    if len({site.tau for site in batch.sites}) > 1 or any(
        each.run.steps != steps for each in batch.weather
    ):
        raise ConfigurationError("all sites in a batch must have the same tau and number of steps")
    note_if_slow(steps * count)
    planned = np.array([batch.parameters[row].get("outlet") == PLAN for row in range(count)])
    groups = np.zeros(count, np.intp) if batch.groups is None else batch.groups
    # Sites that stop for plans come last. Those of a group are adjacent, so that few parts have the
    # group's hydrograph.
    order = np.lexsort((groups, planned))
    rows = order.tolist()
    season = _Season(replace(
        batch, sites=[batch.sites[row] for row in rows], weather_of=batch.weather_of[order],
        parameters=[batch.parameters[row] for row in rows], x1=batch.x1[order],
        x2=batch.x2[order], beds=batch.beds[order],
    ), groups[order], every)
    hydrograph = np.zeros((groups.max() + 1, 2, season.intervals))
    first_planned = count - int(planned.sum())
    with ThreadPoolExecutor(threads) as pool:
        for begin, end, due in (
            (0, first_planned, set[int]()), (first_planned, count, season.due)
        ):
            parts, first = season.divide(begin, end), 0
            for last in sorted({*due, *range(_BLOCK, steps, _BLOCK), steps + 1}):
                if first in due:
                    season.plan(first)
                # A thread of its own would take longer to wake than a site needs from plan to plan.
                run = partial(season.run, first=first, last=last)
                list(pool.map(run, parts) if threads > 1 else map(run, parts))
                done, first = done + (last - first) * (end - begin), last
                if progress is not None:
                    progress(min(1.0, done / (steps + 1) / count))
            for part in parts:
                hydrograph[part.groups] += part.hydrograph
    places = np.argsort(order)
    metrics, weeks, events = zip(*map(season.finish, places.tolist()), strict=True)
    return SeasonResult([*metrics], [*weeks], [*events], hydrograph, season.kept[places])


class _Part(NamedTuple):
    """Adjacent sites, which a thread simulates one after the other."""

    rows: slice
    groups: Rows
    """groups of the sites, shape (groups,)"""
    hydrograph: Values
    """as :attr:`SeasonResult.hydrograph`, for these groups"""


class _Plan(NamedTuple):
    """Sites whose plans are made in the same ticks."""

    rows: list[int]
    weather: SeasonWeather
    due: set[int]
    """ticks in which plans are made"""
    areas: Values
    """areas of the cisterns and of the roofs (m2), shape (2, sites)"""
    find: Callable[..., Values]
    """:func:`.plan_levels` for these sites"""


class _Season:
    """A batch in the form in which :func:`run_ticks` takes it.

    Attributes:
        intervals: number of intervals of a hydrograph.
        due: ticks in which plans are made.
        kept: as :attr:`SeasonResult.kept`.
    """

    def __init__(self, batch: Batch, groups: Rows, every: int) -> None:
        self._batch, self._groups, self._every = batch, groups, max(1, every)
        sites, self._steps = batch.sites, batch.weather[0].run.steps
        steps = self._steps
        self._compiles = pays_to_compile(steps * len(sites))
        self._numbers = numbers = [s.sum_parameters(site) for site in sites]
        clocks: dict[Any, tuple[int, Site, Run]] = {}
        controls, together = list[Control](), dict[tuple[int, float], list[int]]()
        for row, site in enumerate(sites):
            weather = int(batch.weather_of[row])
            run = batch.weather[weather].run
            clock, *_ = clocks.setdefault(
                (site.zone, site.quiet_hours, run.start), (len(clocks), site, run)
            )
            controls.append(_control(batch, row, clock))
            if batch.parameters[row].get("outlet") == PLAN:
                together.setdefault((weather, site.wet_after), []).append(row)
        plants = [plant_parameters(site) for site in sites]
        self._plans = [
            _make_plan(batch, plants, rows, self._compiles) for rows in together.values()
        ]
        self.due = {tick for plan in self._plans for tick in plan.due}
        count, self.intervals = len(sites), -(-steps // int(numbers[0].interval_ticks))
        events = max(s.count_events(q, steps) for q in numbers) if count == 1 else 0
        self._events = np.zeros((count, events, s.EVENT_COLUMNS))
        self.kept = np.zeros((count, -(-steps // every) + 1 if every else 0, len(KEPT)))
        self._group_of = np.zeros(count, np.intp)
        self._levels = np.array([each.get("outlet_reserve", 0.0) for each in batch.parameters])
        layers = [site.initial_layer for site in sites]
        self._state, switches, self._sums, self._weeks = map(self._as_taken, (
            np.column_stack((batch.x1, batch.x2, layers)),
            np.array([[0.0, control.min_off, 0.0] for control in controls]),
            np.zeros((count, max(map(s.count_places, numbers)))),
            np.zeros((count, max(s.count_weeks(q, steps) for q in numbers))),
        ))
        self._of_rows = (
            *(records(each) if self._compiles else each for each in (plants, numbers, controls)),
            self._group_of, self._levels,
            self._state, switches, self._sums, self._weeks, self._events, self.kept,
        )
        self._errors = read_errors(batch.sensor_and_pump, steps + 1)
        flags = [_read_clock(site, run) for _, site, run in clocks.values()]
        self._shared = [*map(self._as_taken, (
            *(np.array([getattr(each, name) for each in batch.weather]) for name in (
                "rain", "evapotranspiration", "frost", "without_rain",
            )), *map(np.array, zip(*flags, strict=True)), self._errors,
        ))]

    def _as_taken(self, array: NDArray[Any]) -> Any:
        """Return an array as :func:`run_ticks` takes it; plain Python is faster with lists."""
        return array if self._compiles else array.tolist()

    def divide(self, begin: int, end: int) -> list[_Part]:
        """Return the sites from a row to another (exclusive) in parts."""
        parts, bounds = [], np.unique(np.linspace(begin, end, _PARTS + 1).astype(int)).tolist()
        for rows in itertools.starmap(slice, itertools.pairwise(bounds)):
            groups, self._group_of[rows] = np.unique(self._groups[rows], return_inverse=True)
            parts.append(_Part(rows, groups, np.zeros((len(groups), 2, self.intervals))))
        return parts

    def run(self, part: _Part, first: int, last: int) -> None:
        """Simulate a part from a tick to another (exclusive)."""
        function: Any = compiled(run_ticks) if self._compiles else run_ticks
        function(
            *(each[part.rows] for each in self._of_rows), *self._shared, part.hydrograph,
            self._every, first, last, self._steps,
        )

    def plan(self, tick: int) -> None:
        """Make the plans that are due in a tick."""
        for rows, weather, due, (a1, a2), find in self._plans:
            if tick in due:
                x1, x2, _ = np.asarray(self._state)[rows].T
                roof = x2 / a2
                if len(self._errors):
                    roof = np.maximum(0.0, roof + self._errors[tick])
                forecast = weather.foresee(tick, self._batch.with_forecast)
                self._levels[rows] = find(x1 / a1 * a1, roof * a2, *forecast)

    def finish(self, row: int) -> tuple[dict[str, float], list[float], list[Event]]:
        """Return the metrics, the weeks and the events of a site."""
        site, q, events = self._batch.sites[row], self._numbers[row], self._events[row]
        state = State(*map(float, self._state[row]))
        s.finish(q, self._sums[row], self._weeks[row], events, state)
        sums, weeks = [*map(float, self._sums[row])], [*map(float, self._weeks[row])]
        return (
            compute_metrics(site, sums), weeks[: s.count_weeks(q, self._steps)],
            list_events(site, sums, events) if len(events) else [],
        )


def _control(batch: Batch, row: int, clock: int) -> Control:
    site, parameters, errors = batch.sites[row], batch.parameters[row], batch.sensor_and_pump
    return Control(
        parameters["fraction"], parameters["level"] * site.z_veg,
        min_ticks(errors.pump_min_on, site.tau), min_ticks(errors.pump_min_off, site.tau),
        POLICIES.index(parameters.get("outlet", OPEN)), site.valve_closed_in_frost,
        site.wet_after * HOUR_S, float(batch.beds[row]), int(batch.weather_of[row]), clock,
    )


def _make_plan(
    batch: Batch, plants: Sequence[PlantParameters], rows: list[int], compiles: bool
) -> _Plan:
    site, weather = batch.sites[rows[0]], batch.weather[batch.weather_of[rows[0]]]
    clock, own = PlanClock(site.tau), [plants[row] for row in rows]
    due = {
        tick for tick, without_rain in enumerate(weather.without_rain.tolist())
        if clock.is_due(is_wet(without_rain, site.tau, site.wet_after * HOUR_S))
    }
    names = "outlet_reserve", "outlet_price", "outlet_reach"
    options = np.array([
        [*(batch.parameters[row][name] for name in names), batch.beds[row]] for row in rows
    ])
    return _Plan(rows, weather, due, np.array([(p.a1, p.a2) for p in own]).T, partial(
        plan_levels, compiled(find_levels) if compiles else find_levels,
        records(own) if compiles else own, options, site.wet_after * HOUR_S,
        look_ahead_ends(weather.run.site, 0.0, HORIZON_H),
    ))


def _read_clock(site: Site, run: Run) -> tuple[Flags, Flags]:
    """Return whether each tick is in the quiet hours, and whether it is the first of a day."""
    quiet, new_day = np.zeros((2, run.steps + 1), bool)
    if site.quiet is not None:
        quiet = site.quiet.quiet_ticks(run.time_ns(0), round(site.tau * 1e9), run.steps + 1)
    new_day[find_new_days(site, run.time_ns(0) / 1e9, run.steps)] = True
    return quiet, new_day
