"""Runs under on/off control and the policies of the valve: compiled, for one site or for many.

The results equal those of :class:`.loop.Simulation` bit for bit, whatever the site: the same
functions of numbers decide, step the plant and add up the sums. Only the evapotranspiration of a
bed that differs from that of the first site with its weather is scaled, to within a rounding error
(1e-15 of it). Threads share the sites.

Sites with the same weather and the same clock are simulated together. What their ticks have in
common is read in blocks, so that a season of seconds needs no more memory than one of minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import pairwise, starmap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.onoff import onoff_command
from greenroof_ros.controllers.outlet import OPEN, PLAN, POLICIES, outlet_share
from greenroof_ros.controllers.outlet_plan import HORIZON_H, PlanClock, find_levels
from greenroof_ros.forecast.steps import make_forecast
from greenroof_ros.physics.compiled import compiled, note_if_slow, pays_to_compile, records
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.pump import make_switch, observe_pump, read_errors, switch_pump
from greenroof_ros.physics.storm_water import Event, find_wet, make_valve, move_valve
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.results import sums as s
from greenroof_ros.results.metrics import Results, end_run, find_new_days
from greenroof_ros.results.sums import add
from greenroof_ros.results.trajectory import COLUMNS
from greenroof_ros.simulation.run import Run, Values
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site
from greenroof_ros.weather.evapotranspiration import COMPUTED

# Ticks that are read together, and number of parts into which sites are divided, whatever the
# number of threads, so that sums over sites do not depend on it.
_BLOCK, _PARTS = 43_200, 8
# Plans that are made in one call: a user's interrupt waits for its end.
_PLANS = 20_000


def _find_bed(run: Run, site: Site) -> float:
    """Return the area (m2) that, with a crop coefficient of 1, evaporates as much as a site's bed.

    A crop coefficient applies only to computed evapotranspiration; values from a column of a file
    are used unchanged.
    """
    return site.a2 * (site.crop_coefficient if run.weather.method in COMPUTED else 1.0)


class Case(NamedTuple):
    """A site in a season."""

    site: Site
    parameters: Mapping[str, Any]
    """every parameter of the controller, ``onoff``, and of the outlet valve, if there is one"""
    run: Run
    """weather, sensor and pumps of the season, for sites with the same ticks as the run's own"""
    x1: float
    x2: float
    """initial volumes in the cistern and on the roof (m3)"""
    with_forecast: bool = True
    """whether a plan uses the forecasts of the run; otherwise it knows the evapotranspiration and
    the current rain, and expects no further rain"""
    group: int = 0
    """group of sites for which a hydrograph is made"""


KEPT = (*(column.attribute for column in COLUMNS if column.attribute),)
"""values that are kept of a tick, as in a :class:`.Trajectory`"""
ALL_KEPT = (*KEPT, "evaporated", "limited")
"""values that are kept of a tick where all flows are wanted"""
_KEPT = len(KEPT)


class Control(NamedTuple):
    """The numbers that determine how a site is controlled."""

    fraction: float
    """command while pumping (share of the maximum flow)"""
    level: float
    """level on the roof below which the pumps run (m)"""
    suction_level: float
    """level in the cistern below which the pumps are not commanded (m)"""
    policy: float
    """index of the valve's policy in :data:`.outlet.POLICIES`, of which that of ``open`` also holds
    without a valve; or the opening itself, a share from 0 to 1"""
    bed: float
    """area to which the weather's evapotranspiration applies (m2)"""
    other_demand: float
    """factor of what other uses need in the ticks"""


class Ticks(NamedTuple):
    """What consecutive ticks have in common for sites.

    Sequences have shape (runs, ticks), where a run is the weather and the clock of some sites.
    """

    first: int
    """number of the first tick"""
    rain: Any
    """rain rate (m/s)"""
    potential: Any
    """evapotranspiration of a bed of 1 m2 (m3/s)"""
    frost: Any
    """whether there is frost"""
    wet: Any
    """whether the weather is wet"""
    quiet: Any
    """whether each tick is in the quiet hours"""
    new_day: Any
    """whether each tick is the first of a day of the clock"""
    other: Any
    """water that other uses than the roof need (m3/s); 1 if this is the same all year"""
    errors: Any
    """error of the roof's sensor in every run (m), shape (ticks,), or (0,) without errors"""


class Forecasts(NamedTuple):
    """Forecasts for which plans are made before some ticks; see :func:`.find_levels`."""

    due: Any
    """numbers of these ticks, shape (plans,)"""
    ends: Any
    """boundaries of the forecasts' steps (s from the tick), starting at 0"""
    rain: Any
    """rain (m/s), shape (plans, members, steps)"""
    evaporated: Any
    """evapotranspiration of a bed of 1 m2 (m3/s), shape (plans, steps)"""


class Sites(NamedTuple):
    """Sites that are simulated together; sequences have an entry for each of n sites."""

    parameters: Any
    """:class:`.PlantParameters`"""
    controls: Any
    """:class:`Control`"""
    runs: Any
    """rows of the ticks"""
    groups: Any
    """rows of the hydrograph"""
    options: Any
    """options of the plans, see :func:`.find_levels`, shape (n, 4)"""
    levels: Any
    """volumes to which the valves drain the cisterns in dry weather (m3)"""
    state: Any
    """water in cistern, roof and layer (m3), shape (n, 3)"""
    switches: Any
    """switches of the pumps, see :func:`.make_switch`, shape (n, 5)"""
    valves: Any
    """valves, see :func:`.make_valve`, shape (n, 3)"""
    sums: Any
    """sums of the runs, shape (n, places)"""
    missed: Any
    """deviations of the roofs' readings from their targets, summed over the ticks that were
    simulated in the last call, but for its first (m3)"""
    events: Any
    """rain events, shape (n, events, columns)"""
    kept: Any
    """values of some ticks and of the last one, see :data:`KEPT` and :data:`ALL_KEPT`, shape (n,
    ticks, values)"""


def run_ticks(
    sites: Any, ticks: Any, begin: int, end: int, hydrograph: Any, every: int, steps: int
) -> None:
    """Simulate sites, one after the other, in some ticks.

    Args:
        sites: :class:`Sites`.
        ticks: :class:`Ticks`.
        begin: the first tick to simulate.
        end: the tick after the last.
        hydrograph: discharge and its part through low outlets in each interval (m3), to which
            those of the sites are added, shape (groups, 2, intervals).
        every: interval between the ticks that are kept (ticks).
        steps: N; the run ends in the state of this tick.
    """
    first, errors = ticks.first, ticks.errors
    for row in range(len(sites.state)):
        run, missed = sites.runs[row], 0.0
        rain, potential, frost = ticks.rain[run], ticks.potential[run], ticks.frost[run]
        wet, quiet, new_day = ticks.wet[run], ticks.quiet[run], ticks.new_day[run]
        other = ticks.other[run]
        p, c = sites.parameters[row], sites.controls[row]
        switch, sums, events = sites.switches[row], sites.sums[row], sites.events[row]
        state, kept, valve = sites.state[row], sites.kept[row], sites.valves[row]
        discharged, low = hydrograph[sites.groups[row]]
        to_sewer = 1 - p.drainage_to_cistern
        now, level = State(state[0], state[1], state[2]), float(sites.levels[row])
        for n in range(begin - first, end - first):
            k, falls, frozen, demand = first + n, rain[n], frost[n], potential[n] * c.bed
            cistern, roof = now.cistern / p.a1, now.roof / p.a2
            if len(errors) > 0:
                roof = max(0.0, roof + errors[n])
            if k > begin:
                missed += abs(roof * p.a2 - p.x2_star)
            may_run, command = p.b > 0 and not (frozen or quiet[n]), 0.0
            if may_run:
                command = onoff_command(c.fraction, c.level, c.suction_level, cistern, roof)
            switched = switch_pump(switch, command, may_run)
            outlet = outlet_share(p, c.policy, wet[n], level, cistern)
            if frozen and p.valve_closed_in_frost:
                outlet = 0.0
            opening = move_valve(valve, p.tau, outlet)
            needed = other[n] * c.other_demand
            after, flows = step(p, now, falls, demand, switched, opening, OWN_PUMPS, needed)
            observe_pump(switch, flows.pump)
            if len(kept) > 0 and (k % every == 0 or k == steps):
                values = kept[(k + every - 1) // every]
                values[:_KEPT] = (
                    now.cistern, now.roof, falls, demand, command, flows.pump, flows.outflow,
                    flows.drainage, 1.0 if frozen else 0.0, now.layer, outlet, flows.low_outlet,
                    flows.other, flows.other_demand, flows.mains, 1.0 if wet[n] else 0.0,
                )
                if len(values) > _KEPT:
                    values[_KEPT:] = flows.evapotranspiration, 1.0 if flows.limited else 0.0
            if k == steps:
                break
            if flows.outflow > 0 or flows.drainage > 0:
                interval = int(sums[s.INTERVALS])
                discharged[interval] += p.tau * (flows.outflow + to_sewer * flows.drainage)
                low[interval] += p.tau * flows.low_outlet
            add(p, sums, events, now, command, falls, demand, flows, wet[n], new_day[n])
            now = after
        state[0], state[1], state[2] = now.cistern, now.roof, now.layer
        sites.missed[row] = missed


def run_planned(
    sites: Any, ticks: Any, begin: int, end: int, hydrograph: Any, every: int, steps: int,
    forecasts: Any,
) -> None:
    """Simulate sites as :func:`run_ticks` does, and make their plans before the ticks due.

    The last argument is one of :class:`Forecasts`.
    """
    due, count = forecasts.due, len(sites.state)
    x1, x2 = np.empty(count), np.empty(count)
    for n in range(len(due) + 1):
        start = due[n - 1] if n > 0 else begin
        if n > 0:
            for row in range(count):
                p, state = sites.parameters[row], sites.state[row]
                roof = state[1] / p.a2
                if len(ticks.errors) > 0:
                    roof = max(0.0, roof + ticks.errors[start - ticks.first])
                x1[row], x2[row] = state[0] / p.a1 * p.a1, roof * p.a2
            sites.levels[:] = find_levels(
                sites.parameters, sites.options, forecasts.ends, x1, x2, forecasts.rain[n - 1],
                forecasts.evaporated[n - 1],
            )
        run_ticks(
            sites, ticks, start, due[n] if n < len(due) else end, hydrograph, every, steps
        )


def simulate_season(
    cases: Sequence[Case], *, every: int = 0,
    progress: Callable[[float], None] = lambda share: None, threads: int = 1,
) -> tuple[list[tuple[Results, Values]], Values]:
    """Simulate sites under on/off control.

    Args:
        cases: the sites, which have the same tau and number of steps.
        every: interval between the ticks that are kept (ticks); 0 to keep none.
        progress: callback that regularly receives the completed share of the work (1); an error
            that it raises ends the simulation.
        threads: number of threads that share the sites.

    Returns:
        The results of each site, whose events are empty if more than one site is simulated, and
        the values :data:`KEPT` of its kept ticks, shape (ticks, values); and the discharge of each
        group and its part through low outlets in each interval of
        :func:`.storm_water.interval_seconds` (m3), shape (groups, 2, intervals).

    Raises:
        ConfigurationError: if the sites differ in tau or in their number of steps.
    """
    steps, count, done = cases[0].run.steps, len(cases), 0
    if any((each.site.tau, each.run.steps) != (cases[0].site.tau, steps) for each in cases):
        raise ConfigurationError("all sites in a batch must have the same tau and number of steps")
    note_if_slow(steps * count)
    compiles = pays_to_compile(steps * count)
    together: dict[Any, list[int]] = {}
    # Those of a group are adjacent, so that few parts have the group's hydrograph.
    for row in sorted(range(count), key=lambda row: cases[row].group):
        case, site = cases[row], cases[row].site
        plans = case.parameters.get("outlet") == PLAN
        key = (
            plans, case.with_forecast, id(case.run), site.wet_after, site.zone, site.quiet_hours,
            site.monthly_other_demand if case.run.series.demand_varies(site) else None,
        )
        together.setdefault(key, []).append(row)
    intervals = -(-steps // int(plant_parameters(cases[0].site).interval_ticks))
    hydrograph = np.zeros((1 + max(case.group for case in cases), 2, intervals))
    results: dict[int, tuple[Results, Values]] = {}
    with ThreadPoolExecutor(threads) as pool:
        # A thread of its own would take longer to wake than a site needs from plan to plan.
        spread: Any = pool.map if threads > 1 else map
        for rows in together.values():
            season = Season([cases[row] for row in rows], every, count, compiles)
            running: Iterable[None] = ()
            for ticks, begin, end, *forecasts in season.ticks():
                list(running)  # ticks are read while those before them are simulated
                progress(done / (steps + 1) / count)
                running = spread(partial(season.run, ticks, begin, end, forecasts), season.parts)
                done += (end - begin) * len(rows)
            list(running)
            for _, groups, of_part in season.parts:
                hydrograph[groups] += of_part
            results |= zip(rows, season.results(), strict=True)
    progress(1.0)
    return [results[row] for row in range(count)], hydrograph


class Season:
    """Sites with the same weather, clock and times of plans, as :func:`run_ticks` takes them.

    Attributes:
        sites: the sites.
        errors: error of the roof's sensor in every tick (m), see :class:`Ticks`.
        parts: adjacent sites, which a thread simulates one after the other; each with its groups
            and their hydrographs.
    """

    def __init__(self, cases: Sequence[Case], every: int, total: int, compiles: bool) -> None:
        """Begin with tick 0.

        Args:
            cases: the sites.
            every: interval between the ticks that are kept (ticks); 0 to keep none.
            total: number of all sites; the events of a single site are recorded.
            compiles: whether to compile the ticks.
        """
        self._cases, self._run, self._site = cases, cases[0].run, cases[0].site
        run, site, count = self._run, self._site, len(cases)
        self._every = max(1, every)
        # Not in the threads, each of which would compile them.
        plans = cases[0].parameters.get("outlet") == PLAN
        functions: Any = find_wet, run_planned if plans else run_ticks
        self._find_wet, self._run_ticks = map(compiled, functions) if compiles else functions
        # Plain Python is faster with lists.
        self._as_taken: Callable[[Any], Any] = lambda array: array if compiles else array.tolist()
        self.errors = read_errors(run.sensor_and_pump, run.steps + 1)
        self._forecast: Any = None
        if plans:
            weather = run.weather
            if not cases[0].with_forecast:  # unknown hours can only be after the run
                known = {name: np.nan_to_num(series) for name, series in weather.values.items()}
                weather = replace(weather, values=known)
            self._forecast = make_forecast(
                weather, run.series, run.site, run.start, 0.0, run.forecast_choice,
                all_members=True, outlet_horizon=HORIZON_H,
            )
        # At the bed of the run, evapotranspiration stays the same to the last bit.
        self._bed, *beds = (_find_bed(run, each) for each in (run.site, *(c.site for c in cases)))
        if {*beds} == {self._bed}:
            self._bed, beds = 1.0, [1.0] * count
        names = "outlet_reserve", "outlet_price", "outlet_reach"
        options = np.array([
            [*(case.parameters.get(name, 0.0) for name in names), bed]
            for case, bed in zip(cases, beds, strict=True)
        ])
        plants = [plant_parameters(case.site) for case in cases]
        self._wet_after = plants[0].wet_after_s
        self._demand_varies = run.series.demand_varies(site)
        self._ends = look_ahead_ends(run.site, 0.0, HORIZON_H)
        controls = [Control(
            case.parameters["fraction"], case.parameters["level"] * case.site.z_veg,
            plant.suction_level, POLICIES.index(case.parameters.get("outlet", OPEN)), bed,
            1.0 if self._demand_varies else (case.site.other_flows or (0.0,))[0],
        ) for case, plant, bed in zip(cases, plants, beds, strict=True)]
        groups = np.array([case.group for case in cases])
        events = s.count_events(plants[0], run.steps) if total == 1 else 0
        kept = -(-run.steps // every) + 1 if every else 0
        intervals = -(-run.steps // int(plants[0].interval_ticks))
        self.sites = Sites._make((
            *(records(each) if compiles else each for each in (plants, controls)),
            np.zeros(count, np.intp), np.zeros(count, np.intp), options, options[:, 0].copy(),
            *map(self._as_taken, (
                np.array([(case.x1, case.x2, case.site.initial_layer) for case in cases]),
                np.tile(make_switch(run.sensor_and_pump, site.tau), (count, 1)),
                np.array([make_valve(case.site.valve_moves_per_hour) for case in cases]),
                np.zeros((count, s.count_places(plants[0]))),
            )), np.zeros(count),
            np.zeros((count, events, len(Event._fields))), np.zeros((count, kept, len(KEPT))),
        ))
        self.parts: list[tuple[slice, NDArray[np.intp], Any]] = []
        bounds = np.unique(np.linspace(0, count, _PARTS + 1).astype(int)).tolist()
        for rows in starmap(slice, pairwise(bounds)):
            own, self.sites.groups[rows] = np.unique(groups[rows], return_inverse=True)
            self.parts.append((rows, own, self._as_taken(np.zeros((len(own), 2, intervals)))))

    def ticks(self) -> Iterator[tuple[Any, ...]]:
        """Yield ticks, the first and the end of those to simulate, and any forecasts for plans."""
        run, site, clock = self._run, self._site, PlanClock(self._site.tau)
        new_days = find_new_days(site, run.time_ns(0) / 1e9, run.steps)
        without_rain = run.without_rain_s
        plans = max(1, _PLANS // len(self._cases))
        for first in range(0, run.steps + 1, _BLOCK):
            last = min(first + _BLOCK, run.steps + 1)
            rain, evaporated, frost, quiet, other = run.read_ticks(first, last, site)
            wet, without_rain = self._find_wet(
                self._as_taken(rain), site.tau, self._wet_after, without_rain
            )
            new_day = np.isin(np.arange(first, last), new_days)
            if not self._demand_varies:
                other = np.ones(last - first)
            values = rain, evaporated / self._bed, frost, np.asarray(wet), quiet, new_day, other
            block = Ticks._make((first, *map(self._as_taken, (
                *(each[np.newaxis] for each in values), self.errors[first:last],
            ))))
            if self._forecast is None:
                yield block, first, last
                continue
            due = [tick for tick, is_wet in enumerate(wet, first) if clock.is_due(is_wet)]
            for n, (begin, end) in enumerate(pairwise([first, *due[plans::plans], last])):
                yield block, begin, end, self._foresee(due[n * plans : (n + 1) * plans])

    def _foresee(self, due: Sequence[int]) -> Forecasts:
        """Return the forecasts for the plans that are made before some ticks."""
        outlooks = [self._forecast.at(tick) for tick in due]
        rates = np.array([np.atleast_2d(each.rain) for each in outlooks] or np.empty((0, 1, 1)))
        if not self._cases[0].with_forecast:
            rates = rates[:, :1].copy()
            rates[:, :, 1:] = 0.0
        needs = [each.evapotranspiration for each in outlooks]
        demand = np.array(needs or np.empty((0, 1))) / self._bed
        return Forecasts(np.array(due, np.intp), self._ends, rates, demand)

    def run(
        self, ticks: Ticks, begin: int, end: int, forecasts: Sequence[Forecasts],
        part: tuple[slice, Any, Any],
    ) -> None:
        """Simulate a part of the sites in some ticks, with their plans if there are forecasts."""
        rows, _, hydrograph = part
        self._run_ticks(
            Sites(*(each[rows] for each in self.sites)), ticks, begin, end, hydrograph,
            self._every, self._run.steps, *forecasts,
        )

    def results(self) -> Iterator[tuple[Results, Values]]:
        """Yield the results of each site after the last tick, and its kept ticks."""
        sites = self.sites
        for case, *taken, events, kept in zip(
            self._cases, sites.state, sites.sums, sites.events, sites.kept, strict=True
        ):
            state, sums = ([*map(float, each)] for each in taken)
            yield end_run(case.site, sums, events, State(*state)), kept
