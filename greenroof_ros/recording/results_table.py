"""The table of a study, ``results.csv``: its columns of parameters, and what tells runs apart.

A parameter ``weight`` is in the column ``parameter:weight``: whatever a controller calls its
parameters, none is mistaken for another column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from greenroof_ros.model.metrics import METRICS

_PREFIX = "parameter:"

Cell = TypeVar("Cell")


def parameter_columns(parameters: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return the columns of parameters, by the parameters' names."""
    return {f"{_PREFIX}{name}": value for name, value in parameters.items()}


def summary_columns(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a summary says of a run's results, in columns of the table.

    They are the same in every repetition. What the summary does not say is None or empty.
    """
    solver, filled = summary.get("solver") or {}, summary.get("filled") or {}
    return {
        **{metric.name: summary[metric.name] for metric in METRICS if metric.name in summary},
        "weekly_deviation_m3": " ".join(map(repr, summary.get("weekly_deviation_m3") or ())),
        "solves": solver.get("solves"),
        "fallbacks": solver.get("fallbacks"),
        "frost_hours": summary.get("frost_hours"),
        "precipitation_in_frost_mm": summary.get("precipitation_in_frost_mm"),
        "filled_hours": summary.get("filled_hours"),
        "filled": "; ".join(f"{name}: {', '.join(hours)}" for name, hours in filled.items()),
        "weather_notes": "; ".join(summary.get("weather_notes") or ()),
        "suspicious": "; ".join(summary.get("suspicious") or ()),
        "forecast_repeats_from": summary.get("forecast_repeats_last_record_from"),
    }


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
