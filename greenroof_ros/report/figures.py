"""The figures of results, and which figures a report has; one specification makes page, PNG, SVG.

Here the x axis of a panel is a controller's settings, the skill of forecasts, years, or sizes of a
cistern. Trajectories, weather and pumps have their own modules.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import altair as alt
import polars as pl

from greenroof_ros.common.files import shared_directory
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.model.site import PLACE, read_site
from greenroof_ros.report.drawing import (
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
)
from greenroof_ros.report.groups import (
    SEASONS,
    SEEDS,
    SKY,
    TOTAL,
    Report,
    Settings,
    by_place,
    heading,
    unique,
    who,
)
from greenroof_ros.report.pump_figures import pump_curve, pump_smoothing, read_pump_data
from greenroof_ros.report.run import NO_ERRORS, Row, controller_name
from greenroof_ros.report.trajectories import trajectories, weather

_PAPER_START = datetime.fromisoformat("2021-07-07T02:00-05:00")
_PAPER_HOURS = 12.0
_PAPERS_PARAMETER = {"mpc": "weight", "onoff": "fraction"}
_HEIGHT = 260
_TOTAL_AXIS = "total |x2 - x2*| (m³)"


class Quantity(NamedTuple):
    """A quantity by which runs are compared, setting by setting."""

    name: str
    title: str
    axis: str
    caption: str
    column: str
    times: float = 1.0


QUANTITIES = (
    Quantity(
        "total-deviation", "Total deviation", _TOTAL_AXIS,
        "The sum of |x2 - x2*| over the ticks: how far the roof was from its target, the "
        "whole time (paper: Fig. 5). Less is better.", TOTAL,
    ),
    Quantity(
        "time-in-band", "Time near the target", "time in the band (h)",
        "How long the roof was within the band about its target. More is better.",
        "near_target_hours",
    ),
    Quantity(
        "energy", "Electric energy", "electric energy (Wh)",
        "What the pumps draw, at the site's pump_efficiency. Less is better.",
        "electric_energy_kwh", 1000,
    ),
    Quantity(
        "pump-starts", "Pump starts", "starts",
        "How often the pumps' flow went from 0 to more. Starts wear pumps.", "pump_starts",
    ),
)

# The names of all figures begin with one of these; numbers can follow.
_KINDS = (
    *(quantity.name for quantity in QUANTITIES), "pump-curve", "pump-smoothing", "weather",
    "trajectories", "water-balance", "forecast-errors", "seasons", "season-comparisons", "sizing",
)


def is_figure(name: str) -> bool:
    """Whether a file has the name of a figure in a report."""
    return re.fullmatch(rf"({'|'.join(_KINDS)})(-\d+)*\.(svg|png)", name) is not None


def make_figures(report: Report, pump_data: Path | None) -> Iterator[Figure]:
    """Yield the figures, in the order in which they appear.

    Args:
        report: all results.
        pump_data: file with points of the pumps' data sheet, if there is one.

    Raises:
        ConfigurationError: that file is wrong.
    """
    points = read_pump_data(pump_data) if pump_data is not None else None
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
            for quantity in QUANTITIES:
                known = [row for row in rows if row[quantity.column] is not None]
                if known:
                    yield by_setting(report, known, number, quantity)
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
        if report.over_onoff:
            yield comparison_figure(report)
    # Seasons are left out: their sites differ only in size, so the pumps are the same.
    alone = [*report.single, *report.of(SEEDS)]
    sites = {row["site"]: report.runs[row["run"]].site for row in alone}
    for number, (name, site) in enumerate(sites.items(), start=1):
        whose = f" of {name}" if len(sites) > 1 else ""
        yield pump_curve(site, number, whose, points)
        yield pump_smoothing(site, number, whose)


# --- single runs ----------------------------------------------------------------------------------


def by_setting(report: Report, rows: Sequence[Row], number: int, quantity: Quantity) -> Figure:
    """Return a quantity over each controller's settings, marked by initial state.

    Args:
        report: all results.
        rows: runs of a window for which the quantity is known.
        number: of the window.
        quantity: to draw.
    """
    # Its marks are larger, to show behind others at the same place.
    first = report.initials[0]
    published: Rows = []
    bounds: Rows = []
    if quantity.column == TOTAL:
        published = published_totals(report, rows)
        known = {row["from"]: row["bound_m3"] for row in rows if row["bound_m3"] is not None}
        bounds = [
            {"initial": name, "v": short(bound), "text": "least",
             "width": 4.0 if name == first else 1.5}
            for name, bound in known.items()
        ]
    values = [quantity.times * row[quantity.column] for row in rows]
    # If all values are 0, any axis will do.
    top = max([*values, *(row["v"] for row in (*published, *bounds))]) or 1.0
    y = alt.Y("v:Q", title=quantity.axis, scale=alt.Scale(domain=[0, 1.08 * top], nice=False))
    colour = alt.Color("initial:N", title="from", scale=cycled(COLOURS, report.initials))
    shape = alt.Shape("initial:N", title="from", scale=cycled(SHAPES, report.initials))
    panels, least = [], []
    data: dict[str, Rows] = {}
    if bounds:
        data[f"bound-{number}"] = bounds
        least = _least_layers(alt.Chart(alt.NamedData(f"bound-{number}")).encode(
            y=y, color=colour, strokeWidth=alt.StrokeWidth("width:Q", scale=None)
        ), ("initial:N", "from"))
    for controller in report.controllers:
        here = [
            {
                "run": row["run"], "setting": row["label"],
                "x": row["label"] if row["x"] is None else row["x"], "initial": row["from"],
                "v": short(value), "size": 150 if row["from"] == first else 50,
            }
            for row, value in zip(rows, values, strict=True) if row["controller"] == controller
        ]
        if not here:
            continue
        settings = report.settings[controller]
        theirs = [row for row in published if row["controller"] == controller]
        dataset, codes = (f"{name}-{number}-{controller}" for name in (quantity.name, "published"))
        data[dataset] = here
        base = alt.Chart(alt.NamedData(dataset)).encode(
            x=_settings_axis(settings, here), y=y, color=colour
        )
        layers = [
            base.mark_line(strokeWidth=1, opacity=0.6),
            base.mark_point(filled=True, opacity=1).encode(
                shape=shape, size=alt.Size("size:Q", scale=None), tooltip=pointed(
                    "run:N", ("setting:N", settings.title), ("initial:N", "from"),
                    ("v:Q", quantity.axis),
                ),
            ),
            *least,
        ]
        if theirs:
            data[codes] = theirs
            marks = base.properties(data=alt.NamedData(codes))
            layers.append(marks.mark_point(filled=False, size=330, strokeWidth=1.5).encode(
                shape=shape,
                tooltip=pointed(alt.Tooltip("v:Q", title="authors' code", format=".8~g")),
            ))
        panels.append(Panel(alt.layer(*layers), controller_name(controller), toggle="initial"))
    title, caption = report.title(quantity.title, rows[0]), quantity.caption
    if published:
        title += " (large hollow marks: the authors' code)"
        caption += (
            " Large hollow marks: the paper's values, recomputed with the code that its authors "
            "published, as the paper gives them in a figure only."
        )
    if bounds:
        caption += (
            " Dashed, 'least': the least that any controller with commands up to 1 could reach "
            "from the initial state of the same colour."
        )
    return Figure(f"{quantity.name}-{number}", title, caption, tuple(panels), len(panels), data)


def _settings_axis(settings: Settings, rows: Rows) -> alt.X:
    """Return the axis of a controller's settings: numeric if one parameter differs, else names."""
    if not settings.axis:
        angle = -20 if max(map(len, settings.labels)) > 12 else 0
        axis = alt.Axis(labelAngle=angle, labelLimit=160)
        return alt.X("x:N", title=settings.title, sort=settings.labels, axis=axis)
    kind = {"type": "log"} if settings.log else {"zero": False}
    ticks = sorted({row["x"] for row in rows})
    axis = alt.Axis(values=ticks, labelExpr="'' + datum.value", labelOverlap=True)
    return alt.X("x:Q", title=settings.title, scale=alt.Scale(padding=12, **kind), axis=axis)


def _least_layers(bounds: alt.Chart, *pointed_at: tuple[str, str]) -> list[alt.Chart]:
    """Return the lines of the least possible deviation, each with its name at the left."""
    names = bounds.copy()
    names.encoding.strokeWidth = alt.Undefined
    return [
        bounds.mark_rule(strokeDash=[6, 3]).encode(
            tooltip=pointed(*pointed_at, ("v:Q", "least possible (m³)"))
        ),
        names.mark_text(align="left", baseline="bottom", dx=4, dy=-1, fontSize=10).encode(
            x=alt.XValue(0), text=alt.Text("text:N"),
        ),
    ]


def published_totals(report: Report, rows: Sequence[Row]) -> Rows:
    """Return the authors' values if a window is the paper's, or else none."""
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
        return []
    totals = pl.read_csv(config / "paper" / "totals.csv").filter(
        pl.col("initial").is_in(report.initials), pl.col("controller").is_in(report.controllers)
    )
    return [
        {
            "controller": row["controller"], "initial": row["initial"], "x": row["parameter"],
            "v": row["total_deviation_m3"],
        }
        for row in totals.to_dicts()
        if report.settings[row["controller"]].axis == _PAPERS_PARAMETER[row["controller"]]
    ]


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
    """Return the figure of both tanks' water balance, run by run."""
    rows = sorted(rows, key=lambda row: (report.initials.index(row["from"]), row["rank"]))
    names = unique(rows, [f"{who(row)}, {row['from']}" for row in rows])
    panels, data = [], {}
    for tank, parts in _BALANCE.items():
        dataset = f"balance-{number}-{tank.split()[-1].lower()}"
        data[dataset] = [
            {"run": name, "term": term, "v": short(
                (-1 if column.startswith("-") else 1) * (row[column.removeprefix("-")] or 0.0)
            )}
            for name, row in zip(names, rows, strict=True) for term, column in parts.items()
        ]
        chart = alt.Chart(alt.NamedData(dataset)).mark_bar(stroke="white", strokeWidth=0.5).encode(
            x=alt.X("v:Q", title="in (+) and out (-) (m³)", axis=alt.Axis(tickCount=5)),
            y=alt.Y("run:N", sort=names, title=None, axis=alt.Axis(labelLimit=190)),
            color=alt.Color(
                "term:N", title=None,
                scale=alt.Scale(domain=list(parts), range=[_TERMS[term] for term in parts]),
            ),
            tooltip=pointed("run:N", "term:N", ("v:Q", "m³")),
        )
        panels.append(Panel(chart, tank, height=max(90, 17 * len(rows)), toggle="term"))
    return Figure(
        f"water-balance-{number}", report.title("Water balance", rows[0]),
        "What came into each tank and left it during the run; the bars' sum is the change of what "
        "it holds. Evapotranspiration is what the roof could give.",
        tuple(panels), 2, data,
    )


# --- many seeds -----------------------------------------------------------------------------------

_AMOUNTS = {"mean": TOTAL, "mean of the worst tenth": "worst_tenth_m3"}


def forecast_errors(report: Report) -> Figure:
    """Return the figure of total deviation, mean and worst tenth, over the skill of forecasts."""
    cases, apart = report.of(SEEDS), report.apart(SEEDS)
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
    seeds = sorted({row["seeds"] for row in cases})
    count = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"{seeds[0]}"
    caption = (
        f"Total deviation of {count} seeds of errors each, over the skill of the forecasts. "
        "Colours: controllers; shapes: their settings. Filled marks on solid lines: the mean; "
        "hollow ones on dashed lines: the mean of the worst tenth of the runs. The panels' axes do "
        "not begin at 0."
    )
    if any(row["bound_m3"] for row in cases):
        caption += " Dashed: the least that any controller with commands up to 1 could reach."
    return Figure(
        "forecast-errors", "Deviation under forecast errors", caption, tuple(panels),
        min(len(panels), 3), data,
    )


def _errors_chart(report: Report, cases: Sequence[Row], dataset: str) -> Chart:
    """Return a panel's chart: lines and marks of each series, and the least possible deviation."""
    bounds = sorted({row["bound_m3"] for row in cases if row["bound_m3"] is not None})
    values = [*bounds, *(row[column] for row in cases for column in _AMOUNTS.values())]
    low, high = min(values), max(values)
    margin = 0.08 * (high - low) or 0.08 * high or 1.0
    scale = alt.Scale(domain=[max(0.0, low - margin), high + margin], nice=False)
    skills = dict.fromkeys(
        row["skill"] for row in sorted(report.of(SEEDS), key=lambda row: row["skill rank"])
    )
    x = alt.X("skill:O", title="skill of the forecasts", sort=list(skills),
              axis=alt.Axis(labelAngle=0))
    y = alt.Y("v:Q", title=_TOTAL_AXIS, scale=scale)
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
    layers = _least_layers(alt.Chart(alt.InlineData(
        [{"v": bound, "text": "least possible"} for bound in bounds]
    )).encode(y=y, color=alt.ColorValue("black"))) if bounds else []
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
    apart = report.apart(SEASONS)
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


def _scale(values: str) -> dict[str, Any]:
    """Return a quantitative axis that does not begin at 0."""
    return {"field": values, "type": "quantitative", "scale": alt.Scale(zero=False)}


def by_year(report: Report) -> Figure:
    """Return the figure of each year's deviation: a panel for each place and kind of forecast."""
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    cases, looking = report.of(SEASONS), report.given_errors
    usual = list(dict.fromkeys(row["forecast"] for row in cases if row["controller"] in looking))
    for place, here in _places(report, cases):
        for forecast in usual or [""]:
            shown = [
                row for row in here
                if row["controller"] not in looking or row["forecast"] == forecast
            ]
            name = f"seasons-{len(data) + 1}"
            data[name] = [
                {"series": _series(row, shown), "year": year, "v": short(float(totals.mean())),
                 "least": short(float(totals.min())), "largest": short(float(totals.max()))}
                for row in shown for year, totals in report.years(row)
            ]
            series = list(dict.fromkeys(row["series"] for row in data[name]))
            chart = alt.Chart(alt.NamedData(name)).mark_line(point=True).encode(
                x=alt.X("year:O", title=None, axis=alt.Axis(labelAngle=0)),
                y=alt.Y(**_scale("v"), title="total |x2 - x2*| of the season (m³)"),
                **distinct("series", series, ""),
                tooltip=pointed("series:N", "year:O", "v:Q", "least:Q", "largest:Q"),
            )
            title = [place, *([f"forecasts: {forecast}"] if forecast else [])]
            panels.append(Panel(chart, title, height=_HEIGHT, toggle="series"))
    return Figure(
        "seasons", "Deviation of each season",
        "Total deviation of each season, the mean over the seeds of the forecasts' errors. The "
        "axes do not begin at 0.", tuple(panels), max(1, min(len(usual), 3)), data,
    )


def comparison_figure(report: Report) -> Figure:
    """Return the figure of deviations over on/off's with intervals, a panel for each place."""
    cases = report.of(SEASONS)
    names = list(map(controller_name, report.controllers))
    colour = alt.Color("controller:N", title=None, scale=cycled(COLOURS, names))
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    for place, here in _places(report, report.over_onoff):
        name = f"season-comparisons-{len(data) + 1}"
        data[name] = [
            {
                "series": _series(row, cases), "controller": controller_name(row["controller"]),
                "v": short(ratio.value), "low": short(ratio.low), "high": short(ratio.high),
                "verdict": ratio.verdict,
            }
            for row in here for ratio in [row["has"].mean]
        ]
        order = [str(row["series"]) for row in data[name]]
        base = alt.Chart(alt.NamedData(name)).encode(
            y=alt.Y("series:N", sort=order, title=None, axis=alt.Axis(labelLimit=400)),
            color=colour, tooltip=pointed("series:N", "v:Q", "low:Q", "high:Q", "verdict:N"),
        )
        intervals = base.mark_rule(strokeWidth=2).encode(
            x=alt.X(**_scale("low"), title="deviation of a season relative to on/off (1)"),
            x2=alt.X2("high:Q"),
        )
        marks = base.mark_point(filled=True, size=70, opacity=1).encode(x=alt.X("v:Q"))
        line = alt.Chart(alt.InlineData(values=[{"x": 1}])).mark_rule().encode(x=alt.X("x:Q"))
        panels.append(Panel(alt.layer(line, intervals, marks), place, height=_HEIGHT))
    return Figure(
        "season-comparisons", "Deviation relative to on/off",
        "Total deviation of all seasons over on/off's in the same seasons, and its 95 % interval, "
        "each for one comparison alone. An interval that crosses the line contains 1.",
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
            **distinct("series", series, ""),
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
            x=alt.X(**_scale("overflow"), title="overflow to the sewer (m³ a season)"),
            y=alt.Y(**_scale("saved"), title="mains water saved (m³ a season)"),
            order=alt.Order("volume:Q"),
        )
        upper.append(Panel(saved, title, height=_HEIGHT, toggle="series"))
        lower.append(Panel(traded, title, height=_HEIGHT, toggle="series"))
    return Figure(
        "sizing", "Cistern and green roof: mains water saved and overflow",
        "Means of a season. Above: over the volume of the cistern. Below: the trade-off, each mark "
        "a cistern, the smallest at the right. The axes below do not begin at 0.",
        (*upper, *lower), len(upper), data,
    )
