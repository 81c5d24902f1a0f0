"""Tables of text cells in CSV, and the measurements in them, with the line and column of an error.

The csv module of the standard library reads the text line by line. Polars and pandas are not used,
because a node does not need them otherwise, and because they do not provide the line number of a
cell.
"""

from __future__ import annotations

import csv
import itertools
import math
import re
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
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
from greenroof_ros.base.parameter import parameters_of
from greenroof_ros.base.ranges import Range, read_number
from greenroof_ros.base.times import DEFAULT_START, duration, is_skipped, parse_time
from greenroof_ros.site.site import Place, Site
from greenroof_ros.weather import description, quantities
from greenroof_ros.weather.description import END, PLACE, SEPARATORS, STANDARD, TIME, Description
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES

Values = NDArray[np.float64]
_Refuse = Callable[[int, str], ConfigurationError]
_HOUR_S, _DAY_S = 3600.0, 86_400.0
# The share of a step by which a time may be off, and the share by which a step of whole minutes may
# be off because of the logger's clock.
_OFF, _CLOCK = 0.25, 0.02
# No rain of one day to a year has been more than 3,000 mm times this power of the days: the records
# are 1,825 mm in a day, 4,936 mm in four, 9,300 mm in a month and 26,470 mm in a year (WMO).
_RECORD, _POWER = 3000.0, 0.37
# A running total that begins again after more than this share of it was a fall by little.
_LITTLE = 0.95
_OWN = Description()


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
        rows: the rows; a list if they have no lines.
        described: description with the encoding and the separator of the file.
    """

    def __init__(
        self, file: Path, header: Sequence[str], line: int | None, rows: Iterable[Row],
        described: Description = _OWN,
    ) -> None:
        """Prepare the table."""
        self.file, self.header, self.line, self.rows = file, header, line, rows
        self.described = described
        counts = Counter(header)
        self._places = {str(place): place for place in range(len(header))} | {
            name: place for place, name in enumerate(header) if counts[name] == 1
        }

    def place(self, column: str) -> int:
        """Return the position of a column, from its name or its number.

        Raises:
            ConfigurationError: if the header does not contain the column exactly once.
        """
        place = self._places.get(column)
        if place is None:
            many = column in self.header
            what = "occurs more than once" if many else suggest_names(column, self.header)
            raise self.refuse(f"must be the name of one column of the file; {what}", column)
        return place

    def cell(self, row: Row, column: str) -> str:
        """Return the text of a cell."""
        return str(row.cells[self.place(column)])

    def find_row(self, number: int) -> Row:
        """Return a row again, by its line or number, for a message."""
        if self.line is None:
            return [*self.rows][number]
        lines = read_lines(self.file, self.described.encoding)
        text = next(itertools.islice(lines, number - 1, None))
        return Row(number, split(text, SEPARATORS[self.described.sep]) or [])

    def refuse(
        self, expected: str, column: str | None = None, row: Row | None = None, value: object = None
    ) -> ConfigurationError:
        """Return an error about the header, or about a value in a row, by default that of its cell.

        The rows of a data frame have numbers in place of lines.
        """
        if column is None or row is None:
            return ConfigurationError(expected, file=self.file, line=self.line, value=column)
        place: dict[str, Any] = {"file": self.file, "line": row.line}
        if self.line is None:
            place = {"file": f"{self.file}, row {row.line}"}
        value = self.cell(row, column) if value is None else value
        return ConfigurationError(expected, key=column, value=value, **place)

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
        try:
            return limits.parse(self.cell(row, column))
        except ValueError as error:
            raise self.refuse(str(error), column, row) from None

    def read_time(self, row: Row, column: str) -> datetime:
        """Return the time in a cell, which must include its UTC offset.

        Raises:
            ConfigurationError: if the cell does not contain such a time.
        """
        with suppress(ValueError):
            time = parse_time(self.cell(row, column))
            if time.tzinfo is not None:
                return time
        raise self.refuse(
            f"must be a time with a UTC offset, such as {DEFAULT_START}", column, row
        )


def split(text: str, separator: str) -> list[str] | None:
    """Return the cells of a line; None if a quote is not closed in it, or is followed by text."""
    if '"' not in text:  # the module csv takes longer
        return [cell.strip() for cell in text.split(None if separator == " " else separator)]
    with suppress(csv.Error):
        (cells,) = csv.reader(
            [text.strip()], delimiter=separator, strict=True, skipinitialspace=True
        )
        return [cell.strip() for cell in cells]
    return None


def read_table(
    file: Path, lines: Iterable[tuple[int, str]] | None = None, described: Description = _OWN
) -> Table:
    """Read CSV as a table; blank lines, and lines that begin with ``#``, are left out.

    Args:
        file: file to read.
        lines: numbered lines, beginning with the header; by default, those of the file.
        described: description with the separator, and with the columns of values. A row that ends
            before the first of them has no values.

    Raises:
        ConfigurationError: if the file cannot be read, or the header or all rows are missing. A row
            that has more or fewer cells than the header is rejected when it is read.
    """

    def refuse(expected: str, line: int | None = None) -> ConfigurationError:
        return ConfigurationError(expected, file=file, line=line)

    def parse() -> Iterator[Row]:
        for number, text in lines or enumerate(read_lines(file), start=1):
            if not is_comment(text):
                cells = split(text, SEPARATORS[described.sep])
                if cells is None:
                    raise refuse("is not a line of CSV: a quoted cell must end in it", number)
                yield Row(number, cells)

    def fit(row: Row) -> Row:
        """Return a row with as many cells as the header."""
        cells = row.cells
        if len(cells) <= first:
            cells = [*cells, *[""] * (count - len(cells))]
        if len(cells) < count or any(cells[count:]):
            expected = f"must have {count} cells, like the header, but has {len(cells)}"
            raise refuse(expected, row.line)
        return Row(row.line, cells[:count])

    rows = parse()
    head, second = next(rows, None), next(rows, None)
    if head is None or not any(head.cells):
        raise refuse("must contain a header and rows")
    if second is None:
        raise refuse("has a header but no rows")
    header = [" ".join(name.split()) for name in head.cells]
    while not header[-1]:  # separators at the end of each line
        header.pop()
    count = len(header)
    values = {columns[0] for name, columns in described.columns.items() if name in QUANTITIES}
    first = next((place for place, name in enumerate(header) if name in values), 0)
    return Table(file, header, head.line, map(fit, itertools.chain([second], rows)), described)


def is_comment(text: str) -> bool:
    """Return whether a line is blank, or begins with ``#``."""
    return text.lstrip()[:1] in ("", "#")


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

    @property
    def begins(self) -> Values:
        """Starts of the rows (s since 1970)."""
        return np.asarray(self.first.timestamp() + self.step_s * self.steps)


def read_rows(
    file: Path, site: Place, wanted: Collection[str], described: Description | None = None
) -> Rows:
    """Read a file of measurements.

    Without a description, the file is in this project's own form or in that of a service; see
    :mod:`.description`. A row covers the interval that begins (or, with ``rows: end``, ends) at its
    time, which may be off by a quarter of the interval. An amount is the total in a row's interval;
    litres and m3 refer to the whole roof of area ``a2``.

    Args:
        file: file to read.
        site: place with its clock; the site, if litres and m3 may occur.
        wanted: quantities to read; columns of other quantities are ignored.
        described: description of the file.

    Raises:
        ConfigurationError: if the file does not conform to its description; the message names the
            line, the column and the value.
    """
    return arrange(*_open(file, described or _OWN), site, wanted)


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
    clock, form = described.columns.get(TIME, (TIME,)), described.time_format
    places = [table.place(column) for column in clock]
    lines, times, numbers = array("l"), list[datetime](), [array("d") for _ in readers]
    for row in table.rows:
        if not lines:
            described = _read_position(table, row, described)
        lines.append(row.line)
        text = " ".join(str(row.cells[place]) for place in places)
        try:
            times.append(parse_text(text, form))
        except ValueError:
            expected = f"must be a time such as {form or DEFAULT_START}"
            raise table.refuse(expected, clock[0], row, text) from None
        for series, read in zip(numbers, readers.values(), strict=True):
            series.append(read(row))
    with suppress(TypeError):  # only some of the times have an offset
        if times[-1] < times[0]:  # the newest row is the first
            lines, times, numbers = lines[::-1], times[::-1], [each[::-1] for each in numbers]

    def refuse(place: int, expected: str) -> ConfigurationError:
        """Return an error about the time of a row, as the file has it."""
        row = table.find_row(lines[place])
        return table.refuse(expected, clock[0], row, " ".join(str(row.cells[n]) for n in places))

    zone = _find_zone(site, described)
    seconds = _find_seconds(times, zone, refuse)
    first = datetime.fromtimestamp(seconds[0], times[0].tzinfo or zone)
    offset = first.utcoffset() or timedelta()
    begin, step_s, steps = _number_steps(seconds + offset.total_seconds(), described.step, refuse)
    values, area = dict[str, Values](), site.a2 if isinstance(site, Site) else math.nan
    for name, amounts in zip(readers, map(np.array, numbers), strict=True):
        column, unit_name = columns[name]
        unit = quantities.find_unit(name, unit_name, step_s / _HOUR_S, area)
        if unit_name.startswith(quantities.COUNTER):
            amounts = _take_differences(table, column, amounts, steps, lines)
        elif name == PRECIPITATION:
            depths = amounts / unit.per_ours * step_s / _HOUR_S
            _refuse_total(table, column, depths, (steps * step_s // _DAY_S).astype(np.int64))
        values[name] = _convert(table, name, column, unit, amounts, lines)
    if described.rows == END:
        begin -= step_s
    used = {*places, *map(table.place, itertools.chain(
        (column for column, _ in columns.values()), described.flags.values(),
        *described.columns.values(),
    ))}
    return Rows(
        table, described, columns, method,
        datetime.fromtimestamp(begin, timezone.utc).replace(tzinfo=timezone(offset)), step_s, steps,
        values, tuple(name for place, name in enumerate(table.header) if place not in used),
    )


# --- the form of a file ---------------------------------------------------------------------------


def _open(file: Path, given: Description) -> tuple[Table, Description]:
    """Return the table of a file, and its description with the statements in its comments."""
    skipped, numbered = {*given.skiprows}, enumerate(read_lines(file, given.encoding), start=1)
    lines = (line for line in numbered if line[0] - 1 not in skipped)
    if given.skipfooter:
        rows, ahead = itertools.tee(lines)  # one is ahead of the other by the foot of the file
        ahead = itertools.islice(ahead, given.skipfooter, None)
        lines = (row for row, _ in zip(rows, ahead, strict=False))
    if given.columns:
        return read_table(file, lines, given), given
    head = list[tuple[int, str]]()
    for number, text in lines:
        service = description.find_service(text)
        if service is not None:  # its header can be a comment
            description.read_comments(file, head, given).check_unused(service.name, file)
            header = number, text.replace("#", " ", 1)
            return read_table(file, itertools.chain([header], lines), service), service
        if text.lstrip()[:1] in ("{", "["):
            raise ConfigurationError(
                "contains JSON: the name of an answer of Open-Meteo must end in .json", file=file
            )
        head.append((number, text))
        if not is_comment(text):
            break
    made = description.read_comments(file, head, given)
    table = read_table(file, itertools.chain(head, lines), made)
    if table.header[0] != TIME:
        raise table.refuse(
            f"must be '{TIME}', or the header must be that of a service; for any other file, write "
            "a description: greenroof weather FILE --describe", table.header[0],
        )
    return table, made


def _find_columns(table: Table, described: Description) -> tuple[dict[str, tuple[str, str]], str]:
    """Return the column and unit of every quantity, and the method of evapotranspiration."""
    named = [(name, column) for name, (column, *_) in described.columns.items()] or [
        (description.usual_name(split_unit(column)[0]), column) for column in table.header
    ]
    columns, method = dict[str, tuple[str, str]](), ""
    for name, column in named:
        quantity = description.quantity_of(name)
        if quantity not in QUANTITIES:  # the time, a coordinate, or a column that is not used
            continue
        if quantity in columns:
            raise table.refuse(f"an earlier column already contains {quantity}", column)
        table.place(column)
        unit = described.units.get(name, described.units.get(quantity, split_unit(column)[1]))
        try:
            quantities.find_unit(quantity, unit, 1.0, 1.0)
        except ValueError as error:
            raise table.refuse(str(error), column) from None
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
        key.name: table.read_number(row, column, key.range)
        for key in parameters_of(Description) if key.name in PLACE
        for column in described.columns.get(key.name, ()) if table.cell(row, column)
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
    meanings: dict[Any, float] = dict.fromkeys(("", *described.na_values), math.nan)
    meanings |= dict.fromkeys(zeros, 0.0)
    for text in [*meanings]:
        with suppress(ValueError):  # a code counts by its number, as in -99.0
            meanings[read_number(text)] = meanings[text]
    meanings[None] = math.nan  # in a data frame

    def read(row: Row) -> float:
        cell = row.cells[place]
        if flag is not None and row.cells[flag] in described.flag_values:
            return math.nan
        try:
            if cell in meanings or cell != cell:  # NaN in a data frame
                return meanings.get(cell, math.nan)
            number = read_number(cell.translate(marks)) if isinstance(cell, str) else float(cell)
            if not math.isfinite(number) or isinstance(cell, bool | np.bool_):
                raise ValueError
        except (TypeError, ValueError):
            expected = f"must be a number with a decimal {'comma' if comma else 'point'}, or empty"
            if table.line is not None:
                expected += "; if it denotes a missing value, name it in na_values"
            raise table.refuse(expected, column, row) from None
        return meanings.get(number, number)

    return read


def _take_differences(
    table: Table, column: str, totals: Values, steps: NDArray[np.int64], lines: Sequence[int]
) -> Values:
    """Return the amounts of rows from a running total.

    After a fall, the total is the amount since it began again at 0. The amount of the first row, or
    of one after a missing row, is unknown (NaN).

    Raises:
        ConfigurationError: if the total falls by little, as the level of a weighing gauge does.
    """
    before = np.append(math.nan, totals[:-1])
    falls = totals < before
    for row in np.flatnonzero(falls & (totals > _LITTLE * before)).tolist():
        expected = "must not fall by little: a counter falls only to begin again at 0"
        raise table.refuse(expected, column, table.find_row(lines[row]))
    amounts = np.where(falls, totals, totals - before)
    amounts[1:][np.diff(steps) > 1] = math.nan
    # Tenths do not subtract exactly in binary numbers.
    return np.asarray(np.round(amounts, 9))


def _refuse_total(table: Table, column: str, depths: Values, days: NDArray[np.int64]) -> None:
    """Reject a running total as rain: it seldom falls, and its sum is impossible.

    Args:
        table: table of the file.
        column: column of the rain.
        depths: rain in the rows (mm).
        days: day of every row, from 0.
    """
    sums, changes = np.bincount(days, np.nan_to_num(depths)), np.diff(depths)
    most = max(sums.max(), sums.sum() / len(sums) ** _POWER)
    # A single row can be a code of a missing value.
    seldom_falls = 2 * np.count_nonzero(changes < 0) <= np.count_nonzero(changes > 0)
    if seldom_falls and most - np.nanmax(depths, initial=0.0) > _RECORD:
        raise table.refuse(
            f"looks like a running total (as rain, {sums.sum():.0f} mm in {len(sums)} days): state "
            f"its unit in the header or in units, as in '{quantities.COUNTER}mm'", column,
        )


def _convert(
    table: Table, name: str, column: str, unit: quantities.Unit, numbers: Values,
    lines: Sequence[int],
) -> Values:
    """Return values in the unit of :data:`.quantities.QUANTITIES`.

    Raises:
        ConfigurationError: if a value is outside the physical range of its quantity.
    """
    ends = QUANTITIES[name].low, QUANTITIES[name].high
    values = (numbers - unit.zero) / unit.per_ours
    wrong = np.flatnonzero((values < ends[0]) | (values > ends[1]))
    if wrong.size:
        low, high = (float(f"{end * unit.per_ours + unit.zero:.4g}") for end in ends)
        raise table.refuse(
            f"{Range(low, high, unit.name).expected()}; is the unit of the column right? "
            "A code for a missing value must be named in na_values", column,
            table.find_row(lines[wrong[0]]),
        )
    return np.asarray(values)


# --- times ----------------------------------------------------------------------------------------


def _find_seconds(times: Sequence[datetime], zone: tzinfo | None, refuse: _Refuse) -> Values:
    """Return the times of rows (s since 1970).

    In the hour that occurs twice when daylight saving time ends, a time that is not later than the
    previous one belongs to the second occurrence.

    Raises:
        ConfigurationError: if a time is not later than the previous one, has no offset although
            nothing states the zone or other times have one, or is in an hour that is skipped when
            daylight saving time begins.
    """
    seconds, before, is_local = array("d"), -math.inf, times[0].tzinfo is None
    if is_local and zone is None:
        raise refuse(
            0, f"must include a UTC offset, as in {DEFAULT_START}, unless the site file, a "
            "description or a comment states time_zone or utc_offset"
        )
    for place, given in enumerate(times):
        if (given.tzinfo is None) != is_local:
            raise refuse(place, "must have a UTC offset either in all rows of the file or in none")
        time = given.replace(tzinfo=zone) if is_local else given
        if is_skipped(time):
            raise refuse(
                place, f"is in an hour that the clocks in {zone} skip; if this clock is not "
                "changed in summer, state utc_offset in place of time_zone"
            )
        if time.timestamp() <= before:
            time = time.replace(fold=1)
        if time.timestamp() <= before:
            advice = "; if this clock is changed in summer, state time_zone, such as Europe/Berlin"
            expected = f"must be later than the time of the previous row; {description.TIPS}"
            raise refuse(place, expected + advice * is_local)
        before = time.timestamp()
        seconds.append(before)
    return np.array(seconds)


def _find_zone(site: Place, described: Description) -> tzinfo | None:
    """Return the time zone of times without an offset; None if nothing states it."""
    is_standard = described.time_zone == STANDARD
    if described.time_zone and not is_standard:
        return ZoneInfo(described.time_zone)
    if is_standard and site.utc_offset is None:
        raise ConfigurationError(
            f"files of {described.name} contain local standard time: the site file must state its "
            "offset from UTC, such as -5.0", key="utc_offset",
        )
    offset = site.utc_offset if is_standard else described.utc_offset
    if offset is not None:
        return timezone(timedelta(hours=offset))
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
    with suppress(ValueError):
        return datetime.strptime(text, form)  # noqa: DTZ007
    for hour in re.finditer("24", text):  # no time has the hour 24, nor 00 in place of another 24
        with suppress(ValueError):
            changed = f"{text[: hour.start()]}00{text[hour.end() :]}"
            day = datetime.strptime(changed, form)  # noqa: DTZ007
            if day.hour == day.minute == day.second == 0:
                return day + timedelta(days=1)
    raise ValueError


def _number_steps(
    local: Values, stated: float | None, refuse: _Refuse
) -> tuple[float, float, NDArray[np.int64]]:
    """Return the start of step 0 (s since 1970 on the file's clock), the step (s), and every row's.

    Without a statement, the step is the median interval, in whole minutes if the rows disagree by
    some seconds; a single row covers an hour. Steps that divide an hour or a day begin at multiples
    of the interval since midnight. Other steps begin at the first row, and so do all steps if the
    first row is too far from a multiple.

    Raises:
        ConfigurationError: if a row is too far from the beginning of a step, or in the same step as
            the previous row; or if less than half of the intervals are a step that is not stated.
    """
    apart = np.diff(local)
    middle = float(np.median(apart)) if apart.size else _HOUR_S
    irregular = (abs(apart - middle) > _OFF * middle).sum() > apart.size / 2
    step_s = stated or 60.0 * round(middle / 60)
    agreed = len(apart) > 1 and np.ptp(apart) == 0
    if stated is None and (agreed or abs(step_s - middle) > _CLOCK * middle):
        step_s = float(max(1, round(middle)))
    begin = step_s * math.floor(local[0] / step_s + 0.5)
    if abs(local[0] - begin) > _OFF * step_s or (_HOUR_S % step_s and 24 * _HOUR_S % step_s):
        whole = 1.0 if step_s % 60 else 60.0
        begin = whole * round(local[0] / whole)
    steps = np.floor((local - begin) / step_s + 0.5).astype(np.int64)
    wrong = np.abs(local - begin - steps * step_s) > _OFF * step_s
    wrong[1:] |= np.diff(steps) == 0
    wrong[1:] |= irregular and stated is None
    if wrong.any():
        row = int(np.argmax(wrong))
        raise refuse(
            row, f"this row is {duration(float(local[row] - local[max(0, row - 1)]))} after the "
            f"previous row, but rows must be {duration(step_s)} or a multiple apart; "
            + (description.TIPS if irregular else "where the interval changes, split the file")
        )
    return begin, step_s, steps
