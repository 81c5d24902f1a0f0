"""The figures of results, and which figures a report has; one specification makes page, PNG, SVG.

Here the rows or the x axis of a panel are runs, the skill of forecasts, years, or sizes of a
cistern. Trajectories and weather have their own module.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from typing import NamedTuple

import altair as alt
import polars as pl

from greenroof_ros.analysis.report.drawing import (
    COLOURS,
    SHAPES,
    Chart,
    Figure,
    Panel,
    Rows,
    cycled,
    distinct,
    pointed,
    short,
    value_axis,
)
from greenroof_ros.analysis.report.groups import (
    SEASONS,
    SEEDS,
    SKY,
    TOTAL,
    Report,
    by_place,
    heading,
    unique,
    who,
)
from greenroof_ros.analysis.report.run import NO_ERRORS, Row, controller_name
from greenroof_ros.analysis.report.trajectories import trajectories, weather
from greenroof_ros.common.files import shared_directory
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.model.site import PLACE, read_site

_PAPER_START = datetime.fromisoformat("2021-07-07T02:00-05:00")
_PAPER_HOURS = 12.0
_PAPERS_PARAMETER = {"mpc": "weight", "onoff": "fraction"}
_HEIGHT = 260
# Height of a row with its name above its mark (px).
_NAMED_ROW = 45
_PIXELS = 300
_TOTAL_AXIS = "total |x2 - x2*| (m³)"


class Criterion(NamedTuple):
    """A quantity by which runs are compared, setting by setting."""

    name: str
    title: str
    axis: str
    column: str
    times: float = 1.0
    step: float = 0.0
    """minimum distance of an axis' ticks"""


CRITERIA = (
    Criterion("total-deviation", "Total deviation", _TOTAL_AXIS, TOTAL),
    Criterion("time-in-band", "Time near the target", "time in the band (h)", "near_target_hours"),
    Criterion("energy", "Electric energy", "electric energy (Wh)", "electric_energy_kwh", 1000),
    Criterion("pump-starts", "Pump starts", "starts", "pump_starts", step=1.0),
)

# The names of all figures begin with one of these; numbers can follow.
_KINDS = (
    *(criterion.name for criterion in CRITERIA), "weather", "trajectories", "water-balance",
    "forecast-errors", "seasons", "season-comparisons", "sizing",
)


def is_figure(name: str) -> bool:
    """Whether a file has the name of a figure in a report."""
    return re.fullmatch(rf"({'|'.join(_KINDS)})(-\d+)*\.(svg|png)", name) is not None


def make_figures(report: Report) -> Iterator[Figure]:
    """Yield the figures, in the order in which they appear."""
    windows = [
        (number, [row for row in report.single if row["window"] == window["window"]])
        for number, window in enumerate(report.windows(), start=1)
    ]
    recorded = [
        (number, [row for row in rows if row["run"] in report.drawn]) for number, rows in windows
    ]
    # Windows that differ only in evapotranspiration share a figure of the weather.
    skies: dict[tuple[str, ...], dict[str, Row]] = {}
    for _, rows in recorded:
        for row in rows[:1]:
            of = skies.setdefault(tuple(row[name] for name in SKY), {})
            of.setdefault(row["evapotranspiration"], row)
    for number, methods in enumerate(skies.values(), start=1):
        yield weather(report, list(methods.values()), number)
    for number, rows in windows:
        # With a single mark in each panel the figure would only repeat the table.
        if len({row["controller"] for row in rows}) < len(rows):
            for criterion in CRITERIA:
                known = [row for row in rows if row[criterion.column] is not None]
                if known:
                    yield by_setting(report, known, number, criterion)
    for number, rows in recorded:
        for initial in report.initials:
            of_state = [row for row in rows if row["from"] == initial]
            if of_state:
                yield trajectories(report, of_state, number)
    for number, rows in windows:
        yield balance(report, rows, number)
    if report.of(SEEDS):
        yield forecast_errors(report)
    if report.sizing:
        yield sizing(report)
    elif report.of(SEASONS):
        yield by_year(report)
        if report.relative_to_onoff:
            yield comparison_figure(report)


# --- single runs ----------------------------------------------------------------------------------


def by_setting(report: Report, rows: Sequence[Row], number: int, criterion: Criterion) -> Figure:
    """Return a criterion of each run: a panel for each initial state, with a scale of its own.

    Args:
        report: all results.
        rows: runs of a window for which the criterion is known.
        number: of the window.
        criterion: to draw.
    """
    published = published_totals(report, rows) if criterion.column == TOTAL else {}
    controllers = list(map(controller_name, report.controllers))
    panels, marks = list[Panel](), set[str]()
    data: dict[str, Rows] = {}
    for initial in report.initials:
        here = sorted((row for row in rows if row["from"] == initial), key=lambda row: row["rank"])
        if not here:
            continue
        names = unique(here, list(map(who, here)))
        bound = here[0]["bound_m3"] if criterion.column == TOTAL else None
        drawn: Rows = [
            {"setting": name, "run": row["run"], "controller": controller_name(row["controller"]),
             "v": short(criterion.times * row[criterion.column])}
            for name, row in zip(names, here, strict=True)
        ]
        theirs: Rows = [
            {"setting": name, "v": published[row["run"]]}
            for name, row in zip(names, here, strict=True) if row["run"] in published
        ]
        values = [*(row["v"] for row in (*drawn, *theirs)), *([bound] if bound is not None else [])]
        dataset = f"{criterion.name}-{number}-{len(panels) + 1}"
        data[dataset] = drawn
        x = alt.X(
            "v:Q", title=criterion.axis, **{"axis": alt.Axis(tickMinStep=criterion.step)}
            | value_axis(values),
        )
        y = alt.Y("setting:N", sort=names, title=None, axis=alt.Axis(labelLimit=190))
        layers: list[Chart] = [
            alt.Chart(alt.NamedData(dataset)).mark_point(filled=True, opacity=1, size=60).encode(
                x=x, y=y,
                color=alt.Color(
                    "controller:N", scale=cycled(COLOURS, controllers), legend=None
                ),
                tooltip=pointed("run:N", "setting:N", ("v:Q", criterion.axis)),
            )
        ]
        if bound is not None:
            marks.add("dashed: the minimum possible")
            layers.insert(0, _least(bound, x=x))
        if theirs:
            marks.add("hollow: the authors' code")
            layers.append(
                alt.Chart(alt.InlineData(theirs)).mark_point(
                    filled=False, size=240, strokeWidth=1.5, color="#555555"
                ).encode(x=x, y=y, tooltip=pointed(
                    alt.Tooltip("v:Q", title="authors' code", format=".8~g")
                ))
            )
        panels.append(Panel(
            alt.layer(*layers), f"from {initial}", max(60, 18 * len(here))
        ))
    return Figure(
        f"{criterion.name}-{number}", report.title(criterion.title, rows[0]), _named(marks),
        tuple(panels), min(len(panels), 3), data,
    )


def _named(marks: Iterable[str]) -> str:
    """Return a caption that names these marks, which may be none."""
    text = "; ".join(sorted(marks))
    return f"{text[:1].upper()}{text[1:]}"


def _least(bound: float, **channel: alt.X | alt.Y) -> Chart:
    """Return the line of the minimum possible deviation (m3), along x or y."""
    rule: Chart = alt.Chart(alt.InlineData([{"v": short(bound)}])).mark_rule(
        strokeDash=[6, 3], color="black"
    ).encode(**channel, tooltip=pointed(("v:Q", "minimum possible (m³)")))
    return rule


def published_totals(report: Report, rows: Sequence[Row]) -> dict[str, float]:
    """Return the authors' totals by run if a window is the paper's, or else none."""
    row, config = rows[0], shared_directory() / "config"
    site, papers = report.runs[row["run"]].site, read_site(config / "site.yaml")
    # All but the place, with its climate and clock, which published evapotranspiration replaces.
    place = (*PLACE, "monthly_evapotranspiration", "time_zone")
    if (
        row["evapotranspiration"] != "published"
        or datetime.fromisoformat(row["start"]) != _PAPER_START or row["hours"] != _PAPER_HOURS
        or row["forecast"] != PERFECT or row["sensor and pump errors"] != NO_ERRORS
        or replace(site, **{name: getattr(papers, name) for name in place}) != papers
    ):
        return {}
    totals = {
        (controller, initial, setting): total for controller, setting, initial, total in
        pl.read_csv(config / "paper" / "totals.csv").select(
            "controller", "parameter", "initial", "total_deviation_m3"
        ).with_columns(pl.col("parameter").cast(pl.Float64)).iter_rows()
    }
    keys = {
        row["run"]: (
            row["controller"], row["from"],
            report.runs[row["run"]].parameters.get(report.settings[row["controller"]].title),
        )
        for row in rows
        if report.settings[row["controller"]].title == _PAPERS_PARAMETER.get(row["controller"])
        and not report.runs[row["run"]].changes
    }
    return {run: totals[key] for run, key in keys.items() if key in totals}


_TERMS = {
    "rain": "#56B4E9",
    "pumped": "#0072B2",
    "evapotranspiration": "#009E73",
    "drainage": "#000000",
    "outflow": "#999999",
}
# By tank: inflows are positive.
_BALANCE = {
    "Cistern": {"rain": "rain_cistern_m3", "pumped": "-pumped_m3", "outflow": "-outflow_m3"},
    "Green roof": {
        "rain": "rain_roof_m3", "pumped": "pumped_m3",
        "evapotranspiration": "-evapotranspiration_m3", "drainage": "-drainage_m3",
    },
}


def balance(report: Report, rows: Sequence[Row], number: int) -> Figure:
    """Return the figure of both tanks' water balance: a row of panels for each initial state."""
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    for initial in report.initials:
        here = sorted((row for row in rows if row["from"] == initial), key=lambda row: row["rank"])
        names = unique(here, list(map(who, here)))
        for tank, parts in _BALANCE.items() if here else ():
            dataset = f"balance-{number}-{tank.split()[-1].lower()}-{len(panels) // 2 + 1}"
            bars_of_runs: list[Rows] = [
                [{"run": name, "term": term, "v": short(
                    (-1 if column.startswith("-") else 1) * (row[column.removeprefix("-")] or 0.0)
                )} for term, column in parts.items()]
                for name, row in zip(names, here, strict=True)
            ]
            data[dataset] = list(itertools.chain(*bars_of_runs))
            # A thinner bar than a pixel has no entry in the legend.
            longest = max(sum(abs(row["v"]) for row in bars) for bars in bars_of_runs)
            drawn = {
                str(row["term"]) for bars in bars_of_runs for row in bars
                if abs(row["v"]) > longest / _PIXELS
            }
            chart = alt.Chart(alt.NamedData(dataset)).mark_bar(
                stroke="white", strokeWidth=0.5
            ).encode(
                x=alt.X("v:Q", title="in (+) and out (-) (m³)", axis=alt.Axis(tickCount=5)),
                y=alt.Y("run:N", sort=names, title=None, axis=alt.Axis(labelLimit=190)),
                color=alt.Color("term:N", title=None, scale=cycled(
                    [_TERMS[term] for term in parts], list(parts), drawn
                )),
                tooltip=pointed("run:N", "term:N", ("v:Q", "m³")),
            )
            panels.append(Panel(
                chart, f"{tank}, from {initial}", max(60, 17 * len(here)),
                toggle="term" if drawn else "",
            ))
    return Figure(
        f"water-balance-{number}", report.title("Water balance", rows[0]), "", tuple(panels), 2,
        data,
    )


# --- many seeds -----------------------------------------------------------------------------------

_AMOUNTS = {"mean": TOTAL, "mean of the worst tenth": "worst_tenth_m3"}


def forecast_errors(report: Report) -> Figure:
    """Return the figure of total deviation, mean and worst tenth, over the skill of forecasts."""
    cases, apart = report.of(SEEDS), report.differing_facts(SEEDS)
    panels, data = [], {}
    for number, here in enumerate(by_place(cases), start=1):
        dataset = f"forecast-errors-{number}"
        data[dataset] = [
            {"series": who(row), "skill": row["skill"], "amount": amount,
             "v": short(row[column]), "seeds": row["seeds"]}
            for row in here for amount, column in _AMOUNTS.items()
        ]
        where = heading(here[0], apart, apart)
        initial = f"from {here[0]['from']}"
        panels.append(Panel(
            _errors_chart(report, here, dataset), [where, initial] if apart else initial,
            height=_HEIGHT, toggle="series",
        ))
    marks = {"filled, solid: mean", "hollow, dashed: mean of the worst tenth"}
    if any(row["bound_m3"] for row in cases):
        marks.add("dashed, black: the minimum possible")
    return Figure(
        "forecast-errors", "Deviation under forecast errors", _named(marks), tuple(panels),
        min(len(panels), 3), data,
    )


def _errors_chart(report: Report, cases: Sequence[Row], dataset: str) -> Chart:
    """Return a panel's chart: lines and marks of each series, and the minimum deviation."""
    bounds = sorted({row["bound_m3"] for row in cases if row["bound_m3"] is not None})
    values = [*bounds, *(row[column] for row in cases for column in _AMOUNTS.values())]
    skills = dict.fromkeys(
        row["skill"] for row in sorted(report.of(SEEDS), key=lambda row: row["skill rank"])
    )
    x = alt.X("skill:O", title="skill of the forecasts", sort=list(skills),
              axis=alt.Axis(labelAngle=0))
    y = alt.Y("v:Q", title=_TOTAL_AXIS, **value_axis(values))
    # Colours show the controller, shapes its setting.
    named = {who(row): row["controller"] for row in cases}
    colours = dict(zip(report.controllers, itertools.cycle(COLOURS)))
    shapes = {name: itertools.cycle(SHAPES) for name in report.controllers}
    colour = alt.Color("series:N", title=None, legend=alt.Legend(columns=2), scale=alt.Scale(
        domain=list(named), range=[colours[name] for name in named.values()],
    ))
    shape = alt.Shape("series:N", title=None, scale=alt.Scale(
        domain=list(named), range=[next(shapes[name]) for name in named.values()],
    ))
    layers = [_least(bound, y=y) for bound in bounds]
    tooltip = pointed(
        ("series:N", "controller"), ("skill:N", "skill"), ("amount:N", "of the seeds"), "seeds:Q",
        ("v:Q", _TOTAL_AXIS),
    )
    base = alt.Chart(alt.NamedData(dataset))
    for amount, filled, dash in zip(_AMOUNTS, (True, False), ([1, 0], [4, 3]), strict=True):
        part = base.transform_filter(alt.datum.amount == amount)
        layers += [
            part.mark_line(strokeWidth=1.5, strokeDash=dash).encode(x=x, y=y, color=colour),
            part.mark_point(filled=filled, size=70, opacity=1).encode(
                x=x, y=y, color=colour, shape=shape, tooltip=tooltip
            ),
        ]
    return alt.layer(*layers)


# --- the same season of several years -------------------------------------------------------------


def _places(report: Report, rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield the cases of each place, with the facts that distinguish it from other places."""
    apart = report.differing_facts(SEASONS)
    for here in by_place(rows):
        yield ", ".join(here[0][name] for name in apart) or "all years", here


def _series(row: Row, rows: Sequence[Row]) -> str:
    """Name a controller, with its setting and its forecasts if it has several of them."""
    own = [other for other in rows if other["controller"] == row["controller"]]
    name = controller_name(row["controller"])
    if len({other["setting"] for other in own}) > 1:
        name += f" {row['setting']}"
    if len({other["forecast"] for other in own}) > 1:
        name += f", {row['forecast']}"
    return name


def by_year(report: Report) -> Figure:
    """Return the figure of each year's deviation: a panel for each place and kind of forecast."""
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    cases, forecasting = report.of(SEASONS), report.with_forecast_errors
    usual = list(dict.fromkeys(
        row["forecast"] for row in cases if row["controller"] in forecasting
    ))
    for place, here in _places(report, cases):
        for forecast in usual or [""]:
            shown = [
                row for row in here
                if row["controller"] not in forecasting or row["forecast"] == forecast
            ]
            name = f"seasons-{len(data) + 1}"
            data[name] = [
                {"series": _series(row, shown), "year": year, "v": short(float(totals.mean())),
                 "minimum": short(float(totals.min())), "largest": short(float(totals.max()))}
                for row in shown for year, totals in report.years(row)
            ]
            series = list(dict.fromkeys(row["series"] for row in data[name]))
            chart = alt.Chart(alt.NamedData(name)).mark_line(point=True).encode(
                x=alt.X("year:O", title=None, axis=alt.Axis(labelAngle=0)),
                y=alt.Y(
                    "v:Q", title="total |x2 - x2*| of the season (m³)",
                    **value_axis([row["v"] for row in data[name]]),
                ),
                **distinct("series", series, ""),
                tooltip=pointed("series:N", "year:O", "v:Q", "minimum:Q", "largest:Q"),
            )
            title = [place, *([f"forecasts: {forecast}"] if forecast else [])]
            panels.append(Panel(chart, title, height=_HEIGHT, toggle="series"))
    return Figure(
        "seasons", "Deviation of each season", "", tuple(panels), max(1, min(len(usual), 3)), data,
    )


def comparison_figure(report: Report) -> Figure:
    """Return the figure of deviations relative to on/off with intervals, a panel for each place."""
    cases = report.of(SEASONS)
    names = list(map(controller_name, report.controllers))
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    for place, here in _places(report, report.relative_to_onoff):
        name = f"season-comparisons-{len(data) + 1}"
        data[name] = [
            {
                "series": _series(row, cases), "controller": controller_name(row["controller"]),
                "v": short(ratio.value), "low": short(ratio.low), "high": short(ratio.high),
            }
            for row in here for ratio in [row["has"].mean]
        ]
        order = [str(row["series"]) for row in data[name]]
        ends = [row[end] for row in data[name] for end in ("low", "high", "v")]
        base = alt.Chart(alt.NamedData(name)).encode(
            # Each name stands above its interval: next to it there is no room on a phone.
            y=alt.Y("series:N", sort=order, title=None, axis=alt.Axis(
                labelAlign="left", labelPadding=-4, labelOffset=-13, labelLimit=400, domain=False,
                ticks=False,
            )),
            color=alt.Color("controller:N", scale=cycled(COLOURS, names), legend=None),
            tooltip=pointed("series:N", "v:Q", "low:Q", "high:Q"),
        )
        intervals = base.mark_rule(strokeWidth=2).encode(
            x=alt.X(
                "low:Q", title="deviation of a season relative to on/off (1)",
                **value_axis([1.0, *ends]),
            ),
            x2=alt.X2("high:Q"),
        )
        marks = base.mark_point(filled=True, size=70, opacity=1).encode(x=alt.X("v:Q"))
        line = alt.Chart(alt.InlineData(values=[{"x": 1}])).mark_rule().encode(x=alt.X("x:Q"))
        panels.append(Panel(
            alt.layer(line, intervals, marks), place, height=_NAMED_ROW * len(order),
        ))
    return Figure(
        "season-comparisons", "Deviation relative to on/off",
        "Lines: 95 % intervals",
        tuple(panels), 1, data,
    )


def sizing(report: Report) -> Figure:
    """Return water saved over the cistern's volume and over overflow, for each roof area."""
    cases = report.of(SEASONS)
    data: dict[str, Rows] = {}
    upper, lower = [], []
    apart = len({row["from"] for row in cases}) > 1

    def named(row: Row) -> str:
        return _series(row, cases) + (f", from {row['from']}" if apart else "")

    series = list(dict.fromkeys(map(named, cases)))
    for area in sorted({row["roof_m2"] for row in cases}):
        name = f"sizing-{len(data) + 1}"
        here = [row for row in cases if row["roof_m2"] == area]
        data[name] = [
            {
                "series": named(row), "volume": short(row["cistern_size_m3"]),
                "saved": short(row["saved_m3"]), "overflow": short(row["outflow_m3"]),
            }
            for row in sorted(here, key=lambda row: row["cistern_size_m3"])
        ]
        base = alt.Chart(alt.NamedData(name)).encode(
            **distinct("series", series, "", {str(row["series"]) for row in data[name]}),
            tooltip=pointed("series:N", "volume:Q", "saved:Q", "overflow:Q"),
        )
        title = f"green roof of {area:g} m²"
        volumes = sorted({row["volume"] for row in data[name]})
        saved = base.mark_line(point=True).encode(
            x=alt.X("volume:Q", title="cistern up to its outlet (m³)",
                    axis=alt.Axis(values=volumes), scale=alt.Scale(type="log", nice=False)),
            y=alt.Y("saved:Q", title="mains water saved (m³ a season)"),
        )
        traded = base.mark_line(point=True).encode(
            x=alt.X("overflow:Q", title="overflow to the sewer (m³ a season)",
                    scale=alt.Scale(zero=False)),
            y=alt.Y("saved:Q", title="mains water saved (m³ a season)",
                    scale=alt.Scale(zero=False)),
            order=alt.Order("volume:Q"),
        )
        upper.append(Panel(saved, title, height=_HEIGHT, toggle="series"))
        lower.append(Panel(traded, title, height=_HEIGHT, toggle="series"))
    return Figure(
        "sizing", "Cistern and green roof: mains water saved and overflow",
        "",
        (*upper, *lower), len(upper), data,
    )
