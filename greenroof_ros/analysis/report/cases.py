"""The cases of a report: runs that differ only in their seeds and, for a season, in the year."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean
from typing import TypeVar

from greenroof_ros.analysis.report.bags import ReportedRun, Row
from greenroof_ros.analysis.report.sources import Sources
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.site.site import Site

Item = TypeVar("Item")

TOTAL, WET, MAINS = "total_deviation_m3", "wet_discharge_m3", "mains_m3"
BOUNDS = {TOTAL: "bound_m3", WET: "bound_wet_discharge_m3", MAINS: "bound_mains_m3"}
"""the columns of the minimum possible values, by metric"""
BOUND = "minimum possible"
"""name of the bound in figures and tables"""
# Metrics of which more is better.
_MORE = {
    "near_target_hours", "evapotranspiration_ratio", "roof_retention_share", "demand_met_share",
    "retention_share",
}


@dataclass
class CaseRuns:
    """Runs of one window, initial state and setting.

    Attributes:
        runs: runs in the order of their source.
        row: the row of the first run, in which every result is the mean over the seeds of each year
            and then over the years; None if no run has the result.
        ranges: lowest and highest value of each result over all runs.
        years: results of the runs, by the year of the season; by 0 if there is no season.
        change: mean difference of the first shown metric from the first case of the study, the
            number of years in which this case is better, and the number of years of both.
    """

    runs: list[ReportedRun]
    row: Row
    ranges: Mapping[str, tuple[float, float]]
    years: Mapping[int, Sequence[Row]]
    change: tuple[float, int, int] | None = None

    @property
    def label(self) -> str:
        """Name of the case, unique for its window and initial state."""
        return str(self.row["case"])

    @property
    def place(self) -> tuple[str, str]:
        """Window and initial state; only cases that share both are compared."""
        return str(self.row["window"]), str(self.row["initial"])

    def yearly(self, metric: str) -> dict[int, float]:
        """Return the mean of a metric over the seeds of each year in which it is known."""
        known = {
            year: [row[metric] for row in rows if row.get(metric) is not None]
            for year, rows in self.years.items()
        }
        return {year: fmean(values) for year, values in known.items() if values}


class Report:
    """All results, grouped into cases.

    Attributes:
        sources: where the runs are from.
        runs: all runs with results.
        show: metrics in the order of their importance, the first of which sorts the cases.
        places: cases by window and initial state, the best first.
    """

    def __init__(self, sources: Sources) -> None:
        """Group and compare the runs.

        Raises:
            ConfigurationError: if a study shows a metric that does not exist.
        """
        self.sources, self.runs = sources, sources.runs
        self.show = sources.show or (
            [WET, MAINS] if any(_has_valve_and_mains(run.site) for run in self.runs) else [TOTAL]
        )
        if unknown := set(self.show) - {metric.name for metric in METRICS}:
            raise ConfigurationError("is not a metric", key="show", value=min(unknown))
        self.places = list[list[CaseRuns]]()
        for place in _grouped(self.runs, lambda run: (run.row["window"], run.row["initial"])):
            cases = [_case(runs) for runs in _grouped(place, lambda run: run.row["case"])]
            for case in cases[1:]:
                case.change = _compare(case, cases[0], self.show[0])
            self.places.append(
                sorted(cases, key=lambda case: rank(self.show[0], case.row[self.show[0]]))
            )

    @property
    def cases(self) -> list[CaseRuns]:
        """All cases."""
        return [case for place in self.places for case in place]

    def name_place(self, place: Sequence[CaseRuns]) -> str:
        """Return in what the window and the initial state of a place differ from the others."""
        texts = [
            {*each[0].place[0].split(", "), f"from {each[0].place[1]}"} for each in self.places
        ]
        common = set.intersection(*texts)
        window, initial = place[0].place
        parts = [*window.split(", "), f"from {initial}"]
        return ", ".join(part for part in parts if part not in common)


def rank(metric: str, value: float | None) -> float:
    """Return a number that is the lower, the better a metric is."""
    return float("inf") if value is None else -value if metric in _MORE else value


def _has_valve_and_mains(site: Site) -> bool:
    return site.low_outlet_valve and site.mains_level is not None


def _grouped(items: Iterable[Item], key: Callable[[Item], object]) -> list[list[Item]]:
    groups: dict[object, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return list(groups.values())


def _case(runs: list[ReportedRun]) -> CaseRuns:
    """Combine some runs into a case."""
    years: dict[int, list[Row]] = {}
    for run in runs:
        year = datetime.fromisoformat(run.row["start"]).year if run.row["season"] else 0
        years.setdefault(year, []).append(run.row)
    case = CaseRuns(runs, dict(runs[0].row), {}, years)
    ranges = {}
    for name in (*(metric.name for metric in METRICS), *BOUNDS.values()):
        known = [row[name] for rows in years.values() for row in rows if row.get(name) is not None]
        case.row[name] = fmean(case.yearly(name).values()) if known else None
        if known:
            ranges[name] = min(known), max(known)
    case.ranges = ranges
    return case


def _compare(case: CaseRuns, first: CaseRuns, metric: str) -> tuple[float, int, int] | None:
    own, other = case.yearly(metric), first.yearly(metric)
    differences = [own[year] - other[year] for year in own if year in other]
    if not differences:
        return None
    better = sum(rank(metric, each) < 0 for each in differences)
    return fmean(differences), better, len(differences)
