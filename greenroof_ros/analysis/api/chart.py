"""The chart of one or more simulations over time: rain, roof, cistern, pump."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any, NamedTuple

import altair as alt
import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.report.bags import thin
from greenroof_ros.analysis.report.drawing import CONFIG, Rows, distinct, short
from greenroof_ros.model.site import Site
from greenroof_ros.recording.trajectory import Trajectory

_WIDTH, _HEIGHT, _RAIN_HEIGHT = 640, 130, 70
_LEGEND_COLUMNS = 4
# Room for the numbers, the same in all panels, so that their titles are in line.
_AXIS = alt.Axis(minExtent=44)
# Above this ratio of the runs' largest flows their axis is logarithmic.
_MOST_RATIO = 20.0
# Up to this length (h) the axis has times of day.
_MOST_HOURS = 96


class _Panel(NamedTuple):
    """A panel of lines, one for each trajectory."""

    quantity: str
    """an attribute of the trajectory"""
    title: str
    factor: float
    """from the trajectory's unit to the panel's"""
    holds: bool
    """whether a value holds until the next"""
    marked: dict[str, float]
    """levels with a name, in the panel's unit"""


def _panels(site: Site) -> list[_Panel]:
    return [
        _Panel("roof", "roof level (mm)", 1000 / site.a2, False, {"target": 1000 * site.z_veg}),
        _Panel("cistern", "cistern level (m)", 1 / site.a1, False, {
            "outlet": site.lowest_outlet, "pump minimum": site.suction_level,
        }),
        _Panel("pump_flow", "pump flow (L/s)", 1000.0, True, {}),
    ]


def overlaid(site: Site, trajectories: Mapping[str, Trajectory]) -> alt.VConcatChart:
    """Return a chart with a line for each trajectory, and the rain of the first.

    Args:
        site: their site, with target and outlet.
        trajectories: by the names of the lines; a single one has no legend.
    """
    names = list(trajectories)
    first = trajectories[names[0]]
    start, length = first.start, max(each.time[-1] for each in trajectories.values())
    rain = _rows(first, start, first.precipitation * 3.6e6, holds=True)
    top = 1.1 * max(row["v"] for row in rain) or 1.0
    charts: list[Any] = [alt.Chart(alt.InlineData(rain)).mark_area(
        interpolate="step-after", color="#56B4E9", line={"color": "#0072B2", "strokeWidth": 1},
    ).encode(
        x=_time_axis(start, length, labelled=False), tooltip=_tooltip("mm/h"),
        y=alt.Y("v:Q", title="rain (mm/h)", axis=_AXIS,
                scale=alt.Scale(domain=[0, top], reverse=True, nice=False)),
    ).properties(width=_WIDTH, height=_RAIN_HEIGHT)]
    series = distinct("name", names, "")
    legend = alt.Legend(symbolType="stroke", symbolSize=600, columns=_LEGEND_COLUMNS)
    for channel in series.values():
        channel.legend = legend if len(names) > 1 else None
    panels = _panels(site)
    for panel in panels:
        points = {name: _rows(
            each, start, getattr(each, panel.quantity) * panel.factor, panel.holds
        ) for name, each in trajectories.items()}
        rows: Rows = [{"name": name, **row} for name, own in points.items() for row in own]
        y = alt.Y("v:Q", title=panel.title, axis=_AXIS, scale=alt.Scale(zero=panel.holds))
        if panel.holds:
            y = _flow_axis(y, [max(row["v"] for row in own) for own in points.values()])
        lines = alt.Chart(alt.InlineData(rows)).mark_line(
            interpolate="step-after" if panel.holds else "linear", strokeWidth=1.6,
        ).encode(
            x=_time_axis(start, length, labelled=panel is panels[-1]), y=y, **series,
            tooltip=[alt.Tooltip("name:N", title="controller"), *_tooltip(panel.title)],
        )
        charts.append(alt.layer(lines, *_marks(panel, rows, y)).properties(
            width=_WIDTH, height=_HEIGHT))
    chart: alt.VConcatChart = alt.vconcat(*charts, spacing=10).resolve_scale(
        x="shared", color="shared", strokeDash="shared"
    ).configure(**CONFIG)
    return chart


def _flow_axis(y: alt.Y, peaks: list[float]) -> alt.Y:
    """Return an axis on which small flows are seen beside large ones; linear if there are none."""
    running = [peak for peak in peaks if peak > 0]
    if not running or max(running) <= _MOST_RATIO * min(running):
        return y
    least = 10.0 ** math.floor(math.log10(min(running)))
    powers = range(round(math.log10(least)), 1 + math.floor(math.log10(max(running))))
    scaled: alt.Y = y.scale(type="symlog", constant=least, domain=[0, 1.3 * max(running)])
    return scaled.axis(
        values=[0.0, *(10.0**power for power in powers)], format="~g", labelOverlap=False,
        minExtent=_AXIS.minExtent,
    )


def _rows(
    trajectory: Trajectory, start: datetime, values: NDArray[np.float64], holds: bool
) -> Rows:
    """Return the points of a line, with its smallest and largest values.

    Times are shifted so that an axis in UTC shows the start's local time in every browser.
    """
    if holds:  # the run ends at the last sample: its flows are not applied
        values = np.append(values[:-1], values[-2])
    kept = thin(values)
    offset = start.utcoffset()
    assert offset is not None, "a run's start has its offset"
    origin = (trajectory.start.timestamp() + offset.total_seconds()) * 1000
    return [
        {"t": origin + 1000 * second, "v": short(value)}
        for second, value in zip(
            trajectory.time[kept].tolist(), values[kept].tolist(), strict=True)
    ]


def _time_axis(start: datetime, seconds: float, *, labelled: bool) -> alt.X:
    """Return an axis with dates, and times of day if the run is short."""
    if not labelled:
        return alt.X("t:T", title=None, scale=alt.Scale(type="utc", nice=False), axis=alt.Axis(
            labels=False, ticks=False, tickCount=10))
    time, day = "utcFormat(datum.value, '%H:%M')", "utcFormat(datum.value, '%-d %b')"
    midnight = "utchours(datum.value) + utcminutes(datum.value) == 0"
    label = f"{midnight} ? {day} : {time}" if seconds <= 3600 * _MOST_HOURS else day
    return alt.X(
        "t:T", title=f"from {start:%-d %B %Y, %H:%M} on, local time (UTC{start.isoformat()[-6:]})",
        scale=alt.Scale(type="utc", nice=False),
        axis=alt.Axis(labelExpr=label, tickCount=10, labelOverlap=True),
    )


def _tooltip(title: str) -> list[alt.Tooltip]:
    return [
        alt.Tooltip("t:T", title="time", timeUnit="utcyearmonthdatehoursminutesseconds"),
        alt.Tooltip("v:Q", title=title, format=".4~g"),
    ]


def _marks(panel: _Panel, rows: Rows, y: alt.Y) -> list[alt.Chart]:
    """Return a dashed line with its name for each marked level near the values."""
    low, high = (end(row["v"] for row in rows) for end in (min, max))
    margin = 0.5 * (high - low)
    marks: Rows = [
        {"v": level, "mark": name} for name, level in panel.marked.items()
        if low - margin <= level <= high + margin or name == "target"
    ]
    if not marks:
        return []
    base = alt.Chart(alt.InlineData(marks)).encode(y=y)
    return [
        base.mark_rule(color="#555555", strokeDash=[5, 3]),
        # Beside the panel, where no line crosses it.
        base.mark_text(align="left", dx=5, color="#333333", fontSize=11).encode(
            text="mark:N", x=alt.value(_WIDTH)),
    ]
