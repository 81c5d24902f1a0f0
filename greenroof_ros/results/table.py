"""Tables with a row for each run, ``results.csv``, or for each rain event, ``events.csv``.

In the table of runs, the column of the parameter ``weight`` is ``parameter:weight``, so that the
name of a parameter cannot conflict with another column.

Some forked processes cannot create data frames.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.physics.storm_water import Event
from greenroof_ros.results.metrics import METRICS

if TYPE_CHECKING:
    import polars

_PREFIX = "parameter:"

EVENTS = "events.csv"
"""name of the file in a run's directory"""

EventRow = dict[str, Any]
"""an event: ``start``, with its offset from UTC, and the fields of an :class:`.Event`"""

_EVENT_COLUMNS = ("start", *Event._fields)

Cell = TypeVar("Cell")


def parameter_columns(parameters: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the values of parameters, keyed by column name."""
    return {f"{_PREFIX}{name}": value for name, value in parameters.items()}


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
        **{name: "; ".join(summary.get(name) or ()) for name in ("notes", "weather_notes")},
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


# Whether this process was forked from one in which polars was running threads.
_lost_threads = False


def _note_lost_threads() -> None:
    """In a forked process, look for threads of polars in its parent."""
    global _lost_threads
    if "polars" in sys.modules:
        for task in Path(f"/proc/{os.getppid()}/task").glob("*/comm"):
            with contextlib.suppress(OSError):  # it has just ended
                _lost_threads |= task.read_text() == "polars-0\n"


def refuse_forked_polars() -> None:
    """Raise an error if polars would wait forever for threads that a fork did not copy.

    Raises:
        ConfigurationError: if this process was forked after polars had been used.
    """
    if _lost_threads:
        raise ConfigurationError(
            "cannot be created in a process that was forked after polars was used; start the "
            "processes with spawn: multiprocessing.get_context('spawn')", key="a data frame",
        )


def make_frame(data: Any, **options: Any) -> polars.DataFrame:
    """Return a data frame, from the arguments of ``polars.DataFrame``.

    Raises:
        ConfigurationError: if polars is not installed, or would wait forever.
    """
    refuse_forked_polars()
    with require_extra("study"):
        import polars
    return polars.DataFrame(data, **options)


if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_note_lost_threads)
