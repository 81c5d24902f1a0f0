"""A study on the terminal: its cases by name, and their total deviations as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.model.sensor_pump_errors import PARAMETERS
from greenroof_ros.recording.results_table import differing, shortest
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


class Names:
    """The names of a study's cases: the controller, and whatever differs between them."""

    def __init__(self, cases: Sequence[Case]) -> None:
        """Look at what differs between all cases, and among those of each controller."""
        self._columns = differing([case.columns() for case in cases])
        self._parameters = {
            name: differing([case.parameters for case in cases if case.controller.name == name])
            for name in {case.controller.name for case in cases}
        }

    def name(self, case: Case) -> str:
        """Return the whole name of a case, for a sentence."""
        parts = [self.setting(case)]
        if "initial" in self._columns:
            parts.append(case.initial)
        for column, text in (
            ("start", f"from {case.start}"), ("hours", f"{shortest(case.hours)} h"),
            ("weather", case.weather_name), ("site", case.site.name),
            ("evapotranspiration", f"evapotranspiration {case.evapotranspiration}"),
        ):
            if column in self._columns:
                parts.append(text)
        if any(column.startswith("forecast") for column in self._columns):
            parts.append(f"forecast {forecast_name(case)}")
        return ", ".join(parts)

    def setting(self, case: Case) -> str:
        """Return the controller with its parameters, and the errors of sensor and pump."""
        columns = case.columns()
        values = {
            **{name: case.parameters[name] for name in self._parameters[case.controller.name]},
            **{name: columns[name] for name in PARAMETERS if name in self._columns},
        }
        return _named(case.controller.name, values)


def forecast_name(case: Case) -> str:
    """Name the forecasts of a case."""
    dressed = {} if case.dressed_file is None else {"dressed": case.dressed_file.name}
    return _named(str(case.forecast), {**case.forecast.options(), **dressed})


def _named(name: str, values: Mapping[str, float | str]) -> str:
    """Put values after a name."""
    texts = (
        f"{key} {value if isinstance(value, str) else shortest(value)}"
        for key, value in values.items()
    )
    return " ".join([name, *texts])


def show(cases: Sequence[Case], rows: Sequence[Mapping[str, Any]], directory: Path) -> None:
    """Print the total deviations, setting and forecast a line and an initial state a column.

    Args:
        cases: of the study.
        rows: of its ``results.csv``, one for each case.
        directory: of the study.
    """
    console = Console()
    names = Names(cases)
    windows: dict[_Window, dict[_Line, dict[str, str]]] = {}
    initials = list(dict.fromkeys(case.initial for case in cases))
    forecasts = any(case.forecast.model != PERFECT for case in cases)
    for case, row in zip(cases, rows, strict=True):
        window = _Window(
            case.site.name, case.weather_name, case.start, case.hours, case.evapotranspiration
        )
        done = row["status"] == "done"
        line = _Line(names.setting(case), forecast_name(case))
        windows.setdefault(window, {}).setdefault(line, {})[
            case.initial
        ] = f"{row['total_deviation_m3']:.2f}" if done else row["status"].upper()
    for window, lines in windows.items():
        table = Table(
            title=f"Total deviation (m3, summed over the ticks): {window.weather}, "
            f"{shortest(window.hours)} h from {window.start}, evapotranspiration "
            f"{window.evapotranspiration}, {window.site}",
            title_justify="left",
        )
        table.add_column("controller")
        if forecasts:
            table.add_column("forecast")
        for initial in initials:
            table.add_column(initial, justify="right")
        for shown, totals in lines.items():
            cells = shown if forecasts else (shown.setting,)
            table.add_row(*cells, *(totals.get(initial, "") for initial in initials))
        console.print(table)
    for column, what in _NOTES.items():
        count = sum(bool(row.get(column)) for row in rows)
        if count:
            console.print(f"NOTE: {count} of {len(rows)} runs {what} (column {column})")
    console.print(f"written to {directory / 'results.csv'}", soft_wrap=True, highlight=False)
