"""Measured records as CSV: a row for each step, units in the header."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.calibration.record import (
    DAY_S,
    HOUR_S,
    RoofRecord,
    Steps,
    Values,
    in_months,
    time_name,
)
from greenroof_ros.common.errors import ConfigurationError
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
# For each quantity: our unit, minimum and maximum believable value, and the units of a column.
# Limits of amounts are per hour. The maximum rain in a minute was less (WMO: 31.2 mm, Unionville
# 1956), and no roof gives back more than its rain. A W/m2 evaporates 0.0015 mm/h: the sun's
# 1361 W/m2 and warmer air cannot evaporate more than 3 mm/h. The minimum level allows for a
# sensor's zero error and noise.
_WATER: Limits = ("mm/h", 0.0, 1900.0)
_LEVEL: Limits = ("m", -0.1, 100.0)
_QUANTITIES: dict[str, tuple[Limits, str]] = {
    "rain": (_WATER, "mm mm/h"),
    "runoff": (_WATER, "mm mm/h l l/s m3/h"),
    "pumped": (_WATER, "mm mm/h l l/s m3/h"),
    REFERENCE: (("mm/h", 0.0, 3.0), "mm mm/h mm/day"),
    "level": (_LEVEL, "m cm mm"),
    "cistern level": (_LEVEL, "m cm mm"),
    "pump state": (("1", 0.0, 1.0), "1 %"),
    **dict.fromkeys((_COURSE, _MINIMUM, _MAXIMUM), (QUANTITIES[_COURSE], "degC")),
}
# How far below 0, or above a pump state of 1, a zero error can be: in mm/h or as a share. Dew at
# night is negative evapotranspiration. A rain gauge that counts has no zero error.
_ZERO_ERROR = {"runoff": 0.1, "pumped": 0.1, REFERENCE: 0.1, "pump state": 0.02}
# How many of a unit make one m, 1 or degC.
_PER_OURS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "1": 1.0, "%": 100.0, "degC": 1.0}
_SECONDS = {"s": 1.0, "h": 3600.0, "day": 86400.0}
_FEWEST_ROWS = 100
# Temperatures further apart (s) miss a day's extremes: three hours apart they show at least 0.92 of
# a sine's range, six hours apart 0.71.
_LONGEST_STEP_S = 3 * HOUR_S


def read_csv_record(file: Path, site: Site, months: str | None = None) -> RoofRecord:
    """Read a measured record from CSV.

    The first column is ``time``: ISO 8601, by the site's clock if a time has no offset: its
    ``time_zone``, or else its ``utc_offset``. Others are named like ``rain [mm]``: quantity and
    unit. A row describes the step that begins at its time; levels are at that time. An amount
    without ``/`` is the sum over its step. ``mm`` is a depth on the roof; ``l`` and ``m3`` are for
    the whole roof of area ``a2``. Rows are a regular step apart, at most a day. Missing rows and
    empty cells are gaps. Lines that begin with ``#`` are comments.

    Required are ``rain``, ``level`` or ``runoff``, and evapotranspiration. It is ``reference
    evapotranspiration``, with gaps of at most an hour, or computed by Hargreaves' equation from
    ``temperature``, or from the day's ``least temperature`` and ``greatest temperature`` in any row
    of that day. Pumped water is ``pumped``, or ``pump state`` (share of the maximum flow) with
    ``cistern level``, or else 0.

    Args:
        file: the record.
        site: its place, clock and pumps.
        months: that count, such as ``4-10``. In other months evapotranspiration may have longer
            gaps, which are interpolated linearly.

    Raises:
        ConfigurationError: the file breaks a rule; the message names line, column and value.
    """
    table = read_table(file)
    columns = _columns(table)
    times = _times(table, site)
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
    for row in (np.flatnonzero(np.diff(steps) == 0) + 1).tolist():
        raise table.refuse(
            f"must be {time_name(step_s)} after the row before; if a clock was set, write one row "
            "for both, with the sums of amounts and the means of levels", TIME, row,
        )
    series = {}
    last_decimal = 0.0
    for quantity, (name, text) in columns.items():
        limits, unit = _unit(table, name, quantity, text, site, step_s)
        numbers = table.usable(
            name, limits, unit, _ZERO_ERROR.get(quantity, 0.0) * _per_step(limits, step_s),
            hint="; is the unit of the column right?",
        )
        series[quantity] = np.full(steps[-1] + 1, np.nan)
        series[quantity][steps] = numbers
        if quantity == "runoff":
            last_decimal = _last_decimal(numbers * unit.per_ours) / unit.per_ours
    record = RoofRecord(
        source=file, start=times[0], step_s=step_s, rain=series["rain"],
        reference=np.zeros(steps[-1] + 1), pumped=_pumped(series, site, step_s),
        runoff=series.get("runoff"), level=series.get("level"), last_decimal=last_decimal,
        cistern=series.get("cistern level"), command=series.get("pump state"),
        reference_column=columns[REFERENCE][0] if REFERENCE in columns else "",
        notes=tuple(table.notes),
    )
    counts = in_months(record, months)
    if REFERENCE in columns:
        lines = [table.lines[row] for row in np.searchsorted(steps, np.arange(record.steps))]
        reference = _through_short_gaps(record, lines, series[REFERENCE], counts)
    else:
        reference = _from_temperatures(record, site, series, counts)
    return replace(record, reference=reference)


def _times(table: Table, site: Site) -> list[datetime]:
    """Return the time of each row, each later than the one before."""
    zone = None if site.utc_offset is None else timezone(timedelta(hours=site.utc_offset))
    times: list[datetime] = []
    for time in table.times(
        TIME, example="2015-06-01T14:05Z",
        hint=", or the site file must give its time_zone or utc_offset",
        zone=zone if site.time_zone is None else ZoneInfo(site.time_zone),
    ):
        if times and time <= times[-1]:
            raise table.refuse(
                "must be later than the time of the row before; if the clock has daylight saving "
                "time, give the site file its time_zone, or write times in UTC, such as "
                "2015-06-01T14:05Z", TIME, len(times),
            )
        times.append(time)
    return times


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
) -> tuple[Limits, Unit]:
    """Return a column's believable range, and its unit relative to ours, which is mm in a step."""
    (ours, low, high), allowed = _QUANTITIES[quantity]
    if text not in allowed.split():
        units = " or ".join(f"[{unit}]" for unit in allowed.split())
        raise table.refuse(f"the unit of {quantity} must be {units}", name)
    if ours != "mm/h":
        return (ours, low, high), Unit(text, _PER_OURS[text])
    amount, _, time = text.partition("/")
    per_ours = {"mm": 1.0, "l": site.a2, "m3": site.a2 / 1000}[amount]
    if time:
        per_ours *= _SECONDS[time] / step_s
    return ("mm", low, high * step_s / HOUR_S), Unit(text, per_ours)


def _per_step(limits: Limits, step_s: float) -> float:
    """Return how much of an hour's amount a step has; 1 for what is no amount."""
    return step_s / HOUR_S if limits[0] == "mm" else 1.0


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


def _through_short_gaps(
    record: RoofRecord, lines: list[int], values: Values, counts: Steps
) -> Values:
    """Return reference evapotranspiration without gaps (mm), shape (steps,).

    A roof dries even if its sensors fail. So a gap of at most an hour, or a step, is interpolated
    linearly, and a longer gap is refused.

    Args:
        record: its times, and the column's name.
        lines: line of the row of each step, or of the next row.
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
    for low, high in gaps(missing):
        gap_s = (high - low) * record.step_s
        if gap_s > max(HOUR_S, record.step_s) and counts[low:high].any():
            raise ConfigurationError(
                f"has no value from {record.time(low)} for {time_name(gap_s)}: at most an hour may "
                "be missing, since a roof also dries while sensors have gaps; write a day's value "
                "into each of its rows, and add missing rows with the time and this value, their "
                "other cells empty", file=record.source, line=lines[low], key=column,
            )
    steps = np.arange(len(values))
    return np.interp(steps, steps[~missing], values[~missing])


def _from_temperatures(
    record: RoofRecord, site: Site, series: Mapping[str, Values], counts: Steps
) -> Values:
    """Return Hargreaves' reference evapotranspiration of each step (mm), shape (steps,).

    Days are by the record's own clock. A day without temperatures, or with less than 0.75 of its
    ``temperature``, is interpolated. For a day that counts, temperatures must exist within three
    days.

    Args:
        record: its times.
        site: its place.
        series: of each quantity, among them ``temperature``, or ``least temperature`` and
            ``greatest temperature`` in any row of the day (degC), NaN if a step has none, shape
            (steps,).
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
    if _COURSE in series and record.step_s > _LONGEST_STEP_S:
        raise ConfigurationError(
            f"its rows are {time_name(record.step_s)} apart, but show a day's extremes only if "
            "they are at most three hours apart; write columns 'least temperature [degC]' and "
            "'greatest temperature [degC]' instead", file=record.source, key=_COURSE,
        )
    dates, day = np.unique(record.times.astype("datetime64[D]"), return_inverse=True)
    low, high = (_COURSE, _COURSE) if _COURSE in series else (_MINIMUM, _MAXIMUM)
    minimum, maximum = extremes = extremes_of_days(
        day, series[low], series[high], DAY_S / record.step_s if _COURSE in series else 1.0
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
    counted: NDArray[np.datetime64] = np.unique(record.times[counts].astype("datetime64[D]"))
    far = temperatures.far(counted)
    if far.any():
        raise ConfigurationError(
            f"has no temperature within 3 days of {counted[far][0]}, from which evapotranspiration "
            "is computed; add a row for each day without them, with its temperatures and the other "
            "cells empty, or leave its month out with --months", file=record.source,
        )
    return temperatures.evapotranspiration(site, record.seconds, record.step_s, record.offset_s)
