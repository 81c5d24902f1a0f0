"""Tables with a row for each run, ``results.csv``, or for each rain event, ``events.csv``.

In the table of runs, the column of the parameter ``weight`` is ``parameter:weight``, so that the
name of a parameter cannot conflict with another column.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text
from greenroof_ros.physics.storm_water import Event
from greenroof_ros.results.metrics import METRICS

_PREFIX = "parameter:"

EVENTS = "events.csv"
"""name of the file in a run's directory"""

EventRow = dict[str, Any]
"""an event: ``start``, with its offset from UTC, and the fields of an :class:`.Event`"""

_EVENT_COLUMNS = ("start", *Event._fields)
_MAY_BE_NONE = ("peak_delay_min",)

Cell = TypeVar("Cell")


def parameter_columns(parameters: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the values of parameters, keyed by column name."""
    return {f"{_PREFIX}{name}": value for name, value in parameters.items()}


def row_parameters(row: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the values of the parameters in a row of the table, keyed by parameter name."""
    return {
        column.removeprefix(_PREFIX): value
        for column, value in row.items() if column.startswith(_PREFIX)
    }


def summary_columns(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results in a run's summary, keyed by the table's column names.

    No result depends on the duration of the run. A value that the summary lacks is None or empty,
    but a missing metric has no column.
    """
    solver = summary.get("solver") or {}
    return {
        **{metric.name: summary[metric.name] for metric in METRICS if metric.name in summary},
        "solves": solver.get("solves"),
        "fallbacks": solver.get("fallbacks"),
        "frost_hours": summary.get("frost_hours"),
        "precipitation_in_frost_mm": summary.get("precipitation_in_frost_mm"),
        "filled_hours": summary.get("filled_hours"),
        "weather_notes": "; ".join(
            (*(summary.get("notes") or ()), *(summary.get("weather_notes") or ()))
        ),
    }


def find_differing_keys(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the keys that have more than one value in the rows, in the order of the keys.

    These keys identify the runs in tables and titles. A key that a row lacks counts as None.
    """
    keys = dict.fromkeys(key for row in rows for key in row)
    return [key for key in keys if len({row.get(key) for row in rows}) > 1]


def format_exactly(value: float) -> str:
    """Format a number exactly, in as few digits as possible: 12, 0.5 or 0.3333333333333333."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)


def event_rows(start: datetime, events: Iterable[Event]) -> list[EventRow]:
    """Return table rows for the events of a run, given the run's start with a fixed UTC offset."""
    return [
        {
            "start": (start + timedelta(hours=event.start_h)).isoformat(timespec="seconds"),
            **event._asdict(),
        }
        for event in events
    ]


def format_csv(columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows as CSV with a header; floats keep all their digits, None is an empty cell."""
    text = io.StringIO()
    table = csv.DictWriter(text, [*columns], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def format_events(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the content of ``events.csv``, with full-precision numbers and lower-case Booleans."""
    return format_csv(
        _EVENT_COLUMNS, ({**row, "complete": json.dumps(row["complete"])} for row in rows)
    )


def read_events(file: Path) -> list[EventRow]:
    """Read the rain events in a file ``events.csv``.

    Raises:
        ConfigurationError: if the file is damaged, or is not a table of rain events.
    """
    rows = list[EventRow]()
    table = csv.DictReader(io.StringIO(read_text(file)), restkey="", restval="?")
    if tuple(table.fieldnames or ()) != _EVENT_COLUMNS:
        raise ConfigurationError(
            f"must have the columns {', '.join(_EVENT_COLUMNS)}; repeat the run", file=file, line=1
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
    if row.keys() != set(_EVENT_COLUMNS):
        raise ValueError
    datetime.fromisoformat(row["start"])
    known = {name for name in Event._fields if row[name] is not None or name not in _MAY_BE_NONE}
    if not all(math.isfinite(row[name]) for name in known):
        raise ValueError
    return row
