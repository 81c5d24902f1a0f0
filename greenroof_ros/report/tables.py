"""The tables of the report's page."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from greenroof_ros.common.times import hours_minutes_seconds, to_people
from greenroof_ros.experiment import summary
from greenroof_ros.model.metrics import METRICS, Metric
from greenroof_ros.report.about import Row, controller_name
from greenroof_ros.report.groups import (
    SEASONS,
    SEEDS,
    TOTAL,
    Report,
    facts,
    who,
)
from greenroof_ros.report.intervals import Comparison, Ratio

_METRICS = {metric.name: metric for metric in METRICS}

# Shown in the water balance, where each tank has its own; or with the band that was asked for.
_ELSEWHERE = {
    TOTAL, "near_target_hours", "rain_m3", "rain_cistern_m3", "rain_roof_m3", "outflow_m3",
    "drainage_m3", "evapotranspiration_m3", "final_cistern_m3", "final_roof_m3", "final_layer_m3",
}
# Means of a season.
_MEANS = (
    "mean_deviation_mm", "stress_hours", "evapotranspiration_ratio", "rain_kept_share",
    "rain_kept_share_hour", "rain_kept_share_day", "saved_m3", "mains_m3", "pumped_m3",
    "outflow_m3", "drainage_m3", "electric_energy_kwh", "pump_starts",
)
_MEAN_FORMS = {
    "mean_deviation_mm": ".2f", "stress_hours": ".1f", "electric_energy_kwh": ".3g",
    "pump_starts": ".0f", **dict.fromkeys(
        ("saved_m3", "mains_m3", "pumped_m3", "outflow_m3", "drainage_m3"), ".2f"
    ),
}


class Cell(NamedTuple):
    """A cell of a table: what is shown, and what the table is sorted by."""

    text: str
    key: float | str
    warning: bool = False


class Table(NamedTuple):
    """A table that a reader can sort; the first column names the row.

    Without a header each row is a quantity of the only run.
    """

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    folded: bool = False
    """whether another one says in short what it says"""


class Column(NamedTuple):
    """A column, and what it says of a row: a run, or a case."""

    header: str
    cell: Callable[[Any], Cell]


def number(value: float | None, digits: str = ".4g", most: float = float("inf")) -> Cell:
    """Return the cell of a number; none of a quantity that a run has not, such as a storm's."""
    if value is None:
        return Cell("none", -1.0)
    if digits == "d":
        value = int(value)
    text = f"{value:{digits}}"
    return Cell("0" if float(text.rstrip("%")) == 0 else text, value, value > most)


def word(text: str) -> Cell:
    """Return the cell of a text."""
    return Cell(text, text)


def share(value: float | None) -> Cell:
    """Return a cell of a ratio; the unknown ones come last."""
    return Cell("unknown", sys.float_info.max) if value is None else number(value, ".4f")


def make_tables(report: Report) -> list[Table]:
    """Return the tables that a report has something for."""
    tables = [*_seasons(report), *_seeds(report)]
    single, best = report.single, report.best()
    if len(single) > len(best):
        tables.append(_best(report, best))
    tables += _methods(report)
    if single:
        folded = len(single) > len(best)
        tables += [
            _of_runs(report, "Results", _results(report))._replace(folded=folded),
            _of_runs(report, "Water balance", _balance(report))._replace(folded=True),
        ]
    return tables


def _table(name: str, columns: Sequence[Column], rows: Sequence[Any]) -> Table:
    return Table(
        name, [column.header for column in columns],
        [[column.cell(row) for column in columns] for row in rows],
    )


# --- columns --------------------------------------------------------------------------------------


def _number(header: str, name: str, form: str = ".4g", most: float = float("inf")) -> Column:
    return Column(header, lambda row: number(row[name], form, most))


def _metric(metric: Metric, form: str = "", title: str = "") -> Column:
    """Return the column of a metric."""
    header = f"{title} (m³)" if title else _header(metric)
    return _number(header, metric.name, form or metric.form, metric.most)


def _header(metric: Metric) -> str:
    """Return a metric's label with its unit, which the numbers of percentages have."""
    return metric.label if metric.form.endswith("%") else f"{metric.label} ({unit(metric)})"


def unit(metric: Metric) -> str:
    """Return a metric's unit as print has it."""
    return metric.unit.replace("m3", "m³")


def shown_metrics(report: Report) -> list[Metric]:
    """Return the metrics that any single run has."""
    return [
        metric for metric in METRICS if any(row[metric.name] is not None for row in report.single)
    ]


def _fact(name: str) -> Column:
    def cell(row: Row) -> Cell:
        return Cell(row[name], row["hours"]) if name == "length" else word(row[name])

    return Column(name, cell)


_NEAR = Column("near target (%)", lambda row: number(
    None if row["near_share"] is None else 100 * row["near_share"], ".1f"))


def _setting(row: Row) -> Cell:
    return Cell(row["setting"], f"{row['controller']} {row['rank']:06}")


_CONTROLLER = Column("controller", lambda row: word(controller_name(row["controller"])))
_FROM = Column("from", lambda row: word(row["from"]))
# The directory's name stands behind the first results: it may be long, and says little.
_RUN = Column("run", lambda row: word(row["run"]))


def _ended(report: Report) -> list[Column]:
    """Return the column that says how runs ended, where one is not done or had incidents."""
    if all(row["ended"] == summary.DONE for row in report.single):
        return []

    def cell(row: Row) -> Cell:
        return Cell(row["ended"], row["ended"], warning=row["ended"] != summary.DONE)

    return [Column("ended", cell)]


def _ratio(rows: Sequence[Row]) -> list[Column]:
    """Return the column of deviations over the least possible, where any is known."""
    known = any(row["ratio"] is not None for row in rows)
    return [Column("over the least possible (1)", lambda row: share(row["ratio"]))] * known


# --- single runs ----------------------------------------------------------------------------------


def _results(report: Report) -> list[Column]:
    """Return the columns of results; facts of windows stand behind the first number.

    A narrow screen would not show it otherwise.
    """
    money = report.assumptions.currency
    return [
        _metric(_METRICS[TOTAL]),
        *_ratio(report.single),
        *map(_fact, report.apart()),
        _RUN,
        _number("near target (h)", "near_target_hours", ".2f"),
        _NEAR,
        *(_metric(metric) for metric in shown_metrics(report) if metric.name not in _ELSEWHERE),
        _number(f"value as mains water ({money})", "water_value"),
        _number(f"cost of electric energy ({money})", "energy_cost"),
        _number("frost (h)", "frost_hours", ".2f"),
        _number("pumped in frost (m³)", "frost_pumped_m3", most=0),
    ]


def _balance(report: Report) -> list[Column]:
    """Return the columns of both tanks' water balance."""

    def metric(name: str, title: str) -> Column:
        return _metric(_METRICS[name], title=title)

    layer = [metric("final_layer_m3", "drainage layer: at the end")]
    return [
        metric("rain_cistern_m3", "cistern: rain"),
        metric("pumped_m3", "pumped"),
        metric("outflow_m3", "to the sewer"),
        _number("cistern: change (m³)", "cistern_change_m3"),
        _number("cistern: unexplained (m³)", "cistern_residual_m3", ".1e"),
        metric("final_cistern_m3", "cistern: at the end"),
        metric("rain_roof_m3", "roof: rain"),
        metric("evapotranspiration_m3", "evapotranspiration"),
        metric("drainage_m3", "drainage"),
        _number("roof: change (m³)", "roof_change_m3"),
        _number("roof: unexplained (m³)", "roof_residual_m3", ".1e"),
        metric("final_roof_m3", "roof: at the end"),
        *(layer if _METRICS["final_layer_m3"] in shown_metrics(report) else []),
        *map(_fact, report.apart()),
        _RUN,
    ]


def _of_runs(report: Report, name: str, columns: Sequence[Column]) -> Table:
    """Return a table with a line a run; of a single one a line a quantity."""
    columns = [_CONTROLLER, Column("setting", _setting), _FROM, *_ended(report), *columns]
    if len(report.single) == 1:
        rows = [[word(column.header), column.cell(report.single[0])] for column in columns]
        return Table(f"{name} of the run", header=(), rows=rows)
    return _table(f"{name} of each run", columns, report.single)


def _best(report: Report, best: Sequence[Row]) -> Table:
    """Return the best run of each controller."""
    window = Column("window", lambda row: word(report.heading(row)))
    return _table("Least total deviation of each controller", [
        _CONTROLLER,
        Column("best setting", lambda row: word(row["setting"])),
        _FROM,
        *_ended(report),
        _metric(_METRICS[TOTAL]),
        *_ratio(report.single),
        *([window] if len(report.windows()) > 1 else []),
        _metric(_METRICS["pumped_m3"]), _metric(_METRICS["max_command"]), _RUN,
    ], best)


def _methods(report: Report) -> list[Table]:
    """Return total deviations under both kinds of evapotranspiration, where there are both."""
    where = [name for name in report.apart() if name != "evapotranspiration"]

    def key(row: Row) -> tuple[object, ...]:
        alike = (row[name] for name in facts(row) if name != "evapotranspiration")
        return *alike, row["from"], row["controller"], *report.runs[row["run"]].parameters.items()

    other = {key(row): row for row in report.single if row["evapotranspiration"] == "fao56"}
    pairs = [
        {**row, "fao56": other[key(row)][TOTAL],
         "more": 100 * (other[key(row)][TOTAL] / row[TOTAL] - 1) if row[TOTAL] else 0.0}
        for row in report.single
        if row["evapotranspiration"] == "published" and key(row) in other
    ]
    if not pairs:
        return []
    return [_table("Total deviation under both kinds of evapotranspiration", [
        Column("setting", lambda row: word(who(row))),
        _FROM, *map(_fact, where),
        _number("published (m³)", TOTAL, ".2f"), _number("fao56 (m³)", "fao56", ".2f"),
        _number("difference (%)", "more", "+.2f"),
    ], pairs)]


def incident_tables(report: Report) -> list[Table]:
    """Return what was lost in the runs while they went on, where there was anything."""
    several = len(report.single) > 1
    rows = [
        [
            Cell(str(incident.number), f"{place:06} {incident.number:06}"),
            *([word(row["run"])] if several else []),
            word(incident.what),
            _moment(report, row, incident.began, incident.began_tick),
            _moment(report, row, incident.ended, incident.ended_tick),
            Cell("unknown", sys.float_info.max, warning=True) if incident.seconds is None
            else number(incident.seconds, ".1f"),
            word(incident.cause),
        ]
        for place, row in enumerate(report.single)
        for incident in report.runs[row["run"]].incidents
    ]
    header = ["incident", *(["run"] if several else []), "part", "from", "until",
              "duration (s of wall time)", "cause"]
    return [Table("Incidents", header, rows)] if rows else []


def _moment(report: Report, row: Row, wall_time: str | None, tick: int | None) -> Cell:
    """Return when something was lost or came back: since the start, or the time of a live site."""
    if wall_time is None:
        return Cell("not over", "~", warning=True)
    if tick is not None:
        return Cell(f"{hours_minutes_seconds(tick * row['tau'])} (tick {tick})", wall_time)
    zone = report.drawn[row["run"]].start.tzinfo
    time = datetime.fromisoformat(wall_time).astimezone(zone)
    return Cell(to_people(time.replace(microsecond=0)), wall_time)


# --- many seeds, and the same season of several years ---------------------------------------------


def _seeds(report: Report) -> list[Table]:
    """Return the results of runs under forecast errors over their seeds, where there are many."""
    cases = report.of(SEEDS)
    amounts = {"mean": TOTAL, "worst tenth": "worst_tenth_m3", "worst": "worst_m3"}

    def over_least(name: str) -> Callable[[Row], Cell]:
        return lambda row: share(row[name] / row["bound_m3"] if row["bound_m3"] else None)

    known = any(row["bound_m3"] for row in cases)
    return [_table("Total deviation under forecast errors, over their seeds", [
        _CONTROLLER, Column("setting", _setting), _number("seeds", "seeds", "d"),
        Column("skill of the forecasts", lambda row: word(row["skill"])),
        *map(_fact, report.apart(SEEDS)), _FROM,
        *(_number(f"{amount} (m³)", name, ".2f") for amount, name in amounts.items()),
        *(Column(f"{amount} over the least (1)", over_least(name))
          for amount, name in amounts.items() if known),
    ], cases)] if cases else []


def _seasons(report: Report) -> list[Table]:
    """Return means and comparisons, or of several cisterns or roofs sizes; none without seasons."""
    cases = report.of(SEASONS)
    if not cases:
        return []
    tables = [_means(report, cases)]
    if report.sizing:
        return tables
    for other, compared in (
        ("on/off", report.over_onoff),
        ("the controller with the least deviation", report.over_least),
    ):
        if compared:
            tables.append(_comparisons(report, other, compared))
    return tables


def _named(report: Report) -> list[Column]:
    return [
        _CONTROLLER, Column("setting", lambda row: word(row["setting"])),
        Column("forecast", lambda row: word(row["forecast"])),
        *map(_fact, report.apart(SEASONS)),
    ]


def _means(report: Report, cases: Sequence[Row]) -> Table:
    """Return the table of means; of sites of several sizes with their sizes."""
    sizes = [
        _number("green roof (m²)", "roof_m2", "g"), _number("cistern (m³)", "cistern_size_m3", "g")
    ]
    return _table("Means of a season", [
        *_named(report),
        *(sizes if report.sizing else []),
        _number("years", "years", "d"), _number("seeds", "seeds", "d"),
        _metric(_METRICS[TOTAL], ".0f"),
        *_ratio(cases),
        _number("worst year (m³)", "worst_year_m3", ".0f"), _number("which", "worst_year", "d"),
        _number("worst tenth of weeks, of a week (m³)", "worst_tenth_m3", ".0f"),
        _NEAR,
        *(
            _metric(_METRICS[name], _MEAN_FORMS.get(name, ""))
            for name in _MEANS if any(row[name] is not None for row in cases)
        ),
    ], cases)


def _comparisons(report: Report, other: str, compared: Sequence[Row]) -> Table:
    """Return what each has over another."""

    def interval(title: str, of: Callable[[Comparison], Ratio]) -> list[Column]:
        return [
            Column(title, lambda row: number(of(row["has"]).value, ".3f")),
            Column("95 % from", lambda row: number(of(row["has"]).low, ".3f")),
            Column("to", lambda row: number(of(row["has"]).high, ".3f")),
        ]

    return _table(
        f"Deviation relative to {other} ({len(compared)} compared, each interval for one)", [
            *_named(report),
            Column("over", lambda row: word(f"{who(row['than'])} {row['than']['forecast']}")),
            Column("years with less deviation", lambda row: Cell(
                f"{row['has'].better} of {row['has'].years}", row["has"].better)),
            Column("more or less (m³)", lambda row: number(row["has"].difference, "+.0f")),
            Column("interval", lambda row: word(row["has"].mean.verdict)),
            *interval("deviation of a season, over (1)", lambda has: has.mean),
            Column("interval of worst weeks", lambda row: word(row["has"].worst_weeks.verdict)),
            *interval("worst tenth of weeks, over (1)", lambda has: has.worst_weeks),
        ], compared,
    )
