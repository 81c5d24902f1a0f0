"""Values in columns of CSV: the lines, cells and checks that all formats share."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import (
    DEFAULT_START,
    FIRST_YEAR,
    LAST_YEAR,
    parse_time,
    to_minutes,
)
from greenroof_ros.formats.records import HOUR, Limits


@dataclass(frozen=True)
class Unit:
    """A unit of a file, by the unit of ours: theirs = ours * per_ours + zero.

    Attributes:
        name: as the file writes it.
        per_ours: how many of it are one of ours; 10 for hPa, where ours is kPa.
        zero: what it has where ours has 0; 32 for degF.
    """

    name: str
    per_ours: float = 1.0
    zero: float = 0.0


class Table:
    """A header and columns of cells, without space around them.

    Attributes:
        file: that it is from.
        header: the names of the columns.
        lines: number of each row's line; empty where there are none, as in JSON.
    """

    def __init__(
        self, file: Path, header: list[str], read: Callable[[], list[list[str]]],
        line: int | None = None, lines: Sequence[int] = (), key: str = "",
    ) -> None:
        """Take the header; the rows are read when a column is asked for.

        Args:
            file: that it is from.
            header: the names of the columns.
            read: returns the cells of each column.
            line: number of the header's line; None where there are no lines, as in JSON.
            lines: of each row.
            key: under which the columns are in JSON, such as ``hourly.``
        """
        self.file, self.header = file, header
        self.lines, self._read, self._line, self._key = lines, read, line, key

    @cached_property
    def columns(self) -> dict[str, list[str]]:
        """The cells of each column, by its name."""
        return dict(zip(self.header, self._read(), strict=True))

    def refuse(
        self, expected: str, column: str | None = None, row: int | None = None
    ) -> ConfigurationError:
        """Return an error that names the place and text of a cell, or of the header's cell."""
        if column is None or row is None:
            return ConfigurationError(expected, file=self.file, line=self._line, value=column)
        key = f"{self._key}{column.partition(' ')[0]}[{row}]" if self._key else column
        return ConfigurationError(
            expected, file=self.file, line=self.lines[row] if self.lines else None, key=key,
            value=self.columns[column][row],
        )

    def require(self, columns: Iterable[str], whose: str) -> None:
        """Refuse a header that does not have each of some columns once."""
        for column in columns:
            if column not in self.header:
                raise self.refuse(f"must have a column '{column}', as {whose} have")
            if self.header.count(column) > 1:
                raise self.refuse("is the name of two columns", column)

    def quantities(self, example: str) -> Iterator[tuple[str, str, str]]:
        """Yield each column after the first, which is ``time``, with its quantity and unit.

        Args:
            example: of a column's name, for messages.

        Raises:
            ConfigurationError: the first column is another, or one is not named like the example.
        """
        if self.header[0] != "time":
            raise self.refuse("the first column must be 'time'", self.header[0])
        for column in self.header[1:]:
            match = re.fullmatch(r"([^\[\]]+?)\s*\[([^\[\]]*)\]", column)
            if match is None:
                raise self.refuse(f"a column must be named like '{example}'", column)
            yield column, match[1], match[2]

    def numbers(
        self, column: str, limits: Limits, unit: Unit | None = None, missing: Container[str] = (),
        hint: str = "",
    ) -> NDArray[np.float64]:
        """Return a column's values in our unit, shape (rows,).

        Args:
            column: its name.
            limits: our unit, and the believable range.
            unit: of the column; ours unless given.
            missing: texts that stand for a missing value, which is NaN.
            hint: what ends the message about a wrong value.

        Raises:
            ConfigurationError: a cell is not a number, or not a believable one.
        """
        ours, low, high = limits
        unit = unit or Unit(ours)
        values = np.full(len(self.columns[column]), np.nan)
        for row, text in enumerate(self.columns[column]):
            if text in missing:
                continue
            try:
                value = (float(text) - unit.zero) / unit.per_ours
            except ValueError:
                value = math.nan
            if not low <= value <= high:
                ends = [f"{end * unit.per_ours + unit.zero:g}" for end in (low, high)]
                raise self.refuse(
                    f"must be a number from {' to '.join(ends)} {unit.name}"
                    + (", or empty" if "" in missing else "") + hint,
                    column, row,
                )
            values[row] = value
        return values

    def times(
        self, column: str, parse: Callable[[str], datetime] = parse_time,
        example: str = DEFAULT_START, hint: str = "",
    ) -> list[datetime]:
        """Return a column's times.

        Args:
            column: its name.
            parse: raises ValueError where a text is no time; ISO 8601 with an offset from UTC
                unless given.
            example: of a time, for messages.
            hint: what ends the message about a missing offset.

        Raises:
            ConfigurationError: a cell is no time, or says no offset from UTC.
        """
        times = []
        for row, text in enumerate(self.columns[column]):
            try:
                time = parse(text)
            except ValueError:
                raise self.refuse(
                    f"must be a time such as {example}, {FIRST_YEAR} to {LAST_YEAR}", column, row
                ) from None
            if time.utcoffset() is None:
                raise self.refuse(
                    f"must say its offset from UTC, as in {DEFAULT_START}{hint}", column, row
                )
            times.append(time)
        return times

    def first_hour(
        self, column: str, parse: Callable[[str], datetime] = parse_time,
        example: str = DEFAULT_START,
    ) -> datetime:
        """Return the first of a column's times; each must be an hour after the other.

        Raises:
            ConfigurationError: one is not; or as :meth:`times` says.
        """
        first, *later = self.times(column, parse, example)
        for row, time in enumerate(later, start=1):
            self.check_due(column, row, time, first + row * HOUR)
        return first

    def check_due(
        self, column: str, row: int, time: datetime, due: datetime, what: str = "the records"
    ) -> None:
        """Refuse a time that is not the hour that must follow."""
        if time != due:
            raise self.refuse(
                f"must be {to_minutes(due.astimezone(time.tzinfo))}: {what} must be hour after "
                "hour, without gap or repetition",
                column, row,
            )


def numbered_lines(text: str) -> list[tuple[int, str]]:
    """Return the lines that are neither empty nor a comment (``#``), with their numbers from 1."""
    return [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def split_cells(file: Path, line: int, text: str) -> list[str]:
    """Split a line of CSV into cells without space around them; a quoted cell ends in its line.

    Raises:
        ConfigurationError: a quote is left open, or something follows a closed one.
    """
    try:
        return [cell.strip() for cell in next(csv.reader([text], strict=True))]
    except csv.Error as error:
        raise ConfigurationError(f"is not valid CSV: {error}", file=file, line=line) from error


def read_table(
    file: Path, lines: Sequence[tuple[int, str]], observed: Container[str] = ()
) -> Table:
    """Return lines of CSV as a table.

    Args:
        file: that the lines are from.
        lines: as :func:`numbered_lines` returns them, the header first.
        observed: columns of values; a row that ends before the first of them is of an hour that is
            missing: its further cells are empty.

    Raises:
        ConfigurationError: there is no header; and when a column is asked for: there is no row, or
            one has more or fewer cells than the header.
    """
    if not lines:
        raise ConfigurationError("holds comments only; a header and records must follow", file=file)
    (header_line, text), *rest = lines
    header = split_cells(file, header_line, text)
    first = next((index for index, name in enumerate(header) if name in observed), 0)

    def read() -> list[list[str]]:
        if not rest:
            raise ConfigurationError("has a header but no records", file=file)
        rows = []
        for line, text in rest:
            cells = split_cells(file, line, text)
            if len(cells) <= first:
                cells += [""] * (len(header) - len(cells))
            if len(cells) != len(header):
                raise ConfigurationError(
                    f"must have {len(header)} cells as the header has, not {len(cells)}",
                    file=file, line=line,
                )
            rows.append(cells)
        return [list(column) for column in zip(*rows, strict=True)]

    return Table(file, header, read, header_line, [line for line, _ in rest])
