"""The weather of a run: hourly records, and what they are tick by tick.

A run may be of years: what a tick has is looked up in its hour, and no array has an entry a tick.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.formats.records import HOUR, PRECIPITATION, Issue, Records, name_hours
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import FAO56, why_missing
from greenroof_ros.weather.filling import REFUSE, suspicious_rain

_HOUR_NS = 3_600_000_000_000


@dataclass(frozen=True)
class Weather:
    """Hourly records without a gap in time; each holds for the hour that starts at its time.

    Attributes:
        records: as read, gaps filled.
        precipitation: depth of rain in each hour (mm/h), shape (hours,); NaN where missing.
        evapotranspiration: depth over the vegetation bed (mm/day), shape (hours,); NaN where
            missing.
        method: of the evapotranspiration: ``fao56``, computed here, or as the file's header
            names it.
        frost: whether the air is at or below 0 degC, shape (hours,); None where the file has no
            temperature.
        gaps: what was done about gaps that are not short, one of
            :data:`greenroof_ros.weather.filling.GAPS`.
    """

    records: Records
    precipitation: NDArray[np.float64]
    evapotranspiration: NDArray[np.float64]
    method: str
    frost: NDArray[np.bool_] | None
    gaps: str = REFUSE

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
    def rain_from(self) -> datetime:
        """Start of the hour in which the first record's rain fell."""
        return self.first - self.records.rain_late * HOUR

    @property
    def end(self) -> datetime:
        """End of the last hour."""
        return self.first + len(self.precipitation) * HOUR


class _Clock:
    """Which hour of the records a tick is in; beyond their end it is the last."""

    def __init__(self, offset_ns: int, tick_ns: int, last: int) -> None:
        """Take the time of tick 0 since hour 0, the duration of a tick (ns), and the last hour."""
        self._offset_ns = offset_ns
        self._tick_ns = tick_ns
        self._last = last

    def hour(self, tick: int) -> int:
        """Return the hour of a tick."""
        return min((self._offset_ns + tick * self._tick_ns) // _HOUR_NS, self._last)

    def hours(self, ticks: range) -> NDArray[np.int64]:
        """Return the hour of each tick, shape (ticks,)."""
        elapsed_ns = self._offset_ns + np.asarray(ticks, dtype=np.int64) * self._tick_ns
        return np.minimum(elapsed_ns // _HOUR_NS, self._last)

    def first_tick(self, hour: int) -> int:
        """Return the first tick that begins in an hour or after it."""
        return -((self._offset_ns - hour * _HOUR_NS) // self._tick_ns)


class PerTick(Sequence[float]):
    """Hourly values as one for each tick; a slice is an array."""

    def __init__(self, values: NDArray[np.float64], clock: _Clock, ticks: int) -> None:
        """Take the values of all hours of the records, and the number of ticks."""
        self._values = values
        self._clock = clock
        self._ticks = range(ticks)

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self._ticks)

    @overload
    def __getitem__(self, key: int) -> float: ...

    @overload
    def __getitem__(self, key: slice) -> array[float]: ...

    def __getitem__(self, key: int | slice) -> float | array[float]:
        """Return the value of a tick, or those of several."""
        ticks = self._ticks[key]
        if isinstance(ticks, int):
            return float(self._values[self._clock.hour(ticks)])
        return array("d", self._values[self._clock.hours(ticks)].tobytes())

    @property
    def largest(self) -> float:
        """The largest value of a tick."""
        first, last = self._clock.hour(0), self._clock.hour(len(self) - 1)
        return float(self._values[first : last + 1].max())


class Hour(NamedTuple):
    """The weather of the ticks of an hour."""

    precipitation: float
    """m/s"""
    evapotranspiration: float
    """m3/s, off the whole bed"""
    frost: float
    """1 or 0"""
    until: int
    """the first tick of the next hour"""


class WeatherSeries:
    """A run's weather in SI units, tick by tick.

    Attributes:
        precipitation: rain (m/s) in each tick; beyond the last tick for M ticks more.
        evapotranspiration: off the whole bed (m3/s), likewise.
        frost: 1 where there is frost, 0 where there is none or it is unknown, likewise.
        repeats_from: the time from which on the last record is repeated, because some tick's
            window of M ticks reaches past the end of the file; None if none does.
        filled: hours of the run's days and the day before that were missing and filled, named, by
            quantity.
        filled_hours: their number; an hour counts once, however many quantities it lacked.
        suspicious: hours of the run with more rain than is believable, named.
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
        last = len(weather.precipitation) - 1
        self._clock = clock = _Clock(offset_ns, tick_ns, last)
        past = offset_ns + (ticks - 1) * tick_ns >= (last + 1) * _HOUR_NS
        self.repeats_from = weather.end if past else None
        first = clock.hour(0)
        _check_known(weather, np.arange(first, clock.hour(ticks - 1) + 1))
        frost = np.zeros(last + 1) if weather.frost is None else weather.frost.astype(float)
        self.precipitation = PerTick(weather.precipitation / 1000 / 3600, clock, ticks)
        self.evapotranspiration = PerTick(
            weather.evapotranspiration / 1000 / 86400 * site.a2, clock, ticks
        )
        self.frost = PerTick(frost, clock, ticks)
        # Of tick 0 to the end of tick N-1; the window beyond is not part of the run.
        run = range(first, clock.hour(steps - 1) + 1)
        begins = [clock.first_tick(hour) for hour in run[1:]]
        frozen = frost[run.start : run.stop] * np.diff([0, *begins, steps])
        self.frost_hours: float | None = None
        if weather.frost is not None:
            self.frost_hours = float(frozen.sum()) * site.tau / 3600
        self.precipitation_in_frost = float(
            (frozen * weather.precipitation[run.start : run.stop]).sum() * site.tau / 3600
        )
        self.suspicious = suspicious_rain(weather.records, run)
        days = range(max(0, run.start - 24), min(last, run.stop - 1 + 24) + 1)
        self.filled = {
            quantity: name_hours(weather.first, [index for index in days if marks[index]])
            for quantity, marks in weather.records.filled.items()
            if marks[days.start : days.stop].any()
        }
        filled = np.zeros(last + 1, dtype=np.bool_)
        for marks in weather.records.filled.values():
            filled |= marks
        self.filled_hours = int(filled[days.start : days.stop].sum())

    def at(self, tick: int) -> Hour:
        """Return the weather of a tick, and until when it stays."""
        hour = self._clock.hour(tick)
        until = self._clock.first_tick(hour + 1)
        return Hour(
            self.precipitation[tick], self.evapotranspiration[tick], self.frost[tick],
            until if tick < until else len(self.precipitation),
        )


def _check_known(weather: Weather, hours: NDArray[np.int64]) -> None:
    """Refuse a run that needs an hour that is missing and was not filled."""
    first, records = weather.first, weather.records
    way_out = "choose another window, or put in what another station has"
    if weather.gaps == REFUSE:
        way_out += (
            "; or have the gaps filled (--gaps fill, in a grid gaps: fill): missing rain counts as "
            "none, and all else is the mean at that time of day over three days before and after"
        )
    for quantity in (PRECIPITATION, "temperature"):
        series = records.values.get(quantity)
        if series is not None and np.isnan(series[hours]).any():
            missing = hours[np.isnan(series[hours])]
            raise ConfigurationError(
                f"{quantity} is missing at {', '.join(name_hours(first, missing))}; {way_out}",
                file=weather.source,
            )
    unknown = hours[np.isnan(weather.evapotranspiration[hours])]
    if unknown.size:
        raise ConfigurationError(
            f"there is no {FAO56} evapotranspiration for {', '.join(name_hours(first, unknown))}: "
            f"{why_missing(records, unknown)}; {way_out}",
            file=weather.source,
        )


def records_at(
    weather: Weather, quantity: str, hours: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return records; the first stands for those before it, and the last for those after it.

    Raises:
        ConfigurationError: one of them is missing.
    """
    series: NDArray[np.float64] = getattr(weather, quantity)
    index = np.clip(hours, 0, len(series) - 1)
    values = series[index]
    if np.isnan(values).any():
        missing = np.unique(index[np.isnan(values)])
        raise ConfigurationError(
            f"{quantity} is missing at {', '.join(name_hours(weather.first, missing))}, and the "
            "run's forecasts need it; choose another window or another kind of forecast",
            file=weather.source,
        )
    return values


def refuse_between_hours(issues: Sequence[Issue], weather: Weather) -> None:
    """Refuse issues that are not whole hours from where the records begin.

    Raises:
        ConfigurationError: one is not.
    """
    for issue in issues:
        if (issue.issued - weather.first) % HOUR:
            raise ConfigurationError(
                f"must be a whole number of hours from {to_minutes(weather.first)}, where "
                f"{weather.source} begins",
                file=issue.file, line=issue.line, key="issued", value=to_minutes(issue.issued),
            )
