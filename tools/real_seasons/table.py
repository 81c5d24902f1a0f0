"""The numbers of the runs, with intervals from blocks of weeks."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from real_seasons.inputs import NO_RAIN
from real_seasons.runs import ONOFF

Array = NDArray[np.float64]
Metrics = Mapping[str, float]

# Of the bootstrap. It draws blocks of weeks, because a storm's excess lasts longer than one week.
_RESAMPLES, _BLOCK_WEEKS = 2000, 4


class Row(NamedTuple):
    """A number of a run, as a row of ``real_seasons.csv``, with the ends of its 95 % interval."""

    roof: str
    forecast: str
    measure: str
    value: float
    low: float
    high: float


def _deviation(metrics: Metrics) -> float:
    return metrics["total_deviation_m3"]


def _rain(metrics: Metrics) -> float:
    return metrics["rain_roof_m3"]


# Ratios of two sums over time, so that weeks can be drawn; a measure without the second is a sum.
_MEASURES: dict[str, tuple[Callable[[Metrics], float], Callable[[Metrics], float] | None]] = {
    "mean deviation (mm)": (
        _deviation, lambda metrics: _deviation(metrics) / metrics["mean_deviation_mm"]
    ),
    "pumped (m³)": (lambda metrics: metrics["pumped_m3"], None),
    "water stress (h)": (lambda metrics: metrics["stress_hours"], None),
    "rain kept": (lambda metrics: metrics["rain_kept_share"] * _rain(metrics), _rain),
}


def rows(roof: str, results: Mapping[str, list[dict[str, float]]]) -> Iterator[Row]:
    """Yield the numbers of a roof's runs.

    Args:
        roof: its name.
        results: by forecast, the metrics until the end of each week.
    """
    deviations = {forecast: _added(until, _deviation) for forecast, until in results.items()}
    for forecast, until in results.items():
        for measure, (above, below) in _MEASURES.items():
            weeks = len(until)
            other = np.full(weeks, 1 / weeks) if below is None else _added(until, below)
            yield Row(roof, forecast, measure, *interval(_added(until, above), other))
        for other_run in (ONOFF, NO_RAIN):
            yield Row(
                roof, forecast, f"over {other_run}",
                *interval(deviations[forecast], deviations[other_run]),
            )


def _added(until: list[dict[str, float]], total: Callable[[Metrics], float]) -> Array:
    """Return what each week added to a total."""
    return np.diff([0.0, *map(total, until)])


def interval(own: Array, other: Array) -> tuple[float, float, float]:
    """Return the ratio of two sums over weeks, and the ends of its 95 % interval."""
    weeks, random = len(own), np.random.default_rng(1)
    begins = random.integers(weeks, size=(_RESAMPLES, -(-weeks // _BLOCK_WEEKS)))
    drawn = (begins[..., None] + np.arange(_BLOCK_WEEKS)).reshape(_RESAMPLES, -1)[:, :weeks] % weeks
    ratios = own[drawn].sum(axis=1) / other[drawn].sum(axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(own.sum() / other.sum()), float(low), float(high)


def write_rows(made: Iterable[Row], file: Path) -> None:
    """Write rows, in all digits."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([Row._fields, *made])
