"""Measured records as CSV: one row a step, units in the header."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import (
    DAY_S,
    HOUR_S,
    Record,
    Steps,
    Values,
    in_months,
    means,
    sums,
    time_name,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.common.times import parse_time
from greenroof_ros.formats.records import (
    Limits,
    Table,
    Unit,
    gaps,
    numbered_lines,
    read_table,
)
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import hargreaves, over_the_day

TIME = "time"
REFERENCE = "reference evapotranspiration"
_COURSE, _LEAST, _GREATEST = "temperature", "least temperature", "greatest temperature"
# Of each quantity: unit, least and greatest believable value in it, and examples of what a column's
# unit may be. Amounts are believable by the hour. More rain than that fell nowhere for a minute
# (WMO: 31.2 mm, Unionville 1956), and no roof gives back more than its rain. A W/m2 evaporates
# 0.0015 mm/h: more than 3 the sun's 1361 W/m2 cannot, with air that is warmer. So far a level
# sensor's zero may be off, or its noise go.
_WATER: Limits = ("mm/h", 0.0, 1900.0)
_LEVEL: Limits = ("m", -0.1, 100.0)
_TEMPERATURE: Limits = ("degC", -90.0, 60.0)
_QUANTITIES: dict[str, tuple[Limits, str]] = {
    "rain": (_WATER, "mm mm/h mm/5min"),
    "runoff": (_WATER, "mm mm/5min l l/s m3/h"),
    "pumped": (_WATER, "mm l l/s m3/h m3/s"),
    REFERENCE: (("mm/h", 0.0, 3.0), "mm mm/h mm/day"),
    "level": (_LEVEL, "m mm cm"),
    "cistern level": (_LEVEL, "m mm cm"),
    "pump state": (("1", 0.0, 1.0), "1 %"),
    _COURSE: (_TEMPERATURE, "degC"),
    _LEAST: (_TEMPERATURE, "degC"),
    _GREATEST: (_TEMPERATURE, "degC"),
}
# How many of a unit are one m, 1 or degC.
_PER_OURS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "1": 1.0, "%": 100.0, "degC": 1.0}
_RATE = re.compile(r"(?P<amount>mm|l|m3)(/(?P<count>[1-9]\d{0,3})?(?P<time>s|min|h|day))?")
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0}
_FEWEST_ROWS = 100
# Rows may be so much off a step (share of it) without being counted as off; and of those that are,
# so many may be there (share of the rows): a clock that is set each week has two in a thousand.
_LOOSENESS, _MOST_OFF = 0.1, 0.01
# Of a day, so that its extremes are among them; and days without that take those beside them (d).
_ENOUGH, _LONGEST_GAP = 0.75, 3
# Temperatures further apart (s) miss a day's extremes: those three hours apart see 0.92 of a sine's
# range at least, those six hours apart 0.71.
_LONGEST_STEP_S = 3 * HOUR_S


class _Rows(NamedTuple):
    """Which step each row of a file is of."""

    table: Table
    times: list[datetime]
    steps: NDArray[np.int64]
    """counted from the first row's"""

    def together(
        self, values: Values, group: Callable[[Values, NDArray[np.int64], int], Values]
    ) -> Values:
        """Return what :func:`.record.sums` or means make of each step's rows; NaN without any."""
        series = np.full(self.steps[-1] + 1, np.nan)
        series[np.unique(self.steps)] = group(values, self.steps, 1)
        return series


def read_csv_record(file: Path, site: Site, months: str | None = None) -> Record:
    """Read a measured record from CSV.

    The first column is ``time``: ISO 8601, on the clock of the site's ``utc_offset`` where it says
    no offset. Others are named like ``rain [mm]``: quantity and unit. Each row is of the step that
    begins at its time; levels are of that moment. An amount without ``/`` is the sum of its
    step; ``mm`` are over the roof, ``l`` and ``m3`` those of the whole roof of ``a2``. Rows are a
    regular step apart, of at most a day; where a clock was set, each is of the step that begins
    nearest to its time, amounts of two rows of one step add up, and all else of them is averaged.
    Missing rows and empty cells are gaps. Lines that begin with ``#`` are comments.

    ``rain`` must be there, ``level`` or ``runoff``, and ``reference evapotranspiration``, which has
    gaps of an hour at most, or temperatures: ``temperature``, or the day's ``least temperature``
    and ``greatest temperature`` in any row of their day, for Hargreaves' equation. A row is of the
    day of its own time, whatever its step. What was pumped onto the roof is ``pumped``, or ``pump
    state`` (share of the maximum flow) with ``cistern level``; without either nothing.

    Args:
        file: the record.
        site: its place, and its pumps.
        months: those that count, such as ``4-10``; in the others evapotranspiration may have longer
            gaps, over which it takes the straight line.

    Raises:
        ConfigurationError: the file breaks any of this; the message names line, column and value.
    """
    table = read_table(file, numbered_lines(read_text(file, byte_order_mark=True)))
    columns = _columns(table)
    clock = None if site.utc_offset is None else timezone(timedelta(hours=site.utc_offset))

    def on_clock(text: str) -> datetime:
        time = parse_time(text)
        return time.replace(tzinfo=time.tzinfo or clock)

    times = table.times(
        TIME, on_clock, "2015-06-01T14:05", ", or the site file must give utc_offset"
    )
    if len(times) < _FEWEST_ROWS:
        raise ConfigurationError(
            f"has {len(times)} rows; a record must have {_FEWEST_ROWS} at least", file=file
        )
    steps, step_s = steps_of_rows(table, times)
    rows = _Rows(table, times, steps)
    units, numbers, series = {}, {}, {}
    for quantity, (name, text) in columns.items():
        limits, unit, adds_up = _unit(table, name, quantity, text, site, step_s)
        units[quantity] = unit
        numbers[quantity] = table.numbers(
            name, limits, unit, ("",), "; is the unit of the column right?"
        )
        series[quantity] = rows.together(numbers[quantity], sums if adds_up else means)
    record = Record(
        source=file, start=times[0], step_s=step_s, rain=series["rain"],
        reference=np.zeros(steps[-1] + 1), pumped=_pumped(series, site, step_s),
        runoff=series.get("runoff"), level=series.get("level"),
        cistern=series.get("cistern level"), command=series.get("pump state"),
        reference_column=columns[REFERENCE][0] if REFERENCE in columns else "",
    )
    if record.runoff is not None:
        per_ours = units["runoff"].per_ours
        record = replace(record, last_decimal=_last_decimal(record.runoff * per_ours) / per_ours)
    counts = in_months(record, months)
    if REFERENCE in columns:
        reference = _through_short_gaps(record, rows, series[REFERENCE], counts)
    else:
        reference = _from_temperatures(record, site, rows, numbers, counts)
    return replace(record, reference=reference)


def _columns(table: Table) -> dict[str, tuple[str, str]]:
    """Return each quantity's column and its unit; refuse a header that lacks what a fit needs."""
    columns: dict[str, tuple[str, str]] = {}
    for name, quantity, unit in table.quantities("rain [mm]"):
        if quantity in columns:
            raise table.refuse(f"there is a column of {quantity} before this one", name)
        if quantity not in _QUANTITIES:
            raise table.refuse(
                f"is not a known column; choose from {', '.join(_QUANTITIES)}, each with its unit "
                "in brackets", name,
            )
        columns[quantity] = name, unit
    for there, what in (
        ("rain" in columns, "there must be a column 'rain [mm]'"),
        ("runoff" in columns or "level" in columns,
         "there must be a column 'runoff [mm]' or 'level [m]'"),
        (REFERENCE in columns or _COURSE in columns or {_LEAST, _GREATEST} <= set(columns),
         "there must be a column 'reference evapotranspiration [mm]', 'temperature [degC]', or "
         "both 'least temperature [degC]' and 'greatest temperature [degC]'"),
        ("pump state" not in columns or "cistern level" in columns,
         "with 'pump state' there must be a column 'cistern level [m]', on which the pumps' flow "
         "depends; or 'pumped [l]' in its place"),
    ):
        if not there:
            raise table.refuse(what)
    return columns


def _unit(
    table: Table, name: str, quantity: str, text: str, site: Site, step_s: float
) -> tuple[Limits, Unit, bool]:
    """Return what a column's unit means; refuse one that the quantity cannot have.

    Returns:
        The believable range, the unit by ours, which is mm in a step for amounts and rates, and
        whether the numbers of two rows of one step add up, as amounts of their rows.
    """
    (ours, low, high), examples = _QUANTITIES[quantity]
    per_ours = _PER_OURS.get(text) if text in examples.split() else None
    if ours != "mm/h" and per_ours is not None:
        return (ours, low, high), Unit(text, per_ours), False
    rate = _RATE.fullmatch(text)
    if ours != "mm/h" or rate is None or not (rate["amount"] == "mm" or "l/s" in examples):
        units = ", ".join(f"[{one}]" for one in examples.split())
        raise table.refuse(f"the unit of {quantity} must be one like {units}", name)
    per_ours = {"mm": 1.0, "l": site.a2, "m3": site.a2 / 1000}[rate["amount"]]
    if rate["time"]:
        per_ours *= _SECONDS[rate["time"]] * int(rate["count"] or 1) / step_s
    return ("mm", low, high * step_s / HOUR_S), Unit(text, per_ours), not rate["time"]


def _last_decimal(values: Values) -> float:
    """Return what 1 in the last decimal place is that any value has, 1e-12 at least."""
    there = values[~np.isnan(values)]
    places = 0
    while places < 12 and not np.allclose(np.round(there, places), there, rtol=1e-9, atol=0.0):
        places += 1
    return float(10.0**-places)


def _pumped(series: Mapping[str, Values], site: Site, step_s: float) -> Values:
    """Return what was pumped onto the roof (mm in a step), NaN where that is not known.

    While the pumps stand the cistern's level does not matter.
    """
    if "pumped" in series or "pump state" not in series:
        return series.get("pumped", np.zeros(len(series["rain"])))
    levels, state = series["cistern level"], series["pump state"]
    most = np.array([maximum_pump_flow(site, x1) for x1 in levels * site.a1])
    most[np.isnan(levels)] = np.nan
    return np.where(state == 0, 0.0, state * most * step_s * 1000 / site.a2)


# --- rows and steps -------------------------------------------------------------------------------


def steps_of_rows(table: Table, times: Sequence[datetime]) -> tuple[NDArray[np.int64], float]:
    """Return the step that each row is of, counted from the first row, and its duration (s).

    The duration is the median of the rows' spacings. Each row is of the step that begins nearest to
    its time, half a step off at most: so a clock that was set moves no row that comes after. Two
    rows can be of one step then.

    Args:
        table: for messages.
        times: of its rows.

    Raises:
        ConfigurationError: a time is not later than the one before, the rows are more than a day
            apart, or more than one in a hundred is off a regular step.
    """
    since = np.array([time.timestamp() for time in times]) - times[0].timestamp()
    spacing = np.diff(since)
    back = np.flatnonzero(spacing <= 0)
    if len(back):
        raise table.refuse(
            "must be later than the time of the row before", TIME, int(back[0]) + 1
        )
    step_s = float(np.median(spacing))
    # A roof's drainage is of hours; of longer sums nothing can be told that rain does not say.
    if step_s > DAY_S:
        raise table.refuse(
            f"the rows are {time_name(step_s)} apart; they must be a day apart at most", TIME, 1
        )
    counts = np.maximum(1.0, np.round(spacing / step_s))
    off = np.flatnonzero(np.abs(spacing / step_s - counts) > _LOOSENESS)
    if len(off) > _MOST_OFF * len(spacing):
        raise table.refuse(
            f"must be {step_s:g} s after the row before, or a whole number of such steps, not "
            f"{spacing[off[0]]:g} s; so are {len(off)} of {len(times)} rows, more than clocks that "
            "were set explain: write rows a regular step apart", TIME, int(off[0]) + 1,
        )
    return np.floor(since / step_s + 0.5).astype(np.int64), step_s


# --- reference evapotranspiration -----------------------------------------------------------------


def _through_short_gaps(record: Record, rows: _Rows, values: Values, counts: Steps) -> Values:
    """Return reference evapotranspiration that is there in every step (mm), shape (steps,).

    A roof dries while its sensors fail, too: a gap of an hour at most takes the straight line
    between the steps beside it, and a longer one is refused. Rows' times measure a gap, not its
    steps: where a clock was set on, a step can be without a row though hardly any time is missing.

    Args:
        record: its times, and the column's name.
        rows: of the file.
        values: of each step (mm), NaN where there is none.
        counts: whether a step is fitted or judged, shape (steps,); a gap in which none is may be of
            any length.

    Raises:
        ConfigurationError: another gap is longer, or it is 0 throughout.
    """
    column = record.reference_column
    if not np.any(values > 0):
        raise ConfigurationError(
            "is 0 throughout: it must be there, or nothing of how the roof dries can be fitted",
            file=record.source, key=column,
        )
    missing = np.isnan(values)
    since = np.array([time.timestamp() for time in rows.times])
    # Before the first row and after the last as if there were one more, so that gaps there count.
    since = np.concatenate(([since[0] - record.step_s], since, [since[-1] + record.step_s]))
    for low, high in gaps(missing):
        row, after = (int(one) for one in np.searchsorted(rows.steps, (low, high)))
        gap_s = float(since[after + 1] - since[row]) - record.step_s
        if gap_s > HOUR_S and counts[low:high].any():
            empty = rows.steps[row] == low
            what = "is empty" if empty else f"there is no row of {record.times[low]}"
            raise ConfigurationError(
                f"{what}, and none has a value for {time_name(gap_s)}: it may be missing for an "
                "hour at most, as a roof dries in gaps of the sensors, too; write a day's value "
                "into each of its rows, and add missing rows with time and this value, their other "
                "cells empty", file=record.source, line=rows.table.lines[row], key=column,
            )
    steps = np.arange(len(values))
    return np.interp(steps, steps[~missing], values[~missing])


def _from_temperatures(
    record: Record, site: Site, rows: _Rows, numbers: Mapping[str, Values], counts: Steps
) -> Values:
    """Return Hargreaves' reference evapotranspiration of each step (mm), shape (steps,).

    A temperature is of its row's day, not of its step's: the step that a row of 0:00 lies in can
    have begun the day before, where the logger's clock was set. A step has the evapotranspiration
    of the day that it begins in on the record's own clock. A day without temperatures, or with
    those of part of it, takes the line between its neighbours', where it counts over three days at
    most.

    Args:
        record: its times.
        site: its place.
        rows: of the file.
        numbers: of each quantity, among them ``temperature``, or ``least temperature`` and
            ``greatest temperature`` in any row of their day (degC), NaN where a row has none, shape
            (rows,).
        counts: whether a step is fitted or judged, shape (steps,).

    Raises:
        ConfigurationError: the site has no place, temperatures are too far apart to show a day's
            extremes, or more days in a row have none.
    """
    if site.latitude is None or site.longitude is None:
        raise ConfigurationError(
            "evapotranspiration from temperatures needs latitude and longitude in the site file "
            "(see config/site.yaml)"
        )
    if _COURSE in numbers and record.step_s > _LONGEST_STEP_S:
        raise ConfigurationError(
            f"its rows are {time_name(record.step_s)} apart, and show a day's extremes where they "
            "are three hours apart at most; write columns 'least temperature [degC]' and 'greatest "
            "temperature [degC]' instead", file=record.source, key=_COURSE,
        )
    enough = _ENOUGH * DAY_S / record.step_s if _COURSE in numbers else 1.0
    dates, day = np.unique(
        np.array([time.date() for time in rows.times], dtype="datetime64[D]"), return_inverse=True
    )
    least, greatest = extremes = np.full((2, len(dates)), np.nan)
    for name, extreme, of_days in ((_LEAST, np.fmin, least), (_GREATEST, np.fmax, greatest)):
        values = numbers[_COURSE if _COURSE in numbers else name]
        extreme.at(of_days, day, values)
        of_days[np.bincount(day, ~np.isnan(values)) < enough] = np.nan
    crossed = np.flatnonzero(least > greatest)
    if len(crossed):
        raise ConfigurationError(
            f"on {dates[crossed[0]]} the least temperature, {least[crossed[0]]:g} degC, is above "
            f"the greatest, {greatest[crossed[0]]:g} degC", file=record.source,
        )
    there = ~np.isnan(extremes).any(axis=0)
    if not there.any():
        raise ConfigurationError("no day has its temperatures", file=record.source)
    days, day_of_step = np.unique(record.seconds // DAY_S, return_inverse=True)
    wanted = days.astype("datetime64[D]")
    counted = np.unique(day_of_step[counts])
    at = dates.astype(np.int64)
    far = np.abs(days[counted, None] - at[there]).min(axis=1) > _LONGEST_GAP
    if far.any():
        raise ConfigurationError(
            f"has no temperature within {_LONGEST_GAP} days of {wanted[counted[far][0]]}, from "
            "which evapotranspiration is computed; add a row of each day without, its temperatures "
            "in it and the other cells empty, or leave its month out with --months",
            file=record.source,
        )
    lines = []
    for values in extremes:
        known = ~np.isnan(values)
        lines.append(np.interp(days, at[known], values[known]))
    daily = hargreaves(site.latitude, wanted, *lines)
    east = site.longitude - record.offset_s / 240
    return over_the_day(daily, site.latitude, record.seconds, day_of_step, record.step_s, east)
