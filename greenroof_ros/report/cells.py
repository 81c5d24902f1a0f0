"""What the tables of the report's page are made of."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NamedTuple


class Cell(NamedTuple):
    """A cell of a table: what is shown, and what the table is sorted by."""

    text: str
    key: float | str
    warning: bool = False


NONE = Cell("none", -1.0)
"""of a quantity that a run has not: a storm's, or the mains'"""


class Table(NamedTuple):
    """A table that a reader can sort; the first column names the row.

    Without a header each row is a quantity of the only run.
    """

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    folded: bool = False
    """whether another one says in short what it says"""


def number(value: float, digits: str = ".4g", warning: bool = False) -> Cell:
    """Return the cell of a number."""
    text = f"{value:{digits}}"
    return Cell("0" if float(text.rstrip("%")) == 0 else text, value, warning)


def word(text: str) -> Cell:
    """Return the cell of a text."""
    return Cell(text, text)


def share(value: float | None) -> Cell:
    """Return a cell of a ratio; the unknown ones come last."""
    return Cell("unknown", sys.float_info.max) if value is None else number(value, ".4f")
