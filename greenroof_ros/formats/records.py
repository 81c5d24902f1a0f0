"""Contents of files: tables of cells, hourly records with their missing values, and forecasts."""

from __future__ import annotations

import csv
import itertools
import math
import re
from array import array
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_lines
from greenroof_ros.common.ranges import Range
from greenroof_ros.common.times import (
    DEFAULT_START,
    FIRST_YEAR,
    LAST_YEAR,
    hours_since_1970,
    parse_time,
    time_hint,
    to_minutes,
)
from greenroof_ros.model.look_ahead import MAX_MEMBERS

HOUR, MINUTE = timedelta(hours=1), timedelta(minutes=1)
PRECIPITATION = "precipitation"
EVAPOTRANSPIRATION = "evapotranspiration"
RADIATION = "solar radiation"
TEMPERATURE = "temperature"
HUMIDITY = "relative humidity"
DEW_POINT = "dew point"

Limits: TypeAlias = tuple[str, float, float]
"""A unit, and the smallest and the largest plausible value in it."""

NEARLY = {
    PRECIPITATION: 0.5, EVAPOTRANSPIRATION: 2.5, "wind speed": 1.0, RADIATION: 15.0,
    HUMIDITY: 5.0,
}
"""How far outside its range a value is set to the end of the range, in the quantity's unit.

Models round, and interpolate below 0: rain of -0.1 mm and radiation of -0.3 W/m2 are seen. A
pyranometer has an offset of up to 15 W/m2 at night (ISO 9060, first class). Dew is negative
evapotranspiration, of at most some 0.1 mm/h. A humidity sensor is off by up to 5 %.
"""

# Quantity: unit, smallest and largest plausible value. A value above the world record of an hour's
# rain, or of a day's evapotranspiration, shows a wrong unit.
QUANTITIES: dict[str, Limits] = {
    PRECIPITATION: ("mm/h", 0.0, 500.0),
    EVAPOTRANSPIRATION: ("mm/day", 0.0, 50.0),
    TEMPERATURE: ("degC", -90.0, 60.0),
    "dew point": ("degC", -90.0, 60.0),
    "wind speed": ("km/h", 0.0, 500.0),
    "station pressure": ("kPa", 50.0, 110.0),
    RADIATION: ("W/m2", 0.0, 1500.0),
    HUMIDITY: ("%", 0.0, 100.0),
}

MISSING = {"", "nan", "na", "n/a", "#n/a", "n/d", "m", "null", "none", "-", "--", "---", "missing"}
"""What stands for a missing value, in lower case."""
# Digits of numbers that do, besides nines.
_CODES = {
    "32767", "32768", "65535", "2147483647", "2147483648", "4294967295", "27315", "6999", "7999",
    "777", "7777", "888", "8888",
}
_HUGE = 1e15  # fill values of GRIB are larger
# Share of a column's values other than 0 that may be neither plausible nor a code: a wrong unit of
# rain shows in the few wettest hours.
_MOST_WRONG = 0.01
_MOST_NAMED = 3
# Equal cells of a table are kept once, for so many different ones.
_MOST_CELLS = 10_000
# The longest line that can be one cut off (bytes).
_LONGEST_LINE = 10_000
# A comment, or a spreadsheet's line that names the separator.
_NO_RECORD = re.compile(r'\s*("?#|sep=.$)')
_DECIMAL_COMMA = re.compile(r"^([-+]?\d*),(\d+)$", re.ASCII)

# What evapotranspiration is computed from, if it is not given.
FOR_EVAPOTRANSPIRATION = ("temperature", "dew point", "wind speed", "station pressure")


@dataclass(frozen=True)
class Records:
    """Consecutive hours; each record is for the hour that starts at its time.

    Attributes:
        files: where they come from, in order of time.
        first: start of the first hour, with its offset from UTC.
        values: of each quantity of :data:`QUANTITIES` that the files have, in its unit there, or of
            each forecast by its column, shape (hours,); NaN if missing.
        method: of the evapotranspiration among them; empty if there is none.
        shifted: quantities that the files have at the end of their hour, moved to its start.
        rain_late: delay of the rain's time (h): 1 if the files give rain at the end of its hour and
            it was not moved to the start, otherwise 0.
        filled: for each quantity, whether an hour was missing and filled, shape (hours,).
        left_out: what could not be used as it is, in sentences that name it.
        empty: quantities of the files without any value.
        places: latitude and longitude (degrees) of each file that gives them, by file.
        wind_height: height at which the wind was measured (m); None if it is in the site file.
    """

    files: tuple[Path, ...]
    first: datetime
    values: dict[str, NDArray[np.float64]]
    method: str = ""
    shifted: tuple[str, ...] = ()
    rain_late: int = 0
    filled: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    empty: tuple[str, ...] = ()
    places: dict[Path, tuple[float, float]] = field(default_factory=dict)
    wind_height: float | None = None

    @property
    def hours(self) -> int:
        """Number of hours."""
        return len(next(iter(self.values.values())))

    @property
    def source(self) -> str:
        """Name of all files, for messages and tables."""
        return name_files(self.files)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was done to the files' values, apart from filling gaps."""
        if not self.shifted:
            return self.left_out
        return (
            f"{' and '.join(self.shifted)} in the files are for the hour before their time, and "
            "were moved back an hour", *self.left_out,
        )


def by_hour(
    columns: Mapping[str, NDArray[np.float64]], hours: NDArray[np.intp]
) -> dict[str, NDArray[np.float64]]:
    """Return columns hour by hour, NaN in hours without a row.

    Args:
        columns: values by name, shape (rows,).
        hours: of each row, from 0.
    """
    values = {name: np.full(hours[-1] + 1, np.nan) for name in columns}
    for name, series in columns.items():
        values[name][hours] = series
    return values


def with_dew_point(values: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Return values with the dew point in place of relative humidity, by FAO-56 Eqs. 11 and 14."""
    rest = {name: series for name, series in values.items() if name != HUMIDITY}
    if HUMIDITY in values and TEMPERATURE in values:
        share, warmth = np.maximum(values[HUMIDITY], 1.0) / 100, values[TEMPERATURE]
        vapour = np.log(share) + 17.27 * warmth / (warmth + 237.3)
        dew_point = 237.3 * vapour / (17.27 - vapour)
        given = values.get(DEW_POINT, dew_point)
        rest[DEW_POINT] = np.where(np.isnan(given), dew_point, given)
    return rest


def bridged(series: NDArray[np.float64], longest: int) -> NDArray[np.float64]:
    """Return hourly values with gaps of at most ``longest`` hours bridged by a straight line."""
    filled = series.copy()
    for low, high in gaps(np.isnan(series)):
        if high - low <= longest and low > 0 and high < len(series):
            filled[low:high] = np.interp(
                np.arange(low, high), [low - 1, high], series[[low - 1, high]]
            )
    return filled


def name_files(files: Sequence[Path]) -> str:
    """Return one name for files: the path of a single one, or their number, first and last.

    Empty if there are none.
    """
    if not files:
        return ""
    if len(files) == 1:
        return str(files[0])
    return str(files[0].parent / f"{len(files)} files, {files[0].name} to {files[-1].name}")


def gaps(missing: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the gaps in which values are missing, each as (first, one past the last)."""
    padded = np.concatenate(([False], missing, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded))
    return [(int(low), int(high)) for low, high in zip(edges[::2], edges[1::2], strict=True)]


def name_hours(first: datetime, hours: Iterable[int]) -> list[str]:
    """Name hours by the spans that they form.

    Args:
        first: start of hour 0.
        hours: indices.

    Returns:
        One text for each span: ``2021-07-20T13:00-05:00`` for a single hour, otherwise the first
        and last hour and their number.
    """
    indices = np.sort(np.array(list(hours), dtype=np.intp))
    spans = []
    for span in np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1):
        times = [to_minutes(first + int(hour) * HOUR) for hour in span]
        if len(times) > 1:
            spans.append(f"{times[0]} to {times[-1]} ({len(times)} hours)")
        else:
            spans += times
    return spans


def join(parts: Sequence[Records]) -> Records:
    """Join the records of several files.

    They are sorted by time. A value that no file has is missing (NaN). If several files have it,
    they must agree. If hours of a file do not begin with hours of the first, each of its values is
    the mean of the two hours in which it lies; values of other files then go before.

    Raises:
        ConfigurationError: two files have different values for an hour, different quantities,
            methods of evapotranspiration or conventions of time. The message names both.
    """
    first = min(parts, key=lambda part: part.first)
    for part in parts:
        _check_alike(first, part)
    moved = [part for part in parts if (part.first - first.first) % HOUR]
    parts = [
        *sorted((part for part in parts if part not in moved), key=lambda part: part.first),
        *(_on_hours_of(first, part) for part in moved),
    ]
    begins = [(part.first - first.first) // HOUR for part in parts]
    hours = max(begin + part.hours for begin, part in zip(begins, parts, strict=True))
    values = {quantity: np.full(hours, np.nan) for quantity in first.values}
    for begin, part in zip(begins, parts, strict=True):
        for quantity, series in part.values.items():
            joined = values[quantity][begin : begin + part.hours]
            known = ~np.isnan(series)
            if part.source in [other.source for other in moved]:
                known &= np.isnan(joined)
            unequal = np.flatnonzero(known & ~np.isnan(joined) & (joined != series))
            if unequal.size:
                hour = int(unequal[0])
                other = next(
                    part for at, part in zip(begins, parts, strict=True)
                    if 0 <= begin + hour - at < part.hours
                    and not np.isnan(part.values[quantity][begin + hour - at])
                )
                raise ConfigurationError(
                    f"must be {joined[hour]:g}, as in {other.source}, or the files must not "
                    "overlap", file=part.source,
                    key=f"{quantity} at {to_minutes(part.first + hour * HOUR)}",
                    value=float(series[hour]),
                )
            joined[known] = series[known]
    parts = sorted(parts, key=lambda part: part.first)
    files = tuple(file for part in parts for file in part.files)
    left_out = tuple(note for part in parts for note in part.left_out)
    places = {file: place for part in parts for file, place in part.places.items()}
    return replace(first, files=files, values=values, left_out=left_out, places=places)


def _check_alike(first: Records, part: Records) -> None:
    for aspect, expected, present in (
        ("quantities", sorted(first.values), sorted(part.values)),
        ("method of evapotranspiration", [first.method], [part.method]),
        ("quantities for the hour before their time", first.shifted, part.shifted),
        ("delay of the rain in hours", [str(first.rain_late)], [str(part.rain_late)]),
    ):
        if expected != present:
            raise ConfigurationError(
                f"must have the same {aspect} as {first.source}, {', '.join(expected) or 'none'}; "
                f"it has {', '.join(present) or 'none'}",
                file=part.source,
            )


def _on_hours_of(first: Records, part: Records) -> Records:
    """Return records on hours that begin with another's, as local hours at UTC-3:30 do not."""
    late = (part.first - first.first) % HOUR
    share = late / HOUR
    return replace(
        part, first=part.first - late + HOUR,
        values={
            quantity: share * series[:-1] + (1 - share) * series[1:]
            for quantity, series in part.values.items()
        },
        left_out=(*part.left_out, (
            f"{part.source}: its hours begin {late // MINUTE} min after the hours of "
            f"{first.source}; each value is the mean of the two hours in which it lies"
        )),
    )


# Longest gap of temperature and evapotranspiration in a forecast that is bridged (h).
_LONGEST_BRIDGE = 6
ISSUE_HOURS = 6
"""Interval at which services start runs of a global model (h): at 00, 06, 12 and 18 UTC."""
SERVICE_DELAY_H = 6.0
"""Time from a run's nominal time until a service has it (h). Open-Meteo, Single Runs API:
"typically 4-6 hours for global models"."""


@dataclass(frozen=True)
class Issue:
    """A forecast of a file.

    Attributes:
        issued: its nominal time, at which its first hour starts.
        file: where it is from.
        line: its first line in the file; None if unknown.
        rain: mm/h, shape (members, hours).
        evapotranspiration: mm/day, shape (hours,); None if the file has none.
        temperature: of the air (degC), likewise.
        available: when it arrived; None for the archive's delay after its nominal time.
        notes: what could not be used as it is.
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
        """What issues are sorted by: nominal time, then arrival."""
        return self.issued, self.available or self.issued

    def evapotranspiration_at(self, ahead: NDArray[np.intp]) -> NDArray[np.float64] | None:
        """Return evapotranspiration some hours ahead (mm/day); None if the file has none.

        After its end the issue repeats its last day, or its last hour if it is shorter than a day.
        """
        if self.evapotranspiration is None:
            return None
        last = self.hours - 1
        index = ahead - 24 * np.maximum(-((last - ahead) // 24), 0)
        return self.evapotranspiration[np.where(index < 0, last, index)]


def ensemble(numbered: Iterable[tuple[float, Issue]]) -> Issue:
    """Return one issue of all members, each given as its number and an issue of that member alone.

    Members that end early are missing (NaN) from then on.

    Raises:
        ConfigurationError: the numbers are not 0, 1, 2 and so on, or there are too many.
    """
    ordered = sorted(numbered, key=lambda member: member[0])
    numbers, issues = [number for number, _ in ordered], [issue for _, issue in ordered]
    first, wrong = issues[0], ""
    if numbers != list(range(len(numbers))):
        wrong = (
            f"has members {', '.join(f'{number:g}' for number in numbers)}; they must be 0, 1, 2 "
            "and so on, each once"
        )
    elif len(numbers) > MAX_MEMBERS:
        wrong = f"has {len(numbers)} members; at most {MAX_MEMBERS} are allowed"
    if wrong:
        raise ConfigurationError(
            f"the issue of {to_minutes(first.issued)} {wrong}", file=first.file, line=first.line
        )
    rain = np.full((len(issues), max(issue.hours for issue in issues)), np.nan)
    for row, issue in zip(rain, issues, strict=True):
        row[: issue.hours] = issue.rain[0]
    notes = tuple(note for issue in issues for note in issue.notes)
    return replace(first, rain=rain, notes=notes)


def mended(issue: Issue) -> Issue:
    """Return an issue without missing values, with notes of what was done.

    A missing hour of rain has the mean of its neighbours, and temperature and evapotranspiration
    are bridged likewise for up to six hours. A member that still has less than half the hours of
    the longest is left out, and so is such a temperature. The issue ends where another member,
    evapotranspiration or temperature does.

    Raises:
        ConfigurationError: nothing is left.
    """
    rain = np.array([bridged(series, 1) for series in issue.rain])
    if issue.hours > 1:  # the first hour has one neighbour
        rain[:, 0] = np.where(np.isnan(rain[:, 0]), rain[:, 1], rain[:, 0])
    lengths = [_complete_hours(series) for series in rain]
    used = [number for number, hours in enumerate(lengths) if hours and 2 * hours >= max(lengths)]
    if not used:
        raise ConfigurationError(
            f"has no precipitation after its run, {to_minutes(issue.issued)}", file=issue.file,
            line=issue.line,
        )
    notes = [
        f"member {number} is left out: it has {hours} hours, and others {max(lengths)}"
        for number, hours in enumerate(lengths) if number not in used
    ]
    hours = min(lengths[number] for number in used)
    evapotranspiration, temperature = (
        series if series is None else bridged(series, _LONGEST_BRIDGE)
        for series in (issue.evapotranspiration, issue.temperature)
    )
    if evapotranspiration is not None:
        hours = min(hours, _complete_hours(evapotranspiration))
        if not hours:
            raise ConfigurationError(
                f"has no evapotranspiration at {to_minutes(issue.issued)}", file=issue.file,
                line=issue.line,
            )
    if temperature is not None:
        known = _complete_hours(temperature)
        if 2 * known < hours:
            notes.append(f"temperature is left out: it has {known} hours, and others {hours}")
            temperature = None
        else:
            hours = min(hours, known)
    if hours < max(lengths):
        notes.append(f"ends after {hours} of {max(lengths)} hours, from which something is missing")
    count = int(np.isnan(issue.rain[used, :hours]).sum())
    if count:
        notes.append(f"{count} missing hours of precipitation have the mean of their neighbours")
    return replace(
        issue, rain=rain[used, :hours],
        notes=(*issue.notes, *(
            f"{issue.file.name}, issue of {to_minutes(issue.issued)}: {note}" for note in notes
        )),
        evapotranspiration=None if evapotranspiration is None else evapotranspiration[:hours],
        temperature=None if temperature is None else temperature[:hours],
    )


def _complete_hours(series: NDArray[np.float64]) -> int:
    """Return the number of values before the first that is missing."""
    return int(np.append(np.isnan(series), True).argmax())


def check_alike(earlier: Issue, later: Issue) -> None:
    """Refuse an issue of an archive that repeats the issue before it, or has a different form.

    Raises:
        ConfigurationError: it repeats it, or has other quantities.
    """
    wrong, when = "", to_minutes(later.issued)
    if earlier.order == later.order:
        wrong = f"has the issue of {when}, which {earlier.file.name} has already"
    elif (earlier.evapotranspiration is None) != (later.evapotranspiration is None):
        wrong = f"must have a column of evapotranspiration, or none, like {earlier.file.name}"
    if wrong:
        raise ConfigurationError(wrong, file=later.file, line=later.line)


@dataclass(frozen=True)
class Archive:
    """Forecasts as they were issued.

    Attributes:
        source: the file or directory.
        kind: what it is, in words.
        issues: at least one, in order of time, all with the same number of members.
        delay: time after its nominal time from which an issue is known (h).
        verified: the issues to verify, mostly the same ones; their rain can be NaN.
        finest_lead: finest lead resolution at which it can be verified (h).
        notes: what could not be used as it is.
    """

    source: Path
    kind: str
    issues: Sequence[Issue]
    delay: float
    verified: Sequence[Issue]
    finest_lead: int = 1
    notes: tuple[str, ...] = ()

    @property
    def members(self) -> int:
        """Number of members of each issue."""
        return len(self.issues[0].rain)


def newest_issue(first: datetime, hour: int) -> tuple[int, int]:
    """Return the time of the issue that is the newest in an hour of the records.

    An issue counts as known from its time of issue on; callers subtract a service's delay from
    ``hour``. It is the newest until the next one. If records do not begin on a whole hour of UTC,
    an issue counts from the first hour of the records that begins after it. An issue made before
    the records keeps its own time; the first record then stands for the hours before it.

    Args:
        first: start of hour 0.
        hour: index of the hour.

    Returns:
        Hours since 1970, and the index of the first hour of the records from then on, negative if
        it was made before them.
    """
    since_1970 = hours_since_1970(first)
    issue = (since_1970 + hour) // ISSUE_HOURS * ISSUE_HOURS
    return issue, issue - since_1970


@dataclass(frozen=True)
class Unit:
    """A unit of a file, expressed in our unit: theirs = ours * per_ours + zero.

    Attributes:
        name: as the file writes it.
        per_ours: how many of it equal one of ours; 10 for hPa if ours is kPa.
        zero: its value at 0 of ours; 32 for degF.
    """

    name: str
    per_ours: float = 1.0
    zero: float = 0.0


class Table:
    """A header and columns of cells, without surrounding space.

    The rows are read when they are first needed, so that an error in one of them is found before
    the rest of the file is read.

    Attributes:
        file: where it is from.
        header: names of the columns.
        line: line number of the header; None if there are no lines, as in JSON.
        lines: line number of each row that was read; empty likewise.
        key: prefix of the columns in JSON, such as ``hourly.``
        notes: what could not be used as it is; :meth:`usable` adds to them.
    """

    def __init__(
        self, file: Path, columns: Collection[tuple[str, list[str]]], line: int | None = None,
        rows: Iterable[tuple[int, list[str]]] = (), key: str = "",
    ) -> None:
        """Prepare; only the first of the rows is read.

        Args:
            file: where it is from.
            columns: name and cells of each.
            line: of the header.
            rows: line and cells of each further row.
            key: prefix of the columns.
        """
        self.file, self.line, self.key = file, line, key
        self.header = [name for name, _ in columns]
        self.lines, self.notes = array("q"), list[str]()
        self._columns, self._in_order = dict(columns), [cells for _, cells in columns]
        self._cells: dict[str, str] = {}  # equal cells are kept once
        self._rows = iter(rows)
        for row in itertools.islice(self._rows, 1):
            self._add(row)

    @property
    def columns(self) -> dict[str, list[str]]:
        """Cells of each column, by its name; the whole file is read."""
        for row in self._rows:
            self._add(row)
        return self._columns

    def cell(self, column: str, row: int) -> str:
        """Return a cell of a row that was read."""
        return self._columns[column][row]

    def rows(self) -> Iterator[int]:
        """Yield the number of each row, counted from 0, as it is read."""
        first = self._in_order[0]
        row = 0
        while True:
            if row == len(first):
                further = next(self._rows, None)
                if further is None:
                    return
                self._add(further)
            yield row
            row += 1

    def _add(self, row: tuple[int, list[str]]) -> None:
        line, cells = row
        self.lines.append(line)
        if len(self._cells) > _MOST_CELLS:
            self._cells.clear()
        for column, cell in zip(self._in_order, cells, strict=True):
            column.append(self._cells.setdefault(cell, cell))

    def refuse(
        self, expected: str, column: str | None = None, row: int | None = None
    ) -> ConfigurationError:
        """Return an error that gives the place and text of a cell, or of the header's cell."""
        if column is None or row is None:
            return ConfigurationError(expected, file=self.file, line=self.line, value=column)
        key = f"{self.key}{column.partition(' ')[0]}[{row}]" if self.key else column
        return ConfigurationError(
            expected, file=self.file, line=self.lines[row] if self.lines else None, key=key,
            value=self.cell(column, row),
        )

    def require(self, columns: Iterable[str], source: str) -> None:
        """Refuse a header unless it has each of these columns exactly once."""
        for column in columns:
            if column not in self.header:
                raise self.refuse(f"must have a column '{column}', as {source} have")
            if self.header.count(column) > 1:
                raise self.refuse("is the name of two columns", column)

    def quantities(self, example: str) -> Iterator[tuple[str, str, str]]:
        """Yield each column after the first, which is ``time``, with its quantity and unit.

        Args:
            example: of a column's name, for messages.

        Raises:
            ConfigurationError: the first column is not ``time``, or a name is unlike the example.
        """
        if self.header[0] != "time":
            raise self.refuse("the first column must be 'time'", self.header[0])
        for column in self.header[1:]:
            match = re.fullmatch(r"([^\[\]]+?)\s*\[([^\[\]]*)\]", column)
            if match is None:
                raise self.refuse(f"a column must be named like '{example}'", column)
            yield column, match[1], match[2]

    def require_header(self, columns: Sequence[str], why: str) -> None:
        """Refuse a header with other columns, or another order."""
        for cell, name in itertools.zip_longest(self.header, columns):
            if cell != name:
                wrong = "is one column too many" if name is None else f"the column must be '{name}'"
                raise self.refuse(f"{wrong}{why}", cell or "")

    def numbers(
        self, column: str, limits: Limits, unit: Unit | None = None, missing: Container[str] = (),
        hint: str = "",
    ) -> NDArray[np.float64]:
        """Return a column's values in our unit, shape (rows,); see :meth:`number`."""
        return np.array([
            self.number(column, row, limits, unit, missing, hint) for row in self.rows()
        ])

    def number(
        self, column: str, row: int, limits: Limits, unit: Unit | None = None,
        missing: Container[str] = (), hint: str = "",
    ) -> float:
        """Return a value in our unit.

        Args:
            column: its column.
            row: its row.
            limits: our unit, and the plausible range.
            unit: of the column; ours by default.
            missing: texts that stand for a missing value, which is NaN.
            hint: end of the message about a wrong value.

        Raises:
            ConfigurationError: the cell is not a number, or not a plausible one.
        """
        own_unit, low, high = limits
        unit = unit or Unit(own_unit)
        text = self.cell(column, row)
        if text in missing:
            return math.nan
        try:
            value = (float(text) - unit.zero) / unit.per_ours
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            low, high = (float(f"{end * unit.per_ours + unit.zero:g}") for end in (low, high))
            expected = Range(low, high, unit.name).expected(text)
            raise self.refuse(
                expected + (", or empty" if "" in missing else "") + hint, column, row
            )
        return value

    def usable(
        self, column: str, limits: Limits, unit: Unit | None = None, nearly: float = 0.0,
        hint: str = "", *, optional: bool = False,
    ) -> NDArray[np.float64]:
        """Return a column's values in our unit, shape (rows,); NaN for those that cannot be used.

        A value just outside the range is treated as its end. A code such as -999, a word, a
        negative value of what cannot be negative, and a few other values that are not plausible are
        left out. The notes name them all.

        Args:
            column: its name.
            limits: our unit, and the plausible range.
            unit: of the column; ours by default.
            nearly: how far outside the range is just outside.
            hint: end of the message about wrong values.
            optional: codes alone are as good as no column.

        Raises:
            ConfigurationError: too few of the values are plausible.
        """
        own_unit, low, high = limits
        unit = unit or Unit(own_unit)
        cells = self.columns[column]
        values = np.full(len(cells), np.nan)
        near: list[int] = []
        codes: list[int] = []
        wrong: list[int] = []
        zero, per_ours = unit.zero, unit.per_ours
        for row, text in enumerate(cells):
            try:
                number = float(text)
            except ValueError:
                if text.lower() not in MISSING:
                    (wrong if re.search(r"\d", text) else codes).append(row)
                continue
            value = (number - zero) / per_ours
            if low <= value <= high:
                values[row] = value
            elif text.lower() in MISSING:
                continue
            elif low - nearly <= value <= high + nearly:
                values[row] = min(max(value, low), high)
                near.append(row)
            else:
                below = number <= 0 <= low and value < low  # 0 of a pressure, too
                (codes if below or _is_code(text, number) else wrong).append(row)
        known = values[~np.isnan(values)]
        if len(wrong) > max(1.0, _MOST_WRONG * np.count_nonzero(known)) or (
            not known.size and (wrong or (codes and not optional))
        ):
            first = (wrong or codes)[0]
            self.numbers(column, limits, unit, {"", *cells[:first]} - {cells[first]}, hint)
        self._note(column, near, f"is set to the end of its range, {low:g} to {high:g} {own_unit}")
        self._note(column, codes + wrong, "is no plausible value, and is treated as missing")
        return values

    def _note(self, column: str, rows: Sequence[int], what: str) -> None:
        """Add a note about some cells of a column, with the first of them and their times."""
        if not rows:
            return
        times = next(
            (name for name in self.header if re.match(r"(date|time|issued)", name, re.I)),
            self.header[0],
        )
        named = [
            f"{self.columns[column][row]} at {self.columns[times][row]}"
            for row in sorted(rows)[:_MOST_NAMED]
        ]
        if len(rows) > _MOST_NAMED:
            named.append(f"{len(rows) - _MOST_NAMED} more")
        self.notes.append(f"{self.file.name}: {column} of {' and '.join(named)} {what}")

    def times(
        self, column: str, parse: Callable[[str], datetime] = parse_time,
        example: str = DEFAULT_START, hint: str = "", zone: tzinfo | None = None,
    ) -> Iterator[datetime]:
        """Yield a column's times; see :meth:`time`."""
        time: datetime | None = None
        for row in self.rows():
            time = self.time(column, row, parse, example, hint, zone, time)
            yield time

    def time(
        self, column: str, row: int, parse: Callable[[str], datetime] = parse_time,
        example: str = DEFAULT_START, hint: str = "", zone: tzinfo | None = None,
        before: datetime | None = None,
    ) -> datetime:
        """Return a time.

        Args:
            column: its column.
            row: its row.
            parse: returns a time, or raises ValueError; by default it reads ISO 8601 with an offset
                from UTC.
            example: of a time, for messages.
            hint: end of the message about a missing offset.
            zone: of a time without an offset, with its daylight saving time.
            before: time of the row before. In the hour that a clock shows twice, a time that is not
                later is the second.

        Raises:
            ConfigurationError: the cell is not a time, lacks its offset from UTC, or is in an hour
                that the zone's clocks skip.
        """
        text = self.cell(column, row)
        try:
            time = parse(text)
        except ValueError:
            raise self.refuse(
                f"must be a time such as {example}, {FIRST_YEAR} to {LAST_YEAR}"
                + time_hint(text), column, row,
            ) from None
        if time.tzinfo is None and zone is not None:
            time = self._on_clock(column, row, time, zone, before)
        if time.tzinfo is None:
            raise self.refuse(
                f"must give its offset from UTC, as in {DEFAULT_START}{hint}", column, row
            )
        return time

    def _on_clock(
        self, column: str, row: int, time: datetime, zone: tzinfo, before: datetime | None
    ) -> datetime:
        """Return a time of a zone's clock with its offset from UTC."""
        local = time.replace(tzinfo=zone)
        if local.astimezone(timezone.utc).astimezone(zone).replace(tzinfo=None) != time:
            raise self.refuse(
                f"is a time that clocks in {zone} skip; does the record stay on standard time? "
                "Then write the offset from UTC into each time", column, row,
            )
        if before is not None and local.astimezone(timezone.utc) <= before:
            local = local.replace(fold=1)
        offset = local.utcoffset()
        assert offset is not None
        return time.replace(tzinfo=timezone(offset))

    def hours(
        self, column: str, parse: Callable[[str], datetime] = parse_time,
        example: str = DEFAULT_START, zone: tzinfo | None = None, hint: str = "",
    ) -> tuple[datetime, NDArray[np.intp]]:
        """Return the first of a column's times, and how many hours after it each row is.

        An hour without a row is missing.

        Raises:
            ConfigurationError: a time is not a whole number of hours after the row before; or see
                :meth:`times`.
        """
        times = self.times(column, parse, example, hint, zone)
        first = next(times)
        hours = [0]
        for row, time in enumerate(times, start=1):
            hour, rest = divmod(time - first, HOUR)
            if rest or hour <= hours[-1]:
                expected = first.astimezone(time.tzinfo) + (hours[-1] + 1) * HOUR
                raise self.refuse(
                    f"must be {to_minutes(expected)}, or whole hours later: each row is an hour; "
                    "an hour without values is a row with empty cells, or none", column, row,
                )
            hours.append(hour)
        return first, np.array(hours, dtype=np.intp)


def _is_code(text: str, number: float) -> bool:
    """Return whether a value outside its range is one that stands for a missing value."""
    digits = text.lstrip("+-").replace(".", "").strip("0")
    return not abs(number) < _HUGE or digits in _CODES or re.fullmatch("9{2,}", digits) is not None


def read_table(file: Path, observed: Callable[[str], bool] = lambda _: False) -> Table:
    """Read a CSV file; see :func:`table_of`.

    Raises:
        ConfigurationError: it cannot be read, or is not a table.
    """
    return table_of(file, numbered_lines(read_lines(file)), observed)


def numbered_lines(text: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield the lines that are neither comments (``#``) nor without text, numbered from 1.

    Nor is a spreadsheet's first line that names the separator.
    """
    lines = itertools.chain.from_iterable(map(str.splitlines, text))
    for number, line in enumerate(lines, start=1):
        if line.strip(" ,;\t\x1a") and not _NO_RECORD.match(line):
            yield number, line


def table_of(
    file: Path, lines: Iterable[tuple[int, str]],
    observed: Callable[[str], bool] = lambda _: False,
) -> Table:
    """Return lines of CSV as a table; a quoted cell must end in its line.

    Cells are separated by commas, semicolons or tabs: what the header has most of. A number
    may have a decimal comma.

    Args:
        file: where the lines are from.
        lines: as :func:`numbered_lines` yields them, the header first.
        observed: whether a column is one of values. A row that ends before the first of them is an
            hour that is missing: its other cells are empty.

    Raises:
        ConfigurationError: there is no header or no row, a row has more or fewer cells than the
            header, or a quote is left open or followed by text. A row is refused when it is read;
            one that is cut off by the end of the file is only noted.
    """
    numbered = iter(lines)
    line, text = next(numbered, (0, ""))
    if not line:
        raise ConfigurationError("holds only comments; a header and records must follow", file=file)
    separator = max(",;\t", key=text.count)
    header = _cells(file, line, text, separator)
    while header and not header[-1]:  # separators at the end of each line
        header.pop()
    first = next((index for index, name in enumerate(header) if observed(name)), 0)

    def rows() -> Iterator[tuple[int, list[str]]]:
        begun = False
        for line, text in numbered:
            cells = _cells(file, line, text, separator)
            if begun and len(cells) < len(header) and text == _cut_line(file):
                table.notes.append(f"{file.name}: line {line} is cut off, and left out")
                return
            begun = True
            if len(cells) <= first:
                cells += [""] * (len(header) - len(cells))
            elif not any(cells[len(header) :]):
                del cells[len(header) :]
            if len(cells) != len(header):
                hint = ""
                if separator == "," and len(cells) > len(header):
                    hint = "; a decimal comma needs quotes, or semicolons between the cells"
                raise ConfigurationError(
                    f"must have {len(header)} cells, like the header, not {len(cells)}{hint}",
                    file=file, line=line,
                )
            yield line, cells

    table = Table(file, [(name, []) for name in header], line, rows())
    if not table.lines:
        raise ConfigurationError("has a header but no records", file=file)
    return table


def _cut_line(file: Path) -> str:
    """Return what follows a file's last line end: a line cut off, as where a logger lost power."""
    if not file.is_file():
        return ""
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - _LONGEST_LINE))
        return stream.read().rpartition(b"\n")[2].decode(errors="replace")


def _cells(file: Path, line: int, text: str, separator: str) -> list[str]:
    if '"' not in text:
        cells = text.split(separator)
    else:
        try:
            cells = next(csv.reader([text], delimiter=separator, strict=True))
        except csv.Error as error:
            raise ConfigurationError(f"is not valid CSV: {error}", file=file, line=line) from error
    return [
        _DECIMAL_COMMA.sub(r"\1.\2", cell.strip()) if "," in cell else cell.strip()
        for cell in cells
    ]
