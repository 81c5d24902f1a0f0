"""Files in this project's own format: records of weather and roofs, and forecasts."""

from __future__ import annotations

import itertools
import math
import re
from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import duration, parse_time, to_minutes
from greenroof_ros.formats.cells import (
    HOUR,
    Column,
    Table,
    arrange_by_hour,
    judge_columns,
    number_lines,
    read_table,
)
from greenroof_ros.formats.comments import (
    END,
    LATITUDE,
    LONGITUDE,
    RAIN_KIND,
    RAIN_LATE,
    WIND_HEIGHT,
    read_comments,
)
from greenroof_ros.formats.forecasts import (
    Archive,
    IssuedForecast,
    check_same_form,
    join_members,
    mend_forecast,
)
from greenroof_ros.formats.hourly import Records, add_dew_point, average_minutes
from greenroof_ros.formats.other_services import explain_file
from greenroof_ros.formats.quantities import (
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    QUANTITIES,
    ROOF,
    TEMPERATURE,
    Unit,
    find_unit,
    is_amount,
)
from greenroof_ros.formats.steps import RowSteps, Values, find_steps
from greenroof_ros.site.horizon import MAX_MEMBERS
from greenroof_ros.site.site import Place, Site

TIME = "time"
_WEATHER = [name for name in QUANTITIES if name not in ROOF]
# Columns of forecasts, by quantity, followed by the optional ones.
_FORECAST = {
    quantity: f"{quantity} [{QUANTITIES[quantity].unit}]"
    for quantity in (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE)
}
# Only the last bytes of a live site's file are read, enough for 100 members of 36 days.
_MAX_BYTES, _CHUNK = 16_000_000, 1_000_000
_LEVELS = ("level", "cistern level")
_COLUMN = re.compile(r"([^\[\]]+?)\s*\[([^\[\]]*)\]")
_SYNONYMS = {"rain": PRECIPITATION}
_MEMBERS = Range(0.0, MAX_MEMBERS - 1.0, "(whole)")
_OPTIONAL = {"available", "member", _FORECAST[EVAPOTRANSPIRATION], _FORECAST[TEMPERATURE]}


# --- weather and roofs ------------------------------------------------------------------------


@dataclass(frozen=True)
class Rows:
    """The rows of a file of measurements at regular intervals.

    Attributes:
        table: table of the file, for messages; its rows have been read.
        columns: name and unit of the column of every quantity.
        method: method of the evapotranspiration; empty without a column of evapotranspiration.
        first: start of the first row, with a UTC offset.
        steps: time steps of the rows, relative to the first row; no step occurs twice.
        since: starts of the rows relative to the first row (s), in the same order.
        values: values of every quantity, in the unit of :data:`.quantities.QUANTITIES` and in the
            order of the rows; NaN if missing.
        about: numbers stated in the comments at the head of the file; see :mod:`.comments`.
        rain_kind: kind of rain stated in the comments; empty if none is stated.
    """

    table: Table
    columns: dict[str, tuple[str, Unit]]
    method: str
    first: datetime
    steps: RowSteps
    since: NDArray[np.float64]
    values: dict[str, NDArray[np.float64]]
    about: dict[str, float]
    rain_kind: str


def read_rows(
    file: Path, site: Place, wanted: Collection[str], stamped: str | None = None
) -> Rows:
    """Read a file of measurements in this project's format.

    Lines that start with ``#`` are comments; comments at the head may contain the statements that
    :mod:`.comments` reads. The first other line is the header. The columns are ``time`` and
    quantities of :data:`.quantities.QUANTITIES` with their units, as in ``rain [mm]``; the column
    ``... evapotranspiration [mm/day]`` begins with the name of its method. An amount in a unit
    without ``/`` is the total over the row. Litres and m3 refer to the whole roof of area ``a2``.
    Every other line is a row, which begins at its ``time``, or ends at this time with ``stamped:
    end``; levels are the values at this time. The time is in ISO 8601 format with a UTC offset. A
    time without an offset is interpreted in the site's ``time_zone``, or else at the
    ``utc_offset``. Rows are at regular intervals, which may change. Empty cells and missing rows
    are missing values.

    Args:
        file: file to read.
        site: place with the clock; the site, if litres and m3 may occur.
        wanted: quantities to read; columns of other quantities are skipped.
        stamped: one of :data:`.comments.STAMPS`; by default, the statement in the comments.

    Raises:
        ConfigurationError: if the file breaks any of these rules; the message names the line and
            the value.
    """
    table = _open(file)
    named, method = _find_columns(table)
    first, seconds, notes = _read_times(table, site)
    about = read_comments(file)
    since = np.array(seconds) - seconds[0]
    rows = find_steps(partial(_open, file), TIME, since)
    if (stamped or about.stamped) == END:
        rows, since = _end_at_stamps(rows, since)
        first -= timedelta(seconds=float(rows.durations[0]))
        notes.append(
            f"{file.name}: the time of each row was the end of its interval, and was moved to "
            "the start",
        )
    table = _open(file)  # again: amounts per row can be judged now that the step is known
    read: dict[float, dict[str, Column]] = {}
    area = site.a2 if isinstance(site, Site) else math.nan
    for quantity, (column, unit) in named.items():
        if quantity in wanted and math.isnan(area) and unit.partition("/")[0] in ("l", "m3"):
            raise ConfigurationError(
                "must be a depth of water, such as mm/h, because the weather does not depend on "
                "the area of a roof", file=file, key=f"the unit of {column}", value=unit,
            )
    for duration_s in np.unique(rows.durations).tolist():
        read[duration_s] = {
            quantity: Column(
                table, column, quantity, find_unit(quantity, unit, duration_s / 3600, area),
                step_h=duration_s / 3600,
            )
            for quantity, (column, unit) in named.items() if quantity in wanted
        }
    for row, duration_s in zip(table.rows, rows.durations.tolist(), strict=True):
        for of_rows in read[duration_s].values():
            of_rows.add(row)
    columns = {
        quantity: (named[quantity][0], column.unit)
        for quantity, column in read[float(rows.durations[0])].items()
    }
    measured = {quantity: np.full(len(since), math.nan) for quantity in columns}
    for duration_s, of_duration in read.items():
        for quantity, series in judge_columns(of_duration).items():
            measured[quantity][rows.durations == duration_s] = series
    steps = rows.steps
    if (np.diff(steps) == 0).any():
        notes.append(
            f"{file.name}: {np.count_nonzero(np.diff(steps) == 0)} rows are in the same step as "
            "the previous row, probably because a clock was adjusted; amounts are added, and all "
            "other values are averaged"
        )
        steps, begins, counts = np.unique(steps, return_index=True, return_counts=True)
        since, rows = since[begins], rows._replace(steps=steps, durations=rows.durations[begins])
        measured = {
            quantity: np.add.reduceat(values, begins) / (
                1 if is_amount(quantity, columns[quantity][1]) else counts
            )
            for quantity, values in measured.items()
        }
    if rows.ended:
        for level in measured.keys() & set(_LEVELS):
            measured[level] = _move_to_next(measured[level], steps)
    table.notes[:0] = [*notes, *about.notes]
    return Rows(table, columns, method, first, rows, since, measured, about.numbers,
                about.rain_kind)


def _end_at_stamps(rows: RowSteps, since: Values) -> tuple[RowSteps, Values]:
    """Return the steps of rows that end at their time stamps, and their relative starts (s)."""
    durations = np.roll(rows.durations, 1)
    durations[0] = rows.durations[0]
    since = since - durations + durations[0]
    steps = rows.steps - np.round((durations - durations[0]) / rows.step_s).astype(np.int64)
    return rows._replace(steps=steps, durations=durations, ended=True), since


def _move_to_next(values: Values, steps: NDArray[np.int64]) -> Values:
    """Return values at the starts of steps from values at the ends; NaN without a previous row."""
    moved = np.full(len(values), math.nan)
    follows = np.flatnonzero(np.diff(steps) == 1)
    moved[follows + 1] = values[follows]
    return moved


def _open(file: Path) -> Table:
    try:
        return read_table(file, observed=lambda name: name != TIME)
    except ConfigurationError:
        explain_file(file)
        raise


def _read_times(table: Table, site: Place) -> tuple[datetime, array[float], list[str]]:
    """Return the first time, the times of all rows (s since 1970), and a note about the clock."""
    has_clock = site.time_zone is not None or site.utc_offset is not None
    zone = site.zone if has_clock else None
    seconds = array("d")
    first: datetime | None = None
    before: datetime | None = None
    for row in table.rows:
        time = table.read_time(
            row, TIME, zone=zone, before=before,
            hint="; if the times are from a local clock, set time_zone in the site file, such as "
            "America/Toronto, or Etc/GMT+5 for UTC-5 without daylight saving time",
        )
        if before is not None and time <= before:
            raise table.refuse(
                "must be later than the time of the previous row; if the clock observes daylight "
                "saving time, set time_zone in the site file, or write times in UTC, such as "
                "2015-06-01T14:05Z", TIME, row,
            )
        first, before = first or time, time
        seconds.append(time.timestamp())
    assert first is not None
    notes = []
    if site.time_zone is None and parse_time(table.cell(table.first, TIME)).tzinfo is None:
        notes.append(
            f"{table.file.name}: times are interpreted as UTC{first:%z}, the utc_offset of the "
            "site file; if the clock observes daylight saving time, set time_zone in the site file"
        )
    return first, seconds, notes


def _find_columns(table: Table) -> tuple[dict[str, tuple[str, str]], str]:
    """Return the column and unit of every quantity, and the method of evapotranspiration."""
    if table.header[0] != TIME:
        explain_file(table.file)
        raise table.refuse(f"the first column must be '{TIME}'", table.header[0])
    columns: dict[str, tuple[str, str]] = {}
    method = ""
    for column in table.header[1:]:
        match = _COLUMN.fullmatch(column)
        if match is None:
            raise table.refuse(
                "the name of a column must have the form 'name [unit]', such as 'rain [mm]'", column
            )
        name, unit = match.groups()
        quantity = EVAPOTRANSPIRATION if name.endswith(EVAPOTRANSPIRATION) else name
        quantity = _SYNONYMS.get(quantity, quantity)
        if quantity not in QUANTITIES:
            known = [f"{key} [{value.unit}]" for key, value in QUANTITIES.items()]
            raise table.refuse(f"is not a known column; {suggest_names(column, known)}", column)
        units = QUANTITIES[quantity].columns
        if unit not in units:
            raise table.refuse(f"the unit of {name} must be [{'] or ['.join(units)}]", column)
        if quantity in columns:
            raise table.refuse(f"an earlier column already contains {quantity}", column)
        columns[quantity] = column, unit
        if quantity == EVAPOTRANSPIRATION:
            method = name.removesuffix(EVAPOTRANSPIRATION).strip() or "unnamed"
    return columns, method


def read_records(file: Path, site: Place, /, stamped: str | None = None) -> Records:
    """Read a weather file; see :func:`read_rows`.

    The values of each hour are for the hour that starts at its time stamp. If rows are less than
    one hour apart, rain is stored in minutes, and the rain of an hour is the mean of its minutes;
    the rain of an hour is missing if less than 0.75 of the minutes are known. Other quantities are
    averaged over the clock hours in which the rows begin, with a tolerance for clock errors.

    Raises:
        ConfigurationError: if the rows are more than one hour apart, or if :func:`read_rows` raises
            one.
    """
    rows = read_rows(file, site, _WEATHER, stamped)
    steps, first, values, minutes = rows.steps, rows.first, rows.values, None
    notes = rows.table.notes
    durations_h = np.unique(steps.durations) / 3600
    if steps.step_s >= 3600:
        if steps.step_s != 3600 or (durations_h % 1).any():
            raise rows.table.refuse(
                f"rows must be at most one hour apart, not {duration(steps.step_s)}"
            )
        hours = steps.steps
        first = _round_first(first, steps)
    else:
        first = first.replace(minute=0, second=0, microsecond=0)
        begin_h = (rows.first - first) / HOUR
        hours_since = (rows.since + steps.clock_error * steps.step_s) / 3600
        of_rows = np.floor(begin_h + hours_since).astype(np.intp)
        first += int(of_rows[0]) * HOUR
        of_rows -= of_rows[0]
        begins = _round_begins((rows.first - first).total_seconds(), steps)
        end_h = math.ceil((begins[-1] + steps.durations[-1]) / 3600)
        hours = np.arange(max(int(of_rows[-1]) + 1, end_h))
        values = {
            name: _average_hours(series, of_rows, steps.durations, len(hours))
            for name, series in values.items()
        }
        if PRECIPITATION in values:
            minutes = _spread_over_minutes(
                rows.values[PRECIPITATION], begins, steps.durations, len(hours)
            )
            values[PRECIPITATION] = average_minutes(minutes)
        notes.append(
            f"{file.name}: rows are {' and '.join(duration(3600 * each) for each in durations_h)} "
            "apart; rain is simulated at a resolution of one minute, and other quantities are "
            "averaged over each hour"
        )
    if steps.changes:
        notes.append(
            f"{file.name}: the interval between rows changes {len(steps.changes)} times, first to "
            f"{duration(float(steps.durations[steps.changes[0]]))} after "
            f"{to_minutes(rows.first + timedelta(seconds=float(rows.since[steps.changes[0]])))}"
        )
    about = rows.about
    here = {file: (about[LATITUDE], about[LONGITUDE])} if (
        {LATITUDE, LONGITUDE} <= about.keys()
    ) else {}
    return Records(
        (file,), first, add_dew_point(arrange_by_hour(values, hours)), rows.method,
        left_out=tuple(notes), rain_late=round(about.get(RAIN_LATE, 0.0)), places=here,
        wind_height=about.get(WIND_HEIGHT), minutes=minutes,
        rain_kind=rows.rain_kind if PRECIPITATION in values else "",
    )


def _round_first(first: datetime, steps: RowSteps) -> datetime:
    """Return the start of the first hour, rounded to 5 min, because clocks are not exact."""
    begin = first - timedelta(seconds=steps.late)
    whole = begin.replace(minute=begin.minute // 5 * 5, second=0, microsecond=0)
    return whole + timedelta(minutes=5) * round((begin - whole) / timedelta(minutes=5))


def _round_begins(first_s: float, steps: RowSteps) -> Values:
    """Return the starts of rows relative to the first hour (s), rounded for rows of whole minutes.

    Args:
        first_s: start of the first row relative to the first hour (s).
        steps: time steps of the rows.
    """
    begins = np.asarray(first_s - steps.late + steps.steps * steps.step_s)
    return begins if steps.step_s % 60 else 60 * np.round(begins / 60)


def _spread_over_minutes(rain: Values, begins: Values, durations: Values, hours: int) -> Values:
    """Return the mean rain in every minute, shape (hours, 60); NaN in minutes without a row.

    Args:
        rain: rain in the rows (mm/h), NaN if missing.
        begins: starts of the rows relative to the first hour (s).
        durations: durations of the rows (s).
        hours: number of hours.
    """
    known = ~np.isnan(rain)
    edges = np.stack((begins, begins + durations), axis=1)[known].ravel()
    edges = np.maximum.accumulate(edges)
    minutes = 60 * np.arange(60 * hours + 1)
    amounts, seconds = np.zeros((2, len(edges)))
    amounts[1::2], seconds[1::2] = rain[known] * np.diff(edges)[::2], np.diff(edges)[::2]
    fallen, there = (
        np.diff(np.interp(minutes, edges, np.cumsum(each))) for each in (amounts, seconds)
    )
    rates = np.divide(fallen, there, out=np.full(len(there), math.nan), where=there > 1e-6)
    # Sums of binary numbers are rounded.
    return np.asarray(np.round(rates, 9).reshape(hours, 60))


def _average_hours(
    series: Values, hours: NDArray[np.intp], weights: Values, count: int
) -> Values:
    """Return the mean of the rows in every hour, shape (count,); NaN in hours without rows.

    Args:
        series: values of the rows, NaN if missing.
        hours: indices of the hours in which the rows begin.
        weights: weights of the rows.
        count: number of hours.
    """
    known = ~np.isnan(series)
    series, hours, weights = series[known], hours[known], weights[known]
    total, weight = (np.bincount(hours, each, count) for each in (weights * series, weights))
    lowest, highest = np.full((2, count), [[math.inf], [-math.inf]])
    np.minimum.at(lowest, hours, series)
    np.maximum.at(highest, hours, series)
    # Tenths do not add up exactly in binary numbers; the mean of equal values is that value.
    means = np.round(total / np.where(weight > 0, weight, 1.0), 9)
    return np.where(weight > 0, np.where(lowest == highest, lowest, means), np.nan)


def _find_longest_step(minutes: Values) -> int:
    """Return the longest time step (min) that preserves the rain of all minutes."""
    changes = np.diff(np.nan_to_num(minutes, nan=-1.0), axis=1).any(axis=0)
    return math.gcd(minutes.shape[1], *(1 + np.flatnonzero(changes)).tolist())


def write_records(records: Records, about: str) -> str:
    """Return records as the text of a file, which :func:`read_records` reads back bit for bit.

    If the rain is known for every minute, the time step of the rows is the longest that preserves
    it; other values are in the first row of their hour.

    Args:
        records: hourly records for one location; gaps are written as empty cells.
        about: text of the first comment, of one or more lines.
    """
    head = []
    places = {*records.places.values()}
    if len(places) == 1:
        head += [
            f"{name}: {degrees:.5f}"
            for name, degrees in zip((LATITUDE, LONGITUDE), *places, strict=True)
        ]
    if records.wind_height is not None:
        head.append(f"{WIND_HEIGHT}: {records.wind_height:g}")
    if records.rain_late:
        head.append(f"{RAIN_LATE}: {records.rain_late}")
    if records.rain_kind:
        head += [f"{RAIN_KIND}: {records.rain_kind}", records.rain_note]
    names = {
        name: f"{records.method} {name}" if name == EVAPOTRANSPIRATION else name
        for name in records.values
    }
    lines = [
        *(f"# {line}" for line in (*about.splitlines(), *head)),
        ",".join(["time", *(f"{text} [{QUANTITIES[name].unit}]" for name, text in names.items())]),
    ]
    table, step = np.array(list(records.values.values())), HOUR
    if records.minutes is not None:
        rain = np.where(
            np.isnan(records.minutes), records.values[PRECIPITATION][:, None], records.minutes
        )
        step_min = _find_longest_step(rain)
        step = timedelta(minutes=step_min)
        rows = np.full((*table.shape, 60 // step_min), math.nan)
        rows[..., 0] = table
        rows[list(records.values).index(PRECIPITATION)] = rain[:, ::step_min]
        table = rows.reshape(len(table), -1)
    for row, values in enumerate(table.T.tolist()):
        cells = ("" if math.isnan(value) else repr(value) for value in values)
        lines.append(",".join([(records.first + row * step).isoformat(), *cells]))
    return "\n".join([*lines, ""])


# --- forecasts --------------------------------------------------------------------------------


def read_archive(files: Sequence[Path], _site: Place, /) -> Archive:
    """Read forecasts in this format; each is known from its arrival or, if not given, its issue."""
    issues = [issue for file in files for issue in read_forecasts(file)]
    return Archive(files[0], "own format", issues, 0.0, issues)


def read_forecasts(path: Path, now: datetime | None = None) -> list[IssuedForecast]:
    """Read a file of forecasts with one or more issues.

    Lines that start with ``#`` are comments. The first other line is the header. The columns are
    ``issued``, ``available`` (optional, the time of arrival), ``time``, ``member`` (for ensembles),
    ``precipitation [mm/h]``, and optionally ``evapotranspiration [mm/day]`` and ``temperature
    [degC]``, of which only the values of member 0 are used. Every other line contains the forecast
    issued at ``issued`` for the hour that starts at ``time`` (both in ISO 8601 format with a UTC
    offset). The hours of every issue and member are consecutive, and the first hour starts at the
    time of issue. All issues have the members 0, 1, 2 and so on. Missing values are filled; see
    :func:`greenroof_ros.formats.forecasts.mend_forecast`.

    Args:
        path: path of the file.
        now: if given, only the latest issue at this time and later issues are read, from at most
            the last 16 MB of the file; a live site needs no older issues.

    Raises:
        ConfigurationError: if the file breaks any of these rules; the message names the line and
            the value.
    """
    table = read_table(path, None if now is None else _select_newest(path, now))
    columns = ["issued", "available", "time", "member", *_FORECAST.values()]
    optional = [column for column in columns if column in _OPTIONAL]
    table.require_header(
        [column for column in columns if column not in _OPTIONAL or column in table.header],
        f"; the columns are {', '.join(map(repr, columns))}, of which {', '.join(optional)} are "
        "optional",
    )
    # Rows by issue (with its arrival) and member.
    rows_of: dict[tuple[datetime, datetime | None], dict[float, list[int]]] = {}
    lines: dict[tuple[datetime, datetime | None], int | None] = {}
    arrivals, members = ("available" in table.header, "member" in table.header)
    read = {
        quantity: Column(table, column, quantity, rules=())  # for several issues and members
        for quantity, column in _FORECAST.items() if column in table.header
    }
    for row in table.rows:
        issued, time = table.read_time(row, "issued"), table.read_time(row, "time")
        available = table.read_time(row, "available") if arrivals else None
        member = table.read_number(row, "member", _MEMBERS) if members else 0.0
        last, _ = next(reversed(rows_of), (issued, None))
        if available is not None and available < issued:
            raise table.refuse(
                f"must not be before {to_minutes(issued)}, the time of issue", "available", row
            )
        if issued < last:
            raise table.refuse(
                f"must not be before {to_minutes(last)}, the time of the previous issue: issues "
                "must be in chronological order", "issued", row,
            )
        lines.setdefault((issued, available), row.line)
        rows = rows_of.setdefault((issued, available), {}).setdefault(member, [])
        expected = issued + len(rows) * HOUR
        if time != expected:
            raise table.refuse(
                f"must be {to_minutes(expected.astimezone(time.tzinfo))}: every forecast must "
                "have consecutive "
                "hours from its time of issue onward, without gaps or repetitions", "time", row,
            )
        rows.append(row.number)
        for column in read.values():
            column.add(row)
    values = judge_columns(read)
    issues = [
        mend_forecast(join_members(
            (member, IssuedForecast(
                issued, path, lines[issued, available],
                values[PRECIPITATION][None, rows],
                values[EVAPOTRANSPIRATION][rows] if EVAPOTRANSPIRATION in values else None,
                values[TEMPERATURE][rows] if TEMPERATURE in values else None,
                available=available,
            ))
            for member, rows in numbered.items()
        ))
        for (issued, available), numbered in rows_of.items()
    ]
    issues[0] = replace(issues[0], notes=(*table.notes, *issues[0].notes))
    for earlier, later in itertools.pairwise(issues):
        check_same_form(earlier, later)
    return issues


def _select_newest(path: Path, now: datetime) -> list[tuple[int, str]]:
    """Return the header, and the numbered lines from the latest issue at a given time onwards.

    Raises:
        ConfigurationError: if the file cannot be read, or if its last issue is too long.
    """
    if not path.is_file() or path.stat().st_size <= _MAX_BYTES:
        lines = [*number_lines(read_lines(path))]
    else:
        lines = _read_last_lines(path)
    first, before = 1, ""
    for at, (_, line) in enumerate(lines[1:], start=1):
        issued = line.partition(",")[0]
        if issued == before:
            continue
        before = issued
        try:
            if parse_time(issued.strip(' "')) > now:
                break
        except (TypeError, ValueError):
            break  # the error of the table names the line
        first = at
    return lines[:1] + lines[first:]


def _read_last_lines(path: Path) -> list[tuple[int, str]]:
    """Return the header of a large file, and the numbered lines of its last complete issues."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        header = next(number_lines(stream))
    tail, skipped = path.stat().st_size - _MAX_BYTES, 0
    with path.open("rb") as stream:
        while chunk := stream.read(min(_CHUNK, tail - stream.tell())):
            skipped += chunk.count(b"\n")
        text = stream.read(_MAX_BYTES).decode("utf-8", "replace")
    rows = [(skipped + number, line) for number, line in number_lines([text])][1:]
    cut = rows[0][1].partition(",")[0] if rows else ""
    whole = [row for row in rows if row[1].partition(",")[0] != cut]
    if not whole:
        raise ConfigurationError(
            f"ends with an issue of more than {_MAX_BYTES / 1e6:g} MB, but only the last "
            f"{_MAX_BYTES / 1e6:g} MB of a live site's file are read: write a new file for each "
            "issue, with fewer members or hours", file=path,
        )
    return [header, *whole]


def write_forecasts(issues: Sequence[IssuedForecast]) -> str:
    """Return forecasts as the text of a file, which :func:`read_forecasts` reads back bit for bit.

    Args:
        issues: issues of an archive in chronological order, all with the quantities of the first
            issue.
    """
    quantities = [PRECIPITATION] + [
        name for name in (EVAPOTRANSPIRATION, TEMPERATURE) if getattr(issues[0], name) is not None
    ]
    arrivals = ["available"] if any(issue.available for issue in issues) else []
    lines = [",".join(
        ["issued", *arrivals, "time", "member", *(_FORECAST[name] for name in quantities)]
    )]
    for issue in issues:
        times = [(issue.issued + hour * HOUR).isoformat() for hour in range(issue.hours)]
        arrived = [issue.order[1].isoformat() for _ in arrivals]
        further = [getattr(issue, name).tolist() for name in quantities[1:]]
        lines += [
            ",".join([times[0], *arrived, time, str(member), *map(repr, values)])
            for member, rain in enumerate(issue.rain.tolist())
            for time, *values in zip(times, rain, *further, strict=True)
        ]
    return "\n".join([*lines, ""])
