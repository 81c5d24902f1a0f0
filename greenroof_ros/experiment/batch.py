"""Simulations of many sites together, under on/off control and outlet policies.

Ticks, metrics and forecasts are the same as in :class:`.closed_loop.Simulation` for a single site,
but are computed on arrays. :mod:`greenroof_ros.model.plants` states how closely the results agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property, partial
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import epoch_ns
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.outlet import PARAMETERS
from greenroof_ros.controllers.outlet_plan import HORIZON_H
from greenroof_ros.controllers.outlets import OutletGroup, Outlets, find_dry_ticks
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.batch_metrics import BatchMetrics, Clock
from greenroof_ros.forecast.resampling import Forecast, make_forecast
from greenroof_ros.model.plants import Plants
from greenroof_ros.model.sites import Sites
from greenroof_ros.physics.storm_water import Intervals, find_wet_weather, interval_seconds
from greenroof_ros.simulation.inputs import RunInputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site
from greenroof_ros.weather.evapotranspiration import COMPUTED

Values = NDArray[np.float64]
Rows = NDArray[np.intp]

_Observer = TypeVar("_Observer", bound="Observer")

# Number of sites that are stepped together, whose arrays fit in the processor's cache.
_TOGETHER = 8000
# Number of ticks between two reports of progress.
_BLOCK = 1440


class Observer(Protocol):
    """Observer of sites that are stepped together."""

    def add(self, tick: int) -> None:
        """Add the water that moved in a tick, and the state at its end."""


@dataclass(frozen=True, eq=False)
class BatchWeather:
    """Weather, tick by tick, for sites with the same weather; arrays have shape (steps + 1,).

    Attributes:
        run: run with this weather; the plans use its forecasts.
        rain: rain rate (m/s).
        evapotranspiration: evapotranspiration of a bed with a crop coefficient of 1 (m/s).
        frost: 1 in frost, otherwise 0.
    """

    run: Run
    rain: Values
    evapotranspiration: Values
    frost: Values

    @classmethod
    def of_run(cls, run: Run) -> BatchWeather:
        """Return the weather of a run that has been built."""
        series, ticks = run.series, slice(0, run.steps + 1)
        rain, evaporated, frost = (
            np.array(values[ticks])
            for values in (series.precipitation, series.evapotranspiration, series.frost)
        )
        return cls(run, rain, evaporated / find_bed(run.weather.method, run.site), frost)

    @classmethod
    def read(cls, inputs: RunInputs) -> BatchWeather:
        """Read the weather of a run.

        Raises:
            ConfigurationError: if an input of the run is invalid; see :meth:`.RunInputs.build`.
        """
        return cls.of_run(inputs.build())

    @property
    def steps(self) -> int:
        """N."""
        return self.run.steps

    @property
    def start(self) -> datetime:
        """Time of tick 0."""
        return self.run.start

    def beds(self, sites: Sites) -> Values:
        """Return the areas (m2) that, with crop coefficient 1, evaporate as much as the beds."""
        return np.asarray(find_bed(self.run.weather.method, sites))

    @cached_property
    def ends(self) -> Values:
        """Boundaries of the forecasts' steps (s from now), starting at 0."""
        return look_ahead_ends(self.run.site, 0.0, HORIZON_H)

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
            Rain (m/s), shape (members, steps), and evapotranspiration of a bed with a crop
            coefficient of 1 (m/s), shape (steps,).
        """
        rain = np.atleast_2d(np.asarray(self.forecast.precipitation(tick)))
        evaporated = np.asarray(self.forecast.evapotranspiration(tick))
        if not with_rain:
            rain = rain[:1].copy()
            rain[:, 1:] = 0.0
        return rain, evaporated / find_bed(self.run.weather.method, self.run.site)


def find_bed(method: str, site: Any) -> Any:
    """Return the area (m2) that, with a crop coefficient of 1, evaporates as much as a site's bed.

    A crop coefficient applies only to computed evapotranspiration; values from a column of a file
    are used unchanged.
    """
    return site.a2 * site.crop_coefficient if method in COMPUTED else site.a2


@dataclass(frozen=True, eq=False)
class Batch:
    """Sites that are simulated together, under on/off control.

    Attributes:
        sites: n sites with the same tau.
        weather: weather of the sites; all entries have the same number of steps, but their start
            times may differ.
        weather_of: index of each site's weather, shape (n,).
        parameters: parameters of each site's controller, ``onoff``, and of its outlet valve;
            omitted parameters take their default values.
        x1: initial volume in each cistern (m3), shape (n,).
        x2: initial volume on each roof (m3), shape (n,).
        with_forecast: whether plans use the forecasts of the weather's run; otherwise the plans
            know the evapotranspiration and the current rain, and expect no further rain.
    """

    sites: Sequence[Site]
    weather: Sequence[BatchWeather]
    weather_of: Rows
    parameters: Sequence[Mapping[str, Any]]
    x1: Values
    x2: Values
    with_forecast: bool = True


@dataclass(frozen=True, eq=False)
class BatchResult:
    """The results of a batch.

    Attributes:
        metrics: metrics by their names in :data:`greenroof_ros.results.metrics.METRICS`, each of
            shape (n,).
        hydrograph: discharge of each group's sites to the sewer in each interval of
            :func:`greenroof_ros.physics.storm_water.interval_seconds` (m3), shape (groups,
            intervals); None without groups.
        low_outlet: part of the hydrograph that leaves through low outlets (m3), as an array of the
            same shape.
    """

    metrics: dict[str, Values]
    hydrograph: Values | None
    low_outlet: Values | None


def simulate_batch(
    batch: Batch, groups: Rows | None = None, progress: Callable[[float], None] | None = None
) -> BatchResult:
    """Simulate a batch in this process.

    Args:
        batch: batch to simulate.
        groups: index of each site's group; None for no hydrograph.
        progress: callback that regularly receives the completed share of the work (1).

    Raises:
        ConfigurationError: if a parameter is invalid, or the sites differ in tau or in their number
            of steps.
    """
    count = len(batch.sites)
    shape = (
        0 if groups is None else int(groups.max()) + 1,
        -(-batch.weather[0].steps // _count_per_interval(batch.sites[0])),
    )
    hydrograph, low_outlet = (None if groups is None else np.zeros(shape) for _ in range(2))
    metrics: dict[str, Values] = {}

    def begin(part: Part) -> BatchMetrics:
        return part.make_metrics(groups, hydrograph, low_outlet)

    for part, sums in simulate_parts(batch, begin, progress):
        for name, values in part.results(sums).items():
            metrics.setdefault(name, np.empty(count))[part.rows] = values
    return BatchResult(metrics, hydrograph, low_outlet)


def simulate_parts(
    batch: Batch, begin: Callable[[Part], _Observer],
    progress: Callable[[float], None] | None = None,
) -> Iterator[tuple[Part, _Observer]]:
    """Simulate a batch in this process, and yield each part after it has been simulated.

    Args:
        batch: batch to simulate.
        begin: function that returns the observer of a part; the part is then in its initial state.
        progress: callback that regularly receives the completed share of the work (1).

    Raises:
        ConfigurationError: if a parameter is invalid, or the sites differ in tau or in their number
            of steps.
    """
    if len({site.tau for site in batch.sites}) > 1 or len({
        weather.steps for weather in batch.weather
    }) > 1:
        raise ConfigurationError("all sites in a batch must have the same tau and number of steps")
    every, done = Sites.of(batch.sites), 0
    for rows in _split(every, batch.weather_of):
        part = Part(batch, every, rows)
        observer = begin(part)
        for ticks in part.simulate(observer.add):
            done += ticks * len(rows)
            if progress is not None:
                progress(done / (batch.weather[0].steps * len(every)))
        yield part, observer


def _count_per_interval(site: Site) -> int:
    return round(interval_seconds(site) / site.tau)


def _split(sites: Sites, weather_of: Rows) -> Iterator[Rows]:
    """Yield rows that can be stepped together; rows with the same weather are adjacent."""
    kept = sites.drainage_to_cistern > 0  # needs more steps
    kind = 4 * kept + 2 * sites.has_field_capacity + sites.has_short_ticks
    for value in np.unique(kind):
        rows = np.flatnonzero(kind == value)
        rows = rows[np.argsort(weather_of[rows], kind="stable")]
        yield from np.array_split(rows, -(-len(rows) // _TOGETHER))


class Part:
    """Sites of a batch that are stepped together.

    Attributes:
        rows: indices of the sites in the batch.
        plants: cisterns and roofs of the sites.
    """

    def __init__(self, batch: Batch, every: Sites, rows: Rows) -> None:
        """Set the initial state.

        Args:
            batch: batch with all sites.
            every: parameters of all sites.
            rows: indices of the part's sites.
        """
        self.rows = rows
        self._batch, self._sites = batch, every.take(rows)
        self._weather_of = batch.weather_of[rows]
        self._steps = batch.weather[0].steps
        own = [batch.sites[row] for row in rows]
        self._per_interval = _count_per_interval(own[0])
        given = [batch.parameters[row] for row in rows]
        parameters = _complete(own, given)
        self.plants = Plants(
            self._sites, batch.x1[rows], batch.x2[rows], parameters["fraction"],
            parameters["level"],
        )
        self._beds = np.empty(len(rows))
        for number, of_weather in self._by_weather():
            self._beds[of_weather] = batch.weather[number].beds(self._sites)[of_weather]
        self._outlets = Outlets(
            self._sites, parameters["outlet"], parameters["outlet_reserve"],
            parameters["outlet_price"], parameters["outlet_reach"], self._beds,
            list(self._groups()),
        )
        self._clocks = self._find_clocks(own)
        self._has_quiet_hours = any(site.quiet for site in own)
        self._changes = self._find_changes()
        self._allowed: NDArray[np.bool_] | None = None

    def make_metrics(
        self, groups: Rows | None, hydrograph: Values | None, low_outlet: Values | None
    ) -> BatchMetrics:
        """Return the metrics of the initial state; see :class:`.batch_metrics.BatchMetrics`."""
        return BatchMetrics(
            self.plants, self._steps, self._per_interval, list(self._find_wet()), self._clocks,
            None if groups is None else groups[self.rows], hydrograph, low_outlet,
        )

    def _by_weather(self) -> Iterator[tuple[int, Rows]]:
        for number in np.unique(self._weather_of).tolist():
            yield number, np.flatnonzero(self._weather_of == number)

    def _by_wet_after(self) -> Iterator[tuple[BatchWeather, float, Rows]]:
        """Yield sites with the same weather and the same ``wet_after``."""
        for number, rows in self._by_weather():
            after = self._sites.wet_after[rows]
            for value in np.unique(after).tolist():
                yield self._batch.weather[number], value, rows[after == value]

    def _groups(self) -> Iterator[OutletGroup]:
        tau, with_rain = float(self._sites.tau[0]), self._batch.with_forecast
        for weather, wet_after, rows in self._by_wet_after():
            yield OutletGroup(
                rows, find_dry_ticks(weather.rain, tau, wet_after), weather.ends,
                partial(weather.foresee, with_rain=with_rain), with_rain,
            )

    def _find_wet(self) -> Iterator[tuple[Rows, NDArray[np.bool_]]]:
        """Yield groups of sites, and whether their weather is wet in each interval."""
        tau = float(self._sites.tau[0])
        for weather, wet_after, rows in self._by_wet_after():
            depths = tau * weather.rain[: self._steps]
            depths = np.add.reduceat(depths, range(0, self._steps, self._per_interval))
            seconds = tau * self._per_interval
            yield rows, find_wet_weather(wet_after, Intervals(seconds, depths, depths))

    def _find_clocks(self, sites: Sequence[Site]) -> list[Clock]:
        """Return the groups of sites with the same clock and quiet hours."""
        clocks: dict[Any, list[int]] = {}
        for row, (site, number) in enumerate(zip(sites, self._weather_of, strict=True)):
            key = site.time_zone, site.utc_offset, site.quiet_hours, number
            clocks.setdefault(key, []).append(row)
        return [
            Clock(
                np.array(rows), sites[rows[0]],
                epoch_ns(self._batch.weather[self._weather_of[rows[0]]].start) / 1e9,
            ) for rows in clocks.values()
        ]

    def simulate(self, observe: Callable[[int], None]) -> Iterator[int]:
        """Simulate, and regularly yield the number of ticks since the previous yield.

        Args:
            observe: callback that receives the number of every tick once the tick has been
                simulated.
        """
        plants, outlets = self.plants, self._outlets
        for tick in range(self._steps):
            if self._changes[tick]:
                self._set_weather(tick)
            allowed = self._allowed
            if self._has_quiet_hours:
                quiet = self._find_quiet(tick)
                allowed = ~quiet if allowed is None else allowed & ~quiet
            outlet = outlets.command(tick, plants.x1, plants.x2)
            if self._closed is not None:
                outlet = np.where(self._closed, 0.0, outlet)
            plants.tick(outlet, allowed)
            observe(tick)
            if tick % _BLOCK == _BLOCK - 1:
                yield _BLOCK
        yield self._steps % _BLOCK

    def _find_changes(self) -> NDArray[np.bool_]:
        """Return for every tick whether the weather differs from that of the previous tick."""
        changes = np.zeros(self._steps + 1, bool)
        changes[0] = True
        for number in np.unique(self._weather_of):
            weather = self._batch.weather[number]
            for values in (weather.rain, weather.evapotranspiration, weather.frost):
                changes[1:] |= np.diff(values) != 0
        return changes

    def _set_weather(self, tick: int) -> None:
        """Set the weather of a tick."""
        rain, reference, frost = np.array([
            (weather.rain[tick], weather.evapotranspiration[tick], weather.frost[tick])
            for weather in self._batch.weather
        ]).T[:, self._weather_of]
        self.plants.set_weather(rain, reference * self._beds)
        self._allowed = None if not frost.any() else frost == 0
        closed = (frost != 0) & self._sites.valve_closed_in_frost
        self._closed = closed if closed.any() else None

    def _find_quiet(self, tick: int) -> NDArray[np.bool_]:
        """Return for every pump whether quiet hours prevent it from running in a tick."""
        quiet = np.zeros(len(self._sites), bool)
        tick_ns = round(self._sites.tau[0] * 1e9)
        for rows, site, start in self._clocks:
            if site.quiet is not None:
                quiet[rows] = site.quiet.quiet_at(round(start * 1e9) + tick * tick_ns)
        return quiet

    def results(self, metrics: BatchMetrics) -> dict[str, Values]:
        """Return the metrics of the sites, after the last block."""
        depths = np.array([
            self._sites.tau[0] * weather.rain[: self._steps].sum()
            for weather in self._batch.weather
        ])
        return metrics.results(self._steps, depths[self._weather_of])


def _complete(sites: Sequence[Site], given: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return every parameter of on/off control and the outlet, as arrays over the sites."""
    onoff = find_controller("onoff")
    names = [parameter.name for parameter in (*OnOff.parameters, *PARAMETERS)]
    complete = [
        onoff.complete_parameters(site, onoff.check_parameters(own))
        for site, own in zip(sites, given, strict=True)
    ]
    unused = {parameter.name: parameter.default for parameter in PARAMETERS}  # without a valve
    return {name: np.array([{**unused, **own}[name] for own in complete]) for name in names}
