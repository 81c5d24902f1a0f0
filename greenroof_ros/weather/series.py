"""The weather of a run: hourly records, and their values for every tick.

A run may last for years, so the arrays do not have an entry per tick. The value of a tick is looked
up in its hour or, for rain with a resolution of one minute, in its minute. Only if a minute is not
a multiple of a tick is the rain stored as the mean over each tick.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import duration, to_minutes
from greenroof_ros.site.site import Place, Site, format_place, measure_distance
from greenroof_ros.weather.climate import RECORDED, Climate
from greenroof_ros.weather.evapotranspiration import COMPUTED, FAO56
from greenroof_ros.weather.quantities import (
    EVAPOTRANSPIRATION,
    FOR_EVAPOTRANSPIRATION,
    OTHER_DEMAND,
    PRECIPITATION,
    TEMPERATURE,
)
from greenroof_ros.weather.records import HOUR, Array, Records, name_hours
from greenroof_ros.weather.summary import summarize

_HOUR_NS = 3_600_000_000_000
_MINUTE_NS = _HOUR_NS // 60
# Weather from this distance or further does not represent the site (km): rain and wind differ even
# within a city.
_FAR_KM = 50.0
# At or below this temperature there is frost, and nothing is pumped (degC).
_FREEZING = 0.0

REFUSE, FILL = "refuse", "fill"
GAPS = (REFUSE, FILL)
"""treatments of a missing hour in a long gap that a run needs; the first is the default"""


@dataclass(frozen=True)
class Weather(Records):
    """Consecutive hourly records with evapotranspiration.

    Attributes:
        gaps: treatment of long gaps, one of :data:`GAPS`.
        climate: how the climate differs from that of the record.
    """

    gaps: str = REFUSE
    climate: Climate = RECORDED

    @property
    def precipitation(self) -> Array:
        """Rain in every hour (mm/h), shape (hours,); NaN if missing."""
        return self.values[PRECIPITATION]

    @property
    def evapotranspiration(self) -> Array:
        """Evapotranspiration of the vegetation (mm/day), shape (hours,); NaN if missing."""
        return self.values[EVAPOTRANSPIRATION]

    @property
    def frost(self) -> NDArray[np.bool_] | None:
        """Mask of hours with frost (at most 0 degC), shape (hours,); None without temperature."""
        temperature = self.values.get(TEMPERATURE)
        return None if temperature is None else temperature <= _FREEZING

    @property
    def end(self) -> datetime:
        """End of the last hour."""
        return self.first + self.hours * HOUR

    def warnings(self, site: Place) -> Iterator[str]:
        """Yield sentences that a reader should see before any result at a site."""
        own: Any = site.latitude, site.longitude
        for file, place in self.places.items() if None not in own else ():
            away = measure_distance(place, own)
            if away > _FAR_KM:
                yield (
                    f"{file} is from {format_place(*place)}, {away:.0f} km from the site at "
                    f"{format_place(*own)}; check that this weather applies to the site"
                )
        yield from filter(None, [self.rain_note])


@dataclass(frozen=True, eq=False)
class PerTick(Sequence[float]):
    """A value for every tick, looked up in hourly or other values; a slice yields an array."""

    values: Array
    """values of consecutive steps, such as hours; the last also holds for all later ticks"""
    offset_ns: int
    """time of tick 0 relative to step 0 (ns)"""
    tick_ns: int
    """duration of a tick (ns)"""
    ticks: range
    """all ticks"""
    step_ns: int = _HOUR_NS
    """duration of a step (ns)"""

    def step(self, ticks: Any) -> Any:
        """Return the step in which a tick begins, or the steps of an array of ticks."""
        steps, last = (self.offset_ns + ticks * self.tick_ns) // self.step_ns, len(self.values) - 1
        # For a single number, numpy takes five times as long.
        return min(steps, last) if isinstance(steps, int) else np.minimum(steps, last)

    def first_tick(self, step: Any) -> Any:
        """Return the first tick that begins in a given step or later, or those of many steps."""
        return -((self.offset_ns - step * self.step_ns) // self.tick_ns)

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.ticks)

    def __getitem__(self, key: Any) -> Any:
        """Return the value of a tick, or the values of a range of ticks."""
        ticks = self.ticks[key]
        if isinstance(ticks, int):
            return float(self.values[self.step(ticks)])
        numbers = np.arange(ticks.start, ticks.stop, ticks.step, dtype=np.int64)
        return array("d", self.values[self.step(numbers)].tobytes())

    @property
    def maximum(self) -> float:
        """The maximum value of all ticks."""
        return float(self.values[self.step(0) : self.step(len(self) - 1) + 1].max())


class Hour(NamedTuple):
    """The weather of the ticks in an hour."""

    precipitation: float
    """rain (m/s)"""
    evapotranspiration: float
    """evapotranspiration of the whole bed (m3/s)"""
    frost: float
    """1 during frost, otherwise 0"""
    other_demand: float
    """water that other uses than the roof need (m3/s)"""
    until: int
    """the tick until which these values hold"""


class WeatherSeries:
    """The weather of a run in SI units, for every tick.

    Attributes:
        precipitation: rain (m/s) in every tick of the run, and in M more ticks.
        evapotranspiration: evapotranspiration of the whole bed (m3/s) in the same ticks.
        frost: 1 during frost, 0 without frost or if the temperature is unknown, in the same ticks.
        repeats_from: time from which the last record is repeated, because the window of M ticks
            extends beyond the end of the records; None if the records extend far enough.
        filled: whether each hour of the run was missing and has been filled, by quantity.
        filled_hours: number of filled hours; an hour in which more than one quantity was filled
            counts once.
        frost_hours: duration of frost in the run (h); None if the temperature is unknown.
        precipitation_in_frost: precipitation during frost (mm), which the model treats as rain.
    """

    def __init__(self, weather: Weather, site: Site, start: datetime, steps: int) -> None:
        """Prepare the values of the ticks 0..steps, and of the window after the last tick.

        Args:
            weather: hourly records that cover the run.
            site: site with the duration of a tick, the look-ahead, and the area of the bed.
            start: time of tick 0.
            steps: N, the last tick.

        Raises:
            ConfigurationError: if the records do not cover the run, or if an hour of the run is
                missing from the records.
        """
        tick_ns = round(site.tau * 1e9)
        before = (weather.end - start).total_seconds()
        if start < weather.first or steps * site.tau > before:
            raise ConfigurationError(
                f"contains records from {to_minutes(weather.first)} to {to_minutes(weather.end)}, "
                f"but the run starts at {to_minutes(start)} and lasts {duration(steps * site.tau)}",
                file=weather.source,
            )
        ticks = range(steps + site.M)
        offset_ns = round((start - weather.first) / timedelta(microseconds=1)) * 1000
        past = offset_ns + ticks[-1] * tick_ns >= weather.hours * _HOUR_NS
        self.repeats_from = weather.end if past else None
        # Only the hours of these ticks are kept: a record may have many years, and many runs.
        first, offset_ns = divmod(offset_ns, _HOUR_NS)
        part = weather.cut(first, first - (offset_ns + len(ticks) * tick_ns) // -_HOUR_NS)
        frost = np.zeros(part.hours) if part.frost is None else part.frost.astype(float)
        self.frost = PerTick(frost, offset_ns, tick_ns, ticks)
        _check_hours(weather, first + np.arange(self.frost.step(ticks[-1]) + 1))
        self.precipitation = rain_per_tick(part, offset_ns, tick_ns, ticks)
        depth = np.maximum(part.evapotranspiration, 0.0)  # dew does not count
        self.evapotranspiration = replace(self.frost, values=depth / 1000 / 86400 * site.a2)
        self._part = part
        self._other_demand = self.other_demand_of(site)
        # From tick 0 to the end of tick N-1; the window after it is not part of the run.
        run = self.frost.step(steps - 1) + 1  # hours
        begins = self.frost.first_tick(np.arange(1, run))
        frozen = frost[:run] * np.diff([0, *begins, steps])
        frozen_hours = float(frozen.sum()) * site.tau / 3600
        self.frost_hours = None if part.frost is None else frozen_hours
        rain = part.precipitation[:run]
        self.precipitation_in_frost = float((frozen * rain).sum() * site.tau / 3600)
        self._summarized = weather, site, range(first, first + run)
        hours = slice(first, first + run)
        self.filled = {
            quantity: marks[hours] for quantity, marks in weather.filled.items()
            if marks[hours].any()
        }
        self.filled_hours = int(np.any([*self.filled.values()], axis=0).sum())

    @property
    def notes(self) -> list[str]:
        """Sentences about filled and rare weather values, for readers of the results."""
        first = self._part.first
        return [
            *(
                f"{quantity} is missing at {', '.join(name_hours(first, marks))} and was filled"
                + (" with 0: rain in these hours is lost" if quantity == PRECIPITATION else "")
                for quantity, marks in self.filled.items()
            ),
            *self.summary["notes"],
            *([f"the column {OTHER_DEMAND} is not used, because the site has no other_demand"]
              if OTHER_DEMAND in self._part.values and self._other_demand is None else []),
        ]

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What the records contain in the hours of the run; see :func:`.summary.summarize`."""
        return summarize(*self._summarized)

    def other_demand_of(self, site: Site) -> PerTick | None:
        """Return what other uses than the roof of a site need (m3/s) in every tick; None for none.

        The values are from the column of the weather or, without one, those of the site for the
        months, which begin at midnight of standard time.
        """
        if site.other_flows is None:
            return None
        if OTHER_DEMAND in self._part.values:
            flows = self._part.values[OTHER_DEMAND] / 1000 / 3600
        else:
            first = self._part.first.timestamp() + 3600 * site.clock_offset
            seconds = int(first) + 3600 * np.arange(self._part.hours)
            months = seconds.astype("datetime64[s]").astype("datetime64[M]").astype(np.intp) % 12
            flows = np.array(site.other_flows)[months]
        return replace(self.frost, values=flows)

    def demand_varies(self, site: Site) -> bool:
        """Return whether other uses than the roof of a site do not need the same all year."""
        months = site.monthly_other_demand
        return months is not None and (OTHER_DEMAND in self._part.values or len({*months}) > 1)

    def at(self, tick: int) -> Hour:
        """Return the weather of a tick, and the tick until which it remains constant."""
        until = min(
            values.first_tick(values.step(tick) + 1)
            for values in (self.precipitation, self.evapotranspiration)
        )
        return Hour(
            self.precipitation[tick], self.evapotranspiration[tick], self.frost[tick],
            0.0 if self._other_demand is None else self._other_demand[tick],
            int(until) if tick < until else len(self.precipitation),
        )


def rain_per_tick(weather: Weather, offset_ns: int, tick_ns: int, ticks: range) -> PerTick:
    """Return the rain in every tick (m/s), at the finest resolution of the records.

    Args:
        weather: the records.
        offset_ns: time of tick 0 relative to hour 0 (ns).
        tick_ns: duration of a tick (ns).
        ticks: the ticks.
    """
    step_ns = _HOUR_NS // weather.finest_rain.shape[1]
    rain = weather.finest_rain.ravel() / 1000 / 3600
    if weather.minutes is None or _MINUTE_NS % tick_ns == 0 == offset_ns % tick_ns:
        return PerTick(rain, offset_ns, tick_ns, ticks, step_ns)
    edges = (offset_ns + tick_ns * np.arange(len(ticks) + 1)) / _MINUTE_NS
    beyond = max(0, math.ceil(edges[-1]) - len(rain))
    later = np.full(beyond, rain[-1])
    fallen = np.cumsum(np.nan_to_num(np.concatenate(([0.0], rain, later))))
    means = np.diff(np.interp(edges, np.arange(len(fallen)), fallen))
    means = np.maximum(means, 0.0) / (tick_ns / _MINUTE_NS)  # never negative by rounding
    return PerTick(means, 0, tick_ns, ticks, tick_ns)


def _check_hours(weather: Weather, hours: NDArray[np.int64]) -> None:
    """Reject a run that needs a missing hour that has not been filled."""
    way_out = "choose another period, or add values from another station"
    if weather.gaps == REFUSE:
        filled = "with 0 for rain, and the mean of three days before and after for the rest"
        way_out += f"; or fill the gaps (gaps: fill), in a command by its option gaps, {filled}"
    unknown = hours[np.isnan(weather.evapotranspiration[hours])]
    sources = FOR_EVAPOTRANSPIRATION if weather.method == FAO56 else ()
    for needed, quantities in (
        (hours, (PRECIPITATION, TEMPERATURE, OTHER_DEMAND)),
        (unknown, (*sources, EVAPOTRANSPIRATION)),
    ):
        for quantity in filter(weather.values.__contains__, quantities):
            _refuse_missing(weather, quantity, needed, way_out)


def _refuse_missing(weather: Weather, quantity: str, hours: NDArray[np.intp], more: str) -> None:
    """Reject records that lack a quantity for some hours; the message ends with ``more``."""
    unknown = np.isnan(weather.values[quantity][hours])
    if unknown.any():
        missing = np.zeros(weather.hours, np.bool_)
        missing[hours] = unknown
        why = ", ".join(name_hours(weather.first, missing))
        if quantity == EVAPOTRANSPIRATION and weather.method in COMPUTED:
            why += f": {weather.method} needs temperatures of the whole day in local standard time"
        raise ConfigurationError(f"{quantity} is missing at {why}; {more}", file=weather.source)


def select_records(weather: Weather, quantity: str, hours: NDArray[np.intp]) -> Array:
    """Return values of records; before and after them, the first or last value is repeated.

    Raises:
        ConfigurationError: if one of the values is missing.
    """
    index = np.clip(hours, 0, weather.hours - 1)
    _refuse_missing(
        weather, quantity, index,
        "a forecast needs it; fill the gaps (gaps: fill, or option gaps), or take another period",
    )
    return weather.values[quantity][index]
