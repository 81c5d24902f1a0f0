"""Figures of single runs over time: commands and volumes, and the weather."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime

import altair as alt

from greenroof_ros.analysis.report.drawing import Figure, Panel, Rows, pointed, series_panel, short
from greenroof_ros.analysis.report.groups import SKY, Report, unique
from greenroof_ros.analysis.report.run import Row, controller_name
from greenroof_ros.model.site import Site

_GREY = "#555555"
_FULL_FLOW = "full flow; the pump cannot deliver more"
# Runs longer than this (h) have days on their axis.
_MOST_HOURS = 72.0
# Commands of 1e-3 and of 1 must both be visible: below this power of ten the axis is linear.
_LEAST_POWER = {"command": -3, "pump_flow": -2}


def trajectories(report: Report, rows: Sequence[Row], number: int) -> Figure:
    """Return the figure of command, flow and volumes over time (paper: Figs. 6-9).

    Args:
        report: all results.
        rows: runs of a window from the same initial state.
        number: of the window.
    """
    site, first = report.runs[rows[0]["run"]].site, rows[0]
    controllers = [
        name for name in report.controllers if any(row["controller"] == name for row in rows)
    ]
    unit, seconds = ("h", 3600.0) if first["hours"] <= _MOST_HOURS else ("days", 86400.0)
    time = alt.X(
        "t:Q", title=f"time since the start ({unit})",
        scale=alt.Scale(domain=[0, first["hours"] * 3600 / seconds], nice=False),
    )
    panels, data, ordered = [], {}, sorted(rows, key=lambda row: row["rank"])
    index = report.initials.index(first["from"]) + 1
    for quantity, title, axis in (
        ("command", "command", "command (1)"),
        ("pump_flow", "pump flow", "pump flow (L/s)"),
        ("cistern", "cistern", "cistern, x1 (m³)"),
        ("roof", "green roof", "green roof, x2 (m³)"),
    ):
        times = 1000 if quantity == "pump_flow" else 1
        curves = {
            row["run"]: [(t, times * v) for t, v in report.drawn[row["run"]].curves[quantity]]
            for row in rows
        }
        values = [value for curve in curves.values() for _, value in curve]
        domain, references = _axis(site, quantity, values)
        scale, ticks = alt.Scale(domain=domain, nice=False), alt.Axis()
        if quantity in _LEAST_POWER:
            least = _LEAST_POWER[quantity]
            scale = alt.Scale(type="symlog", constant=10.0**least, domain=domain, nice=False)
            ticks = alt.Axis(
                values=[0.0, *(10.0**power for power in range(least, 10))], format="~g"
            )
        for controller in controllers:
            dataset = f"{quantity}-{number}-{index}-{controller}"
            own = [row for row in ordered if row["controller"] == controller]
            labels = unique(own, [row["label"] for row in own])
            data[dataset] = [
                {"setting": label, "t": short(t / seconds), "v": short(v)}
                for label, row in zip(labels, own, strict=True) for t, v in curves[row["run"]]
            ]
            named = report.settings[controller].title
            lines = alt.Chart(alt.NamedData(dataset)).mark_line(clip=True, strokeWidth=1.8).encode(
                x=time,
                y=alt.Y("v:Q", title=axis, scale=scale, axis=ticks),
                tooltip=pointed(
                    ("setting:N", named),
                    alt.Tooltip("t:Q", title=f"time ({unit})", format=".4~g"), ("v:Q", axis),
                ),
            )
            panels.append(series_panel(
                lines, "setting", labels, f"{controller_name(controller)}: {title}",
                legend=named, zoom=True, below=[
                    *(_incidents(report, own, seconds) if quantity in _LEAST_POWER
                      else []),
                    *_reference_layers(domain, references, scale),
                ],
            ))
    return Figure(
        f"trajectories-{number}-{index}",
        report.title(f"Command, flow and volumes from {first['from']}", first),
        "Red: incidents" if any(report.runs[row["run"]].incidents for row in rows) else "",
        tuple(panels), len(controllers) if len(controllers) > 1 else len(panels), data,
    )


def _incidents(report: Report, rows: Sequence[Row], seconds: float) -> list[alt.Chart]:
    """Return the incidents of some runs as areas; one that is not over lasts to the run's end."""
    areas = []
    for row in rows:
        run, began = report.runs[row["run"]], report.drawn[row["run"]].start
        for incident in run.incidents:
            low, high = (
                tick * run.site.tau if tick is not None
                else (datetime.fromisoformat(time) - began).total_seconds() if time is not None
                else row["hours"] * 3600
                for tick, time in ((incident.began_tick, incident.began),
                                   (incident.ended_tick, incident.ended))
            )
            areas.append({
                "from": low / seconds, "to": high / seconds, "cause": incident.cause,
                "part": incident.subject, "run": row["run"],
            })
    return [
        alt.Chart(alt.InlineData(areas)).mark_rect(color="#a30000", opacity=0.2, clip=True).encode(
            x=alt.X("from:Q"), x2=alt.X2("to:Q"), tooltip=pointed("run:N", "part:N", "cause:N"),
        )
    ] if areas else []


def _axis(
    site: Site, quantity: str, values: Sequence[float]
) -> tuple[list[float], dict[str, float]]:
    """Return a quantity's axis range, the same in all panels, and its reference levels by name."""
    low, high = min(values), max(values)
    if quantity == "command":
        # On the logarithmic axis this leaves room for the text above the line.
        top = max(2.5 * high, 0.002)
        return [0.0, top], {_FULL_FLOW: 1.0} if top > 1.5 else {}
    span = max(high - low, 1e-3 * high) or 1.0

    def near(value: float) -> bool:
        return low - span / 2 <= value <= high + span / 2

    references = {"target": site.x2_star} if quantity == "roof" else {}
    if quantity == "cistern":
        references = {"outlet": site.a1 * site.z_o, "suction limit": site.a1 * site.suction_level}
        # Only if nearby: at the edge its label would overlap another.
        if site.low_outlet_level is not None and near(site.a1 * site.low_outlet_level):
            references["low outlet"] = site.a1 * site.low_outlet_level
    # Include references nearby; a reference far away would make all lines flat.
    inside = list(filter(near, references.values()))
    low, high = min([low, *inside]), max([high, *inside])
    margin = 0.12 * max(high - low, span)
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


def _clock(hours: float) -> str:
    """Return the time format of an axis of this many hours: its six labels must differ."""
    return "%H:%M:%S" if hours < 0.2 else "%H:%M" if hours <= 36 else "%d %b"


def weather(report: Report, rows: Sequence[Row], number: int) -> Figure:
    """Return the figure of rain and evapotranspiration over time (paper: Fig. 4).

    Args:
        report: all results.
        rows: runs of one site with the same weather, one for each method of evapotranspiration.
        number: of the figure.
    """
    runs = {row["evapotranspiration"]: report.drawn[row["run"]] for row in rows}
    start, curves, frozen = next(iter(runs.values()))
    offset = start.utcoffset()
    assert offset is not None
    # The axis is in UTC; times shifted by the offset show local time in every browser.
    origin = (start.timestamp() + offset.total_seconds()) * 1000
    area = report.runs[rows[0]["run"]].site.a2
    rain: Rows = [
        {"t": origin + time * 1000, "v": short(value * 3.6e6)}
        for time, value in curves["precipitation"]
    ]
    top = 1.05 * max(row["v"] for row in rain) or 1.0
    evaporation: Rows = [
        {"method": method, "t": origin + time * 1000, "v": short(value / area * 8.64e7)}
        for method, run in runs.items() for time, value in run.curves["evapotranspiration"]
    ]
    utc = alt.Scale(type="utc")
    x = alt.X(
        "t:T", scale=utc, title=f"local time (UTC{start.isoformat()[-6:]})",
        axis=alt.Axis(tickCount=6, format=_clock(rows[0]["hours"])),
    )
    when = alt.Tooltip(
        "t:T", title="from", timeUnit="utcyearmonthdatehoursminutes", format="%Y-%m-%d %H:%M"
    )
    frost = [
        alt.Chart(alt.InlineData([
            {"from": origin + low * 1000, "to": origin + high * 1000} for low, high in frozen
        ])).mark_rect(color="#999999", opacity=0.3).encode(
            x=alt.X("from:T", scale=utc), x2=alt.X2("to:T")
        )
    ] if frozen else []
    rained = alt.Chart(alt.NamedData(f"rain-{number}")).mark_area(
        interpolate="step-after", line={"color": "#0072B2"}, color="#56B4E9", clip=True
    ).encode(
        x=x, y=alt.Y("v:Q", title="rain (mm/h)", scale=alt.Scale(domain=[0, top])),
        tooltip=[when, alt.Tooltip("v:Q", title="mm/h")],
    )
    evaporated = alt.Chart(alt.NamedData(f"evapotranspiration-{number}")).mark_line(
        interpolate="step-after", clip=True
    ).encode(
        x=x, y=alt.Y("v:Q", title="evapotranspiration (mm/day)", scale=alt.Scale(zero=True)),
        tooltip=pointed("method:N", when, alt.Tooltip("v:Q", title="mm/day")),
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
