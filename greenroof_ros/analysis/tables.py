"""Tables of results: how each metric is named and written, wherever it is shown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.results.metrics import METRICS, Metric
from greenroof_ros.site.site import Site

TOTAL, WET, MAINS = "total_deviation_m3", "wet_discharge_m3", "mains_m3"
STRESS = "stress_hours"
BOUNDS = {TOTAL: "bound_m3", WET: "bound_wet_discharge_m3", MAINS: "bound_mains_m3"}
"""the results of the minimum possible values, by metric"""


class Column(NamedTuple):
    """The presentation of a result."""

    label: str
    unit: str
    """unit, as people write it; empty for a text or a number without a unit"""
    form: Callable[[Any], str] = str

    @property
    def heading(self) -> str:
        """Label and unit, for tables, terminals and axes."""
        return f"{self.label} ({self.unit})" if self.unit else self.label


class Table(NamedTuple):
    """A table of a page; the first cell of a row is its heading."""

    caption: str
    columns: Sequence[Column | str]
    rows: Sequence[Sequence[Any]]
    """cells: text, or a number that is written as its column says; None for what is unknown"""
    marked: frozenset[int] = frozenset()
    """rows that are shown in bold, counted from 0"""

    def headings(self) -> list[str]:
        """Return the headings of the columns."""
        return [each if isinstance(each, str) else each.heading for each in self.columns]

    def texts(self) -> list[list[str]]:
        """Return the cells as texts."""
        return [
            [write(value, column) for value, column in zip(row, self.columns, strict=True)]
            for row in self.rows
        ]


def write(value: Any, column: Column | str) -> str:
    """Return a value as text; ``none`` for an unknown value."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "none"
    if isinstance(value, str) or isinstance(column, str):
        return str(value)
    return column.form(value)


def format_share(share: float) -> str:
    """Return a share (1) in per cent; only all is 100, and only what rounds to 0.0 is 0."""
    text = f"{100 * share:.0f}"
    if text in ("0", "-0", "100") and share not in (0, 1):
        exact = f"{100 * share:.1f}"
        return {"0.0": "0", "-0.0": "0", "100.0": "over 99.9"}.get(exact, exact)
    return text


def format_number(value: float) -> str:
    """Return a volume or another quantity with three digits, but whole numbers in full."""
    rounded = float(f"{value:.3g}")
    return f"{value:.0f}" if abs(rounded) >= 100 else f"{rounded:g}"


def write_range(
    row: Mapping[str, Any], name: str, column: Column, low: str = "_min", high: str = "_max"
) -> str:
    """Return a result of a row with its range, as ``3.5 (1.2 to 7.9)``.

    Args:
        row: results.
        name: name of the result.
        column: its presentation.
        low: ending of the name of the lower end.
        high: ending of the name of the upper end.
    """
    texts = [write(row[name + end], column) for end in ("", low, high)]
    return texts[0] if texts[1] == texts[2] else f"{texts[0]} ({texts[1]} to {texts[2]})"


def tabulate_peaks(what: str, peaks: Mapping[str, Iterable[float]]) -> Table:
    """Return the table of the five highest peaks of each case, by return period.

    Args:
        what: the peaks in words.
        peaks: the peak of each season, by case; all cases have the same seasons.
    """
    ranked = [*zip(*(sorted(each, reverse=True) for each in peaks.values()), strict=True)]
    caption = f"{what} (L/s); the m-th largest of n has a return period of (n + 1) / m years"
    return Table(f"{caption} (Weibull)", ["return period (years)", *peaks], [
        [f"{(len(ranked) + 1) / place:.3g}", *map(format_number, row)]
        for place, row in enumerate(ranked[:5], start=1)
    ])


def _describe(metric: Metric) -> Column:
    if metric.form.endswith("%"):
        return Column(metric.label, "%", format_share)
    if metric.form == "d":
        # Of whole numbers, the mean has one decimal.
        return Column(metric.label, "", lambda value: f"{value:.1f}".removesuffix(".0"))
    unit = metric.unit.replace("m3", "m³").replace("m2", "m²")
    return Column(metric.label, "" if unit == "1" else unit, format_number)


COLUMNS = {metric.name: _describe(metric) for metric in METRICS}
"""the presentation of each metric, by its name"""


def check_metrics(names: Iterable[str]) -> None:
    """Check that metrics exist.

    Raises:
        ConfigurationError: if one does not exist.
    """
    for name in names:
        if name not in COLUMNS:
            raise ConfigurationError(
                f"is no metric; {suggest_names(str(name), COLUMNS)}", key="show", value=name
            )


def choose_metrics(sites: Iterable[Site]) -> list[str]:
    """Return the metrics that are shown of runs unless others are asked for."""
    valves = any(site.low_outlet_valve and site.mains_level for site in sites)
    return [WET, MAINS] if valves else [TOTAL]
