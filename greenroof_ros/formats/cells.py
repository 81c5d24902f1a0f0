"""Tables of text cells, which are read strictly, with the file, line and column of every value.

The csv module of the standard library reads the text line by line. Polars is not used, because it
belongs to an optional extra that simulations do not need, and because it does not provide the line
number of a row after comments.
"""

from __future__ import annotations

import csv
import itertools
import math
import re
from array import array
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.ranges import Range, read_number
from greenroof_ros.base.times import (
    DEFAULT_START,
    FIRST_YEAR,
    LAST_YEAR,
    is_skipped,
    parse_time,
    time_hint,
    to_minutes,
)
from greenroof_ros.formats.quantities import (
    PRECIPITATION,
    QUANTITIES,
    Quantity,
    Unit,
    find_plausible,
)

HOUR = timedelta(hours=1)
# Hours of a service begin on whole hours; according to some clocks, a few seconds later.
_CLOCK_ERROR = timedelta(minutes=1)

MISSING = {"", "nan", "na", "n/a", "#n/a", "n/d", "m", "null", "none", "-", "--", "---", "missing"}
"""texts that denote a missing value, in lower case"""
# Digits of numbers that stand for one, besides nines.
_CODES = {
    "32767", "32768", "65535", "2147483647", "2147483648", "4294967295", "27315", "6999", "7999",
    "777", "7777", "888", "8888",
}
_HUGE = 1e15  # fill values of GRIB are larger
# No unit makes a plausible value so negative; MeteoSwiss writes -1000000.
_HUGE_NEGATIVE = 1e5
# Water that is less than a gauge can measure: T, as services write it, or less than a small amount.
_TRACE = re.compile(
    r"(0?[.,]?0*\s*)?(t|tr|traces?)\.?|<\s*(?P<below>\d*[.,]?\d+)", re.IGNORECASE | re.ASCII
)
# Share of a column's non-zero values that may be neither plausible nor a code: a wrong unit of rain
# shows in the few wettest hours.
_MAX_WRONG = 0.01
_MAX_NAMED = 3
# A comment, or a spreadsheet's line that names the separator.
_NO_RECORD = re.compile(r'\s*("?#|"?sep=."?\s*$)', re.IGNORECASE)
_LINE_END, _BYTE_ORDER_MARK = "\r\n", "\ufeff"
_NO_TEXT = f" ,;\t\x1a{_LINE_END}"
_DECIMAL_COMMA = re.compile(r"^([-+]?\d*),(\d+(?:e[-+]?\d+)?)$", re.ASCII | re.IGNORECASE)
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}[,.]\d{3}", re.ASCII)
_DECIMAL_POINT = re.compile(r"[-+]?\d*\.\d+", re.ASCII)
_HUNDREDS = re.compile(r"[-+]?[1-9]\d{2}", re.ASCII)
# Digits in groups, which may be separated by narrow or non-breaking spaces.
_GROUPS = re.compile(r"[-+]?\d{1,3}([ '_.,\u2019\u00a0\u202f]\d{2,3})+([.,]\d+)?", re.ASCII)
_PLAIN = "Write numbers with a decimal point and without a thousands separator"


class Row(NamedTuple):
    """A row of a table."""

    number: int
    """index of the row, from 0"""
    line: int | None
    """line number in the file; None for JSON"""
    cells: Sequence[str]


class Table:
    """A table: a header, and rows of cells without surrounding spaces.

    Attributes:
        file: file that contains the table.
        header: names of the columns.
        line: line number of the header; None for JSON, which has no lines.
        first: the first row.
        times: name of the column that contains the times, for notes.
        rows: all rows. The rows are read one by one, so that an error in a row is found before the
            rest of the file is read.
        notes: sentences about data that could not be used unchanged.
    """

    def __init__(
        self, file: Path, header: Sequence[str],
        rows: Iterable[tuple[int | None, Sequence[str]]], line: int | None = None, key: str = "",
    ) -> None:
        """Prepare the table, and read only its first row.

        Args:
            file: file that contains the table.
            header: names of the columns.
            rows: line number and cells of each row.
            line: line number of the header.
            key: prefix of the column names in JSON, such as ``hourly.``.

        Raises:
            ConfigurationError: if the table has no rows.
        """
        self.file, self.header, self.line = file, header, line
        self.notes = list[str]()
        self.times = next(
            (name for name in header if re.match(r"(date|time|issued)", name, re.IGNORECASE)),
            "".join(header[:1]),
        )
        self._key = key
        self._places = {name: place for place, name in reversed([*enumerate(header)])}
        numbered = (Row(number, *row) for number, row in enumerate(rows))
        first = next(numbered, None)
        if first is None:
            raise ConfigurationError("has a header but no records", file=file)
        self.first = first
        self.rows = itertools.chain([first], numbered)

    def cell(self, row: Row, column: str) -> str:
        """Return the text of a cell."""
        return row.cells[self._places[column]]

    def refuse(
        self, expected: str, column: str | None = None, row: Row | None = None
    ) -> ConfigurationError:
        """Return an error with the position and the text of a cell in a row or in the header."""
        if column is None or row is None:
            return ConfigurationError(expected, file=self.file, line=self.line, value=column)
        key = f"{self._key}{column.partition(' ')[0]}[{row.number}]" if self._key else column
        return ConfigurationError(
            expected, file=self.file, line=row.line, key=key, value=self.cell(row, column)
        )

    def require_columns(self, columns: Iterable[str], source: str) -> None:
        """Reject a header that does not contain each of these columns exactly once."""
        for column in columns:
            if column not in self.header:
                raise self.refuse(f"must have a column '{column}', like {source}")
            if self.header.count(column) > 1:
                raise self.refuse("is the name of more than one column", column)

    def require_header(self, columns: Sequence[str], why: str) -> None:
        """Reject a header with different columns or a different order of columns."""
        for cell, name in itertools.zip_longest(self.header, columns):
            if cell != name:
                wrong = "is an extra column" if name is None else f"the column must be '{name}'"
                raise self.refuse(f"{wrong}{why}", cell or "")

    def read_number(
        self, row: Row, column: str, limits: Range, missing: Container[str] = ()
    ) -> float:
        """Return the number in a cell, or NaN for a text that denotes a missing value.

        Raises:
            ConfigurationError: if the cell does not contain a number within the limits.
        """
        text = self.cell(row, column)
        if text in missing:
            return math.nan
        try:
            return limits.check(read_number(text))
        except ValueError:
            raise self.refuse(limits.expected(text), column, row) from None

    def read_time(
        self, row: Row, column: str, parse: Callable[[str], datetime] = parse_time,
        example: str = DEFAULT_START, hint: str = "", zone: tzinfo | None = None,
        before: datetime | None = None,
    ) -> datetime:
        """Return the time in a cell.

        Args:
            row: row of the cell.
            column: column of the cell.
            parse: function that returns the time in a text, or raises ValueError; by default, it
                reads ISO 8601 with a UTC offset.
            example: example of a time, for messages.
            hint: end of the message about a missing offset.
            zone: time zone of times without an offset, including its daylight saving time.
            before: time of the previous row. In the hour that occurs twice when daylight saving
                time ends, a time that is not later than the previous one belongs to the second
                occurrence.

        Raises:
            ConfigurationError: if the cell does not contain a time, lacks a UTC offset, or is in an
                hour that is skipped when daylight saving time begins.
        """
        text = self.cell(row, column)
        try:
            time = parse(text)
        except ValueError:
            what = "" if re.search(r"\d", text) else (
                "; if this line contains units or a total instead of a record, delete it"
            )
            raise self.refuse(
                f"must be a time such as {example}, {FIRST_YEAR} to {LAST_YEAR}"
                + (time_hint(text) or what), column, row,
            ) from None
        if time.tzinfo is not None:
            return time
        if zone is None:
            raise self.refuse(
                f"must include a UTC offset, as in {DEFAULT_START}{hint}", column, row
            )
        local = time.replace(tzinfo=zone)
        if is_skipped(local):
            raise self.refuse(
                f"is in an hour that clocks in {zone} skip; does the record stay on standard "
                "time? If so, add the UTC offset to every time", column, row,
            )
        if before is not None and local.astimezone(timezone.utc) <= before:
            local = local.replace(fold=1)
        offset = local.utcoffset()
        assert offset is not None
        return time.replace(tzinfo=timezone(offset))

    def read_hours(
        self, column: str, columns: Mapping[str, Column], parse: Callable[[str], datetime],
        example: str, *, in_order: bool = True, station: str | None = None,
    ) -> tuple[datetime, dict[str, NDArray[np.float64]]]:
        """Read all rows, each of which contains the values of an hour.

        An hour without a row is missing. A time may differ from the whole hour by up to one minute.

        Args:
            column: name of the column of times.
            columns: the columns of values, by name.
            parse: function that reads a time, as for :meth:`read_time`.
            example: example of a time, as for :meth:`read_time`.
            in_order: whether rows must be in chronological order; otherwise, every hour may occur
                only once.
            station: name of the column that identifies the station; None without such a column.

        Returns:
            The first time, and the values of every column from this time on, shape (hours,); NaN if
            missing.

        Raises:
            ConfigurationError: if a time is not a whole number of hours after the previous row, if
                a row is from a different station, or if :meth:`read_time` raises one.
        """
        self.times = column
        first = self.read_time(self.first, column, parse, example).replace(second=0, microsecond=0)
        hours: list[int] = []
        present = set[int]()
        for row in self.rows:
            if station and self.cell(row, station) != self.cell(self.first, station):
                raise self.refuse(
                    "is a different station: write a separate file for each station", station, row,
                )
            time = self.read_time(row, column, parse, example)
            hour = round((time - first) / HOUR)
            off = abs(time - first - hour * HOUR)
            if off > _CLOCK_ERROR or hour in present or (
                in_order and hours and hour <= hours[-1]
            ):
                expected = first.astimezone(time.tzinfo) + (hours[-1] + 1) * HOUR
                raise self.refuse(
                    f"must be {to_minutes(expected)}, or a whole number of hours later: each row "
                    "is one hour; for an hour without values, leave the cells empty or leave out "
                    "the row", column, row,
                )
            hours.append(hour)
            present.add(hour)
            for values in columns.values():
                values.add(row)
        earliest = min(hours)
        return first + earliest * HOUR, arrange_by_hour(
            judge_columns(columns), np.array(hours) - earliest
        )


NEAR, CODE, WRONG = "near", "code", "wrong"
"""Kinds of odd cells: just outside the range, a code for a missing value, and all others."""


class Cell(NamedTuple):
    """A cell of a column of values."""

    text: str
    number: float
    """number in the cell; NaN if the text is not a number"""
    value: float
    """number converted to this project's unit"""
    quantity: Quantity


Verdict = tuple[float, str]
"""value to use, and the kind of odd cell; the kind is empty for ordinary cells"""


def take_plausible(cell: Cell) -> Verdict | None:
    """Accept a plausible value unchanged."""
    _, low, high, *_ = cell.quantity
    return (cell.value, "") if low <= cell.value <= high else None


def take_missing(cell: Cell) -> Verdict | None:
    """Treat an empty cell and the usual words for a missing value as NaN."""
    return (math.nan, "") if cell.text.lower() in MISSING else None


def take_trace(cell: Cell) -> Verdict | None:
    """Treat a trace of water as 0."""
    match = _TRACE.fullmatch(cell.text) if cell.quantity.is_water else None
    if match is None or float((match["below"] or "0").replace(",", ".")) > cell.quantity.nearly:
        return None
    return 0.0, ""


def take_near(cell: Cell) -> Verdict | None:
    """Set a value just outside the range to the nearest limit."""
    _, low, high, nearly, _ = cell.quantity
    near = low - nearly <= cell.value <= high + nearly
    return (min(max(cell.value, low), high), NEAR) if near else None


def take_code(cell: Cell) -> Verdict | None:
    """Treat words, codes such as -999, and physically impossible negative values as missing."""
    if math.isnan(cell.number):
        is_code = cell.text.startswith("#") or not re.search(r"\d", cell.text)
    elif cell.number <= 0 <= cell.quantity.low and cell.value < cell.quantity.low:
        is_code = True  # also a pressure of 0
    else:
        is_code = _has_digits_of_code(cell.text) or not -_HUGE_NEGATIVE < cell.number < _HUGE
    return (math.nan, CODE) if is_code else None


def _has_digits_of_code(text: str) -> bool:
    digits = text.lstrip("+-").replace(".", "").strip("0")
    return digits in _CODES or re.fullmatch("9{2,}", digits) is not None


CELL_RULES = take_plausible, take_missing, take_trace, take_near, take_code
"""Rules for cells, in order. The first rule that accepts a cell decides; else the cell is wrong."""


def read_cell(text: str, quantity: Quantity, unit: Unit) -> Cell:
    """Return a cell with its number, converted to this project's unit."""
    try:
        number = read_number(text)
    except ValueError:
        number = math.nan
    return Cell(text, number, (number - unit.zero) / unit.per_ours, quantity)


def judge_cell(cell: Cell) -> Verdict:
    """Return the value of a cell in this project's unit, and the cell's kind of irregularity."""
    for rule in CELL_RULES:
        if verdict := rule(cell):
            return verdict
    return math.nan, WRONG


class Given(NamedTuple):
    """The numbers of a column in this project's unit, including implausible numbers."""

    quantity: Quantity
    unit: str
    """name of the unit in the file"""
    values: NDArray[np.float64]
    """numbers of the rows that contain a number"""
    step_h: float = 1.0
    """interval between rows (h)"""
    name: str = PRECIPITATION
    """name of the quantity"""


# A running total rises, or stays the same: for this many rows per rise if rises are few, and for
# this many if they are not. In rain, as many hours have less than the hour before as have more, so
# this many wet rows in succession do not all exceed the previous one by chance.
_MIN_RISES, _MANY_RISES, _SAME_OF_FEW, _SAME_OF_MANY = 3, 10, 5.0, 0.5
# It rarely falls, only when it is reset to 0, and more rarely than rain does; rain falls in amount
# about as often as it rises. A change of less than this share of its range is noise.
_MAX_FALLS, _MAX_FALLS_IN_RAIN, _NOISE = 0.4, 0.15, 0.02
# Sliding sums must be found in this many different wet spells; a change of less than this share of
# the minimum amount is rounding.
_MIN_SPELLS, _NEARLY_DRY = 8, 0.5
# A sum is rounded.
_NEARLY_SUM = 1e-3
# A saturated sensor reports fractions slightly above 1.
_MAX_FRACTION = 1.05


def find_running_total(given: Given) -> str:
    """Find running totals of water, including totals that are reset every day."""
    if not given.quantity.is_water or not given.values.size:
        return ""
    wet, changes = given.values > 0, np.diff(given.values)
    noise = _NOISE * float(np.ptp(given.values))
    if np.gcd.reduce(np.diff(np.flatnonzero(changes))) > 1:
        return ""  # from longer rows, each repeated in shorter ones
    rises, falls = np.count_nonzero(changes > noise), np.count_nonzero(changes < -noise)
    changes = changes[wet[:-1] & wet[1:]]
    same = np.count_nonzero(np.abs(changes) <= noise)
    share = _SAME_OF_MANY if rises >= _MANY_RISES else _SAME_OF_FEW
    in_rain = np.count_nonzero(changes < -noise)
    if rises < _MIN_RISES or same < share * rises or (
        falls > _MAX_FALLS * rises or in_rain > _MAX_FALLS_IN_RAIN * rises
    ):
        return ""
    return (
        f"is a running total: it rises {rises} times, stays the same in {same} rows and falls "
        f"{falls} times; in each row, write only the amount for that row's interval, which is "
        "the difference from the previous row"
    )


def find_event_total(given: Given) -> str:
    """Find rain that never decreases from one wet row to the next."""
    wet = given.values > 0
    changes = np.diff(given.values)[wet[:-1] & wet[1:]]
    rises = np.count_nonzero(changes > 0)
    if given.name != PRECIPITATION or rises < _MANY_RISES or (changes < 0).any():
        return ""
    return (
        f"rises {rises} times from one wet row to the next, and never falls: is it the total "
        "since the rain event began?"
    )


def find_fraction(given: Given) -> str:
    """Find fractions in a column that should contain percentages."""
    share = given.values * (1.0 if given.quantity.unit == "%" else 100.0)
    if given.unit != "%" or not share.size or not 0 < share.max() <= _MAX_FRACTION:
        return ""
    return f"has no value above {_MAX_FRACTION:g}: are the values fractions? If so, the unit is [1]"


def find_sum(given: Given) -> str:
    """Find a last row that contains the sum of all other amounts."""
    if not given.quantity.is_water or np.count_nonzero(given.values) < _MANY_RISES:
        return ""
    if not math.isclose(given.values[-1], given.values[:-1].sum(), rel_tol=_NEARLY_SUM):
        return ""
    return "contains the sum of the other values in its last row: leave that row out"


def find_sliding_sum(given: Given) -> str:
    """Find moving sums over n rows, such as the rain of the last hour in ten-minute rows.

    Normally, rain appears in only one row. In moving sums, however, rain appears in n rows, so no
    wet spell is shorter than n rows, and the rain recovered from the sums, S(t) - S(t-1) + r(t-n),
    is never negative. Rows that repeat or interpolate values change only in every n-th row. The
    rule does not apply to quantities that are smooth by nature, such as runoff, because they
    resemble moving sums.
    """
    if given.name != PRECIPITATION or not given.values.size:
        return ""
    sums = given.values
    begins = 1 + np.flatnonzero((sums[:-1] <= 0) & (sums[1:] > 0))
    ends = 1 + np.flatnonzero((sums[:-1] > 0) & (sums[1:] <= 0))
    ends = ends[ends > begins[0]] if begins.size else begins
    begins = begins[: len(ends)]
    # For a rate, the sum over an hour is a mean.
    fewest = 2 if "/" not in given.unit else math.floor(1 / given.step_h) + 1
    spells = {
        tuple(np.diff(sums[begin - 1 : end + 1]).tolist())
        for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)
    }
    if len(spells) < _MIN_SPELLS:
        return ""
    nearly = _NEARLY_DRY * float(sums[sums > 0].min())
    rows = next((
        rows for rows in range(int((ends - begins).min()), fewest - 1, -1)
        if _is_sum_of_rows(spells, rows, nearly)
    ), 0)
    if not rows:
        return ""
    return (
        f"has no wet spell of fewer than {rows} rows: is each value the sum of the last {rows} "
        "rows? In each row, write only the rain of that row's interval"
    )


def _is_sum_of_rows(spells: Iterable[tuple[float, ...]], rows: int, nearly: float) -> bool:
    """Return True if every value could be the sum of the rain in the given number of rows.

    Args:
        spells: differences between consecutive rows of every wet spell, including the dry row
            before and the dry row after the spell.
        rows: number of rows in a sum.
        nearly: amount below which a value counts as 0.
    """
    wet_at, changed_at = set[int](), set[int]()  # rows since the beginning of their spell
    for spell in spells:
        whole = np.zeros(-(-len(spell) // rows) * rows)
        whole[: len(spell)] = spell
        rain = whole.reshape(-1, rows).cumsum(axis=0).ravel()[: len(spell)]
        if (rain < -nearly).any():
            return False
        wet_at.update(np.flatnonzero(rain > nearly).tolist())
        changed_at.update((1 + np.flatnonzero(np.abs(np.diff(rain)) > nearly)).tolist())
    return math.gcd(*wet_at) == 1 == math.gcd(*changed_at)


COLUMN_RULES = find_running_total, find_event_total, find_fraction, find_sum, find_sliding_sum
"""Rules that question a column: each returns a note, or an empty text."""


class Column:
    """The values of a table's column in this project's unit, which are read row by row.

    A value just outside the range is set to the nearest limit. Codes such as -999, words, negative
    values of a quantity that cannot be negative, and a few other implausible values are treated as
    missing. The table's notes report all of these cells.
    """

    def __init__(
        self, table: Table, name: str, quantity: str, unit: Unit | None = None, *,
        step_h: float = 1.0, optional: bool | None = None,
        cell: Callable[[Row], str] | None = None,
        rules: Sequence[Callable[[Given], str]] = COLUMN_RULES,
    ) -> None:
        """Prepare the column.

        Args:
            table: table that contains the column.
            name: name of the column.
            quantity: name of the quantity, one of :data:`.quantities.QUANTITIES`.
            unit: unit of the column; by default, this project's unit of the quantity.
            step_h: interval between rows (h).
            optional: whether a column that contains only codes is treated as missing rather than as
                an error; by default, true for all quantities except precipitation.
            cell: function that returns the text for a row; by default, the text in the column.
            rules: rules for the whole column; empty if its rows are not consecutive in time.
        """
        self._rules, self._of = rules, quantity
        self._table, self._name = table, name
        self.unit = unit or Unit(QUANTITIES[quantity].unit)
        self._quantity = find_plausible(quantity, step_h, self.unit)
        self._optional = quantity != PRECIPITATION if optional is None else optional
        self._step_h = step_h
        self._cell = cell or (lambda row: table.cell(row, name))
        self._values, self._given = array("d"), array("d")
        self._odd: dict[str, list[Row]] = {NEAR: [], CODE: [], WRONG: []}

    def add(self, row: Row) -> None:
        """Read and store the value of a row."""
        cell = read_cell(self._cell(row), self._quantity, self.unit)
        value, what = judge_cell(cell)
        self._values.append(value)
        self._given.append(math.nan if what == CODE else cell.value)
        if math.isnan(cell.number) and _GROUPS.fullmatch(cell.text):
            raise self._table.refuse(
                f"contains a separator between digits. {_PLAIN}", self._name, row,
            )
        if what:
            self._odd[what].append(row)

    @property
    def is_empty(self) -> bool:
        """Whether all cells of the column denote missing values."""
        return not any(self._odd.values()) and all(map(math.isnan, self._values))

    def judge(self) -> NDArray[np.float64]:
        """Return the values of all rows, shape (rows,); NaN for values that cannot be used.

        Raises:
            ConfigurationError: if too few values are plausible.
        """
        numbers = np.array(self._given)
        given = Given(
            self._quantity, self.unit.name, numbers[~np.isnan(numbers)], self._step_h, self._of
        )
        for rule in self._rules:
            if note := rule(given):
                self._table.notes.append(f"{self._table.file.name}: {self._name} {note}")
        values = np.array(self._values)
        known = values[~np.isnan(values)]
        near, codes, wrong = self._odd.values()
        if len(wrong) > max(1.0, _MAX_WRONG * np.count_nonzero(known)) or (
            not known.size and (wrong or (codes and not self._optional))
        ):
            raise self._refuse((wrong or codes)[0])
        unit, low, high, *_ = self._quantity
        self._note(near, f"was set to the nearest limit of the range, {low:g} to {high:g} {unit}")
        self._note(sorted(codes + wrong), "is not a plausible value, and is treated as missing")
        return values

    def _refuse(self, row: Row) -> ConfigurationError:
        low, high = (
            float(f"{end * self.unit.per_ours + self.unit.zero:g}")
            for end in (self._quantity.low, self._quantity.high)
        )
        expected = Range(low, high, self.unit.name).expected(self._table.cell(row, self._name))
        return self._table.refuse(
            f"{expected}, or empty; is the unit of the column right?", self._name, row
        )

    def _note(self, rows: Sequence[Row], what: str) -> None:
        """Add a note about some cells, with the texts and times of the first of them."""
        if not rows:
            return
        table = self._table
        named = [
            f"{table.cell(row, self._name)} at {table.cell(row, table.times)}"
            for row in rows[:_MAX_NAMED]
        ]
        if len(rows) > _MAX_NAMED:
            named.append(f"{len(rows) - _MAX_NAMED} more")
        table.notes.append(f"{table.file.name}: {self._name} of {' and '.join(named)} {what}")


def judge_columns(columns: Mapping[str, Column]) -> dict[str, NDArray[np.float64]]:
    """Return the values of columns after all rows have been read; see :meth:`Column.judge`."""
    return {name: column.judge() for name, column in columns.items()}


def arrange_by_hour(
    columns: Mapping[str, NDArray[np.float64]], hours: NDArray[np.intp]
) -> dict[str, NDArray[np.float64]]:
    """Arrange the rows of columns by hour, with NaN in hours without a row.

    Args:
        columns: values of every column by name, shape (rows,).
        hours: index of the hour of every row, from 0.
    """
    values = {name: np.full(hours.max() + 1, np.nan) for name in columns}
    for name, series in columns.items():
        values[name][hours] = series
    return values


def number_lines(text: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield all lines, numbered from 1, except comments (``#``) and blank lines.

    The first line is also skipped if it is the one in which spreadsheets declare the separator.
    """
    lines = itertools.chain.from_iterable(part.splitlines(keepends=True) for part in text)
    for number, marked in enumerate(lines, start=1):
        line = marked.removeprefix(_BYTE_ORDER_MARK)  # from a file that was appended
        if line.strip(_NO_TEXT) and not _NO_RECORD.match(line):
            yield number, line


def read_table(
    file: Path, lines: Iterable[tuple[int, str]] | None = None,
    observed: Callable[[str], bool] = lambda _: False,
) -> Table:
    """Read CSV as a table; a quoted cell must end within its line.

    The separator is a comma, a semicolon or a tab, whichever is most frequent in the header. A
    number may have a decimal comma, unless the comma could be a thousands separator. A repeated
    header, as in files that were appended to each other, is skipped.

    Args:
        file: file to read.
        lines: lines of the table, beginning with the header, as returned by :func:`number_lines`;
            by default, all lines of the file.
        observed: function that returns True for the name of a column that contains values. If a row
            ends before the first of these columns, its other cells are empty, and its hour is
            missing.

    Raises:
        ConfigurationError: if the file cannot be read, if the header or all rows are missing, if a
            row has more or fewer cells than the header, or if a quote is not closed or is followed
            by text. A row is rejected when it is read; if the last row is cut off by the end of the
            file, a note reports it.
    """
    numbered = iter(number_lines(read_lines(file)) if lines is None else lines)
    line, text = next(numbered, (0, ""))
    if not line:
        raise ConfigurationError(
            "contains only comments; a header and records must follow", file=file,
        )
    separator = max(",;\t", key=text.count)
    header = _split(file, line, text, separator)
    while header and not header[-1]:  # separators at the end of each line
        header.pop()
    first = next((index for index, name in enumerate(header) if observed(name)), 0)

    def rows() -> Iterator[tuple[int, list[str]]]:
        begun = whole = False
        marks = set[str]()  # decimal marks
        # For every mark, the first number in which it may be a decimal mark or separate thousands.
        grouped: dict[str, ConfigurationError] = {}
        for line, text in numbered:
            cells = _split(file, line, text, separator)
            if [cell for cell in cells if cell] == [name for name in header if name]:
                table.notes.append(f"{file.name}: line {line} repeats the header and was ignored")
                continue
            if begun and cells[0] == header[0]:
                raise ConfigurationError(
                    "is a second header, with different columns: move this line and all later "
                    "lines to a separate file", file=file, line=line,
                )
            for place, cell in enumerate(cells):
                mark = ""
                if "," in cell and _DECIMAL_COMMA.match(cell):
                    cells[place] = _DECIMAL_COMMA.sub(r"\1.\2", cell)
                    mark = ","
                elif "." not in marks and place >= first and _DECIMAL_POINT.fullmatch(cell):
                    mark = "."
                elif not marks and place >= first:
                    whole = whole or _HUNDREDS.fullmatch(cell) is not None
                if mark and _THOUSANDS.fullmatch(cell):
                    grouped.setdefault(mark, ConfigurationError(
                        f"is '{mark}' a decimal mark or a thousands separator? {_PLAIN}",
                        file=file, line=line, value=cell,
                    ))
                elif mark:
                    marks.add(mark)
            for mark, error in grouped.items():
                if marks - {mark}:
                    raise error
            if begun and len(cells) < len(header) and text == text.rstrip(_LINE_END):
                table.notes.append(f"{file.name}: line {line} is incomplete and was ignored")
                return
            begun = True
            if len(cells) <= first:
                cells += [""] * (len(header) - len(cells))
            elif not any(cells[len(header) :]):
                del cells[len(header) :]
            if len(cells) != len(header):
                hint = ""
                if separator == "," and len(cells) > len(header):
                    hint = "; quote numbers with decimal commas, or separate cells by semicolons"
                raise ConfigurationError(
                    f"must have {len(header)} cells, as many as the header, but has "
                    f"{len(cells)}{hint}",
                    file=file, line=line,
                )
            yield line, cells
        # Otherwise whole numbers would be written with decimals, too.
        for mark, error in grouped.items():
            if not marks and (separator == "," if mark == "," else whole and separator == ";"):
                raise error

    table = Table(file, header, rows(), line)
    return table


def _split(file: Path, line: int, text: str, separator: str) -> list[str]:
    try:
        cells = next(csv.reader([text], delimiter=separator, strict=True))
    except csv.Error as error:
        raise ConfigurationError(f"is not valid CSV: {error}", file=file, line=line) from error
    return [cell.strip() for cell in cells]
