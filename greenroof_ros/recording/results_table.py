"""The table of a study, ``results.csv``: its columns of parameters, and what tells runs apart.

A parameter ``weight`` is in the column ``parameter:weight``: whatever a controller calls its
parameters, none is mistaken for another column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

_PREFIX = "parameter:"

Cell = TypeVar("Cell")


def parameter_columns(parameters: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the columns of parameters, by the parameters' names."""
    return {f"{_PREFIX}{name}": value for name, value in parameters.items()}


def differing(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the keys that tell rows apart, in their order: those with more than one value.

    What differs between the runs of a set of results names them, in every table and title, and
    nothing else need. A key that a row lacks has the value None there.
    """
    keys = dict.fromkeys(key for row in rows for key in row)
    return [key for key in keys if len({row.get(key) for row in rows}) > 1]


def shortest(value: float) -> str:
    """Write a number in as few digits as leave it that number: 12, 0.5, 0.3333333333333333."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)


def row_parameters(row: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the parameters in a row of the table, by their names."""
    return {
        column.removeprefix(_PREFIX): value
        for column, value in row.items() if column.startswith(_PREFIX)
    }
