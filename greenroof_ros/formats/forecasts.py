"""Forecasts as they were issued: single ones, and archives of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.formats.hourly import bridge_gaps
from greenroof_ros.model.look_ahead import MAX_MEMBERS

# Longest gap of temperature and evapotranspiration in a forecast that is bridged (h).
_MAX_BRIDGE_H = 6
# Global models run every six or twelve hours; some runs of a day may be missed.
_MAX_UNCHANGED = timedelta(days=1)
ISSUE_HOURS = 6
"""interval at which services start runs of a global model (h): at 00, 06, 12 and 18 UTC"""
SERVICE_DELAY_H = 6.0
"""time from a run's nominal time until a service provides it (h). Open-Meteo, Single Runs API:
"typically 4-6 hours for global models"."""


@dataclass(frozen=True)
class IssuedForecast:
    """A forecast from a file.

    Attributes:
        issued: nominal time, at which the first hour starts.
        file: file that it is from.
        line: its first line in the file; None if unknown.
        rain: rain rate (mm/h), shape (members, hours).
        evapotranspiration: rate (mm/day), shape (hours,); None if the file has none.
        temperature: air temperature (degC), shape (hours,); None if the file has none.
        available: when it arrived; None if it is the archive's delay after the nominal time.
        notes: what could not be used unchanged, in sentences.
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
        """The key by which issues are sorted: nominal time, then arrival."""
        return self.issued, self.available or self.issued

    def evapotranspiration_at(self, ahead: NDArray[np.intp]) -> NDArray[np.float64] | None:
        """Return evapotranspiration some hours ahead (mm/day); None if the file has none.

        After its end, the issue repeats its last day, or its last hour if it is shorter than a day.
        """
        if self.evapotranspiration is None:
            return None
        last = self.hours - 1
        index = ahead - 24 * np.maximum(-((last - ahead) // 24), 0)
        return self.evapotranspiration[np.where(index < 0, last, index)]


def join_members(numbered: Iterable[tuple[float, IssuedForecast]]) -> IssuedForecast:
    """Return one issue with all members, from (number, issue of this member alone) pairs.

    Members that end early are missing (NaN) from then on.

    Raises:
        ConfigurationError: if the numbers are not 0, 1, 2 and so on, or there are too many.
    """
    ordered = sorted(numbered, key=lambda member: member[0])
    numbers, issues = [number for number, _ in ordered], [issue for _, issue in ordered]
    first, wrong = issues[0], ""
    if numbers != list(range(len(numbers))):
        wrong = (
            f"has members {', '.join(f'{number:g}' for number in numbers)}; they must be 0, 1, 2 "
            "and so on, with each number used once"
        )
    elif len(numbers) > MAX_MEMBERS:
        wrong = f"has {len(numbers)} members; no more than {MAX_MEMBERS} are allowed"
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
    """Return an issue without missing values, and with notes on what was done.

    A missing hour of rain is replaced by the mean of its neighbours; gaps of temperature and
    evapotranspiration are bridged in the same way if they are no longer than six hours. A member
    that still has less than half the hours of the longest one is left out, and so is such a
    temperature. The issue ends where another member, evapotranspiration or temperature ends.

    Raises:
        ConfigurationError: if nothing is left.
    """
    rain = np.array([bridge_gaps(series, 1) for series in issue.rain])
    if issue.hours > 1:  # the first hour has one neighbour
        rain[:, 0] = np.where(np.isnan(rain[:, 0]), rain[:, 1], rain[:, 0])
    lengths = [_count_complete_hours(series) for series in rain]
    used = [number for number, hours in enumerate(lengths) if hours and 2 * hours >= max(lengths)]
    if not used:
        raise ConfigurationError(
            f"contains no precipitation after its run, {to_minutes(issue.issued)}", file=issue.file,
            line=issue.line,
        )
    notes = [
        f"member {number} is left out: it has {hours} hours, while others have {max(lengths)}"
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
            notes.append(f"temperature is left out: it covers {known} hours, while the other "
                f"quantities cover {hours}")
            temperature = None
        else:
            hours = min(hours, known)
    if hours < max(lengths):
        notes.append(f"ends after {hours} of {max(lengths)} hours: later values are missing")
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
    """Return the number of values before the first missing one."""
    return int(np.append(np.isnan(series), True).argmax())


class Repetition:
    """Detects forecasts that only repeat the previous one, as when a service's model stops."""

    def __init__(self) -> None:
        """Begin without a forecast."""
        self._newest: IssuedForecast | None = None
        self._since: datetime | None = None

    def follow(self, issue: IssuedForecast) -> str:
        """Follow a forecast; return a note if forecasts have not changed for a day, otherwise "".

        Only rain and temperature in the hours that both forecasts cover count.
        """
        before, self._newest = self._newest, issue
        if self._since is None or before is None or not _agree(before, issue):
            self._since = issue.order[1]
        if issue.order[1] - self._since < _MAX_UNCHANGED:
            return ""
        return (
            f"the forecasts have not changed since {to_minutes(self._since)}: they repeat a single "
            "model run, and are as old as that run"
        )


def _agree(before: IssuedForecast, issue: IssuedForecast) -> bool:
    """Return whether two forecasts are the same in the hours that both cover."""
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
    """Reject an issue of an archive that repeats the previous issue, or has a different form.

    Raises:
        ConfigurationError: if it repeats the issue, or has other quantities.
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
    """Forecasts as they were issued.

    Attributes:
        source: the file or directory.
        kind: kind of archive, in words.
        issues: at least one issue, in order of time, all with the same number of members.
        delay: time after the nominal time from which an issue is known (h).
        verified: the issues to verify, usually the same ones; their rain can be NaN.
        finest_lead: finest lead-time resolution at which it can be verified (h).
        notes: what could not be used unchanged, in sentences.
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
