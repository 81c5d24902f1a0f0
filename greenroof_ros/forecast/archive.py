"""Archives of forecasts: this project's own form, and previous runs or runs of Open-Meteo.

Files of **previous runs** (JSON, or CSV whose first column is ``time`` or ``datetime``, in UTC)
contain ``precipitation_previous_day1`` to 7: for every hour, the latest forecast that was at least
N x 24 h old (Open-Meteo, Previous Runs API: "fixed lead-time offsets"). They contain neither single
runs nor forecasts newer than 24 h. The forecast of an hour that was known at a given time is
therefore the value with the smallest N that is old enough.

Files of **a run** (JSON) contain ``precipitation``, which is the control run, and
``precipitation_member01`` and so on. The file does not state the time of its run, so the file name
must end with this time, as in ``gem_2024060112.json``. The first time in the file is not
sufficient: an answer to ``run=`` begins at the time of the run, but an answer without ``run=``
begins at midnight, or days earlier with ``past_days=``, and would reveal rain that fell before the
download.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import DEFAULT_START, hours_since_1970, parse_time, to_minutes
from greenroof_ros.forecast.issue import (
    ISSUE_HOURS,
    SERVICE_DELAY_H,
    Archive,
    IssuedForecast,
    check_same_form,
    join_members,
    mend_forecast,
)
from greenroof_ros.site.horizon import MAX_MEMBERS
from greenroof_ros.site.site import Place
from greenroof_ros.weather.open_meteo import read_answer
from greenroof_ros.weather.quantities import (
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    QUANTITIES,
    TEMPERATURE,
)
from greenroof_ros.weather.records import HOUR, Records, join_records
from greenroof_ros.weather.table import Row, Table, read_table

SUFFIXES = (".csv", ".json")
"""suffixes of forecast files"""
# Columns of this project's form, by quantity; the optional columns.
_COLUMNS = {
    quantity: f"{quantity} [{QUANTITIES[quantity].unit}]"
    for quantity in (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE)
}
_OPTIONAL = {"available", "member", _COLUMNS[EVAPOTRANSPIRATION], _COLUMNS[TEMPERATURE]}
_MEMBERS = Range(0.0, MAX_MEMBERS - 1.0, "(whole)")
_RANGES = {
    quantity: Range(QUANTITIES[quantity].low, QUANTITIES[quantity].high, QUANTITIES[quantity].unit)
    for quantity in _COLUMNS
}
_TIMES = "time", "datetime"
# Only the last bytes of a live site's file are read, enough for 100 members of 36 days.
_MAX_BYTES, _CHUNK = 16_000_000, 1_000_000
_PREVIOUS = re.compile(r"precipitation_previous_day([1-7])")
_MEMBER = re.compile(r"precipitation(?:_member(\d{2,3}))?")
# A browser adds " (1)" to the name of a second download.
_RUN_IN_NAME = re.compile(r"(\d{4})-?(\d\d)-?(\d\d)T?(\d\d)(?:-?00)?(?: ?\(\d+\))?$")
# The service's longest forecasts, those of ensembles, reach 36 days (h).
_MAX_RUN_H = 36 * 24
_DAY_H = 24


def read_archive(source: Path, site: Place, delay: float | None = None) -> Archive:
    """Read an archive of forecasts.

    An issue is known as soon as it is available, hours after its nominal time, because the model
    run has to be computed and distributed. The nominal time is the time of the run's observations,
    at which the first hour begins.

    Args:
        source: file, or directory with files in a single form.
        site: site that must be near the archive's position, if the archive states a position.
        delay: time from the nominal time of an issue until the issue is known (h); by default, the
            usual delay for the kind of archive.

    Raises:
        ConfigurationError: if a file does not conform to its form, if the files have different
            forms, if an issue occurs twice, or if only some issues contain evapotranspiration.
    """
    files = _list_files(source)
    own = [_is_own(file) for file in files]
    if any(own) and not all(own):
        raise ConfigurationError(
            f"must have the form of {files[0].name}, like all files of an archive",
            file=files[own.index(not own[0])],
        )
    if own[0]:
        issues = [issue for file in files for issue in read_forecasts(file)]
        archive = Archive(files[0], "own form", issues, 0.0, issues)
    else:
        archive = _read_answers(files, site)
    issues, notes = _equalise_members(sorted(archive.issues, key=lambda issue: issue.order))
    if delay is not None:
        issues = [replace(issue, available=None) for issue in issues]
    return replace(
        archive, source=source, issues=issues,
        verified=issues if archive.verified is archive.issues else archive.verified,
        delay=archive.delay if delay is None else delay,
        notes=tuple(dict.fromkeys([*archive.notes, *notes])),
    )


def _list_files(source: Path) -> list[Path]:
    if not source.is_dir():
        return [source]
    files = sorted(
        file for file in source.iterdir() if file.is_file() and not file.name.startswith(".")
    )
    if not files:
        raise ConfigurationError("must contain forecast files", file=source)
    for file in files:
        if file.suffix not in SUFFIXES:
            raise ConfigurationError(
                f"must have the suffix {' or '.join(SUFFIXES)}, like all files in a directory of "
                "forecasts", file=file,
            )
    return files


def _is_own(file: Path) -> bool:
    """Return True if the first line that is no comment begins with the column ``issued``."""
    if file.suffix == ".json":
        return False
    header = next((
        line for line in read_lines(file) if line.strip() and not line.lstrip().startswith("#")
    ), "")
    return header.split(",")[0].strip() == "issued"


def _equalise_members(issues: Sequence[IssuedForecast]) -> tuple[list[IssuedForecast], list[str]]:
    """Return issues with equal numbers of members, and notes on omitted members and issues.

    If an issue has fewer members than others, the other issues are reduced to the same number. If
    this would be less than half of their members, the issue is left out instead.

    Raises:
        ConfigurationError: if an issue repeats another issue, or has different quantities.
    """
    for earlier, later in itertools.pairwise(issues):
        check_same_form(earlier, later)
    maximum = max(len(issue.rain) for issue in issues)
    used = [issue for issue in issues if 2 * len(issue.rain) >= maximum]
    minimum = min(len(issue.rain) for issue in used)
    notes = [note for issue in used for note in issue.notes]
    notes += [
        f"{issue.file.name}: the issue of {to_minutes(issue.issued)} is left out: it has only "
        f"{len(issue.rain)} members, but the largest issue has {maximum}"
        for issue in issues if 2 * len(issue.rain) < maximum
    ]
    if minimum < maximum:
        notes.append(
            f"the number of members used from every issue is {minimum}, as in the smallest issue"
        )
    return [replace(issue, rain=issue.rain[:minimum]) for issue in used], notes


# --- own form -------------------------------------------------------------------------------------


def read_forecasts(path: Path, now: datetime | None = None) -> list[IssuedForecast]:
    """Read a file of forecasts with one or more issues.

    Lines that start with ``#`` are comments. The first other line is the header. The columns are
    ``issued``, ``available`` (optional, the time of arrival), ``time``, ``member`` (for ensembles),
    ``precipitation [mm/h]``, and optionally ``evapotranspiration [mm/day]`` and ``temperature
    [degC]``, of which only the values of member 0 are used. Every other line contains the forecast
    issued at ``issued`` for the hour that starts at ``time`` (both in ISO 8601 format with a UTC
    offset). The hours of every issue and member are consecutive, and the first hour starts at the
    time of issue. All issues have the members 0, 1, 2 and so on. An empty cell is missing; see
    :func:`.issue.mend_forecast`.

    Args:
        path: path of the file.
        now: if given, only the latest issue at this time and later issues are read, from at most
            the last 16 MB of the file; a live site needs no older issues.

    Raises:
        ConfigurationError: if the file breaks any of these rules; the message names the line and
            the value.
    """
    table = read_table(path, None if now is None else _select_newest(path, now))
    columns = ["issued", "available", "time", "member", *_COLUMNS.values()]
    table.require_header(
        [column for column in columns if column not in _OPTIONAL or column in table.header],
        f"; the columns are {', '.join(map(repr, columns))}, of which "
        f"{', '.join(sorted(_OPTIONAL))} are optional",
    )
    grouped = itertools.groupby(
        table.rows,
        lambda row: [table.cell(row, name) for name in columns[:2] if name in table.header],
    )
    issues = list[IssuedForecast]()
    for _, rows in grouped:
        issue = _read_issue(table, [*rows])
        if issues and issue.issued < issues[-1].issued:
            raise ConfigurationError(
                f"must not be before {to_minutes(issues[-1].issued)}, the time of the previous "
                "issue: issues must be in chronological order", file=path, line=issue.line,
                key="issued", value=to_minutes(issue.issued),
            )
        issues.append(issue)
    return issues


def _select_newest(path: Path, now: datetime) -> list[tuple[int, str]]:
    """Return the header, and the numbered lines from the latest issue at a given time onwards.

    Raises:
        ConfigurationError: if the file cannot be read, or if its last issue is too long.
    """
    if not path.is_file() or path.stat().st_size <= _MAX_BYTES:
        lines = _keep_rows(enumerate(read_lines(path), start=1))
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


def _keep_rows(lines: Iterable[tuple[int, str]]) -> list[tuple[int, str]]:
    return [(number, line) for number, line in lines if line.strip() and line.lstrip()[0] != "#"]


def _read_last_lines(path: Path) -> list[tuple[int, str]]:
    """Return the header of a large file, and the numbered lines of its last complete issues."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        header = next((1, line) for line in stream if line.strip() and line.lstrip()[0] != "#")
    tail, skipped = path.stat().st_size - _MAX_BYTES, 0
    with path.open("rb") as stream:
        while chunk := stream.read(min(_CHUNK, tail - stream.tell())):
            skipped += chunk.count(b"\n")
        text = stream.read(_MAX_BYTES).decode("utf-8", "replace")
    rows = _keep_rows(enumerate(text.splitlines(), start=skipped + 1))[1:]
    cut = rows[0][1].partition(",")[0] if rows else ""
    whole = [row for row in rows if row[1].partition(",")[0] != cut]
    if not whole:
        raise ConfigurationError(
            f"ends with an issue of more than {_MAX_BYTES / 1e6:g} MB, but only the last "
            f"{_MAX_BYTES / 1e6:g} MB of a live site's file are read: write a new file for each "
            "issue, with fewer members or hours", file=path,
        )
    return [header, *whole]


def _read_issue(table: Table, rows: Sequence[Row]) -> IssuedForecast:
    """Return the issue in rows that have the same times of issue and arrival."""
    issued = table.read_time(rows[0], "issued")
    available = table.read_time(rows[0], "available") if "available" in table.header else None
    if available is not None and available < issued:
        raise table.refuse(
            f"must not be before {to_minutes(issued)}, the time of issue", "available", rows[0]
        )
    values: dict[float, dict[str, list[float]]] = {}
    for row in rows:
        member = table.read_number(row, "member", _MEMBERS) if "member" in table.header else 0.0
        series = values.setdefault(
            member, {name: [] for name, column in _COLUMNS.items() if column in table.header}
        )
        expected = issued + len(series[PRECIPITATION]) * HOUR
        time = table.read_time(row, "time")
        if time != expected:
            raise table.refuse(
                f"must be {to_minutes(expected.astimezone(time.tzinfo))}: every forecast must have "
                "consecutive hours from its time of issue onward, without gaps or repetitions",
                "time", row,
            )
        for name, numbers in series.items():
            numbers.append(_read_value(table, row, _COLUMNS[name], name))
    return mend_forecast(join_members(
        (member, IssuedForecast(
            issued, table.file, rows[0].line, np.array(series[PRECIPITATION])[None],
            _as_array(series.get(EVAPOTRANSPIRATION)), _as_array(series.get(TEMPERATURE)),
            available,
        ))
        for member, series in values.items()
    ))


def _as_array(numbers: Sequence[float] | None) -> NDArray[np.float64] | None:
    return None if numbers is None else np.array(numbers)


def _read_value(table: Table, row: Row, column: str, quantity: str) -> float:
    if not table.cell(row, column):
        return math.nan
    return table.read_number(row, column, _RANGES[quantity])


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
        ["issued", *arrivals, "time", "member", *(_COLUMNS[name] for name in quantities)]
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


# --- Open-Meteo -----------------------------------------------------------------------------------


def _read_answers(files: Sequence[Path], site: Place) -> Archive:
    """Read files of previous runs, or files that each contain one run."""
    parts = [_read_precipitation(file, site) for file in files]
    previous = [any(map(_PREVIOUS.fullmatch, part.values)) for part in parts]
    if not any(previous):
        runs = [_select_run(part, _read_run_time(part.files[0])) for part in parts]
        return Archive(files[0], "Open-Meteo, runs", runs, SERVICE_DELAY_H, runs)
    if not all(previous):
        raise ConfigurationError(
            f"must contain previous runs, like {parts[previous.index(True)].files[0].name}",
            file=parts[previous.index(False)].source,
        )
    whole = join_records([
        replace(part, values={
            name: series for name, series in part.values.items() if _PREVIOUS.fullmatch(name)
        })
        for part in parts
    ])
    return Archive(
        files[0], "Open-Meteo, previous runs", _make_issues(whole), SERVICE_DELAY_H,
        _make_daily(whole), _DAY_H,
    )


def _read_precipitation(file: Path, site: Place) -> Records:
    """Return the precipitation by variable; values are for the hour after their time stamps."""
    if file.suffix == ".json":
        hours = read_answer(file, site, _find_quantity)
        if not hours.values:
            raise ConfigurationError(
                "must contain precipitation, precipitation_member01 or precipitation_previous_day1",
                file=file, key="hourly",
            )
        return replace(hours, first=hours.first - HOUR)
    table = read_table(file)
    names = [name for name in table.header if _PREVIOUS.fullmatch(name)]
    if table.header[0] not in _TIMES or not names:
        raise table.refuse(
            f"must begin with 'issued', as in this project's form, or with {' or '.join(_TIMES)} "
            "before columns precipitation_previous_day1 and so on", table.header[0],
        )
    first, hours_of_rows = None, list[int]()
    series = {name: list[float]() for name in names}
    for row in table.rows:
        text = table.cell(row, table.header[0])
        with suppress(ValueError):
            time = parse_time(text, timezone.utc)
            first = first or time
            hour = (time - first) / HOUR
            if hour.is_integer() and hour > (hours_of_rows[-1] if hours_of_rows else -1):
                hours_of_rows.append(int(hour))
                for name in names:
                    series[name].append(_read_value(table, row, name, PRECIPITATION))
                continue
        raise table.refuse(
            f"must be a time such as {DEFAULT_START}, a whole number of hours after the previous "
            "row", table.header[0], row,
        )
    assert first is not None
    values = {name: np.full(hours_of_rows[-1] + 1, np.nan) for name in names}
    for name, numbers in series.items():
        values[name][hours_of_rows] = numbers
    return Records((file,), first - HOUR, values)


def _find_quantity(name: str) -> str | None:
    return PRECIPITATION if _PREVIOUS.fullmatch(name) or _MEMBER.fullmatch(name) else None


def read_run(file: Path, site: Place, issued: datetime) -> IssuedForecast:
    """Read an answer as a forecast with a known time of issue.

    Args:
        file: file for a single location.
        site: site that must be near this location.
        issued: start of the first hour; earlier hours in the file are skipped.

    Raises:
        ConfigurationError: if the file contains no precipitation from this hour on.
    """
    return _select_run(_read_precipitation(file, site), issued)


def _select_run(hours: Records, run: datetime) -> IssuedForecast:
    """Return the run in a file; the series without a number is the control run, member 0."""
    (file,) = hours.files
    start, rest = divmod(run - hours.first, HOUR)
    if rest or not 0 <= start < hours.hours:
        raise ConfigurationError(
            f"must contain the hour after its run, {to_minutes(run)}, but the first time is "
            f"{to_minutes(hours.first + HOUR)}", file=file,
        )
    # Some runs have no control run, and a download may lack a member.
    series = [hours.values[name] for name in sorted(filter(_MEMBER.fullmatch, hours.values))]
    issue = join_members(
        (number, IssuedForecast(run, file, None, member[None, start:]))
        for number, member in enumerate(series)
    )
    if issue.hours > _MAX_RUN_H:
        raise ConfigurationError(
            f"has {issue.hours} hours, but a run covers at most {_MAX_RUN_H} hours. For a longer "
            "period in the past, use previous runs, precipitation_previous_day1 and so on",
            file=file,
        )
    known = np.flatnonzero(~np.isnan(issue.rain).all(axis=0))  # NaN beyond the model's horizon
    end = known[-1] + 1 if known.size else 1
    return mend_forecast(replace(issue, rain=issue.rain[:, :end], notes=hours.left_out))


def _read_run_time(file: Path) -> datetime:
    """Return the time of the run, which is at the end of the file's name."""
    with suppress(ValueError):
        if match := _RUN_IN_NAME.search(file.stem):
            year, month, day, hour = map(int, match.groups())
            return datetime(year, month, day, hour, tzinfo=timezone.utc)
    raise ConfigurationError(
        "the file name must end with the time of the run, such as 2024060112 (year, month, day "
        "and hour in UTC), because the file does not state this time. For more than one run, use "
        "previous runs, precipitation_previous_day1 and so on", file=file,
    )


def _make_issues(previous: Records) -> list[IssuedForecast]:
    """Return the forecasts that were known at 00, 06, 12 and 18 UTC, as issues.

    With l as the lead time (h) from the issue to the end of an hour, the forecast for this hour is
    the value with the smallest N for which 24 N >= l and the value is not missing. An issue ends
    before the first hour without a known value.

    Raises:
        ConfigurationError: if all values are missing, or if no issue has a known first hour.
    """
    issues = []
    for issued, by_days in _list_windows(previous, ISSUE_HOURS):
        leads = np.arange(by_days.shape[1])
        old_enough = np.arange(len(by_days))[:, None] >= leads // _DAY_H
        known = old_enough & ~np.isnan(by_days)
        hours = int(np.append(known.any(axis=0), False).argmin())
        if hours:
            newest = known.argmax(axis=0)
            rain = by_days[newest, leads][None, :hours]
            issues.append(IssuedForecast(issued, previous.files[0], None, rain))
    if not issues:
        nothing = all(np.isnan(series).all() for series in previous.values.values())
        raise ConfigurationError(
            "contains no precipitation: every value is missing" if nothing else
            "must contain a value for an hour that starts at 00, 06, 12 or 18 UTC, the times at "
            "which forecasts are issued",
            file=previous.files[0],
        )
    return issues


def _make_daily(previous: Records) -> list[IssuedForecast]:
    """Return one issue per day, at 00 UTC, for verification.

    The hours from 24 (N - 1) to 24 N after the issue contain the values of N, so every value of the
    file is in exactly one issue, on the day to which it belongs. Missing values are NaN. In
    contrast, :func:`_make_issues` uses a value in up to four issues, or replaces it with a value of
    another N.
    """
    issues = []
    for issued, by_days in _list_windows(previous, _DAY_H):
        leads = np.arange(by_days.shape[1])
        rain = by_days[leads // _DAY_H, leads][None, :]
        issues.append(IssuedForecast(issued, previous.files[0], None, rain))
    return issues


def _list_windows(
    previous: Records, every: int
) -> Iterator[tuple[datetime, NDArray[np.float64]]]:
    """Yield the times of issue, ``every`` hours from 00 UTC on, and the values after each issue.

    The values have one row for each N up to the maximum, and cover the same number of days; NaN if
    missing.
    """
    days = {int(name[-1]): series for name, series in previous.values.items()}
    maximum = max(days)
    span = _DAY_H * maximum
    padded = np.full((maximum, previous.hours + 2 * span), np.nan)
    for day, series in days.items():
        padded[day - 1, span:-span] = series
    since_1970 = hours_since_1970(previous.first)
    for start in range(-span, previous.hours):
        if (since_1970 + start) % every == 0:
            yield previous.first + start * HOUR, padded[:, span + start : 2 * span + start]
