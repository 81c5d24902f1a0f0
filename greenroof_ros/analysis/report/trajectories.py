"""The figures over time (water, commands and flows), and the chart of simulations."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

import altair as alt
import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.figures import (
    CONFIG,
    Figure,
    Panel,
    PictureColumn,
    Rows,
    distinguish_series,
    make_tooltips,
    round_value,
    series_panel,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import to_minutes
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.site.site import Site

MAX_POINTS = 500
"""approximate number of points in a drawn line"""

# The pointer finds the tooltips of points that are too small to see.
_MARK: dict[str, Any] = {"clip": True, "strokeWidth": 1.6, "point": "transparent"}
# Runs longer than this (h) have no times of day on their axis.
_MAX_HOURS = 96.0
# The chart of simulations: width and height of a panel, and of the rain's (px).
_WIDTH, _HEIGHT, _RAIN_HEIGHT = 640, 130, 70
# The names of reference levels closer than this share of the axis would overlap.
_CLOSE = 0.1
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
    """times (s) and values of about :data:`MAX_POINTS` samples, by attribute of the trajectory"""


def select_curves(site: Site, trajectory: Trajectory) -> Drawn:
    """Return a run with the curves that are drawn."""
    curves = {}
    drained = (1 - site.drainage_to_cistern) * trajectory.drainage
    computed = {"discharge": trajectory.outflow + drained}
    for name in (*_QUANTITIES, "precipitation"):
        values = computed[name] if name in computed else getattr(trajectory, name)
        if name not in ("cistern", "roof"):
            # The run ends at the last sample: its flows never held, so the values before it are
            # drawn.
            values = np.append(values[:-1], values[-2:-1])
        index = select_samples(values)
        times = trajectory.time[index].tolist()
        curves[name] = list(zip(times, values[index].tolist(), strict=True))
    hours = float(trajectory.time[-1]) / 3600 if len(trajectory.time) else 0.0
    return Drawn(site, trajectory.start, hours, curves)


def select_samples(values: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the samples to draw: the first, the last, and the minimum and maximum of every bucket.

    Args:
        values: values, shape (n,); all values are kept if there are no more than
            :data:`MAX_POINTS`.
    """
    count = len(values)
    if count <= MAX_POINTS:
        return np.arange(count)
    edges = np.linspace(0, count, (MAX_POINTS - 2) // 2 + 1).astype(np.intp)
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
    """factor from the unit of the curves to that of the axis"""
    min_power: int | None = None
    """the axis is linear below this power of ten, and logarithmic above it"""
    references: Callable[[Site], dict[str, float | None]] = lambda site: {}
    """levels to draw, in the axis' unit, by name; None for what a site does not have"""


_QUANTITIES = {
    "roof": _Quantity(
        "Roof", "roof level (mm)", lambda site: 1000 / site.a2,
        references=lambda site: {"target": 1000 * site.x2_star / site.a2},
    ),
    "cistern": _Quantity(
        "Cistern", "cistern level (m)", lambda site: 1 / site.a1,
        references=lambda site: {
            "overflow": site.z_o, "suction limit": site.suction_level,
            "low outlet": site.low_outlet_level,
        },
    ),
    # Commands of 1e-3 and of 1 must both be visible.
    "command": _Quantity("Command", "command (1)", lambda site: 1.0, -3, lambda site: {
        "full flow; the pump cannot deliver more": 1.0
    }),
    "pump_flow": _Quantity("Pump flow", "pump flow (L/s)", min_power=-2),
    "outflow": _Quantity("Outflow to the sewer", "outflow (L/s)"),
    "discharge": _Quantity("To the sewer", "to the sewer (L/s)"),
}
_FIGURES = {
    "water": ("Water", ("roof", "cistern")),
    "flows": ("Commands and flows", ("command", "pump_flow", "outflow")),
}


def _lines(
    quantity: str, runs: Mapping[str, Drawn], x: alt.X, data: str = ""
) -> tuple[alt.Chart, list[alt.Chart], Rows]:
    """Return a quantity's lines, the reference levels below them, and the points of the lines.

    Args:
        quantity: quantity to draw.
        runs: runs by the names of their lines; the time axis is in the time zone of the first run.
        x: time axis.
        data: name of the data set with the points; if it is empty, the chart itself contains the
            points.
    """
    known, (first, *others) = _QUANTITIES[quantity], runs.values()
    rows: Rows = [
        {"controller": name, **point} for name, run in runs.items()
        for point in _points(run, first.start, quantity, known.factor(run.site))
    ]
    y, references = _axis(
        known, first.site if all(run.site == first.site for run in others) else None,
        [row["v"] for row in rows if row["v"] is not None],
    )
    lines = alt.Chart(alt.NamedData(data) if data else alt.InlineData(rows)).mark_line(
        **_MARK
    ).encode(x=x, y=y, tooltip=make_tooltips("controller:N", _WHEN, ("v:Q", known.axis)))
    return lines, references, rows


def overlay_simulations(simulations: Mapping[str, tuple[Site, Trajectory]]) -> alt.VConcatChart:
    """Return a chart of rain, roof level, cistern level and pump flow, with a line per simulation.

    If any water reaches the sewer, the chart also has a panel for this flow.

    Args:
        simulations: sites and trajectories, by the names of the lines. The rain is that of the
            longest simulation.

    Raises:
        ConfigurationError: if the simulations begin at different times.
    """
    runs = {name: select_curves(*simulation) for name, simulation in simulations.items()}
    first, start = next((name, run.start) for name, run in runs.items())
    for name, run in runs.items():
        if run.start != start:
            raise ConfigurationError(
                f"begins at {to_minutes(run.start)}, but {first} begins at {to_minutes(start)}: "
                "all runs in a chart must begin at the same time", key=name,
            )
    longest = max(runs.values(), key=lambda run: run.hours)
    x = _time(start, longest.hours)
    charts: list[Any] = [
        _rained(longest, x.title(None)).properties(width=_WIDTH, height=_RAIN_HEIGHT)
    ]
    series = distinguish_series("controller", list(runs))
    legend = alt.Legend(symbolType="stroke", symbolSize=600, columns=4)
    for channel in series.values():
        channel.legend = legend if len(runs) > 1 else None
    quantities = ["roof", "cistern", "pump_flow"]
    if any(flow > 0 for run in runs.values() for _, flow in run.curves["discharge"]):
        quantities.append("discharge")
    for quantity in quantities:
        axis = x if quantity == quantities[-1] else x.title(None)
        lines, references, _ = _lines(quantity, runs, axis)
        charts.append(alt.layer(*references, lines.encode(**series)).properties(
            width=_WIDTH, height=_HEIGHT
        ))
    chart: alt.VConcatChart = PictureColumn(vconcat=charts, spacing=10).resolve_scale(
        x="shared", color="shared", strokeDash="shared"
    ).configure(**CONFIG).configure_axisY(minExtent=_EXTENT)
    return chart


def figures_over_time(
    runs: Mapping[str, Drawn], name: str, title: str
) -> list[Figure]:
    """Return the figures of water, and of commands and flows (paper: Figs. 4 and 6-9).

    Args:
        runs: runs of one window, by the names of their lines.
        name: last part of the figures' names.
        title: last part of the figures' titles.
    """
    first = next(iter(runs.values()))
    x = _time(first.start, max(run.hours for run in runs.values()))
    figures = []
    for kind, (what, quantities) in _FIGURES.items():
        panels, data = [], {}
        if kind == "water":
            panels.append(Panel(_rained(first, x), "Rain"))
        for quantity in quantities:
            dataset = f"{quantity}-{name}"
            lines, references, data[dataset] = _lines(quantity, runs, x, dataset)
            panels.append(series_panel(
                lines, "controller", list(runs), _QUANTITIES[quantity].title, references,
            ))
        figures.append(Figure(f"{kind}-{name}", f"{what}{title}", "", tuple(panels), 3, data))
    return figures


_WHEN = alt.Tooltip(
    "t:T", title="time", timeUnit="utcyearmonthdatehoursminutesseconds", format="%Y-%m-%d %H:%M:%S"
)


def _origin(start: datetime) -> float:
    """Return a time (ms) for a UTC axis, so that every browser shows the run's local time."""
    offset = start.utcoffset()
    assert offset is not None, "the start of a run must have an offset from UTC"
    return (start.timestamp() + offset.total_seconds()) * 1000


def _points(run: Drawn, start: datetime, quantity: str, factor: float) -> Rows:
    """Return the points of a curve, at the UTC offset of ``start``.

    Args:
        run: run with the curve.
        start: start of the axis; the run can begin at another time.
        quantity: quantity of the curve.
        factor: factor from the unit of the curve to that of the axis.
    """
    origin = _origin(run.start.astimezone(start.tzinfo))
    return [
        {"t": origin + 1000 * time, "v": round_value(factor * value)}
        for time, value in run.curves[quantity]
    ]


def _time(start: datetime, hours: float) -> alt.X:
    """Return a time axis; the labels at its six ticks must differ."""
    day = "utcFormat(datum.value, '%-d %b')"
    midnight = "utchours(datum.value) + utcminutes(datum.value) + utcseconds(datum.value) == 0"
    clock = f"utcFormat(datum.value, '{'%H:%M:%S' if hours < 0.2 else '%H:%M'}')"
    return alt.X(
        "t:T",
        title=f"from {start:%-d %B %Y}, UTC{start.isoformat()[-6:]}",
        scale=alt.Scale(type="utc", nice=False, domain=[
            _origin(start), _origin(start) + max(3.6e6 * hours, 1000.0),
        ]),
        axis=alt.Axis(
            tickCount=6, labelOverlap=True,
            labelExpr=f"{midnight} ? {day} : {clock}" if hours <= _MAX_HOURS else day,
        ),
    )


def _axis(
    quantity: _Quantity, site: Site | None, values: Sequence[float]
) -> tuple[alt.Y, list[alt.Chart]]:
    """Return a quantity's axis, the same in all panels, and its reference levels with their names.

    A reference level far from the values is left out, because it would flatten all lines.

    Args:
        quantity: quantity of the curves.
        site: site with the reference levels; None for no levels.
        values: all drawn values, in the unit of the axis; the list may be empty.
    """
    low, high = min(values, default=0.0), max(values, default=0.0)
    span = max(high - low, 1e-3 * high) or 1.0
    references = {
        text: value for text, value in (quantity.references(site) if site else {}).items()
        if value is not None and low - span / 2 <= value <= high + span / 2
    }
    low, high = min([low, *references.values()]), max([high, *references.values()])
    margin = 0.1 * max(high - low, span)  # room for the names above the lines
    scale: dict[str, Any] = {"nice": False, "domain": [max(0.0, low - margin), high + margin]}
    axis = alt.Axis()
    if quantity.min_power is not None:
        powers = range(quantity.min_power, 10)
        # From 0, otherwise it may contain no power of ten; this leaves room for the names.
        scale |= {
            "type": "symlog", "constant": 10.0**quantity.min_power,
            "domain": [0.0, max(2.5 * high, 2 * 10.0**quantity.min_power)],
        }
        axis = alt.Axis(values=[0.0, *(10.0**power for power in powers)], format=".12~g")
    scaled = alt.Scale(**scale)
    layers = []
    names: list[tuple[float, str]] = []  # levels that are close share one label
    for text, value in sorted(references.items(), key=lambda item: item[1], reverse=True):
        if names and names[-1][0] - value < _CLOSE * (high - low):
            names[-1] = names[-1][0], f"{names[-1][1]}, {text}"
        else:
            names.append((value, text))
    y = alt.Y("v:Q", scale=scaled)
    if references:
        lines = alt.InlineData([{"v": value} for value in references.values()])
        layers = [
            alt.Chart(lines).mark_rule(color="#555555", strokeDash=[3, 2]).encode(y=y),
            alt.Chart(alt.InlineData([{"v": v, "text": text} for v, text in names])).mark_text(
                align="right", baseline="bottom", dx=-4, dy=-2, color="#333333", fontSize=10
            ).encode(x=alt.XValue("width"), y=y, text=alt.Text("text:N")),
        ]
    return alt.Y("v:Q", title=quantity.axis, scale=scaled, axis=axis), layers


def _rained(run: Drawn, x: alt.X) -> alt.Chart:
    """Return the rain of a run as an area that hangs from the top, as is usual in hydrology."""
    rows = _points(run, run.start, "precipitation", 3.6e6)
    top = 1.05 * max((row["v"] for row in rows if row["v"] is not None), default=0.0) or 1.0
    chart: alt.Chart = alt.Chart(alt.InlineData(rows)).mark_area(
        interpolate="step-after", line={"color": "#0072B2"}, color="#56B4E9", clip=True
    ).encode(
        x=x, tooltip=make_tooltips(_WHEN, ("v:Q", "mm/h")),
        y=alt.Y("v:Q", title="rain (mm/h)", scale=alt.Scale(domain=[0, top], reverse=True)),
    )
    return chart
