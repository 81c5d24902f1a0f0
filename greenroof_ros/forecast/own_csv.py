"""Archives of forecasts of this project's own form: issue after issue, hour after hour."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.common.times import to_minutes
from greenroof_ros.forecast.issue import Contents, Issue
from greenroof_ros.model.look_ahead import MOST_MEMBERS
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import (
    EVAPOTRANSPIRATION,
    HOUR,
    PRECIPITATION,
    QUANTITIES,
    TEMPERATURE,
)
from greenroof_ros.weather.table import Row, Table, numbered_lines

_COLUMNS = {
    quantity: f"{quantity} [{QUANTITIES[quantity][0]}]"
    for quantity in (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE)
}
# The columns that a file may do without.
_OPTIONAL = {"member", _COLUMNS[EVAPOTRANSPIRATION], _COLUMNS[TEMPERATURE]}


@dataclass
class _Draft:
    """An issue while it is read: of each member, hour by hour, the values of each quantity."""

    issued: datetime
    line: int
    members: dict[int, list[dict[str, float]]] = field(default_factory=dict)


def recognises(_file: Path, _head: bytes, /) -> bool:
    """Any file: this format is the last to be asked, and its errors say what would be right."""
    return True


def read(files: Sequence[Path], _site: Site, /) -> Contents:
    """Read files of this form; their issues are known from when they say that they were issued."""
    return Contents("own form", [issue for file in files for issue in read_forecasts(file)], 0.0)


def read_forecasts(path: Path) -> list[Issue]:
    """Read a file of forecasts, one issue after the other.

    Lines that start with ``#`` are comments. The first other line is the header: ``issued``,
    ``time``, then ``member`` if there is more than one forecast per issue, ``precipitation
    [mm/h]``, and ``evapotranspiration [mm/day]`` and ``temperature [degC]`` if the file has them
    (member 0's count). Each further line is the hour that starts at its ``time``, as forecast at
    ``issued`` (ISO 8601 with the offset from UTC): of each issue and member hour after hour, the
    first that which starts with the issue. All issues have the members 0, 1, 2 and so on, and all
    members of an issue the same hours.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    table = Table(path, numbered_lines(read_text(path)))
    _check_header(table)
    quantities = [quantity for quantity, column in _COLUMNS.items() if column in table.header]
    drafts: list[_Draft] = []
    for row in table.rows():
        _add(row, quantities, drafts)
    return [_finish(path, draft, len(drafts[0].members)) for draft in drafts]


def _check_header(table: Table) -> None:
    """Refuse other columns, or another order of them."""
    columns = ["issued", "time", "member", *_COLUMNS.values()]
    expected = [one for one in columns if one not in _OPTIONAL or one in table.header]
    for cell, due in itertools.zip_longest(table.header, expected):
        if cell == due:
            continue
        may = (
            f"they are {', '.join(map(repr, columns))}, of which "
            f"{', '.join(one for one in columns if one in _OPTIONAL)} may be left out"
        )
        if due is None:
            raise table.refuse(f"is one column too many; {may}", cell)
        raise table.refuse(f"the column must be '{due}'; {may}", cell or "")


def _add(row: Row, quantities: list[str], drafts: list[_Draft]) -> None:
    """Add a line to its issue, the last of the drafts or a new one."""
    issued, time = row.time("issued"), row.time("time")
    if not drafts or issued > drafts[-1].issued:
        drafts.append(_Draft(issued, row.line))
    draft = drafts[-1]
    if issued < draft.issued:
        raise row.refuse(
            f"must not be before {to_minutes(draft.issued)}, as above: the issues must be in the "
            "order of time",
            "issued",
        )
    hours = draft.members.setdefault(_member(row), [])
    row.check_due("time", time, issued + len(hours) * HOUR, "from its issue on, each forecast")
    hours.append({quantity: row.value(_COLUMNS[quantity], quantity) for quantity in quantities})


def _member(row: Row) -> int:
    """Return a line's member, 0 where the file has but one."""
    text = row.cells.get("member", "0")
    most = MOST_MEMBERS - 1
    if not (text.isascii() and text.isdecimal() and float(text) <= most):
        raise row.refuse(f"must be a whole number from 0 to {most}", "member")
    return int(float(text))  # an int of a text may have 4300 digits, zeros too


def _finish(path: Path, draft: _Draft, members: int) -> Issue:
    """Return a whole issue.

    Raises:
        ConfigurationError: it lacks members that the first issue has, or has others, or hours.
    """
    found = sorted(draft.members)
    if found != list(range(members)):
        raise ConfigurationError(
            f"the issue of {to_minutes(draft.issued)} has members {', '.join(map(str, found))}, "
            f"but must have 0 to {members - 1}: without gap, and as many as the first issue",
            file=path, line=draft.line,
        )
    lengths = [len(draft.members[member]) for member in found]
    if min(lengths) != max(lengths):
        raise ConfigurationError(
            f"the issue of {to_minutes(draft.issued)} must have as many hours of each member; "
            f"member {lengths.index(min(lengths))} has {min(lengths)}, "
            f"member {lengths.index(max(lengths))} has {max(lengths)}",
            file=path, line=draft.line,
        )
    rain = [[hour[PRECIPITATION] for hour in draft.members[member]] for member in found]
    return Issue(
        draft.issued, path, draft.line, np.array(rain),
        *(_of_member_0(draft, quantity) for quantity in (EVAPOTRANSPIRATION, TEMPERATURE)),
    )


def _of_member_0(draft: _Draft, quantity: str) -> NDArray[np.float64] | None:
    """Return a quantity of each hour, shape (hours,); None where the file does not have it."""
    hours = draft.members[0]
    return np.array([hour[quantity] for hour in hours]) if quantity in hours[0] else None


def write_forecasts(issues: Sequence[Issue]) -> str:
    """Return issues as a file of this form, which :func:`read_forecasts` reads bit for bit.

    The temperature, of which nothing that reads such a file makes use, is left out.

    Args:
        issues: an archive's, in the order of time.
    """
    columns = ["issued", "time", "member", _COLUMNS[PRECIPITATION]]
    if issues[0].evapotranspiration is not None:
        columns.append(_COLUMNS[EVAPOTRANSPIRATION])
    lines = [",".join(columns)]
    for issue in issues:
        issued = issue.issued.isoformat()
        times = [(issue.issued + hour * HOUR).isoformat() for hour in range(issue.hours)]
        dry = [""] * issue.hours
        if issue.evapotranspiration is not None:
            dry = [f",{value!r}" for value in issue.evapotranspiration.tolist()]
        lines += [
            f"{issued},{time},{member},{rain!r}{evapotranspiration}"
            for member, series in enumerate(issue.rain.tolist())
            for time, rain, evapotranspiration in zip(times, series, dry, strict=True)
        ]
    return "\n".join([*lines, ""])
