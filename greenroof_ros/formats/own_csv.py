"""Files in this project's own format: weather, and forecasts issue by issue."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError, did_you_mean
from greenroof_ros.common.files import read_lines
from greenroof_ros.common.ranges import Range
from greenroof_ros.common.times import duration, parse_time, to_minutes
from greenroof_ros.formats.records import (
    EVAPOTRANSPIRATION,
    HOUR,
    NEARLY,
    PRECIPITATION,
    QUANTITIES,
    TEMPERATURE,
    Archive,
    Issue,
    Records,
    Table,
    Unit,
    by_hour,
    check_alike,
    ensemble,
    mended,
    numbered_lines,
    read_table,
    table_of,
    with_dew_point,
)
from greenroof_ros.formats.steps import steps_of_rows
from greenroof_ros.model.look_ahead import MAX_MEMBERS
from greenroof_ros.model.site import Site

# Columns of forecasts, by quantity; then the optional ones.
_FORECAST = {
    quantity: f"{quantity} [{QUANTITIES[quantity][0]}]"
    for quantity in (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE)
}
# Of a live site's file only the last bytes are read, enough for 100 members of 36 days.
_MOST_BYTES, _CHUNK = 16_000_000, 1_000_000
_COMMENT = re.compile(r"\s*(#|$)")
# What comments at the head of a weather file may state: its place, the height of the wind, and the
# delay of the rain's time.
_ENDS = {
    "latitude": Range(-90.0, 90.0, "degrees"), "longitude": Range(-180.0, 180.0, "degrees"),
    "wind_height": Range(0.5, 100.0, "m"), "rain_late": Range(0.0, 1.0, "h"),
}
_ABOUT = re.compile(rf"\b({'|'.join(_ENDS)})\s*[:=]\s*([-+]?\d+(?:\.\d*)?)", re.IGNORECASE)
# Minimum share of an hour's rows to know its rain; another quantity needs one value.
_ENOUGH = 0.75
# Other names of quantities, and units of amounts in a row.
_SYNONYMS = {"rain": PRECIPITATION}
_AMOUNT = "mm"
_MEMBERS = ("(whole)", 0.0, MAX_MEMBERS - 1.0)
_OPTIONAL = {"available", "member", _FORECAST[EVAPOTRANSPIRATION], _FORECAST[TEMPERATURE]}


def recognises(_file: Path, _head: bytes, /) -> bool:
    """Any file: this format is the last that is tried, and its errors state what is expected."""
    return True


# --- weather ----------------------------------------------------------------------------------


def read_records(file: Path, site: Site, /) -> Records:
    """Read a weather file in this project's format; an empty cell is a missing value.

    Lines that start with ``#`` are comments. The first other line names the columns with their
    units: ``time``, ``precipitation [mm/h]`` or ``rain [mm]``, the amount of each row, and others
    of :data:`greenroof_ros.formats.records.QUANTITIES`; ``... evapotranspiration [mm/day]`` begins
    with the name of its method. Comments at the head may give the place, as in ``latitude: 43.63,
    longitude: -79.40``, and ``wind_height: 2`` (m). Each further line is the hour that starts at
    its ``time`` (ISO 8601 with the offset from UTC; without an offset it is a time of the clock in
    ``time_zone`` of the site). An hour without a line is missing.

    Lines less than an hour apart, at a regular step, are averaged by the hours of the clock. Rain
    of an hour with less than 0.75 of its lines is missing.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    table = read_table(file, lambda name: name != "time")
    columns, method = _columns(table)
    first, hours, step = _hours(table, site)
    values = {}
    for quantity, column in columns.items():
        unit = Unit(_AMOUNT, step) if column.endswith(f"[{_AMOUNT}]") else None
        values[quantity] = table.usable(
            column, QUANTITIES[quantity], unit, NEARLY.get(quantity, 0.0),
            optional=quantity != PRECIPITATION,
        )
    notes = table.notes
    if step < 1:
        values = {
            name: _means(series, hours, _ENOUGH / step if name == PRECIPITATION else 1.0)
            for name, series in values.items()
        }
        hours = np.arange(hours[-1] + 1)
        notes.append(
            f"{file.name}: rows are {duration(3600 * step)} apart; each hour has their mean, of "
            f"rain their mean rate if at least {_ENOUGH:g} of them are there"
        )
    about = _about(file)
    here = {file: (about["latitude"], about["longitude"])} if (
        {"latitude", "longitude"} <= about.keys()
    ) else {}
    return Records(
        (file,), first, with_dew_point(by_hour(values, hours)), method, left_out=tuple(notes),
        rain_late=round(about.get("rain_late", 0.0)), places=here,
        wind_height=about.get("wind_height"),
    )


def _hours(table: Table, site: Site) -> tuple[datetime, NDArray[np.intp], float]:
    """Return the start of the first hour, the hour of each row, and the rows' step (h)."""
    times_of = partial(
        table.times, "time", zone=None if site.time_zone is None else ZoneInfo(site.time_zone),
        hint="; if it is of a clock, give the site file its time_zone, such as America/Toronto, or "
        "Etc/GMT+5 for UTC-5 without daylight saving time",
    )
    first_two = [*itertools.islice(times_of(), 2)]
    if timedelta() < first_two[-1] - first_two[0] < HOUR:
        times = [*times_of()]
        for row, (earlier, later) in enumerate(itertools.pairwise(times), start=1):
            if later <= earlier:
                raise table.refuse("must be later than the time of the row before", "time", row)
        step = steps_of_rows(table, times)[1] / 3600
        if step < 1:
            first = times[0].replace(minute=0, second=0, microsecond=0)
            return first, np.array([(time - first) // HOUR for time in times]), step
    return *table.hours("time", **times_of.keywords), 1.0


def _means(
    series: NDArray[np.float64], hours: NDArray[np.intp], fewest: float
) -> NDArray[np.float64]:
    """Return the mean of each hour's rows; NaN if there are too few.

    Args:
        series: values of the rows, NaN if missing.
        hours: of the rows.
        fewest: number of values that an hour must have.
    """
    count = np.bincount(hours, ~np.isnan(series))
    total = np.bincount(hours, np.nan_to_num(series))
    # Tenths of a millimetre do not add up exactly in binary numbers.
    means = np.round(total / np.maximum(count, 1), 9)
    return np.where(count >= round(fewest, 6), means, np.nan)


def _about(file: Path) -> dict[str, float]:
    """Return what the comments at the head of a file state about it, by the names of ``_ENDS``."""
    found = {}
    with file.open(encoding="utf-8-sig") as stream:
        for number, line in enumerate(itertools.takewhile(_COMMENT.match, stream), 1):
            for key, text in _ABOUT.findall(line.lower()):
                found[key] = _ENDS[key].read(float(text), file=file, line=number, key=key)
    return found


def _columns(table: Table) -> tuple[dict[str, str], str]:
    """Return the column of each quantity, and the method of evapotranspiration."""
    columns: dict[str, str] = {}
    method = ""
    for column, name, unit in table.quantities(_FORECAST[PRECIPITATION]):
        quantity = EVAPOTRANSPIRATION if name.endswith(EVAPOTRANSPIRATION) else name
        quantity = _SYNONYMS.get(quantity, quantity)
        if quantity not in QUANTITIES:
            known = [f"{key} [{value[0]}]" for key, value in QUANTITIES.items()]
            raise table.refuse(f"is not a known column; {did_you_mean(column, known)}", column)
        units = [QUANTITIES[quantity][0], *([_AMOUNT] if quantity == PRECIPITATION else [])]
        if unit not in units:
            raise table.refuse(f"the unit of {name} must be [{'] or ['.join(units)}]", column)
        if quantity in columns:
            raise table.refuse(f"there is a column of {quantity} before this one", column)
        columns[quantity] = column
        if quantity == EVAPOTRANSPIRATION:
            method = name.removesuffix(EVAPOTRANSPIRATION).strip() or "unnamed"
    if PRECIPITATION not in columns:
        raise table.refuse(
            f"there must be a column '{_FORECAST[PRECIPITATION]}' or 'rain [{_AMOUNT}]'"
        )
    return columns, method


def write_records(records: Records, about: str) -> str:
    """Return records as the text of a file, which :func:`read_records` reads bit for bit.

    Args:
        records: hours of one place; gaps are empty cells.
        about: the first comment.
    """
    head = []
    places = {*records.places.values()}
    if len(places) == 1:
        head += [f"{name}: {degrees:.5f}" for name, degrees in zip(_ENDS, *places, strict=False)]
    if records.wind_height is not None:
        head.append(f"wind_height: {records.wind_height:g}")
    if records.rain_late:
        head.append(f"rain_late: {records.rain_late}")
    names = {
        name: f"{records.method} {name}" if name == EVAPOTRANSPIRATION else name
        for name in records.values
    }
    lines = [
        f"# {about}", *(f"# {line}" for line in head),
        ",".join(["time", *(f"{text} [{QUANTITIES[name][0]}]" for name, text in names.items())]),
    ]
    columns = (series.tolist() for series in records.values.values())
    for hour, row in enumerate(zip(*columns, strict=True)):
        cells = ("" if math.isnan(value) else repr(value) for value in row)
        lines.append(",".join([(records.first + hour * HOUR).isoformat(), *cells]))
    return "\n".join([*lines, ""])


# --- forecasts --------------------------------------------------------------------------------


def read_archive(files: Sequence[Path], _site: Site, /) -> Archive:
    """Read files in this format; issues are known from their arrival, or else time of issue."""
    issues = [issue for file in files for issue in read_forecasts(file)]
    return Archive(files[0], "own format", issues, 0.0, issues)


def read_forecasts(path: Path, now: datetime | None = None) -> list[Issue]:
    """Read a file of forecasts, one issue after the other.

    Lines that start with ``#`` are comments. The first other line is the header: ``issued``,
    ``available`` if the time of its arrival is known, ``time``, then ``member`` if there is more
    than one forecast per issue, ``precipitation [mm/h]``, and ``evapotranspiration [mm/day]`` and
    ``temperature [degC]`` if the file has them (only member 0's values are used). Each further line
    is the hour that starts at its ``time``, as forecast at ``issued`` (ISO 8601 with the offset
    from UTC). The hours of each issue and member are consecutive, and the first starts with the
    issue. All issues have the members 0, 1, 2 and so on. What is missing is mended, see
    :func:`greenroof_ros.formats.records.mended`.

    Args:
        path: of the file.
        now: if given, only the newest issue at this time and later ones are read, and no more than
            the last 16 MB of the file: a live site needs no others.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    table = read_table(path) if now is None else table_of(path, _newest(path, now))
    columns = ["issued", "available", "time", "member", *_FORECAST.values()]
    optional = [column for column in columns if column in _OPTIONAL]
    table.require_header(
        [column for column in columns if column not in _OPTIONAL or column in table.header],
        f"; they are {', '.join(map(repr, columns))}; {', '.join(optional)} may be left "
        "out",
    )
    # Rows by issue, with its arrival, and member.
    rows_of: dict[tuple[datetime, datetime | None], dict[float, list[int]]] = {}
    arrivals, members = ("available" in table.header, "member" in table.header)
    for row in table.rows():
        issue, time = table.time("issued", row), table.time("time", row)
        available = table.time("available", row) if arrivals else None
        member = table.number("member", row, _MEMBERS) if members else 0.0
        last, _ = next(reversed(rows_of), (issue, None))
        if available is not None and available < issue:
            raise table.refuse(
                f"must not be before {to_minutes(issue)}, when it was issued", "available", row
            )
        if issue < last:
            raise table.refuse(
                f"must not be before {to_minutes(last)}, the issue above: issues must be in order "
                "of time", "issued", row,
            )
        rows = rows_of.setdefault((issue, available), {}).setdefault(member, [])
        expected = issue + len(rows) * HOUR
        if time != expected:
            raise table.refuse(
                f"must be {to_minutes(expected.astimezone(time.tzinfo))}: each forecast, from its "
                "issue on, must have consecutive hours, without gap or repetition", "time", row,
            )
        rows.append(row)
    values = {
        quantity: table.usable(
            column, QUANTITIES[quantity], nearly=NEARLY.get(quantity, 0.0),
            optional=quantity != PRECIPITATION,
        )
        for quantity, column in _FORECAST.items() if column in table.header
    }
    issues = [
        mended(ensemble(
            (member, Issue(
                issue, path, table.lines[next(iter(numbered.values()))[0]],
                values[PRECIPITATION][None, rows],
                values[EVAPOTRANSPIRATION][rows] if EVAPOTRANSPIRATION in values else None,
                values[TEMPERATURE][rows] if TEMPERATURE in values else None,
                available=available,
            ))
            for member, rows in numbered.items()
        ))
        for (issue, available), numbered in rows_of.items()
    ]
    issues[0] = replace(issues[0], notes=(*table.notes, *issues[0].notes))
    for earlier, later in itertools.pairwise(issues):
        check_alike(earlier, later)
    return issues


def _newest(path: Path, now: datetime) -> list[tuple[int, str]]:
    """Return the header, and the numbered lines of the newest issue at a time and of later ones.

    Raises:
        ConfigurationError: the file cannot be read, or its last issue is too long.
    """
    if not path.is_file() or path.stat().st_size <= _MOST_BYTES:
        lines = [*numbered_lines(read_lines(path))]
    else:
        lines = _last_lines(path)
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
            break  # the table's error names the line
        first = at
    return lines[:1] + lines[first:]


def _last_lines(path: Path) -> list[tuple[int, str]]:
    """Return the header of a large file, and the numbered lines of the last whole issues."""
    tail = path.stat().st_size - _MOST_BYTES
    with path.open("rb") as stream:
        number = 1
        while (header := stream.readline(_CHUNK)).lstrip().startswith(b"#") or header == b"\n":
            number += 1
        top = number, header.decode("utf-8-sig", "replace").strip()
        while stream.tell() < tail and (
            chunk := stream.read(min(_CHUNK, tail - stream.tell()))
        ):
            number += chunk.count(b"\n")
        text = stream.read(_MOST_BYTES).decode("utf-8", "replace")
    rows = [
        (number + 2 + row, line) for row, line in enumerate(text.splitlines()[1:])
        if line.strip() and not line.lstrip().startswith("#")
    ]
    cut = rows[0][1].partition(",")[0] if rows else ""
    whole = [row for row in rows if row[1].partition(",")[0] != cut]
    if not whole:
        raise ConfigurationError(
            f"has an issue of more than {_MOST_BYTES / 1e6:g} MB at its end; only the last "
            f"{_MOST_BYTES / 1e6:g} MB of a live site's file are read: write a new file for each "
            "issue, with fewer members or hours", file=path,
        )
    return [top, *whole]


def write_forecasts(issues: Sequence[Issue]) -> str:
    """Return issues as the text of a file, which :func:`read_forecasts` reads bit for bit.

    Args:
        issues: of an archive, in order of time, all with the quantities of the first.
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
