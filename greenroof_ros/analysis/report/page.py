"""The page of a report: the answer, tables, notes, and what the results rest on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from textwrap import shorten
from typing import Any

from greenroof_ros.analysis.figures import Figure
from greenroof_ros.analysis.page import Part, Section, make_page
from greenroof_ros.analysis.report.cases import (
    BOUND,
    BOUNDS,
    WET,
    CaseRuns,
    Report,
    rank,
)
from greenroof_ros.analysis.tables import COLUMNS, Table, format_range
from greenroof_ros.base.parameter import parameters_of
from greenroof_ros.base.text import number_of
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.site.site import Site

# Water that enters the sewer in dry weather is not kept out of it.
_BESIDE = {WET: ("discharge_m3", "retention_share")}
# With more cases than this, only results.csv contains all results.
_MAX_CASES = 8
# Longer notes are cut; results.csv and summary.json contain all of them.
_MAX_NOTE = 160
_TEXTS = "notes", "weather_notes"
_MAX = {metric.name: metric.max for metric in METRICS}
# What is worth a note if a column of a run's row is not 0.
_NOTED = {
    "filled_hours": "hours of missing weather that were filled",
    "fallbacks": "ticks in which the controller's solver found no solution",
    "limited_steps": "ticks in which a tank ran empty, so its outflow was limited",
    "beyond_hours": "hours with a command that no real pump can follow, as it exceeds the maximum "
    "flow",
    "excess_starts": "pump starts that exceed starts_per_hour of the site",
}


def render(report: Report, figures: Sequence[Figure]) -> str:
    """Return the page as HTML.

    Args:
        report: the results.
        figures: figures in the order in which they appear.
    """
    failed, ended = report.sources.failed, [run for run in report.runs if run.row.get("ended")]
    alarms = [(run.name, *alarm) for run in report.runs for alarm in run.alarms]
    warnings = [f"{run.name} {run.row['ended']}" for run in ended]
    if failed:
        warnings.append(f"{len(failed)} of {len(failed) + len(report.runs)} runs have no results")
    first = [each for each in figures if each.name in ("comparison", "seasons", "time-1")]
    others = [each for each in figures if each not in first]
    weather = dict.fromkeys(line for run in report.runs for line in run.weather)
    sections = [
        Section("Results", [*[warnings] * bool(warnings), make_table(report), *first]),
        Section("All results", [make_full_table(report)]),
        Section("Further pictures", others, folded=True),
        Section("Alarms", [Table("Alarms", (
            "run", "part", "from", "until", "level", "what", "follows from"
        ), alarms)] * bool(alarms)),
        Section("Runs without results", [
            Table("Runs without results", ("run", "case", "reason"), failed)
        ] * bool(failed)),
        Section("What it rests on", _rest(report)),
        Section("What was read", [[*report.sources.read, *weather]], folded=True),
        Section("How it was made", [
            "Each run is a simulation of the site, tick by tick, or a recording. The result of a "
            "case is the mean over its years, in which a year counts as the mean over its random "
            "seeds. Cases are compared only for the same window and initial state.",
        ]),
    ]
    title = f"Report on {number_of(len(report.runs), 'run')}"
    return make_page(title, answer(report), [each for each in sections if each.parts])


def answer(report: Report) -> str:
    """Return the answer: the best case, what it achieves, and what the first case of the study."""
    name, reference = report.show[0], report.runs[0].row["case"]
    label, count = Counter(place[0].label for place in report.places).most_common(1)[0]
    places = [place for place in report.places if place[0].label == label]
    if len(report.cases) == 1:
        return f"{label}: {_achieved(places[0][0], _columns(report))}."
    text = f"Best by {COLUMNS[name].label}: {label}"
    if len(report.places) > 1:
        text += f", in {count} of {number_of(len(report.places), 'comparison')}"
    where, achieved = report.name_place(places[0]), _achieved(places[0][0], _columns(report))
    sentences = [text, f"{where[:1].upper()}{where[1:]}: {achieved}" if where else (
        f"Means: {achieved}"
    )]
    sentences += [
        f"With {reference}: {_achieved(case, [name])}" for case in places[0]
        if case.label == reference != label
    ]
    return ". ".join(sentences) + "."


def _achieved(case: CaseRuns, names: Sequence[str]) -> str:
    return "; ".join(
        f"{COLUMNS[name].label} {_cell(case, name)} {COLUMNS[name].unit}".rstrip() for name in names
    )


def _columns(report: Report) -> list[str]:
    """Return the metrics of the main table: those shown, and what must stand beside them."""
    names = [each for name in report.show for each in (name, *_BESIDE.get(name, ()))]
    return [
        name for name in dict.fromkeys(names) if any(name in case.ranges for case in report.cases)
    ]


def _cell(case: CaseRuns, name: str) -> str:
    """Return a result with its range, marked if no real pump can achieve it."""
    if name not in case.ranges:
        return "none"
    low, high = case.ranges[name]
    text = format_range(case.row[name], low, high, COLUMNS[name])
    return text + " ⚠" * (high > _MAX.get(name, high))


def make_table(report: Report) -> Table:
    """Return the main table: the shown metrics of all cases, and the minimum possible values."""
    names, first = _columns(report), report.show[0]
    several = len(report.places) > 1
    compared = any(len(case.years) > 1 for case in report.cases)
    rows, marked = list[list[Any]](), set[int]()
    for place in report.places:
        where = [report.name_place(place)] * several
        for case in place:
            if len(place) > 1 and not _is_beaten(case, place, report.show):
                marked.add(len(rows))
            rows.append([
                case.label, *where, *(_cell(case, name) for name in names), len(case.runs),
            ])
            if compared:
                mean, better, years = case.change or (None, 0, 0)
                rows[-1] += [mean, f"{better} of {years}"] if years else ["", ""]
        bounds = [place[0].row.get(BOUNDS.get(name, "")) for name in names]
        if any(bounds):
            rows.append([BOUND, *where, *("" if each is None else each for each in bounds), ""])
            rows[-1] += ["", ""] * compared
    columns: list[Any] = ["case", *["window"] * several, *(COLUMNS[name] for name in names), "runs"]
    if compared:
        change = COLUMNS[first]._replace(label=f"difference from {report.runs[0].row['case']}")
        columns += [change, "years in which it is better"]
    return Table(
        "Means (lowest to highest run), sorted by the first result; bold: no other case is better "
        "in all shown results", columns, rows, frozenset(marked),
    )


def _is_beaten(case: CaseRuns, place: Sequence[CaseRuns], metrics: Sequence[str]) -> bool:
    """Return whether another case is as good in all metrics and better in one."""
    own, *others = (
        [rank(name, each.row[name]) for name in metrics] for each in (case, *place)
    )
    return any(
        other != own and all(map(float.__le__, other, own)) for other in others
    )


def make_full_table(report: Report) -> Part:
    """Return the table of all results, or where they are if there are too many cases."""
    if len(report.cases) > _MAX_CASES:
        return "All results of every run are in results.csv of the study."
    labels = [
        f"{case.label}, {name}".rstrip(", ")
        for place in report.places for name in [report.name_place(place)] for case in place
    ]
    return Table("Means (lowest to highest run)", ["result", *labels], [
        [column.heading, *(_cell(case, name) for case in report.cases)]
        for name, column in COLUMNS.items() if any(name in case.ranges for case in report.cases)
    ])


def make_notes(report: Report) -> list[str]:
    """Return the notes for the reader, each with the number of runs to which it applies."""
    texts = Counter(
        text for run in report.runs for text in (
            *run.notes,
            *(shorten(run.row[name], _MAX_NOTE) for name in _TEXTS if run.row.get(name)),
        )
    )
    notes = [f"{text} ({_of(count, report)})" for text, count in texts.items()]
    for name, text in _NOTED.items():
        if values := [value for run in report.runs if (value := run.row.get(name))]:
            notes.append(f"{text}: up to {max(values):.4g} ({_of(len(values), report)})")
    return notes


def _of(count: int, report: Report) -> str:
    return f"{count} of {number_of(len(report.runs), 'run')}"


def _rest(report: Report) -> list[Part]:
    """Return what the ranges cover, and the parameters of the sites."""
    years = sorted({year for case in report.cases for year in case.years if year})
    seeds = {run.row.get("forecast_seed") for run in report.runs} - {None, ""}
    covered = [
        *([f"the seasons of {years[0]} to {years[-1]}"] if years else []),
        *([f"{len(seeds)} random seeds"] if len(seeds) > 1 else []),
    ]
    forecasts = sorted({str(run.row.get("forecast") or "perfect") for run in report.runs})
    sites = {str(run.row["site"]): run.site for run in report.runs}
    return [
        [
            f"The ranges cover {' and '.join(covered) or 'single runs: they show no spread'}, but "
            "not the uncertainty of the parameters below.",
            f"Forecasts: {', '.join(forecasts)}.", *make_notes(report),
        ],
        Table("Parameters", ["parameter", "unit", "meaning", *sites], [
            [known.name, known.unit, known.meaning, *values] for known in parameters_of(Site)
            if any(values := [getattr(site, known.name) for site in sites.values()])
        ]),
    ]
