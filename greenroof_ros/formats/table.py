"""Hourly values in CSV: the lines, cells and checks that all formats share."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, tzinfo
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import (
    DEFAULT_START,
    FIRST_YEAR,
    LAST_YEAR,
    parse_local_time,
    parse_time,
    to_minutes,
)
from greenroof_ros.weather.records import HOUR, QUANTITIES


@dataclass(frozen=True)
class Unit:
    """A unit of a file, by the unit of :data:`QUANTITIES`: theirs = ours * per_ours + zero.

    Attributes:
        name: as the file writes it.
        per_ours: how many of it are one of ours; 10 for hPa, where ours is kPa.
        zero: what it has where ours has 0; 32 for degF.
    """

    name: str
    per_ours: float = 1.0
    zero: float = 0.0


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        file: that it is from.
        line: its number there, from 1.
        cells: by the name of their column, without space around them.
    """

    file: Path
    line: int
    cells: dict[str, str]

    def refuse(self, expected: str, column: str | None = None) -> ConfigurationError:
        """Return an error that names file and line, and of a column its value."""
        value = None if column is None else self.cells[column]
        return ConfigurationError(
            expected, file=self.file, line=self.line, key=column, value=value
        )

    def value(
        self, column: str, quantity: str, unit: Unit | None = None, missing: Container[str] = ()
    ) -> float:
        """Return a value of a quantity, in its unit of :data:`QUANTITIES`.

        Args:
            column: where it stands.
            quantity: one of :data:`QUANTITIES`, which has its believable range.
            unit: of the column; that of the quantity unless given.
            missing: texts that stand for a missing value, which is NaN.

        Raises:
            ConfigurationError: it is not a number, or not a believable one.
        """
        text = self.cells[column]
        if text in missing:
            return math.nan
        ours, low, high = QUANTITIES[quantity]
        unit = unit or Unit(ours)
        try:
            value = (float(text) - unit.zero) / unit.per_ours
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            ends = [f"{end * unit.per_ours + unit.zero:g}" for end in (low, high)]
            raise self.refuse(
                f"must be a number from {' to '.join(ends)} {unit.name}"
                + (", or empty" if "" in missing else ""),
                column,
            )
        return value

    def time(self, column: str) -> datetime:
        """Return an ISO 8601 time, which must say its offset from UTC."""
        try:
            time = parse_time(self.cells[column])
        except ValueError:
            raise self.refuse(
                f"must be a time such as {DEFAULT_START}, {FIRST_YEAR} to {LAST_YEAR}", column
            ) from None
        if time.utcoffset() is None:
            raise self.refuse(f"must say its offset from UTC, as in {DEFAULT_START}", column)
        return time

    def local_time(self, column: str, zone: tzinfo, example: str) -> datetime:
        """Return a time that says no offset, in a zone; ``example`` is for the message."""
        try:
            return parse_local_time(self.cells[column], zone)
        except ValueError:
            raise self.refuse(
                f"must be a time such as {example}, {FIRST_YEAR} to {LAST_YEAR}", column
            ) from None

    def check_due(
        self, column: str, time: datetime, due: datetime, what: str = "the records"
    ) -> None:
        """Refuse a time that is not the hour that must follow."""
        if time != due:
            raise self.refuse(
                f"must be {to_minutes(due.astimezone(time.tzinfo))}: {what} must be hour after "
                "hour, without gap or repetition",
                column,
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


class Table:
    """A header and rows with as many cells.

    Attributes:
        file: that it is from.
        line: number of the header's line.
        header: the names of the columns.
    """

    def __init__(self, file: Path, lines: Sequence[tuple[int, str]]) -> None:
        """Split the header.

        Args:
            file: that the lines are from.
            lines: as :func:`numbered_lines` returns them, the header first.

        Raises:
            ConfigurationError: there is no line, or the header is not CSV.
        """
        if not lines:
            raise ConfigurationError(
                "holds comments only; a header and records must follow", file=file
            )
        self.file = file
        self.line, header = lines[0]
        self.header = split_cells(file, self.line, header)
        self._lines = lines[1:]

    def refuse(self, expected: str, cell: str | None = None) -> ConfigurationError:
        """Return an error that names the header's line, and a cell of it."""
        return ConfigurationError(expected, file=self.file, line=self.line, value=cell)

    def require(self, columns: Iterable[str], whose: str) -> None:
        """Refuse a header that does not have each of some columns once."""
        for column in columns:
            if column not in self.header:
                raise self.refuse(f"must have a column '{column}', as {whose} have")
            if self.header.count(column) > 1:
                raise self.refuse("is the name of two columns", column)

    def rows(self, observed_from: int = 0) -> Iterator[Row]:
        """Return the rows, one after the other.

        Args:
            observed_from: index of the first column of values; a row that ends before it is of an
                hour that is missing: its further cells are empty. 0 where there are no such rows.

        Raises:
            ConfigurationError: there is none, or one has more or fewer cells than the header.
        """
        if not self._lines:
            raise ConfigurationError("has a header but no records", file=self.file)
        for line, text in self._lines:
            cells = split_cells(self.file, line, text)
            if len(cells) <= observed_from:
                cells += [""] * (len(self.header) - len(cells))
            if len(cells) != len(self.header):
                raise ConfigurationError(
                    f"must have {len(self.header)} cells as the header has, not {len(cells)}",
                    file=self.file, line=line,
                )
            yield Row(self.file, line, dict(zip(self.header, cells, strict=True)))


def read_hours(
    rows: Iterable[Row],
    column: str,
    time: Callable[[Row], datetime],
    values: dict[str, Callable[[Row], float]],
) -> tuple[datetime, dict[str, NDArray[np.float64]]]:
    """Read rows that are hour after hour.

    Args:
        rows: at least one.
        column: of the time, for messages.
        time: returns a row's time.
        values: for each quantity, what returns its value in a row.

    Returns:
        The first time, and the values of each quantity, shape (rows,).

    Raises:
        ConfigurationError: a time is not an hour after the one before; or what ``time`` and
            ``values`` raise.
    """
    first: datetime | None = None
    series: dict[str, list[float]] = {quantity: [] for quantity in values}
    for number, row in enumerate(rows):
        now = time(row)
        first = first or now
        row.check_due(column, now, first + number * HOUR)
        for quantity, value in values.items():
            series[quantity].append(value(row))
    assert first is not None
    return first, {quantity: np.array(numbers) for quantity, numbers in series.items()}
