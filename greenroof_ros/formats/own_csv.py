"""Weather files of this project's own form."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import (
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    QUANTITIES,
    Records,
)
from greenroof_ros.weather.table import Row, Table, numbered_lines, read_hours

BYTE_ORDER_MARK = False


def recognises(_text: str, /) -> bool:
    """Any text: this format is the last to be asked, and its errors say what would be right."""
    return True


def parse(file: Path, text: str, _site: Site, /) -> Records:
    """Parse a weather file of this project's form; an empty cell is a missing value.

    Lines that start with ``#`` are comments. The first other line names the columns with their
    units: ``time``, ``precipitation [mm/h]``, and others of
    :data:`greenroof_ros.weather.records.QUANTITIES`, of which ``... evapotranspiration [mm/day]``
    names its method in its first words. Each further line is the hour that starts at its ``time``
    (ISO 8601 with the offset from UTC), hour after hour.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    table = Table(file, numbered_lines(text))
    columns, method = _columns(table)
    first, values = read_hours(
        table.rows(), "time", lambda row: row.time("time"),
        {
            quantity: partial(Row.value, column=column, quantity=quantity, missing=("",))
            for quantity, column in columns.items()
        },
    )
    return Records((file,), first, values, method)


def _columns(table: Table) -> tuple[dict[str, str], str]:
    """Return the column of each quantity, and the method of evapotranspiration."""
    columns: dict[str, str] = {}
    method = ""
    if table.header[0] != "time":
        raise table.refuse("the first column must be 'time'", table.header[0])
    for column in table.header[1:]:
        match = re.fullmatch(r"([^\[\]]+?)\s*\[([^\[\]]*)\]", column)
        if not match:
            raise table.refuse("a column must be named like 'precipitation [mm/h]'", column)
        name, unit = match.groups()
        quantity = EVAPOTRANSPIRATION if name.endswith(EVAPOTRANSPIRATION) else name
        if quantity not in QUANTITIES:
            known = ", ".join(f"{key} [{value[0]}]" for key, value in QUANTITIES.items())
            raise table.refuse(f"is not a known column; they are {known}", column)
        if unit != QUANTITIES[quantity][0]:
            raise table.refuse(f"the unit of {name} must be [{QUANTITIES[quantity][0]}]", column)
        if quantity in columns:
            raise table.refuse(f"there is a column of {quantity} before this one", column)
        columns[quantity] = column
        if quantity == EVAPOTRANSPIRATION:
            method = name.removesuffix(EVAPOTRANSPIRATION).strip() or "unnamed"
    if PRECIPITATION not in columns:
        raise table.refuse(
            f"there must be a column '{PRECIPITATION} [{QUANTITIES[PRECIPITATION][0]}]'"
        )
    return columns, method
