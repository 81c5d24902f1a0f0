"""Measured records as CSV: one row a step, units in the header."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from greenroof_ros.calibration.daily import reference_from_temperatures
from greenroof_ros.calibration.months import Months, counted
from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.calibration.reference_column import refuse_wrong_unit, through_short_gaps
from greenroof_ros.calibration.row_steps import means_of_steps, steps_of_rows, sums_of_steps
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.common.times import parse_time
from greenroof_ros.formats.table import Table, numbered_lines, read_table
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site

TIME = "time"
REFERENCE = "reference evapotranspiration"
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0}
_RATE = re.compile(r"(?P<amount>mm|l|m3)(/(?P<count>[1-9]\d{0,3})?(?P<time>s|min|h|day))?")
# Greatest believable amount in a time (mm/h). More rain than that fell nowhere for a minute (WMO:
# 31.2 mm, Unionville 1956), and no roof gives back more than its rain.
_MOST_MM_PER_H = 1900.0
# A W/m2 evaporates 0.0015 mm/h: more than the sun's 1361 W/m2 can, with air that is warmer.
_MOST_EVAPORATING = 3.0
_PLAIN = {
    "level": {"m": 1.0, "mm": 0.001, "cm": 0.01},
    "cistern level": {"m": 1.0, "mm": 0.001, "cm": 0.01},
    "pump state": {"1": 1.0, "%": 0.01},
    "temperature": {"degC": 1.0},
    "least temperature": {"degC": 1.0},
    "greatest temperature": {"degC": 1.0},
}
_AMOUNTS = {
    "rain": ("mm", "mm/h", "mm/5min"),
    "runoff": ("mm", "mm/5min", "l", "l/s", "m3/h"),
    "pumped": ("mm", "l", "l/s", "m3/h", "m3/s"),
    REFERENCE: ("mm", "mm/h", "mm/day"),
}
_FEWEST_ROWS = 100
# So far a level sensor's zero may be off, or its noise go.
_ZERO_OFF_M = 0.1


class _Column(NamedTuple):
    """A column of the file: its name there, and how its numbers become this package's."""

    name: str
    factor: float
    """to mm in a step, m, 1 or degC; of a rate to mm/s"""
    rate: bool
    amount: bool
    """of its row, so that those of two rows add up"""


def read_csv_record(file: Path, site: Site, months: Months | None = None) -> Record:
    """Read a measured record from CSV.

    The first column is ``time``: ISO 8601, on the clock of the site's ``utc_offset`` where it says
    no offset. Others are named like ``rain [mm]``: quantity and unit. Each row is of the step that
    begins at its time; levels are those of that moment. An amount without ``/`` is that of its
    step; ``mm`` are over the roof, ``l`` and ``m3`` those of the whole roof of ``a2``. Rows are a
    regular step apart, of at most a day; where a clock was set, each is of the step that begins
    nearest to its time, amounts of two rows of one step add up, and all else of them is averaged.
    Missing rows and empty cells are gaps. Lines that begin with ``#`` are comments.

    ``rain`` must be there, ``level`` or ``runoff``, and ``reference evapotranspiration``, which has
    gaps of an hour at most, or temperatures: ``temperature``, or the day's ``least temperature``
    and ``greatest temperature`` in any row of their day, for Hargreaves' equation. A row is of the
    day of its own time, whatever its step. What was pumped onto the
    roof is ``pumped``, or ``pump state`` (share of the maximum flow) with ``cistern level``;
    without either nothing.

    Args:
        file: the record.
        site: its place, and its pumps.
        months: those that count; in the others evapotranspiration may have longer gaps, over which
            it takes the straight line.

    Raises:
        ConfigurationError: the file breaks any of this; the message names line, column and value.
    """
    table = read_table(file, numbered_lines(read_text(file, byte_order_mark=True)))
    columns = _columns(table, site)
    offset = timezone(timedelta(hours=site.utc_offset)) if site.utc_offset is not None else None
    rows = list(table.lines)
    times = [_time(table, index, offset) for index in range(len(rows))]
    cells = {
        quantity: [_number(table, index, column.name) for index in range(len(rows))]
        for quantity, column in columns.items()
    }
    if len(times) < _FEWEST_ROWS:
        raise ConfigurationError(
            f"has {len(times)} rows; a record must have {_FEWEST_ROWS} at least", file=file
        )
    slots, step_s = steps_of_rows(file, TIME, times, rows)
    series, temperatures = {}, {}
    last_decimal = 0.0
    for quantity, column in columns.items():
        of_rows = np.array(cells[quantity])
        together = sums_of_steps if column.amount else means_of_steps
        values = together(of_rows, slots)
        factor = column.factor * (step_s if column.rate else 1.0)
        series[quantity] = values * factor
        if quantity == "runoff":
            last_decimal = _last_decimal(values) * factor
        if "temperature" in quantity:
            temperatures[quantity] = of_rows
        believed = series[quantity][slots] if column.amount else of_rows * factor
        _refuse_unbelievable(file, quantity, column, believed, step_s, rows, of_rows)
    record = Record(
        source=file, start=times[0], step_s=step_s, rain=series["rain"],
        reference=np.zeros(slots[-1] + 1), pumped=_pumped(series, site, step_s),
        runoff=series.get("runoff"), level=series.get("level"), last_decimal=last_decimal,
        cistern=series.get("cistern level"), command=series.get("pump state"),
    )
    if REFERENCE in columns:
        name = columns[REFERENCE].name
        reference = through_short_gaps(
            record, name, series[REFERENCE], times, rows, slots, counts=counted(record, months)
        )
        refuse_wrong_unit(record, site, name, reference)
    else:
        days = np.array([time.date() for time in times], dtype="datetime64[D]")
        reference = reference_from_temperatures(
            record, site, days, temperatures, counts=counted(record, months)
        )
    return replace(record, reference=reference)


def _columns(table: Table, site: Site) -> dict[str, _Column]:
    """Return the column of each quantity; refuse a header that cannot be understood."""
    if table.header[0] != TIME:
        raise table.refuse(f"the first column must be '{TIME}'", table.header[0])
    columns: dict[str, _Column] = {}
    for name in table.header[1:]:
        match = re.fullmatch(r"([^\[\]]+?)\s*\[([^\[\]]*)\]", name)
        if match is None:
            raise table.refuse("a column must be named like 'rain [mm]'", name)
        quantity, unit = match.groups()
        if quantity in columns:
            raise table.refuse(f"there is a column of {quantity} before this one", name)
        if quantity in _PLAIN:
            if unit not in _PLAIN[quantity]:
                raise _unit_error(table, name, quantity, _PLAIN[quantity])
            columns[quantity] = _Column(name, _PLAIN[quantity][unit], False, False)
        elif quantity in _AMOUNTS:
            rate = _RATE.fullmatch(unit)
            depth_only = "l" not in _AMOUNTS[quantity]
            if rate is None or (depth_only and rate["amount"] != "mm"):
                raise _unit_error(table, name, quantity, _AMOUNTS[quantity])
            factor = {"mm": 1.0, "l": 1 / site.a2, "m3": 1000 / site.a2}[rate["amount"]]
            if rate["time"]:
                factor /= _SECONDS[rate["time"]] * int(rate["count"] or 1)
            is_rate = rate["time"] is not None
            columns[quantity] = _Column(name, factor, is_rate, not is_rate)
        else:
            raise table.refuse(
                f"is not a known column; they are {', '.join((*_AMOUNTS, *_PLAIN))}, each with "
                "its unit in brackets", name,
            )
    _require(table, columns)
    return columns


def _require(table: Table, columns: dict[str, _Column]) -> None:
    """Refuse a header that lacks what a fit needs."""
    if "rain" not in columns:
        raise table.refuse("there must be a column 'rain [mm]'")
    if "runoff" not in columns and "level" not in columns:
        raise table.refuse("there must be a column 'runoff [mm]' or 'level [m]'")
    if not (
        REFERENCE in columns or "temperature" in columns
        or {"least temperature", "greatest temperature"} <= columns.keys()
    ):
        raise table.refuse(
            "there must be a column 'reference evapotranspiration [mm]', 'temperature [degC]', or "
            "both 'least temperature [degC]' and 'greatest temperature [degC]'"
        )
    if "pump state" in columns and "cistern level" not in columns:
        raise table.refuse(
            "with it there must be a column 'cistern level [m]', on which the pumps' flow depends; "
            "or 'pumped [l]' in its place", columns["pump state"].name,
        )


def _unit_error(
    table: Table, name: str, quantity: str, units: Iterable[str]
) -> ConfigurationError:
    return table.refuse(
        f"the unit of {quantity} must be one like {', '.join(f'[{unit}]' for unit in units)}", name
    )


def _time(table: Table, row: int, clock: timezone | None) -> datetime:
    """Return a row's time; without an offset it is that of the site's clock."""
    try:
        time = parse_time(table.columns[TIME][row])
    except ValueError:
        raise table.refuse("must be a time such as 2015-06-01T14:05", TIME, row) from None
    if time.utcoffset() is not None:
        return time
    if clock is None:
        raise table.refuse(
            "must say its offset from UTC, as in 2015-06-01T14:05+01:00, or the site file must "
            "give utc_offset", TIME, row,
        )
    return time.replace(tzinfo=clock)


def _number(table: Table, row: int, column: str) -> float:
    """Return a cell's number, NaN where it is empty."""
    text = table.columns[column][row]
    if not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise table.refuse("must be a number, or empty where there is none", column, row)
    return value


def _last_decimal(values: Values) -> float:
    """Return what 1 in the last decimal place is that any value has, 1e-12 at least."""
    there = values[~np.isnan(values)]
    places = 0
    while places < 12 and not np.allclose(np.round(there, places), there, rtol=1e-9, atol=0.0):
        places += 1
    return float(10.0**-places)


def _refuse_unbelievable(
    file: Path, quantity: str, column: _Column, values: Values, step_s: float, lines: list[int],
    cells: Values,
) -> None:
    """Refuse a row with a value that nothing on a roof can have, or an amount of its step."""
    low, high = 0.0, _MOST_MM_PER_H * step_s / 3600
    what = f"from 0 to {_MOST_MM_PER_H:g} mm/h"
    if quantity == REFERENCE:
        high = _MOST_EVAPORATING * step_s / 3600
        what = f"from 0 to {_MOST_EVAPORATING:g} mm/h"
    elif quantity == "pump state":
        high, what = 1.0, "from 0 to 1"
    elif "level" in quantity:
        low, high, what = -_ZERO_OFF_M, 100.0, f"from {-_ZERO_OFF_M:g} to 100 m"
    elif "temperature" in quantity:
        low, high, what = -90.0, 60.0, "from -90 to 60 degC"
    wrong = np.flatnonzero((values < low) | (values > high))
    if len(wrong):
        row = int(wrong[0])
        raise ConfigurationError(
            f"must be {what}; is the unit of the column right?", file=file, line=lines[row],
            key=column.name, value=float(cells[row]),
        )


def _pumped(series: dict[str, Values], site: Site, step_s: float) -> Values:
    """Return what was pumped onto the roof (mm in a step), NaN where that is not known.

    While the pumps stand the cistern's level does not matter.
    """
    if "pumped" in series:
        return series["pumped"]
    if "pump state" not in series:
        return np.zeros(len(series["rain"]))
    levels = series["cistern level"]
    most = np.array([maximum_pump_flow(site, x1) for x1 in levels * site.a1])
    most[np.isnan(levels)] = np.nan
    state = series["pump state"]
    return np.where(state == 0, 0.0, state * most * step_s * 1000 / site.a2)
