"""Figures over time: water, commands and flows, and forecasts; and the chart of simulations."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

import altair as alt
import numpy as np
from numpy.typing import NDArray

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
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.model.site import Site
from greenroof_ros.recording.trajectory import Trajectory

MOST_POINTS = 500
"""of a drawn line, about"""

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


class Drawn(NamedTuple):
    """A run with the curves that are drawn."""

    site: Site
    start: datetime
    """time of the first sample"""
    hours: float
    """length (h)"""
    curves: dict[str, list[tuple[float, float]]]
    """time (s) and value of about :data:`MOST_POINTS` samples, by attribute of the trajectory"""


def drawn(site: Site, trajectory: Trajectory) -> Drawn:
    """Return a run with the curves that are drawn."""
    curves = {}
    for name in (*_QUANTITIES, "precipitation"):
        values = getattr(trajectory, name)
        if name not in ("cistern", "roof"):
            # The run ends at the last sample: its flows never held, so draw the values before it.
            values = np.append(values[:-1], values[-2:-1])
        index = thin(values)
        times = trajectory.time[index].tolist()
        curves[name] = list(zip(times, values[index].tolist(), strict=True))
    hours = float(trajectory.time[-1]) / 3600 if len(trajectory.time) else 0.0
    return Drawn(site, trajectory.start, hours, curves)


def thin(values: NDArray[np.float64], most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Return the samples to draw: the first, the last, and the smallest and largest of each bucket.

    Args:
        values: shape (n,).
        most: number of samples to keep, about; all are kept if there are no more than this.
    """
    count = len(values)
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, (most - 2) // 2 + 1).astype(np.intp)
    indices = {0, count - 1}
    for low, high in itertools.pairwise(edges):
        indices.add(int(low + np.argmin(values[low:high])))
        indices.add(int(low + np.argmax(values[low:high])))
    return np.array(sorted(indices), dtype=np.intp)


class _Quantity(NamedTuple):
    """A quantity that is drawn over time."""

    title: str
    axis: str
    factor: Callable[[Site], float] = lambda site: 1000.0
    """from the unit of the curves to that of the axis"""


_QUANTITIES = {
    "roof": _Quantity("Roof", "roof level (mm)", lambda site: 1000 / site.a2),
    "cistern": _Quantity("Cistern", "cistern level (m)", lambda site: 1 / site.a1),
    "command": _Quantity("Command", "command (1)", lambda site: 1.0),
    "pump_flow": _Quantity("Pump flow", "pump flow (L/s)"),
    "outflow": _Quantity("Outflow to the sewer", "outflow (L/s)"),
}
_FIGURES = {
    "water": ("Water", ("roof", "cistern")),
    "flows": ("Commands and flows", ("command", "pump_flow", "outflow")),
}


def _lines(
    quantity: str, runs: Mapping[str, Drawn], start: datetime
) -> tuple[Rows, alt.Y, list[alt.Chart]]:
    """Return the points of a quantity's curves, its axis, and its reference levels.

    The sites' reference levels are drawn if all runs have the same.

    Args:
        quantity: to draw.
        runs: by the names of their lines.
        start: of the axis of time.
    """
    known = _QUANTITIES[quantity]
    rows: Rows = [
        {"controller": name, **point} for name, run in runs.items()
        for point in _points(run, start, quantity, known.factor(run.site))
    ]
    sites = [run.site for run in runs.values()]
    levels = {
        site.z_veg if quantity == "roof" else (site.z_o, site.suction_level, site.low_outlet_level)
        for site in sites
    }
    return rows, *_axis(
        sites[0] if len(levels) == 1 else None, quantity, known.axis,
        [row["v"] for row in rows if row["v"] is not None], known.factor(sites[0]),
    )


def overlaid(simulations: Mapping[str, tuple[Site, Trajectory]]) -> alt.VConcatChart:
    """Return the chart of simulations: rain, roof level, cistern and pump, with a line for each.

    Args:
        simulations: sites and trajectories, by the names of the lines. The rain is the longest's.

    Raises:
        ConfigurationError: they begin at different times.
    """
    runs = {name: drawn(*simulation) for name, simulation in simulations.items()}
    first, start = next((name, run.start) for name, run in runs.items())
    for name, run in runs.items():
        if run.start != start:
            raise ConfigurationError(
                f"begins at {to_minutes(run.start)}, but {first} at {to_minutes(start)}: one "
                "chart is of one time", key=name,
            )
    longest = max(runs.values(), key=lambda run: run.hours)
    x = _time(start, longest.hours)
    charts: list[Any] = [
        _rained(longest, x.title(None)).properties(width=_WIDTH, height=_RAIN_HEIGHT)
    ]
    series = distinct("controller", list(runs), "")
    legend = alt.Legend(symbolType="stroke", symbolSize=600, columns=4)
    for channel in series.values():
        channel.legend = legend if len(runs) > 1 else None
    for quantity in ("roof", "cistern", "pump_flow"):
        rows, y, references = _lines(quantity, runs, start)
        lines = alt.Chart(alt.InlineData(rows)).mark_line(clip=True, strokeWidth=1.6).encode(
            x=x if quantity == "pump_flow" else x.title(None), y=y, **series,
            tooltip=pointed("controller:N", _WHEN, ("v:Q", _QUANTITIES[quantity].axis)),
        )
        charts.append(alt.layer(*references, lines).properties(width=_WIDTH, height=_HEIGHT))
    chart: alt.VConcatChart = alt.vconcat(*charts, spacing=10).resolve_scale(
        x="shared", color="shared", strokeDash="shared"
    ).configure(**CONFIG).configure_axisY(minExtent=_EXTENT)
    return chart


def figures_over_time(
    runs: Mapping[str, Drawn], name: str, title: str
) -> list[Figure]:
    """Return the figures of water, and of commands and flows (paper: Figs. 4 and 6-9).

    Args:
        runs: of one window, by the names of their lines.
        name: end of the figures' names.
        title: end of their titles.
    """
    first = next(iter(runs.values()))
    x = _time(first.start, max(run.hours for run in runs.values()))
    figures = []
    for kind, (what, quantities) in _FIGURES.items():
        panels, data = [], {}
        if kind == "water":
            panels.append(Panel(_rained(first, x), "Rain"))
        for quantity in quantities:
            dataset, known = f"{quantity}-{name}", _QUANTITIES[quantity]
            data[dataset], y, references = _lines(quantity, runs, first.start)
            lines = alt.Chart(alt.NamedData(dataset)).mark_line(clip=True, strokeWidth=1.6).encode(
                x=x, y=y, tooltip=pointed("controller:N", _WHEN, ("v:Q", known.axis))
            )
            panels.append(series_panel(
                lines, "controller", list(runs), known.title, below=references,
                zoom=True,
            ))
        figures.append(Figure(f"{kind}-{name}", f"{what}{title}", "", tuple(panels), 3, data))
    return figures


def forecast_figure(
    forecasts: Sequence[tuple[float, float, float]], run: Drawn, trajectory: Trajectory, name: str,
    title: str,
) -> Figure:
    """Return the figure of the rain that was forecast, and of what fell in the same time.

    Args:
        forecasts: time of each (s since the start), how far it counts (s), and its rain (m).
        run: the run.
        trajectory: of the same run.
        name: end of the figure's name.
        title: end of its title.
    """
    steps = np.append(np.diff(trajectory.time), 0.0)
    fallen = np.concatenate([[0.0], np.cumsum(steps * trajectory.precipitation)[:-1]])
    issued, span, rain = np.array(forecasts).T
    came = np.interp(issued + span, trajectory.time, fallen) - np.interp(
        issued, trajectory.time, fallen
    )
    came[issued + span > trajectory.time[-1]] = np.nan
    origin = _origin(run.start)
    dataset = f"forecast-{name}"
    rows: Rows = [
        {"controller": series, "t": origin + 1000 * time, "v": short(1000 * value)}
        for series, values in (("forecast", rain), ("fell", came))
        for time, value in zip(issued.tolist(), values.tolist(), strict=True)
    ]
    lines = alt.Chart(alt.NamedData(dataset)).mark_line(clip=True, strokeWidth=1.6).encode(
        x=_time(run.start, run.hours), y=alt.Y("v:Q", title="rain (mm)"),
        tooltip=pointed("controller:N", _WHEN, ("v:Q", "mm")),
    )
    names, length = ["forecast", "fell"], round(float(span.max()))
    panel = series_panel(lines, "controller", names, f"Rain in the next {length} s", zoom=True)
    return Figure(
        f"forecast-{name}", f"Forecast{title}", "The mean of an ensemble's members", (panel,), 1,
        {dataset: rows},
    )


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


def _axis(
    site: Site | None, quantity: str, title: str, values: Sequence[float], factor: float
) -> tuple[alt.Y, list[alt.Chart]]:
    """Return a quantity's axis, the same in all panels, and its reference levels with their names.

    Args:
        site: with the tanks' reference levels; None for none.
        quantity: of the curves.
        title: of the axis.
        values: all that are drawn, in the axis' unit; there may be none.
        factor: from the volume in a tank (m3) to the axis' unit.
    """
    low, high = min(values, default=0.0), max(values, default=0.0)
    scale: dict[str, Any] = {"nice": False}
    axis = alt.Axis()
    if quantity in _LEAST_POWER:
        least = _LEAST_POWER[quantity]
        scale |= {"type": "symlog", "constant": 10.0**least}
        axis = alt.Axis(values=[0.0, *(10.0**power for power in range(least, 10))], format=".12~g")
    references: dict[str, float] = {}
    if quantity == "command":
        # On the logarithmic axis this leaves room for the text above the line.
        top = max(2.5 * high, 0.002)
        domain, references = [0.0, top], {_FULL_FLOW: 1.0} if top > 1.5 else {}
    elif quantity in ("pump_flow", "outflow"):
        domain = [0.0, 1.3 * high or 1.0]  # from 0, or no power of ten may be in it
    else:
        domain, references = _around(site, quantity, low, high, factor)
    scaled = alt.Scale(domain=domain, **scale)
    return (
        alt.Y("v:Q", title=title, scale=scaled, axis=axis),
        _reference_layers(references, scaled),
    )


def _around(
    site: Site | None, quantity: str, low: float, high: float, factor: float
) -> tuple[list[float], dict[str, float]]:
    """Return an axis range around values, and the reference levels nearby, if a site has them.

    A reference far away would make all lines flat.
    """
    span = max(high - low, 1e-3 * high) or 1.0
    references = {"target": factor * site.x2_star} if site and quantity == "roof" else {}
    if site and quantity == "cistern":
        area = factor * site.a1
        references = {"outlet": area * site.z_o, "suction limit": area * site.suction_level}
        if site.low_outlet_level is not None:
            references["low outlet"] = area * site.low_outlet_level
    references = {
        text: value for text, value in references.items()
        if low - span / 2 <= value <= high + span / 2
    }
    low, high = min([low, *references.values()]), max([high, *references.values()])
    margin = 0.1 * max(high - low, span)  # for the names above the lines
    return [max(0.0, low - margin), high + margin], references


def _reference_layers(
    references: Mapping[str, float], scale: alt.Scale
) -> list[alt.Chart]:
    """Return the reference lines with their names."""
    layers = []
    for text, value in references.items():
        base = alt.Chart(alt.InlineData([{"v": value, "text": text}]))
        y = alt.Y("v:Q", scale=scale)
        layers += [
            base.mark_rule(color=_GREY, strokeDash=[3, 2]).encode(y=y),
            base.mark_text(
                align="right", baseline="bottom", dx=-4, dy=-2, color="#333333", fontSize=10
            ).encode(x=alt.XValue("width"), y=y, text=alt.Text("text:N")),
        ]
    return layers


def _rained(run: Drawn, x: alt.X) -> alt.Chart:
    """Return the area of rain of a run, from above as in hydrology."""
    rows = _points(run, run.start, "precipitation", 3.6e6)
    top = 1.05 * max((row["v"] for row in rows if row["v"] is not None), default=0.0) or 1.0
    chart: alt.Chart = alt.Chart(alt.InlineData(rows)).mark_area(
        interpolate="step-after", line={"color": "#0072B2"}, color="#56B4E9", clip=True
    ).encode(
        x=x, tooltip=pointed(_WHEN, ("v:Q", "mm/h")),
        y=alt.Y("v:Q", title="rain (mm/h)", scale=alt.Scale(domain=[0, top], reverse=True)),
    )
    return chart
