"""The cases of a report: runs that differ only in their seeds and, for a season, in the year."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean
from typing import TypeVar

import numpy as np

from greenroof_ros.analysis.report.intervals import Array, SeasonComparison, compare
from greenroof_ros.analysis.report.run import ReportedRun, Row
from greenroof_ros.analysis.report.sources import Sources
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.outlet import CLOSED
from greenroof_ros.results.metrics import METRICS

Item = TypeVar("Item")

TOTAL = "total_deviation_m3"
FLOWS = {
    "cistern": {
        "rain_cistern_m3": 1, "drainage_kept_m3": 1, "mains_m3": 1, "pumped_m3": -1,
        "outflow_m3": -1,
    },
    "roof": {"rain_roof_m3": 1, "pumped_m3": 1, "evapotranspiration_m3": -1, "drainage_m3": -1},
}
"""the flows in the water balance of either tank, each with its sign"""


@dataclass
class CaseRuns:
    """Runs of one window, initial state and setting.

    Attributes:
        runs: runs in the order of their source.
        row: the row of the first run, in which every result is the mean over the seeds of each year
            and then over the years; None if no run has the result.
        totals: total deviation of every run (m3), shape (runs,), by the year of the season; by 0 if
            there is no season.
        relative: comparison of the season with plain on/off control, if both controllers ran in the
            same years.
    """

    runs: list[ReportedRun]
    row: Row
    totals: dict[int, Array]
    relative: SeasonComparison | None = None

    @property
    def label(self) -> str:
        """Name of the case, unique for its window and initial state."""
        return str(self.row["case"])

    @property
    def place(self) -> tuple[str, str]:
        """Window and initial state; only cases that share both are compared."""
        return str(self.row["window"]), str(self.row["initial"])


class Report:
    """All results, grouped into cases.

    Attributes:
        cases: cases in the order of the runs, grouped by window and, within a window, by initial
            state.
        runs: all runs with results.
        failed: runs without results.
        configuration: name and text of every other file that affects the results.
    """

    def __init__(self, sources: Sources) -> None:
        self.runs, self.failed = sources.runs, sources.failed
        self.configuration = sources.configuration
        self.cases = [
            _case(runs)
            for window in _grouped(self.runs, lambda run: run.row["window"])
            for place in _grouped(window, lambda run: run.row["initial"])
            for runs in _grouped(place, lambda run: run.row["case"])
        ]
        for place in self.places():
            _compare(place)

    def windows(self) -> list[list[CaseRuns]]:
        """Return the cases, grouped by window."""
        return _grouped(self.cases, lambda case: case.place[0])

    def places(self) -> list[list[CaseRuns]]:
        """Return the cases, grouped by window and initial state."""
        return _grouped(self.cases, lambda case: case.place)


def _grouped(items: Sequence[Item], key: Callable[[Item], object]) -> list[list[Item]]:
    groups: dict[object, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return list(groups.values())


def _case(runs: list[ReportedRun]) -> CaseRuns:
    """Combine some runs into a case."""
    years: dict[int, list[Row]] = {}
    season = runs[0].row["season"]
    for run in runs:
        year = datetime.fromisoformat(run.row["start"]).year if season else 0
        years.setdefault(year, []).append(run.row | _derived(run))
    row = {**runs[0].row, **_means(list(years.values()))}
    totals = {year: np.array([row[TOTAL] for row in rows]) for year, rows in years.items()}
    return CaseRuns(runs, row, totals)


def _means(years: Sequence[Sequence[Row]]) -> Row:
    """Return the mean of every result over the runs of a year, then over the years.

    The ratio to the minimum possible deviation is the ratio of the means; it is known if all minima
    are known.
    """
    means: Row = {}
    for name in _AVERAGED:
        known = [[row[name] for row in rows if row.get(name) is not None] for rows in years]
        yearly = [fmean(values) for values in known if values]
        means[name] = fmean(yearly) if yearly else None
    bounds = [row.get("bound_m3") for rows in years for row in rows]
    means["ratio"] = means[TOTAL] / means["bound_m3"] if all(bounds) else None
    return means


_AVERAGED = (
    *(metric.name for metric in METRICS), "bound_m3", "bound_wet_discharge_m3", "bound_mains_m3",
    "frost_hours", "frost_pumped_m3",
    "cistern_change_m3", "cistern_residual_m3", "roof_change_m3", "roof_residual_m3",
    "drainage_kept_m3",
)


def _derived(run: ReportedRun) -> Row:
    """Return the changes in storage and the mass balance errors, derived from the results.

    The mass balance error is the change in storage that the flows do not explain. In a simulation,
    this error is due to rounding. At a real site, it consists of all the water that was not
    measured.
    """
    row, site = {**run.row, "mains_m3": run.row.get("mains_m3") or 0.0}, run.site
    row["drainage_kept_m3"], derived = 0.0, Row()
    if site.drainage_to_cistern:
        kept = _sum(row, {"drainage_m3": site.drainage_to_cistern})
        derived["drainage_kept_m3"] = row["drainage_kept_m3"] = kept
    for tank, flows in FLOWS.items():
        change = _sum(row, {f"final_{tank}_m3": 1, f"{tank}_m3": -1})
        if tank == "roof" and change is not None and row.get("final_layer_m3") is not None:
            change += row["final_layer_m3"] - site.initial_layer
        explained = _sum(row, flows)
        derived[f"{tank}_change_m3"] = change
        derived[f"{tank}_residual_m3"] = (
            None if change is None or explained is None else change - explained
        )
    return derived


def _sum(row: Row, terms: Mapping[str, float]) -> float | None:
    """Return a sum of results, each multiplied by a factor; None if a result is missing."""
    if any(row.get(name) is None for name in terms):
        return None
    return float(sum(factor * row[name] for name, factor in terms.items()))


def _compare(place: Sequence[CaseRuns]) -> None:
    """Compare cases of one window and initial state with on/off control that fills to the target.

    The reference is the paper's controller; if some of its cases keep the valve of the low outlet
    closed, only these are used. If there is more than one such case, with different shares of the
    flow, the case with the most runs is used and, in a tie, the case with the smallest mean
    deviation. Deviations are compared for seasons. Volumes are compared if both cases ran in the
    same years.
    """
    (level,) = (known.default for known in OnOff.parameters if known.name == "level")
    plain = [
        case for case in place if case.row["controller"] == "onoff"
        and float(case.row.get("parameter:level") or level) == level
    ]
    closed = [case for case in plain if case.row.get("parameter:outlet") == CLOSED]
    if plain:
        other = min(closed or plain, key=lambda case: (-len(case.runs), case.row[TOTAL]))
        for case in place:
            if case is other:
                continue
            if case.row["season"]:
                case.relative = compare(case.totals, other.totals)
            if case.totals.keys() == other.totals.keys():
                for volume in ("mains", "wet_discharge"):
                    case.row[f"{volume}_below_onoff_m3"] = _sum(
                        {"own": case.row[f"{volume}_m3"], "onoff": other.row[f"{volume}_m3"]},
                        {"onoff": 1, "own": -1},
                    )
