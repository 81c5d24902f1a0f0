"""What all formats of text share, one case for each rule."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal

from greenroof_ros.base.ranges import Range, read_number
from greenroof_ros.base.times import DEFAULT_START, parse_time
from greenroof_ros.formats.cells import (
    CODE,
    NEAR,
    WRONG,
    Column,
    Table,
    judge_cell,
    number_lines,
    read_cell,
    read_table,
)
from greenroof_ros.weather.quantities import QUANTITIES, Unit

FILE = Path("hours.csv")
RAIN = "precipitation"
HEADER = "# A comment\n\ntime, rain [mm/h] ,temperature\n"
ROWS = ["2021-07-07T03:00-05:00, 0.2,20", "2021-07-07T04:00-05:00,3.0,21"]


def table(*rows: str, header: str = HEADER) -> Table:
    """Return a table with its first row in line 4."""
    return read_table(FILE, number_lines([header + "\n".join(rows) + "\n"]))


def values_of(read: Table, name: str, quantity: str, unit: Unit | None = None) -> np.ndarray:
    """Return the values of a column."""
    column = Column(read, name, quantity, unit)
    for row in read.rows:
        column.add(row)
    return column.judge()


def test_cells_numbers_and_times() -> None:
    """Comments and empty lines may be anywhere; cells are stripped of spaces.

    A row, also the first, may end before the values of its hour.
    """
    read = table(ROWS[0], "# gauge read", "", ROWS[1])
    assert read.header == ["time", "rain [mm/h]", "temperature"]
    rain = Column(read, "rain [mm/h]", RAIN)
    first, values = read.read_hours("time", {"rain": rain}, parse_time, DEFAULT_START)
    assert values["rain"].tolist() == [0.2, 3.0]
    assert first == datetime.fromisoformat("2021-07-07T03:00-05:00")
    lines = number_lines([f"{HEADER}2021-07-07T03:00-05:00\n# none\n{ROWS[1]}\n"])
    rows = [*read_table(FILE, lines, {"rain [mm/h]"}.__contains__).rows]
    assert [(row.line, row.cells[2]) for row in rows] == [(4, ""), (6, "21")]


def test_what_is_no_table() -> None:
    """The error has file and line."""
    for rows, reason in (
        ([ROWS[0], "2021-07-07T04:00-05:00,3.0"],
         ", line 5: must have 3 cells, as many as the header, but has 2"),
        ([ROWS[0], '2021-07-07T04:00-05:00,3.0,"1.2'],
         ", line 5: is not valid CSV: unexpected end of data"),
        ([], ": has a header but no records"),
    ):
        assert refusal(lambda rows: [*table(*rows).rows], rows) == f"{FILE}{reason}"
    assert refusal(read_table, FILE, []) == (
        f"{FILE}: contains only comments; a header and records must follow"
    )


@pytest.mark.parametrize("text", ["1_0", "1__0", "١٢", "0x10", "1,2,3", "1 000", "", "ten"])
def test_texts_that_are_no_numbers(text: str) -> None:
    """In files and in options alike; Python's float takes the first and the third for numbers."""
    with pytest.raises(ValueError):  # noqa: PT011 - any
        read_number(text)
    for whole in (False, True):
        with pytest.raises(ValueError, match="must be a"):
            Range(0, 500, whole=whole).parse(text)


@pytest.mark.parametrize(
    ("text", "value", "kind"),
    [
        ("500", 500.0, ""), ("NaN", np.nan, ""), ("#N/A", np.nan, ""), ("-0.5", 0.0, NEAR),
        ("500.4", 500.0, NEAR), ("-999", np.nan, CODE), ("7999", np.nan, CODE),
        ("9.96921e36", np.nan, CODE), ("inf", np.nan, CODE), ("ice", np.nan, CODE),
        ("-1", np.nan, CODE), ("501", np.nan, WRONG), ("1_0", np.nan, WRONG),
        ("5 h", np.nan, WRONG), ("99.9", 99.9, ""), ("327.67", 327.67, ""),
        ("#DIV/0!", np.nan, CODE), ("9.9", 9.9, ""), ("99", 99.0, ""),
    ],
)
def test_rules_of_cells(text: str, value: float, kind: str) -> None:
    """Of rain, from 0 to 500 mm/h, by half a millimetre more or less."""
    read, what = judge_cell(read_cell(text, QUANTITIES[RAIN], Unit("mm/h")))
    assert (what, read) == (kind, pytest.approx(value, nan_ok=True))


@pytest.mark.parametrize("text", ["M", "", "-0.1", "500.1", "nan", "1_0"])
def test_numbers_that_are_not_believed(text: str) -> None:
    """The error has file, line, column and value, and the range that would be right."""
    read = table(f"2021-07-07T04:00-05:00,{text},1")
    limits = Range(0.0, 500.0, "mm/h")
    assert refusal(read.read_number, read.first, "rain [mm/h]", limits) == (
        f"{FILE}, line 4: rain [mm/h] = {text!r}: must be a number from 0 to 500 mm/h"
    )


@pytest.mark.parametrize(
    "text", ["time;a;b\n2021;-0,2;1,5\n", 'time,a,b\n2021,"-0,2","1,5"\n',
             "time\ta\tb\n2021\t-,2\t1.5\n;;\n"],
)
def test_separators_and_decimal_commas(text: str) -> None:
    """Semicolons and tabs as well as commas; rows without text are left out."""
    (row,) = read_table(FILE, number_lines([text])).rows
    assert [read_number(cell) for cell in row.cells[1:]] == [-0.2, 1.5]


def test_missing_values_and_other_units() -> None:
    """A missing value is NaN; the range is given in the unit of the file."""
    rows = ["2021-07-07T03:00Z,1,68", "2021-07-07T04:00Z,,NaN", "2021-07-07T05:00Z,1,x2"]
    warmth, unit = "temperature", Unit("°F", 1.8, 32.0)
    assert values_of(table(*rows), "temperature", warmth, unit) == pytest.approx(
        [20.0, np.nan, np.nan], nan_ok=True
    )
    assert refusal(values_of, table(*rows[1:]), "temperature", warmth, unit) == (
        f"{FILE}, line 5: temperature = 'x2': must be a number from -130 to 140 °F, or empty; is "
        "the unit of the column right?"
    )


@pytest.mark.parametrize(
    ("time", "reason"),
    [
        ("2021-07-07T04:00", "must include a UTC offset, as in 2021-07-07T02:00-05:00"),
        ("07/07/2021 04:00", "must be a time such as 2021-07-07T02:00-05:00, 1971 to 2037"),
        ("2021-07-07T04:30-05:00", "must be 2021-07-07T04:00-05:00, or a whole number of hours"),
        # In the offset of the wrong record.
        ("2021-07-07T04:00-04:00", "must be 2021-07-07T05:00-04:00, or a whole number of hours"),
    ],
)
def test_times_that_are_wrong(time: str, reason: str) -> None:
    """The same error, with the hour that is due."""
    read = table(ROWS[0], f"{time},1,1")
    message = refusal(read.read_hours, "time", {}, parse_time, DEFAULT_START)
    assert message.startswith(f"{FILE}, line 5: time = {time!r}: {reason}")


def test_columns_that_must_be_there() -> None:
    """Each exactly once."""
    read = table(ROWS[0], header="time,a,a\n")
    assert refusal(read.require_columns, ["b"], "such files") == (
        f"{FILE}, line 1: must have a column 'b', like such files"
    )
    assert refusal(read.require_columns, ["a"], "such files") == (
        f"{FILE}, line 1: 'a': is the name of more than one column"
    )
