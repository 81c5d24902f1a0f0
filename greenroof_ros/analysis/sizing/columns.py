"""The results that are printed and drawn, and the format of their numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from greenroof_ros.results.metrics import METRICS

KEPT, COST = "storm_water_kept_share", "cost"
"""Results in addition to the metrics: the share of storm water kept out of the sewer; the cost."""

ENDS = ("", "_min", "_max")
"""Endings of the columns' names: for the mean, the lowest and the highest of the seasons."""

_METRICS = {metric.name: metric for metric in METRICS}


class Spread(NamedTuple):
    """The mean, the lowest and the highest value of a result over the seasons."""

    mean: float
    low: float
    high: float


class Column(NamedTuple):
    """The presentation of a result."""

    label: str
    unit: str
    form: Callable[[float], str]
    per_roof: bool = False
    """whether the result is also shown per m2 of green roof"""


def format_share(share: float) -> str:
    """Return a share (1) as text in whole per cent, without the sign."""
    return f"{round(100 * share)}"


def _format_volume(value: float) -> str:
    return f"{value:.{1 if abs(value) < 99.95 else 0}f}"


def _format_count(value: float) -> str:
    return f"{value:.0f}"


def _of_metric(
    name: str, unit: str, form: Callable[[float], str], per_roof: bool = False
) -> Column:
    return Column(_METRICS[name].label, unit, form, per_roof)


COLUMNS = {
    "demand_met_share": _of_metric("demand_met_share", "%", format_share),
    "mains_m3": _of_metric("mains_m3", "m³", _format_volume, True),
    "wet_discharge_m3": _of_metric("wet_discharge_m3", "m³", _format_volume, True),
    KEPT: Column("storm water kept out of the sewer", "%", format_share),
    "overflow_days": _of_metric("overflow_days", "days", _format_count),
    "stress_hours": _of_metric("stress_hours", "h", _format_count),
    COST: Column("cost of a season", "in the currency of the prices", _format_volume),
}
"""the results, by name"""


def format_spread(spread: Spread, column: Column) -> str:
    """Return the mean, the lowest and the highest value as text: ``3.5 (1.2 to 7.9)``."""
    if math.isnan(spread.mean):
        return "none"
    mean, low, high = map(column.form, spread)
    return mean if low == high else f"{mean} ({low} to {high})"


def format_per_roof(spread: Spread, roof: float) -> str:
    """Return the mean of a volume (m3) per m2 of green roof, as text.

    Args:
        spread: mean, lowest and highest volume (m3).
        roof: area of the green roof (m2).
    """
    return f"{1000 * spread.mean / roof:.0f} L/m²"
