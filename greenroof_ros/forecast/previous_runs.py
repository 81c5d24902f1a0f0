"""Forecasts of which only how long before each was made is known: Open-Meteo's previous runs.

``previous_dayN`` of an hour is the newest forecast of it that was at least N x 24 h old
(Open-Meteo, Previous Runs API: "fixed lead-time offsets"). There are no runs in it, and nothing
that is newer than 24 h. So what was known of an hour at some time is that of the smallest N whose
age fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.issue import Issue
from greenroof_ros.forecast.issue_times import ISSUE_HOURS
from greenroof_ros.weather.records import HOUR

DAY_HOURS = 24


@dataclass(frozen=True)
class PreviousRuns:
    """A file of previous runs, or several that follow one another.

    Attributes:
        file: the first of them.
        line: of its first hour; None where there are no lines, or several files.
        first: start of the first hour.
        days: the series by N, mm/h, shape (hours,); NaN where missing.
    """

    file: Path
    line: int | None
    first: datetime
    days: dict[int, NDArray[np.float64]]

    @property
    def hours(self) -> int:
        """How many it has."""
        return len(next(iter(self.days.values())))

    def issues(self) -> list[Issue]:
        """Return what was known at 00, 06, 12 and 18 UTC of the hours that followed.

        With the lead l (h) from then to an hour's end, that is the value of the smallest N with
        24 N >= l that is not missing. An issue ends before the first hour of which none is known.

        Raises:
            ConfigurationError: nothing is known at all, or at none of these times.
        """
        leads = np.arange(DAY_HOURS * max(self.days))
        issues = []
        for start in self._starts(0, ISSUE_HOURS):
            rain = np.full(len(leads), np.nan)
            for day in sorted(self.days, reverse=True):
                values = self._at(day, start + leads)
                known = (leads + 1 <= DAY_HOURS * day) & ~np.isnan(values)
                rain[known] = values[known]
            missing = np.flatnonzero(np.isnan(rain))
            if missing.size:
                rain = rain[: missing[0]]
            if rain.size:
                issues.append(self._issue(start, rain))
        if not issues and all(np.isnan(series).all() for series in self.days.values()):
            raise ConfigurationError("has no precipitation: every value is missing", file=self.file)
        if not issues:
            raise ConfigurationError(
                "must have a value for an hour from 00, 06, 12 or 18 UTC on, when issues begin",
                file=self.file, line=self.line,
            )
        return issues

    def daily(self) -> list[Issue]:
        """Return one issue a day, at 00 UTC, of which each hour is of its own N alone.

        The hours from 24 (N - 1) to 24 N after it are those of N, so that each value of the file is
        in one issue, by the day that it stands for; missing ones are NaN. They are for
        verification: of :meth:`issues` four have the same value, and some that of another N.
        """
        last = max(self.days)
        issues = []
        for start in self._starts(-DAY_HOURS * last, DAY_HOURS):
            rain = np.full(DAY_HOURS * last, np.nan)
            for day in self.days:
                leads = np.arange(DAY_HOURS * (day - 1), DAY_HOURS * day)
                rain[leads] = self._at(day, start + leads)
            issues.append(self._issue(start, rain))
        return issues

    def _starts(self, begin: int, every: int) -> Iterator[int]:
        """Yield the hours from one on, counted from the first, that begin so often a day in UTC."""
        since_1970 = hours_since_1970(self.first)
        return (hour for hour in range(begin, self.hours) if (since_1970 + hour) % every == 0)

    def _at(self, day: int, hours: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return a day's values at some hours; NaN before the first and after the last."""
        series = self.days[day]
        inside = (hours >= 0) & (hours < len(series))
        return np.where(inside, series[np.clip(hours, 0, len(series) - 1)], np.nan)

    def _issue(self, start: int, rain: NDArray[np.float64]) -> Issue:
        line = None if self.line is None else self.line + max(start, 0)
        return Issue(self.first + start * HOUR, self.file, line, rain[None, :])


def join(parts: Sequence[PreviousRuns]) -> PreviousRuns:
    """Join the previous runs of several files; an hour that none has is missing.

    Raises:
        ConfigurationError: two files differ in a value, in the days that they have, or are not
            whole hours apart.
    """
    parts = sorted(parts, key=lambda part: part.first)
    first = parts[0]
    if len(parts) == 1:
        return first
    begins = [(part.first - first.first) // HOUR for part in parts]
    hours = max(begin + part.hours for begin, part in zip(begins, parts, strict=True))
    days = {day: np.full(hours, np.nan) for day in first.days}
    for begin, part in zip(begins, parts, strict=True):
        if part.days.keys() != days.keys() or (part.first - first.first) % HOUR:
            raise ConfigurationError(
                f"must have the days of {first.file.name}, and be whole hours from it",
                file=part.file, line=part.line,
            )
        for day, series in part.days.items():
            joined = days[day][begin : begin + part.hours]
            both = ~(np.isnan(joined) | np.isnan(series))
            differing = np.flatnonzero(both & (joined != series))
            if differing.size:
                hour = int(differing[0])
                raise ConfigurationError(
                    f"must be {joined[hour]:g} mm/h, as in {first.file.name} or a file after it: "
                    "files of an archive are of one model",
                    file=part.file, line=None if part.line is None else part.line + hour,
                    key=f"precipitation_previous_day{day}", value=float(series[hour]),
                )
            np.copyto(joined, series, where=~np.isnan(series))
    return PreviousRuns(first.file, None, first.first, days)
