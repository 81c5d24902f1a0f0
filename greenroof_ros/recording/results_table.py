"""The table of a study, ``results.csv``: how the columns of controllers' parameters are named.

A parameter ``weight`` is in the column ``parameter:weight``: whatever a controller calls its
parameters, none is mistaken for another column.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

_PREFIX = "parameter:"

Cell = TypeVar("Cell")


def parameter_columns(parameters: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the columns of parameters, by the parameters' names."""
    return {f"{_PREFIX}{name}": value for name, value in parameters.items()}


def row_parameters(row: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the parameters in a row of the table, by their names."""
    return {
        column.removeprefix(_PREFIX): value
        for column, value in row.items() if column.startswith(_PREFIX)
    }
