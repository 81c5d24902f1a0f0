"""The tables of real seasons, from ``doc/results/real_seasons.csv``.

``python tools/real_seasons ARCHIVES -o DIR`` writes that file as ``DIR/real_seasons.csv``: a row
for each number of a run, with its 95 % interval.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

FILE = Path(__file__).resolve().parent / "results" / "real_seasons.csv"

MEAN, OVER_ONOFF, OVER_NO_RAIN = "mean deviation (mm)", "over on/off", "over no rain"
TOGETHER = "the three as one"

# The columns of each table by measure: how a number is written, and whether its interval is.
# One table of all measures is wider than a phone.
_TABLES = (
    {MEAN: ("{:.2f}", False), OVER_ONOFF: ("{:.3f}", True), OVER_NO_RAIN: ("{:.3f}", True)},
    {
        "pumped (m³)": ("{:.1f}", False),
        "water stress (h)": ("{:.0f}", False),
        "rain kept": ("{:.0%}", False),
    },
)
# The roofs, by the name of their table.
_ROOFS = {
    "measured": "measured",
    "measured at its own target": "measured, target 39 mm",
    "paper": "paper",
}

# A cell is a text, or a text for each of its lines.
Cell = str | tuple[str, ...]
Table = tuple[Sequence[str], list[tuple[Cell, ...]]]


class Number(NamedTuple):
    """A number, and the ends of its 95 % interval."""

    value: float
    low: float
    high: float

    def text(self, form: str, interval: bool = True) -> str:
        """Return it as a cell, with or without its interval."""
        value, low, high = (form.format(number).replace("%", " %") for number in self)
        return f"{value} ({low} to {high})" if interval and low != high else value


@cache
def numbers() -> dict[tuple[str, ...], Number]:
    """Return all numbers by roof, forecast and measure."""
    with FILE.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.reader(stream))[1:]
    return {tuple(row[:3]): Number(*map(float, row[3:])) for row in rows}


def season(roof: str) -> list[Table]:
    """Return the numbers of a roof's runs; a measure that is the same in all runs is left out."""
    forecasts = dict.fromkeys(key[1] for key in numbers() if key[0] == roof)
    tables: list[Table] = []
    for measures in _TABLES:
        columns = {
            measure.replace(MEAN, "mean (mm)"): [
                numbers()[roof, forecast, measure].text(*how) for forecast in forecasts
            ]
            for measure, how in measures.items()
        }
        columns = {name: texts for name, texts in columns.items() if len(set(texts)) > 1}
        rows = list(zip(forecasts, *columns.values(), strict=True))
        tables.append((("forecast", *columns), rows))
    return tables


REAL_SEASONS: dict[str, Callable[[], list[Table]]] = {
    name: partial(season, roof) for name, roof in _ROOFS.items()
}
