"""Forecasts: what a controller is told, at each tick, about the time that follows."""

from __future__ import annotations

from array import array
from datetime import datetime
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.look_ahead import growing_steps
from greenroof_ros.site import Site
from greenroof_ros.weather import Weather, WeatherSeries

Array = NDArray[np.float64]
_HOUR_S = 3600.0


class Forecast(Protocol):
    """What was known at a tick about the steps that follow it; the first entry is now."""

    def precipitation(self, tick: int) -> array[float]:
        """Mean rain of each step (m/s), shape (steps,), or one member after the other."""
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

    def precipitation(self, tick: int) -> array[float]:
        """Rain (m/s), shape (M,)."""
        return self._series.precipitation[tick : tick + self._look_ahead]

    def evapotranspiration(self, tick: int) -> array[float]:
        """Evapotranspiration off the whole bed (m3/s), shape (M,)."""
        return self._series.evapotranspiration[tick : tick + self._look_ahead]


class ForecastModel(Protocol):
    """Hourly forecasts: what is known in an hour about those that follow."""

    @property
    def members(self) -> int:
        """How many forecasts of the rain there are; 1 unless it is an ensemble."""
        ...

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast that is the newest in an hour of the records.

        Args:
            hour: index of the hour.
            hours: how many to return, that one first; past the records the last is repeated.

        Returns:
            Rain (mm/h), shape (members, hours), and evapotranspiration (mm/day), shape (hours,).
        """
        ...


class PerfectModel:
    """Knows the records themselves."""

    members = 1

    def __init__(self, weather: Weather) -> None:
        """Take the records."""
        self._weather = weather

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the records; see :class:`ForecastModel`."""
        index = np.minimum(np.arange(hour, hour + hours), len(self._weather.precipitation) - 1)
        return self._weather.precipitation[index][None, :], self._weather.evapotranspiration[index]


class SteppedForecast:
    """Means of an hourly forecast over steps that grow.

    The present hour is not forecast but observed: its rates are those of the records.
    """

    def __init__(
        self, model: ForecastModel, weather: Weather, site: Site, start: datetime, edges: Array
    ) -> None:
        """Prepare for a run.

        Args:
            model: hourly forecasts.
            weather: the records, which give the present hour.
            site: tick, and the bed's area, over which a depth is a volume.
            start: time of tick 0.
            edges: ends of the steps, in seconds from now, the first 0, shape (steps + 1,).
        """
        self._model = model
        self._weather = weather
        self._site = site
        self._offset = (start - weather.first).total_seconds()
        self._edges = edges
        self._lengths = np.diff(edges)
        self._hours = int(edges[-1] // _HOUR_S) + 2
        self._hour = -1
        self._rates = self._sums = np.empty(0)
        self._tick = -1
        self._means: tuple[array[float], array[float]] = (array("d"), array("d"))

    def precipitation(self, tick: int) -> array[float]:
        """Return mean rain (m/s), shape (members * steps,), one member after the other."""
        return self._at(tick)[0]

    def evapotranspiration(self, tick: int) -> array[float]:
        """Return mean evapotranspiration off the whole bed (m3/s), shape (steps,)."""
        return self._at(tick)[1]

    def _at(self, tick: int) -> tuple[array[float], array[float]]:
        """Return both for a tick."""
        if tick != self._tick:
            self._tick = tick
            time = self._offset + tick * self._site.tau
            hour = int(time // _HOUR_S)
            if hour != self._hour:
                self._hour = hour
                self._take_hour(hour)
            ends = time - hour * _HOUR_S + self._edges
            index = (ends // _HOUR_S).astype(np.intp)
            into = ends - index * _HOUR_S
            sums = self._sums[:, index] + self._rates[:, index] * into
            means = np.diff(sums) / self._lengths
            self._means = (
                array("d", means[:-1].tobytes()),
                array("d", means[-1].tobytes()),
            )
        return self._means

    def _take_hour(self, hour: int) -> None:
        """Take the newest forecast: rates in SI units and their sums from the hour's start on."""
        rain, evapotranspiration = self._model.known(hour, self._hours)
        present = min(hour, len(self._weather.precipitation) - 1)
        rates = np.vstack([rain, evapotranspiration])
        rates[:-1, 0] = self._weather.precipitation[present]
        rates[-1, 0] = self._weather.evapotranspiration[present]
        rates[:-1] /= 1000 * _HOUR_S
        rates[-1] *= self._site.a2 / 1000 / 86400
        self._rates = rates
        self._sums = np.zeros_like(rates)
        np.cumsum(rates[:, :-1] * _HOUR_S, axis=1, out=self._sums[:, 1:])


def make_forecast(
    weather: Weather, series: WeatherSeries, site: Site, start: datetime, horizon: float
) -> Forecast:
    """Return what a controller is told.

    Args:
        weather: hourly records.
        series: the same, tick by tick.
        site: gives tick and look-ahead.
        start: time of tick 0.
        horizon: 0 for the M ticks that come, one by one; otherwise hours, in steps that grow.
    """
    if not horizon:
        return PerfectForecast(series, site.M)
    return SteppedForecast(PerfectModel(weather), weather, site, start, growing_steps(horizon))
