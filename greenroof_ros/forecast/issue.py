"""Issued forecasts, and the files and archives from which they are read.

Files of **this project's own form** contain issues with all their members; see
:func:`read_forecasts`. Files of **previous runs** of Open-Meteo (JSON, or CSV whose first column is
``time`` or ``datetime``, in UTC) contain ``precipitation_previous_day1`` to 7: for every hour, the
latest forecast that was at least N x 24 h old (Open-Meteo, Previous Runs API: "fixed lead-time
offsets"). They contain neither single runs nor forecasts newer than 24 h. The forecast of an hour
that was known at a given time is therefore the value with the smallest N that is old enough.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import hours_since_1970, to_minutes
from greenroof_ros.site.horizon import MAX_MEMBERS
from greenroof_ros.site.site import Place
from greenroof_ros.weather import quantities
from greenroof_ros.weather.description import END, TIME, Description
from greenroof_ros.weather.open_meteo import read_answer
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, TEMPERATURE
from greenroof_ros.weather.records import HOUR, Array, bridge_gaps, make_hours
from greenroof_ros.weather.table import Row, Rows, Table, arrange, read_table

SUFFIXES = (".csv", ".json")
"""suffixes of forecast files"""
ISSUE_HOURS = 6
"""interval between the runs of a global model (h), at 00, 06, 12 and 18 UTC"""
SERVICE_DELAY_H = 6.0
"""Delay between a run's nominal time and its availability (h). Open-Meteo, Single Runs API:
"typically 4-6 hours for global models"."""
# Longest gap of temperature and evapotranspiration in a forecast that is bridged (h).
_MAX_BRIDGE_H = 6
# The longest forecasts, those of ensembles, cover 36 days (h).
_MAX_HOURS = 36 * 24
_DAY_H = 24
# Ranges and columns of the values, by quantity; all columns in their order; the optional columns.
_RANGES = {
    name: Range(each.low, each.high, each.unit) for name, each in quantities.QUANTITIES.items()
    if name in (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE)
}
_COLUMNS = {name: f"{name} [{limits.unit}]" for name, limits in _RANGES.items()}
_NAMES = ["issued", "available", "time", "member", *_COLUMNS.values()]
_OPTIONAL = {"available", "member", _COLUMNS[EVAPOTRANSPIRATION], _COLUMNS[TEMPERATURE]}
_MEMBERS = Range(0.0, MAX_MEMBERS - 1.0, "(whole)")
_PREVIOUS = re.compile(r"precipitation_previous_day([1-7])")


@dataclass(frozen=True, order=True)
class IssuedForecast:
    """A forecast of consecutive hours; forecasts are sorted by time of issue, then of arrival.

    Attributes:
        issued: nominal time of issue, at which the first hour starts.
        available: time of arrival, from which on the forecast is known.
        file: file that contains the forecast.
        line: number of the forecast's first line in the file; None if unknown.
        values: precipitation (mm/h), shape (members, hours), and, if the file contains them,
            evapotranspiration (mm/day) and temperature (degC), shape (hours,), by quantity.
        notes: sentences about data that could not be used unchanged.
        finest_lead: finest resolution of the lead (h); more than 1 for a day of previous runs.
    """

    issued: datetime
    available: datetime
    file: Path
    line: int | None
    values: dict[str, Array]
    notes: tuple[str, ...] = ()
    finest_lead: int = 1

    @property
    def rain(self) -> Array:
        """Rain (mm/h), shape (members, hours)."""
        return self.values[PRECIPITATION]

    @property
    def hours(self) -> int:
        """Number of hours."""
        return len(self.rain[0])

    @property
    def end(self) -> datetime:
        """End of the last hour."""
        return self.issued + self.hours * HOUR

    def ahead(self, lead: int, hours: int, late: int = 0) -> tuple[Array, Array | None]:
        """Return the values from a lead on, which continue after the end of the issue.

        After the end, there is no rain. The evapotranspiration of the last day is repeated, or that
        of the last hour if the issue is shorter than a day.

        Args:
            lead: first lead time to return (h).
            hours: number of hours to return.
            late: delay of the rain (h).

        Returns:
            Rain (mm/h), shape (members, hours), and evapotranspiration (mm/day), shape (hours,), or
            None if the issue does not contain it.
        """
        rain = np.zeros((len(self.rain), hours))
        known = self.rain[:, lead - late : lead - late + hours]
        rain[:, : known.shape[1]] = known
        if EVAPOTRANSPIRATION not in self.values:
            return rain, None
        last, leads = self.hours - 1, np.arange(lead, lead + hours)
        index = leads - 24 * np.maximum(-((last - leads) // 24), 0)
        return rain, self.values[EVAPOTRANSPIRATION][np.where(index < 0, last, index)]

    def align(self, hours_from: datetime) -> IssuedForecast:
        """Return the forecast in hours that begin at the same minute as those of some records.

        If the UTC offset of a location includes half an hour, the hours of its records begin
        between the hours of UTC. The forecast then begins at the next hour of the records, and each
        of its new hours is the weighted mean of the two original hours that it overlaps. The last
        of them is assumed to continue.

        Args:
            hours_from: start of an hour of the records.
        """
        late = (hours_from - self.issued) % HOUR
        if not late:
            return self
        share = late / HOUR
        return replace(self, issued=self.issued + late, values={
            name: (1 - share) * series + share * series[..., [*range(1, self.hours), -1]]
            for name, series in self.values.items()
        })

    def repeats(self, earlier: IssuedForecast) -> bool:
        """Return whether the forecast only repeats the remaining hours of an earlier forecast."""
        late = (self.issued - earlier.issued) // HOUR
        return self.values.keys() == earlier.values.keys() and all(
            np.array_equal(earlier.values[name][..., late:], series, equal_nan=True)
            for name, series in self.values.items()
        )


def mend_forecast(issue: IssuedForecast) -> IssuedForecast:
    """Return an issue without missing rain and evapotranspiration, and with notes on the changes.

    A missing hour of rain is replaced by the mean of the adjacent hours. Gaps of up to six hours in
    temperature and evapotranspiration are filled by interpolation. A member that then covers less
    than half of the hours of the longest member is left out. The issue ends with the shortest of
    the remaining members, or with its evapotranspiration; a temperature can remain unknown (NaN).

    Raises:
        ConfigurationError: if the issue has no usable rain, or no usable evapotranspiration.
    """
    rain = np.array([bridge_gaps(series, 1) for series in issue.rain])
    if issue.hours > 1:  # the first hour has one neighbour
        rain[:, 0] = np.where(np.isnan(rain[:, 0]), rain[:, 1], rain[:, 0])
    lengths = _count_known(rain)
    used = 2 * lengths >= lengths.max()
    values = {PRECIPITATION: rain[used]} | {
        name: bridge_gaps(series, _MAX_BRIDGE_H)
        for name, series in issue.values.items() if name != PRECIPITATION
    }
    hours = min(_count_known(values[name]).min() for name in values if name != TEMPERATURE)
    if not hours:
        raise ConfigurationError(
            f"lacks a value for the hour of its issue, {to_minutes(issue.issued)}",
            file=issue.file, line=issue.line,
        )
    notes = [
        f"member {number} is left out: it has {lengths[number]} hours, but the longest member has "
        f"{lengths.max()}" for number in np.flatnonzero(~used)
    ]
    if count := int(np.isnan(issue.rain[used, :hours]).sum()):
        notes.append(f"{count} missing hours of precipitation were filled from adjacent hours")
    if hours < lengths.max():
        notes.append(f"is used only for {hours} of {lengths.max()} hours")
    return replace(
        issue, values={name: series[..., :hours] for name, series in values.items()},
        notes=(*issue.notes, *(
            f"{issue.file.name}, issue of {to_minutes(issue.issued)}: {note}" for note in notes
        )),
    )


def _count_known(series: Array) -> NDArray[np.intp]:
    """Return the number of values before the first missing value, along the last axis."""
    known = np.minimum.accumulate(~np.isnan(series), axis=-1)
    return np.asarray(known.sum(axis=-1))


# --- archives -------------------------------------------------------------------------------------


def read_archive(
    source: Path, site: Place, delay: float | None = None, *, daily: bool = False
) -> list[IssuedForecast]:
    """Return the issues of an archive, in chronological order, with equal numbers of members.

    An issue is known as soon as it is available, hours after its nominal time, because the model
    run has to be computed and distributed. The nominal time is the time of the run's observations,
    at which the first hour begins.

    Args:
        source: file, or directory with files in a single form.
        site: site that must be near the archive's position, if the archive states a position.
        delay: time from the nominal time of an issue until the issue is known (h); by default, the
            usual delay for the kind of archive.
        daily: True for verification: previous runs are then one issue per day, at 00 UTC, whose
            hours from 24 (N - 1) to 24 N contain the values of N. Every value is in exactly one
            issue, on the day to which it belongs; missing values are NaN.

    Raises:
        ConfigurationError: if a file does not conform to its form, if the files have different
            forms, or if an issue occurs twice.
    """
    files = [source]
    if source.is_dir():
        files = sorted(file for file in source.iterdir() if file.suffix in SUFFIXES)
    if not files:
        raise ConfigurationError("must contain forecast files, .csv or .json", file=source)
    if files[0].suffix != ".json" and read_table(files[0]).header[0] == "issued":
        issues = _join_own(files)
    else:
        issues = _make_issues(files, site, daily)
    if delay is None:
        return issues
    return [replace(issue, available=issue.issued + delay * HOUR) for issue in issues]


def _join_own(files: Sequence[Path]) -> list[IssuedForecast]:
    """Return the issues of files in this project's own form, with equal numbers of members.

    If an issue has fewer members than others, the other issues are reduced to the same number.

    Raises:
        ConfigurationError: if an issue repeats another issue.
    """
    issues = sorted(issue for file in files for issue in read_forecasts(file))
    for earlier, later in itertools.pairwise(issues):
        if (earlier.issued, earlier.available) == (later.issued, later.available):
            raise ConfigurationError(
                f"contains the issue of {to_minutes(later.issued)}, which is already in "
                f"{earlier.file.name}", file=later.file, line=later.line,
            )
    members = min(len(issue.rain) for issue in issues)
    return [
        replace(issue, values={**issue.values, PRECIPITATION: issue.rain[:members]}, notes=(
            *issue.notes, f"{members} members are used from every issue, as in the smallest issue"
        ))
        if len(issue.rain) > members else issue for issue in issues
    ]


# --- own form ------------------------------------------------------------------------------------


def read_forecasts(path: Path) -> list[IssuedForecast]:
    """Read a file of forecasts with one or more issues, and return them in chronological order.

    Lines that start with ``#`` are comments. The first other line is the header. The columns are
    ``issued``, ``available`` (the time of arrival; not before the time of issue), ``time``,
    ``member``, ``precipitation [mm/h]``, ``evapotranspiration [mm/day]`` and ``temperature
    [degC]``. All but ``issued``, ``time`` and ``precipitation`` are optional; of evapotranspiration
    and temperature, only the values of member 0 are used. Every other line contains the forecast
    issued at ``issued`` for the hour that starts at ``time`` (both in ISO 8601 format with a UTC
    offset). The hours of every issue and member are consecutive, and the first hour starts at the
    time of issue. Instead of an hour, the lines of an issue can be for a part of it, such as ten
    minutes; the mean of each whole hour is used. All issues have the members 0, 1, 2 and so on. An
    empty cell is missing; see :func:`mend_forecast`.

    Args:
        path: path of the file.

    Raises:
        ConfigurationError: if the file breaks any of these rules; the message names the line and
            the value.
    """
    table = read_table(path)
    columns = [name for name in _NAMES if name not in _OPTIONAL or name in table.header]
    table.require_header(columns, f"; the columns are {', '.join(map(repr, _NAMES))}")
    grouped = itertools.groupby(table.rows, lambda row: row.cells[: columns.index("time")])
    return sorted(_read_issue(table, rows) for _, rows in grouped)


def _read_issue(table: Table, rows: Iterator[Row]) -> IssuedForecast:
    """Return the issue in rows that have the same times of issue and arrival."""
    first = next(rows)
    issued = table.read_time(first, "issued")
    available = table.read_time(first, "available") if "available" in table.header else issued
    if available < issued:
        raise table.refuse("must not be before the time of issue", "available", first)
    columns = {name: column for name, column in _COLUMNS.items() if column in table.header}
    members = defaultdict[float, list[list[float]]](list)
    step = HOUR
    for row in itertools.chain([first], rows):
        member = table.read_number(row, "member", _MEMBERS) if "member" in table.header else 0.0
        time = table.read_time(row, "time")
        is_second = member == 0 and len(members[0]) == 1
        if is_second and issued < time and not HOUR % (time - issued):
            step = time - issued
        expected = issued + len(members[member]) * step
        if time != expected or time >= issued + _MAX_HOURS * HOUR:
            raise table.refuse(
                f"must be {to_minutes(expected.astimezone(time.tzinfo))}: every forecast must have "
                f"up to {_MAX_HOURS} consecutive hours, from its time of issue on", "time", row,
            )
        members[member].append([
            table.read_number(row, column, _RANGES[name]) if table.cell(row, column) else math.nan
            for name, column in columns.items()
        ])
    if sorted(members) != [*range(len(members))]:
        raise table.refuse(
            "every issue must have the members 0, 1, 2 and so on, without gaps", "member", first
        )
    # Members that end early are missing (NaN) in the remaining hours.
    steps, per_hour = max(map(len, members.values())), HOUR // step
    cells = np.full((len(members), steps, len(columns)), np.nan)
    for member, of_member in members.items():
        cells[int(member), : len(of_member)] = of_member
    whole = cells[:, : steps - steps % per_hour]
    cells = whole.reshape(len(members), -1, per_hour, len(columns)).mean(axis=2)
    values = {name: cells[0, :, number] for number, name in enumerate(columns)}
    values[PRECIPITATION] = cells[:, :, 0]
    return mend_forecast(IssuedForecast(issued, available, table.file, first.line, values))


def write_forecasts(issues: Sequence[IssuedForecast]) -> str:
    """Return forecasts as the text of a file, which :func:`read_forecasts` reads back bit for bit.

    Args:
        issues: issues of an archive in chronological order; a quantity that one of them lacks is
            left out.
    """
    names = [name for name in _COLUMNS if all(name in issue.values for issue in issues)]
    columns = ["issued", "available", "time", "member", *(_COLUMNS[name] for name in names)]
    lines = [",".join(columns)]
    for issue in issues:
        times = [(issue.issued + hour * HOUR).isoformat() for hour in range(issue.hours)]
        further = [issue.values[name].tolist() for name in names[1:]]
        lines += [
            ",".join([
                times[0], issue.available.isoformat(), time, str(member),
                *("" if math.isnan(value) else repr(value) for value in values),
            ])
            for member, rain in enumerate(issue.rain.tolist())
            for time, *values in zip(times, rain, *further, strict=True)
        ]
    return "\n".join([*lines, ""])


# --- previous runs and members --------------------------------------------------------------------


def _read_previous_runs(file: Path, site: Place) -> Rows:
    """Return the precipitation by variable; values are for the hour after their time stamps."""
    if file.suffix == ".json":
        table, described = read_answer(file, site)
    else:
        table = read_table(file)
        units = dict.fromkeys(table.header, "mm")
        described = Description(units=units, utc_offset=0.0, step=3600.0)
    first = table.header[0]
    if first not in (TIME, "datetime") or not any(map(_PREVIOUS.fullmatch, table.header)):
        raise table.refuse(
            "must begin with issued, or with time and precipitation_previous_day1 and so on", first
        )
    return read_rain(table, described, _PREVIOUS, site)


def read_rain(table: Table, described: Description, names: re.Pattern[str], site: Place) -> Rows:
    """Return the rain (mm/h) in each column with one of the names, by the name of the column.

    Args:
        table: table whose first column contains the ends of the hours.
        described: description of the table, with the unit of each column.
        names: pattern of the names, of which the table has at least one.
        site: the site.

    Raises:
        ConfigurationError: if the rows or the values are invalid; see :func:`.table.arrange`.
    """
    table.rows, series = [*table.rows], dict[str, Array]()
    for name in filter(names.fullmatch, table.header):
        of_name = replace(
            described, columns={TIME: (table.header[0],), PRECIPITATION: (name,)},
            units={PRECIPITATION: described.units[name]}, rows=END,
        )
        rows = arrange(table, of_name, site, [PRECIPITATION])
        series[name] = rows.values[PRECIPITATION]
    return replace(rows, values=series)


def _make_issues(files: Sequence[Path], site: Place, daily: bool) -> list[IssuedForecast]:
    """Return the forecasts that were known at 00, 06, 12 and 18 UTC, from previous runs.

    With l as the lead time (h) from the issue to the end of an hour, the forecast for this hour is
    the value with the smallest N for which 24 N >= l and the value is not missing. An issue ends
    before the first hour without a known value.

    Args:
        files: files of previous runs.
        site: site that must be near the position in the files.
        daily: True for one issue per day; see :func:`read_archive`.

    Raises:
        ConfigurationError: if no issue has a known first hour.
    """
    previous = make_hours([_read_previous_runs(file, site) for file in files])
    days = {int(name[-1]): series for name, series in previous.values.items()}
    span = _DAY_H * max(days)
    padded = np.full((max(days), previous.hours + 2 * span), np.nan)
    for day, series in days.items():
        padded[day - 1, span:-span] = series
    leads, ages = np.arange(span), np.arange(max(days))[:, None]
    allowed = ages == leads // _DAY_H if daily else ages >= leads // _DAY_H
    issues, every = [], _DAY_H if daily else ISSUE_HOURS
    before = (span - hours_since_1970(previous.first)) % every  # hours before the first issue
    for begin in range(before, span + previous.hours, every):
        by_days = np.where(allowed, padded[:, begin : begin + span], np.nan)
        rain = by_days[(~np.isnan(by_days)).argmax(axis=0), leads]
        if not daily:
            rain = rain[: _count_known(rain)]
        if len(rain):
            issued = previous.first + (begin - span) * HOUR
            issues.append(IssuedForecast(
                issued, issued + SERVICE_DELAY_H * HOUR, files[0], None,
                {PRECIPITATION: rain[None]}, finest_lead=_DAY_H if daily else 1,
            ))
    if not issues:
        raise ConfigurationError(
            "must contain a value for an hour that starts at 00, 06, 12 or 18 UTC", file=files[0]
        )
    return issues
