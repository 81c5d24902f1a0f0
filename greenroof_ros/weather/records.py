"""Hourly records of weather: made from the rows of files, joined, and written again."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import duration, to_minutes
from greenroof_ros.weather.description import END, LONG, PLACE
from greenroof_ros.weather.quantities import (
    DEW_POINT,
    EVAPOTRANSPIRATION,
    HUMIDITY,
    PRECIPITATION,
    QUANTITIES,
    TEMPERATURE,
    WIND,
)
from greenroof_ros.weather.table import Rows

Array = NDArray[np.float64]
HOUR = timedelta(hours=1)
# Minimum share of an hour for which rain must be known; other quantities need only one value.
_ENOUGH = 0.75
_HOUR_S = 3600.0
# Rounding errors of times (s).
_ROUNDING_S = 1e-6


@dataclass(frozen=True)
class Records:
    """Consecutive hourly values; each value is for the hour that starts at its time stamp.

    Attributes:
        files: files that contain the values, in chronological order.
        first: start of the first hour, with a UTC offset.
        values: values of every quantity, keyed by name, shape (hours,); NaN if missing. The names
            are the quantities of :data:`.quantities.QUANTITIES` that the files contain, with the
            units of that table, or the columns of forecasts.
        method: method of the evapotranspiration; empty if the values contain no evapotranspiration.
        shifted: quantities whose times are ends of rows, in files whose other times are starts.
        rain_late: delay of the rain's time stamps (h): 1 if they are at the end of the hour in the
            files and the rain was not moved to the start, otherwise 0.
        filled: mask of the hours that were missing and have been filled, by quantity, shape
            (hours,).
        left_out: sentences about data that could not be used unchanged.
        places: latitude and longitude (degrees), by file, for files that state a position.
        wind_height: height at which the wind was measured (m); None if the height in the site file
            applies.
        minutes: rain in every minute (mm/h), shape (hours, 60); NaN in minutes not covered by rows
            shorter than an hour, and None without such rows. The precipitation of an hour with
            known minutes is their mean.
        rain_kind: one of :data:`.description.RAIN_KINDS` if any of the rain is of this kind;
            otherwise empty.
        applied: what was applied to the rows of the files: form, units, step, and whether times are
            starts or ends.
    """

    files: tuple[Path, ...]
    first: datetime
    values: dict[str, Array]
    method: str = ""
    shifted: tuple[str, ...] = ()
    rain_late: int = 0
    filled: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    places: dict[Path, tuple[float, float]] = field(default_factory=dict)
    wind_height: float | None = None
    minutes: Array | None = None
    rain_kind: str = ""
    applied: tuple[str, ...] = ()

    @property
    def hours(self) -> int:
        """Number of hours."""
        return len(next(iter(self.values.values())))

    @property
    def finest_rain(self) -> Array:
        """Rain (mm/h) in every minute, shape (hours, 60), or else in hours, shape (hours, 1)."""
        rain = self.values[PRECIPITATION][:, None]
        minutes = rain if self.minutes is None else self.minutes
        return np.where(np.isnan(minutes), rain, minutes)

    def cut(self, begin: int, end: int) -> Self:
        """Return the hours from one to another (exclusive)."""
        return replace(
            self, first=self.first + begin * HOUR,
            minutes=None if self.minutes is None else self.minutes[begin:end],
            values={name: series[begin:end] for name, series in self.values.items()},
        )

    @property
    def source(self) -> str:
        """Common name of all files, for messages and tables."""
        return name_files(self.files)

    @property
    def rain_note(self) -> str:
        """Warning that must accompany every result computed from the rain; usually empty."""
        return self.rain_kind and (
            f"rain is from a {self.rain_kind}, whose values are means over a grid cell; its "
            "peaks are lower than those of a rain gauge, so overflow, discharge and peak runoff "
            "are underestimated"
        )


def average_minutes(minutes: Array) -> Array:
    """Return the mean rain in every hour; NaN if less than 0.75 of its minutes are known."""
    count = np.count_nonzero(~np.isnan(minutes), axis=1)
    # Tenths of a millimetre do not add up exactly in binary numbers.
    means = np.round(np.nansum(minutes, axis=1) / np.maximum(count, 1), 9)
    return np.where(count >= _ENOUGH * minutes.shape[1], means, np.nan)


def add_dew_point(values: Mapping[str, Array]) -> dict[str, Array]:
    """Replace relative humidity with the dew point (FAO-56 Eqs. 11 and 14)."""
    rest = {name: series for name, series in values.items() if name != HUMIDITY}
    if HUMIDITY in values and TEMPERATURE in values:
        share, warmth = np.clip(values[HUMIDITY], 1.0, 100.0) / 100, values[TEMPERATURE]
        vapour = np.log(share) + 17.27 * warmth / (warmth + 237.3)
        dew_point = 237.3 * vapour / (17.27 - vapour)
        given = values.get(DEW_POINT, dew_point)
        rest[DEW_POINT] = np.where(np.isnan(given), dew_point, given)
    return rest


def bridge_gaps(series: Array, max_hours: int) -> Array:
    """Fill gaps of up to ``max_hours`` in hourly values by linear interpolation."""
    filled = series.copy()
    for low, high in find_gaps(np.isnan(series)):
        if high - low <= max_hours and low > 0 and high < len(series):
            filled[low:high] = np.interp(range(low, high), [low - 1, high], series[[low - 1, high]])
    return filled


def name_files(files: Sequence[Path]) -> str:
    """Return a common name for files: a single file's path, or their number, first and last names.

    The name is empty if there are no files.
    """
    if len(files) < 2:
        return "".join(map(str, files))
    return str(files[0].parent / f"{len(files)} files, {files[0].name} to {files[-1].name}")


def find_gaps(missing: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the gaps in values, each as (index of the first, index after the last)."""
    padded = np.concatenate(([False], missing, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded))
    return [(int(low), int(high)) for low, high in zip(edges[::2], edges[1::2], strict=True)]


def name_hours(first: datetime, marks: NDArray[np.bool_]) -> list[str]:
    """Return descriptions of the periods formed by marked hours.

    Args:
        first: start of hour 0.
        marks: mask of the hours.

    Returns:
        One text for every period: ``2021-07-20T13:00-05:00`` for a single hour, otherwise the first
        and the last hour and the number of hours.
    """
    spans = [(first + low * HOUR, high - low) for low, high in find_gaps(marks)]
    return [
        to_minutes(begin) if hours == 1 else
        f"{to_minutes(begin)} to {to_minutes(begin + (hours - 1) * HOUR)} ({hours} hours)"
        for begin, hours in spans
    ]


# --- rows ----------------------------------------------------------------------------------------


def make_hours(parts: Sequence[Rows]) -> Records:
    """Return hourly records from the rows of one or more files.

    The values of each hour are for the hour that starts at its time stamp. Hours begin at the full
    hour, or at the minute at which those of the first file begin if its rows are one hour apart. A
    row that begins in one hour and ends in the next counts in both, by its share. A value that is
    in no file is missing (NaN). If rows of rain are less than one hour apart, rain is stored in
    minutes, and the rain of an hour is the mean of its minutes, of which 0.75 must be known.

    Args:
        parts: rows of files. The files may have the same quantities, or some of them other
            quantities.

    Raises:
        ConfigurationError: if the rows of a file are more than one hour apart, or no column is
            weather; if two files have values for the same time, only some quantities in common or
            different methods of evapotranspiration. The message names both files.
    """
    parts = sorted(parts, key=lambda rows: rows.begins[0])
    for rows in parts:
        if not rows.values:
            raise rows.table.refuse("must have a column of weather, such as 'rain [mm]'")
        if rows.step_s > _HOUR_S:
            apart = duration(rows.step_s)
            raise rows.table.refuse(f"rows must be at most one hour apart, not {apart}: {LONG}")
        _check_same_kind(next(each for each in parts if each.values.keys() & rows.values), rows)
    first = parts[0].first
    if parts[0].step_s < _HOUR_S:
        first = first.replace(minute=0, second=0, microsecond=0)
    hours, values, minutes = _count_hours(parts, first), dict[str, Array](), None
    for name in dict.fromkeys(name for rows in parts for name in rows.values):
        joined = _join(parts, name, first)
        values[name] = _average_hours(*joined, hours)
        if name == PRECIPITATION and (joined[1] < _HOUR_S).any():
            minutes = _spread_over_minutes(*joined, hours)
            values[name] = average_minutes(minutes)
    applied, ends = dict[str, list[Path]](), set[str]()
    files = Counter(rows.table.file for rows in parts)
    for rows in parts:
        applied.setdefault(describe_rows(rows), []).append(rows.table.file)
        if rows.described.rows == END and files[rows.table.file] > 1:
            ends |= rows.values.keys()
    about = [rows.described for rows in parts]
    return Records(
        (*files,), first, add_dew_point(values),
        max(rows.method for rows in parts),
        shifted=tuple(name for name in values if name in ends),
        rain_late=max(each.rain_late for each in about),
        places={
            rows.table.file: (each.latitude, each.longitude)
            for rows, each in zip(parts, about, strict=True)
            if each.latitude is not None and each.longitude is not None
        },
        wind_height=min(parts, key=lambda rows: WIND not in rows.values).described.wind_height,
        minutes=minutes,
        rain_kind=max(
            (each.described.rain_kind for each in parts if PRECIPITATION in each.values), default=""
        ),
        applied=tuple(
            text if len(applied) == 1 else f"{name_files(sources)}: {text}"
            for text, sources in applied.items()
        ),
    )


def _check_same_kind(first: Rows, rows: Rows) -> None:
    expected, present = ({
        "quantities": ", ".join(sorted(each.values)),
        "method of evapotranspiration": each.method or "none",
        "delay of the rain": f"{each.described.rain_late} h",
    } for each in (first, rows))
    for aspect, text in expected.items():
        if text != present[aspect]:
            raise ConfigurationError(
                f"must have the same {aspect} as {first.table.file}, {text}; it has "
                f"{present[aspect]}", file=rows.table.file,
            )


def _count_hours(parts: Sequence[Rows], first: datetime) -> int:
    """Return the number of hours up to the last of which the rows know enough."""
    counts = list[int]()
    for rows in parts:
        end = float(rows.begins[-1] - first.timestamp() + rows.step_s) / _HOUR_S
        counts.append(math.ceil(end) if rows.step_s < _HOUR_S else math.floor(end + 1 - _ENOUGH))
    return max(counts)


def _join(parts: Sequence[Rows], name: str, first: datetime) -> tuple[Array, Array, Array]:
    """Return the known values of a quantity in the rows of all files, in chronological order.

    Returns:
        Starts of the rows (s from the first hour), their durations (s), and the values.

    Raises:
        ConfigurationError: if two files have values for the same time.
    """
    own = [rows for rows in parts if name in rows.values]
    begins = np.concatenate([rows.begins for rows in own]) - first.timestamp()
    sizes = [len(rows.steps) for rows in own]
    seconds, files = (np.repeat(each, sizes) for each in ([r.step_s for r in own], range(len(own))))
    values = np.concatenate([rows.values[name] for rows in own])
    order = np.argsort(begins, kind="stable")
    order = order[~np.isnan(values[order])]
    begins, seconds, files, values = (each[order] for each in (begins, seconds, files, values))
    twice = np.flatnonzero(begins[1:] < begins[:-1] + seconds[:-1] - _ROUNDING_S)
    if twice.size:
        one, other = files[twice[0] : twice[0] + 2]
        time = first + timedelta(seconds=begins[twice[0] + 1])
        raise ConfigurationError(
            f"is also in {own[one].table.file}: files must not overlap",
            file=own[other].table.file, key=f"{name} at {to_minutes(time)}",
        )
    return begins, seconds, values


def describe_rows(rows: Rows) -> str:
    """Return what was applied to the rows of a file."""
    units = ", ".join(
        f"{name} in {unit}" for name, (_, unit) in rows.columns.items() if name in rows.values
    )
    ignored = f"; not read: {', '.join(rows.ignored)}" if rows.ignored else ""
    return (
        f"{rows.described.name}, {units}, rows of {duration(rows.step_s)} whose time "
        f"is their {rows.described.rows}, at {rows.first:%Z}{ignored}"
    )


def _spread_over_minutes(begins: Array, seconds: Array, rain: Array, hours: int) -> Array:
    """Return the mean rain in every minute, shape (hours, 60); NaN in minutes without a row.

    Args:
        begins: starts of the rows relative to the first hour (s).
        seconds: durations of the rows (s).
        rain: rain in the rows (mm/h).
        hours: number of hours.
    """
    edges = np.maximum.accumulate(np.stack((begins, begins + seconds), axis=1).ravel())
    seconds, minutes = np.diff(edges)[::2], 60 * np.arange(60 * hours + 1)
    sums = np.zeros((2, len(edges)))
    sums[:, 1::2] = rain * seconds, seconds
    fallen, there = (np.diff(np.interp(minutes, edges, each)) for each in sums.cumsum(axis=1))
    rates = np.divide(fallen, there, out=np.full(len(there), math.nan), where=there > _ROUNDING_S)
    # Sums of binary numbers are rounded.
    return np.asarray(np.round(rates, 9).reshape(hours, 60))


def _average_hours(begins: Array, seconds: Array, values: Array, hours: int) -> Array:
    """Return the mean of the rows in every hour, shape (hours,); NaN in hours without a row.

    Args:
        begins: as for :func:`_spread_over_minutes`.
        seconds: as for :func:`_spread_over_minutes`.
        values: values of the rows.
        hours: number of hours.
    """
    of_begin = (begins // _HOUR_S).astype(np.intp)
    of_end = ((begins + seconds - _ROUNDING_S) // _HOUR_S).astype(np.intp)
    late = np.where(of_end > of_begin, begins + seconds - _HOUR_S * of_end, 0.0) / seconds
    rows, total = (
        np.bincount(of_begin, (1 - late) * each, hours)[:hours]
        + np.bincount(of_end, late * each, hours)[:hours]
        for each in (np.ones(len(values)), values)
    )
    means = np.divide(total, rows, out=np.full(hours, math.nan), where=rows >= _ENOUGH)
    # Tenths do not add up exactly in binary numbers.
    return np.asarray(np.where(rows > 1, np.round(means, 9), means))


def write_records(records: Records, about: str) -> str:
    """Return records as the text of a file, which :func:`.read.read_file` reads back bit for bit.

    If the rain is known for every minute, the time step of the rows is the longest that preserves
    it; other values are in the first row of their hour.

    Args:
        records: hourly records for one location; gaps are written as empty cells.
        about: text of the first comment, of one or more lines.
    """
    places, rain, names = {*records.places.values()}, records.finest_rain, [*records.values]
    changes = np.diff(np.nan_to_num(rain, nan=-1.0), axis=1).any(axis=0)
    step = math.gcd(rain.shape[1], *(1 + np.flatnonzero(changes)).tolist())
    rows = rain.shape[1] // step
    table = np.full((len(names), records.hours, rows), math.nan)
    table[:, :, 0] = [*records.values.values()]
    table[names.index(PRECIPITATION)] = rain[:, ::step]
    stated: dict[str, object] = {
        "wind_height": records.wind_height, "rain_late": records.rain_late,
        "rain_kind": records.rain_kind, "step": 3600 // rows,
    }
    if len(places) == 1:
        stated |= zip(PLACE, map(str, *places), strict=True)
    titles = (f"{records.method} {name}" if name == EVAPOTRANSPIRATION else name for name in names)
    lines = [
        *(f"# {line}" for line in (*about.splitlines(), *filter(None, [records.rain_note]))),
        *(f"# {key}: {value}" for key, value in stated.items() if value),
        ",".join(["time", *(
            f"{title} [{QUANTITIES[name].unit}]" for name, title in zip(names, titles, strict=True)
        )]),
    ]
    for row, numbers in enumerate(table.reshape(len(names), -1).T.tolist()):
        cells = ("" if math.isnan(number) else repr(number) for number in numbers)
        lines.append(",".join([(records.first + row * HOUR / rows).isoformat(), *cells]))
    return "\n".join([*lines, ""])
