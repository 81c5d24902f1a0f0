"""Hourly records of weather, and functions that fill gaps and join the records of files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import to_minutes
from greenroof_ros.weather.quantities import DEW_POINT, HUMIDITY, PRECIPITATION, TEMPERATURE

HOUR = timedelta(hours=1)
ENOUGH = 0.75
"""Minimum share of an hour for which rain must be known; other quantities need only one value."""
_MINUTE = timedelta(minutes=1)


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
    values: dict[str, NDArray[np.float64]]
    method: str = ""
    shifted: tuple[str, ...] = ()
    rain_late: int = 0
    filled: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    places: dict[Path, tuple[float, float]] = field(default_factory=dict)
    wind_height: float | None = None
    minutes: NDArray[np.float64] | None = None
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
        known = np.count_nonzero(~np.isnan(self.minutes), axis=1)
        return np.asarray((known > 0) & (known < self.minutes.shape[1]))

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


def average_minutes(minutes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean rain in every hour; NaN if less than 0.75 of its minutes are known."""
    count = np.count_nonzero(~np.isnan(minutes), axis=1)
    # Tenths of a millimetre do not add up exactly in binary numbers.
    means = np.round(np.nansum(minutes, axis=1) / np.maximum(count, 1), 9)
    return np.where(count >= ENOUGH * minutes.shape[1], means, np.nan)


def add_dew_point(values: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Replace relative humidity with the dew point (FAO-56 Eqs. 11 and 14)."""
    rest = {name: series for name, series in values.items() if name != HUMIDITY}
    if HUMIDITY in values and TEMPERATURE in values:
        share, warmth = np.clip(values[HUMIDITY], 1.0, 100.0) / 100, values[TEMPERATURE]
        vapour = np.log(share) + 17.27 * warmth / (warmth + 237.3)
        dew_point = 237.3 * vapour / (17.27 - vapour)
        given = values.get(DEW_POINT, dew_point)
        rest[DEW_POINT] = np.where(np.isnan(given), dew_point, given)
    return rest


def bridge_gaps(series: NDArray[np.float64], max_hours: int) -> NDArray[np.float64]:
    """Fill gaps of up to ``max_hours`` in hourly values by linear interpolation."""
    filled = series.copy()
    for low, high in find_gaps(np.isnan(series)):
        if high - low <= max_hours and low > 0 and high < len(series):
            filled[low:high] = np.interp(
                np.arange(low, high), [low - 1, high], series[[low - 1, high]]
            )
    return filled


def name_files(files: Sequence[Path]) -> str:
    """Return a common name for files: a single file's path, or their number, first and last names.

    The name is empty if there are no files.
    """
    if not files:
        return ""
    if len(files) == 1:
        return str(files[0])
    return str(files[0].parent / f"{len(files)} files, {files[0].name} to {files[-1].name}")


def find_gaps(missing: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the gaps in values, each as (index of the first, index after the last)."""
    padded = np.concatenate(([False], missing, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded))
    return [(int(low), int(high)) for low, high in zip(edges[::2], edges[1::2], strict=True)]


def name_hours(first: datetime, hours: Iterable[int]) -> list[str]:
    """Return descriptions of the periods formed by consecutive hours.

    Args:
        first: start of hour 0.
        hours: indices of the hours.

    Returns:
        One text for every period: ``2021-07-20T13:00-05:00`` for a single hour, otherwise the first
        and the last hour and the number of hours.
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


def number_days(days: NDArray[np.datetime64]) -> NDArray[np.int64]:
    """Return the day of the year of every date, from 1."""
    since = (days - days.astype("datetime64[Y]")).astype("timedelta64[D]")
    return np.asarray(since.astype(np.int64) + 1)


def join_records(parts: Sequence[Records]) -> Records:
    """Join the records of more than one file.

    The records are sorted by time. A value that is in no file is missing (NaN). No value may be in
    more than one file, except in an hour that a file covers only in part. In such an hour, the
    values of other files take precedence, and the rain is computed from the minutes of all files.
    If the hours of a file begin at a different minute from those of the first file, each value
    becomes the mean of the two hours that it overlaps, and values from other files take precedence.
    Some services have one file per quantity; files without any quantity of the first file are
    joined by quantity.

    Raises:
        ConfigurationError: if two files have values for the same time, different quantities,
            different methods of evapotranspiration or different conventions for time stamps. The
            message names both files.
    """
    first = min(parts, key=lambda part: part.first)
    others = [part for part in parts if part.values.keys().isdisjoint(first.values)]
    if others:
        alike = [part for part in parts if not part.values.keys().isdisjoint(first.values)]
        return _add_quantities(join_records(alike), join_records(others))
    for part in parts:
        _check_same_kind(first, part)
    moved = [part for part in parts if (part.first - first.first) % HOUR]
    parts = [
        *sorted((part for part in parts if part not in moved), key=lambda part: part.first),
        *(_shift_to_hours_of(first, part) for part in moved),
    ]
    begins = [(part.first - first.first) // HOUR for part in parts]
    hours = max(begin + part.hours for begin, part in zip(begins, parts, strict=True))
    values = {quantity: np.full(hours, np.nan) for quantity in first.values}
    wholes = [~part.parts_of_hours for part in parts]
    for begin, part, whole in zip(begins, parts, wholes, strict=True):
        for quantity, series in part.values.items():
            joined = values[quantity][begin : begin + part.hours]
            known = whole & ~np.isnan(series)
            if part.source in [other.source for other in moved]:
                known &= np.isnan(joined)
            both = np.flatnonzero(known & ~np.isnan(joined))
            if both.size:
                hour = int(both[0])
                other = next(
                    part for at, part, whole in zip(begins, parts, wholes, strict=True)
                    if 0 <= begin + hour - at < part.hours and whole[begin + hour - at]
                    and not np.isnan(part.values[quantity][begin + hour - at])
                )
                raise _refuse_overlap(part, other.source, quantity, part.first + hour * HOUR)
            joined[known] = series[known]
    for begin, part in zip(begins, parts, strict=True):
        for quantity, series in part.values.items():
            joined = values[quantity][begin : begin + part.hours]
            np.copyto(joined, series, where=np.isnan(joined))
    minutes = _join_minutes(hours, zip(begins, parts, strict=True))
    if minutes is not None:
        means = average_minutes(minutes)
        np.copyto(values[PRECIPITATION], means, where=~np.isnan(means))
        minutes[np.isnan(means) & ~np.isnan(values[PRECIPITATION])] = np.nan
    parts = sorted(parts, key=lambda part: part.first)
    files = tuple(file for part in parts for file in part.files)
    left_out = tuple(note for part in parts for note in part.left_out)
    places = {file: place for part in parts for file, place in part.places.items()}
    return replace(
        first, files=files, values=values, left_out=left_out, places=places, minutes=minutes,
        rain_kind=max(part.rain_kind for part in parts),
        applied=tuple(dict.fromkeys(text for part in parts for text in part.applied)),
    )


def _refuse_overlap(
    part: Records, other: str, quantity: str, time: datetime
) -> ConfigurationError:
    return ConfigurationError(
        f"is also in {other}: files must not overlap", file=part.source,
        key=f"{quantity} at {to_minutes(time)}",
    )


def _join_minutes(
    hours: int, parts: Iterable[tuple[int, Records]]
) -> NDArray[np.float64] | None:
    """Join the per-minute rain of parts, given their first hours; None if no part contains any.

    Raises:
        ConfigurationError: if two parts have rain in the same minute.
    """
    joined = None
    for begin, part in parts:
        if part.minutes is not None:
            if joined is None:
                joined = np.full((hours, part.minutes.shape[1]), np.nan)
            place = joined[begin : begin + part.hours]
            both = np.argwhere(~np.isnan(place) & ~np.isnan(part.minutes))
            if both.size:
                hour, minute = (int(index) for index in both[0])
                time = part.first + hour * HOUR + minute * _MINUTE
                raise _refuse_overlap(part, "another file", PRECIPITATION, time)
            np.copyto(place, part.minutes, where=np.isnan(place))
    return joined


def _add_quantities(first: Records, other: Records) -> Records:
    """Return records with the quantities of both parts, over the period that they cover together.

    Raises:
        ConfigurationError: if the hours of the two parts do not begin at the same minute.
    """
    if (other.first - first.first) % HOUR:
        raise ConfigurationError(
            f"hours must begin at the same minute as in {first.source}, which contains the other "
            "quantities",
            file=other.source,
        )
    begin = min(first.first, other.first)
    hours = max((part.first - begin) // HOUR + part.hours for part in (first, other))
    values = {}
    for part in (first, other):
        at = (part.first - begin) // HOUR
        for quantity, series in part.values.items():
            values[quantity] = np.full(hours, np.nan)
            values[quantity][at : at + part.hours] = series
    minutes = _join_minutes(
        hours, [((part.first - begin) // HOUR, part) for part in (first, other)]
    )
    heights = [part.wind_height for part in (first, other) if "wind speed" in part.values]
    return replace(
        first, files=(*first.files, *other.files), first=begin, values=values,
        method=first.method or other.method, shifted=(*first.shifted, *other.shifted),
        rain_late=max(first.rain_late, other.rain_late),
        rain_kind=max(first.rain_kind, other.rain_kind),
        left_out=(*first.left_out, *other.left_out),
        applied=(*first.applied, *other.applied), places={**first.places, **other.places},
        wind_height=heights[0] if heights else None, minutes=minutes,
    )


def _check_same_kind(first: Records, part: Records) -> None:
    for aspect, expected, present in (
        ("quantities", sorted(first.values), sorted(part.values)),
        ("method of evapotranspiration", [first.method], [part.method]),
        ("quantities for the hour before the time stamp", first.shifted, part.shifted),
        ("delay of the rain in hours", [str(first.rain_late)], [str(part.rain_late)]),
    ):
        if expected != present:
            raise ConfigurationError(
                f"must have the same {aspect} as {first.source}, {', '.join(expected) or 'none'}; "
                f"it has {', '.join(present) or 'none'}",
                file=part.source,
            )


def _shift_to_hours_of(first: Records, part: Records) -> Records:
    """Shift records to hours that begin at the same minute as those of the first records."""
    late = (part.first - first.first) % HOUR
    share, values = late / HOUR, part.values
    minutes, begin = part.minutes, part.first - late + HOUR
    if minutes is not None:  # rain of the first and last hour is kept as far as it is known
        begin -= HOUR
        edge = late // _MINUTE, 60 - late // _MINUTE
        minutes = np.pad(minutes.ravel(), edge, constant_values=np.nan).reshape(-1, 60)
        values = {
            name: np.pad(series, 1, constant_values=np.nan) for name, series in values.items()
        }
    values = {
        quantity: share * series[:-1] + (1 - share) * series[1:]
        for quantity, series in values.items()
    }
    if minutes is not None:
        values[PRECIPITATION] = average_minutes(minutes)
        first_empty, last_empty = (int(np.isnan(minutes[hour]).all()) for hour in (0, -1))
        there = slice(first_empty, len(minutes) - last_empty)
        begin, minutes = begin + first_empty * HOUR, minutes[there]
        values = {name: series[there] for name, series in values.items()}
    return replace(
        part, first=begin, minutes=minutes, values=values,
        left_out=(*part.left_out, (
            f"{part.source}: hours begin {late // _MINUTE} min after those of {first.source}; "
            "each value is the mean of the two hours that it overlaps"
        )),
    )
