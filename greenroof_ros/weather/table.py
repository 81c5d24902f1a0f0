"""Tables of text cells in CSV, and the measurements in them, with the line and column of an error.

The csv module of the standard library reads the text line by line. Polars and pandas are not used,
because a node does not need them otherwise, and because they do not provide the line number of a
cell.
"""

from __future__ import annotations

import csv
import itertools
import math
from array import array
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.parameter import keys
from greenroof_ros.base.ranges import Range, read_number
from greenroof_ros.base.times import DEFAULT_START, duration, is_skipped, parse_time
from greenroof_ros.site.site import Place, Site
from greenroof_ros.weather.description import (
    END,
    PLACE,
    SEPARATORS,
    STANDARD,
    TIME,
    Description,
    find_service,
    make_description,
    quantity_of,
    read_comment,
    service_descriptions,
    unknown_unit,
)
from greenroof_ros.weather.quantities import (
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    QUANTITIES,
    SYNONYMS,
    find_unit,
)

Values = NDArray[np.float64]
_HOUR_S = 3600.0
# Rows from which the step is taken, the share of a step by which a time may be off, and the share
# by which a step of whole minutes may be off because of the logger's clock.
_FIRST_ROWS, _OFF, _CLOCK = 10, 0.25, 0.02
_LEVELS = "level", "cistern level"
_PLACES = dict(zip(PLACE, (90.0, 180.0), strict=True))


class Row(NamedTuple):
    """A row of a table."""

    line: int
    """line number in the file"""
    cells: Sequence[str]


class Table:
    """A table: a header, and rows of cells without surrounding spaces, which are read one by one.

    Attributes:
        file: file that contains the table.
        header: names of the columns.
        line: line number of the header; None for a data frame, whose rows have no lines.
        rows: the rows.
    """

    def __init__(
        self, file: Path, header: Sequence[str], line: int | None, rows: Iterator[Row]
    ) -> None:
        """Prepare the table, and read its first row.

        Raises:
            ConfigurationError: if the table has no rows, or its first row is invalid.
        """
        self.file, self.header, self.line = file, header, line
        self._places = {name: place for place, name in reversed([*enumerate(header)])}
        first = next(rows, None)
        if first is None:
            raise ConfigurationError("has a header but no rows", file=file)
        self.first, self.rows_after_first = first, rows
        self.rows: Iterator[Row] = itertools.chain([first], rows)

    def place(self, column: str) -> int:
        """Return the position of a column, from its name or its number.

        Raises:
            ConfigurationError: if the header does not contain the column exactly once.
        """
        if column.isdecimal() and column not in self.header and int(column) < len(self.header):
            return int(column)
        if self.header.count(column) != 1:
            what = "occurs more than once" if column in self.header else suggest_names(
                column, self.header
            )
            raise self.refuse(f"must be the name of one column of the file; {what}", column)
        return self._places[column]

    def cell(self, row: Row, column: str) -> str:
        """Return the text of a cell."""
        return row.cells[self._places[column] if column in self._places else int(column)]

    def refuse(
        self, expected: str, column: str | None = None, row: Row | None = None
    ) -> ConfigurationError:
        """Return an error with the place and the text of a cell in a row or in the header."""
        if column is None or row is None:
            return ConfigurationError(expected, file=self.file, line=self.line, value=column)
        return self.refuse_at(expected, row.line, column, self.cell(row, column))

    def refuse_at(
        self, expected: str, line: int, key: str, value: object = None
    ) -> ConfigurationError:
        """Return an error about a value in a line of the file, or in a row of a data frame."""
        if self.line is None:
            return ConfigurationError(
                expected, file=f"{self.file}, row {line}", key=key, value=value
            )
        return ConfigurationError(expected, file=self.file, line=line, key=key, value=value)

    def require_header(self, columns: Sequence[str], why: str) -> None:
        """Reject a header with different columns or a different order of columns."""
        for cell, name in itertools.zip_longest(self.header, columns):
            if cell != name:
                wrong = "is an extra column" if name is None else f"the column must be '{name}'"
                raise self.refuse(f"{wrong}{why}", cell or "")

    def read_number(self, row: Row, column: str, limits: Range) -> float:
        """Return the number in a cell.

        Raises:
            ConfigurationError: if the cell does not contain a number within the limits.
        """
        text = self.cell(row, column)
        try:
            return limits.check(read_number(text))
        except ValueError:
            raise self.refuse(limits.expected(text), column, row) from None

    def read_time(self, row: Row, column: str) -> datetime:
        """Return the time in a cell, which must include its UTC offset.

        Raises:
            ConfigurationError: if the cell does not contain such a time.
        """
        try:
            time = parse_time(self.cell(row, column))
        except ValueError:
            raise self.refuse(f"must be a time such as {DEFAULT_START}", column, row) from None
        if time.tzinfo is None:
            raise self.refuse(f"must include a UTC offset, as in {DEFAULT_START}", column, row)
        return time


def split(text: str, separator: str) -> list[str]:
    """Return the cells of a line; a quoted cell must end within its line.

    Raises:
        ValueError: if a quote is not closed, or is followed by text.
    """
    if '"' not in text:
        return [cell.strip() for cell in text.split(separator)]
    try:
        cells = next(csv.reader([text.strip()], delimiter=separator, strict=True))
    except csv.Error as error:
        raise ValueError(str(error)) from None
    return [cell.strip() for cell in cells]


def read_table(
    file: Path, lines: Iterable[tuple[int, str]] | None = None, separator: str = ",",
    first_value: Callable[[Sequence[str]], int] = lambda _: 0,
) -> Table:
    """Read CSV as a table; blank lines, and lines that begin with ``#``, are left out.

    Args:
        file: file to read.
        lines: numbered lines, beginning with the header; by default, those of the file.
        separator: separator between cells.
        first_value: function that returns the position of the first column with a value. A row that
            ends before it is a row without values.

    Raises:
        ConfigurationError: if the file cannot be read, or the header or all rows are missing. A row
            that has more or fewer cells than the header is rejected when it is read.
    """
    if lines is None:
        lines = enumerate(read_lines(file), start=1)
    numbered = (
        (number, text) for number, text in lines
        if text.strip() and not text.lstrip().startswith("#")
    )

    def parse(number: int, text: str) -> list[str]:
        try:
            return split(text, separator)
        except ValueError as error:
            raise ConfigurationError(
                f"is not a line of CSV: {error}", file=file, line=number
            ) from None

    line, text = next(numbered, (0, ""))
    if not line:
        raise ConfigurationError("must contain a header and rows", file=file)
    header = [" ".join(name.split()) for name in parse(line, text)]
    while header and not header[-1]:  # separators at the end of each line
        header.pop()
    count, first = len(header), first_value(header)

    def rows() -> Iterator[Row]:
        for number, text in numbered:
            cells = parse(number, text)
            if len(cells) > count and not any(cells[count:]):
                cells = cells[:count]
            if len(cells) < count and len(cells) <= first:
                cells += [""] * (count - len(cells))
            if len(cells) != count:
                raise ConfigurationError(
                    f"must have {count} cells, like the header, but has {len(cells)}", file=file,
                    line=number,
                )
            yield Row(number, cells)

    return Table(file, header, line, rows())


@dataclass(frozen=True)
class Rows:
    """The rows of a file of measurements at regular intervals.

    Attributes:
        table: table of the file, for messages; its rows have been read.
        described: what the file means, with the statements in its comments.
        columns: name and unit of the column of every quantity.
        method: method of the evapotranspiration; empty without a column of evapotranspiration.
        first: start of step 0, with a UTC offset.
        step_s: interval between rows (s).
        steps: index of every row's step, from 0 and increasing; steps without a row are missing.
        values: values of every quantity in the rows, in the unit of :data:`.quantities.QUANTITIES`;
            NaN if missing.
        ignored: columns that were not read.
    """

    table: Table
    described: Description
    columns: dict[str, tuple[str, str]]
    method: str
    first: datetime
    step_s: float
    steps: NDArray[np.int64]
    values: dict[str, Values]
    ignored: tuple[str, ...]

    @property
    def position(self) -> tuple[float, float] | None:
        """Latitude and longitude (degrees) that the file states; None if it states none."""
        latitude, longitude = self.described.latitude, self.described.longitude
        return None if latitude is None or longitude is None else (latitude, longitude)


def read_rows(
    file: Path, site: Place, wanted: Collection[str], described: Description | None = None
) -> Rows:
    """Read a file of measurements.

    Without a description, the file is in this project's own form or in that of a service; see
    :mod:`.description`. A row covers the interval that begins (or, with ``rows: end``, ends) at its
    time, which may be off by a quarter of the interval. Levels are the values at the row's time. An
    amount is the total in a row's interval; litres and m3 refer to the whole roof of area ``a2``.

    Args:
        file: file to read.
        site: place with its clock; the site, if litres and m3 may occur.
        wanted: quantities to read; columns of other quantities are ignored.
        described: description of the file.

    Raises:
        ConfigurationError: if the file does not conform to its description; the message names the
            line, the column and the value.
    """
    table, described = _open(file, described)
    columns, method = find_columns(table, described)
    cells = {
        name: _Cells(table, columns[name][0], name, described)
        for name in columns if name in wanted
    }
    times = _read_times(table, site, described, [*cells.values()])
    position = _read_position(table, described)
    return arrange(
        table, replace(described, **position), site, columns, method, times,  # type: ignore[arg-type]
        {name: np.array(each.numbers) for name, each in cells.items()},
    )


class Times(NamedTuple):
    """The times of rows."""

    seconds: Values
    """times (s since 1970), in ascending order"""
    lines: Sequence[int]
    """line of every row in the file, or number of the row in a data frame"""
    offset: float
    """UTC offset of the first row (s)"""


def arrange(
    table: Table, described: Description, site: Place, columns: dict[str, tuple[str, str]],
    method: str, times: Times, numbers: Mapping[str, Values],
) -> Rows:
    """Return rows in steps, from times, and numbers in the units of the file.

    Args:
        table: the table, for messages.
        described: what the table means.
        site: the site, if litres and m3 may occur.
        columns: name and unit of the column of every quantity.
        method: method of the evapotranspiration.
        times: times of the rows.
        numbers: numbers of every quantity, NaN if missing.

    Raises:
        ConfigurationError: if the rows are not at regular intervals, or a value is outside the
            physical range of its quantity.
    """
    step_s = described.step or _find_step(table, times)
    begin, steps = _number_steps(table, times, step_s)
    area = site.a2 if isinstance(site, Site) else math.nan
    values = {
        name: _convert(table, *columns[name], name, series, times.lines, step_s / 3600, area)
        for name, series in numbers.items()
    }
    if described.rows == END:
        begin -= step_s
        for level in values.keys() & {*_LEVELS}:
            values[level] = _move_to_next(values[level], steps)
    zone = timezone(timedelta(seconds=times.offset))
    used = {
        TIME, *(column for column, _ in columns.values()), *described.flags.values(),
        *itertools.chain(*described.columns.values()),
    }
    return Rows(
        table, described, columns, method,
        datetime.fromtimestamp(begin - times.offset, timezone.utc).astimezone(zone), step_s, steps,
        values, tuple(name for name in table.header if name not in used),
    )


# --- the form of a file ---------------------------------------------------------------------------


def _open(file: Path, described: Description | None) -> tuple[Table, Description]:
    """Return the table of a file, and its description with the statements in its comments."""
    given = described or Description()
    lines = enumerate(read_lines(file, given.encoding), start=1)
    if given.columns:
        skipped = {*given.skiprows}
        kept = ((number, text) for number, text in lines if number - 1 not in skipped)
        return _read_as(file, _without_last(kept, given.skipfooter), given), given
    head, stated = [(0, "")], dict[str, object]()
    for number, text in lines:
        if text.strip():
            head.append((number, text))
            if not text.lstrip().startswith("#"):
                break
            for key, value in read_comment(file, number, text).items():
                if stated.setdefault(key, value) != value:
                    raise ConfigurationError(
                        "differs from an earlier comment", file=file, line=number, key=key,
                        value=value,
                    )
    is_own = head[-1][1].strip('" \r\n').startswith(TIME)
    for number, text in () if is_own else head[-2:]:  # a header can be the last comment
        for separator in SEPARATORS.values():
            header = [cell.strip('" ') for cell in text.strip().split(separator)]
            service = find_service(header, separator)
            if service is not None:
                later = [line for line in head if line[0] > number]
                start = (number, text.replace("#", " ", 1))
                return _read_as(file, itertools.chain([start], later, lines), service), service
    made = make_description({
        **stated, **{
            key.name: getattr(given, key.name) for key in keys(Description)
            if getattr(given, key.name) != getattr(Description(), key.name)
        },
    })
    table = _read_as(file, itertools.chain(head[-1:], lines), made)
    if table.header[0] != TIME:
        known = sorted({described.name for described in service_descriptions()})
        raise table.refuse(
            f"must be '{TIME}', or the header must be that of a service ({', '.join(known)}); for "
            "any other file, write a description: greenroof weather FILE --describe",
            table.header[0],
        )
    return table, made


def _without_last(
    lines: Iterable[tuple[int, str]], count: int
) -> Iterator[tuple[int, str]]:
    waiting = deque[tuple[int, str]]()
    for line in lines:
        waiting.append(line)
        if len(waiting) > count:
            yield waiting.popleft()


def _read_as(file: Path, lines: Iterable[tuple[int, str]], described: Description) -> Table:
    values = {column for name in described.columns.keys() & QUANTITIES.keys()
              for column in described.columns[name]}

    def first_value(header: Sequence[str]) -> int:
        return min((header.index(name) for name in values if name in header), default=0)

    return read_table(file, lines, described.separator, first_value)


def find_columns(
    table: Table, described: Description
) -> tuple[dict[str, tuple[str, str]], str]:
    """Return the column and unit of every quantity, and the method of evapotranspiration."""
    named = {
        name: column for name, (column, *_) in described.columns.items()
        if name not in (TIME, *PLACE)
    }
    for column in table.header if not described.columns else ():
        name = split_unit(column)[0]
        name = SYNONYMS.get(name, name)
        if quantity_of(name) in QUANTITIES:
            if name in named:
                raise table.refuse(f"an earlier column already contains {name}", column)
            named[name] = column
    columns, method = dict[str, tuple[str, str]](), ""
    for name, column in named.items():
        table.place(column)
        quantity = quantity_of(name)
        unit = described.units.get(name, described.units.get(quantity, split_unit(column)[1]))
        try:
            find_unit(quantity, unit, 1.0, 1.0)
        except ValueError:
            raise table.refuse(unknown_unit(quantity), column) from None
        if quantity in columns:
            raise table.refuse(f"an earlier column already contains {quantity}", column)
        columns[quantity] = column, unit
        if quantity == EVAPOTRANSPIRATION:
            method = name.removesuffix(EVAPOTRANSPIRATION).strip() or "unnamed"
    return columns, method


def split_unit(column: str) -> tuple[str, str]:
    """Return the name and the unit of a column such as ``rain [mm]`` or ``Temp (°C)``."""
    for begin, end in ("[]", "()"):
        name, mark, unit = column.rpartition(begin)
        if mark and unit.endswith(end):
            return name.strip(), unit[:-1].strip()
    return column, ""


def _read_position(table: Table, described: Description) -> dict[str, float]:
    """Return the position in the columns of the first row, if the file has such columns."""
    return {
        name: table.read_number(table.first, described.columns[name][0], Range(-end, end))
        for name, end in _PLACES.items()
        if name in described.columns and table.cell(table.first, described.columns[name][0])
    }


# --- values ---------------------------------------------------------------------------------------


class _Cells:
    """The numbers in a column, in the unit of the file, which are read row by row."""

    def __init__(
        self, table: Table, column: str, quantity: str, described: Description
    ) -> None:
        """Prepare the column."""
        self._table, self._column = table, column
        self._place = table.place(column)
        self._missing = {"", *described.na_values}
        self._missing_numbers = _numbers_of(described.na_values)
        self._zero = {*described.zero_values} if quantity == PRECIPITATION else set[str]()
        self._comma = described.decimal == ","
        flag = described.flags.get(quantity)
        self._flag = None if flag is None else table.place(flag)
        self._flags = {*described.flag_values}
        self.numbers = array("d")

    def add(self, row: Row) -> None:
        """Read the cell in a row.

        Raises:
            ConfigurationError: if the cell is neither a number nor declared to be missing.
        """
        text = row.cells[self._place]
        if text in self._missing or (
            self._flag is not None and row.cells[self._flag] in self._flags
        ):
            self.numbers.append(math.nan)
            return
        if text in self._zero:
            self.numbers.append(0.0)
            return
        try:
            number = read_number(self._with_point(text))
            if not math.isfinite(number):
                raise ValueError
        except ValueError:
            mark = "comma" if self._comma else "point"
            raise self._table.refuse(
                f"must be a number with a decimal {mark}, or empty; if it denotes a missing value, "
                "name it in na_values", self._column, row,
            ) from None
        self.numbers.append(math.nan if number in self._missing_numbers else number)

    def _with_point(self, text: str) -> str:
        if not self._comma:
            return text
        if "." in text:
            raise ValueError
        return text.replace(",", ".")


def _convert(
    table: Table, column: str, unit_name: str, name: str, numbers: Values, lines: Sequence[int],
    step_h: float, area: float,
) -> Values:
    """Return values in the unit of :data:`.quantities.QUANTITIES`.

    Raises:
        ConfigurationError: if a value is outside the physical range of its quantity.
    """
    quantity, unit = QUANTITIES[name], find_unit(name, unit_name, step_h, area)
    values = (numbers - unit.zero) / unit.per_ours
    wrong = np.flatnonzero((values < quantity.low) | (values > quantity.high))
    if wrong.size:
        low, high = (
            float(f"{end * unit.per_ours + unit.zero:.4g}") for end in (quantity.low, quantity.high)
        )
        raise table.refuse_at(
            f"{Range(low, high, unit.name).expected()}; is the unit of the column right? "
            "A code for a missing value must be named in na_values",
            lines[wrong[0]], column, float(numbers[wrong[0]]),
        )
    return np.asarray(values)


def _numbers_of(texts: Iterable[str]) -> set[float]:
    numbers = set[float]()
    for text in texts:
        with suppress(ValueError):
            numbers.add(read_number(text))
    return numbers


# --- times ----------------------------------------------------------------------------------------


def _read_times(
    table: Table, site: Place, described: Description, cells: Sequence[_Cells]
) -> Times:
    """Read all rows, and return their times."""
    columns = described.columns.get(TIME, (TIME,))
    places = [table.place(column) for column in columns]

    def rows() -> Iterator[tuple[int, str]]:
        for row in table.rows:
            yield row.line, text_of(row)
            for cell in cells:
                cell.add(row)

    def text_of(row: Row) -> str:
        return " ".join(row.cells[place] for place in places)

    second = next(table.rows_after_first, None)
    if second is not None:
        table.rows = itertools.chain([table.first, second], table.rows_after_first)
        with suppress(ValueError, TypeError):  # such times are refused below
            form = described.time_format
            if parse_text(text_of(second), form) < parse_text(text_of(table.first), form):
                table.rows = reversed([*table.rows])  # the newest row is the first
    return find_times(table, site, described, rows())


def find_times(
    table: Table, site: Place, described: Description, times: Iterable[tuple[int, str | datetime]]
) -> Times:
    """Return the times of rows, from their lines and their texts or times.

    In the hour that occurs twice when daylight saving time ends, a time that is not later than the
    previous one belongs to the second occurrence.

    Raises:
        ConfigurationError: if a time cannot be read, is not later than the previous one, has no
            offset although nothing states the zone, or is in an hour that is skipped when daylight
            saving time begins.
    """
    zone = _find_zone(site, described)
    key = described.columns.get(TIME, (TIME,))[0]
    seconds, lines = array("d"), array("l")
    offset, before = 0.0, -math.inf
    for line, given in times:
        text = str(given)
        try:
            time = parse_text(text, described.time_format) if isinstance(given, str) else given
        except ValueError:
            raise table.refuse_at(
                f"must be a time such as {described.time_format or DEFAULT_START}", line, key, text
            ) from None
        if time.tzinfo is None:
            if zone is None:
                raise table.refuse_at(
                    f"must include a UTC offset, as in {DEFAULT_START}, unless the site file, a "
                    "description or a comment states time_zone or utc_offset", line, key, text,
                )
            time = time.replace(tzinfo=zone)
            if is_skipped(time):
                raise table.refuse_at(
                    f"is in an hour that the clocks in {zone} skip; if this clock is not changed "
                    "in summer, state utc_offset in place of time_zone", line, key, text,
                )
            if time.timestamp() <= before:
                time = time.replace(fold=1)
        now = time.timestamp()
        if now <= before:
            raise table.refuse_at(
                "must be later than the time of the previous row; if this clock is changed in "
                "summer, state time_zone, such as Europe/Berlin", line, key, text,
            )
        if not lines:
            offset = (time.utcoffset() or timedelta()).total_seconds()
        seconds.append(now)
        lines.append(line)
        before = now
    return Times(np.array(seconds), lines, offset)


def _find_zone(site: Place, described: Description) -> tzinfo | None:
    """Return the time zone of times without an offset; None if nothing states it."""
    if described.time_zone == STANDARD:
        if site.utc_offset is None:
            raise ConfigurationError(
                f"files of {described.name} contain local standard time: the site file must state "
                "its offset from UTC, such as -5.0", key="utc_offset",
            )
        return timezone(timedelta(hours=site.utc_offset))
    if described.time_zone:
        return ZoneInfo(described.time_zone)
    if described.utc_offset is not None:
        return timezone(timedelta(hours=described.utc_offset))
    return None if site.time_zone is None and site.utc_offset is None else site.zone


def parse_text(text: str, form: str) -> datetime:
    """Return the time in a text; 24:00 is the end of the day.

    Raises:
        ValueError: if the text does not have the form.
    """
    if not form:
        return parse_time(text)
    if form.endswith("%p") and text[-1:] in "ap":
        text += "m"
    date, mark, rest = text.partition(" 24")
    if mark and not rest.lstrip(":0"):
        return datetime.strptime(f"{date} 00{rest}", form) + timedelta(days=1)  # noqa: DTZ007
    return datetime.strptime(text, form)  # noqa: DTZ007


def _find_step(table: Table, times: Times) -> float:
    """Return the interval between the first ten rows (s); a single row covers an hour.

    Raises:
        ConfigurationError: if the intervals disagree.
    """
    if len(times.seconds) < 2:
        return _HOUR_S
    spacing = np.diff(times.seconds[:_FIRST_ROWS])
    middle = float(np.median(spacing))
    minutes = 60.0 * round(middle / 60)
    step_s = minutes if abs(minutes - middle) <= _CLOCK * middle else float(max(1, round(middle)))
    wrong = np.flatnonzero(np.abs(spacing - step_s) > 2 * _OFF * step_s)
    if wrong.size:
        raise table.refuse_at(
            f"this row is {duration(float(spacing[wrong[0]]))} after the previous row, but the "
            f"first rows are {duration(step_s)} apart: state the interval in seconds, as in step: "
            f"{step_s:g}; rows that are missing may be left out", times.lines[int(wrong[0]) + 1],
            "step",
        )
    return step_s


def _number_steps(table: Table, times: Times, step_s: float) -> tuple[float, NDArray[np.int64]]:
    """Return the start of step 0 (s since 1970 on the file's clock), and the step of every row.

    Steps that divide an hour or a day begin at multiples of the interval since midnight. Other
    steps begin at the first row, and so do all steps if the first row is too far from a multiple.

    Raises:
        ConfigurationError: if a row is too far from the beginning of a step, or in the same step as
            the previous row.
    """
    local = times.seconds + times.offset
    begin = step_s * math.floor(local[0] / step_s + 0.5)
    if abs(local[0] - begin) > _OFF * step_s or (_HOUR_S % step_s and 24 * _HOUR_S % step_s):
        whole = 60.0 if step_s >= 60 else 1.0
        begin = whole * round(local[0] / whole)
    steps = np.floor((local - begin) / step_s + 0.5).astype(np.int64)
    off = np.abs(local - begin - steps * step_s) > _OFF * step_s
    off[1:] |= np.diff(steps) == 0
    if off.any():
        row = int(np.argmax(off))
        raise table.refuse_at(
            f"this row is {duration(float(local[row] - local[max(0, row - 1)]))} after the "
            f"previous row, but rows must be {duration(step_s)} or a multiple apart: where the "
            "interval changes, split the file", times.lines[row], TIME,
        )
    return begin, steps


def _move_to_next(values: Values, steps: NDArray[np.int64]) -> Values:
    """Return values at the starts of steps from values at the ends; NaN without a previous row."""
    moved = np.full(len(values), math.nan)
    follows = np.flatnonzero(np.diff(steps) == 1)
    moved[follows + 1] = values[follows]
    return moved
