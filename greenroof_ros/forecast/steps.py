"""Forecasts resampled to the steps of a controller, as it receives them in every tick.

One rule holds for simulations and for live sites. A forecast begins with what is measured now: the
weather of the tick, or the reading of the rain gauge. This value holds for the present tick, and
for the whole first step if that is longer. Everything after it, including the rest of the current
hour, is the forecast's own value. A later record therefore never replaces a forecast; only a
perfect forecast consists of records. A value that is not measured (rain without a gauge, or the
evapotranspiration of a live site) is the forecast's own from the beginning.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from greenroof_ros.base.times import to_minutes
from greenroof_ros.forecast.choice import PERFECT, ForecastChoice
from greenroof_ros.forecast.models import ForecastModel, make_model
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION
from greenroof_ros.weather.records import HOUR, Array
from greenroof_ros.weather.series import Weather, WeatherSeries

Rain: TypeAlias = "array[float] | Array"
"""a single forecast of rain, shape (steps,), or all members of an ensemble, (members, steps)"""

_HOUR_S = 3600.0
# More than the rounding error of sums of times.
_ROUNDING_S = 1e-6


class Outlook(NamedTuple):
    """The current weather and the forecast in steps, as a controller receives them."""

    rain: Rain
    """mean rain in the steps of the look-ahead (m/s), shape (steps,), or (members, steps) for all
    members"""
    evapotranspiration: array[float]
    """mean evapotranspiration of the whole bed (m3/s), shape (steps,)"""
    rain_now: float
    """current rain (m/s)"""
    evapotranspiration_now: float
    """current evapotranspiration of the whole bed (m3/s)"""
    issued: datetime | None = None
    """nominal time of issue; None if the forecast has no time of issue"""
    temperature: float = math.nan
    """current air temperature (degC); NaN if unknown"""


class HourForecast:
    """A forecast from one hour on, with mean rates over steps that begin at any time in the hour.

    While the end of every step stays within its hour, the means are linear in time, apart from the
    measured values. These linear functions are always computed from the start of the hour, no
    matter when they are first needed, so that a restarted node yields bit-identical results.
    """

    def __init__(
        self, issued: datetime | None, rain: Array, evapotranspiration: Array, site: Site,
        ends: Array, measured: bool, temperature: float = math.nan,
    ) -> None:
        """Set the forecast.

        Args:
            issued: nominal time of issue; see :class:`Outlook`.
            rain: rain (mm/h), shape (members, hours), starting with the current hour.
            evapotranspiration: evapotranspiration (mm/day), shape (hours,), or (sites, hours).
            site: site, which provides the tick, and the bed area used to convert depths to volumes.
            ends: boundaries of the steps; see :func:`look_ahead_ends`.
            measured: whether the current rain is measured.
            temperature: air temperature; see :class:`Outlook`.
        """
        self._issued, self._temperature = issued, temperature
        self._rates, self._members = np.vstack([rain, evapotranspiration]), len(rain)
        rates = self._rates
        rates[: len(rain)] /= 1000 * _HOUR_S
        rates[len(rain) :] *= site.a2 / 1000 / 86400
        # The totals at the start of every hour.
        self._sums = np.zeros_like(rates)
        np.cumsum(rates[:, :-1] * _HOUR_S, axis=1, out=self._sums[:, 1:])
        # The current values hold for a share of every step; the ends of its other part.
        hold = max(site.tau, float(ends[1])) if measured else 0.0
        self._ends, self._lengths = np.maximum(ends, hold), np.diff(ends)
        self._held = np.diff(np.minimum(ends, hold)) / self._lengths
        # The lines, and the interval in which they are valid (s since the start of the first hour).
        self._from = self._until = math.inf
        self._first = self._slope = np.empty(0)

    def at(self, since: float, all_members: bool, measured: tuple[float, ...]) -> Outlook:
        """Return the outlook at a given time.

        Args:
            since: time since the start of the current hour (s).
            all_members: whether to return the rain of all members, or of the first member only.
            measured: the current values that are measured: none, or the rain (m/s), or the rain and
                the evapotranspiration of the whole bed (m3/s).
        """
        means, now = self.find_means(since, measured)
        return Outlook(
            means[:-1] if all_members else array("d", means[0].tobytes()),
            array("d", means[-1].tobytes()), float(now[0, 0]), float(now[-1, 0]),
            self._issued, self._temperature,
        )

    def find_means(self, since: float, measured: tuple[float | Array, ...]) -> tuple[Array, Array]:
        """Return the means of the rain of all members, then of the evapotranspiration.

        Args:
            since: time since the start of the current hour (s).
            measured: as for :meth:`at`; each can have shape (members, 1) or (sites, 1).

        Returns:
            The means, shape (members + sites, steps), and the current values, shape (members +
            sites, 1).
        """
        if not self._from <= since < self._until:
            self._draw_lines(since)
        now, members = self._rates[:, :1].copy(), self._members
        for rows, value in zip((slice(members), slice(members, None)), measured, strict=False):
            now[rows] = value
        means = self._held * now
        means += self._first
        means += self._slope * since
        # No mean is negative, but rounding can make one so at the end of a line.
        return np.maximum(means, 0.0, out=means), now

    def _draw_lines(self, since: float) -> None:
        ends = since + self._ends
        # The last step may end with the last hour.
        index = np.minimum(ends // _HOUR_S, self._rates.shape[1] - 1).astype(np.intp)
        begins = index * _HOUR_S
        # Unlike an index in brackets, this keeps the memory order, and with it the order of
        # summation: sums over members equal those of the same values received in a message.
        at_ends = self._rates.take(index, axis=1)
        cumulative = self._sums.take(index, axis=1)
        cumulative += at_ends * (self._ends - begins)
        self._first, self._slope = np.diff(cumulative), np.diff(at_ends)
        self._first /= self._lengths
        self._slope /= self._lengths
        self._from = since
        self._until = since + float((begins + _HOUR_S - ends).min()) - _ROUNDING_S


class PerfectForecast:
    """Perfect knowledge of the weather in the next M ticks, as the paper assumes.

    Attributes:
        notes: sentences about values of a file's forecasts that could not be used unchanged, and
            about values that are assumed.
    """

    def __init__(self, series: WeatherSeries, look_ahead: int) -> None:
        """Set the run's weather and the look-ahead M (ticks)."""
        self._series = series
        self._look_ahead = look_ahead
        self._ticks = range(0)  # ticks for which the current window is valid
        self._rain = self._evapotranspiration = array("d")
        self.notes = _note_end(series.repeats_from)

    def at(self, tick: int) -> Outlook:
        """Return the outlook at a tick, with a step for each of the next M ticks."""
        if tick not in self._ticks:
            window = slice(tick, tick + self._look_ahead)
            self._rain = self._series.precipitation[window]
            self._evapotranspiration = self._series.evapotranspiration[window]
            last = self._series.at(tick).until - self._look_ahead
            self._ticks = range(tick, max(tick, last) + 1)
        rain, evapotranspiration = self._rain[:], self._evapotranspiration[:]
        return Outlook(rain, evapotranspiration, rain[0], evapotranspiration[0])


class SteppedForecast:
    """Means of an hourly forecast over the steps of the look-ahead, beginning with the present.

    Attributes:
        notes: as for :class:`PerfectForecast`.
    """

    def __init__(
        self, model: ForecastModel, weather: Weather, series: WeatherSeries, site: Site,
        start: datetime, ends: Array, all_members: bool = False,
    ) -> None:
        """Prepare for a run, and check that nothing is missing in all of it.

        Args:
            model: model of the hourly forecasts.
            weather: the records, to which the hours of the model refer.
            series: the weather of the run, tick by tick.
            site: site, which provides the tick, and the bed area used to convert depths to volumes.
            start: time of tick 0.
            ends: boundaries of the steps; see :func:`look_ahead_ends`.
            all_members: whether to return the rain of all members, or of a single member.

        Raises:
            ConfigurationError: if there is no forecast for a part of the run.
        """
        self._model, self._series, self._site = model, series, site
        self._ends, self._all_members = ends, all_members
        # Times count from the start of the run's first hour, so that they do not depend on it.
        first, self._offset = divmod((start - weather.first).total_seconds(), _HOUR_S)
        self._first, self._weather = int(first), weather
        self._until = self._offset + (len(series.precipitation) - site.M) * site.tau
        # Those of the current hour and tick: an environment asks twice in a tick.
        self._made: dict[int, HourForecast] = {}
        self._outlooks: dict[int, Outlook] = {}
        last = int(self._until // _HOUR_S)
        model.check(range(self._first, self._first + last + self._hours(last)))

    @property
    def notes(self) -> list[str]:
        """Sentences for readers; see :class:`PerfectForecast`."""
        model, start = self._model, self._weather.first + self._first * HOUR
        hours = range(int(self._until // _HOUR_S) + 1)
        ends = ((hour, model.end(self._first + hour)) for hour in hours)
        short = (end for hour, end in ends if end < start + (hour + self._hours(hour)) * HOUR)
        return [*model.notes, *_note_end(min(short, default=None))]

    def at(self, tick: int) -> Outlook:
        """Return the outlook at a tick."""
        if tick in self._outlooks:
            return self._outlooks[tick]
        hour, since = self._locate(tick)
        measured = self._series.precipitation[tick], self._series.evapotranspiration[tick]
        if hour not in self._made:
            self._made = {hour: self._make(self._first, hour)}
        outlook = self._made[hour].at(since, self._all_members, measured)
        self._outlooks = {tick: outlook}
        return outlook

    @staticmethod
    def at_once(forecasts: Sequence[Any], tick: int, measured: tuple[Array, Array]) -> Array:
        """Return the means of perfect forecasts for runs that differ by whole hours in their start.

        Args:
            forecasts: forecasts of n equally long runs with the same weather and site.
            tick: a tick of every run.
            measured: rain (m/s) and evapotranspiration (m3/s) in this tick, each of shape (n, 1).

        Returns:
            Means of the rain, then of the evapotranspiration, in units of :class:`Outlook`, shape
            (n, 2 steps); each equal to that of :meth:`at` bit for bit.
        """
        one, firsts = forecasts[0], np.array([each._first for each in forecasts])
        hour, since = one._locate(tick)
        means, _ = one._make(firsts[:, None], hour).find_means(since, measured)
        return np.hstack(np.split(means, 2))

    def as_records(self, tick: int) -> Weather:
        """Return records in which the forecast of a tick, with its first member, comes true.

        After the forecast, there is no rain, and the evapotranspiration of its last day repeats.
        """
        hour, _ = self._locate(tick)
        first, hours = self._first + hour, self._hours(hour)
        rain, dried, _ = self._model.forecast(first, hours)
        values, left = {**self._weather.values}, self._weather.hours - first
        for name, expected, then in (
            (PRECIPITATION, rain[0], np.zeros(1)), (EVAPOTRANSPIRATION, dried, dried[-24:])
        ):
            later = np.append(expected, np.resize(then, left))[:left]
            values[name] = np.append(values[name][:first], later)
        return replace(self._weather, values=values, minutes=None)

    def _locate(self, tick: int) -> tuple[int, float]:
        """Return the hour of the run in which a tick begins, and the time since its start (s)."""
        time = self._offset + tick * self._site.tau
        hour = int(time // _HOUR_S)
        return hour, time - hour * _HOUR_S

    def _make(self, first: Any, hour: int) -> HourForecast:
        """Make the forecast in an hour of a run, or of many with first hours of shape (n, 1)."""
        rain, dried, issued = self._model.forecast(first + hour, self._hours(hour))
        return HourForecast(issued, rain, dried, self._site, self._ends, True)

    def _hours(self, hour: int) -> int:
        """Return the number of hours that the ticks in an hour of the run need, with that hour."""
        last_tick = min((hour + 1) * _HOUR_S, self._until)
        return math.ceil((last_tick + float(self._ends[-1])) / _HOUR_S) - hour


def _note_end(repeats_from: datetime | None) -> list[str]:
    """Return a note if a forecast repeats its last value from some time on."""
    if repeats_from is None:
        return []
    return [f"a forecast ends at {to_minutes(repeats_from)}; later values are assumed"]


Forecast: TypeAlias = PerfectForecast | SteppedForecast
"""what was known at a tick about the steps that follow it; the first entry is the present"""


def make_forecast(
    weather: Weather,
    series: WeatherSeries,
    site: Site,
    start: datetime,
    horizon: float,
    choice: ForecastChoice,
    all_members: bool = False,
    outlet_horizon: float = 0.0,
) -> Forecast:
    """Return the forecast that a controller receives.

    Args:
        weather: hourly records.
        series: the weather, tick by tick.
        site: site, which provides the tick and the look-ahead.
        start: time of tick 0.
        horizon: length of the forecast in growing steps (h); 0 for the next M ticks, one by one.
        choice: choice of the forecasts.
        all_members: whether to return the rain of all members of an ensemble, or of the first
            member only.
        outlet_horizon: look-ahead of the outlet valve's plan (h); 0 without a plan for the valve.

    Raises:
        ConfigurationError: if a forecast file is invalid, or if there is no forecast for a part
            of the run.
    """
    if choice.model == PERFECT and not horizon and not all_members:
        return PerfectForecast(series, site.M)
    model = make_model(choice, weather, site, all_members)
    ends = look_ahead_ends(site, horizon, outlet_horizon)
    return SteppedForecast(model, weather, series, site, start, ends, all_members)
