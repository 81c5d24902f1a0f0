"""Table of a run's rain events, as rows for ``summary.json`` and as the file ``events.csv``."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text
from greenroof_ros.physics.storm_water import Event

EVENTS = "events.csv"
"""name of the file in a run's directory"""

EventRow = dict[str, Any]
"""an event: ``start``, with its offset from UTC, and the fields of an :class:`.Event`"""

_COLUMNS = ("start", *Event._fields)
_MAY_BE_NONE = ("peak_delay_min",)


def event_rows(start: datetime, events: Iterable[Event]) -> list[EventRow]:
    """Return table rows for the events of a run, given the run's start with a fixed UTC offset."""
    return [
        {
            "start": (start + timedelta(hours=event.start_h)).isoformat(timespec="seconds"),
            **event._asdict(),
        }
        for event in events
    ]


def format_events(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the content of ``events.csv``, with full-precision numbers and lower-case Booleans."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows(
        [
            cell if isinstance(cell, str) else "" if cell is None else json.dumps(cell)
            for cell in map(row.get, _COLUMNS)
        ]
        for row in rows
    )
    return text.getvalue()


def read_events(file: Path) -> list[EventRow]:
    """Read the rain events in a file ``events.csv``.

    Raises:
        ConfigurationError: if the file is damaged, or is not a table of rain events.
    """
    rows = list[EventRow]()
    table = csv.DictReader(io.StringIO(read_text(file)), restkey="", restval="?")
    if tuple(table.fieldnames or ()) != _COLUMNS:
        raise ConfigurationError(
            f"must have the columns {', '.join(_COLUMNS)}; repeat the run", file=file, line=1
        )
    for cells in table:
        try:
            rows.append(check_event({
                name: cell if name == "start" else json.loads(cell) if cell else None
                for name, cell in cells.items()
            }))
        except (TypeError, ValueError) as error:
            raise ConfigurationError(
                "is not a valid rain event; repeat the run", file=file, line=table.line_num
            ) from error
    return rows


def check_event(row: EventRow) -> EventRow:
    """Check a row from a file, which can have any content, and return the row.

    Raises:
        TypeError, ValueError: if the row is not an event, which consists of a time, finite numbers
        and Booleans. Only values that can be unknown may be missing.
    """
    if row.keys() != set(_COLUMNS):
        raise ValueError
    datetime.fromisoformat(row["start"])
    known = {name for name in Event._fields if row[name] is not None or name not in _MAY_BE_NONE}
    if not all(math.isfinite(row[name]) for name in known):
        raise ValueError
    return row
