"""Forecasts: what is known at a tick about the ticks that follow."""

from __future__ import annotations

from array import array
from typing import Protocol

from greenroof_ros.weather import WeatherSeries


class Forecast(Protocol):
    """What was known at tick k about the ticks k..k+M-1; the first entry is now."""

    def precipitation(self, tick: int) -> array[float]:
        """Rain (m/s), shape (M,)."""
        ...

    def evapotranspiration(self, tick: int) -> array[float]:
        """Evapotranspiration off the whole bed (m3/s), shape (M,)."""
        ...


class PerfectForecast:
    """Knows the weather that comes, as the paper assumes."""

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
