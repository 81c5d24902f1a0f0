"""Forecasts of which only how long before each was made is known: Open-Meteo's previous runs.

``previous_dayN`` of an hour is the newest forecast of it that was at least N x 24 h old
(Open-Meteo, Previous Runs API: "fixed lead-time offsets"). There are no runs in it, and nothing
that is newer than 24 h. So what was known of an hour at some time is that of the smallest N whose
age fits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.issue import ISSUE_HOURS, Issue
from greenroof_ros.weather.records import HOUR

_DAY_HOURS = 24


@dataclass(frozen=True)
class PreviousRuns:
    """A file of previous runs.

    Attributes:
        file: that it is.
        line: of its first hour; None where the file has no lines.
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
            ConfigurationError: nothing is known at all.
        """
        leads = np.arange(_DAY_HOURS * max(self.days))
        issues = []
        for start in self._starts(0, ISSUE_HOURS):
            rain = np.full(len(leads), np.nan)
            for day in sorted(self.days, reverse=True):
                values = self._at(day, start + leads)
                known = (leads + 1 <= _DAY_HOURS * day) & ~np.isnan(values)
                rain[known] = values[known]
            missing = np.flatnonzero(np.isnan(rain))
            if missing.size:
                rain = rain[: missing[0]]
            if rain.size:
                issues.append(self._issue(start, rain))
        if not issues:
            raise ConfigurationError("has no precipitation: every value is missing", file=self.file)
        return issues

    def daily(self) -> list[Issue]:
        """Return one issue a day, at 00 UTC, of which each hour is of its own N alone.

        The hours from 24 (N - 1) to 24 N after it are those of N, so that each value of the file is
        in one issue, by the day that it stands for; missing ones are NaN. They are for
        verification: of :meth:`issues` four have the same value, and some that of another N.
        """
        last = max(self.days)
        issues = []
        for start in self._starts(-_DAY_HOURS * last, _DAY_HOURS):
            rain = np.full(_DAY_HOURS * last, np.nan)
            for day in self.days:
                leads = np.arange(_DAY_HOURS * (day - 1), _DAY_HOURS * day)
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
