"""Forecasts at a controller's steps: what it is given, at each tick, of the time that follows."""

from __future__ import annotations

import math
from array import array
from datetime import datetime
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.models import ForecastModel, PerfectModel, make_model
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.site import Site
from greenroof_ros.weather.series import Weather, WeatherSeries

Array = NDArray[np.float64]
Rain: TypeAlias = "array[float] | Array"
"""A single forecast of rain, shape (steps,), or all members of an ensemble, (members, steps)."""

_HOUR_S = 3600.0
# More than what sums of times lose.
_ROUNDING_S = 1e-6


class Forecast(Protocol):
    """What was known at a tick about the steps that follow it; the first entry is now."""

    @property
    def repeats_from(self) -> datetime | None:
        """The earliest time from which on a forecast knows nothing, and what it says is assumed."""
        ...

    def precipitation(self, tick: int) -> Rain:
        """Mean rain of each step (m/s), shape (steps,); of all members, (members, steps)."""
        ...

    def evapotranspiration(self, tick: int) -> array[float]:
        """Mean evapotranspiration off the whole bed (m3/s) of each step, shape (steps,)."""
        ...


class PerfectForecast:
    """Knows the weather of the M ticks that come, as the paper assumes."""

    def __init__(self, series: WeatherSeries, look_ahead: int) -> None:
        """Take the run's weather and the look-ahead M (ticks)."""
        self._series = series
        self._look_ahead = look_ahead
        self._ticks = range(0)  # which have what follows
        self._rain = self._evapotranspiration = array("d")
        self.repeats_from = series.repeats_from

    def precipitation(self, tick: int) -> array[float]:
        """Rain (m/s), shape (M,)."""
        if tick not in self._ticks:
            self._look(tick)
        return self._rain[:]

    def evapotranspiration(self, tick: int) -> array[float]:
        """Evapotranspiration off the whole bed (m3/s), shape (M,)."""
        if tick not in self._ticks:
            self._look(tick)
        return self._evapotranspiration[:]

    def _look(self, tick: int) -> None:
        """Take what comes from a tick on; from most ticks on it is what comes from the next."""
        window = slice(tick, tick + self._look_ahead)
        self._rain = self._series.precipitation[window]
        self._evapotranspiration = self._series.evapotranspiration[window]
        last = self._series.at(tick).until - self._look_ahead
        self._ticks = range(tick, max(tick, last) + 1)


class SteppedForecast:
    """Means of an hourly forecast over steps.

    The present hour is not forecast but observed: its rates are those of the records.
    """

    def __init__(
        self,
        model: ForecastModel,
        weather: Weather,
        site: Site,
        start: datetime,
        edges: Array,
        steps: int,
        all_members: bool = False,
    ) -> None:
        """Prepare for a run, and ask for all that it needs, so that nothing is missing later.

        Args:
            model: hourly forecasts.
            weather: the records, which give the present hour.
            site: tick, and the bed's area, over which a depth is a volume.
            start: time of tick 0.
            edges: ends of the steps, in seconds from now, the first 0, shape (steps + 1,).
            steps: N of the run (ticks).
            all_members: whether rain is that of all members, otherwise that of the only one.

        Raises:
            ConfigurationError: there is no forecast for a part of the run.
        """
        self._model = model
        self._all_members = all_members
        self._weather = weather
        self._site = site
        self._offset = (start - weather.first).total_seconds()
        self._until = self._offset + steps * site.tau
        self._edges = edges
        self._lengths = np.diff(edges)
        self._hour = -1
        self._rates = self._sums = np.empty((0, 0))
        self._course: _CourseOfMeans | None = None
        self._tick = -1
        self._means: tuple[Rain, array[float]] = (array("d"), array("d"))
        self.repeats_from = self._ask_for_all()

    def precipitation(self, tick: int) -> Rain:
        """Return mean rain (m/s), shape (steps,); of all members, (members, steps)."""
        return self._at(tick)[0]

    def evapotranspiration(self, tick: int) -> array[float]:
        """Return mean evapotranspiration off the whole bed (m3/s), shape (steps,)."""
        return self._at(tick)[1]

    def _at(self, tick: int) -> tuple[Rain, array[float]]:
        """Return rain and evapotranspiration of a tick, which are computed together."""
        if tick != self._tick:
            self._tick = tick
            time = self._offset + tick * self._site.tau
            hour = int(time // _HOUR_S)
            if hour != self._hour:
                self._hour = hour
                self._take_hour(hour)
            since = time - hour * _HOUR_S
            if self._course is None or not self._course.begin <= since < self._course.end:
                self._course = _CourseOfMeans(
                    self._rates, self._sums, self._edges, self._lengths, since
                )
            means = self._course.at(since)
            self._means = (
                means[:-1] if self._all_members else array("d", means[0].tobytes()),
                array("d", means[-1].tobytes()),
            )
        return self._means

    def _ask_for_all(self) -> datetime | None:
        """Ask for every hour's forecast, and return the earliest time from which one repeats."""
        found = []
        for hour in range(int(self._offset // _HOUR_S), int(self._until // _HOUR_S) + 1):
            hours = self._hours(hour)
            self._model.known(hour, hours)
            repeats_from = self._model.repeats_from(hour, hours)
            if repeats_from is not None:
                found.append(repeats_from)
        return min(found, default=None)

    def _hours(self, hour: int) -> int:
        """Return how many hours the ticks in an hour need, that one included."""
        last_tick = min((hour + 1) * _HOUR_S, self._until)
        return math.ceil((last_tick + float(self._edges[-1])) / _HOUR_S) - hour

    def _take_hour(self, hour: int) -> None:
        """Take the newest forecast: rates in SI units and their sums from the hour's start on."""
        rain, evapotranspiration = self._model.known(hour, self._hours(hour))
        present = min(hour, len(self._weather.precipitation) - 1)
        rates = np.vstack([rain, evapotranspiration])
        rates[:-1, 0] = self._weather.precipitation[present]
        rates[-1, 0] = self._weather.evapotranspiration[present]
        rates[:-1] /= 1000 * _HOUR_S
        rates[-1] *= self._site.a2 / 1000 / 86400
        self._rates = rates
        self._sums = sums_of_hours(rates)
        self._course = None


def sums_of_hours(rates: Array) -> Array:
    """Return what has come by the start of each hour, at these rates (1/s), shape (..., hours)."""
    sums = np.zeros_like(rates)
    np.cumsum(rates[:, :-1] * _HOUR_S, axis=1, out=sums[:, 1:])
    return sums


def means_of_hours(rates: Array, sums: Array, ends: Array, lengths: Array) -> Array:
    """Return the mean rate of each step, shape (..., steps), row by row in memory.

    Args:
        rates: of each hour (1/s), shape (..., hours).
        sums: see :func:`sums_of_hours`.
        ends: of the steps (s since the start of the first hour), shape (steps + 1,).
        lengths: of the steps (s), shape (steps,).
    """
    return _CourseOfMeans(rates, sums, ends, lengths, 0.0).at(0.0)


class _CourseOfMeans:
    """The means of steps as time passes: straight lines while each end stays in its hour.

    The lines are those from the start of the hour, whenever in it they are asked for first, so that
    a node that was started again has each bit of one that was not.

    Attributes:
        begin: from then on they are right (s since the start of the first hour).
        end: until then, but for a rounding.
    """

    def __init__(
        self, rates: Array, sums: Array, edges: Array, lengths: Array, since: float
    ) -> None:
        """Take what :func:`means_of_hours` does, which explains it, and the time.

        Args:
            rates: of each hour.
            sums: before each hour.
            edges: ends of the steps (s from the time), shape (steps + 1,).
            lengths: of the steps.
            since: the time (s since the start of the first hour).
        """
        ends = since + edges
        # The end of the last step may be that of the last hour.
        index = np.minimum(ends // _HOUR_S, rates.shape[1] - 1).astype(np.intp)
        begins = index * _HOUR_S
        # numpy's choice of columns turns the order in memory around, and that of its sums follows
        # it: the last bit of a sum over members would differ from that on what a message brings.
        at_ends = np.ascontiguousarray(rates[:, index])
        come = np.ascontiguousarray(sums[:, index]) + at_ends * (edges - begins)
        self._first = (come[:, 1:] - come[:, :-1]) / lengths
        self._slope = (at_ends[:, 1:] - at_ends[:, :-1]) / lengths
        self.begin = since
        self.end = since + float((begins + _HOUR_S - ends).min()) - _ROUNDING_S

    def at(self, since: float) -> Array:
        """Return the mean rate of each step, shape (..., steps), row by row in memory.

        None is below 0; the last bit of a line's end may be.
        """
        means: Array = np.maximum(self._first + self._slope * since, 0.0)
        return means


def look_ahead_ends(site: Site, horizon: float) -> Array:
    """Return the ends of the steps of a look-ahead (s from now), the first 0, shape (steps + 1,).

    Args:
        site: gives tick and look-ahead.
        horizon: 0 for the M ticks that come, one by one; otherwise hours, in steps that grow.
    """
    return growing_steps(horizon) if horizon else site.tau * np.arange(site.M + 1.0)


def make_forecast(
    weather: Weather,
    series: WeatherSeries,
    site: Site,
    start: datetime,
    horizon: float,
    choice: ForecastChoice,
    all_members: bool = False,
) -> Forecast:
    """Return the forecast that a controller is given.

    Args:
        weather: hourly records.
        series: the same, tick by tick.
        site: gives tick and look-ahead.
        start: time of tick 0.
        horizon: 0 for the M ticks that come, one by one; otherwise hours, in steps that grow.
        choice: which forecasts.
        all_members: of an ensemble; otherwise the first.

    Raises:
        ConfigurationError: a file of forecasts is wrong, or there is none for a part of the run.
    """
    model = make_model(choice, weather, site, all_members)
    if not horizon and not all_members and isinstance(model, PerfectModel):
        return PerfectForecast(series, site.M)
    edges = look_ahead_ends(site, horizon)
    steps = len(series.precipitation) - site.M
    return SteppedForecast(model, weather, site, start, edges, steps, all_members)
