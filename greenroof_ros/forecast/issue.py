"""Issued forecasts, and archives of issued forecasts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import to_minutes
from greenroof_ros.site.horizon import MAX_MEMBERS
from greenroof_ros.weather.records import HOUR, Records, bridge_gaps

# Longest gap of temperature and evapotranspiration in a forecast that is bridged (h).
_MAX_BRIDGE_H = 6
# Global models run every six or twelve hours; some runs of a day may be missed.
_MAX_UNCHANGED = timedelta(days=1)
ISSUE_HOURS = 6
"""interval between the runs of a global model (h), at 00, 06, 12 and 18 UTC"""
SERVICE_DELAY_H = 6.0
"""Delay between a run's nominal time and its availability (h). Open-Meteo, Single Runs API:
"typically 4-6 hours for global models"."""


@dataclass(frozen=True)
class IssuedForecast:
    """A forecast that was read from a file.

    Attributes:
        issued: nominal time of issue, at which the first hour starts.
        file: file that contains the forecast.
        line: number of the forecast's first line in the file; None if unknown.
        rain: rain rate (mm/h), shape (members, hours).
        evapotranspiration: rate (mm/day), shape (hours,); None if the file does not contain it.
        temperature: air temperature (degC), shape (hours,); None if the file does not contain it.
        available: time of arrival; None if it follows from the archive's delay.
        notes: sentences about data that could not be used unchanged.
    """

    issued: datetime
    file: Path
    line: int | None
    rain: NDArray[np.float64]
    evapotranspiration: NDArray[np.float64] | None = None
    temperature: NDArray[np.float64] | None = None
    available: datetime | None = None
    notes: tuple[str, ...] = ()

    @property
    def hours(self) -> int:
        """Number of hours."""
        return len(self.rain[0])

    @property
    def order(self) -> tuple[datetime, datetime]:
        """Key for sorting issues: the nominal time, then the time of arrival."""
        return self.issued, self.available or self.issued

    def evapotranspiration_at(self, ahead: NDArray[np.intp]) -> NDArray[np.float64] | None:
        """Return the evapotranspiration (mm/day) for every hour ahead; None if the file has none.

        Beyond the end of the issue, the values of its last day are repeated, or the value of its
        last hour if the issue is shorter than a day.
        """
        if self.evapotranspiration is None:
            return None
        last = self.hours - 1
        index = ahead - 24 * np.maximum(-((last - ahead) // 24), 0)
        return self.evapotranspiration[np.where(index < 0, last, index)]


def join_members(numbered: Iterable[tuple[float, IssuedForecast]]) -> IssuedForecast:
    """Return one issue with all members, from pairs (number, issue with only this member).

    Members that end early are missing (NaN) in the remaining hours.

    Raises:
        ConfigurationError: if the numbers are not 0, 1, 2 and so on, or if there are too many
            members.
    """
    ordered = sorted(numbered, key=lambda member: member[0])
    numbers, issues = [number for number, _ in ordered], [issue for _, issue in ordered]
    first, wrong = issues[0], ""
    if numbers != list(range(len(numbers))):
        wrong = (
            f"has the members {', '.join(f'{number:g}' for number in numbers)}, but the members "
            "must be numbered 0, 1, 2 and so on, without gaps or repetitions"
        )
    elif len(numbers) > MAX_MEMBERS:
        wrong = f"has {len(numbers)} members, but at most {MAX_MEMBERS} are allowed"
    if wrong:
        raise ConfigurationError(
            f"the issue of {to_minutes(first.issued)} {wrong}", file=first.file, line=first.line
        )
    rain = np.full((len(issues), max(issue.hours for issue in issues)), np.nan)
    for row, issue in zip(rain, issues, strict=True):
        row[: issue.hours] = issue.rain[0]
    notes = tuple(note for issue in issues for note in issue.notes)
    return replace(first, rain=rain, notes=notes)


def mend_forecast(issue: IssuedForecast) -> IssuedForecast:
    """Return an issue without missing values, and with notes on the changes.

    A missing hour of rain is replaced by the mean of the adjacent hours. Gaps of up to six hours in
    temperature and evapotranspiration are filled by interpolation. A member that then covers less
    than half of the hours of the longest member is left out; so is the temperature if it covers
    less than half of the hours of the other quantities. The issue ends with the shortest of the
    remaining series.

    Raises:
        ConfigurationError: if the issue has no usable rain, or no usable evapotranspiration.
    """
    rain = np.array([bridge_gaps(series, 1) for series in issue.rain])
    if issue.hours > 1:  # the first hour has one neighbour
        rain[:, 0] = np.where(np.isnan(rain[:, 0]), rain[:, 1], rain[:, 0])
    lengths = [_count_complete_hours(series) for series in rain]
    used = [number for number, hours in enumerate(lengths) if hours and 2 * hours >= max(lengths)]
    if not used:
        raise ConfigurationError(
            "contains no precipitation after the time of its run, "
            f"{to_minutes(issue.issued)}", file=issue.file,
            line=issue.line,
        )
    notes = [
        f"member {number} is left out: it has {hours} hours, but the longest member has "
        f"{max(lengths)}"
        for number, hours in enumerate(lengths) if number not in used
    ]
    hours = min(lengths[number] for number in used)
    evapotranspiration, temperature = (
        series if series is None else bridge_gaps(series, _MAX_BRIDGE_H)
        for series in (issue.evapotranspiration, issue.temperature)
    )
    if evapotranspiration is not None:
        hours = min(hours, _count_complete_hours(evapotranspiration))
        if not hours:
            raise ConfigurationError(
                f"contains no evapotranspiration at {to_minutes(issue.issued)}", file=issue.file,
                line=issue.line,
            )
    if temperature is not None:
        known = _count_complete_hours(temperature)
        if 2 * known < hours:
            notes.append(
                f"temperature is left out: it covers {known} hours, but the other quantities cover "
                f"{hours}",
            )
            temperature = None
        else:
            hours = min(hours, known)
    if hours < max(lengths):
        notes.append(f"is used only for {hours} of {max(lengths)} hours, because later values are "
        "missing")
    count = int(np.isnan(issue.rain[used, :hours]).sum())
    if count:
        notes.append(f"{count} missing hours of precipitation were filled with the mean of the "
            "adjacent hours")
    return replace(
        issue, rain=rain[used, :hours],
        notes=(*issue.notes, *(
            f"{issue.file.name}, issue of {to_minutes(issue.issued)}: {note}" for note in notes
        )),
        evapotranspiration=None if evapotranspiration is None else evapotranspiration[:hours],
        temperature=None if temperature is None else temperature[:hours],
    )


def _count_complete_hours(series: NDArray[np.float64]) -> int:
    """Return the number of values before the first missing value."""
    return int(np.append(np.isnan(series), True).argmax())


class Repetition:
    """Detector of forecasts that only repeat the previous one, as when a model has stopped."""

    def __init__(self) -> None:
        """Start without a forecast."""
        self._newest: IssuedForecast | None = None
        self._since: datetime | None = None

    def follow(self, issue: IssuedForecast) -> str:
        """Process a forecast; return a note if forecasts have not changed for a day, otherwise "".

        Only rain and temperature in the hours that both forecasts cover are compared.
        """
        before, self._newest = self._newest, issue
        if self._since is None or before is None or not _agree(before, issue):
            self._since = issue.order[1]
        if issue.order[1] - self._since < _MAX_UNCHANGED:
            return ""
        return (
            f"the forecasts have not changed since {to_minutes(self._since)}: all of them "
            "contain the model run of that time"
        )


def _agree(before: IssuedForecast, issue: IssuedForecast) -> bool:
    """Return True if two forecasts are equal in the hours that both cover."""
    late = (issue.issued - before.issued) // timedelta(hours=1)
    hours = min(before.hours - late, issue.hours)
    return late >= 0 and hours > 0 and all(
        first is second is None or (
            first is not None and second is not None
            and np.array_equal(first[..., late : late + hours], second[..., :hours])
        )
        for first, second in (
            (before.rain, issue.rain), (before.temperature, issue.temperature),
        )
    )


def check_same_form(earlier: IssuedForecast, later: IssuedForecast) -> None:
    """Reject an issue that has the same time as the previous issue, or different quantities.

    Raises:
        ConfigurationError: if the issue has the same time or different quantities.
    """
    wrong, when = "", to_minutes(later.issued)
    if earlier.order == later.order:
        wrong = f"contains the issue of {when}, which is already in {earlier.file.name}"
    elif (earlier.evapotranspiration is None) != (later.evapotranspiration is None):
        wrong = f"must contain evapotranspiration if and only if {earlier.file.name} does"
    if wrong:
        raise ConfigurationError(wrong, file=later.file, line=later.line)


@dataclass(frozen=True)
class Archive:
    """An archive of issued forecasts.

    Attributes:
        source: file or directory of the archive.
        kind: description of the kind of archive.
        issues: at least one issue, in chronological order, all with the same number of members.
        delay: time from the nominal time of an issue until the issue is known (h).
        verified: issues to verify, usually equal to ``issues``; their rain can be NaN.
        finest_lead: finest resolution of lead time for verification (h).
        notes: sentences about data that could not be used unchanged.
    """

    source: Path
    kind: str
    issues: Sequence[IssuedForecast]
    delay: float
    verified: Sequence[IssuedForecast]
    finest_lead: int = 1
    notes: tuple[str, ...] = ()

    @property
    def members(self) -> int:
        """Number of members in every issue."""
        return len(self.issues[0].rain)


def align_to_hours(issues: Sequence[IssuedForecast], weather: Records) -> list[IssuedForecast]:
    """Shift forecasts to hours that begin at the same minute as those of the records.

    If the UTC offset of a location includes half an hour, the hours of its records begin between
    the hours of UTC. A forecast is then shifted to the next hour of the records, and each of its
    new hours is the weighted mean of the two original hours that it overlaps. A forecast of only
    one hour is left out.

    Raises:
        ConfigurationError: if no forecast is left.
    """
    resampled = []
    for issue in issues:
        late = (weather.first - issue.issued) % HOUR
        if late and issue.hours > 1:
            share = late / HOUR
            rain, evapotranspiration, temperature = (
                series if series is None
                else (1 - share) * series[..., :-1] + share * series[..., 1:]
                for series in (issue.rain, issue.evapotranspiration, issue.temperature)
            )
            assert rain is not None
            resampled.append(replace(
                issue, issued=issue.issued + late, rain=rain,
                evapotranspiration=evapotranspiration, temperature=temperature,
            ))
        elif not late:
            resampled.append(issue)
    if not resampled:
        raise ConfigurationError(
            "must contain more than one hour, or begin a whole number of hours before or after "
            f"{to_minutes(weather.first)}, when {weather.source} begins",
            file=issues[0].file, line=issues[0].line, key="issued",
            value=to_minutes(issues[0].issued),
        )
    return resampled
