"""The weather of a run: hourly records, and what they are tick by tick."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import FAO56, why_missing
from greenroof_ros.weather.records import HOUR, PRECIPITATION, Records, name_hours

_HOUR_NS = 3_600_000_000_000


@dataclass(frozen=True)
class Weather:
    """Hourly records without a gap in time; each holds for the hour that starts at its time.

    Attributes:
        records: as read, their short gaps filled.
        precipitation: depth of rain in each hour (mm/h), shape (hours,); NaN where missing.
        evapotranspiration: depth over the vegetation bed (mm/day), shape (hours,); NaN where
            missing.
        method: of the evapotranspiration: ``fao56``, computed here, or as the file's header
            names it.
        frost: whether the air is at or below 0 degC, shape (hours,); None where the file has no
            temperature.
    """

    records: Records
    precipitation: NDArray[np.float64]
    evapotranspiration: NDArray[np.float64]
    method: str
    frost: NDArray[np.bool_] | None

    @property
    def files(self) -> tuple[Path, ...]:
        """Where the records come from, in the order of time."""
        return self.records.files

    @property
    def source(self) -> str:
        """The files by one name, for messages and tables."""
        return self.records.source

    @property
    def first(self) -> datetime:
        """Start of the first hour, with its offset from UTC."""
        return self.records.first

    @property
    def end(self) -> datetime:
        """End of the last hour."""
        return self.first + len(self.precipitation) * HOUR


class WeatherSeries:
    """A run's weather in SI units, tick by tick.

    Attributes:
        precipitation: rain (m/s), shape (ticks,); beyond the last tick for M ticks more.
        evapotranspiration: off the whole bed (m3/s), shape (ticks,).
        frost: 1 where there is frost, 0 where there is none or it is unknown, shape (ticks,).
        repeats_from: the time from which on the last record is repeated, because some tick's
            window of M ticks reaches past the end of the file; None if none does.
        filled: hours of the run's days and the day before that were missing and filled, named, by
            quantity.
        filled_hours: their number; an hour counts once, however many quantities it lacked.
        frost_hours: of the run (h); None where the file has no temperature.
        precipitation_in_frost: depth (mm) in them, snow perhaps, which the model takes as rain.
    """

    def __init__(self, weather: Weather, site: Site, start: datetime, steps: int) -> None:
        """Give each of the ticks 0..steps, and of the last tick's window, the values of its hour.

        Args:
            weather: hourly records that cover the run.
            site: gives tick, look-ahead and the bed's area, over which a depth is a volume.
            start: time of tick 0.
            steps: N; tick N is the last.

        Raises:
            ConfigurationError: the records do not cover the run, or an hour of it is missing.
        """
        tick_ns = round(site.tau * 1e9)
        before = (weather.end - start).total_seconds()
        if start < weather.first or steps * site.tau > before:
            raise ConfigurationError(
                f"holds {to_minutes(weather.first)} to {to_minutes(weather.end)}, but the run is "
                f"from {to_minutes(start)} on for {steps * site.tau / 3600:g} hours",
                file=weather.source,
            )
        ticks = steps + site.M
        offset_ns = round((start - weather.first) / timedelta(microseconds=1)) * 1000
        elapsed_ns: NDArray[np.int64] = offset_ns + np.arange(ticks, dtype=np.int64) * tick_ns
        hour = elapsed_ns // _HOUR_NS
        last = len(weather.precipitation) - 1
        self.repeats_from = weather.end if hour[-1] > last else None
        _check_known(weather, np.arange(int(hour[0]), min(int(hour[-1]), last) + 1))
        hour = np.minimum(hour, last)
        self.precipitation = array("d", (weather.precipitation / 1000 / 3600)[hour].tobytes())
        self.evapotranspiration = array(
            "d", (weather.evapotranspiration / 1000 / 86400 * site.a2)[hour].tobytes()
        )
        frost = np.zeros(last + 1) if weather.frost is None else weather.frost.astype(float)
        self.frost = array("d", frost[hour].tobytes())
        # Of tick 0 to the end of tick N-1; the window beyond is not part of the run.
        run = hour[:steps]
        self.frost_hours: float | None = None
        if weather.frost is not None:
            self.frost_hours = float(frost[run].sum()) * site.tau / 3600
        self.precipitation_in_frost = float(
            (frost * weather.precipitation)[run].sum() * site.tau / 3600
        )
        days = range(max(0, int(run[0]) - 24), min(last, int(run[-1]) + 24) + 1)
        self.filled = {
            quantity: name_hours(weather.first, [index for index in days if marks[index]])
            for quantity, marks in weather.records.filled.items()
            if marks[days.start : days.stop].any()
        }
        filled = np.zeros(last + 1, dtype=np.bool_)
        for marks in weather.records.filled.values():
            filled |= marks
        self.filled_hours = int(filled[days.start : days.stop].sum())


def _check_known(weather: Weather, hours: NDArray[np.int64]) -> None:
    """Refuse a run that needs an hour that is missing and was not filled."""
    first, records = weather.first, weather.records
    for quantity in (PRECIPITATION, "temperature"):
        series = records.values.get(quantity)
        if series is not None and np.isnan(series[hours]).any():
            missing = hours[np.isnan(series[hours])]
            raise ConfigurationError(
                f"{quantity} is missing at {', '.join(name_hours(first, missing))}; choose another "
                "window, or put in what another station has",
                file=weather.source,
            )
    unknown = hours[np.isnan(weather.evapotranspiration[hours])]
    if unknown.size:
        raise ConfigurationError(
            f"there is no {FAO56} evapotranspiration for {', '.join(name_hours(first, unknown))}: "
            + why_missing(records, unknown),
            file=weather.source,
        )
