"""Forecasts that are wrong as real ones are: missed rain, false alarms, wrong times and amounts.

What the records' rain is made of, z of :mod:`greenroof_ros.forecast.climate`, is forecast as

    f_j = s z + sqrt(s - s^2) zeta + sqrt(1 - s) xi_j

at each frequency, with the coherence s of :mod:`greenroof_ros.forecast.skill`. The first two terms
are what the forecasters know; zeta is what they have wrong all alike, xi_j what member j of an
ensemble has of its own. All have the spectrum of z, and so has f_j: it rains in forecasts as often
as in the records. Any two members have the coherence s with each other, as each has with what
comes; so what comes is like one more member, and the ensemble's spread is what it claims. Only
after that is rain made of f_j + wetness, and multiplied by the amount: what a service has wrong
always.
"""

from __future__ import annotations

import math
from datetime import datetime
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.climate import NormalRecords
from greenroof_ros.forecast.skill import Skill
from greenroof_ros.formats.records import (
    EVAPOTRANSPIRATION,
    ISSUE_HOURS,
    PRECIPITATION,
    QUANTITIES,
    newest_issue,
)
from greenroof_ros.weather.series import Weather, records_at

Array = NDArray[np.float64]

# A filter reaches as many times the longest of memory and error of timing: exp(-6) is left then.
_REACH = 6

# The leads (h) of a forecast of ten days, whose latest issue is up to 12 h old.
_LEADS = 256

# So many times the persistence ago, an issue is forgotten; exp(-3) of it is left then.
_FORGOTTEN = 3


class ErrorModel:
    """Forecasts with errors; see the module.

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

        Missing records are refused only when a forecast needs them.

        Args:
            weather: the records.
            seed: of the errors.
            skill: how good the forecasts are; its leads count from the time of issue.
            members: how many an issue has.
            delay: h after its time from which an issue is known, while a service's would be
                computed: the newest is then as much older.
        """
        self._weather = weather
        self._delay = math.ceil(delay)  # what is known within an hour counts from the next on
        self._skill = skill
        self.members = members
        self._normal = NormalRecords(
            skill.climate, weather.precipitation, hours_since_1970(weather.first)
        )
        self._filters = _filters(skill)
        self._noise = _Noise(seed, members, skill.errors.persistence)
        self._issue = (-1, -1)
        self._forecast = (np.empty((0, 0)), np.empty(0))

    def known(self, hour: int, hours: int) -> tuple[Array, Array]:
        """Return the forecast; see :class:`greenroof_ros.forecast.models.ForecastModel`."""
        issue, issued = newest_issue(self._weather.first, hour - self._delay)
        records = np.arange(hour, hour + hours)
        records_at(self._weather, PRECIPITATION, records)  # refuses missing ones
        evapotranspiration = records_at(self._weather, EVAPOTRANSPIRATION, records)
        leads = ISSUE_HOURS - 1 + self._delay + hours
        if self._issue != (issue, leads):
            self._forecast = self._make(issue, issued, leads)
            self._issue = (issue, leads)
        rain, factor = self._forecast
        lead = hour - issued
        return (
            rain[:, lead : lead + hours].copy(),
            np.minimum(
                evapotranspiration * factor[lead : lead + hours],
                QUANTITIES[EVAPOTRANSPIRATION][2],
            ),
        )

    def repeats_from(self, hour: int, hours: int) -> datetime | None:
        """Return the end of the records, if the hours are past it."""
        past = hour + hours > len(self._weather.precipitation)
        return self._weather.end if past else None

    def _make(self, issue: int, issued: int, leads: int) -> tuple[Array, Array]:
        """Make the forecast of an issue (h since 1970; index of its hour in the records).

        Returns:
            Rain (mm/h), shape (members, leads), and what evapotranspiration is multiplied by (1),
            shape (leads,).
        """
        filters = self._filters
        filters.prepare(leads)
        reach = filters.reach
        hours = np.arange(issued - reach, issued + leads + reach)
        common, own, dry = self._noise.of(issue, len(hours), reach)
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


class _Filters:
    """What each lead (h, from 0 on) makes of the hours about it.

    Attributes:
        reach: hours on either side.
        signal: weights of z, shape (leads, 2 reach + 1).
        common: of the errors that all members share, likewise.
        own: of each member's own errors, likewise.
        unknown: standard deviation of what is not known of z (1), shape (leads,).
    """

    def __init__(self, skill: Skill) -> None:
        """Prepare the first leads."""
        self._skill = skill
        errors = skill.errors
        timing = errors.timing * (_LEADS / 24) ** errors.timing_growth
        self.reach = math.ceil(_REACH * max(skill.climate.memory, timing))
        self.signal = self.common = self.own = np.empty((0, 2 * self.reach + 1))
        self.unknown = np.empty(0)
        self.prepare(_LEADS)

    def prepare(self, leads: int) -> None:
        """Prepare so many leads, if they are not.

        Always as many at a time, as sums in a matrix may round by the number of its rows.
        """
        while len(self.unknown) < leads:
            begin = len(self.unknown)
            signal, common, own, unknown = self._block(np.arange(begin, begin + _LEADS))
            self.signal = np.concatenate((self.signal, signal))
            self.common = np.concatenate((self.common, common))
            self.own = np.concatenate((self.own, own))
            self.unknown = np.concatenate((self.unknown, unknown))

    def _block(self, leads: NDArray[np.intp]) -> tuple[Array, Array, Array, Array]:
        """Return the weights of some leads, and what is unknown at them."""
        # A circle so large that its two sides do not meet.
        hours = 4 * self.reach
        power = self._skill.climate.spectrum(hours)
        frequencies = np.arange(2 * self.reach + 1) / hours
        coherence = self._skill.coherence(leads.astype(np.float64), frequencies)
        common = self._weights(np.sqrt((coherence - coherence**2) * power))
        own = self._weights(np.sqrt((1 - coherence) * power))
        # The mean over the circle; all frequencies but the first and the last stand for two.
        twice = np.full(len(power), 2.0)
        twice[[0, -1]] = 1.0
        unknown = (1 - coherence**2) @ (twice * power) / hours
        # What lies beyond the filters' reach is given back to what lies within.
        within = (common**2).sum(axis=1) + (own**2).sum(axis=1)
        scale = np.sqrt(np.divide(unknown, within, out=np.zeros(len(leads)), where=within > 0))
        return (
            self._weights(coherence), common * scale[:, None], own * scale[:, None],
            np.sqrt(unknown),
        )

    def _weights(self, response: Array) -> Array:
        """Return the weights of filters with these responses, shape (leads, 2 reach + 1)."""
        circle = np.fft.irfft(response, 4 * self.reach, axis=1)
        return np.concatenate((circle[:, -self.reach :], circle[:, : self.reach + 1]), axis=1)


@lru_cache(maxsize=8)
def _filters(skill: Skill) -> _Filters:
    """Return the filters of a skill; they are kept, since a study needs them for each seed."""
    return _Filters(skill)


class _Noise:
    """White noise of each issue, which is not far from the noise of the issue before."""

    def __init__(self, seed: int, members: int, persistence: float) -> None:
        """Take seed, number of members, and the persistence (h)."""
        self._seed = seed
        self._members = members
        ages = np.arange(math.ceil(_FORGOTTEN * persistence / ISSUE_HOURS) + 1)
        weights = np.exp(-ages * ISSUE_HOURS / persistence)
        self._weights = weights / np.sqrt((weights**2).sum())
        self._drawn: dict[int, tuple[Array, float]] = {}
        self._length = 0

    def of(self, issue: int, hours: int, before: int) -> tuple[Array, Array, float]:
        """Return the noise of an issue.

        Args:
            issue: h since 1970.
            hours: how many, the first of them ``before`` hours before the issue.
            before: see there.

        Returns:
            Of all members, shape (hours,); of each of them, shape (members, hours); and
            of evapotranspiration.
        """
        longest = hours + ISSUE_HOURS * (len(self._weights) - 1)
        ages = range(len(self._weights))
        issues = [issue - ISSUE_HOURS * age for age in ages]
        if longest > self._length:
            self._drawn, self._length = {}, longest
        self._drawn = {
            each: self._drawn[each] if each in self._drawn else self._draw(each)
            for each in issues
        }
        rain = np.zeros((self._members + 1, hours))
        dry = 0.0
        for age, each in zip(ages, issues, strict=True):
            noise, of_dry = self._drawn[each]
            begin = ISSUE_HOURS * age
            rain += self._weights[age] * noise[:, begin : begin + hours]
            dry += self._weights[age] * of_dry
        return rain[0], rain[1:], dry

    def _draw(self, issue: int) -> tuple[Array, float]:
        """Draw what an issue adds, shape (1 + members, hours), and for evapotranspiration.

        The first hours are the same however many there are.
        """
        chances = [
            np.random.default_rng([self._seed, member, issue % 2**32])
            for member in range(self._members + 1)
        ]
        dry = float(chances[0].standard_normal())
        return np.stack([chance.standard_normal(self._length) for chance in chances]), dry


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
