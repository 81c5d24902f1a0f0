"""Measured records as CSV: one row a step, units in the header."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Record, Steps, Values, in_months
from greenroof_ros.calibration.reference import reference_from_temperatures, through_short_gaps
from greenroof_ros.calibration.scores import DAY_S, time_name
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
# 31.2 mm, Unionville 1956), and no roof gives back more than its rain. A W/m2 evaporates 0.0015
# mm/h: more than 3 the sun's 1361 W/m2 cannot, with air that is warmer.
_MOST_MM_PER_H, _MOST_EVAPORATING = 1900.0, 3.0
_FEWEST_ROWS = 100
# Rows may be so much off a step (share of it) without being counted as off; and of those that are,
# so many may be there (share of the rows): a clock that is set each week has two in a thousand.
_LOOSENESS, _MOST_OFF = 0.1, 0.01


class _Quantity(NamedTuple):
    """What a column may hold."""

    units: dict[str, float]
    """factor of each to m, 1 or degC; of an amount examples, whose factors are computed"""
    low: float
    high: float
    """greatest believable value; of an amount in mm/h"""
    unit: str
    """of both"""
    amount: bool = False


def _amount(*examples: str, most: float = _MOST_MM_PER_H) -> _Quantity:
    return _Quantity(dict.fromkeys(examples, 1.0), 0.0, most, " mm/h", amount=True)


# So far a level sensor's zero may be off, or its noise go.
_LEVEL = _Quantity({"m": 1.0, "mm": 0.001, "cm": 0.01}, -0.1, 100.0, " m")
_TEMPERATURE = _Quantity({"degC": 1.0}, -90.0, 60.0, " degC")
_QUANTITIES = {
    "rain": _amount("mm", "mm/h", "mm/5min"),
    "runoff": _amount("mm", "mm/5min", "l", "l/s", "m3/h"),
    "pumped": _amount("mm", "l", "l/s", "m3/h", "m3/s"),
    REFERENCE: _amount("mm", "mm/h", "mm/day", most=_MOST_EVAPORATING),
    "level": _LEVEL,
    "cistern level": _LEVEL,
    "pump state": _Quantity({"1": 1.0, "%": 0.01}, 0.0, 1.0, ""),
    "temperature": _TEMPERATURE,
    "least temperature": _TEMPERATURE,
    "greatest temperature": _TEMPERATURE,
}


class _Column(NamedTuple):
    """A column of the file: its name there, and how its numbers become this package's."""

    name: str
    quantity: _Quantity
    factor: float
    """to mm in a step, m, 1 or degC; of a rate to mm/s"""
    rate: bool = False

    @property
    def adds_up(self) -> bool:
        """Whether the numbers of two rows of one step do, as amounts of their rows."""
        return self.quantity.amount and not self.rate


class _Cells(NamedTuple):
    """The rows of a file: line, time, and the numbers of each quantity, NaN where empty."""

    lines: list[int]
    times: list[datetime]
    numbers: dict[str, Values]


def read_csv_record(file: Path, site: Site, months: str | None = None) -> Record:
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
    columns = _columns(table, site)
    lines, times, numbers = _cells(table, columns, site)
    if len(times) < _FEWEST_ROWS:
        raise ConfigurationError(
            f"has {len(times)} rows; a record must have {_FEWEST_ROWS} at least", file=file
        )
    slots, step_s = steps_of_rows(file, times, lines)
    series = {}
    last_decimal = 0.0
    for quantity, column in columns.items():
        of_rows = numbers[quantity]
        values = (_sums if column.adds_up else _means)(of_rows, slots)
        factor = column.factor * (step_s if column.rate else 1.0)
        series[quantity] = values * factor
        if quantity == "runoff":
            last_decimal = _last_decimal(values) * factor
        low, high, unit = column.quantity[1:4]
        believed = series[quantity][slots] if column.adds_up else of_rows * factor
        wrong = (believed < low) | (
            believed > high * (step_s / 3600 if column.quantity.amount else 1.0)
        )
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ConfigurationError(
                f"must be from {low:g} to {high:g}{unit}; is the unit of the column right?",
                file=file, line=lines[row], key=column.name, value=float(of_rows[row]),
            )
    record = Record(
        source=file, start=times[0], step_s=step_s, rain=series["rain"],
        reference=np.zeros(slots[-1] + 1), pumped=_pumped(series, site, step_s),
        runoff=series.get("runoff"), level=series.get("level"), last_decimal=last_decimal,
        cistern=series.get("cistern level"), command=series.get("pump state"),
    )
    counts = in_months(record, months)
    if REFERENCE in columns:
        record = replace(record, reference_column=columns[REFERENCE].name)
        reference = through_short_gaps(
            record, series[REFERENCE], times, lines, slots, counts=counts
        )
    else:
        days = np.array([time.date() for time in times], dtype="datetime64[D]")
        temperatures = {name: one for name, one in numbers.items() if "temperature" in name}
        reference = reference_from_temperatures(record, site, days, temperatures, counts=counts)
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
        if quantity not in _QUANTITIES:
            raise table.refuse(
                f"is not a known column; they are {', '.join(_QUANTITIES)}, each with its unit in "
                "brackets", name,
            )
        column = _column(name, _QUANTITIES[quantity], unit, site)
        if column is None:
            units = ", ".join(f"[{one}]" for one in _QUANTITIES[quantity].units)
            raise table.refuse(f"the unit of {quantity} must be one like {units}", name)
        columns[quantity] = column
    _require(table, columns)
    return columns


def _column(name: str, quantity: _Quantity, unit: str, site: Site) -> _Column | None:
    """Return a column by its unit; None where the quantity has no such unit."""
    if not quantity.amount:
        factor = quantity.units.get(unit)
        return None if factor is None else _Column(name, quantity, factor)
    rate = _RATE.fullmatch(unit)
    if rate is None or ("l" not in quantity.units and rate["amount"] != "mm"):
        return None
    factor = {"mm": 1.0, "l": 1 / site.a2, "m3": 1000 / site.a2}[rate["amount"]]
    if rate["time"]:
        factor /= _SECONDS[rate["time"]] * int(rate["count"] or 1)
    return _Column(name, quantity, factor, rate["time"] is not None)


def _require(table: Table, columns: Collection[str]) -> None:
    """Refuse a header that lacks what a fit needs."""
    if "rain" not in columns:
        raise table.refuse("there must be a column 'rain [mm]'")
    if "runoff" not in columns and "level" not in columns:
        raise table.refuse("there must be a column 'runoff [mm]' or 'level [m]'")
    if not any(
        set(needed) <= set(columns)
        for needed in (
            (REFERENCE,), ("temperature",), ("least temperature", "greatest temperature"),
        )
    ):
        raise table.refuse(
            "there must be a column 'reference evapotranspiration [mm]', 'temperature [degC]', or "
            "both 'least temperature [degC]' and 'greatest temperature [degC]'"
        )
    if "pump state" in columns and "cistern level" not in columns:
        raise table.refuse(
            "with 'pump state' there must be a column 'cistern level [m]', on which the pumps' "
            "flow depends; or 'pumped [l]' in its place"
        )


def _cells(table: Table, columns: dict[str, _Column], site: Site) -> _Cells:
    """Return times and numbers; a time without an offset is that of the site's clock."""
    clock = timezone(timedelta(hours=site.utc_offset)) if site.utc_offset is not None else None
    rows = range(len(table.lines))
    return _Cells(
        list(table.lines), [_time(table, row, clock) for row in rows],
        {quantity: np.array([_number(table, row, column.name) for row in rows])
         for quantity, column in columns.items()},
    )


def _time(table: Table, row: int, clock: timezone | None) -> datetime:
    try:
        time = parse_time(table.columns[TIME][row])
    except ValueError:
        raise table.refuse("must be a time such as 2015-06-01T14:05", TIME, row) from None
    if time.utcoffset() is None and clock is None:
        raise table.refuse(
            "must say its offset from UTC, as in 2015-06-01T14:05+01:00, or the site file must "
            "give utc_offset", TIME, row,
        )
    return time if time.utcoffset() is not None else time.replace(tzinfo=clock)


def _number(table: Table, row: int, column: str) -> float:
    text = table.columns[column][row]
    try:
        value = float(text or "nan")
    except ValueError:
        value = math.inf
    if text and not math.isfinite(value):
        raise table.refuse("must be a number, or empty where there is none", column, row)
    return value


def _last_decimal(values: Values) -> float:
    """Return what 1 in the last decimal place is that any value has, 1e-12 at least."""
    there = values[~np.isnan(values)]
    places = 0
    while places < 12 and not np.allclose(np.round(there, places), there, rtol=1e-9, atol=0.0):
        places += 1
    return float(10.0**-places)


def _pumped(series: dict[str, Values], site: Site, step_s: float) -> Values:
    """Return what was pumped onto the roof (mm in a step), NaN where that is not known.

    While the pumps stand the cistern's level does not matter.
    """
    if "pumped" in series or "pump state" not in series:
        return series.get("pumped", np.zeros(len(series["rain"])))
    levels = series["cistern level"]
    most = np.array([maximum_pump_flow(site, x1) for x1 in levels * site.a1])
    most[np.isnan(levels)] = np.nan
    state = series["pump state"]
    return np.where(state == 0, 0.0, state * most * step_s * 1000 / site.a2)


def steps_of_rows(
    file: Path, times: Sequence[datetime], lines: Sequence[int]
) -> tuple[NDArray[np.int64], float]:
    """Return the step that each row is of, counted from the first row, and its duration (s).

    The duration is the median of the rows' spacings. Each row is of the step that begins nearest to
    its time, half a step off at most: so a clock that was set moves no row that comes after. Two
    rows can be of one step then.

    Args:
        file: for messages.
        times: of the rows.
        lines: of the rows in the file.

    Raises:
        ConfigurationError: a time is not later than the one before, the rows are more than a day
            apart, or more than one in a hundred is off a regular step.
    """
    since = np.array([time.timestamp() for time in times]) - times[0].timestamp()
    spacing = np.diff(since)

    def error(row: int, text: str) -> ConfigurationError:
        return ConfigurationError(
            text, file=file, line=lines[row], key=TIME, value=times[row].isoformat()
        )

    back = np.flatnonzero(spacing <= 0)
    if len(back):
        raise error(int(back[0]) + 1, "must be later than the time of the row before")
    step_s = float(np.median(spacing))
    # A roof's drainage is of hours; of longer sums nothing can be told that rain does not say.
    if step_s > DAY_S:
        raise error(
            1, f"the rows are {time_name(round(step_s))} apart; they must be a day apart at most"
        )
    counts = np.maximum(1.0, np.round(spacing / step_s))
    off = np.flatnonzero(np.abs(spacing / step_s - counts) > _LOOSENESS)
    if len(off) > _MOST_OFF * len(spacing):
        row = int(off[0]) + 1
        raise error(
            row,
            f"must be {step_s:g} s after the row before, or a whole number of such steps, not "
            f"{spacing[row - 1]:g} s; so are {len(off)} of {len(times)} rows, more than clocks "
            "that were set explain: write rows a regular step apart",
        )
    return np.floor(since / step_s + 0.5).astype(np.int64), step_s


def _sums(values: Values, slots: NDArray[np.int64]) -> Values:
    """Add up the rows of each step; NaN where it has none, or one of them has no value."""
    total = np.bincount(slots, values).astype(np.float64)
    total[np.bincount(slots) == 0] = np.nan
    return total


def _means(values: Values, slots: NDArray[np.int64]) -> Values:
    """Average the values that the rows of each step have; NaN where there is none."""
    there: Steps = ~np.isnan(values)
    steps = int(slots[-1]) + 1
    count = np.bincount(slots[there], minlength=steps)
    total = np.bincount(slots[there], values[there], minlength=steps)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
