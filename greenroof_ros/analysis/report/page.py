"""The page of a report: the answer, tables, notes, and what the results rest on."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from textwrap import shorten
from typing import Any

from greenroof_ros.analysis.assumptions import list_assumptions
from greenroof_ros.analysis.figures import Figure
from greenroof_ros.analysis.page import Section, make_page
from greenroof_ros.analysis.report.runs import Report, rank
from greenroof_ros.analysis.tables import BOUNDS, COLUMNS, STRESS, WET, Table, write, write_range
from greenroof_ros.base.text import number_of
from greenroof_ros.results.metrics import METRICS

# Water that enters the sewer in dry weather is not kept out of it.
_BESIDE = {WET: ("discharge_m3", "retention_share")}
# With more cases than this, only results.csv contains the results of the others.
_MAX_CASES = 8
# Longer notes are cut; results.csv and summary.json contain all of them.
_MAX_NOTE = 160
_NO_PICTURE = (
    "No run kept its trajectory, so there is no picture over time. To keep it: greenroof simulate "
    "--trajectory-every 600 (s); in Python, trajectory_every=600, also for a study."
)
# What is worth a note if it is more than 0 in a run.
_NOTED = {each.name: each.meaning for each in METRICS if each.max == 0} | {
    "fallbacks": "ticks in which the controller's solver found no solution",
}


def render(report: Report, figures: Sequence[Figure]) -> str:
    """Return the page as HTML.

    Args:
        report: the results.
        figures: figures in the order in which they appear.
    """
    failed = Table("Runs that failed or did not finish", ("run", "reason"), report.sources.failed)
    missing = [_NO_PICTURE] * all(run.kept is None for run in report.sources.runs)
    sections = [
        Section(failed.caption, [failed] * bool(failed.rows)),
        Section("Results", [make_table(report, _columns(report)), *figures, *missing]),
        Section("All results", [make_full_table(report)], folded=True),
        Section("What it rests on", [make_notes(report), _tabulate_assumptions(report)]),
        Section("What was read", [report.sources.read], folded=True),
        Section("How it was made", [
            "Each run is a simulation of the site, tick by tick, or a recording. The result of a "
            "case is the mean over its years, in which a year counts as the mean over its random "
            "seeds. Cases are compared only for the same period and initial state.",
        ]),
    ]
    title = f"Report on {number_of(len(report.sources.runs), 'run')}"
    return make_page(title, answer(report), [each for each in sections if each.parts])


def answer(report: Report) -> str:
    """Return the answer: the best cases, what one of them achieves, and what the runs cover."""
    runs, won = report.sources.runs, dict[str, list[str]]()
    for place in report.places:
        values = place[report.show[0]].drop_nulls().to_list()
        alike = sum(math.isclose(value, values[0], rel_tol=1e-6) for value in values[1:])
        case = place["case"][0] + f" (and {number_of(alike, 'other')} alike)" * bool(alike)
        won.setdefault(case, []).append(place["place"][0])
    best, *others = report.places[0].to_dicts()
    winners = ", ".join(
        case + f" ({'; '.join(places)})" * bool(places[0]) for case, places in won.items()
    )
    told = {", ".join(filter(None, (best["case"], best["place"]))): best} | {
        case["case"]: case for case in others if case["case"] == runs[0].row["case"]
    }
    return ". ".join([
        *[f"Best by {COLUMNS[report.show[0]].label}: {winners}"] * (len(runs) > 1),
        *(f"For {name}: " + "; ".join(
            f"{COLUMNS[each].label} {write_range(case, each, COLUMNS[each])} {COLUMNS[each].unit}"
            .rstrip() for each in _columns(report)
        ) for name, case in told.items()),
        _describe_runs(report),
    ]) + "."


def _describe_runs(report: Report) -> str:
    """Return the sites, the periods and the rain of the runs."""
    runs, years = report.sources.runs, report.years["year"].drop_nulls()
    rain = [1000 * each / run.site.a2 for run in runs if (each := run.row.get("rain_roof_m3"))]
    texts = {
        "Site": [run.row["site"] for run in runs], "period": [run.row["window"] for run in runs],
        "seasons": [f"{years.min()!r} to {years.max()!r}"] * bool(len(years)),
        "rain on the roof": [f"{each:.0f} mm" for each in sorted(rain)],
        "forecasts, if used": [run.row.get("forecast") or "not known" for run in runs],
    }
    return "; ".join(f"{name}: {shorten(', '.join(dict.fromkeys(each)), _MAX_NOTE)}"
                     for name, each in texts.items() if each)


def _columns(report: Report) -> list[str]:
    """Return the metrics of the main table: those shown, and what must stand beside them.

    Plants that lack water save some of it, so their stress is shown if it differs between cases.
    """
    names = [each for name in report.show for each in (name, *_BESIDE.get(name, ()))]
    names += [STRESS] * any(
        place[STRESS].n_unique() > 1 for place in report.places if STRESS in report.metrics
    )
    return [name for name in dict.fromkeys(names) if name in report.metrics]


def make_table(report: Report, names: Sequence[str]) -> Table:
    """Return the main table: some metrics of all cases, and the minimum possible values."""
    rows, marked = list[list[Any]](), set[int]()
    several = len(report.places) > 1
    for place in report.places:
        ranks = place.select(map(rank, report.show)).fill_null(math.inf).to_numpy()
        marked |= {len(rows) + index for index, own in enumerate(ranks) if not any(
            (ranks <= own).all(axis=1) & (ranks < own).any(axis=1)
        )}
        cases = place.to_dicts()
        rows += [
            [case["case"], *[case["place"]] * several,
             *(write_range(case, name, COLUMNS[name]) for name in names), case["runs"]]
            for case in cases
        ]
        bounds = [cases[0].get(BOUNDS.get(name, "")) for name in names]
        if any(each is not None for each in bounds):
            rows.append(["minimum possible", *[cases[0]["place"]] * several, *(
                "" if each is None else write(each, COLUMNS[name])
                for name, each in zip(names, bounds, strict=True)
            ), ""])
    return Table(
        "Means (lowest to highest run), sorted by the first result; bold: no other case is better "
        "in all shown results",
        ["case", *["place"] * several, *(COLUMNS[name] for name in names), "runs"], rows,
        frozenset(marked),
    )


def make_full_table(report: Report) -> Table:
    """Return the table of all results of the first cases."""
    cases = [case for place in report.places for case in place.to_dicts()][:_MAX_CASES]
    labels = [f"{case['case']}, {case['place']}".rstrip(", ") for case in cases]
    return Table("Means (lowest to highest run)", ["result", *labels], [
        [COLUMNS[name].heading, *(write_range(case, name, COLUMNS[name]) for case in cases)]
        for name in report.metrics
    ])


def make_notes(report: Report) -> list[str]:
    """Return the notes for the reader, most with the number of runs to which they apply."""
    runs = report.sources.runs
    texts = Counter(text for run in runs for text in (
        f"forecast: {run.row.get('forecast') or 'not known'}", *run.notes,
        *(shorten(run.row.get(name) or "", _MAX_NOTE) for name in ("notes", "weather_notes")),
        *(meaning for name, meaning in _NOTED.items() if run.row.get(name)),
    ) if text)
    return [
        "The ranges cover the seasons and the random seeds of the runs, but not what is assumed "
        "below. greenroof size runs both ends of each assumption.",
        *(f"{text} ({count} of {number_of(len(runs), 'run')})" for text, count in texts.items()),
    ]


def _tabulate_assumptions(report: Report) -> Table:
    """Return the assumptions that matter, with both ends."""
    sites = dict.fromkeys(run.site for run in report.sources.runs)
    return Table(
        "Assumptions: the range in which each probably lies",
        ["assumption", "low", "used", "high", "source of the range"], [
            [each.label, f"{each.low:g}", ", ".join(
                f"{value:g}" for value in sorted({getattr(site, each.name) for site in sites})
            ), f"{each.high:g}", each.source]
            for each in dict.fromkeys(each for site in sites for each in list_assumptions(site))
        ],
    )
