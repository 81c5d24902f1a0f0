"""Hourly CSV and JSON files from Open-Meteo, with past weather or issued forecasts.

The service's CSV files begin with two lines that describe the location, followed by a
header with units, and the hours. The service's JSON files contain the same values under
``hourly_units`` and ``hourly``::

    latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation
    43.620384,-79.41748,77.0,-18000,America/Toronto,GMT-5

    time,temperature_2m (°C),precipitation (mm),shortwave_radiation (W/m²)
    2021-07-07T00:00,21.4,0.20,0.0

Files that a program has saved without these two lines and without units are also read, if they use
the service's variable names. In such a file, the first column must be ``time``, ``datetime`` or
``date``. The times in such a file are in UTC unless they have an offset, and all units are the
service's defaults.

Precipitation is the total, and shortwave radiation the mean, over the hour *before* the time stamp;
all other quantities are instantaneous. (Open-Meteo, Historical Weather API and Weather Forecast
API, Hourly Parameter Definition: "Preceding hour sum", "Preceding hour mean", "Instant".) In this
project, values are for the hour that starts at the time stamp. Therefore rain and radiation are
moved back by one hour, and an instantaneous value is used for the following hour, as in ECCC's
files.

Local times have the same UTC offset, ``utc_offset_seconds``, in the whole file, even across the
beginning or end of daylight saving time. With ``timeformat=unixtime``, times are seconds since 1970
in UTC.

Files of **past weather** contain ``precipitation`` and the quantities from which evapotranspiration
is computed.

Files of **previous runs** contain ``precipitation_previous_day1`` to 7: for every hour, the latest
forecast that was at least N x 24 h old (Open-Meteo, Previous Runs API: "fixed lead-time offsets").
These files contain neither single runs nor forecasts newer than 24 h. The forecast of an hour that
was known at a given time is therefore the value with the smallest N that is old enough.

Files of **a run** contain ``precipitation``, which is the control run, and
``precipitation_member01`` and so on. The file does not state the time of its run, so the file name
must end with this time, as in ``gem_2024060112.json``. The first time in the file is not
sufficient: a response to ``run=`` begins at the time of the run, but a response without ``run=``
begins at midnight, or days earlier with ``past_days=``, and would reveal rain that fell before the
download.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timedelta, timezone, tzinfo
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_lines, read_text
from greenroof_ros.base.ranges import Range, read_number
from greenroof_ros.base.text import clean_text
from greenroof_ros.base.times import (
    hours_since_1970,
    parse_local_time,
    parse_time,
    parse_unix_time,
    to_minutes,
)
from greenroof_ros.formats.cells import HOUR, Column, Table, number_lines, read_table
from greenroof_ros.formats.comments import REANALYSIS
from greenroof_ros.formats.forecasts import (
    ISSUE_HOURS,
    SERVICE_DELAY_H,
    Archive,
    IssuedForecast,
    join_members,
    mend_forecast,
)
from greenroof_ros.formats.hourly import Records, add_dew_point, join_records
from greenroof_ros.formats.quantities import (
    DEW_POINT,
    HUMIDITY,
    PRECIPITATION,
    RADIATION,
    TEMPERATURE,
    Unit,
)
from greenroof_ros.site.site import Place

_OFFSET = "utc_offset_seconds"
# The service's unit for a variable that the model does not have: all its values are missing.
_NO_UNIT = "undefined"
# From March 1973 on; with fewer digits it can be a date.
_UNIX_TIME = re.compile(r"\d{9,10}(\.0*)?", re.ASCII)
# The header of a section; its line may be quoted.
_SECTION = re.compile(r'"?time"?[,;\t]')
_SAVED_TIMES = ("time", "datetime", "date")
# Names of variables that other sources would not use.
_ONLY_ITS_OWN = re.compile(
    r"(temperature|dew_?point|relative_?humidity|wind_?(speed|gusts|direction))_\d+m(?![a-z])"
    r"|soil_[a-z]+_\d|precipitation_(previous_day|member)\d|surface_pressure"
    r"|shortwave_radiation|et0_fao_evapotranspiration"
)
_SOURCE = "Open-Meteo's hourly files"
_OTHER_JSON = (
    "is JSON, but not an Open-Meteo response with hourly data; download CSV files from other "
    "services"
)
# Keys under which services state what went wrong.
_MESSAGES = ("reason", "message", "detail", "description", "error", "title")
VARIABLES = {
    PRECIPITATION: PRECIPITATION, TEMPERATURE: "temperature_2m", DEW_POINT: "dew_point_2m",
    "wind speed": "wind_speed_10m", "station pressure": "surface_pressure",
    RADIATION: "shortwave_radiation",
}
"""the service's variable for each of our quantities"""
_QUANTITIES = {variable: quantity for quantity, variable in VARIABLES.items()} | {
    "relative_humidity_2m": HUMIDITY,
    # Names before 2023.
    "dewpoint_2m": DEW_POINT, "windspeed_10m": "wind speed", "relativehumidity_2m": HUMIDITY,
}
_DEGREES = (Unit("°C"), Unit("°F", 1.8, 32.0))
UNITS = {
    PRECIPITATION: (Unit("mm"), Unit("inch", 1 / 25.4)),
    TEMPERATURE: _DEGREES,
    DEW_POINT: _DEGREES,
    "wind speed": (
        Unit("km/h"), Unit("m/s", 1 / 3.6), Unit("mp/h", 1 / 1.609344), Unit("kn", 1 / 1.852)
    ),
    "station pressure": (Unit("hPa", 10.0),),
    RADIATION: (Unit("W/m²"), Unit("W/m2")),
    HUMIDITY: (Unit("%"),),
}
"""the service's units for each quantity; the first is its default"""
# Height of the wind that is requested and read, wind_speed_10m (m).
_WIND_HEIGHT_M = 10.0
# Largest distance of a file's place from the site, and the end of the range: a cell of the coarsest
# model is half a degree wide; air is 2 degC colder 300 m further up.
_PLACE = {"latitude": (0.5, 90.0), "longitude": (0.5, 180.0), "elevation": (300.0, 9000.0)}
_PREVIOUS = re.compile(r"precipitation_previous_day([1-7])")
_MEMBER = re.compile(r"precipitation(?:_member(\d{2,3}))?")
# A browser adds " (1)" to the name of a second download.
_RUN_IN_NAME = re.compile(r"(\d{4})-?(\d\d)-?(\d\d)T?(\d\d)(?:-?00)?(?: ?\(\d+\))?$")
# The service's longest forecasts, those of ensembles, reach 36 days (h).
_MAX_RUN_H = 36 * 24
_DAY_H = 24
_JUDGED_ROWS = 1000
_S = TypeVar("_S")
_T = TypeVar("_T")


def recognises(head: bytes, /) -> bool:
    """Return True if a file is JSON, or its header contains names that only the service uses."""
    cells = _split_header(head)
    return cells[0].startswith(("{", "[")) or _OFFSET in cells or (
        cells[0] in _SAVED_TIMES and any(map(_ONLY_ITS_OWN.match, cells))
    )


def recognises_forecasts(head: bytes, /) -> bool:
    """Return True if a file is from the service, or a saved forecast of ``precipitation``.

    A weather file with only this name could be from any source, and its time stamps could have a
    different meaning.
    """
    cells = _split_header(head)
    return recognises(head) or (cells[0] in _SAVED_TIMES and any(
        cell.startswith(PRECIPITATION) and "[" not in cell for cell in cells
    ))


def _split_header(head: bytes) -> list[str]:
    text = head.decode("utf-8", "replace").removeprefix("\ufeff").lstrip()
    return [cell.strip(' "\r') for cell in re.split("[,;\t]", text.partition("\n")[0])]


# --- hours of both -----------------------------------------------------------------------------


def _read(
    file: Path, site: Place, quantity_of: Callable[[str], str | None]
) -> tuple[Table, Records]:
    """Return a file's table, and its hours by variable, with all values at the file's time stamps.

    Args:
        file: file with hourly values for one location.
        site: site that must be near the file's location, if both are known.
        quantity_of: function that returns the quantity of a variable, or None if the variable is
            not needed, and raises ValueError if the variable is unknown.

    Raises:
        ConfigurationError: if the file is malformed or is for a different location, if a time is
            out of order, if a unit is unknown, or if too few values are plausible; the message
            names the line or the key, and the value.
    """
    place, table = _read_tables(file)
    if place is None:
        places, parse = {}, partial(_parse, parse_time, zone=timezone.utc)
    else:
        parse = partial(_parse, parse_local_time, zone=_check_place(place, site))
        latitude, longitude = (
            read_number(place.cell(place.first, name)) for name in ("latitude", "longitude")
        )
        places = {file: (latitude, longitude)}
        table.require_columns(["time"], _SOURCE)
    columns: dict[str, Column] = {}
    without_unit: list[str] = []
    members = sum(cell.startswith(PRECIPITATION) for cell in table.header)
    for cell in table.header[1:]:
        name, _, text = cell.partition(" ")
        try:
            quantity = quantity_of(name)
        except ValueError as error:
            raise table.refuse(str(error), cell) from None
        if quantity is None:
            continue
        table.require_columns([cell], _SOURCE)
        known = {unit.name: unit for unit in UNITS[quantity]}
        text = text.strip("()") or next(iter(known))
        if text not in (*known, _NO_UNIT) or name in columns:
            raise table.refuse(
                f"must have the unit {' or '.join(known)}, and must occur only once", cell,
            )
        if text == _NO_UNIT:
            without_unit.append(cell)
        columns[name] = Column(
            table, cell, quantity, known.get(text, next(iter(known.values()))),
            optional=members > 1 or None,
        )
    first, values = table.read_hours(table.header[0], columns, parse, "2024-06-01T12:00")
    for cell in without_unit:
        if not columns[cell.partition(" ")[0]].is_empty:
            raise table.refuse("must have a known unit, because the column contains values", cell)
    return table, Records(
        (file,), first, values, left_out=tuple(table.notes), places=places,
        wind_height=_WIND_HEIGHT_M,
    )


def _read_tables(file: Path) -> tuple[Table | None, Table]:
    """Return the tables of a file's location (None if not stated) and of its hours."""
    if next(filter(str.strip, read_lines(file))).lstrip().startswith(("{", "[")):
        return _read_json_tables(file, read_text(file))
    lines = number_lines(read_lines(file))
    about = list(itertools.islice(lines, 2))
    if about and _OFFSET not in about[0][1]:
        return None, read_table(file, itertools.chain(about, lines))
    hours = _select_hours(file, about, lines)
    header = next(hours, None)
    if header is None:
        raise ConfigurationError(
            "must begin with two lines that describe the location, followed by a header and "
            "records", file=file
        )
    return read_table(file, about), read_table(file, itertools.chain([header], hours))


def _parse(parse: Callable[[str, tzinfo], datetime], text: str, zone: tzinfo) -> datetime:
    """Return the time in a text, which can also be in seconds since 1970 (``unixtime``)."""
    if _UNIX_TIME.fullmatch(text):
        return parse_unix_time(text).astimezone(zone)
    return parse(text, zone)


def _select_hours(
    file: Path, about: Sequence[tuple[int, str]], lines: Iterator[tuple[int, str]]
) -> Iterator[tuple[int, str]]:
    """Return the header and the lines of the hourly section, without the other sections.

    The service writes one section each for ``current``, ``minutely_15``, ``hourly`` and ``daily``,
    as selected on its web page. If none of the sections is hourly, the first section is returned.
    An appended download begins with a copy of the lines ``about`` the location.
    """
    sections: list[list[tuple[int, str]]] = []
    broken: ConfigurationError | None = None
    try:
        for line in lines:
            if _OFFSET in line[1]:
                place = next(lines, (0, ""))[1]
                if [line[1].strip(), place.strip()] != [text.strip() for _, text in about]:
                    raise ConfigurationError(
                        "begins a download for a different location or time zone: move it to a "
                        "separate file",
                        file=file, line=line[0],
                    )
                continue
            if _SECTION.match(line[1]) or not sections:
                sections.append([])
            sections[-1].append(line)
    except ConfigurationError as error:  # reported when its line is read
        broken = error
    of_hours = [section for section in sections if _may_be_hours(section[1:_JUDGED_ROWS])]
    yield from itertools.chain.from_iterable(of_hours or sections[:1])
    if broken is not None:
        raise broken


def _may_be_hours(rows: Sequence[tuple[int, str]]) -> bool:
    """Return True if most rows of a section may be hourly; wrong times are rejected later."""
    if len(rows) < 2:
        return False
    try:
        times = [
            _parse(parse_time, re.split("[,;\t]", row)[0].strip('"'), timezone.utc)
            for _, row in rows
        ]
    except ValueError:
        return True
    apart = sorted(later - time for time, later in itertools.pairwise(times))[len(times) // 2 - 1]
    return not (timedelta() < apart < HOUR or apart >= _DAY_H * HOUR)


def _read_json_tables(file: Path, text: str) -> tuple[Table, Table]:
    """Return the location and the hours of a JSON response as tables of text, as in CSV."""
    refuse = partial(ConfigurationError, file=file)
    try:
        content = json.loads(text, parse_int=str, parse_float=str, parse_constant=str)
    except json.JSONDecodeError as error:
        raise refuse(f"is not valid JSON: {error}", line=error.lineno) from error
    except RecursionError as error:
        raise refuse("is JSON that is nested too deeply to be a response of Open-Meteo") from error
    if isinstance(content, list) and "hourly" in str(content)[:_JUDGED_ROWS]:
        raise refuse("must be for a single location; download each location separately")
    if not isinstance(content, dict):
        raise refuse(_OTHER_JSON)
    why = next((content[key] for key in _MESSAGES if isinstance(content.get(key), str)), "")
    if content.get("error") or (why and "hourly" not in content):
        raise refuse(f"is not a forecast but an error message from the service: {clean_text(why)}")
    units, hourly = (content.get(key, {}) for key in ("hourly_units", "hourly"))
    for key, value in (("hourly_units", units), ("hourly", hourly)):
        if not isinstance(value, dict):
            raise refuse("must be a mapping, as in a response with hourly data", key=key)
    if "hourly" not in content:
        present = ", ".join(key for key in ("current", "minutely_15", "daily") if key in content)
        raise refuse(
            f"contains no hourly values, only {present}; download hourly variables" if present
            else _OTHER_JSON
        )
    hourly = {"time": [], **hourly}
    for name, series in hourly.items():
        if not isinstance(series, list) or len(series) != len(hourly["time"]) or not series:
            raise refuse("must be a list with one value for each time", key=f"hourly.{name}")
    about = [_write_cell(value, "NaN") for value in content.values()]
    hours = {
        name if name == "time" else f"{name} ({units.get(name) or ''})": [*map(_write_cell, series)]
        for name, series in hourly.items()
    }
    return (
        Table(file, [*content], [(None, about)]),
        Table(file, [*hours], zip(itertools.repeat(None), zip(*hours.values(), strict=True)),
              key="hourly."),
    )


def _write_cell(value: Any, missing: str = "") -> str:
    """Return the text of a JSON value, as it would be in CSV."""
    return missing if value is None else str(value)


def _check_place(place: Table, site: Place) -> timezone:
    """Return a location's UTC offset; reject a location known not to be near the site.

    Raises:
        ConfigurationError: if the location is not near the site, or if its coordinates or UTC
            offset are invalid.
    """
    row = place.first
    if "location_id" in place.header:
        raise place.refuse(
            "must be for a single location; download each location separately", "location_id", row
        )
    place.require_columns([_OFFSET, *_PLACE], _SOURCE)
    offset = place.read_number(row, _OFFSET, Range(-43200.0, 50400.0, "s"))  # UTC-12 to UTC+14
    if offset % 3600:
        raise place.refuse(
            "must be a whole number of hours, because the service's data are for whole hours in "
            "UTC; download the data again in GMT (timezone=GMT)", _OFFSET, row,
        )
    for name, (maximum, end) in _PLACE.items():
        # The service writes an unknown elevation as NaN.
        missing = ["NaN"] if name == "elevation" else []
        unit = "m" if name == "elevation" else "degrees"
        value = place.read_number(row, name, Range(-end, end, unit), missing)
        own: float | None = getattr(site, name)
        if own is None or math.isnan(value):
            continue
        away = abs(value - own)
        if name == "longitude":  # 179.9 and -179.9 are neighbours
            away = min(away, 360 - away)
        if away > maximum:
            raise place.refuse(
                f"must be within {maximum:g} {unit} of the site's {name}, {own:g}", name, row
            )
    return timezone(timedelta(seconds=offset))


# --- past weather ------------------------------------------------------------------------------


def read_records(file: Path, site: Place, /) -> Records:
    """Read past weather; empty cells and ``NaN`` are missing values.

    All values are from weather models. Precipitation is required. Quantities from which
    evapotranspiration is computed are used if the file contains them, and other variables are
    ignored.

    Args:
        file: file for a single location.
        site: site that must be near the file's location, if both are known.

    Raises:
        ConfigurationError: if :func:`_read` raises one, or if a column is missing.
    """
    table, records = _read(file, site, _QUANTITIES.get)
    values: dict[str, NDArray[np.float64]] = {}
    for variable, series in records.values.items():
        values.setdefault(_QUANTITIES[variable], series)
    values = add_dew_point(values)
    if PRECIPITATION not in values:
        table.require_columns([f"{PRECIPITATION} (mm)"], _SOURCE)
    if not records.places:
        records = replace(records, left_out=(*records.left_out, (
            f"{file.name}: the variables have the names of Open-Meteo's variables, so times "
            "without an offset are interpreted as UTC"
        )))
    shifted = tuple(quantity for quantity in (PRECIPITATION, RADIATION) if quantity in values)
    # One more hour: the hour before the first time has only rain and radiation, the last has
    # neither.
    nothing = np.array([math.nan])
    return replace(records, first=records.first - HOUR, rain_kind=REANALYSIS, values={
        quantity: np.concatenate((series, nothing) if quantity in shifted else (nothing, series))
        for quantity, series in values.items()
    }, shifted=shifted)


# --- forecasts ---------------------------------------------------------------------------------


def read_archive(files: Sequence[Path], site: Place, /) -> Archive:
    """Read forecasts from files of previous runs, or from files that each contain one run.

    Args:
        files: one or more files.
        site: site that must be near the location of every file, if the file states its location.

    Raises:
        ConfigurationError: if :func:`_read` raises one, if the files are of different kinds or
            models, or if the files lack required values of a run or an hour.
    """
    parts, notes = _read_usable(files, lambda file: _read_precipitation(file, site))
    previous = [any(map(_PREVIOUS.fullmatch, part.values)) for part in parts]
    if not any(previous):
        runs, more = _read_usable(
            parts, lambda part: _select_run(part, _read_run_time(part.files[0]))
        )
        return Archive(
            files[0], "Open-Meteo, runs", runs, SERVICE_DELAY_H, runs, notes=(*notes, *more)
        )
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
        _make_daily(whole), _DAY_H, (*notes, *whole.left_out),
    )


def _read_usable(sources: Iterable[_S], read: Callable[[_S], _T]) -> tuple[list[_T], list[str]]:
    """Return the results of reading all usable sources, and a note about each unusable source.

    Among thousands of downloads, some contain error messages from the service or are truncated.

    Raises:
        ConfigurationError: if no source can be used; the error is that of the first source.
    """
    read_ones, errors = [], []
    for source in sources:
        try:
            read_ones.append(read(source))
        except ConfigurationError as error:
            errors.append(error)
    if not read_ones:
        raise errors[0]
    return read_ones, [f"{error}; the file is left out" for error in errors]


def _read_precipitation(file: Path, site: Place) -> Records:
    """Return the precipitation by variable; values are for the hour after their time stamps."""
    table, hours = _read(file, site, _find_quantity)
    if not hours.values:
        raise table.refuse(
            "must contain precipitation, precipitation_member01 or precipitation_previous_day1"
        )
    return replace(hours, first=hours.first - HOUR)


def _find_quantity(name: str) -> str | None:
    if not name.startswith(PRECIPITATION) or name.startswith("precipitation_probability"):
        return None
    if not (_PREVIOUS.fullmatch(name) or _MEMBER.fullmatch(name)):
        raise ValueError(
            "must be precipitation, precipitation_previous_day1 to 7 or precipitation_member01, "
            "02 and so on; download each model separately"
        )
    return PRECIPITATION


def read_run(file: Path, site: Place, issued: datetime) -> IssuedForecast:
    """Read a response as a forecast with a known time of issue.

    Args:
        file: file for a single location.
        site: site that must be near this location.
        issued: start of the first hour; earlier hours in the file are skipped.

    Raises:
        ConfigurationError: if :func:`_read` raises one, or if the file contains no
            precipitation from this hour on.
    """
    return _select_run(_read_precipitation(file, site), issued)


def _select_run(hours: Records, run: datetime) -> IssuedForecast:
    """Return the run in a file; the series without a number is the control run, member 0."""
    (file,) = hours.files
    refuse = partial(ConfigurationError, file=file)
    start, rest = divmod(run - hours.first, HOUR)
    if rest or not 0 <= start < hours.hours:
        raise refuse(
            f"must contain the hour after its run, {to_minutes(run)}, but the first time is "
            f"{to_minutes(hours.first + HOUR)}"
        )
    # Some runs have no control run, and a download may lack a member.
    series = [hours.values[name] for name in sorted(filter(_MEMBER.fullmatch, hours.values))]
    issue = join_members(
        (number, IssuedForecast(run, file, None, member[None, start:]))
        for number, member in enumerate(series)
    )
    if issue.hours > _MAX_RUN_H:
        raise refuse(
            f"has {issue.hours} hours, but a run covers at most {_MAX_RUN_H} hours. For a longer "
            "period in the past, use previous runs, precipitation_previous_day1 and so on"
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
