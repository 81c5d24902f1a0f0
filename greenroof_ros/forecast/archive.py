"""Files of archived forecasts: issue after issue, hour after hour."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.common.times import parse_time
from greenroof_ros.model.look_ahead import MOST_MEMBERS
from greenroof_ros.weather.own_csv import cells_of, numbered_lines
from greenroof_ros.weather.records import (
    EVAPOTRANSPIRATION,
    HOUR,
    PRECIPITATION,
    QUANTITIES,
)


def _minutes(time: datetime) -> str:
    return time.isoformat(timespec="minutes")


@dataclass(frozen=True)
class _Issue:
    """A forecast of a file.

    Attributes:
        issued: when; its first hour starts then.
        line: of the file, its first.
        rain: mm/h, shape (members, hours).
        evapotranspiration: mm/day, shape (hours,); None where the file has none.
    """

    issued: datetime
    line: int
    rain: NDArray[np.float64]
    evapotranspiration: NDArray[np.float64] | None

    @property
    def hours(self) -> int:
        """How many it has."""
        return len(self.rain[0])


@dataclass
class _Draft:
    """An issue while it is read: the rows of numbers of each of its members."""

    issued: datetime
    line: int
    members: dict[int, list[list[float]]] = field(default_factory=dict)


_UNITS = {quantity: f"{quantity} [{QUANTITIES[quantity][0]}]" for quantity in QUANTITIES}


def read_forecasts(path: Path) -> list[_Issue]:
    """Read a file of forecasts, one issue after the other.

    Lines that start with ``#`` are comments. The first other line is the header: ``issued``,
    ``time``, then ``member`` if there is more than one forecast per issue, ``precipitation
    [mm/h]``, and ``evapotranspiration [mm/day]`` if the file has it (member 0's counts). Each
    further line is the hour that starts at its ``time``, as forecast at ``issued`` (ISO 8601 with
    the offset from UTC): of each issue and member hour after hour, the first that which starts with
    the issue. All issues have the members 0, 1, 2 and so on, and all members of an issue the same
    hours.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    lines = numbered_lines(read_text(path))
    if not lines:
        raise ConfigurationError("holds comments only; a header and records must follow", file=path)
    header = _header(path, *lines[0])
    drafts: list[_Draft] = []
    for line, text in lines[1:]:
        _add(path, line, dict(zip(header, _cells(path, line, text, len(header)), strict=True)),
             drafts)
    if not drafts:
        raise ConfigurationError("has a header but no records", file=path)
    has_evapotranspiration = _UNITS[EVAPOTRANSPIRATION] in header
    return [
        _finish(path, draft, len(drafts[0].members), has_evapotranspiration) for draft in drafts
    ]


def _cells(path: Path, line: int, text: str, count: int) -> list[str]:
    """Split a line of CSV, which must have a number of cells; 0 stands for any."""
    cells = [cell.strip() for cell in cells_of(path, line, text)]
    if count and len(cells) != count:
        raise ConfigurationError(
            f"must have {count} cells as the header has, not {len(cells)}", file=path, line=line
        )
    return cells


def _header(path: Path, line: int, text: str) -> list[str]:
    """Return the names of the columns."""
    cells = _cells(path, line, text, 0)
    expected = ["issued", "time", "member", _UNITS[PRECIPITATION], _UNITS[EVAPOTRANSPIRATION]]
    if "member" not in cells:
        expected.remove("member")
    if len(cells) < len(expected):
        del expected[-1]
    for cell, due in itertools.zip_longest(cells, expected):
        if due is None:
            raise ConfigurationError(
                f"is one column too many; they are {', '.join(expected)}",
                file=path, line=line, value=cell,
            )
        if cell != due:
            raise ConfigurationError(
                f"the column must be '{due}'; they are {', '.join(expected)}",
                file=path, line=line, value=cell or "",
            )
    return cells


def _add(path: Path, line: int, row: dict[str, str], drafts: list[_Draft]) -> None:
    """Add a line to its issue, the last of the drafts or a new one."""
    issued, time = _time(path, line, row, "issued"), _time(path, line, row, "time")
    if not drafts or issued > drafts[-1].issued:
        drafts.append(_Draft(issued, line))
    draft = drafts[-1]
    if issued < draft.issued:
        raise ConfigurationError(
            f"must not be before {_minutes(draft.issued)}, as above: the issues must be in the "
            "order of time",
            file=path, line=line, key="issued", value=row["issued"],
        )
    rows = draft.members.setdefault(_member(path, line, row), [])
    due = issued + len(rows) * HOUR
    if time != due:
        raise ConfigurationError(
            f"must be {_minutes(due.astimezone(time.tzinfo))}: each forecast must be hour after "
            "hour from its issue on, without gap or repetition",
            file=path, line=line, key="time", value=row["time"],
        )
    rows.append([
        _number(path, line, row, quantity)
        for quantity in (PRECIPITATION, EVAPOTRANSPIRATION) if _UNITS[quantity] in row
    ])


def _time(path: Path, line: int, row: dict[str, str], key: str) -> datetime:
    """Return a time with its offset from UTC."""
    try:
        time = parse_time(row[key])
    except ValueError:
        time = None
    if time is None or time.utcoffset() is None:
        raise ConfigurationError(
            "must be a time with its offset from UTC, such as 2021-07-07T02:00-05:00, "
            "1971 to 2037",
            file=path, line=line, key=key, value=row[key],
        )
    return time


def _member(path: Path, line: int, row: dict[str, str]) -> int:
    """Return a line's member, 0 where the file has but one."""
    text = row.get("member", "0")
    most = MOST_MEMBERS - 1
    if not (text.isascii() and text.isdecimal() and int(text) <= most):
        raise ConfigurationError(
            f"must be a whole number from 0 to {most}",
            file=path, line=line, key="member", value=text,
        )
    return int(text)


def _number(path: Path, line: int, row: dict[str, str], quantity: str) -> float:
    """Return a number that can be believed."""
    unit, least, largest = QUANTITIES[quantity]
    text = row[_UNITS[quantity]]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= largest:
        raise ConfigurationError(
            f"must be a number from {least:g} to {largest:g} {unit}",
            file=path, line=line, key=_UNITS[quantity], value=text,
        )
    return value


def _finish(path: Path, draft: _Draft, members: int, has_evapotranspiration: bool) -> _Issue:
    """Return a whole issue.

    Raises:
        ConfigurationError: it lacks members that the first issue has, or has others, or hours.
    """
    found = sorted(draft.members)
    if found != list(range(members)):
        raise ConfigurationError(
            f"the issue of {_minutes(draft.issued)} has members {', '.join(map(str, found))}, but "
            f"must have 0 to {members - 1}: without gap, and as many as the first issue",
            file=path, line=draft.line,
        )
    hours = [len(draft.members[member]) for member in found]
    if min(hours) != max(hours):
        raise ConfigurationError(
            f"the issue of {_minutes(draft.issued)} must have as many hours of each member; "
            f"member {hours.index(min(hours))} has {min(hours)}, "
            f"member {hours.index(max(hours))} has {max(hours)}",
            file=path, line=draft.line,
        )
    values = np.array([draft.members[member] for member in found])
    return _Issue(
        draft.issued, draft.line, values[:, :, 0],
        values[0, :, 1] if has_evapotranspiration else None,
    )
