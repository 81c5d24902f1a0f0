"""Models of hourly forecasts, which are issued at certain times and have errors.

A forecast is issued every 6 hours, at 00, 06, 12 and 18 UTC. It is known from its time of issue on
and is the newest until the next. Where records do not begin on a whole hour of UTC, an issue counts
from the first hour of the records that begins after it. The present hour is observed, not forecast;
:class:`greenroof_ros.forecast.resampling.SteppedForecast` takes it from the records. The issue that
is the newest where the records begin was made before them: it keeps its own time, and the first
record stands for the hours before it. A perfect forecast has no issues; a file has its own.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from datetime import datetime
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.forecast.archive import Archive, read_archive
from greenroof_ros.forecast.choice import PERFECT, ForecastChoice
from greenroof_ros.forecast.issue import ISSUE_HOURS, Issue
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import (
    EVAPOTRANSPIRATION,
    HOUR,
    PRECIPITATION,
    QUANTITIES,
    name_hours,
)
from greenroof_ros.weather.series import Weather

Array = NDArray[np.float64]

_EPOCH = datetime.fromisoformat("1970-01-01T00:00+00:00")

# Errors of size 1 have this standard deviation of the timing (h) at this lead (h), where that of
# the amount's logarithm is 1.
_TIMING_H, _LEAD_H = 4.0, 12.0

# Evapotranspiration follows the sun, and is known better than rain by far.
_EVAPOTRANSPIRATION_SHARE = 0.25


class ForecastModel(Protocol):
    """Hourly forecasts: what is known in an hour about those that follow."""

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast that is the newest in an hour of the records.

        Args:
            hour: index of the hour.
            hours: how many to return, that one first.

        Returns:
            Rain (mm/h), shape (members, hours), and evapotranspiration (mm/day), shape (hours,).

        Raises:
            ConfigurationError: there is no forecast, or a record that it is made of is missing.
        """
        ...

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return from when on these hours are only the last one repeated; None if none are."""
        ...


def make_model(
    choice: ForecastChoice, weather: Weather, site: Site, all_members: bool
) -> ForecastModel:
    """Make the chosen model.

    Args:
        choice: which.
        weather: the records that come true.
        site: its place on earth, to which a file of forecasts must be near.
        all_members: of an ensemble; otherwise its member 0 only.

    Raises:
        ConfigurationError: the file of forecasts is wrong.
    """
    if choice.file is not None:
        return FileModel(read_archive(choice.file, site, choice.delay), weather, all_members)
    if choice.model == "persistence":
        return PersistenceModel(weather)
    members = choice.members if all_members and choice.model == "ensemble" else 1
    if choice.model == PERFECT or (choice.size == 0 and members == 1):
        return PerfectModel(weather)
    return ErrorModel(weather, choice.seed, choice.size, members)


class PerfectModel:
    """Knows the records themselves."""

    def __init__(self, weather: Weather) -> None:
        """Take the records."""
        self._weather = weather

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the records; see :class:`ForecastModel`."""
        index = np.arange(hour, hour + hours)
        rain = _records_at(self._weather, PRECIPITATION, index)
        return rain[None, :], _records_at(self._weather, EVAPOTRANSPIRATION, index)

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return the end of the records, if the hours are past it."""
        past = hour + hours > len(self._weather.precipitation)
        return self._weather.end if past else None


class PersistenceModel:
    """Forecasts that it will go on as it is.

    The rain is for all hours that of the hour of issue. Evapotranspiration follows the day: it is
    that of the same hour of the last day that is known at the issue, or where the records do not
    have it, that of the hour of issue.
    """

    def __init__(self, weather: Weather) -> None:
        """Take the records; none after the hour of issue is used."""
        self._weather = weather

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast; see :class:`ForecastModel`."""
        weather = self._weather
        issued = max(_newest_issue(weather.first, hour)[1], 0)
        lead = hour - issued + np.arange(hours)
        before = issued + lead - 24 * -(-lead // 24)
        now = _records_at(weather, EVAPOTRANSPIRATION, np.array([issued]))
        evapotranspiration = np.where(
            before < 0, now, weather.evapotranspiration[np.maximum(before, 0)]
        )
        evapotranspiration = np.where(np.isnan(evapotranspiration), now, evapotranspiration)
        rain = np.full((1, hours), _records_at(weather, PRECIPITATION, np.array([issued])))
        return rain, evapotranspiration

    def repeats_from(self, hour: int, hours: int) -> None:
        """It needs no record of what is to come."""


class ErrorModel:
    """Knows the records, but with errors of time and amount that grow with the lead.

    With the lead l (h) from the issue to an hour's start, the hour's rain is multiplied by
    exp(s z - s^2 / 2), s = size sqrt(l / 12), the mean of which is 1. Before that everything is
    moved by 4 h x size sqrt(l / 12) z', later where z' > 0: what has fallen from the issue to the
    lead l is what the records have until l less that. So no water is made or lost; and nothing from
    before the issue comes after it. Evapotranspiration is not moved, and its factor is that of a
    quarter of the size, with z''.

    The standard normal z, z' and z'' are drawn once per issue and member, from the seed, the
    member's number and the time of issue alone: the same seed gives the same forecasts, whoever
    asks, when, and in whichever order. More than
    :data:`greenroof_ros.weather.records.QUANTITIES` believes is never forecast.

    Member 0 of an ensemble is the single forecast of the same seed. The others are that forecast
    with such errors once more: they scatter about what was forecast, as an ensemble's do, and not
    about what comes, which their mean would else give away. What comes differs from the forecast as
    they do. Members differ in the rain only.
    """

    def __init__(self, weather: Weather, seed: int, size: float, members: int = 1) -> None:
        """Take the records, the seed, the size of the errors (1) and the number of members."""
        self._weather = weather
        self._seed = seed
        self._size = size
        self.members = members

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast; see :class:`ForecastModel`."""
        issue, issued = _newest_issue(self._weather.first, hour)
        ends = np.arange(hour - issued, hour - issued + hours + 1)
        lead = ends[:-1]
        draws = [self._draw(issue, member) for member in range(self.members)]

        def records(leads: NDArray[np.intp]) -> Array:
            return _records_at(self._weather, PRECIPITATION, issued + leads)

        def forecast(leads: NDArray[np.intp]) -> Array:
            return self._disturbed(records, np.append(leads, leads[-1] + 1), draws[0])

        rain = np.stack([
            self._disturbed(forecast if member else records, ends, draw)
            for member, draw in enumerate(draws)
        ])
        evapotranspiration = _records_at(self._weather, EVAPOTRANSPIRATION, issued + lead)
        evapotranspiration *= _factor(_EVAPOTRANSPIRATION_SHARE * self._size, lead, draws[0][2])
        return (
            np.minimum(rain, QUANTITIES[PRECIPITATION][2]),
            np.minimum(evapotranspiration, QUANTITIES[EVAPOTRANSPIRATION][2]),
        )

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return the end of the records, if the hours, as they are moved, are past it."""
        issue, issued = _newest_issue(self._weather.first, hour)
        end = float(hour - issued + hours)
        furthest = end
        for member in range(self.members):
            read = self._read(np.array([end]), self._draw(issue, member)[1])
            if member:
                read = self._read(np.ceil(read), self._draw(issue, 0)[1])
            furthest = max(furthest, float(read[0]))
        past = issued + furthest > len(self._weather.precipitation)
        return self._weather.end if past else None

    def _draw(self, issue: int, member: int) -> tuple[float, float, float]:
        """Return z, z' and z'' of an issue (h since 1970) and a member."""
        normal = np.random.default_rng([self._seed, member, issue]).standard_normal(3)
        return float(normal[0]), float(normal[1]), float(normal[2])

    def _read(self, ends: NDArray[np.float64], late: float) -> Array:
        """Return until when (h since the issue) the records have fallen at these leads (h)."""
        moved: Array = ends - _TIMING_H * self._size * np.sqrt(ends / _LEAD_H) * late
        return np.maximum(moved, 0.0)

    def _disturbed(
        self,
        source: Callable[[NDArray[np.intp]], Array],
        ends: NDArray[np.intp],
        draw: tuple[float, float, float],
    ) -> Array:
        """Return a source's rain (mm/h) between these leads with errors, shape (ends - 1,)."""
        amount, late, _ = draw
        if not self._size:  # bit for bit: sums and their differences would round
            return source(ends[:-1])
        read = self._read(ends.astype(np.float64), late)
        low, high = math.floor(read[0]), max(math.ceil(read[-1]), math.floor(read[0]) + 1)
        fallen = np.concatenate(([0.0], np.cumsum(source(np.arange(low, high)))))
        at_ends = np.interp(read, np.arange(low, high + 1), fallen)
        moved = np.maximum(np.diff(at_ends), 0.0)  # interpolation rounds, too
        return moved * _factor(self._size, ends[:-1], amount)


class FileModel:
    """Forecasts of an archive; see :func:`greenroof_ros.forecast.archive.read_archive`.

    The newest is the last that was available by the start of the hour. Past its end its last hour
    is repeated. Without a column of evapotranspiration that of the records counts as known.
    """

    def __init__(self, archive: Archive, weather: Weather, all_members: bool) -> None:
        """Take the forecasts.

        Args:
            archive: of the forecasts.
            weather: the records that come true.
            all_members: of each issue; otherwise its member 0 only.

        Raises:
            ConfigurationError: its hours are not those of the records.
        """
        self._archive = archive
        self._weather = weather
        self._known_from = archive.known_from(weather)
        self.members = archive.members if all_members else 1

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast; see :class:`ForecastModel`."""
        issue, lead = self._newest(hour)
        index = np.minimum(np.arange(lead, lead + hours), issue.hours - 1)
        rain = issue.rain[: self.members, index]
        if issue.evapotranspiration is not None:
            return rain, issue.evapotranspiration[index]
        return rain, _records_at(self._weather, EVAPOTRANSPIRATION, np.arange(hour, hour + hours))

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return the end of the issue, or of records that it needs, if the hours are past it."""
        issue, lead = self._newest(hour)
        if lead + hours > issue.hours:
            return issue.issued + issue.hours * HOUR
        needed = issue.evapotranspiration is None
        past = needed and hour + hours > len(self._weather.precipitation)
        return self._weather.end if past else None

    def _newest(self, hour: int) -> tuple[Issue, int]:
        """Return the newest issue in an hour, and how long ago it was made (h)."""
        number = bisect.bisect_right(self._known_from, hour) - 1
        if number < 0:
            known = self._weather.first + self._known_from[0] * HOUR
            raise ConfigurationError(
                f"holds forecasts that are known from {to_minutes(known)} on, but the run needs "
                f"one at {to_minutes(self._weather.first + hour * HOUR)}",
                file=self._archive.source,
            )
        issue = self._archive.issues[number]
        return issue, hour - (issue.issued - self._weather.first) // HOUR


def _newest_issue(first: datetime, hour: int) -> tuple[int, int]:
    """Return when the newest forecast in an hour of the records was made.

    Args:
        first: start of hour 0.
        hour: index of the hour.

    Returns:
        Hours since 1970, and the index of the first hour of the records from then on, which is
        negative for one made before them.
    """
    since_1970 = (first - _EPOCH) // HOUR
    issue = (since_1970 + hour) // ISSUE_HOURS * ISSUE_HOURS
    return issue, issue - since_1970


def _records_at(weather: Weather, quantity: str, hours: NDArray[np.intp]) -> Array:
    """Return records; the first stands for those before it, and the last for those after it.

    Raises:
        ConfigurationError: one of them is missing.
    """
    series: Array = getattr(weather, quantity)
    index = np.clip(hours, 0, len(series) - 1)
    values = series[index]
    if np.isnan(values).any():
        missing = np.unique(index[np.isnan(values)])
        raise ConfigurationError(
            f"{quantity} is missing at {', '.join(name_hours(weather.first, missing))}, of which "
            "the run's forecasts are made; choose another window or another kind of forecast",
            file=weather.source,
        )
    return values


def _factor(size: float, lead: NDArray[np.intp], normal: float) -> Array:
    """Return what an amount is multiplied by at some leads (h); its mean over all draws is 1."""
    spread = size * np.sqrt(lead / _LEAD_H)
    factor: Array = np.exp(spread * normal - spread**2 / 2)
    return factor
