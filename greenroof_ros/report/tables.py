"""The tables of the report's page: the best runs, all results, the water balances."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import NamedTuple

from greenroof_ros.common.times import hours_minutes_seconds, to_people
from greenroof_ros.experiment import summary
from greenroof_ros.model.metrics import METRICS, Metric
from greenroof_ros.recording.results_table import differing
from greenroof_ros.report.assessment import Assumptions
from greenroof_ros.report.cells import NONE, Cell, Table, number, share, word
from greenroof_ros.report.results import Best, Report, Result, best_runs
from greenroof_ros.report.season_tables import season_tables
from greenroof_ros.report.seeds import Spread, spreads
from greenroof_ros.report.settings import controller_name

METRICS_BY_NAME = {metric.name: metric for metric in METRICS}

# Shown in the water balance, where each tank has its own.
_BALANCE_ONLY = {
    "rain_m3", "rain_cistern_m3", "rain_roof_m3", "outflow_m3", "drainage_m3",
    "evapotranspiration_m3", "final_cistern_m3", "final_roof_m3",
    "final_layer_m3",
}
# Shown with the band that was asked for.
_BAND = "near_target_hours"


def make_tables(report: Report, assumptions: Assumptions) -> list[Table]:
    """Return the tables that a report has something for."""
    tables = [*season_tables(report), *_seeded(report)]
    best = len(report.results) > len(best_runs(report))
    if best:
        tables.append(_best_table(report))
    tables += _methods(report)
    if report.results:
        results = _results_table(report, assumptions)
        balance = _balance_table(report)
        tables += [results._replace(folded=best), balance._replace(folded=True)]
    return tables


class _Column(NamedTuple):
    """A column of the results."""

    header: str
    cell: Callable[[Result], Cell]


class _BestColumn(NamedTuple):
    """A column of the best runs."""

    header: str
    cell: Callable[[Best], Cell]


def _named(report: Report) -> list[_Column]:
    """Return the columns that say which run it is; none that is the same for all."""
    order = {
        (name, label): place
        for name in report.controllers
        for place, label in enumerate(report.settings[name].labels)
    }

    def setting(one: Result) -> Cell:
        name = one.entry.controller
        label = report.settings[name].label(one.entry)
        return Cell(
            report.settings[name].full_label(one.entry), f"{name} {order[name, label]:06}"
        )

    return [
        _Column("controller", lambda one: word(controller_name(one.entry.controller))),
        _Column("setting", setting),
        _Column("from", lambda one: word(one.entry.initial)),
        *_endings(report),
    ]


def _apart(report: Report) -> list[_Column]:
    """Return the columns of what differs between the runs' windows.

    They stand behind the first number, which a narrow screen would not show otherwise.
    """
    return [_Column(name, partial(_fact, name)) for name in report.apart]


def _fact(name: str, one: Result) -> Cell:
    """Return what a fact of its window says of a run."""
    text = one.window.facts[name]
    return Cell(text, one.window.sky.hours) if name == "length" else word(text)


def incident_tables(report: Report) -> list[Table]:
    """Return what was lost in the runs while they went on, where there was anything."""
    several = len(report.results) > 1
    rows = [
        [
            Cell(str(incident.number), f"{place:06} {incident.number:06}"),
            *([word(one.entry.name)] if several else []),
            word(incident.what),
            _moment(one, incident.began, incident.began_tick),
            _moment(one, incident.ended, incident.ended_tick),
            Cell("unknown", sys.float_info.max, warning=True) if incident.seconds is None
            else number(incident.seconds, ".1f"),
            word(incident.cause),
        ]
        for place, one in enumerate(report.results) for incident in one.entry.incidents
    ]
    header = ["incident", *(["run"] if several else []), "part", "from", "until",
              "duration (s of wall time)", "cause"]
    return [Table("Incidents", header, rows)] if rows else []


def _moment(one: Result, wall_time: str | None, tick: int | None) -> Cell:
    """Return when something was lost or came back: since the start, or the time of a live site."""
    if wall_time is None:
        return Cell("not over", "~", warning=True)
    if tick is not None:
        return Cell(f"{hours_minutes_seconds(tick * one.entry.site.tau)} (tick {tick})", wall_time)
    time = datetime.fromisoformat(wall_time).astimezone(one.start.tzinfo)
    return Cell(to_people(time.replace(microsecond=0)), wall_time)


def _endings(report: Report) -> list[_Column]:
    """Return the column that says how runs ended, where one is not done or had incidents."""
    if all(one.entry.ended == summary.DONE for one in report.results):
        return []
    return [_Column("ended", _ended)]


def _ended(one: Result) -> Cell:
    """Return whether a run is done, if not where it ended, and how many incidents there were."""
    ended = one.entry.ended
    return Cell(ended, ended, warning=ended != summary.DONE)


# The directory's name stands behind the first results: it may be long, and says little.
_RUN = _Column("run", lambda one: word(one.entry.name))


def _metric(metric: Metric) -> _Column:
    """Return the column of a metric."""

    def cell(one: Result) -> Cell:
        value = one.assessment.metrics.get(metric.name)
        return NONE if value is None else number(value, metric.form, value > metric.most)

    return _Column(header(metric), cell)


def header(metric: Metric) -> str:
    """Return a metric's label with its unit, which the numbers of percentages have."""
    return metric.label if metric.form.endswith("%") else f"{metric.label} ({unit(metric)})"


def unit(metric: Metric) -> str:
    """Return a metric's unit as print has it."""
    return metric.unit.replace("m3", "m³")


def shown_metrics(report: Report) -> list[Metric]:
    """Return the metrics that any run has."""
    return [
        metric for metric in METRICS
        if any(metric.name in one.assessment.metrics for one in report.results)
    ]


def _results_table(report: Report, assumptions: Assumptions) -> Table:
    """Return the results of each run."""
    money = assumptions.currency
    deviation, *others = [
        _metric(metric) for metric in shown_metrics(report)
        if metric.name not in {*_BALANCE_ONLY, _BAND}
    ]
    return _run_table(report, "Results", [
        deviation,
        *_ratio(report),
        *_apart(report),
        _RUN,
        _Column("near target (h)", lambda one: number(one.assessment.band_hours, ".2f")),
        _Column("near target (%)", lambda one: number(
            100 * one.assessment.band_hours / one.assessment.hours, ".1f")),
        *others,
        _Column(f"value as mains water ({money})", lambda one: number(one.assessment.water_value)),
        _Column(
            f"cost of electric energy ({money})",
            lambda one: number(one.assessment.energy_cost),
        ),
        _Column("frost (h)", lambda one: number(one.assessment.frost_hours, ".2f")),
        _Column("pumped in frost (m³)", lambda one: number(
            one.assessment.frost_pumped_m3, ".4g", one.assessment.frost_pumped_m3 > 0)),
    ])


def _balance_table(report: Report) -> Table:
    """Return the water balance of both tanks in each run."""

    def metric(name: str, title: str) -> _Column:
        column = _metric(METRICS_BY_NAME[name])
        return _Column(f"{title} (m³)", column.cell)

    return _run_table(report, "Water balance", [
        metric("rain_cistern_m3", "cistern: rain"),
        metric("pumped_m3", "pumped"),
        metric("outflow_m3", "to the sewer"),
        _Column("cistern: change (m³)", lambda one: number(one.assessment.cistern_change_m3)),
        _Column("cistern: unexplained (m³)", lambda one: number(
            one.assessment.cistern_residual_m3, ".1e")),
        metric("final_cistern_m3", "cistern: at the end"),
        metric("rain_roof_m3", "roof: rain"),
        metric("evapotranspiration_m3", "evapotranspiration"),
        metric("drainage_m3", "drainage"),
        _Column("roof: change (m³)", lambda one: number(one.assessment.roof_change_m3)),
        _Column("roof: unexplained (m³)", lambda one: number(
            one.assessment.roof_residual_m3, ".1e")),
        metric("final_roof_m3", "roof: at the end"),
        *(
            [metric("final_layer_m3", "drainage layer: at the end")]
            if METRICS_BY_NAME["final_layer_m3"] in shown_metrics(report) else []
        ),
        *_apart(report),
        _RUN,
    ])


def _run_table(report: Report, name: str, columns: Sequence[_Column]) -> Table:
    """Return a table with a line a run; of a single one a line a quantity."""
    columns = [*_named(report), *columns]
    if len(report.results) == 1:
        rows = [[word(column.header), column.cell(report.results[0])] for column in columns]
        return Table(f"{name} of the run", header=(), rows=rows)
    return Table(
        name=f"{name} of each run",
        header=[column.header for column in columns],
        rows=[[column.cell(one) for column in columns] for one in report.results],
    )


def _ratio(report: Report) -> list[_Column]:
    """Return the column of deviations over the least possible, where any is known."""
    if all(one.ratio_to_bound is None for one in report.results):
        return []
    return [_Column("over the least possible (1)", lambda one: share(one.ratio_to_bound))]


def _best_table(report: Report) -> Table:
    """Return the best run of each controller."""
    columns = [
        _BestColumn(
            "controller", lambda best: word(controller_name(best.run.entry.controller))
        ),
        _BestColumn("best setting", lambda best: word(best.setting)),
        _BestColumn("from", lambda best: word(best.initial)),
    ]
    windows = [_Column("window", lambda one: word(report.heading(one.window)))]
    for column in (
        *_endings(report),
        _metric(METRICS_BY_NAME["total_deviation_m3"]), *_ratio(report),
        *(windows if len(report.windows) > 1 else []),
        _metric(METRICS_BY_NAME["pumped_m3"]), _metric(METRICS_BY_NAME["max_command"]), _RUN,
    ):
        columns.append(_BestColumn(column.header, partial(_cell_of_run, column)))
    return Table(
        name="Least total deviation of each controller",
        header=[column.header for column in columns],
        rows=[[column.cell(best) for column in columns] for best in best_runs(report)],
    )


def _cell_of_run(column: _Column, best: Best) -> Cell:
    return column.cell(best.run)


def _seeded(report: Report) -> list[Table]:
    """Return the results of runs under forecast errors over their seeds, where there are many."""
    found = spreads(report)
    if not found:
        return []
    where = differing([one.place.facts for one in found])

    known = any(one.bound_m3 for one in found)

    def row(rank: int, one: Spread) -> list[Cell]:
        totals = (one.mean, one.worst_tenth, one.worst)
        return [
            word(controller_name(one.controller)),
            Cell(one.setting, f"{one.controller} {rank:06}"),
            number(len(one.totals), "d"),
            word(one.skill),
            *(word(one.place.facts[name]) for name in where),
            word(one.place.initial),
            *(number(total, ".2f") for total in totals),
            *(share(total / one.bound_m3 if one.bound_m3 else None)
              for total in totals if known),
        ]

    amounts = ("mean", "worst tenth", "worst")
    return [Table(
        "Total deviation under forecast errors, over their seeds",
        ["controller", "setting", "seeds", "skill of the forecasts", *where, "from",
         *(f"{amount} (m³)" for amount in amounts),
         *(f"{amount} over the least (1)" for amount in amounts if known)],
        [row(rank, one) for rank, one in enumerate(found)],
    )]


def _methods(report: Report) -> list[Table]:
    """Return total deviations under both kinds of evapotranspiration, where there are both."""
    pairs = []
    for one in report.results:
        if one.entry.method != "published":
            continue
        window = replace(one.window, method="fao56")
        pairs += [
            (one, other)
            for other in report.of(window, one.entry.controller, one.entry.initial)
            if other.entry.parameters == one.entry.parameters
        ]
    if not pairs:
        return []
    where = [name for name in report.apart if name != "evapotranspiration"]
    rows = []
    for one, other in pairs:
        published, fao56 = (run.assessment.metrics["total_deviation_m3"] for run in (one, other))
        share = 100 * (fao56 / published - 1) if published else 0.0
        rows.append([
            word(report.label(one)), word(one.entry.initial),
            *(_fact(name, one) for name in where),
            number(published, ".2f"), number(fao56, ".2f"), number(share, "+.2f"),
        ])
    return [Table(
        "Total deviation under both kinds of evapotranspiration",
        ["setting", "from", *where, "published (m³)", "fao56 (m³)", "difference (%)"], rows,
    )]
