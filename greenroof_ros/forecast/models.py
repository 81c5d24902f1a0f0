"""Models of hourly forecasts.

When they are issued, :mod:`greenroof_ros.formats.records` says; a perfect forecast has no
issues, and a file has its own. The present hour is observed, not forecast;
:class:`greenroof_ros.forecast.resampling.SteppedForecast` takes it from the records.
"""

from __future__ import annotations

import bisect
from datetime import datetime, timedelta
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.forecast.choice import PERFECT, ForecastChoice
from greenroof_ros.forecast.dressing import chosen_archive
from greenroof_ros.forecast.error_model import ErrorModel
from greenroof_ros.forecast.skill import read_skill
from greenroof_ros.formats.records import (
    EVAPOTRANSPIRATION,
    HOUR,
    PRECIPITATION,
    SERVICE_DELAY_H,
    Archive,
    Issue,
    newest_issue,
)
from greenroof_ros.model.site import Site
from greenroof_ros.weather.series import Weather, records_at, refuse_between_hours

Array = NDArray[np.float64]


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
        """Return from when on these hours are not known but assumed; None if none are."""
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
        ConfigurationError: the file of forecasts, of their dressing or their skill is wrong.
    """
    if choice.file is not None:
        return FileModel(chosen_archive(choice, site), weather, all_members)
    if choice.model == "persistence":
        return PersistenceModel(weather)
    members = choice.members if all_members and choice.model == "ensemble" else 1
    if choice.model == PERFECT:
        return PerfectModel(weather)
    delay = SERVICE_DELAY_H if choice.delay is None else choice.delay
    return ErrorModel(weather, choice.seed, read_skill(choice.skill), members, delay)


class PerfectModel:
    """Knows the records themselves."""

    def __init__(self, weather: Weather) -> None:
        """Take the records."""
        self._weather = weather

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the records; see :class:`ForecastModel`."""
        index = np.arange(hour, hour + hours)
        rain = records_at(self._weather, PRECIPITATION, index)
        return rain[None, :], records_at(self._weather, EVAPOTRANSPIRATION, index)

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return the end of the records, if the hours are past it."""
        past = hour + hours > len(self._weather.precipitation)
        return self._weather.end if past else None


class PersistenceModel:
    """Forecasts that it will go on as it is.

    It rains in all hours as in the hour of issue. Evapotranspiration follows the day: as in the
    same hour of the last day that is known at the issue, or where the records do not have it, as
    in the hour of issue.
    """

    def __init__(self, weather: Weather) -> None:
        """Take the records; none after the hour of issue is used."""
        self._weather = weather

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast; see :class:`ForecastModel`."""
        weather = self._weather
        issued = max(newest_issue(weather.first, hour)[1], 0)
        lead = hour - issued + np.arange(hours)
        before = issued + lead - 24 * -(-lead // 24)
        now = records_at(weather, EVAPOTRANSPIRATION, np.array([issued]))
        evapotranspiration = np.where(
            before < 0, now, weather.evapotranspiration[np.maximum(before, 0)]
        )
        evapotranspiration = np.where(np.isnan(evapotranspiration), now, evapotranspiration)
        rain = np.full((1, hours), records_at(weather, PRECIPITATION, np.array([issued])))
        return rain, evapotranspiration

    def repeats_from(self, hour: int, hours: int) -> None:
        """It needs no record of what is to come."""


class FileModel:
    """Forecasts of an archive; see :func:`greenroof_ros.formats.reading.read_archive`.

    The newest is the last that was available by the start of the hour. Past its end there is no
    rain, as after all forecasts, and the evapotranspiration of its last day, or of its last hour
    where it is shorter than a day. Without a column of evapotranspiration the records'
    counts as known. Where the records' rain is late (``rain_late``), forecasts of rain are as late.
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
        refuse_between_hours(archive.issues, weather)
        self._late = weather.records.rain_late
        # The hour of the records from whose start on each is known. Where their rain is late, so is
        # what is known of it: the controller would otherwise know of rain that fell an hour ago
        # that it is to come.
        delay = timedelta(hours=archive.delay + self._late)
        self._known_from = [
            -((weather.first - issue.issued - delay) // HOUR) for issue in archive.issues
        ]
        self.members = archive.members if all_members else 1

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast; see :class:`ForecastModel`."""
        issue, lead = self._newest(hour)
        ahead = np.arange(lead, lead + hours)
        of_rain = ahead - self._late
        there = of_rain < issue.hours
        rain = np.zeros((self.members, hours))
        rain[:, there] = issue.rain[: self.members, of_rain[there]]
        evapotranspiration = issue.evapotranspiration_at(ahead)
        if evapotranspiration is None:
            evapotranspiration = records_at(
                self._weather, EVAPOTRANSPIRATION, np.arange(hour, hour + hours)
            )
        return rain, evapotranspiration

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return the end of the issue, or of records that it needs, if the hours are past it."""
        issue, lead = self._newest(hour)
        needed = issue.evapotranspiration is None
        end = issue.hours + self._late * needed  # evapotranspiration is not late
        if lead + hours > end:
            return issue.issued + end * HOUR
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
