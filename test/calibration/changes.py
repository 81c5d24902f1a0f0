"""Changes to the rows of a twin's record, to break it in one way or another."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timezone
from functools import cache
from pathlib import Path

import numpy as np
from twins import TWIN, record_rows

from greenroof_ros.calibration.record import Record

DAY = 288
Rows = list[list[str]]
Change = Callable[[Rows], Rows]
# Columns of a twin's record.
TIME, RAIN, RUNOFF, LEVEL, LEAST = range(5)


@cache
def twin(days: int, seed: int) -> Rows:
    """The rows of a twin without gaps, made when the first test needs them."""
    return record_rows(TWIN, days, seed, gaps=False)


def a_record(
    rain: np.ndarray, step_s: float = 300.0, month: int = 5, **series: np.ndarray | None
) -> Record:
    """A record from the beginning of a month on; of what is not given there is nothing."""
    nothing = np.zeros(len(rain))
    given = {"reference": nothing, "pumped": nothing, "runoff": None, "level": None} | series
    start = datetime(2021, month, 1, tzinfo=timezone.utc)
    return Record(Path("roof.csv"), start, step_s, rain, **given)


def same(rows: Rows) -> Rows:
    """No change."""
    return rows


def change(column: int, how: Callable[[int, str], str]) -> Change:
    """Change a column of the record, by its row's number from 0 and its text."""
    def changed(rows: Rows) -> Rows:
        result = [list(row) for row in rows]
        for number, row in enumerate(result[1:]):
            if row[column]:
                row[column] = how(number, row[column])
        return result
    return changed


def scaled(column: int, factor: float) -> Change:
    return change(column, lambda _, text: repr(float(text) * factor))


def from_row(first: int, column: int, text: str, end: int = 10**9) -> Change:
    """The same text in some rows, from one on."""
    return change(column, lambda row, was: text if first <= row < end else was)


def shifted(column: int, steps: int) -> Change:
    """Shift a column in time, round its ends."""
    def changed(rows: Rows) -> Rows:
        cells = [row[column] for row in rows[1:]]
        cells = cells[-steps:] + cells[:-steps]
        return [rows[0]] + [
            [*row[:column], cell, *row[column + 1:]]
            for row, cell in zip(rows[1:], cells, strict=True)
        ]
    return changed


def without(*columns: int) -> Change:
    return lambda rows: [[cell for place, cell in enumerate(row) if place not in columns]
                         for row in rows]


def cell(row: int, column: int, text: str) -> Change:
    """One cell; row 0 is the header."""
    def changed(rows: Rows) -> Rows:
        result = [list(one) for one in rows]
        result[row][column] = text
        return result
    return changed


def both(*changes: Change) -> Change:
    def changed(rows: Rows) -> Rows:
        for one in changes:
            rows = one(rows)
        return rows
    return changed
