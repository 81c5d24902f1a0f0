"""A study on the terminal: its cases by name, and their total deviations as tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.study.grid import Case

_NOTES = {
    "filled_hours": "had missing hours of weather filled in",
    "frost_hours": "had frost, in which nothing was pumped",
    "limited_steps": "had a tank run empty",
}


class _Window(NamedTuple):
    """Runs that share a table."""

    site: str
    weather: str
    start: str
    hours: float
    evapotranspiration: str


class _Line(NamedTuple):
    """Runs that share a line of a table."""

    setting: str
    forecast: str


def case_name(case: Case) -> str:
    """Name a case in a sentence."""
    return f"{_setting(case)}, {case.initial}, from {case.start}, forecast {_forecast(case)}"


def _setting(case: Case) -> str:
    """Name a controller with its parameters, and the errors of sensor and pump that there are."""
    errors = case.sensor_pump_errors.values() if case.sensor_pump_errors is not None else {}
    there = {name: value for name, value in errors.items() if value}
    return _named(case.controller.name, {**case.parameters, **there})


def _forecast(case: Case) -> str:
    return _named(str(case.forecast), case.forecast.options())


def _named(name: str, values: Mapping[str, float]) -> str:
    """Put values after a name; an infinite one is no bound."""
    return " ".join(
        [name, *(f"{key} {value:g}" for key, value in values.items() if math.isfinite(value))]
    )


def show(cases: Sequence[Case], rows: Sequence[Mapping[str, Any]], directory: Path) -> None:
    """Print the total deviations, setting and forecast a line and an initial state a column.

    Args:
        cases: of the study.
        rows: of its ``results.csv``, one for each case.
        directory: of the study.
    """
    console = Console()
    windows: dict[_Window, dict[_Line, dict[str, str]]] = {}
    initials = list(dict.fromkeys(case.initial for case in cases))
    forecasts = any(case.forecast.model != PERFECT for case in cases)
    for case, row in zip(cases, rows, strict=True):
        window = _Window(
            case.site.name, case.weather_name, case.start, case.hours, case.evapotranspiration
        )
        done = row["status"] == "done"
        windows.setdefault(window, {}).setdefault(_Line(_setting(case), _forecast(case)), {})[
            case.initial
        ] = f"{row['total_deviation_m3']:.2f}" if done else row["status"].upper()
    for window, lines in windows.items():
        table = Table(
            title=f"Total deviation (m3, summed over the ticks): {window.weather}, "
            f"{window.hours:g} h from {window.start}, evapotranspiration "
            f"{window.evapotranspiration}, {window.site}",
            title_justify="left",
        )
        table.add_column("controller")
        if forecasts:
            table.add_column("forecast")
        for initial in initials:
            table.add_column(initial, justify="right")
        for line, totals in lines.items():
            names = line if forecasts else (line.setting,)
            table.add_row(*names, *(totals.get(initial, "") for initial in initials))
        console.print(table)
    for column, what in _NOTES.items():
        count = sum(bool(row.get(column)) for row in rows)
        if count:
            console.print(f"NOTE: {count} of {len(rows)} runs {what} (column {column})")
    console.print(f"written to {directory / 'results.csv'}", soft_wrap=True, highlight=False)
