"""Models of hourly forecasts: from records (perfect or with errors), or from an archive.

:mod:`greenroof_ros.forecast.issue` describes when forecasts are issued; a perfect forecast has
no time of issue, and a file states its own times of issue.

**Forecasts with errors** are wrong in the ways real forecasts are: missed rain, false alarms, wrong
times and wrong amounts. The normal variable z behind the recorded rain (see
:mod:`greenroof_ros.forecast.choice`) is forecast as

    f_j = s z + sqrt(s - s^2) zeta + sqrt(1 - s) xi_j

at each frequency, with the coherence s defined in :mod:`greenroof_ros.forecast.choice`. The first
two terms are known to the forecasters; zeta is an error common to all members, and xi_j is the
error of member j alone. Both zeta and xi_j have the spectrum of z, and so does f_j. It therefore
rains in forecasts as often as in the records. Any two members have the coherence s with each other,
and each member has the same coherence with the truth. The truth is therefore like an additional
member, and the spread of the ensemble is reliable. Finally, f_j + wetness is converted to rain and
multiplied by the amount. The wetness and the amount represent the systematic errors of a weather
service.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from datetime import datetime
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import from_epoch_ns, hours_since_1970, to_minutes
from greenroof_ros.forecast.choice import (
    ENSEMBLE,
    PERFECT,
    Climate,
    ForecastChoice,
    Skill,
    read_skill,
)
from greenroof_ros.forecast.issue import ISSUE_HOURS, SERVICE_DELAY_H, IssuedForecast, read_archive
from greenroof_ros.site.site import MUCH_RAIN, Site
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES
from greenroof_ros.weather.records import HOUR, Array
from greenroof_ros.weather.series import Weather, select_records

# Reach of a filter in multiples of the larger of memory and error of timing; exp(-6) remains.
_REACH = 6

# Leads of a ten-day forecast whose latest issue can be 12 h old (h).
_LEADS = 256

# Age in multiples of the persistence at which an issue's noise is dropped; exp(-3) of it remains.
_FORGOTTEN = 3

# Sweeps over all dry hours, after which the start hardly matters: in each sweep, the slowest mode
# of an autoregression with T = 8 h keeps 0.985 of itself.
_SWEEPS = 300

# Length of the blocks in which random numbers are drawn (hours since 1970).
_BLOCK = 512

# Blocks in a part of the records. One more is drawn on either side, so that the ends of the part
# have no effect within it.
_PART = 8

# Beginning of the seeds of z in dry hours, which depend only on the hours since 1970.
_RECORDS = 6158359


class ForecastModel:
    """Hourly forecasts: the information available in an hour about the hours that follow.

    This class provides perfect forecasts, which are the records themselves.
    """

    notes: tuple[str, ...] = ()
    """what could not be used as it was in a file's forecasts"""

    def __init__(self, weather: Weather) -> None:
        """Set the records; missing records are rejected only when a forecast needs them."""
        self._weather = weather

    def forecast(self, hour: int, hours: int) -> tuple[Array, Array, datetime | None]:
        """Return the latest forecast in a given hour of the records.

        Args:
            hour: index of the hour in the records.
            hours: number of hours to return, beginning with the given hour.

        Returns:
            Rain (mm/h), shape (members, hours); evapotranspiration (mm/day), shape (hours,); and
            the nominal time of issue, None if the forecast has none.

        Raises:
            ConfigurationError: if there is no forecast, or the forecast needs a record that is
                missing.
        """
        rain, evapotranspiration = (
            select_records(self._weather, quantity, hour + np.arange(hours))
            for quantity in (PRECIPITATION, EVAPOTRANSPIRATION)
        )
        return np.atleast_2d(rain), evapotranspiration, None

    def check(self, hours: range) -> None:
        """Check that there are forecasts from the first hour on, with all the records they need.

        Args:
            hours: indices of all hours in which forecasts are needed, or that they contain.

        Raises:
            ConfigurationError: as for :meth:`forecast`.
        """
        ForecastModel.forecast(self, hours.start, len(hours))

    def end(self, hour: int) -> datetime:
        """Return the time from which the values of an hour's latest forecast are assumed."""
        return self._weather.end


class FileModel(ForecastModel):
    """Forecasts from an archive; see :func:`greenroof_ros.forecast.issue.read_archive`.

    The latest forecast in an hour is the last forecast that was available at the start of the hour.
    After the end of a forecast, its values continue as :meth:`.IssuedForecast.ahead` describes.
    Without an evapotranspiration column, the recorded values are assumed to be known in advance. If
    the rain in the records is late (``rain_late``), forecasts of rain are equally late: otherwise
    the controller would expect rain that in fact fell an hour ago.
    """

    def __init__(
        self, issues: Sequence[IssuedForecast], weather: Weather, all_members: bool
    ) -> None:
        """Set the forecasts.

        Args:
            issues: at least one issue, in chronological order, all with equally many members.
            weather: the records of the run.
            all_members: whether to use all members of each forecast, or only member 0.
        """
        super().__init__(weather)
        self.notes = tuple(dict.fromkeys(note for issue in issues for note in issue.notes))
        self._issues = [issue.align(weather.first) for issue in issues]
        self.members = len(issues[0].rain) if all_members else 1
        self._late = weather.rain_late
        # An issue that arrives after a later one is of no use: only the latest counts.
        arrivals = [issue.available for issue in reversed(issues)]
        self._available = [*itertools.accumulate(arrivals, min)][::-1]

    def forecast(self, hour: int, hours: int) -> tuple[Array, Array, datetime | None]:
        """Return the forecast; see :class:`ForecastModel`."""
        issue, lead = self._newest(hour)
        rain, evapotranspiration = issue.ahead(lead, hours, self._late)
        if evapotranspiration is None:
            evapotranspiration = select_records(
                self._weather, EVAPOTRANSPIRATION, np.arange(hour, hour + hours)
            )
        return rain[: self.members], evapotranspiration, issue.issued

    def check(self, hours: range) -> None:
        """Check the first forecast, and the records if needed; see :class:`ForecastModel`."""
        self.forecast(hours.start, len(hours))

    def end(self, hour: int) -> datetime:
        """Return the end of the forecast, or of the records if they are needed and end earlier."""
        issue, _ = self._newest(hour)
        if EVAPOTRANSPIRATION in issue.values:  # which is not late
            return issue.end
        return min(issue.end + self._late * HOUR, self._weather.end)

    def _newest(self, hour: int) -> tuple[IssuedForecast, int]:
        """Return the latest forecast in a given hour, and its age (h)."""
        now = self._weather.first + hour * HOUR
        number = bisect.bisect_right(self._available, now - self._late * HOUR) - 1
        if number < 0:
            first = to_minutes(self._available[0] + self._late * HOUR)
            raise ConfigurationError(
                f"has no forecast that is available before {first}, but the run needs one at "
                f"{to_minutes(now)}", file=self._issues[0].file,
            )
        issue = self._issues[number]
        return issue, (now - issue.issued) // HOUR


def _find_normal(climate: Climate, rain: Array, first: int, hours: NDArray[np.intp]) -> Array:
    """Return the normal variable z (1) of hours of the records.

    The rain of a wet hour determines its z. The z of a dry hour is only known to be at most c; it
    is drawn repeatedly from its distribution given its neighbours (Gibbs sampling; Geman and Geman,
    IEEE Trans. PAMI 6:721, 1984), every other hour at a time. The z of a missing hour is drawn in
    the same way, without this limit. The z of a dry hour amid rain is therefore close to that of a
    wet hour, and the z of an hour in a dry week is far below c.

    A draw depends only on the hour since 1970, and not on the order of the requests. Three weeks or
    more from the ends of the records, a draw does not depend on these ends either.

    Args:
        climate: climate of the rain.
        rain: rain in every hour of the records (mm), NaN if missing.
        first: hours since 1970 at the first hour.
        hours: indices of the hours; outside the records, z is that of the first or last hour.
    """
    index = np.clip(hours, 0, len(rain) - 1)
    parts = (index + first) // (_PART * _BLOCK)
    normal = np.empty(len(index))
    for part in np.unique(parts):
        here = parts == part
        # The part's first hour, and the range of its hours with a margin on either side.
        begin = int(part) * _PART * _BLOCK - first
        low, high = max(begin - _BLOCK, 0), begin + (_PART + 1) * _BLOCK
        of_part = _draw_normal(climate, rain[low:high].tobytes(), first + low)
        normal[here] = of_part[index[here] - low]
    return normal


@lru_cache(maxsize=64)
def _draw_normal(climate: Climate, records: bytes, first: int) -> Array:
    """Return z (1) of every hour; see :func:`_find_normal`.

    Results are cached, because a study needs them for each of its seeds.

    Args:
        climate: climate of the rain.
        records: rain in every hour (mm), NaN if missing, as the bytes of an array.
        first: hours since 1970 at the first hour.
    """
    from scipy.special import ndtr, ndtri

    rain = np.frombuffer(records)
    missing = np.isnan(rain)
    drawn = missing | (rain == 0)
    ceiling = np.where(missing, np.inf, climate.threshold)
    # Factor from the neighbours' sum to an hour's mean, and the hour's standard deviation.
    near = np.exp(-1 / climate.memory)
    pull = np.full(len(rain), near / (1 + near**2))
    spread = np.full(len(rain), np.sqrt((1 - near**2) / (1 + near**2)))
    pull[[0, -1]], spread[[0, -1]] = near, np.sqrt(1 - near**2)
    odd = (np.arange(len(rain)) + first) % 2 == 1
    turns = [np.flatnonzero(drawn & odd), np.flatnonzero(drawn & ~odd)]
    normal = np.zeros(len(rain) + 2)  # with one more hour on either side, which has no weight
    normal[1:-1][~drawn] = climate.normal(rain[~drawn])
    blocks = range(first // _BLOCK, (first + len(rain) - 1) // _BLOCK + 1)
    chances = [np.random.default_rng([_RECORDS, block % 2**32]) for block in blocks]
    begin = first - blocks.start * _BLOCK
    for _ in range(_SWEEPS):
        # The same number for an hour since 1970, no matter which hours are requested.
        numbers = np.concatenate([chance.random(_BLOCK) for chance in chances])[begin:]
        for hours in turns:
            mean = pull[hours] * (normal[hours] + normal[hours + 2])
            share = numbers[hours] * ndtr((ceiling[hours] - mean) / spread[hours])
            # 1e-300: about the lowest normal number that can be computed
            normal[hours + 1] = mean + spread[hours] * ndtri(np.maximum(share, 1e-300))
    return normal[1:-1]


class ErrorModel(ForecastModel):
    """Forecasts made from records, with errors; the module docstring describes the method.

    Errors are correlated from forecast to forecast: zeta and xi of a forecast are sums over the
    white noise of this forecast and of earlier ones, weighted by exp(-age / persistence). The noise
    depends only on the seed, the member's number and the time of issue. The same seed therefore
    leads to the same forecasts, in whatever order they are requested.

    The evapotranspiration of a forecast is multiplied by exp(e g - e^2 / 2), whose mean is 1. The
    error e grows from 0 to the constant given by the skill in proportion to the unknown share of
    the rain, and g is drawn like xi. Members differ only in their rain. Member 0 equals the single
    forecast with the same seed.

    Forecasts are limited to the ranges in :data:`greenroof_ros.weather.quantities.QUANTITIES`.
    """

    def __init__(
        self, weather: Weather, seed: int, skill: Skill, members: int = 1, delay: float = 0.0
    ) -> None:
        """Prepare the forecasts for a seed.

        Args:
            weather: the records.
            seed: seed of the errors.
            skill: skill of the forecasts; lead times are counted from the time of issue.
            members: number of members in a forecast.
            delay: time that a service needs to compute a forecast, from the nominal time until the
                forecast is known (h); this time adds to the age of the latest forecast.
        """
        super().__init__(weather)
        self._delay = math.ceil(delay)  # an issue known within an hour counts from the next hour
        self._skill = skill
        self.members = members
        self._first = hours_since_1970(weather.first)
        timing = skill.timing * (_LEADS / 24) ** skill.timing_growth
        self._reach = math.ceil(_REACH * max(skill.climate.memory, timing))
        self._seed, persistence = seed, skill.persistence
        ages = np.arange(math.ceil(_FORGOTTEN * persistence / ISSUE_HOURS) + 1)
        weights = np.exp(-ages * ISSUE_HOURS / persistence)
        self._weights = weights / np.sqrt((weights**2).sum())
        # One issue is needed for several hours, and its noise also for the following issues.
        self._drawn: dict[tuple[int, int], tuple[Array, float]] = {}
        self._made: dict[tuple[int, int], tuple[Array, Array]] = {}

    def forecast(self, hour: int, hours: int) -> tuple[Array, Array, datetime | None]:
        """Return the forecast; see :class:`ForecastModel`."""
        _, evapotranspiration, _ = super().forecast(hour, hours)  # rejects missing records
        # A forecast is the latest until the next one is issued. If the records do not begin at a
        # whole hour of UTC, it counts from their first hour that begins after its issue.
        issue = (self._first + hour - self._delay) // ISSUE_HOURS * ISSUE_HOURS
        key = issue, ISSUE_HOURS - 1 + self._delay + hours
        if key not in self._made:
            self._made = {key: self._make(*key)}
        rain, factor = self._made[key]
        leads = slice(self._first + hour - issue, self._first + hour - issue + hours)
        dried = np.minimum(evapotranspiration * factor[leads], QUANTITIES[EVAPOTRANSPIRATION].high)
        return rain[:, leads].copy(), dried, from_epoch_ns(issue * 3600 * 10**9)

    def _make(self, issue: int, leads: int) -> tuple[Array, Array]:
        """Make the forecast issued at a given time (h since 1970).

        Returns:
            Rain (mm/h), shape (members, leads), and the factor of evapotranspiration (1), shape
            (leads,).
        """
        skill, blocks = self._skill, math.ceil(leads / _LEADS)
        signal, of_all, of_one, errors = _make_filters(skill, self._reach, blocks)
        hours = issue - self._first + np.arange(-self._reach, leads + self._reach)
        (common, *own), dry = self._noise(issue, len(hours))
        unknown = errors[:leads]
        normal = _find_normal(skill.climate, self._weather.precipitation, self._first, hours)
        known = _apply_filters(signal, normal) + _apply_filters(of_all, common)
        members = np.stack([known + _apply_filters(of_one, noise) for noise in own])
        rain = skill.climate.rain(members + skill.wetness * unknown)
        rain *= 1 + (skill.amount - 1) * unknown
        spread = skill.evapotranspiration * unknown
        return np.minimum(rain, MUCH_RAIN), np.exp(spread * dry - spread**2 / 2)

    def _noise(self, issue: int, hours: int) -> tuple[Array, float]:
        """Return the noise of a forecast, which is correlated with that of the previous forecast.

        Args:
            issue: time of issue (h since 1970).
            hours: length of the noise, which begins the same number of hours before every issue.

        Returns:
            The common noise, then the noise of every member, shape (1 + members, hours); and the
            noise of evapotranspiration (1).
        """
        longest = hours + ISSUE_HOURS * (len(self._weights) - 1)
        longest = math.ceil(longest / _BLOCK) * _BLOCK
        rain, dry = np.zeros((self.members + 1, hours)), 0.0
        drawn, self._drawn = self._drawn, {}
        for age, weight in enumerate(self._weights):
            begin = ISSUE_HOURS * age
            key = issue - begin, longest
            self._drawn[key] = noise, of_dry = drawn.get(key) or self._draw(*key)
            rain += weight * noise[:, begin : begin + hours]
            dry += weight * of_dry
        return rain, dry

    def _draw(self, issue: int, hours: int) -> tuple[Array, float]:
        """Draw the noise of a forecast, shape (1 + members, hours), and of evapotranspiration.

        The first hours do not depend on the number of hours that are drawn.
        """
        chances = [
            np.random.default_rng([self._seed, member, issue % 2**32])
            for member in range(self.members + 1)
        ]
        dry = float(chances[0].standard_normal())
        return np.stack([chance.standard_normal(hours) for chance in chances]), dry


@lru_cache(maxsize=8)
def _make_filters(skill: Skill, reach: int, blocks: int) -> list[Array]:
    """Return the filters for a number of blocks of leads, cached for the other seeds of a study.

    Each block has the same size, because rounding in a matrix sum may depend on the number of rows.

    Returns:
        For each lead (h, from 0 on), over ``reach`` hours before and after the lead: the weights of
        z, of the errors that all members share, and of each member's own errors, each of shape
        (leads, 2 reach + 1); and the standard deviation of the unknown part of z (1), shape
        (leads,).
    """
    filters = [_make_block(skill, reach, _LEADS * n + np.arange(_LEADS)) for n in range(blocks)]
    return [np.concatenate(parts) for parts in zip(*filters, strict=True)]


def _make_block(skill: Skill, reach: int, leads: NDArray[np.intp]) -> tuple[Array, ...]:
    def weights(response: Array) -> Array:
        circle = np.fft.irfft(response, hours, axis=1)
        return np.concatenate((circle[:, -reach:], circle[:, : reach + 1]), axis=1)

    hours = 4 * reach  # a circle large enough that its two sides do not meet
    power = skill.climate.spectrum(hours)
    frequencies = np.arange(2 * reach + 1) / hours
    # At the start of the hour of issue, the rest of that hour is not known: its middle counts.
    coherence = skill.coherence(np.maximum(leads, 0.5), frequencies)
    common = weights(np.sqrt((coherence - coherence**2) * power))
    own = weights(np.sqrt((1 - coherence) * power))
    # The mean over the circle; all frequencies but the first and last count twice.
    twice = np.full(len(power), 2.0)
    twice[[0, -1]] = 1.0
    unknown = (1 - coherence**2) @ (twice * power) / hours
    # The variance beyond the filters' reach is added within it.
    within = (common**2).sum(axis=1) + (own**2).sum(axis=1)
    scale = np.sqrt(np.divide(unknown, within, out=np.zeros(len(leads)), where=within > 0))
    return weights(coherence), common * scale[:, None], own * scale[:, None], np.sqrt(unknown)


def _apply_filters(weights: Array, values: Array) -> Array:
    """Apply the filter of every lead to the hours around the lead.

    The result is computed row by row, so that the value at a lead does not depend on the number of
    leads.

    Args:
        weights: weights of the filters, shape (leads or more, width).
        values: value of every hour, shape (leads + width - 1,).
    """
    windows = sliding_window_view(values, weights.shape[1])
    return np.asarray((weights[: len(windows)] * windows).sum(axis=1))


def make_model(
    choice: ForecastChoice, weather: Weather, site: Site, all_members: bool
) -> ForecastModel:
    """Make the chosen forecast model.

    Args:
        choice: the chosen model.
        weather: the records of the run.
        site: site, whose location must be near the location in a forecast file.
        all_members: whether to use all members of an ensemble, or only member 0.

    Raises:
        ConfigurationError: if the forecast file is invalid.
    """
    if choice.file is not None:
        return FileModel(read_archive(choice.file, site, choice.delay), weather, all_members)
    if choice.model == PERFECT:
        return ForecastModel(weather)
    members = choice.members if all_members and choice.model == ENSEMBLE else 1
    delay = SERVICE_DELAY_H if choice.delay is None else choice.delay
    return ErrorModel(weather, choice.seed, read_skill(choice.skill), members, delay)
