"""The tables of the report's page, each as a list of rows, which map headers to texts."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from greenroof_ros.analysis.report.groups import TOTAL, CaseRuns, Report
from greenroof_ros.analysis.report.intervals import SeasonComparison
from greenroof_ros.results.metrics import METRICS

Table = list[dict[str, str]]


class _Result(NamedTuple):
    """The presentation of a result: header, number format, and largest value that is not marked."""

    header: str
    form: str = ".4g"
    max_possible: float = math.inf


_RESULTS = {
    **{
        metric.name: _Result(
            metric.label if metric.form.endswith("%")
            else f"{metric.label} ({metric.unit.replace('m3', 'm³')})",
            ".6g" if metric.form == "d" else metric.form, metric.max,  # the mean of integers
        )
        for metric in METRICS
    },
    "ratio": _Result("relative to the minimum possible (1)", ".4f"),
    "mains_below_onoff_m3": _Result("mains water saved compared with on/off (m³)"),
    "wet_discharge_below_onoff_m3": _Result(
        "wet-weather discharge avoided compared with on/off (m³)"
    ),
    "drainage_kept_m3": _Result("drainage from the roof (m³)"),
    "frost_hours": _Result("frost (h)", ".2f"),
    "frost_pumped_m3": _Result("pumped during frost (m³)", max_possible=0),
    "cistern_change_m3": _Result("change in cistern storage (m³)"),
    "cistern_residual_m3": _Result("unexplained change in cistern storage (m³)", ".1e"),
    "roof_change_m3": _Result("change in roof storage (m³)"),
    "roof_residual_m3": _Result("unexplained change in roof storage (m³)", ".1e"),
}
# The results in every table; a page has room for a dozen columns.
_TABLES = {
    "Results": (
        TOTAL, "ratio", "mean_deviation_mm", "near_target_hours", "pumped_m3", "outflow_m3",
        "max_command", "pump_starts", "electric_energy_kwh",
    ),
    "Plants, rain and frost": (
        "stress_hours", "evapotranspiration_ratio", "roof_retention_share", "frost_hours",
        "frost_pumped_m3",
    ),
    "Pumps and water supply": (
        "beyond_hours", "limited_steps", "busiest_hour_starts", "excess_starts", "pump_hours",
        "hydraulic_energy_kwh", "mains_m3", "mains_below_onoff_m3", "demand_met_share",
    ),
    "Storm water": (
        "discharge_m3", "wet_discharge_m3", "wet_discharge_below_onoff_m3",
        "peak_discharge_5min_l_s", "peak_discharge_60min_l_s", "peak_discharge_5min_mm_h",
        "peak_discharge_60min_mm_h", "overflow_m3", "overflow_days", "retention_share",
    ),
    "Water balance of the cistern": (
        "rain_cistern_m3", "drainage_kept_m3", "mains_m3", "pumped_m3", "outflow_m3",
        "cistern_change_m3", "cistern_residual_m3", "final_cistern_m3",
    ),
    "Water balance of the roof": (
        "rain_roof_m3", "pumped_m3", "evapotranspiration_m3", "drainage_m3", "roof_change_m3",
        "roof_residual_m3", "final_roof_m3", "final_layer_m3",
    ),
}


def make_tables(report: Report) -> dict[str, Table]:
    """Return the tables for which a report has data, by title."""
    tables: dict[str, Table] = {}
    for title, names in _TABLES.items():
        shown = {
            name: _RESULTS[name] for name in names
            if any(case.row.get(name) is not None for case in report.cases)
        }
        if shown:
            tables[title] = [
                _named(report, case) | {
                    result.header: _text(case.row.get(name), result)
                    for name, result in shown.items()
                } for case in report.cases
            ]
    if len(report.runs) > len(report.cases):
        tables["Over seeds and years"] = [
            _named(report, case) | _spread(report, case) for case in report.cases
        ]
    relative = [
        _named(report, case) | _relative(case.relative) for case in report.cases
        if case.relative is not None
    ]
    if relative:
        tables["Deviation relative to on/off"] = relative
    if len(report.cases) == 1:  # one row for each quantity
        tables = {
            title: [{"": name, "value": text} for name, text in row.items()]
            for title, (row,) in tables.items()
        }
    return tables


def _named(report: Report, case: CaseRuns) -> dict[str, str]:
    """Return the cells that name a case and, if any run is unfinished, state how its run ended."""
    ended = any(run.row.get("ended") for run in report.runs)
    window, initial = case.place
    return {
        "case": case.label, "from": initial,
        **({"window": window} if len(report.windows()) > 1 else {}),
        # The reason, which can be long, is among the notes.
        **({"ended": case.row.get("ended", "done").partition(": ")[0]} if ended else {}),
    }


def _text(value: float | None, result: _Result) -> str:
    """Return a number as text, marked if no real pump can achieve it; ``none`` if it is missing."""
    if value is None:
        return "none"
    return f"{value:{result.form}}" + " ⚠" * (value > result.max_possible)


def _spread(report: Report, case: CaseRuns) -> dict[str, str]:
    """Return the cells that show the spread of a case's runs, marked if some runs failed."""
    lacking = sum(
        (run["window"], run["from"], run["case"]) == (*case.place, case.label)
        for run in report.failed
    )
    every = np.concatenate(list(case.totals.values()))
    cells = {
        "runs": str(every.size) + f", {lacking} failed ⚠" * bool(lacking),
        "mean (m³)": f"{case.row[TOTAL]:.2f}",
        "worst run (m³)": f"{every.max():.2f}",
    }
    if case.row["season"]:
        means = {year: of_year.mean() for year, of_year in case.totals.items()}
        worst = max(means, key=lambda year: means[year])
        cells |= {"years": str(len(means)), "worst year": f"{worst}: {means[worst]:.2f} m³"}
    return cells


def _relative(relative: SeasonComparison) -> dict[str, str]:
    """Return the cells of a comparison with on/off control."""
    return {
        "deviation of a season, relative to on/off (1)": f"{relative.mean.value:.3f}",
        "95 % interval": f"{relative.mean.low:.3f} to {relative.mean.high:.3f}",
        "years with a smaller deviation": f"{relative.better} of {relative.years}",
        "change in the deviation (m³)": f"{relative.difference:+.0f}",
    }


# What is worth a note if a column of a run's row is neither empty nor 0.
_NOTED = {
    "filled_hours": "hours of missing weather that were filled",
    "weather_notes": "notes on the weather and the forecasts",
    "fallbacks": "ticks in which the controller's solver found no solution",
    "limited_steps": "ticks in which a tank ran empty, so its outflow was limited",
    "beyond_hours": "hours with a command above 1, which exceeds the pumps' maximum flow: no real "
    "pump can follow it",
    "excess_starts": "pump starts that exceed starts_per_hour of the site",
    "frost_pumped_m3": "m³ of water pumped during frost",
    "roof_noise": "noise of the roof's level sensor (m): the level shown is the sensor's reading",
    "roof_offset": "offset of the roof's level sensor (m): the level shown is the sensor's reading",
}


def make_notes(report: Report) -> dict[str, list[str]]:
    """Return the notes for the reader, each with the runs to which it applies."""
    notes: dict[str, list[str]] = {}
    for run in report.runs:
        ended = run.row.get("ended")
        texts = [f"{ended}: all results are for the recorded part only"] if ended else []
        for text in [*texts, *run.notes]:
            notes.setdefault(text, []).append(run.name)
        for column, text in _NOTED.items():
            value = run.row.get(column)
            if value:
                shown = f"{value:.4g}" if isinstance(value, float) else str(value)
                notes.setdefault(text, []).append(f"{run.name}: {shown}")
    few = [case for case in report.cases if case.row["season"] and len(case.totals) < _FEW_YEARS]
    if few:
        notes[f"with fewer than {_FEW_YEARS} years, a lead in all years may be due to chance"] = [
            f"{case.label}: {len(case.totals)}" for case in few
        ]
    return notes


# A two-sided sign test of five years that all agree gives 6 %, of six years 3 %.
_FEW_YEARS = 6
