"""Hourly records from the rows of a file, and records written in this project's own form."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.times import duration
from greenroof_ros.site.site import Place
from greenroof_ros.weather.description import PLACE, Description
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES, ROOF
from greenroof_ros.weather.records import HOUR, Records, add_dew_point, average_minutes
from greenroof_ros.weather.table import Rows, Values, read_rows

WEATHER = [name for name in QUANTITIES if name not in ROOF]
"""the quantities of weather"""


def read_hours(file: Path, site: Place, described: Description | None = None) -> Records:
    """Read a weather file; see :func:`.table.read_rows` and :func:`make_hours`."""
    return make_hours(file, read_rows(file, site, WEATHER, described))


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
        raise rows.table.refuse(
            f"rows must be at most one hour apart, not {duration(rows.step_s)}"
        )
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


def _spread_over_minutes(rain: Values, begins: Values, step_s: float, hours: int) -> Values:
    """Return the mean rain in every minute, shape (hours, 60); NaN in minutes without a row.

    Args:
        rain: rain in the rows (mm/h), NaN if missing.
        begins: starts of the rows relative to the first hour (s).
        step_s: interval of a row (s).
        hours: number of hours.
    """
    known = ~np.isnan(rain)
    edges = np.stack((begins, begins + step_s), axis=1)[known].ravel()
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


def _average_hours(series: Values, hours: NDArray[np.intp], count: int) -> Values:
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


def _find_longest_step(minutes: Values) -> int:
    """Return the longest time step (min) that preserves the rain of all minutes."""
    changes = np.diff(np.nan_to_num(minutes, nan=-1.0), axis=1).any(axis=0)
    return math.gcd(minutes.shape[1], *(1 + np.flatnonzero(changes)).tolist())


def write_records(records: Records, about: str) -> str:
    """Return records as the text of a file, which :func:`read_hours` reads back bit for bit.

    If the rain is known for every minute, the time step of the rows is the longest that preserves
    it; other values are in the first row of their hour.

    Args:
        records: hourly records for one location; gaps are written as empty cells.
        about: text of the first comment, of one or more lines.
    """
    places, values, rows = {*records.places.values()}, dict(records.values), 1
    if records.minutes is not None:
        rain = np.where(
            np.isnan(records.minutes), values[PRECIPITATION][:, None], records.minutes
        )
        rows = 60 // _find_longest_step(rain)
        for name, series in values.items():
            values[name] = np.full((records.hours, rows), math.nan)
            values[name][:, 0] = series
        values[PRECIPITATION] = rain[:, :: 60 // rows]
    stated: dict[str, object] = {
        "wind_height": records.wind_height, "rain_late": records.rain_late,
        "rain_kind": records.rain_kind, "step": 3600 // rows,
    }
    if len(places) == 1:
        stated |= zip(PLACE, map(str, *places), strict=True)
    names = {
        name: f"{records.method} {name}" if name == EVAPOTRANSPIRATION else name for name in values
    }
    lines = [
        *(f"# {line}" for line in (*about.splitlines(), *filter(None, [records.rain_note]))),
        *(f"# {key}: {value}" for key, value in stated.items() if value),
        ",".join(["time", *(f"{text} [{QUANTITIES[name].unit}]" for name, text in names.items())]),
    ]
    table = np.array([*values.values()]).reshape(len(values), -1)
    for row, numbers in enumerate(table.T.tolist()):
        cells = ("" if math.isnan(number) else repr(number) for number in numbers)
        lines.append(",".join([(records.first + row * HOUR / rows).isoformat(), *cells]))
    return "\n".join([*lines, ""])
