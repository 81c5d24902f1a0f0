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
from collections import Counter, deque
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.ranges import Range, read_number
from greenroof_ros.base.times import DEFAULT_START, duration, is_skipped, parse_time
from greenroof_ros.site.site import Place, Site
from greenroof_ros.weather.description import (
    END,
    PLACE,
    STANDARD,
    TIME,
    Description,
    find_service,
    quantity_of,
    read_comments,
    service_descriptions,
    usual_name,
)
from greenroof_ros.weather.quantities import (
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    QUANTITIES,
    find_unit,
    known_units,
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
    """line number in the file, or number of the row in a data frame, from 0"""
    cells: Sequence[Any]
    """texts; those of a data frame are numbers and times"""


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
        """Prepare the table."""
        self.file, self.header, self.line, self.rows = file, header, line, rows
        counts = Counter(header)
        self._places = {name: place for place, name in enumerate(header) if counts[name] == 1}

    def place(self, column: str) -> int:
        """Return the position of a column, from its name or its number.

        Raises:
            ConfigurationError: if the header does not contain the column exactly once.
        """
        if column in self._places:
            return self._places[column]
        if column in self.header:
            what = "occurs more than once"
        elif column.isdecimal() and int(column) < len(self.header):
            return int(column)
        else:
            what = suggest_names(column, self.header)
        raise self.refuse(f"must be the name of one column of the file; {what}", column)

    def cell(self, row: Row, column: str) -> str:
        """Return the text of a cell."""
        return str(row.cells[self.place(column)])

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
        csv.Error: if a quote is not closed, or is followed by text.
    """
    plain = '"' not in text  # the module csv takes longer
    cells = text.split(separator) if plain else next(
        csv.reader([text.strip()], delimiter=separator, strict=True)
    )
    return [cell.strip() for cell in cells]


def read_table(
    file: Path, lines: Iterable[tuple[int, str]] | None = None, separator: str = ",",
    with_values: Container[str] = (),
) -> Table:
    """Read CSV as a table; blank lines, and lines that begin with ``#``, are left out.

    Args:
        file: file to read.
        lines: numbered lines, beginning with the header; by default, those of the file.
        separator: separator between cells.
        with_values: names of columns. A row that ends before the first of them has no values.

    Raises:
        ConfigurationError: if the file cannot be read, or the header or all rows are missing. A row
            that has more or fewer cells than the header is rejected when it is read.
    """

    def parse() -> Iterator[Row]:
        for number, text in lines or enumerate(read_lines(file), start=1):
            if text.strip() and not text.lstrip().startswith("#"):
                try:
                    yield Row(number, split(text, separator))
                except csv.Error as error:
                    raise ConfigurationError(
                        f"is not a line of CSV: {error}", file=file, line=number
                    ) from None

    def fit(row: Row) -> Row:
        """Return a row with as many cells as the header."""
        cells = [*row.cells[:count]] if not any(row.cells[count:]) else row.cells
        if len(cells) < count and len(cells) <= first:
            cells = [*cells, *[""] * (count - len(cells))]
        if len(cells) != count:
            raise ConfigurationError(
                f"must have {count} cells, like the header, but has {len(cells)}", file=file,
                line=row.line,
            )
        return Row(row.line, cells)

    rows = parse()
    head, second = next(rows, None), next(rows, None)
    if head is None or not any(head.cells):
        raise ConfigurationError("must contain a header and rows", file=file)
    if second is None:
        raise ConfigurationError("has a header but no rows", file=file)
    header = [" ".join(name.split()) for name in head.cells]
    while header and not header[-1]:  # separators at the end of each line
        header.pop()
    count = len(header)
    first = next((place for place, name in enumerate(header) if name in with_values), 0)
    return Table(file, header, head.line, map(fit, itertools.chain([second], rows)))


@dataclass(frozen=True)
class Rows:
    """The rows of a file of measurements at regular intervals.

    Attributes:
        table: table of the file, for messages; its rows have been read.
        described: what the file means, with the statements in its comments and columns.
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
    return arrange(*_open(file, described), site, wanted)


def arrange(table: Table, described: Description, site: Place, wanted: Collection[str]) -> Rows:
    """Read the rows of a table, and return them in steps; see :func:`read_rows`.

    Raises:
        ConfigurationError: if the rows are not at regular intervals, or a cell does not contain a
            number in the physical range of its quantity.
    """
    columns, method = _find_columns(table, described)
    readers = {
        name: _number_reader(table, described, name, column)
        for name, (column, _) in columns.items() if name in wanted
    }
    clock = [table.place(column) for column in described.columns.get(TIME, (TIME,))]
    lines, times, numbers = array("l"), list[str | datetime](), [array("d") for _ in readers]
    for row in table.rows:
        if not lines:
            described = _read_position(table, row, described)
        lines.append(row.line)
        first, *more = (row.cells[place] for place in clock)
        times.append(" ".join([first, *more]) if more else first)
        for series, read in zip(numbers, readers.values(), strict=True):
            series.append(read(row))
    if _is_newest_first(times, described.time_format):
        lines.reverse()
        times.reverse()
        for series in numbers:
            series.reverse()
    seconds, offset_s = _find_times(table, site, described, lines, times)
    step_s = described.step or _find_step(table, seconds, lines)
    begin, steps = _number_steps(table, seconds + offset_s, lines, step_s)
    values = {
        name: _convert(table, *columns[name], name, np.array(series), lines, step_s / 3600, site)
        for name, series in zip(readers, numbers, strict=True)
    }
    if described.rows == END:
        begin -= step_s
        for level in values.keys() & {*_LEVELS}:
            values[level] = _move_to_next(values[level], steps)
    used = {
        TIME, *(column for column, _ in columns.values()), *described.flags.values(),
        *itertools.chain(*described.columns.values()),
    }
    return Rows(
        table, described, columns, method,
        datetime.fromtimestamp(begin - offset_s, timezone(timedelta(seconds=offset_s))), step_s,
        steps, values, tuple(name for name in table.header if name not in used),
    )


# --- the form of a file ---------------------------------------------------------------------------


def _open(file: Path, described: Description | None) -> tuple[Table, Description]:
    """Return the table of a file, and its description with the statements in its comments."""
    given = described or Description()
    lines = enumerate(read_lines(file, given.encoding), start=1)
    if given.columns:
        skipped = {*given.skiprows}
        kept = (line for line in lines if line[0] - 1 not in skipped)
        return _read_as(file, _without_last(kept, given.skipfooter), given), given
    head = [(0, "")]
    for number, text in lines:
        if text.strip():
            head.append((number, text))
            if not text.lstrip().startswith("#"):
                break
    for place, (number, text) in enumerate(head[-2:], len(head) - 2):  # it can be a comment
        service = find_service(text)
        if service is not None:
            header = number, text.replace("#", " ", 1)
            later = itertools.chain([header], head[place + 1 :], lines)
            return _read_as(file, later, service), service
    made = read_comments(file, head[:-1], given)
    table = _read_as(file, itertools.chain(head[-1:], lines), made)
    if table.header[0] != TIME:
        known = sorted({described.name for described in service_descriptions()})
        raise table.refuse(
            f"must be '{TIME}', or the header must be that of a service ({', '.join(known)}); for "
            "any other file, write a description: greenroof weather FILE --describe",
            table.header[0],
        )
    return table, made


def _without_last(lines: Iterable[tuple[int, str]], count: int) -> Iterator[tuple[int, str]]:
    waiting = deque[tuple[int, str]]()
    for line in lines:
        waiting.append(line)
        if len(waiting) > count:
            yield waiting.popleft()


def _read_as(file: Path, lines: Iterable[tuple[int, str]], described: Description) -> Table:
    return read_table(file, lines, described.separator, {
        column for name in described.columns.keys() & QUANTITIES.keys()
        for column in described.columns[name]
    })


def _find_columns(
    table: Table, described: Description
) -> tuple[dict[str, tuple[str, str]], str]:
    """Return the column and unit of every quantity, and the method of evapotranspiration."""
    named = [
        (name, column) for name, (column, *_) in described.columns.items()
        if name not in (TIME, *PLACE)
    ]
    if not described.columns:
        named = [(usual_name(split_unit(column)[0]), column) for column in table.header]
        named = [pair for pair in named if quantity_of(pair[0]) in QUANTITIES]
    columns, method = dict[str, tuple[str, str]](), ""
    for name, column in named:
        quantity = quantity_of(name)
        if quantity in columns:
            raise table.refuse(f"an earlier column already contains {quantity}", column)
        table.place(column)
        unit = described.units.get(name, described.units.get(quantity, split_unit(column)[1]))
        try:
            find_unit(quantity, unit, 1.0, 1.0)
        except ValueError:
            raise table.refuse(
                f"the unit of {quantity} must be one of {', '.join(known_units(quantity))}", column
            ) from None
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


def _read_position(table: Table, row: Row, described: Description) -> Description:
    """Return a description with the position in a row, if the file has such columns."""
    position: dict[str, Any] = {
        name: table.read_number(row, described.columns[name][0], Range(-end, end))
        for name, end in _PLACES.items()
        if name in described.columns and table.cell(row, described.columns[name][0])
    }
    return replace(described, **position)


# --- values ---------------------------------------------------------------------------------------


def _number_reader(
    table: Table, described: Description, quantity: str, column: str
) -> Callable[[Row], float]:
    """Return a function that reads the number in a column, in the unit of the file."""
    place, comma = table.place(column), described.decimal == ","
    marks = str.maketrans(",.", ".?") if comma else {}
    flag = table.place(described.flags[quantity]) if quantity in described.flags else None
    zeros = described.zero_values if quantity == PRECIPITATION else ()
    meanings = dict.fromkeys(("", *described.na_values), math.nan) | dict.fromkeys(zeros, 0.0)
    codes = dict[float, float]()  # by number, as in -99.0
    for text, meaning in meanings.items():
        with suppress(ValueError):
            codes[read_number(text)] = meaning

    def read(row: Row) -> float:
        cell = row.cells[place]
        if flag is not None and row.cells[flag] in described.flag_values:
            return math.nan
        if cell in meanings:
            return meanings[cell]
        try:
            if isinstance(cell, str):
                number = read_number(cell.translate(marks))
            else:
                number = math.nan if cell is None else float(cell)
            if math.isinf(number) or (isinstance(cell, str) and math.isnan(number)):
                raise ValueError
        except (TypeError, ValueError):
            raise table.refuse(
                f"must be a number with a decimal {'comma' if comma else 'point'}, or empty; if it "
                "denotes a missing value, name it in na_values", column, row,
            ) from None
        return codes.get(number, number)

    return read


def _convert(
    table: Table, column: str, unit_name: str, name: str, numbers: Values, lines: Sequence[int],
    step_h: float, site: Place,
) -> Values:
    """Return values in the unit of :data:`.quantities.QUANTITIES`.

    Raises:
        ConfigurationError: if a value is outside the physical range of its quantity.
    """
    area = site.a2 if isinstance(site, Site) else math.nan
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


# --- times ----------------------------------------------------------------------------------------


def _is_newest_first(times: Sequence[str | datetime], form: str) -> bool:
    """Return whether the first row is later than the last; times that cannot be read are not."""
    try:
        return parse_text(times[-1], form) < parse_text(times[0], form)
    except (ValueError, TypeError):
        return False


def _find_times(
    table: Table, site: Place, described: Description, lines: Sequence[int],
    times: Sequence[str | datetime],
) -> tuple[Values, float]:
    """Return the times of rows (s since 1970), and the UTC offset of the first (s).

    In the hour that occurs twice when daylight saving time ends, a time that is not later than the
    previous one belongs to the second occurrence.

    Raises:
        ConfigurationError: if a time cannot be read, is not later than the previous one, has no
            offset although nothing states the zone, or is in an hour that is skipped when daylight
            saving time begins.
    """
    zone = _find_zone(site, described)
    key = described.columns.get(TIME, (TIME,))[0]
    seconds, offset, before = array("d"), timedelta(), -math.inf
    for line, given in zip(lines, times, strict=True):
        try:
            time = _read_time(given, described.time_format, zone, before)
        except ValueError as error:
            raise table.refuse_at(str(error), line, key, str(given)) from None
        if not seconds:
            offset = time.utcoffset() or timedelta()
        before = time.timestamp()
        seconds.append(before)
    return np.array(seconds), offset.total_seconds()


def _read_time(given: str | datetime, form: str, zone: tzinfo | None, before: float) -> datetime:
    """Return the time in a cell, with an offset; the row before it has another (s since 1970).

    Raises:
        ValueError: if the time is invalid; the message states what would be right.
    """
    try:
        time = parse_text(given, form)
    except (TypeError, ValueError):
        raise ValueError(f"must be a time such as {form or DEFAULT_START}") from None
    if time.tzinfo is None:
        if zone is None:
            raise ValueError(
                f"must include a UTC offset, as in {DEFAULT_START}, unless the site file, a "
                "description or a comment states time_zone or utc_offset"
            )
        time = time.replace(tzinfo=zone)
        if is_skipped(time):
            raise ValueError(
                f"is in an hour that the clocks in {zone} skip; if this clock is not changed in "
                "summer, state utc_offset in place of time_zone"
            )
        if time.timestamp() <= before:
            time = time.replace(fold=1)
    if time.timestamp() <= before:
        raise ValueError(
            "must be later than the time of the previous row; if this clock is changed in summer, "
            "state time_zone, such as Europe/Berlin"
        )
    return time


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


def parse_text(text: str | datetime, form: str) -> datetime:
    """Return the time in a text; 24:00 is the end of the day.

    Raises:
        ValueError: if the text does not have the form.
    """
    if isinstance(text, datetime):
        return text
    if not form:
        return parse_time(text)
    if form.endswith("%p") and text[-1:] in "ap":
        text += "m"
    date, mark, rest = text.partition(" 24")
    if mark and not rest.lstrip(":0"):
        return datetime.strptime(f"{date} 00{rest}", form) + timedelta(days=1)  # noqa: DTZ007
    return datetime.strptime(text, form)  # noqa: DTZ007


def _find_step(table: Table, seconds: Values, lines: Sequence[int]) -> float:
    """Return the interval between the first ten rows (s); a single row covers an hour.

    Raises:
        ConfigurationError: if the intervals disagree.
    """
    if len(seconds) < 2:
        return _HOUR_S
    spacing = np.diff(seconds[:_FIRST_ROWS])
    middle = float(np.median(spacing))
    minutes = 60.0 * round(middle / 60)
    step_s = minutes if abs(minutes - middle) <= _CLOCK * middle else float(max(1, round(middle)))
    wrong = np.flatnonzero(np.abs(spacing - step_s) > 2 * _OFF * step_s)
    if wrong.size:
        raise table.refuse_at(
            f"this row is {duration(float(spacing[wrong[0]]))} after the previous row, but the "
            f"first rows are {duration(step_s)} apart: state the interval in seconds, as in step: "
            f"{step_s:g}; rows that are missing may be left out", lines[int(wrong[0]) + 1], "step",
        )
    return step_s


def _number_steps(
    table: Table, local: Values, lines: Sequence[int], step_s: float
) -> tuple[float, NDArray[np.int64]]:
    """Return the start of step 0 (s since 1970 on the file's clock), and the step of every row.

    Steps that divide an hour or a day begin at multiples of the interval since midnight. Other
    steps begin at the first row, and so do all steps if the first row is too far from a multiple.

    Raises:
        ConfigurationError: if a row is too far from the beginning of a step, or in the same step as
            the previous row.
    """
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
            "interval changes, split the file", lines[row], TIME,
        )
    return begin, steps


def _move_to_next(values: Values, steps: NDArray[np.int64]) -> Values:
    """Return values at the starts of steps from values at the ends; NaN without a previous row."""
    moved = np.full(len(values), math.nan)
    follows = np.flatnonzero(np.diff(steps) == 1)
    moved[follows + 1] = values[follows]
    return moved
