"""Models of hourly forecasts: of records as they are or with errors, and of an archive's issues.

When they are issued, :mod:`greenroof_ros.formats.records` says; a perfect forecast has no
issues, and a file has its own. The present hour is observed, not forecast;
:class:`greenroof_ros.forecast.resampling.SteppedForecast` takes it from the records.

**With errors** forecasts are wrong as real ones are: missed rain, false alarms, wrong times and
amounts. What the records' rain is made of, z of :mod:`greenroof_ros.forecast.skill`, is forecast as

    f_j = s z + sqrt(s - s^2) zeta + sqrt(1 - s) xi_j

at each frequency, with the coherence s given there. The first two terms are what the forecasters
know; zeta is what they have wrong all alike, xi_j what member j of an ensemble has of its own. All
have the spectrum of z, and so has f_j: it rains in forecasts as often as in the records. Any two
members have the coherence s with each other, as each has with what comes; so what comes is like one
more member, and the ensemble's spread is what it claims. Only after that is rain made of f_j +
wetness, and multiplied by the amount: what a service has wrong always.
"""

from __future__ import annotations

import bisect
import math
from abc import ABC, abstractmethod
from datetime import datetime, timedelta
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import hours_since_1970, to_minutes
from greenroof_ros.forecast.choice import PERFECT, ForecastChoice
from greenroof_ros.forecast.dressing import chosen_archive
from greenroof_ros.forecast.skill import Climate, Skill, read_skill
from greenroof_ros.formats.records import (
    EVAPOTRANSPIRATION,
    HOUR,
    ISSUE_HOURS,
    PRECIPITATION,
    QUANTITIES,
    SERVICE_DELAY_H,
    Archive,
    Issue,
    newest_issue,
)
from greenroof_ros.model.site import Site
from greenroof_ros.weather.series import Weather, records_at, refuse_between_hours

Array = NDArray[np.float64]

# A filter reaches as many times the longest of memory and error of timing: exp(-6) is left then.
_REACH = 6

# The leads (h) of a forecast of ten days, whose latest issue is up to 12 h old.
_LEADS = 256

# So many times the persistence ago, an issue is forgotten; exp(-3) of it is left then.
_FORGOTTEN = 3

# Sweeps over all dry hours, after which next to nothing of the beginning is left: the slowest mode
# of an autoregression with T = 8 h keeps 0.985 of itself in a sweep.
_SWEEPS = 300

# Random numbers are drawn in blocks of so many hours since 1970.
_BLOCK = 512

# A part of the records is so many blocks, and one more on either side, after which nothing is left
# of where it ends.
_PART = 8

# Begins the seeds of what dry hours hide. It belongs to the records and is no forecast's.
_RECORDS = 6158359


class ForecastModel(ABC):
    """Hourly forecasts: what is known in an hour about those that follow."""

    def __init__(self, weather: Weather) -> None:
        """Take the records; missing ones are refused only when a forecast needs them."""
        self._weather = weather

    @abstractmethod
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

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return from when on these hours are not known but assumed; None if none are.

        That is the end of the records, if the hours are past it.
        """
        past = hour + hours > len(self._weather.precipitation)
        return self._weather.end if past else None


class PerfectModel(ForecastModel):
    """Knows the records themselves."""

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the records; see :class:`ForecastModel`."""
        index = np.arange(hour, hour + hours)
        rain = records_at(self._weather, PRECIPITATION, index)
        return rain[None, :], records_at(self._weather, EVAPOTRANSPIRATION, index)


class PersistenceModel(ForecastModel):
    """Forecasts that it will go on as it is.

    It rains in all hours as in the hour of issue. Evapotranspiration follows the day: as in the
    same hour of the last day that is known at the issue, or where the records do not have it, as
    in the hour of issue. No record after that is used.
    """

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


class FileModel(ForecastModel):
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
            ConfigurationError: its hours and the records' do not begin together.
        """
        super().__init__(weather)
        self._archive = archive
        refuse_between_hours(archive.issues, weather)
        self._late = weather.rain_late
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
        return super().repeats_from(hour, hours) if needed else None

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


class NormalRecords:
    """z of each hour of records.

    Hours with rain have theirs. A dry hour's is not known but that it is at most c; it is drawn as
    likely as it is given its neighbours, over and over (Gibbs sampling; Geman and Geman, IEEE
    Trans. PAMI 6:721, 1984), every other hour at a time. A missing hour's is drawn likewise,
    without that limit. So a dry hour amid rain is near to rain, and one amid a dry week is far from
    it.

    What is drawn depends on the hour since 1970 alone, and not on who asks for which hours first,
    nor, three weeks inside of them, on where the records begin and end.
    """

    def __init__(self, climate: Climate, rain: Array, first: int) -> None:
        """Take the records.

        Args:
            climate: of the rain.
            rain: of each hour (mm), NaN where missing, shape (hours,).
            first: hours since 1970 of the first.
        """
        self._climate, self._rain, self._first = climate, rain, first

    def at(self, hours: NDArray[np.intp]) -> Array:
        """Return z (1) of some hours by their index, of the first or last beyond the ends."""
        index = np.clip(hours, 0, len(self._rain) - 1)
        parts = (index + self._first) // (_PART * _BLOCK)
        normal = np.empty(len(index))
        for part in np.unique(parts):
            here = parts == part
            # A part's first hour, and its hours with a margin on either side.
            begin = int(part) * _PART * _BLOCK - self._first
            low, high = max(begin - _BLOCK, 0), begin + (_PART + 1) * _BLOCK
            of_part = _drawn(self._climate, self._rain[low:high].tobytes(), self._first + low)
            normal[here] = of_part[index[here] - low]
        return normal


@lru_cache(maxsize=64)
def _drawn(climate: Climate, records: bytes, first: int) -> Array:
    """Return z (1) of each hour; see :class:`NormalRecords`.

    It is kept, since a study asks for it for each of its seeds.

    Args:
        climate: of the rain.
        records: rain of each hour (mm), NaN where missing, the bytes of an array.
        first: hours since 1970 of the first.
    """
    from scipy.special import ndtr, ndtri

    rain = np.frombuffer(records)
    missing = np.isnan(rain)
    drawn = missing | (rain == 0)
    ceiling = np.where(missing, np.inf, climate.threshold)
    # What an hour's mean is of its neighbours' sum, and its standard deviation then.
    near = np.exp(-1 / climate.memory)
    pull = np.full(len(rain), near / (1 + near**2))
    spread = np.full(len(rain), np.sqrt((1 - near**2) / (1 + near**2)))
    pull[[0, -1]], spread[[0, -1]] = near, np.sqrt(1 - near**2)
    odd = (np.arange(len(rain)) + first) % 2 == 1
    turns = [np.flatnonzero(drawn & odd), np.flatnonzero(drawn & ~odd)]
    normal = np.zeros(len(rain) + 2)  # and one on either side, of no weight
    normal[1:-1][~drawn] = climate.normal(rain[~drawn])
    blocks = range(first // _BLOCK, (first + len(rain) - 1) // _BLOCK + 1)
    chances = [np.random.default_rng([_RECORDS, block % 2**32]) for block in blocks]
    begin = first - blocks.start * _BLOCK
    for _ in range(_SWEEPS):
        # The same for an hour since 1970, whichever hours are asked for.
        numbers = np.concatenate([chance.random(_BLOCK) for chance in chances])[begin:]
        for hours in turns:
            mean = pull[hours] * (normal[hours] + normal[hours + 2])
            share = numbers[hours] * ndtr((ceiling[hours] - mean) / spread[hours])
            # 1e-300: as far below as a normal number can be
            normal[hours + 1] = mean + spread[hours] * ndtri(np.maximum(share, 1e-300))
    return normal[1:-1]


class ErrorModel(ForecastModel):
    """Forecasts of records, with errors; see the module.

    Errors follow one another from issue to issue: zeta and xi of an issue are sums over white noise
    of the issues until then, weighted by exp(-age / persistence). Each noise is drawn from the
    seed, the member's number and the time of issue alone: the same seed gives the same forecasts,
    whoever asks, when, and in whichever order.

    The evapotranspiration of an issue is multiplied by exp(e g - e^2 / 2), whose mean is 1;
    e grows from 0 to the skill's constant as the unknown share of the rain does, and g is drawn as
    xi is. Members differ in the rain only. Member 0 is the single forecast of the same seed.

    More than :data:`greenroof_ros.formats.records.QUANTITIES` believes is never forecast.
    """

    def __init__(
        self, weather: Weather, seed: int, skill: Skill, members: int = 1, delay: float = 0.0
    ) -> None:
        """Take what the forecasts are made of.

        Args:
            weather: the records.
            seed: of the errors.
            skill: how good the forecasts are; its leads count from the time of issue.
            members: how many an issue has.
            delay: h after its time from which an issue is known, while a service's would be
                computed: the newest is then as much older.
        """
        super().__init__(weather)
        self._delay = math.ceil(delay)  # what is known within an hour counts from the next on
        self._skill = skill
        self.members = members
        self._normal = NormalRecords(
            skill.climate, weather.precipitation, hours_since_1970(weather.first)
        )
        timing = skill.errors.timing * (_LEADS / 24) ** skill.errors.timing_growth
        self._reach = math.ceil(_REACH * max(skill.climate.memory, timing))
        self._seed, persistence = seed, skill.errors.persistence
        ages = np.arange(math.ceil(_FORGOTTEN * persistence / ISSUE_HOURS) + 1)
        weights = np.exp(-ages * ISSUE_HOURS / persistence)
        self._weights = weights / np.sqrt((weights**2).sum())
        # Twice as many as an issue needs: nothing that the next needs, too, makes room for it.
        self._drawn = lru_cache(maxsize=2 * len(weights))(self._draw)
        self._newest = lru_cache(maxsize=1)(self._make)  # it is asked for hour after hour

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast; see :class:`ForecastModel`."""
        issue, issued = newest_issue(self._weather.first, hour - self._delay)
        records = np.arange(hour, hour + hours)
        records_at(self._weather, PRECIPITATION, records)  # refuses missing ones
        evapotranspiration = records_at(self._weather, EVAPOTRANSPIRATION, records)
        leads = ISSUE_HOURS - 1 + self._delay + hours
        rain, factor = self._newest(issue, issued, leads)
        lead = hour - issued
        return (
            rain[:, lead : lead + hours].copy(),
            np.minimum(
                evapotranspiration * factor[lead : lead + hours],
                QUANTITIES[EVAPOTRANSPIRATION][2],
            ),
        )

    def _make(self, issue: int, issued: int, leads: int) -> tuple[Array, Array]:
        """Make the forecast of an issue (h since 1970; index of its hour in the records).

        Returns:
            Rain (mm/h), shape (members, leads), and what evapotranspiration is multiplied by (1),
            shape (leads,).
        """
        filters = _filters(self._skill, self._reach, math.ceil(leads / _LEADS))
        hours = np.arange(issued - self._reach, issued + leads + self._reach)
        (common, *own), dry = self._noise(issue, len(hours))
        known = _filtered(filters.signal, self._normal.at(hours))
        known += _filtered(filters.common, common)
        members = np.stack([known + _filtered(filters.own, noise) for noise in own])
        errors, unknown = self._skill.errors, filters.unknown[:leads]
        rain = self._skill.climate.rain(members + errors.wetness * unknown)
        rain *= 1 + (errors.amount - 1) * unknown
        spread = errors.evapotranspiration * unknown
        return (
            np.minimum(rain, QUANTITIES[PRECIPITATION][2]),
            np.exp(spread * dry - spread**2 / 2),
        )

    def _noise(self, issue: int, hours: int) -> tuple[Array, float]:
        """Return the white noise of an issue, which resembles the noise of the issue before.

        Args:
            issue: h since 1970.
            hours: how many, the first as far before each issue.

        Returns:
            The noise of all members and of each, shape (1 + members, hours); and of
            evapotranspiration.
        """
        longest = hours + ISSUE_HOURS * (len(self._weights) - 1)
        rain = np.zeros((self.members + 1, hours))
        dry = 0.0
        for age, weight in enumerate(self._weights):
            begin = ISSUE_HOURS * age
            noise, of_dry = self._drawn(issue - begin, -(-longest // _BLOCK) * _BLOCK)
            rain += weight * noise[:, begin : begin + hours]
            dry += weight * of_dry
        return rain, dry

    def _draw(self, issue: int, hours: int) -> tuple[Array, float]:
        """Draw what an issue adds, shape (1 + members, hours), and for evapotranspiration.

        The first hours are the same however many there are.
        """
        chances = [
            np.random.default_rng([self._seed, member, issue % 2**32])
            for member in range(self.members + 1)
        ]
        dry = float(chances[0].standard_normal())
        return np.stack([chance.standard_normal(hours) for chance in chances]), dry


class _Filters(NamedTuple):
    """What each lead (h, from 0 on) makes of the hours about it, so many on either side: reach."""

    signal: Array
    """weights of z, shape (leads, 2 reach + 1)"""
    common: Array
    """of the errors that all members share, likewise"""
    own: Array
    """of each member's own errors, likewise"""
    unknown: Array
    """standard deviation of what is not known of z (1), shape (leads,)"""


@lru_cache(maxsize=8)
def _filters(skill: Skill, reach: int, blocks: int) -> _Filters:
    """Return the filters of so many blocks of leads; a study needs them for each seed.

    Always as many leads at a time, as sums in a matrix may round by the number of its rows.
    """
    filters = [_filters_of(skill, reach, _LEADS * n + np.arange(_LEADS)) for n in range(blocks)]
    return _Filters(*map(np.concatenate, zip(*filters, strict=True)))


def _filters_of(skill: Skill, reach: int, leads: NDArray[np.intp]) -> _Filters:
    """Return the filters of some leads."""

    def weights(response: Array) -> Array:
        """Of filters with these responses."""
        circle = np.fft.irfft(response, hours, axis=1)
        return np.concatenate((circle[:, -reach:], circle[:, : reach + 1]), axis=1)

    hours = 4 * reach  # a circle so large that its two sides do not meet
    power = skill.climate.spectrum(hours)
    frequencies = np.arange(2 * reach + 1) / hours
    coherence = skill.coherence(leads.astype(np.float64), frequencies)
    common = weights(np.sqrt((coherence - coherence**2) * power))
    own = weights(np.sqrt((1 - coherence) * power))
    # The mean over the circle; all frequencies but the first and the last stand for two.
    twice = np.full(len(power), 2.0)
    twice[[0, -1]] = 1.0
    unknown = (1 - coherence**2) @ (twice * power) / hours
    # What lies beyond the filters' reach is given back to what lies within.
    within = (common**2).sum(axis=1) + (own**2).sum(axis=1)
    scale = np.sqrt(np.divide(unknown, within, out=np.zeros(len(leads)), where=within > 0))
    return _Filters(
        weights(coherence), common * scale[:, None], own * scale[:, None], np.sqrt(unknown)
    )


def _filtered(weights: Array, values: Array) -> Array:
    """Return what filters make of the hours about each lead.

    Row by row, so that a lead's number does not depend on how many leads there are.

    Args:
        weights: shape (leads or more, width).
        values: of each hour, shape (leads + width - 1,).
    """
    windows = sliding_window_view(values, weights.shape[1])
    filtered: Array = (weights[: len(windows)] * windows).sum(axis=1)
    return filtered


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
