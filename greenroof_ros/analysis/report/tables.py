"""The tables of the report's page."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import NamedTuple

from greenroof_ros.analysis.report.groups import (
    SEASONS,
    SEEDS,
    SINGLE,
    TOTAL,
    Report,
    facts,
    heading,
    who,
)
from greenroof_ros.analysis.report.intervals import Ratio
from greenroof_ros.analysis.report.run import Row
from greenroof_ros.common.times import hours_minutes_seconds, to_people
from greenroof_ros.experiment import summary
from greenroof_ros.model.metrics import METRICS, Metric

_METRICS = {metric.name: metric for metric in METRICS}

# The results of single runs, by the table that shows them; a page has room for a dozen columns.
_RESULTS = {
    "deviation": ("near_target_hours", "near_percent", "mean_deviation_mm"),
    "plants and rain": (
        "stress_hours", "evapotranspiration_ratio", "rain_kept_share", "rain_kept_share_hour",
        "rain_kept_share_day",
    ),
    "pump and water": (
        "pumped_m3", "mains_m3", "saved_m3", "water_value", "max_command", "beyond_hours",
        "limited_steps", "frost_hours", "frost_pumped_m3",
    ),
    "starts and energy": (
        "pump_starts", "busiest_hour_starts", "excess_starts", "pump_hours",
        "hydraulic_energy_kwh", "electric_energy_kwh", "energy_cost",
    ),
}
# Means of a season, with the number format if it is not the metric's.
_MEANS = {
    "plants and rain": {
        "stress_hours": ".1f", "evapotranspiration_ratio": "", "rain_kept_share": "",
        "rain_kept_share_hour": "", "rain_kept_share_day": "", "drainage_m3": ".2f",
    },
    "pump and water": {
        "saved_m3": ".2f", "mains_m3": ".2f", "pumped_m3": ".2f", "outflow_m3": ".2f",
        "electric_energy_kwh": ".3g", "pump_starts": ".0f",
    },
}


class Cell(NamedTuple):
    """A cell of a table: the text that is shown, and the key that the table is sorted by."""

    text: str
    key: float | str
    warning: bool = False


class ReportTable(NamedTuple):
    """A table that a reader can sort; the first column names the row.

    A table without a header has one quantity of the only run in each row.
    """

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    folded: bool = False
    """whether the page folds it away, because another table summarises it"""


class Column(NamedTuple):
    """A column of a table."""

    header: str
    name: str
    """key of its values in a row"""
    form: str = ".4g"
    """format of its numbers"""
    most: float = math.inf
    """larger values are shown as a warning"""


def cell(value: float | str | Cell | None, form: str = ".4g", most: float = math.inf) -> Cell:
    """Return the cell of a value; ``none`` if a run lacks the quantity, such as a storm's."""
    if isinstance(value, Cell):
        return value
    if isinstance(value, str):
        return Cell(value, value)
    if value is None:
        return Cell("none", -1.0)
    value = int(value) if form == "d" else value
    text = f"{value:{form}}"
    return Cell("0" if float(text.rstrip("%")) == 0 else text, value, value > most)


def share(value: float | None) -> Cell:
    """Return the cell of a ratio; unknown ratios are sorted last."""
    return Cell("unknown", sys.float_info.max) if value is None else cell(value, ".4f")


def make_tables(report: Report) -> list[ReportTable]:
    """Return the tables for which a report has data."""
    tables = [*_seasons(report), *_seeds(report)]
    single, best = report.single, report.best()
    several = len(single) > len(best)
    if several:
        tables.append(_best(report, best))
    tables += _methods(report)
    if single:
        tables += [
            *(_of_runs(report, name, columns, folded=several)
              for name, columns in _results(report).items()),
            *(_of_runs(report, name, columns, folded=True)
              for name, columns in _balances(report).items()),
        ]
    return tables


def _table(
    report: Report, name: str, columns: Sequence[Column], rows: Iterable[Row], **folded: bool
) -> ReportTable:
    """Return a table of rows, which are runs or cases."""
    return ReportTable(
        name, [column.header for column in columns],
        [_cells(report, row, columns) for row in rows], **folded,
    )


def _cells(report: Report, row: Row, columns: Sequence[Column]) -> list[Cell]:
    """Return the cells of a run or a case; controllers are sorted by their settings' values."""
    apart = report.differing_facts(row["kind"])
    near, ended, unknown = row["near_share"], row["ended"], Cell("unknown", -1.0)
    shown = {
        **row,
        "controller": Cell(who(row), f"{row['rank']:06}"),
        "window": heading(row, apart, apart) if apart else "",
        "ended": Cell(ended, ended, warning=ended != summary.DONE),
        "near_target_hours": unknown if near is None else row["near_target_hours"],
        "near_percent": unknown if near is None else 100 * near,
        "ratio": share(row["ratio"]),
    }
    return [cell(shown[column.name], column.form, column.most) for column in columns]


# --- columns --------------------------------------------------------------------------------------

_CONTROLLER, _FROM = Column("controller", "controller"), Column("from", "from")
# Placed after the first results: a directory's name can be long and uninformative.
_RUN = Column("run", "run")
_NEAR = Column("near target (%)", "near_percent", ".1f")


def _window(report: Report, kind: str = SINGLE) -> list[Column]:
    """Return the column that names the windows of a kind, if there are several."""
    return [Column("window", "window")] * (len(report.windows(kind)) > 1)


def _metric(name: str, form: str = "", title: str = "") -> Column:
    """Return the column of a metric; its header has the unit unless the numbers have a %."""
    metric = _METRICS[name]
    header = title or metric.label
    if not metric.form.endswith("%"):
        header += f" ({unit(metric)})"
    return Column(header, name, form or metric.form, metric.most)


def unit(metric: Metric) -> str:
    """Return a metric's unit, with m³ for m3."""
    return metric.unit.replace("m3", "m³")


def shown_metrics(report: Report) -> list[Metric]:
    """Return the metrics that at least one single run has."""
    return [
        metric for metric in METRICS if any(row[metric.name] is not None for row in report.single)
    ]


def _ended(report: Report) -> list[Column]:
    """Return the column on how runs ended, if a run is unfinished or had incidents."""
    done = all(row["ended"] == summary.DONE for row in report.single)
    return [Column("ended", "ended")] * (not done)


def _ratio(rows: Sequence[Row]) -> list[Column]:
    """Return the column of deviations over the minimum possible, if any is known."""
    known = any(row["ratio"] is not None for row in rows)
    return [Column("over the minimum possible (1)", "ratio")] * known


# --- single runs ----------------------------------------------------------------------------------


def _results(report: Report) -> dict[str, list[Column]]:
    """Return the columns of each table of results.

    The window follows the first numbers, so that a narrow screen shows a result.
    """
    money = report.assumptions.currency
    columns = {
        **{metric.name: _metric(metric.name) for metric in shown_metrics(report)},
        "near_target_hours": Column("near target (h)", "near_target_hours", ".2f"),
        "near_percent": _NEAR,
        "water_value": Column(f"value as mains water ({money})", "water_value"),
        "energy_cost": Column(f"cost of electric energy ({money})", "energy_cost"),
        "frost_hours": Column("frost (h)", "frost_hours", ".2f"),
        "frost_pumped_m3": Column("pumped in frost (m³)", "frost_pumped_m3", most=0),
    }
    tables = {
        name: [*_window(report), *(columns[result] for result in results if result in columns)]
        for name, results in _RESULTS.items()
    }
    first = "deviation"
    tables[first] = [_metric(TOTAL), *_ratio(report.single), *tables[first], _RUN]
    return tables


def _balances(report: Report) -> dict[str, list[Column]]:
    """Return the columns of each tank's water balance."""
    layer = [_metric("final_layer_m3", title="drainage layer: at the end")]
    return {
        "water balance of the cistern": [
            _metric("rain_cistern_m3", title="rain"),
            _metric("pumped_m3", title="pumped"),
            _metric("outflow_m3", title="to the sewer"),
            Column("change (m³)", "cistern_change_m3"),
            Column("unexplained (m³)", "cistern_residual_m3", ".1e"),
            _metric("final_cistern_m3", title="at the end"),
            *_window(report),
        ],
        "water balance of the roof": [
            _metric("rain_roof_m3", title="rain"),
            _metric("pumped_m3", title="pumped"),
            _metric("evapotranspiration_m3", title="evapotranspiration"),
            _metric("drainage_m3", title="drainage"),
            Column("change (m³)", "roof_change_m3"),
            Column("unexplained (m³)", "roof_residual_m3", ".1e"),
            _metric("final_roof_m3", title="at the end"),
            *(layer if _METRICS["final_layer_m3"] in shown_metrics(report) else []),
            *_window(report),
        ],
    }


def _of_runs(report: Report, name: str, columns: Sequence[Column], *, folded: bool) -> ReportTable:
    """Return a table with a row for each run, or for each quantity if there is a single run."""
    title = f"{name[0].upper()}{name[1:]}"
    columns = [_CONTROLLER, _FROM, *_ended(report), *columns]
    table = _table(report, f"{title}, each run", columns, report.single, folded=folded)
    if len(report.single) > 1:
        return table
    rows = [[cell(header), value] for header, value in zip(table.header, *table.rows, strict=True)]
    return ReportTable(title, (), rows, folded)


def _best(report: Report, best: Sequence[Row]) -> ReportTable:
    """Return the table of each controller's best run."""
    return _table(report, "Smallest total deviation of each controller", [
        _CONTROLLER, _FROM, *_ended(report), _metric(TOTAL), *_ratio(report.single),
        *_window(report), _metric("pumped_m3"), _metric("max_command"), _RUN,
    ], best)


def _methods(report: Report) -> list[ReportTable]:
    """Return the table of total deviations under both kinds of evapotranspiration, if any."""
    where = [name for name in report.differing_facts() if name != "evapotranspiration"]
    windows = [Column("window", "where")] * bool(where)

    def key(row: Row) -> tuple[object, ...]:
        alike = (row[name] for name in facts(row) if name != "evapotranspiration")
        return *alike, row["from"], row["controller"], *report.runs[row["run"]].parameters.items()

    other = {
        key(row): row[TOTAL] for row in report.single if row["evapotranspiration"] == "fao56"
    }
    pairs = [
        {**row, "where": heading(row, where, where) if where else "", "fao56": other[key(row)],
         "more": 100 * (other[key(row)] / row[TOTAL] - 1) if row[TOTAL] else 0.0}
        for row in report.single
        if row["evapotranspiration"] == "published" and key(row) in other
    ]
    return [_table(report, "Total deviation under both kinds of evapotranspiration", [
        _CONTROLLER, _FROM, *windows,
        Column("published (m³)", TOTAL, ".2f"), Column("fao56 (m³)", "fao56", ".2f"),
        Column("difference (%)", "more", "+.2f"),
    ], pairs)] if pairs else []


def incident_tables(report: Report) -> list[ReportTable]:
    """Return the table of incidents of single runs, if there were any."""
    unknown = Cell("unknown", sys.float_info.max, warning=True)
    rows = [
        {
            "incident": Cell(str(incident.number), f"{place:06} {incident.number:06}"),
            "run": cell(row["run"]), "part": cell(incident.subject),
            "from": _moment(report, row, incident.began, incident.began_tick),
            "until": _moment(report, row, incident.ended, incident.ended_tick),
            "duration (s of wall time)":
            unknown if incident.seconds is None else cell(incident.seconds, ".1f"),
            "cause": cell(incident.cause),
        }
        for place, row in enumerate(report.single)
        for incident in report.runs[row["run"]].incidents
    ]
    for row in rows if len(report.single) == 1 else []:
        del row["run"]
    if not rows:
        return []
    return [ReportTable("Incidents", list(rows[0]), [list(row.values()) for row in rows])]


def _moment(report: Report, row: Row, wall_time: str | None, tick: int | None) -> Cell:
    """Return when an incident began or ended: time since the start, or local time if live."""
    if wall_time is None:
        return Cell("not over", "~", warning=True)
    if tick is not None:
        return Cell(f"{hours_minutes_seconds(tick * row['tau'])} (tick {tick})", wall_time)
    zone = report.drawn[row["run"]].start.tzinfo
    time = datetime.fromisoformat(wall_time).astimezone(zone)
    return Cell(to_people(time.replace(microsecond=0)), wall_time)


# --- many seeds, and the same season of several years ---------------------------------------------


def _seeds(report: Report) -> list[ReportTable]:
    """Return the table of runs under forecast errors, over their seeds, if there are any."""
    cases = report.of(SEEDS)
    amounts = {"mean": TOTAL, "worst tenth": "worst_tenth_m3", "worst": "worst_m3"}
    known = amounts if any(row["bound_m3"] for row in cases) else {}
    for row in cases:
        for amount, name in known.items():
            row[amount] = share(row[name] / row["bound_m3"] if row["bound_m3"] else None)
    return [_table(report, "Total deviation under forecast errors, over their seeds", [
        _CONTROLLER, _FROM, *_window(report, SEEDS), Column("seeds", "seeds", "d"),
        Column("skill of the forecasts", "skill"),
        *(Column(f"{amount} (m³)", name, ".2f") for amount, name in amounts.items()),
        *(Column(f"{amount} over the minimum (1)", amount) for amount in known),
    ], cases)] if cases else []


def _seasons(report: Report) -> list[ReportTable]:
    """Return the seasons' means and, unless they compare sizes, comparisons of controllers."""
    cases = report.of(SEASONS)
    if not cases:
        return []
    tables = _means(report, cases)
    for other, compared in (
        ("on/off", report.relative_to_onoff),
        ("the controller with the smallest deviation", report.relative_to_best),
    ):
        if compared and not report.sizing:
            tables.append(_comparisons(report, other, compared))
    return tables


def _named(report: Report) -> list[Column]:
    return [_CONTROLLER, Column("forecast", "forecast"), *_window(report, SEASONS)]


def _means(report: Report, cases: Sequence[Row]) -> list[ReportTable]:
    """Return the tables of means, with sizes if the sites differ in size."""
    sizes = [
        Column("green roof (m²)", "roof_m2", "g"), Column("cistern (m³)", "cistern_size_m3", "g")
    ]
    named = [*_named(report), *(sizes if report.sizing else [])]
    columns = {"deviation": [
        Column("years", "years", "d"), Column("fewest seeds in a year", "seeds", "d"),
        _metric(TOTAL, ".0f"),
        *_ratio(cases),
        Column("worst year (m³)", "worst_year_m3", ".0f"), Column("which", "worst_year", "d"),
        Column("worst tenth of weeks (m³)", "worst_tenth_m3", ".0f"),
        _NEAR, *_present_columns({"mean_deviation_mm": ".2f"}, cases),
    ]} | {name: _present_columns(metrics, cases) for name, metrics in _MEANS.items()}
    return [
        _table(report, f"Means of a season: {name}", [*named, *results], cases)
        for name, results in columns.items() if results
    ]


def _present_columns(metrics: Mapping[str, str], rows: Sequence[Row]) -> list[Column]:
    """Return the columns of the metrics that at least one row has."""
    return [
        _metric(name, form) for name, form in metrics.items()
        if any(row[name] is not None for row in rows)
    ]


def _comparisons(report: Report, other: str, compared: Sequence[Row]) -> ReportTable:
    """Return the table of comparisons with one other controller."""
    rows = []
    for row in compared:
        has, than = row["has"], row["than"]
        rows.append({
            **row, "over": f"{who(than)} {than['forecast']}", "difference": has.difference,
            "fewer": Cell(f"{has.better} of {has.years}", has.better),
            "value": has.mean.value, "interval": _interval(has.mean),
            "worst value": has.worst_weeks.value, "worst interval": _interval(has.worst_weeks),
        })
    return _table(
        report, f"Deviation relative to {other}", [
            *_named(report), Column("over", "over"),
            Column("years with less deviation", "fewer"),
            Column("more or less (m³)", "difference", "+.0f"),
            Column("deviation of a season, over (1)", "value", ".3f"),
            Column("95 % interval", "interval"),
            Column("worst tenth of weeks, over (1)", "worst value", ".3f"),
            Column("95 % interval", "worst interval"),
        ], rows,
    )


def _interval(ratio: Ratio) -> Cell:
    return Cell(f"{ratio.low:.3f} to {ratio.high:.3f}", ratio.low)
