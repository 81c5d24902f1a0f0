"""Figures over time: commands and volumes of runs, the weather, and the chart of simulations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import altair as alt

from greenroof_ros.analysis.report.bags import Drawn, drawn
from greenroof_ros.analysis.report.drawing import (
    CONFIG,
    Figure,
    Panel,
    Rows,
    distinct,
    pointed,
    series_panel,
    short,
)
from greenroof_ros.analysis.report.groups import SKY, Report, unique, who
from greenroof_ros.analysis.report.run import Row, controller_name
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.model.site import Site
from greenroof_ros.recording.trajectory import Trajectory

_GREY = "#555555"
# Runs longer than this (h) have no times of day on their axis.
_MOST_HOURS = 96.0
_FULL_FLOW = "full flow; the pump cannot deliver more"
# Commands of 1e-3 and of 1 must both be visible: below this power of ten the axis is linear.
_LEAST_POWER = {"command": -3, "pump_flow": -2}
# The chart of simulations: width and height of a panel, and of the rain's (px).
_WIDTH, _HEIGHT, _RAIN_HEIGHT = 640, 130, 70
# Room for the numbers of its axes, so that the titles are in line.
_EXTENT = 44


def overlaid(simulations: Mapping[str, tuple[Site, Trajectory]]) -> alt.VConcatChart:
    """Return the chart of simulations: rain, roof level, cistern and pump, with a line for each.

    Args:
        simulations: sites and trajectories, by the names of the lines. The rain is the longest's.

    Raises:
        ConfigurationError: they begin at different times.
    """
    names, sites = list(simulations), [site for site, _ in simulations.values()]
    runs = [drawn(trajectory) for _, trajectory in simulations.values()]
    lengths = [float(trajectory.time[-1]) for _, trajectory in simulations.values()]
    start = runs[0].start
    for name, run in zip(names, runs, strict=True):
        if run.start != start:
            raise ConfigurationError(
                f"begins at {to_minutes(run.start)}, but {names[0]} at {to_minutes(start)}: one "
                "chart is of one time", key=name,
            )
    x = _time(start, max(lengths) / 3600)
    rain, top = _rain(runs[lengths.index(max(lengths))])
    down = alt.Scale(domain=[0, top], reverse=True)
    charts: list[Any] = [_rained(alt.InlineData(rain), x.title(None), down).properties(
        width=_WIDTH, height=_RAIN_HEIGHT)]
    series = distinct("controller", names, "")
    legend = alt.Legend(symbolType="stroke", symbolSize=600, columns=4)
    for channel in series.values():
        channel.legend = legend if len(names) > 1 else None
    for quantity, axis, factors, levels in (
        ("roof", "roof level (mm)", [1000 / site.a2 for site in sites],
         {site.z_veg for site in sites}),
        ("cistern", "cistern level (m)", [1 / site.a1 for site in sites],
         {(site.z_o, site.suction_level, site.low_outlet_level) for site in sites}),
        ("pump_flow", "pump flow (L/s)", [1000.0] * len(sites), {0.0}),
    ):
        rows: Rows = [
            {"controller": name, **row}
            for name, run, factor in zip(names, runs, factors, strict=True)
            for row in _points(run, start, quantity, factor)
        ]
        y, references = _axis(
            sites[0], quantity, axis, [row["v"] for row in rows], factors[0], len(levels) == 1
        )
        lines = alt.Chart(alt.InlineData(rows)).mark_line(clip=True, strokeWidth=1.6).encode(
            x=x if quantity == "pump_flow" else x.title(None), y=y,
            **series, tooltip=pointed("controller:N", _WHEN, ("v:Q", axis)),
        )
        charts.append(alt.layer(*references, lines).properties(width=_WIDTH, height=_HEIGHT))
    chart: alt.VConcatChart = alt.vconcat(*charts, spacing=10).resolve_scale(
        x="shared", color="shared", strokeDash="shared"
    ).configure(**CONFIG).configure_axisY(minExtent=_EXTENT)
    return chart


def trajectories(report: Report, rows: Sequence[Row], number: int) -> Figure:
    """Return the figure of command, flow and volumes over time (paper: Figs. 6-9).

    Controllers with a run each share a panel for each quantity; if one of them has several runs,
    each controller has its own.

    Args:
        report: all results.
        rows: runs of a window from the same initial state.
        number: of the window.
    """
    site, first = report.runs[rows[0]["run"]].site, rows[0]
    ordered = sorted(rows, key=lambda row: row["rank"])
    by_controller = {
        name: own for name in report.controllers
        if (own := [row for row in ordered if row["controller"] == name])
    }
    together = len(by_controller) == len(rows)
    groups = {"": ordered} if together else by_controller
    start = report.drawn[first["run"]].start
    x = _time(start, first["hours"])
    panels, data = [], {}
    index = report.initials.index(first["from"]) + 1
    for quantity, title, axis in (
        ("command", "command", "command (1)"),
        ("pump_flow", "pump flow", "pump flow (L/s)"),
        ("cistern", "cistern", "cistern, x1 (m³)"),
        ("roof", "green roof", "green roof, x2 (m³)"),
    ):
        curves = {row["run"]: _points(
            report.drawn[row["run"]], start, quantity, 1000.0 if quantity == "pump_flow" else 1.0
        ) for row in rows}
        y, references = _axis(
            site, quantity, axis, [point["v"] for curve in curves.values() for point in curve]
        )
        for controller, own in groups.items():
            dataset = "-".join(filter(None, (quantity, str(number), str(index), controller)))
            labels = unique(own, [who(row) if together else row["label"] for row in own])
            data[dataset] = [
                {"setting": label, **point}
                for label, row in zip(labels, own, strict=True) for point in curves[row["run"]]
            ]
            named = "" if together else report.settings[controller].title
            lines = alt.Chart(alt.NamedData(dataset)).mark_line(clip=True, strokeWidth=1.8).encode(
                x=x, y=y,
                tooltip=pointed(("setting:N", named or "controller"), _WHEN, ("v:Q", axis)),
            )
            panels.append(series_panel(
                lines, "setting", labels, f"{controller_name(controller)}: {title}"
                if controller else title.capitalize(),
                legend=named, zoom=True, below=[
                    *(_incidents(report, own, start) if quantity in _LEAST_POWER else []),
                    *references,
                ],
            ))
    return Figure(
        f"trajectories-{number}-{index}",
        report.title(f"Command, flow and volumes from {first['from']}", first),
        "Red: incidents" if any(report.runs[row["run"]].incidents for row in rows) else "",
        tuple(panels), 2 if together else len(groups), data,
    )


_UTC = alt.Scale(type="utc")
_WHEN = alt.Tooltip(
    "t:T", title="time", timeUnit="utcyearmonthdatehoursminutesseconds", format="%Y-%m-%d %H:%M:%S"
)


def _origin(start: datetime) -> float:
    """Return a time for an axis in UTC, which then shows local time in every browser (ms)."""
    offset = start.utcoffset()
    assert offset is not None, "a run's start has its offset"
    return (start.timestamp() + offset.total_seconds()) * 1000


def _points(run: Drawn, start: datetime, quantity: str, factor: float) -> Rows:
    """Return the points of a curve, in the local time of ``start``.

    Args:
        run: with the curve.
        start: of the axis; the run can begin at another time.
        quantity: of the curve.
        factor: from its unit to the axis'.
    """
    origin = _origin(run.start.astimezone(start.tzinfo))
    return [
        {"t": origin + 1000 * time, "v": short(factor * value)}
        for time, value in run.curves[quantity]
    ]


def _time(start: datetime, hours: float) -> alt.X:
    """Return an axis with dates; at six of its ticks their texts must differ."""
    day = "utcFormat(datum.value, '%-d %b')"
    midnight = "utchours(datum.value) + utcminutes(datum.value) + utcseconds(datum.value) == 0"
    clock = f"utcFormat(datum.value, '{'%H:%M:%S' if hours < 0.2 else '%H:%M'}')"
    return alt.X(
        "t:T",
        title=f"from {start:%-d %B %Y}, local time (UTC{start.isoformat()[-6:]})",
        scale=alt.Scale(type="utc", nice=False, domain=[
            _origin(start), _origin(start) + 3.6e6 * hours,
        ]),
        axis=alt.Axis(
            tickCount=6, labelOverlap=True,
            labelExpr=f"{midnight} ? {day} : {clock}" if hours <= _MOST_HOURS else day,
        ),
    )


def _incidents(report: Report, rows: Sequence[Row], start: datetime) -> list[alt.Chart]:
    """Return the incidents of some runs as areas; one that is not over lasts to the run's end."""
    areas = []
    for row in rows:
        run, began = report.runs[row["run"]], report.drawn[row["run"]].start
        origin = _origin(began.astimezone(start.tzinfo))
        for incident in run.incidents:
            low, high = (
                tick * run.site.tau if tick is not None
                else (datetime.fromisoformat(time) - began).total_seconds() if time is not None
                else row["hours"] * 3600
                for tick, time in ((incident.began_tick, incident.began),
                                   (incident.ended_tick, incident.ended))
            )
            areas.append({
                "from": origin + 1000 * low, "to": origin + 1000 * high, "cause": incident.cause,
                "part": incident.subject, "run": row["run"],
            })
    return [
        alt.Chart(alt.InlineData(areas)).mark_rect(color="#a30000", opacity=0.2, clip=True).encode(
            x=alt.X("from:T", scale=_UTC), x2=alt.X2("to:T"),
            tooltip=pointed("run:N", "part:N", "cause:N"),
        )
    ] if areas else []


def _axis(
    site: Site, quantity: str, title: str, values: Sequence[float], factor: float = 1.0,
    referenced: bool = True,
) -> tuple[alt.Y, list[alt.Chart]]:
    """Return a quantity's axis, the same in all panels, and its reference levels with their names.

    Args:
        site: with the levels.
        quantity: of the curves.
        title: of the axis.
        values: all that are drawn, in the axis' unit.
        factor: from the volume in a tank (m3) to the axis' unit.
        referenced: whether all curves have the tanks' reference levels.
    """
    low, high = min(values), max(values)
    scale: dict[str, Any] = {"nice": False}
    axis = alt.Axis()
    if quantity in _LEAST_POWER:
        least = _LEAST_POWER[quantity]
        scale |= {"type": "symlog", "constant": 10.0**least}
        axis = alt.Axis(values=[0.0, *(10.0**power for power in range(least, 10))], format=".12~g")
    if quantity == "command":
        # On the logarithmic axis this leaves room for the text above the line.
        top = max(2.5 * high, 0.002)
        domain, references = [0.0, top], {_FULL_FLOW: 1.0} if top > 1.5 else {}
    elif quantity == "pump_flow":
        domain, references = [0.0, 1.3 * high or 1.0], {}  # from 0, or no power of ten may be in it
    else:
        domain, references = _around(
            site if referenced else None, quantity, low, high, factor
        )
    scaled = alt.Scale(domain=domain, **scale)
    return (
        alt.Y("v:Q", title=title, scale=scaled, axis=axis),
        _reference_layers(domain, references, scaled),
    )


def _around(
    site: Site | None, quantity: str, low: float, high: float, factor: float
) -> tuple[list[float], dict[str, float]]:
    """Return an axis range around values, and the reference levels by name, if a site has them."""
    span = max(high - low, 1e-3 * high) or 1.0

    def near(value: float) -> bool:
        return low - span / 2 <= value <= high + span / 2

    references = {"target": factor * site.x2_star} if site and quantity == "roof" else {}
    if site and quantity == "cistern":
        area = factor * site.a1
        references = {"outlet": area * site.z_o, "suction limit": area * site.suction_level}
        # Only if nearby: at the edge its label would overlap another.
        if site.low_outlet_level is not None and near(area * site.low_outlet_level):
            references["low outlet"] = area * site.low_outlet_level
    # Include references nearby; a reference far away would make all lines flat.
    inside = list(filter(near, references.values()))
    low, high = min([low, *inside]), max([high, *inside])
    # Room for the name of a reference outside the range, below or above all lines.
    margin = 0.18 * max(high - low, span)
    return [max(0.0, low - margin), high + margin], references


def _reference_layers(
    domain: Sequence[float], references: Mapping[str, float], scale: alt.Scale
) -> list[alt.Chart]:
    """Return the reference lines with their names; outside the range only a name at the edge."""
    layers = []
    low, high = domain
    for text, value in references.items():
        above = value > high
        inside = low <= value and not above
        words = text if inside else f"{text} at {value:.4g} {'↑' if above else '↓'}"
        place = value if inside else high if above else low
        base = alt.Chart(alt.InlineData([{"v": place, "text": words}]))
        y = alt.Y("v:Q", scale=scale)
        if text == _FULL_FLOW:
            layers.append(
                alt.Chart(alt.InlineData([{"from": value, "to": high}]))
                .mark_rect(color="#D55E00", opacity=0.12)
                .encode(y=alt.Y("from:Q", scale=scale), y2=alt.Y2("to:Q"))
            )
        if inside:
            layers.append(base.mark_rule(color=_GREY, strokeDash=[3, 2]).encode(y=y))
        layers.append(
            base.mark_text(
                align="right", baseline="top" if above else "bottom",
                dx=-4, dy=3 if above else -2, color="#333333", fontSize=10,
            ).encode(x=alt.XValue("width"), y=y, text=alt.Text("text:N"))
        )
    return layers


def _rain(run: Drawn) -> tuple[Rows, float]:
    """Return the rain of a run, and the end of its axis (mm/h)."""
    rows = _points(run, run.start, "precipitation", 3.6e6)
    return rows, 1.05 * max(row["v"] for row in rows) or 1.0


def _rained(data: Any, x: alt.X, scale: alt.Scale) -> alt.Chart:
    """Return the area of rain."""
    chart: alt.Chart = alt.Chart(data).mark_area(
        interpolate="step-after", line={"color": "#0072B2"}, color="#56B4E9", clip=True
    ).encode(
        x=x, y=alt.Y("v:Q", title="rain (mm/h)", scale=scale),
        tooltip=pointed(_WHEN, ("v:Q", "mm/h")),
    )
    return chart


def weather(report: Report, rows: Sequence[Row], number: int) -> Figure:
    """Return the figure of rain and evapotranspiration over time (paper: Fig. 4).

    Args:
        report: all results.
        rows: runs of one site with the same weather, one for each method of evapotranspiration.
        number: of the figure.
    """
    runs = {row["evapotranspiration"]: report.drawn[row["run"]] for row in rows}
    run = next(iter(runs.values()))
    start, frozen, origin = run.start, run.frost, _origin(run.start)
    area = report.runs[rows[0]["run"]].site.a2
    rain, top = _rain(run)
    evaporation: Rows = [
        {"method": method, **point} for method, each in runs.items()
        for point in _points(each, start, "evapotranspiration", 8.64e7 / area)
    ]
    x = _time(start, rows[0]["hours"])
    frost = [
        alt.Chart(alt.InlineData([
            {"from": origin + low * 1000, "to": origin + high * 1000} for low, high in frozen
        ])).mark_rect(color="#999999", opacity=0.3).encode(
            x=alt.X("from:T", scale=_UTC), x2=alt.X2("to:T")
        )
    ] if frozen else []
    rained = _rained(alt.NamedData(f"rain-{number}"), x, alt.Scale(domain=[0, top]))
    evaporated = alt.Chart(alt.NamedData(f"evapotranspiration-{number}")).mark_line(
        interpolate="step-after", clip=True
    ).encode(
        x=x, y=alt.Y("v:Q", title="evapotranspiration (mm/day)", scale=alt.Scale(zero=True)),
        tooltip=pointed("method:N", _WHEN, ("v:Q", "mm/day")),
    )
    return Figure(
        f"weather-{number}",
        f"Weather: {report.heading(rows[0], SKY)}",
        "Grey: frost" if frozen else "",
        (
            Panel(alt.layer(*frost, rained), "Rain", zoom=True),
            series_panel(evaporated, "method", list(runs), "Evapotranspiration", legend="method",
                         below=frost, zoom=True),
        ),
        2,
        {f"rain-{number}": rain, f"evapotranspiration-{number}": evaporation},
    )
