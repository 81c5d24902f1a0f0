"""Reduction of a study's ``results.csv`` to the tables of results."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from typing import TypeAlias

import numpy as np
import polars as pl
from sizing.__main__ import interval

from greenroof_ros.analysis.report.intervals import Deviations, compare, worst_tenth
from greenroof_ros.model.site import read_site
from greenroof_ros.recording.results_table import differing, row_parameters

Rows: TypeAlias = list[dict[str, str]]

# Volumes of the initial state, which its name identifies.
_VOLUMES = ("cistern_m3", "roof_m3")
_OUTCOMES = ("total_deviation_m3", "mean_deviation_mm", "bound_m3")


def read(path: Path) -> Rows:
    """Return the rows of a table."""
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def write(path: Path, rows: Rows) -> None:
    """Write a table; columns that only some rows have are empty in the others."""
    columns = dict.fromkeys(name for row in rows for name in row)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def inputs(rows: Rows) -> list[str]:
    """Return the columns that distinguish runs; they precede the columns of outcomes.

    A parameter is included if it differs between the runs of a controller.
    """
    given = list(rows[0])[1 : list(rows[0]).index("status")]
    by_controller: dict[str, Rows] = defaultdict(list)
    for row in rows:
        by_controller[row["controller"]].append(row)
    parameters = {name for own in by_controller.values() for name in differing(own)}
    known = parameters | {name for name in differing(rows) if not row_parameters({name: ""})}
    return [name for name in given if name in known and name not in _VOLUMES]


def runs(study: Path) -> Rows:
    """Return a row for each run: what differs between them, and their deviation."""
    rows = read(study / "results.csv")
    columns = [*inputs(rows), *(name for name in _OUTCOMES if rows[0][name])]
    return [{name: row[name] for name in columns} for row in rows]


def seeds(study: Path) -> Rows:
    """Return a row for each controller and skill: mean and worst tenth of its seeds (mm)."""
    deviations: dict[tuple[str, str], list[float]] = defaultdict(list)
    for row in read(study / "results.csv"):
        case = row["forecast_skill"], row["controller"]
        deviations[case].append(float(row["mean_deviation_mm"]))
    return [
        {"forecast_skill": skill, "controller": controller,
         "mean_deviation_mm": str(np.mean(values)),
         "worst_tenth_mm": str(worst_tenth(np.array(values)))}
        for (skill, controller), values in deviations.items()
    ]


def seasons(study: Path) -> Rows:
    """Return a row for each controller and roof, over the years and seeds of its seasons.

    The mean deviation is over all years (mm). Its ratio to the first on/off on the same roof has a
    95 % interval. The row also has the number of years in which it is below on/off, and the ratio
    to the minimum possible if the study has it.
    """
    rows = read(study / "results.csv")
    columns = [
        name for name in inputs(rows) if name not in ("weather", "start", "forecast_seed")
    ]
    cases: dict[tuple[str, ...], Rows] = defaultdict(list)
    for row in rows:
        cases[tuple(row[name] for name in columns)].append(row)
    onoff = {}
    for own in cases.values():
        if own[0]["controller"] == "onoff":
            onoff.setdefault(own[0]["site"], _by_year(own))
    table = []
    for case, own in cases.items():
        against = compare(_by_year(own), onoff[own[0]["site"]])
        assert against is not None, "two years, in which on/off has some deviation"
        mean = np.mean([float(row["mean_deviation_mm"]) for row in own])
        names = ("mean_deviation_mm", "over_onoff", "low", "high", "better", "years")
        outcomes = [mean, *against.mean, against.better, against.years]
        if own[0]["bound_m3"]:
            names = (*names, "over_least")
            total, minimum = (
                np.mean([float(row[name]) for row in own])
                for name in ("total_deviation_m3", "bound_m3")
            )
            outcomes.append(total / minimum)
        table.append({
            **dict(zip(columns, case, strict=True)),
            **dict(zip(names, map(str, outcomes), strict=True)),
        })
    return table


def _by_year(rows: Rows) -> Deviations:
    """Return the deviations of one controller, year by year."""
    deviations = Deviations()
    for year in dict.fromkeys(int(row["start"][:4]) for row in rows):
        own = [row for row in rows if int(row["start"][:4]) == year]
        deviations.totals[year] = np.array([float(row["total_deviation_m3"]) for row in own])
        deviations.weeks[year] = np.array([
            [float(week) for week in row["weekly_deviation_m3"].split()] for row in own
        ])
    return deviations


def sizes(study: Path) -> Rows:
    """Return the mains water saved in a season (m3) for each size: the mean, and its interval."""
    saved: dict[tuple[str, float, float], list[float]] = defaultdict(list)
    for row in read(study / "results.csv"):
        site = read_site(study / "configuration" / row["site"])
        size = row["initial"], site.a2, site.a1 * site.z_o
        saved[size].append(float(row["saved_m3"]))
    names = ("saved_m3", "low", "high")
    return [
        {"initial": initial, "green_roof_m2": str(roof), "cistern_m3": str(cistern),
         **dict(zip(names, map(str, interval(pl.Series(values))), strict=True))}
        for (initial, roof, cistern), values in saved.items()
    ]
