"""Measured records as CSV: a row for each step, units in the header."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.calibration.record import (
    DAY_S,
    HOUR_S,
    RoofRecord,
    Steps,
    Values,
    in_months,
    means,
    sums,
    time_name,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import parse_time
from greenroof_ros.formats.records import QUANTITIES, Limits, Table, Unit, gaps, read_table
from greenroof_ros.formats.steps import steps_of_rows
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import (
    DailyTemperatures,
    check_latitude,
    extremes_of_days,
)

TIME = "time"
REFERENCE = "reference evapotranspiration"
_COURSE, _MINIMUM, _MAXIMUM = "temperature", "least temperature", "greatest temperature"
# For each quantity: unit, minimum and maximum believable value, and examples of units of a column.
# Limits of amounts are per hour. The maximum rain in a minute was less (WMO: 31.2 mm, Unionville
# 1956), and no roof gives back more than its rain. A W/m2 evaporates 0.0015 mm/h: the sun's
# 1361 W/m2 and warmer air cannot evaporate more than 3 mm/h. The minimum level allows for a
# sensor's zero error and noise.
_WATER: Limits = ("mm/h", 0.0, 1900.0)
_LEVEL: Limits = ("m", -0.1, 100.0)
_QUANTITIES: dict[str, tuple[Limits, str]] = {
    "rain": (_WATER, "mm mm/h mm/5min"),
    "runoff": (_WATER, "mm mm/5min l l/s m3/h"),
    "pumped": (_WATER, "mm l l/s m3/h m3/s"),
    REFERENCE: (("mm/h", 0.0, 3.0), "mm mm/h mm/day"),
    "level": (_LEVEL, "m mm cm"),
    "cistern level": (_LEVEL, "m mm cm"),
    "pump state": (("1", 0.0, 1.0), "1 %"),
    **dict.fromkeys((_COURSE, _MINIMUM, _MAXIMUM), (QUANTITIES[_COURSE], "degC")),
}
# How many of a unit make one m, 1 or degC.
_PER_OURS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "1": 1.0, "%": 100.0, "degC": 1.0}
_RATE = re.compile(r"(?P<amount>mm|l|m3)(/(?P<count>[1-9]\d{0,3})?(?P<time>s|min|h|day))?")
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0}
_FEWEST_ROWS = 100
# When clocks change in either hemisphere: months, and the day of the week.
_CHANGES, _SUNDAY = {3, 4, 9, 10, 11}, 6
# Temperatures further apart (s) miss a day's extremes: three hours apart they show at least 0.92 of
# a sine's range, six hours apart 0.71.
_LONGEST_STEP_S = 3 * HOUR_S


class _Rows(NamedTuple):
    """The rows of a file, and the step that each belongs to."""

    table: Table
    times: list[datetime]
    steps: NDArray[np.int64]
    """counted from the step of the first row"""

    def together(
        self, values: Values, group: Callable[[Values, NDArray[np.int64], int], Values]
    ) -> Values:
        """Return :func:`.record.sums` or means of each step's rows; NaN for a step without rows."""
        series = np.full(self.steps[-1] + 1, np.nan)
        series[np.unique(self.steps)] = group(values, self.steps, 1)
        return series


def read_csv_record(
    file: Path, site: Site, months: str | None = None, zone: tzinfo | None = None
) -> RoofRecord:
    """Read a measured record from CSV.

    The first column is ``time``: ISO 8601, at the site's ``utc_offset`` if a time has no offset.
    Others are named like ``rain [mm]``: quantity and unit. A row describes the step that begins at
    its time; levels are at that time. An amount without ``/`` is the sum over its step. ``mm`` is a
    depth on the roof; ``l`` and ``m3`` are for the whole roof of area ``a2``. Rows are a regular
    step apart, at most a day. If a clock was set, a row belongs to the step that begins nearest to
    its time: amounts of two rows in one step add up, other values are averaged. Missing rows and
    empty cells are gaps. Lines that begin with ``#`` are comments.

    Required are ``rain``, ``level`` or ``runoff``, and evapotranspiration. It is ``reference
    evapotranspiration``, with gaps of at most an hour, or computed by Hargreaves' equation from
    ``temperature``, or from the day's ``least temperature`` and ``greatest temperature`` in any row
    of that day. A row belongs to the day of its own time, not of its step. Pumped water is
    ``pumped``, or ``pump state`` (share of the maximum flow) with ``cistern level``, or else 0.

    Args:
        file: the record.
        site: its place and pumps.
        months: that count, such as ``4-10``. In other months evapotranspiration may have longer
            gaps, which are interpolated linearly.
        zone: of times without an offset, with daylight saving; by default standard time.

    Raises:
        ConfigurationError: the file breaks a rule; the message names line, column and value.
    """
    table = read_table(file)
    columns = _columns(table)
    times = _times(table, site, zone)
    if len(times) < _FEWEST_ROWS:
        raise ConfigurationError(
            f"has {len(times)} rows; a record must have at least {_FEWEST_ROWS}", file=file
        )
    steps, step_s = steps_of_rows(table, times)
    # A roof drains within hours, so longer sums show no more than the rain does.
    if step_s > DAY_S:
        raise table.refuse(
            f"the rows are {time_name(step_s)} apart; they must be at most a day apart", TIME, 1
        )
    rows = _Rows(table, times, steps)
    units, numbers, series = {}, {}, {}
    for quantity, (name, text) in columns.items():
        limits, unit, adds_up = _unit(table, name, quantity, text, site, step_s)
        units[quantity] = unit
        numbers[quantity] = table.usable(
            name, limits, unit, hint="; is the unit of the column right?"
        )
        series[quantity] = rows.together(numbers[quantity], sums if adds_up else means)
    record = RoofRecord(
        source=file, start=times[0], step_s=step_s, rain=series["rain"],
        reference=np.zeros(steps[-1] + 1), pumped=_pumped(series, site, step_s),
        runoff=series.get("runoff"), level=series.get("level"),
        cistern=series.get("cistern level"), command=series.get("pump state"),
        reference_column=columns[REFERENCE][0] if REFERENCE in columns else "",
        notes=tuple(table.notes),
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


def _times(table: Table, site: Site, zone: tzinfo | None) -> list[datetime]:
    """Return the time of each row, each later than the one before."""
    standard = None if site.utc_offset is None else timezone(timedelta(hours=site.utc_offset))
    times: list[datetime] = []
    for time in table.times(
        TIME, example="2015-06-01T14:05", hint=", or the site file must give utc_offset",
        zone=zone or standard,
    ):
        times.append(time)
        if len(times) > 1 and time <= times[-2]:
            if zone is None:
                _refuse_daylight_saving(table, site, times)
            raise table.refuse(
                "must be later than the time of the row before", TIME, len(times) - 1
            )
    if zone is None:
        _refuse_daylight_saving(table, site, times)
    return times


def _refuse_daylight_saving(table: Table, site: Site, times: Sequence[datetime]) -> None:
    """Refuse times without an offset that jump as a clock with daylight saving time does.

    Early on a Sunday such a clock shows an hour twice, or skips one. A logger that stood still just
    then looks the same.
    """
    spacing = np.diff([time.timestamp() for time in times])
    for row in np.flatnonzero(np.abs(spacing - np.median(spacing)) == HOUR_S) + 1:
        before, time = (parse_time(table.cell(TIME, at)) for at in (int(row) - 1, int(row)))
        if before.tzinfo or time.tzinfo:
            continue
        if (time.weekday(), time.month in _CHANGES, time.hour <= 4) == (_SUNDAY, True, True):
            what = "skips an hour" if spacing[row - 1] > 0 else "shows an hour twice"
            raise table.refuse(
                f"is after {before}, as by a clock with daylight saving time, which {what} "
                f"then: give its zone, --time-zone {site.time_zone or 'America/Toronto'}; if the "
                "clock is on standard time and rows are missing, one such as Etc/GMT+5 for UTC-5",
                TIME, int(row),
            )


def _columns(table: Table) -> dict[str, tuple[str, str]]:
    """Return each quantity's column and unit; refuse a header without the required columns."""
    columns: dict[str, tuple[str, str]] = {}
    for name, quantity, unit in table.quantities("rain [mm]"):
        if quantity in columns:
            raise table.refuse(f"there is a column of {quantity} already", name)
        if quantity not in _QUANTITIES:
            raise table.refuse(
                f"is not a known column; choose from {', '.join(_QUANTITIES)}, each with its unit "
                "in brackets", name,
            )
        columns[quantity] = name, unit
    for there, message in (
        ("rain" in columns, "there must be a column 'rain [mm]'"),
        ("runoff" in columns or "level" in columns,
         "there must be a column 'runoff [mm]' or 'level [m]'"),
        (REFERENCE in columns or _COURSE in columns or {_MINIMUM, _MAXIMUM} <= set(columns),
         "there must be a column 'reference evapotranspiration [mm]', 'temperature [degC]', or "
         "both 'least temperature [degC]' and 'greatest temperature [degC]'"),
        ("pump state" not in columns or "cistern level" in columns,
         "with 'pump state' there must be a column 'cistern level [m]', on which the pumps' flow "
         "depends; or 'pumped [l]' in its place"),
    ):
        if not there:
            raise table.refuse(message)
    return columns


def _unit(
    table: Table, name: str, quantity: str, text: str, site: Site, step_s: float
) -> tuple[Limits, Unit, bool]:
    """Return the meaning of a column's unit; refuse a unit that the quantity cannot have.

    Returns:
        The believable range, the unit relative to ours (mm in a step for amounts and rates), and
        whether the numbers of two rows in one step add up, because they are amounts.
    """
    (ours, low, high), examples = _QUANTITIES[quantity]
    per_ours = _PER_OURS.get(text) if text in examples.split() else None
    if ours != "mm/h" and per_ours is not None:
        return (ours, low, high), Unit(text, per_ours), False
    rate = _RATE.fullmatch(text)
    if ours != "mm/h" or rate is None or not (rate["amount"] == "mm" or "l/s" in examples):
        units = ", ".join(f"[{example}]" for example in examples.split())
        raise table.refuse(f"the unit of {quantity} must be one like {units}", name)
    per_ours = {"mm": 1.0, "l": site.a2, "m3": site.a2 / 1000}[rate["amount"]]
    if rate["time"]:
        per_ours *= _SECONDS[rate["time"]] * int(rate["count"] or 1) / step_s
    return ("mm", low, high * step_s / HOUR_S), Unit(text, per_ours), not rate["time"]


def _last_decimal(values: Values) -> float:
    """Return the unit of the last decimal place that any value has, at least 1e-12."""
    there = values[~np.isnan(values)]
    places = 0
    while places < 12 and not np.allclose(np.round(there, places), there, rtol=1e-9, atol=0.0):
        places += 1
    return float(10.0**-places)


def _pumped(series: Mapping[str, Values], site: Site, step_s: float) -> Values:
    """Return the water pumped onto the roof (mm in a step), NaN if unknown.

    While the pumps are stopped, the cistern's level does not matter.
    """
    if "pumped" in series or "pump state" not in series:
        return series.get("pumped", np.zeros(len(series["rain"])))
    levels, state = series["cistern level"], series["pump state"]
    most = np.array([maximum_pump_flow(site, x1) for x1 in levels * site.a1])
    most[np.isnan(levels)] = np.nan
    return np.where(state == 0, 0.0, state * most * step_s * 1000 / site.a2)


# --- reference evapotranspiration -----------------------------------------------------------------


def _through_short_gaps(record: RoofRecord, rows: _Rows, values: Values, counts: Steps) -> Values:
    """Return reference evapotranspiration without gaps (mm), shape (steps,).

    A roof dries even if its sensors fail. So a gap of at most an hour is interpolated linearly, and
    a longer gap is refused. A gap is measured by the times of rows, not by steps: if a clock was
    set forward, a step can lack a row though hardly any time is missing.

    Args:
        record: its times, and the column's name.
        rows: of the file.
        values: of each step (mm), NaN if missing.
        counts: whether a step is fitted or judged, shape (steps,). A gap without such steps may
            have any length.

    Raises:
        ConfigurationError: another gap is longer, or evapotranspiration is 0 throughout.
    """
    column = record.reference_column
    if not np.any(values > 0):
        raise ConfigurationError(
            "is 0 throughout: how the roof dries cannot be fitted without it",
            file=record.source, key=column,
        )
    missing = np.isnan(values)
    since = np.array([time.timestamp() for time in rows.times])
    # As if there were one more row at each end, so that gaps there count, too.
    since = np.concatenate(([since[0] - record.step_s], since, [since[-1] + record.step_s]))
    for low, high in gaps(missing):
        row, after = np.searchsorted(rows.steps, (low, high)).tolist()
        gap_s = float(since[after + 1] - since[row]) - record.step_s
        if gap_s > HOUR_S and counts[low:high].any():
            empty = rows.steps[row] == low
            reason = "is empty" if empty else f"there is no row of {record.times[low]}"
            raise ConfigurationError(
                f"{reason}, and no row has a value for {time_name(gap_s)}: at most an hour may be "
                "missing, since a roof also dries while sensors have gaps; write a day's value "
                "into each of its rows, and add missing rows with the time and this value, their "
                "other cells empty", file=record.source, line=rows.table.lines[row], key=column,
            )
    steps = np.arange(len(values))
    return np.interp(steps, steps[~missing], values[~missing])


def _from_temperatures(
    record: RoofRecord, site: Site, rows: _Rows, numbers: Mapping[str, Values], counts: Steps
) -> Values:
    """Return Hargreaves' reference evapotranspiration of each step (mm), shape (steps,).

    A temperature belongs to the day of its row, not of its step: if the logger's clock was set, the
    step of a row at 0:00 can begin on the day before. A step has the evapotranspiration of the day
    in which it begins on the record's own clock. A day without temperatures, or with less than 0.75
    of its ``temperature``, is interpolated. For a day that counts, temperatures must exist within
    three days.

    Args:
        record: its times.
        site: its place.
        rows: of the file.
        numbers: of each quantity, among them ``temperature``, or ``least temperature`` and
            ``greatest temperature`` in any row of the day (degC), NaN if a row has none, shape
            (rows,).
        counts: whether a step is fitted or judged, shape (steps,).

    Raises:
        ConfigurationError: the site has no place; or temperatures are too far apart to show a day's
            extremes, too far from a day that counts, or minimum above maximum.
    """
    if site.latitude is None or site.longitude is None:
        raise ConfigurationError(
            "evapotranspiration from temperatures needs latitude and longitude in the site file "
            "(see config/site.yaml)"
        )
    check_latitude(site)
    if _COURSE in numbers and record.step_s > _LONGEST_STEP_S:
        raise ConfigurationError(
            f"its rows are {time_name(record.step_s)} apart, but show a day's extremes only if "
            "they are at most three hours apart; write columns 'least temperature [degC]' and "
            "'greatest temperature [degC]' instead", file=record.source, key=_COURSE,
        )
    dates, day = np.unique(
        np.array([time.date() for time in rows.times], dtype="datetime64[D]"), return_inverse=True
    )
    low, high = (_COURSE, _COURSE) if _COURSE in numbers else (_MINIMUM, _MAXIMUM)
    minimum, maximum = extremes = extremes_of_days(
        day, numbers[low], numbers[high], DAY_S / record.step_s if _COURSE in numbers else 1.0
    )
    crossed = np.flatnonzero(minimum > maximum)
    if len(crossed):
        raise ConfigurationError(
            f"on {dates[crossed[0]]} the minimum temperature, {minimum[crossed[0]]:g} degC, is "
            f"above the maximum, {maximum[crossed[0]]:g} degC", file=record.source,
        )
    there = ~np.isnan(extremes).any(axis=0)
    if not there.any():
        raise ConfigurationError("no day has its temperatures", file=record.source)
    temperatures = DailyTemperatures(dates, extremes)
    counted = np.unique((record.seconds[counts] // DAY_S).astype("datetime64[D]"))
    far = temperatures.far(counted)
    if far.any():
        raise ConfigurationError(
            f"has no temperature within 3 days of {counted[far][0]}, from which evapotranspiration "
            "is computed; add a row for each day without them, with its temperatures and the other "
            "cells empty, or leave its month out with --months", file=record.source,
        )
    return temperatures.evapotranspiration(site, record.seconds, record.step_s, record.offset_s)
