"""Runs over time: the figure of a report, and the chart of simulations."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from typing import NamedTuple

import altair as alt
import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.figures import (
    CONFIG,
    Panel,
    PictureColumn,
    Rows,
    distinguish_series,
    round_value,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import to_minutes
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.site.site import Site

MAX_POINTS = 500
"""approximate number of points in a drawn line"""

# Runs longer than this (h) have no times of day on their axis.
_MAX_HOURS = 96.0
# Size of a panel, and height of the rain's (px).
_WIDTH, _HEIGHT, _RAIN_HEIGHT = 640, 130, 70
# Room for the numbers of an axis, so that the axes of a column are in line.
_EXTENT = 44


class _Quantity(NamedTuple):
    """A quantity that is drawn over time."""

    title: str
    unit: str
    factor: Callable[[Site], float] = lambda site: 1000.0
    """factor from the unit of the trajectory to that of the axis"""
    references: Callable[[Site], dict[str, float | None]] = lambda site: {}
    """levels to draw, in the axis' unit, by name; None for what a site does not have"""


_RAIN, _SEWER = "precipitation", "discharge"
_QUANTITIES = {
    _RAIN: _Quantity("rain", "mm/h", lambda site: 3.6e6),
    "roof": _Quantity(
        "roof level", "mm", lambda site: 1000 / site.a2,
        references=lambda site: {"target": 1000 * site.x2_star / site.a2},
    ),
    "cistern": _Quantity(
        "cistern level", "m", lambda site: 1 / site.a1,
        references=lambda site: {
            "overflow": site.z_o, "suction limit": site.suction_level,
            "low outlet": site.low_outlet_level,
        },
    ),
    "pump_flow": _Quantity("pump flow", "L/s"),
    _SEWER: _Quantity("to the sewer", "L/s"),
}


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


def draw_over_time(runs: Mapping[str, tuple[Site, Trajectory]]) -> list[Panel]:
    """Return a panel for rain, roof, cistern and pump, and for the sewer if water flows there.

    Args:
        runs: sites and trajectories, by the names of their lines. The rain is that of the longest
            run; the time axis begins with the first run, in its time zone.
    """
    (first, begun), *others = runs.values()
    longest = max((run.time[-1] if len(run.time) else 0.0, name) for name, (_, run) in runs.items())
    x = _time(begun.start, longest[0] / 3600)
    same = all(site == first for site, _ in others)
    panels = []
    for name, quantity in _QUANTITIES.items():
        rows: Rows = [
            {"case": label, "t": _origin(run.start.astimezone(begun.start.tzinfo)) + 1000 * time,
             "v": round_value(value)}
            for label, (site, run) in runs.items() if name != _RAIN or label == longest[1]
            for time, value in _select_points(name, site, run)
        ]
        values = [row["v"] for row in rows if row["v"] is not None]
        if name == _SEWER and not any(values):
            continue
        y, references = _axis(quantity, first if same else None, values, reverse=name == _RAIN)
        chart = alt.Chart(alt.InlineData(rows)).encode(x=x, y=y)
        if name == _RAIN:  # it hangs from the top, as is usual in hydrology
            panels.append(Panel(chart.mark_area(
                interpolate="step-after", line={"color": "#0072B2"}, color="#56B4E9", clip=True
            ), "", _RAIN_HEIGHT))
        else:
            series = distinguish_series("case", list(runs) if len(runs) > 1 else [])
            lines = chart.mark_line(clip=True, strokeWidth=1.6).encode(**series)
            panels.append(Panel(alt.layer(*references, lines), "", _HEIGHT))
    return panels


def _select_points(name: str, site: Site, run: Trajectory) -> Iterable[tuple[float, float]]:
    """Return times (s) and values of about :data:`MAX_POINTS` samples, in the axis' unit."""
    values = _QUANTITIES[name].factor(site) * (
        run.outflow + (1 - site.drainage_to_cistern) * run.drainage
        if name == _SEWER else getattr(run, name)
    )
    if name not in ("cistern", "roof"):
        # The run ends at the last sample: its flows never held, so the values before it are drawn.
        values = np.append(values[:-1], values[-2:-1])
    index = select_samples(values)
    return zip(run.time[index].tolist(), values[index].tolist(), strict=True)


def overlay_simulations(simulations: Mapping[str, tuple[Site, Trajectory]]) -> alt.VConcatChart:
    """Return a chart with the panels of :func:`draw_over_time` and a line per simulation.

    Args:
        simulations: sites and trajectories, by the names of the lines.

    Raises:
        ConfigurationError: if the simulations begin at different times.
    """
    first, start = next((name, run.start) for name, (_, run) in simulations.items())
    for name, (_, run) in simulations.items():
        if run.start != start:
            raise ConfigurationError(
                f"begins at {to_minutes(run.start)}, but {first} begins at {to_minutes(start)}: "
                "all runs in a chart must begin at the same time", key=name,
            )
    panels = draw_over_time(simulations)
    chart: alt.VConcatChart = PictureColumn(
        vconcat=[panel.sized(_WIDTH) for panel in panels], spacing=10
    ).resolve_scale(x="shared", color="shared", strokeDash="shared").configure(
        **CONFIG
    ).configure_axisY(minExtent=_EXTENT)
    return chart


def _origin(start: datetime) -> float:
    """Return a time (ms) for a UTC axis, so that every browser shows the run's local time."""
    return start.replace(tzinfo=timezone.utc).timestamp() * 1000


def _time(start: datetime, hours: float) -> alt.X:
    """Return a time axis; the labels at its six ticks must differ."""
    day = "utcFormat(datum.value, '%-d %b')"
    midnight = "utchours(datum.value) + utcminutes(datum.value) + utcseconds(datum.value) == 0"
    clock = f"utcFormat(datum.value, '{'%H:%M:%S' if hours < 0.2 else '%H:%M'}')"
    return alt.X(
        "t:T", title=f"from {start:%-d %B %Y}, UTC{start.isoformat()[-6:]}",
        scale=alt.Scale(type="utc", nice=False, domain=[
            _origin(start), _origin(start) + max(3.6e6 * hours, 1000.0),
        ]),
        axis=alt.Axis(
            tickCount=6, labelOverlap=True,
            labelExpr=f"{midnight} ? {day} : {clock}" if hours <= _MAX_HOURS else day,
        ),
    )


def _axis(
    quantity: _Quantity, site: Site | None, values: Sequence[float], *, reverse: bool
) -> tuple[alt.Y, list[alt.Chart]]:
    """Return a quantity's axis, and the reference levels with their names.

    A reference level far from the values is left out, because it would flatten all lines.

    Args:
        quantity: quantity of the curves.
        site: site with the reference levels; None for no levels.
        values: all drawn values, in the unit of the axis; the list may be empty.
        reverse: whether the axis begins at the top.
    """
    low, high = min(values, default=0.0), max(values, default=0.0)
    span = max(high - low, 1e-3 * high) or 1.0
    levels = {
        text: value for text, value in (quantity.references(site) if site else {}).items()
        if value is not None and low - span / 2 <= value <= high + span / 2
    }
    shown = low, high, *levels.values()
    low, high = min(shown), max(shown)
    margin = 0.1 * max(high - low, span)  # room for the names above the lines
    y = alt.Y("v:Q", title=f"{quantity.title} ({quantity.unit})", scale=alt.Scale(
        nice=False, domain=[max(0.0, low - margin), high + margin], reverse=reverse
    ))
    rows: Rows = [{"v": value, "text": text} for text, value in levels.items()]
    drawn = alt.Chart(alt.InlineData(rows)).encode(y=y)
    return y, [
        drawn.mark_rule(color="#555555", strokeDash=[3, 2]),
        drawn.mark_text(
            align="right", baseline="bottom", dx=-4, dy=-2, color="#333333", fontSize=10
        ).encode(x=alt.XValue("width"), text=alt.Text("text:N")),
    ] if levels else []
