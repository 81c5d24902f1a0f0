"""Archives of Open-Meteo as downloaded: previous runs, single runs and ensembles, CSV or JSON.

The service's CSV begins with two lines about the place, then come a header with units and the
hours; its JSON has the same under ``hourly_units`` and ``hourly``::

    latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation
    42.25,18.875,5.0,0,GMT,GMT

    time,precipitation_previous_day1 (mm),precipitation_previous_day2 (mm)
    2024-02-20T00:00,0.00,0.10

What a program has made of it and saved, without those lines and units, is read too: its first
column is ``time``, ``datetime`` or ``date``, in UTC unless it says an offset, and the unit is mm,
both as the service answers unless asked for something else.

Precipitation is the sum of the hour *before* its time (Open-Meteo, Weather Forecast API, Hourly
Parameter Definition: "Preceding hour sum"), so it is moved an hour back.

``precipitation_previous_day1`` is of :mod:`greenroof_ros.forecast.previous_runs`. ``precipitation``
and ``precipitation_member01`` ... are one run a file, the first being the control run. Which run it
is, the answer does not say, so the file's name must end in it, as in ``gem_2024060112.json``. The
first time is no sign of it: an answer to ``run=`` begins at the run, but one without begins at
midnight, or days before with ``past_days=``, and what fell until the download would be foreseen.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.common.times import parse_local_time, parse_time, to_minutes
from greenroof_ros.forecast.choice import SERVICE_DELAY_H
from greenroof_ros.forecast.issue import Contents, Issue
from greenroof_ros.forecast.previous_runs import DAY_HOURS, PreviousRuns, join
from greenroof_ros.model.look_ahead import MOST_MEMBERS
from greenroof_ros.model.site import Site
from greenroof_ros.weather.open_meteo import (
    PRECIPITATION_UNITS,
    Place,
    check_place,
    lines_of,
    zone_of,
)
from greenroof_ros.weather.open_meteo import (
    recognises as has_place,
)
from greenroof_ros.weather.records import HOUR, PRECIPITATION, QUANTITIES
from greenroof_ros.weather.table import Row, Table, Unit, numbered_lines, read_hours

_SAVED_TIMES = ("time", "datetime", "date")
# Those that the service has (Previous Runs API).
_PREVIOUS = re.compile(r"precipitation_previous_day([1-7])")
_MEMBER = re.compile(r"precipitation(?:_member(\d{2,3}))?")
_RUN_IN_NAME = re.compile(r"(\d{4})-?(\d\d)-?(\d\d)T?(\d\d)(?:-?00)?$")
# The service's longest forecasts, of ensembles, reach 36 days (h).
_LONGEST_RUN = 36 * 24
_UTC = timezone.utc


class _Hours(NamedTuple):
    """The precipitation of a file, hour after hour."""

    file: Path
    line: int | None
    """of the first hour"""
    first: datetime
    """start of the first hour"""
    values: dict[str, NDArray[np.float64]]
    """mm/h of each column, by its name without unit, shape (hours,); NaN where missing"""


def recognises(_file: Path, head: bytes, /) -> bool:
    """Whether a file is JSON, or its first line that of the service or of hours of a forecast."""
    first = head.decode("utf-8", "replace").removeprefix("\ufeff").lstrip().split("\n", 1)[0]
    cells = [cell.strip() for cell in first.split(",")]
    saved = cells[0] in _SAVED_TIMES and any(
        (cell.startswith(PRECIPITATION) and "[" not in cell) or "_previous_day" in cell
        for cell in cells
    )
    return first.startswith(("{", "[")) or has_place(first) or saved


def read(files: Sequence[Path], site: Site, /) -> Contents:
    """Read files, all of previous runs or each of one run.

    Args:
        files: at least one.
        site: must be near the place of a file that says its own.

    Raises:
        ConfigurationError: a file is broken, of another place, or has an unknown unit; the message
            names line or key, and value.
    """
    read_files = [_read(file, site) for file in files]
    previous = [_previous_runs(hours) for hours in read_files if _days(hours)]
    if not previous:
        return Contents("Open-Meteo, runs", [_run(hours) for hours in read_files], SERVICE_DELAY_H)
    for hours in read_files:
        if not _days(hours):
            raise ConfigurationError(
                f"must be of previous runs, as {previous[0].file.name} is", file=hours.file
            )
    whole = join(previous)
    return Contents(
        "Open-Meteo, previous runs", whole.issues(), SERVICE_DELAY_H, whole.daily(), DAY_HOURS
    )


def _read(file: Path, site: Site) -> _Hours:
    text = read_text(file, byte_order_mark=True)
    if text.lstrip().startswith(("{", "[")):
        return _read_json(file, text, site)
    if has_place(text):
        place, lines = lines_of(file, text)
        zone = zone_of(place)
        check_place(place, site)
        table = Table(file, lines)
        table.require(("time",), "Open-Meteo's hourly files")
        return _read_table(
            table, lambda row: row.local_time("time", zone, "2024-06-01T12:00"), "time", lines
        )
    lines = numbered_lines(text)
    table = Table(file, lines)
    return _read_table(table, partial(_saved_time, column=table.header[0]), table.header[0], lines)


def _saved_time(row: Row, column: str) -> datetime:
    """Return a time of a saved file, in UTC unless it says an offset."""
    try:
        time = parse_time(row.cells[column])
    except ValueError:
        raise row.refuse("must be a time such as 2024-06-01 12:00:00", column) from None
    return time if time.utcoffset() is not None else time.replace(tzinfo=_UTC)


def _read_table(
    table: Table, time: Callable[[Row], datetime], column: str,
    lines: Sequence[tuple[int, str]],
) -> _Hours:
    """Read the hours of a CSV."""
    columns = {}
    for cell in table.header:
        name, _, unit = cell.partition(" ")
        if _is_rain(name):
            table.require([cell], "Open-Meteo's hourly files")
            columns[_known(table.file, table.line, name)] = (
                cell, _unit(table.file, table.line, cell, unit.strip("()") or "mm")
            )
    _refuse_without_rain(table.file, table.line, columns)
    first, values = read_hours(
        table.rows(), column, time,
        {
            name: partial(
                Row.value, column=cell, quantity=PRECIPITATION, unit=unit,
                missing=("", "NaN", "nan"),
            )
            for name, (cell, unit) in columns.items()
        },
    )
    return _Hours(table.file, lines[1][0], first - HOUR, values)


def _read_json(file: Path, text: str, site: Site) -> _Hours:
    """Read the hours of a JSON answer."""
    try:
        content = json.loads(text, parse_int=_whole)
    except json.JSONDecodeError as error:
        raise ConfigurationError(
            f"is not valid JSON: {error}", file=file, line=error.lineno
        ) from error
    except RecursionError as error:
        raise ConfigurationError("is JSON nested too deep to be an answer", file=file) from error
    if not isinstance(content, dict):
        raise ConfigurationError("must be of one place; download each by itself", file=file)
    if content.get("error"):
        raise ConfigurationError(
            f"is no forecast but the service's refusal: {content.get('reason', '')}", file=file
        )
    place = Place(file, None, {
        name: "NaN" if value is None else str(value) for name, value in content.items()
    })
    zone = zone_of(place)
    check_place(place, site)
    units, hourly = (_mapping(file, content, key) for key in ("hourly_units", "hourly"))
    if units.get("time") != "iso8601":
        raise ConfigurationError(
            "must be 'iso8601'; download without timeformat=unixtime",
            file=file, key="hourly_units.time", value=units.get("time"),
        )
    first, count = _first_of(file, hourly, zone)
    values = {}
    for name, series in hourly.items():
        if _is_rain(name):
            unit = _unit(file, None, f"hourly_units.{name}", str(units.get(name)))
            values[_known(file, None, name)] = _series(file, name, series, count, unit)
    _refuse_without_rain(file, None, values)
    return _Hours(file, None, first - HOUR, values)


def _whole(digits: str) -> float:
    """Return an integer of JSON; one that is beyond every float is infinite, as a decimal is.

    Python would read it exactly, and then fail to make it a float, or refuse its many digits.
    """
    number = float(digits)
    return int(digits) if math.isfinite(number) else number


def _mapping(file: Path, content: dict[str, Any], key: str) -> dict[str, Any]:
    value = content.get(key)
    if not isinstance(value, dict):
        raise ConfigurationError("must be a mapping, as in answers for hours", file=file, key=key)
    return value


def _first_of(file: Path, hourly: dict[str, Any], zone: timezone) -> tuple[datetime, int]:
    """Return the first time of a JSON answer, and how many follow it, itself included."""
    times = hourly.get("time")
    if not isinstance(times, list) or not times:
        raise ConfigurationError("must be a list of times", file=file, key="hourly.time")
    first: datetime | None = None
    for index, text in enumerate(times):
        try:
            time = parse_local_time(str(text), zone)
        except ValueError:
            raise ConfigurationError(
                "must be a time such as 2024-06-01T12:00",
                file=file, key=f"hourly.time[{index}]", value=text,
            ) from None
        first = first or time
        if time != first + index * HOUR:
            raise ConfigurationError(
                f"must be {to_minutes(first + index * HOUR)}: hour after hour, without gap or "
                "repetition", file=file, key=f"hourly.time[{index}]", value=text,
            )
    assert first is not None
    return first, len(times)


def _series(
    file: Path, name: str, series: object, count: int, unit: Unit
) -> NDArray[np.float64]:
    """Return the values of a JSON answer in mm/h; null is missing, and the NaN of programs."""
    key = f"hourly.{name}"
    if not isinstance(series, list) or len(series) != count:
        raise ConfigurationError(
            f"must be a list of {count} values, one for each time", file=file, key=key
        )
    _, low, high = QUANTITIES[PRECIPITATION]
    values = np.full(count, np.nan)
    for index, value in enumerate(series):
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if value is None or (number and math.isnan(value)):
            continue
        if not (number and low <= value <= high * unit.per_ours):
            raise ConfigurationError(
                f"must be a number from {low:g} to {high * unit.per_ours:g} {unit.name}, or null",
                file=file, key=f"{key}[{index}]", value=value,
            )
        values[index] = value / unit.per_ours
    return values


def _is_rain(name: str) -> bool:
    """Whether a column is of an amount of rain, and not of another quantity or its probability."""
    return name.startswith(PRECIPITATION) and not name.startswith(f"{PRECIPITATION}_probability")


def _known(file: Path, line: int | None, name: str) -> str:
    """Return a column's name, or refuse one that nothing is known of, as that of a model."""
    if not (_PREVIOUS.fullmatch(name) or _MEMBER.fullmatch(name)):
        raise ConfigurationError(
            "must be precipitation, precipitation_previous_day1 to 7 or precipitation_member01, "
            "02 and so on; download each model by itself", file=file, line=line, value=name,
        )
    return name


def _unit(file: Path, line: int | None, what: str, name: str) -> Unit:
    """Return a unit of precipitation by its name; one that is not known is never guessed."""
    for unit in PRECIPITATION_UNITS:
        if unit.name == name:
            return unit
    raise ConfigurationError(
        f"its unit must be {' or '.join(unit.name for unit in PRECIPITATION_UNITS)}, not {name}",
        file=file, line=line, value=what,
    )


def _refuse_without_rain(file: Path, line: int | None, columns: dict[str, Any]) -> None:
    if not columns:
        raise ConfigurationError(
            "must have precipitation, precipitation_member01 or precipitation_previous_day1",
            file=file, line=line,
        )


def _days(hours: _Hours) -> dict[int, NDArray[np.float64]]:
    """Return the series of previous runs by the days N that they were made before."""
    found = {name: _PREVIOUS.fullmatch(name) for name in hours.values}
    return {
        int(match[1]): hours.values[name] for name, match in found.items() if match is not None
    }


def _previous_runs(hours: _Hours) -> PreviousRuns:
    return PreviousRuns(hours.file, hours.line, hours.first, _days(hours))


def _run(hours: _Hours) -> Issue:
    """Return the run of a file."""
    numbers = _members(hours)
    run = _named_run(hours.file)
    start, rest = divmod(run - hours.first, HOUR)
    rain = np.stack(list(numbers.values()))
    if rest or not 0 <= start < rain.shape[1]:
        raise ConfigurationError(
            f"must have the hour after its run, {to_minutes(run)}; its first time is "
            f"{to_minutes(hours.first + HOUR)}", file=hours.file,
        )
    rain = rain[:, start:]
    if rain.shape[1] > _LONGEST_RUN:
        raise ConfigurationError(
            f"has {rain.shape[1]} hours, and a run at most {_LONGEST_RUN}: of a longer past there "
            "are previous runs, precipitation_previous_day1 and so on", file=hours.file,
        )
    known = np.flatnonzero(~np.isnan(rain).all(axis=0))
    if not known.size:
        raise ConfigurationError(
            f"has no precipitation after its run, {to_minutes(run)}", file=hours.file
        )
    rain = rain[:, : known[-1] + 1]  # beyond the model's horizon there is none
    missing = np.argwhere(np.isnan(rain))
    if missing.size:
        member, hour = missing[0]
        raise ConfigurationError(
            f"is missing at {to_minutes(run + (int(hour) + 1) * HOUR)}, within the run",
            file=hours.file,
            line=None if hours.line is None else hours.line + int(start + hour),
            key=[name for name in hours.values if _MEMBER.fullmatch(name)][int(member)],
        )
    return Issue(run, hours.file, hours.line, rain)


def _members(hours: _Hours) -> dict[int, NDArray[np.float64]]:
    """Return the series of a run by their member; one without a number is the control, 0."""
    found: dict[int, NDArray[np.float64]] = {}
    for name, series in hours.values.items():
        match = _MEMBER.fullmatch(name)
        if match is not None:
            found[int(match[1] or 0)] = series
    numbers = sorted(found)
    if numbers != list(range(numbers[0], numbers[0] + len(numbers))) or numbers[0] > 1:
        raise ConfigurationError(
            f"must have its members without gap; it has {', '.join(map(str, numbers))}",
            file=hours.file, line=hours.line,
        )
    if len(numbers) > MOST_MEMBERS:
        raise ConfigurationError(
            f"must have at most {MOST_MEMBERS} members, not {len(numbers)}", file=hours.file
        )
    return {number: found[number] for number in numbers}


def _named_run(file: Path) -> datetime:
    """Return the run that a file's name ends in."""
    with suppress(ValueError):
        if match := _RUN_IN_NAME.search(file.stem):
            year, month, day, hour = map(int, match.groups())
            return datetime(year, month, day, hour, tzinfo=_UTC)
    raise ConfigurationError(
        "its name must end in the run that it holds, such as 2024060112: year, month, day and hour "
        "in UTC; nothing in the file says it. Of more than one run there are previous runs, "
        "precipitation_previous_day1 and so on", file=file,
    )
