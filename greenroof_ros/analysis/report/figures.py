"""The figures of results by case, and which figures a report has."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import altair as alt

from greenroof_ros.analysis.report.drawing import (
    COLOURS,
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
from greenroof_ros.analysis.report.groups import FLOWS, TOTAL, Case, Report
from greenroof_ros.analysis.report.trajectories import (
    Drawn,
    drawn,
    figures_over_time,
    forecast_figure,
)
from greenroof_ros.model.metrics import METRICS
from greenroof_ros.recording.bag_reader import read_rain_forecasts

# More lines than this in one panel: each controller has its own figures.
_MOST_LINES = len(COLOURS)
_HEIGHT = 260
# Height of a row with its name above its mark (px).
_NAMED_ROW = 45

# The names of all figures begin with one of these; numbers and a controller can follow.
_KINDS = ("deviation", "relative", "sizing", "balance", "water", "flows", "forecast")


def is_figure(name: str) -> bool:
    """Whether a file has the name of a figure in a report."""
    return re.fullmatch(rf"({'|'.join(_KINDS)})(-[\w.]+)*\.(svg|png)", name) is not None


def make_figures(report: Report) -> Iterator[Figure]:
    """Yield the figures, in the order in which they appear.

    Raises:
        ConfigurationError: the trajectory of a run cannot be read.
    """
    several = len(report.windows()) > 1
    windows = {
        f"{number}": (f": {cases[0].place[0]}" if several else "", cases)
        for number, cases in enumerate(report.windows(), start=1)
    }
    if len(report.cases) > 1 and not report.sizing:
        for name, (title, cases) in windows.items():
            yield deviation(cases, name, title)
    if any(case.relative is not None for case in report.cases) and not report.sizing:
        yield relative(report)
    if report.sizing:
        yield sizing(report)
    for number, place in enumerate(report.places(), start=1):
        title = f" from {place[0].place[1]}" + f": {place[0].place[0]}" * several
        yield from _over_time(place, str(number), title)
    for name, (title, cases) in windows.items():
        yield balance(cases, name, title)


def _over_time(place: Sequence[Case], name: str, title: str) -> Iterator[Figure]:
    """Yield the figures over time of a place's runs that are cases of their own."""
    lines: dict[str, dict[str, Drawn]] = {}
    forecasts = list[Figure]()
    for case in place:
        trajectory = case.runs[0].trajectory() if len(case.runs) == 1 else None
        if trajectory is None:
            continue
        run, controller = case.runs[0], case.row["controller"]
        lines.setdefault(controller, {})[case.label] = drawn(run.site, trajectory)
        issued = [] if run.bag is None else read_rain_forecasts(run.bag, trajectory.start)
        issued = [each for each in issued if 0 <= each[0] <= trajectory.time[-1]]
        if issued:
            forecasts.append(forecast_figure(
                issued, lines[controller][case.label], trajectory,
                f"{name}-{len(forecasts) + 1}", f" of {case.label}{title}",
            ))
    together = {label: run for own in lines.values() for label, run in own.items()}
    if 0 < len(together) <= _MOST_LINES:
        yield from figures_over_time(together, name, title)
    else:
        for controller, own in lines.items():
            yield from figures_over_time(
                own, f"{name}-{controller}", f", {controller},{title}"
            )
    yield from forecasts


# --- results by case ------------------------------------------------------------------------------


def deviation(cases: Sequence[Case], name: str, title: str) -> Figure:
    """Return the total deviation of a window's cases, a panel for each initial state."""
    panels, marks = list[Panel](), dict[str, None]()
    controllers = list(dict.fromkeys(str(case.row["controller"]) for case in cases))
    data: dict[str, Rows] = {}
    axis = "total |x2 - x2*| (m³)"
    for initial in dict.fromkeys(case.place[1] for case in cases):
        here = [case for case in cases if case.place[1] == initial]
        dataset = f"deviation-{name}-{len(panels) + 1}"
        rows: Rows = []
        for case in here:
            totals = [total for year in case.totals.values() for total in year]
            rows.append({
                "case": case.label, "controller": case.row["controller"], "runs": len(totals),
                "v": short(case.row[TOTAL]), "low": short(min(totals)), "high": short(max(totals)),
            })
        data[dataset] = rows
        bounds = [case.row["bound_m3"] for case in here if case.row["ratio"] is not None]
        ends = [row[key] for row in rows for key in ("v", "low", "high")]
        x = alt.X("v:Q", title=axis, **value_axis([*ends, *bounds[:1]]))
        y = alt.Y(
            "case:N", sort=[case.label for case in here], title=None, axis=alt.Axis(labelLimit=190)
        )
        base = alt.Chart(alt.NamedData(dataset)).encode(
            y=y, color=alt.Color("controller:N", scale=cycled(COLOURS, controllers), legend=None),
            tooltip=pointed("case:N", ("v:Q", axis), "low:Q", "high:Q", "runs:Q"),
        )
        layers: list[Chart] = [
            base.mark_rule(strokeWidth=2).encode(x=alt.X("low:Q"), x2=alt.X2("high:Q")),
            base.mark_point(filled=True, opacity=1, size=60).encode(x=x),
        ]
        if any(row["runs"] > 1 for row in rows):
            marks["Lines: from the smallest to the largest of a case's runs"] = None
        if bounds:
            marks["Dashed: the minimum possible"] = None
            layers.insert(0, alt.Chart(alt.InlineData([{"v": short(bounds[0])}])).mark_rule(
                strokeDash=[6, 3], color="black"
            ).encode(x=x, tooltip=pointed(("v:Q", "minimum possible (m³)"))))
        panels.append(Panel(alt.layer(*layers), f"from {initial}", max(60, 18 * len(here))))
    return Figure(
        f"deviation-{name}", f"Total deviation{title}", "; ".join(marks), tuple(panels),
        min(len(panels), 3), data,
    )


_TERMS = {
    "rain_cistern_m3": "#56B4E9", "rain_roof_m3": "#56B4E9", "mains_m3": "#E69F00",
    "pumped_m3": "#0072B2", "evapotranspiration_m3": "#009E73", "drainage_m3": "#000000",
    "outflow_m3": "#999999",
}
_LABELS = {metric.name: metric.label for metric in METRICS}


def balance(cases: Sequence[Case], name: str, title: str) -> Figure:
    """Return the water balance of both tanks: a row of panels for each initial state."""
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    for initial in dict.fromkeys(case.place[1] for case in cases):
        here = [case for case in cases if case.place[1] == initial]
        for tank, flows in FLOWS.items():
            dataset = f"balance-{name}-{tank}-{len(panels) // 2 + 1}"
            data[dataset] = [
                {"case": case.label, "flow": _LABELS[flow], "v": short(sign * case.row[flow])}
                for case in here for flow, sign in flows.items() if case.row[flow]
            ]
            drawn_flows = {row["flow"] for row in data[dataset]}
            shown = [flow for flow in flows if _LABELS[flow] in drawn_flows]
            chart = alt.Chart(alt.NamedData(dataset)).mark_bar(
                stroke="white", strokeWidth=0.5
            ).encode(
                x=alt.X(
                    "v:Q", title="in (+) and out (-) (m³)", axis=alt.Axis(tickCount=5),
                    scale=alt.Scale() if shown else alt.Scale(domain=[0, 1]),
                ),
                y=alt.Y("case:N", sort=[case.label for case in here], title=None,
                        axis=alt.Axis(labelLimit=190)),
                color=alt.Color(
                    "flow:N", title=None, legend=alt.Legend() if shown else None, scale=cycled(
                        [_TERMS[flow] for flow in shown], [_LABELS[flow] for flow in shown]
                    ),
                ),
                tooltip=pointed("case:N", "flow:N", ("v:Q", "m³")),
            )
            panels.append(
                Panel(chart, f"{tank.capitalize()}, from {initial}", max(60, 17 * len(here)))
            )
    return Figure(
        f"balance-{name}", f"Water balance{title}", "", tuple(panels), 2, data,
    )


# --- seasons of several years ---------------------------------------------------------------------


def relative(report: Report) -> Figure:
    """Return the deviations relative to on/off with their intervals, a panel for each place."""
    controllers = list(dict.fromkeys(str(case.row["controller"]) for case in report.cases))
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    for place in report.places():
        name = f"relative-{len(data) + 1}"
        rows: Rows = [
            {"case": case.label, "controller": case.row["controller"], "v": short(ratio.value),
             "low": short(ratio.low), "high": short(ratio.high)}
            for case in place if case.relative is not None for ratio in [case.relative.mean]
        ]
        if not rows:
            continue
        data[name] = rows
        base = alt.Chart(alt.NamedData(name)).encode(
            # Each name stands above its interval: next to it there is no room on a phone.
            y=alt.Y("case:N", sort=[row["case"] for row in rows], title=None, axis=alt.Axis(
                labelAlign="left", labelPadding=-4, labelOffset=-13, labelLimit=400, domain=False,
                ticks=False,
            )),
            color=alt.Color("controller:N", scale=cycled(COLOURS, controllers), legend=None),
            tooltip=pointed("case:N", "v:Q", "low:Q", "high:Q"),
        )
        ends = [1.0, *(row[key] for row in rows for key in ("v", "low", "high"))]
        x = alt.X("low:Q", title="deviation of a season relative to on/off (1)", **value_axis(ends))
        line = alt.Chart(alt.InlineData([{"x": 1}])).mark_rule().encode(x=alt.X("x:Q"))
        panels.append(Panel(
            alt.layer(
                line, base.mark_rule(strokeWidth=2).encode(x=x, x2=alt.X2("high:Q")),
                base.mark_point(filled=True, size=70, opacity=1).encode(x=alt.X("v:Q")),
            ),
            [place[0].place[0], f"from {place[0].place[1]}"], _NAMED_ROW * len(rows),
        ))
    return Figure(
        "relative", "Deviation relative to on/off", "Lines: 95 % intervals", tuple(panels), 1, data
    )


def sizing(report: Report) -> Figure:
    """Return water saved over the cistern's volume and over the outflow, for each roof area."""
    rows: Rows = [
        {
            "case": f"{case.label}, from {case.place[1]}", "area": case.runs[0].site.a2,
            "volume": short(case.runs[0].site.a1 * case.runs[0].site.z_o),
            "saved": short(case.row["saved_m3"]), "outflow": short(case.row["outflow_m3"]),
        }
        for case in report.seasons
    ]
    series = list(dict.fromkeys(str(row["case"]) for row in rows))
    data: dict[str, Rows] = {}
    upper, lower = [], []
    for area in sorted({row["area"] for row in rows}):
        name = f"sizing-{len(data) + 1}"
        data[name] = sorted(
            (row for row in rows if row["area"] == area), key=lambda row: row["volume"]
        )
        base = alt.Chart(alt.NamedData(name)).mark_line(point=True).encode(
            **distinct("case", series, ""),
            tooltip=pointed("case:N", "volume:Q", "saved:Q", "outflow:Q"),
        )
        y = alt.Y("saved:Q", title="mains water saved (m³ a season)", scale=alt.Scale(zero=False))
        volumes = sorted({row["volume"] for row in data[name]})
        saved = base.encode(y=y, x=alt.X(
            "volume:Q", title="cistern up to its outlet (m³)", axis=alt.Axis(values=volumes),
            scale=alt.Scale(type="log", nice=False),
        ))
        traded = base.encode(y=y, order=alt.Order("volume:Q"), x=alt.X(
            "outflow:Q", title="outflow to the sewer (m³ a season)", scale=alt.Scale(zero=False),
        ))
        upper.append(Panel(saved, f"green roof of {area:g} m²", _HEIGHT))
        lower.append(Panel(traded, f"green roof of {area:g} m²", _HEIGHT))
    return Figure(
        "sizing", "Cistern and green roof: mains water saved and outflow", "", (*upper, *lower),
        len(upper), data,
    )
