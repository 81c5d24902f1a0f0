"""Hourly records of weather: made from the rows of files, joined, and written again."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import duration, to_minutes
from greenroof_ros.weather.description import PLACE
from greenroof_ros.weather.quantities import (
    DEW_POINT,
    EVAPOTRANSPIRATION,
    HUMIDITY,
    PRECIPITATION,
    QUANTITIES,
    ROOF,
    TEMPERATURE,
    WIND,
)
from greenroof_ros.weather.table import Rows

Array = NDArray[np.float64]
HOUR = timedelta(hours=1)
# Minimum share of an hour for which rain must be known; other quantities need only one value.
_ENOUGH = 0.75
_MINUTE, _MINUTES = timedelta(minutes=1), "minutes"
WEATHER = [name for name in QUANTITIES if name not in ROOF]
"""the quantities of weather"""


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
        shifted: quantities with time stamps at the end of the hour in the files, which were moved
            to its start.
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
    def parts_of_hours(self) -> NDArray[np.bool_]:
        """Mask of the hours of which only some minutes are known, shape (hours,)."""
        if self.minutes is None:
            return np.zeros(self.hours, dtype=bool)
        known = ~np.isnan(self.minutes)
        return np.asarray(known.any(axis=1) & ~known.all(axis=1))

    @property
    def finest_rain(self) -> Array:
        """Rain (mm/h) in every minute, shape (hours, 60), or else in hours, shape (hours, 1)."""
        rain = self.values[PRECIPITATION][:, None]
        minutes = rain if self.minutes is None else self.minutes
        return np.where(np.isnan(minutes), rain, minutes)

    @property
    def arrays(self) -> dict[str, Array]:
        """The values of every quantity and, if known, the rain of minutes, under ``minutes``."""
        return self.values if self.minutes is None else {**self.values, _MINUTES: self.minutes}

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

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes about changes to the values of the files, except the filling of gaps."""
        if not self.shifted:
            return self.left_out
        return (
            f"{' and '.join(self.shifted)} in the files are for the hour before the time stamp, "
            "and were moved back by one hour", *self.left_out,
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


def join_records(parts: Sequence[Records]) -> Records:
    """Join the records of more than one file.

    The files may have the same quantities, or some of them other quantities. A value that is in no
    file is missing (NaN). No value may be in more than one file, except in an hour that a file
    covers only in part. In such an hour, the values of other files take precedence, and the rain is
    computed from the minutes of all files. If the hours of a file begin at a different minute from
    those of the first file, each value becomes the mean of the two hours that it overlaps, and
    values from other files take precedence.

    Raises:
        ConfigurationError: if two files have values for the same time, only some quantities in
            common, different methods of evapotranspiration or different conventions for time
            stamps. The message names both files.
    """
    given = sorted(parts, key=lambda part: part.first)
    first = given[0]
    for part in given:
        _check_same_kind(next(other for other in given if other.values.keys() & part.values), part)
    parts = [_shift_to_hours_of(first, part) for part in given]
    begins = [(part.first - first.first) // HOUR for part in parts]
    hours = max(begin + part.hours for begin, part in zip(begins, parts, strict=True))
    values = {
        name: np.full((hours, *series.shape[1:]), np.nan)
        for part in parts for name, series in part.arrays.items()
    }
    for certain in (True, False):
        for begin, part, own in zip(begins, parts, given, strict=True):
            whole = np.full(part.hours, part is own) & ~part.parts_of_hours
            for name, series in part.arrays.items():
                joined = values[name][begin : begin + part.hours]
                known = ~np.isnan(series)
                if certain and name != _MINUTES:
                    known &= whole
                both = np.argwhere(known & ~np.isnan(joined))
                if certain and both.size:
                    raise _refuse_overlap(parts, part, name, both[0].tolist())
                np.copyto(joined, series, where=known & np.isnan(joined))
    minutes = values.pop(_MINUTES, None)
    if minutes is not None:
        means = average_minutes(minutes)
        np.copyto(values[PRECIPITATION], means, where=~np.isnan(means))
        minutes[np.isnan(means) & ~np.isnan(values[PRECIPITATION])] = np.nan
    parts = sorted(parts, key=lambda part: part.first)
    files, shifted, left_out, applied = (
        tuple(dict.fromkeys(each for part in parts for each in getattr(part, name)))
        for name in ("files", "shifted", "left_out", "applied")
    )
    return Records(
        files, first.first, values, max(part.method for part in parts), shifted,
        max(part.rain_late for part in parts), left_out=left_out, applied=applied, minutes=minutes,
        rain_kind=max(part.rain_kind for part in parts),
        places={file: place for part in parts for file, place in part.places.items()},
        wind_height=min(parts, key=lambda part: WIND not in part.values).wind_height,
    )


def _refuse_overlap(
    parts: Sequence[Records], part: Records, name: str, index: Sequence[int]
) -> ConfigurationError:
    """Return the error about a value of a part that is also in one of the other parts."""
    time = part.first + index[0] * HOUR + sum(index[1:]) * _MINUTE
    other = next(
        each for each in parts
        if each is not part and name in each.arrays
        and each.first <= time < each.first + each.hours * HOUR
    )
    return ConfigurationError(
        f"is also in {other.source}: files must not overlap", file=part.source,
        key=f"{PRECIPITATION if name == _MINUTES else name} at {to_minutes(time)}",
    )


def _check_same_kind(first: Records, part: Records) -> None:
    expected, present = ({
        "quantities": ", ".join(sorted(each.values)),
        "method of evapotranspiration": each.method or "none",
        "quantities for the hour before the time stamp": ", ".join(each.shifted) or "none",
        "delay of the rain": f"{each.rain_late} h",
    } for each in (first, part))
    for aspect, text in expected.items():
        if text != present[aspect]:
            raise ConfigurationError(
                f"must have the same {aspect} as {first.source}, {text}; it has {present[aspect]}",
                file=part.source,
            )


def _shift_to_hours_of(first: Records, part: Records) -> Records:
    """Shift records to hours that begin at the same minute as those of the first records."""
    late = (part.first - first.first) % HOUR
    if not late:
        return part
    share, late_min, minutes = late / HOUR, late // _MINUTE, part.minutes
    values = {
        name: share * np.append(np.nan, series) + (1 - share) * np.append(series, np.nan)
        for name, series in part.values.items()
    }
    if minutes is not None:
        edge = late_min, 60 - late_min
        minutes = np.pad(minutes.ravel(), edge, constant_values=np.nan).reshape(-1, 60)
        values[PRECIPITATION] = average_minutes(minutes)
    shifted = replace(
        part, first=part.first - late, minutes=minutes, values=values,
        left_out=(*part.left_out, (
            f"{part.source}: hours begin {late_min} min after those of {first.source}; "
            "each value is the mean of the two hours that it overlaps"
        )),
    )
    # Of its first and last hour, a part may know nothing.
    known = np.count_nonzero(~np.isnan(np.column_stack([*shifted.arrays.values()])), axis=1)
    return shifted.cut(int(known[0] == 0), shifted.hours - int(known[-1] == 0))


# --- rows ----------------------------------------------------------------------------------------


def make_hours(file: Path, rows: Rows) -> Records:
    """Return hourly records from rows.

    The values of each hour are for the hour that starts at its time stamp. If rows are less than
    one hour apart, rain is stored in minutes, and the rain of an hour is the mean of its minutes;
    the rain of an hour is missing if less than 0.75 of the minutes are known. Other quantities are
    averaged over the clock hours in which the rows begin.

    Raises:
        ConfigurationError: if the rows are more than one hour apart, or no column is weather.
    """
    if not rows.values:
        raise rows.table.refuse("must have a column of weather, such as 'rain [mm]'")
    if rows.step_s > 3600:
        raise rows.table.refuse(f"rows must be at most one hour apart, not {duration(rows.step_s)}")
    first, begins, minutes = rows.first, rows.step_s * rows.steps.astype(np.float64), None
    if rows.step_s < 3600:
        first = first.replace(minute=0, second=0, microsecond=0)
        begins += (rows.first - first).total_seconds()
    of_rows, count = (begins // 3600).astype(np.intp), math.ceil((begins[-1] + rows.step_s) / 3600)
    values = {name: _average_hours(series, of_rows, count) for name, series in rows.values.items()}
    if rows.step_s < 3600 and PRECIPITATION in values:
        minutes = _spread_over_minutes(rows.values[PRECIPITATION], begins, rows.step_s, count)
        values[PRECIPITATION] = average_minutes(minutes)
    about = rows.described
    place: Any = about.latitude, about.longitude
    return Records(
        (file,), first, add_dew_point(values), rows.method,
        rain_late=about.rain_late, applied=(describe_rows(rows),),
        places={} if None in place else {file: place},
        wind_height=about.wind_height, minutes=minutes,
        rain_kind=about.rain_kind if PRECIPITATION in values else "",
    )


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


def _spread_over_minutes(rain: Array, begins: Array, step_s: float, hours: int) -> Array:
    """Return the mean rain in every minute, shape (hours, 60); NaN in minutes without a row.

    Args:
        rain: rain in the rows (mm/h), NaN if missing.
        begins: starts of the rows relative to the first hour (s).
        step_s: interval of a row (s).
        hours: number of hours.
    """
    known = ~np.isnan(rain)
    edges = np.maximum.accumulate(np.stack((begins, begins + step_s), axis=1)[known].ravel())
    seconds, minutes = np.diff(edges)[::2], 60 * np.arange(60 * hours + 1)
    sums = np.zeros((2, len(edges)))
    sums[:, 1::2] = rain[known] * seconds, seconds
    fallen, there = (np.diff(np.interp(minutes, edges, each)) for each in sums.cumsum(axis=1))
    rates = np.divide(fallen, there, out=np.full(len(there), math.nan), where=there > 1e-6)
    # Sums of binary numbers are rounded.
    return np.asarray(np.round(rates, 9).reshape(hours, 60))


def _average_hours(series: Array, hours: NDArray[np.intp], count: int) -> Array:
    """Return the mean of the rows in every hour, shape (count,); NaN in hours without rows.

    Args:
        series: values of the rows, NaN if missing.
        hours: indices of the hours in which the rows begin.
        count: number of hours.
    """
    rows = np.bincount(hours, ~np.isnan(series), count)
    total = np.bincount(hours, np.nan_to_num(series), count)
    means = np.divide(total, rows, out=np.full(count, math.nan), where=rows > 0)
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
