"""Weather files of this project's own form."""

from __future__ import annotations

import csv
import math
import re
from datetime import datetime
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import FIRST_YEAR, LAST_YEAR, parse_time
from greenroof_ros.weather.records import (
    EVAPOTRANSPIRATION,
    FOR_EVAPOTRANSPIRATION,
    HOUR,
    PRECIPITATION,
    QUANTITIES,
    Records,
)


def _read_header(path: Path, line: int, header: list[str]) -> tuple[dict[str, int], str]:
    """Return the column of each quantity and the method of evapotranspiration."""

    def refuse(expected: str, value: object = None) -> ConfigurationError:
        return ConfigurationError(expected, file=path, line=line, value=value)

    columns: dict[str, int] = {}
    method = ""
    if header[0].strip() != "time":
        raise refuse("the first column must be 'time'", header[0])
    for index, cell in enumerate(header[1:], start=1):
        match = re.fullmatch(r"\s*([^\[\]]+?)\s*\[([^\[\]]*)\]\s*", cell)
        if not match:
            raise refuse("a column must be named like 'precipitation [mm/h]'", cell)
        name, unit = match.groups()
        quantity = EVAPOTRANSPIRATION if name.endswith(EVAPOTRANSPIRATION) else name
        if quantity not in QUANTITIES:
            known = ", ".join(f"{key} [{value[0]}]" for key, value in QUANTITIES.items())
            raise refuse(f"is not a known column; they are {known}", cell)
        if unit != QUANTITIES[quantity][0]:
            raise refuse(f"the unit of {name} must be [{QUANTITIES[quantity][0]}]", cell)
        if quantity in columns:
            raise refuse(f"there is a column of {quantity} before this one", cell)
        columns[quantity] = index
        if quantity == EVAPOTRANSPIRATION:
            method = name.removesuffix(EVAPOTRANSPIRATION).strip() or "unnamed"
    if PRECIPITATION not in columns:
        raise refuse(f"there must be a column '{PRECIPITATION} [{QUANTITIES[PRECIPITATION][0]}]'")
    lacking = [name for name in FOR_EVAPOTRANSPIRATION if name not in columns]
    if EVAPOTRANSPIRATION not in columns and lacking:
        raise refuse(
            f"there must be a column '{EVAPOTRANSPIRATION} [{QUANTITIES[EVAPOTRANSPIRATION][0]}]', "
            f"or {', '.join(lacking)} to compute it of"
        )
    return columns, method


def numbered_lines(text: str) -> list[tuple[int, str]]:
    """Return the lines that say something, with their numbers: neither empty nor a comment."""
    return [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def cells_of(path: Path, line: int, text: str) -> list[str]:
    """Split a line of CSV; a quoted cell ends in its line."""
    try:
        return next(csv.reader([text], strict=True))
    except csv.Error as error:
        raise ConfigurationError(f"is not valid CSV: {error}", file=path, line=line) from error


def parse(path: Path, text: str) -> Records:
    """Parse a weather file of this project's form; nothing may be missing in it.

    Lines that start with ``#`` are comments. The first other line names the columns with their
    units: ``time``, ``precipitation [mm/h]``, and others of
    :data:`greenroof_ros.weather.records.QUANTITIES`, of which ``... evapotranspiration [mm/day]``
    names its method in its first words. Each further line is the hour that starts at its ``time``
    (ISO 8601 with the offset from UTC), hour after hour.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    numbered = numbered_lines(text)
    rows = [cells_of(path, line, text) for line, text in numbered]
    if not rows:
        raise ConfigurationError("holds comments only; a header and records must follow", file=path)
    columns, method = _read_header(path, numbered[0][0], rows[0])
    first: datetime | None = None
    values: dict[str, list[float]] = {quantity: [] for quantity in columns}
    for (line, _), row in zip(numbered[1:], rows[1:], strict=True):
        if len(row) != len(rows[0]):
            raise ConfigurationError(
                f"must have {len(rows[0])} cells as the header has, not {len(row)}",
                file=path, line=line,
            )
        try:
            time = parse_time(row[0])
        except ValueError:
            raise ConfigurationError(
                f"must be a time such as 2021-07-07T02:00-05:00, {FIRST_YEAR} to {LAST_YEAR}",
                file=path, line=line, key="time", value=row[0],
            ) from None
        if time.utcoffset() is None:
            raise ConfigurationError(
                "must say its offset from UTC, as in 2021-07-07T02:00-05:00",
                file=path, line=line, key="time", value=row[0],
            )
        if first is None:
            first = time
        due = first + len(values[PRECIPITATION]) * HOUR
        if time != due:
            expected = due.astimezone(time.tzinfo).isoformat(timespec="minutes")
            raise ConfigurationError(
                f"must be {expected}: the records must be hour after hour, "
                "without gap or repetition",
                file=path, line=line, key="time", value=row[0],
            )
        for quantity, column in columns.items():
            unit, least, largest = QUANTITIES[quantity]
            try:
                value = float(row[column])
            except ValueError:
                value = math.nan
            if not least <= value <= largest:
                raise ConfigurationError(
                    f"must be a number from {least:g} to {largest:g} {unit}",
                    file=path, line=line, key=rows[0][column].strip(), value=row[column],
                )
            values[quantity].append(value)
    if first is None:
        raise ConfigurationError("has a header but no records", file=path)
    return Records(path, first, {key: np.array(value) for key, value in values.items()}, method)
