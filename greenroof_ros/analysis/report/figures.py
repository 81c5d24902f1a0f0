"""The figures of a report: the comparison of cases and their seasons, and runs over time.

The chart of simulations is that of runs over time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from datetime import timezone
from typing import Any

import altair as alt
import numpy as np
import polars
from numpy.typing import NDArray

from greenroof_ros.analysis import figures
from greenroof_ros.analysis.report.runs import Report
from greenroof_ros.analysis.tables import BOUNDS, COLUMNS
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.site.site import Site

# With more cases than colours, only the best ones are drawn over time.
_MAX_CASES = len(figures.COLOURS)


def make_figures(report: Report) -> Iterator[figures.Figure]:
    """Yield the figures: of the places with several runs, and of the first one over time.

    Raises:
        ConfigurationError: if the trajectory of a run cannot be read.
    """
    if compared := [_compare(each, report) for each in report.places if each["runs"].sum() > 1]:
        yield figures.Figure(
            "comparison", "Comparison of the cases", "Large points are means, small ones seasons; "
            "lines extend from the lowest to the highest run", tuple(compared),
            min(len(compared), 2),
        )
    best = report.places[0].head(_MAX_CASES).filter(runs=1)
    runs = {
        case: (run.site, trajectory) for case, first in best.select("case", "first").rows()
        if (trajectory := (run := report.sources.runs[first]).trajectory()) is not None
    }
    if runs:
        title = f"Rain, levels and flows, {best['place'][0]}".removesuffix(", ")
        yield figures.Figure("time", title, "", tuple(draw_over_time(runs)), 2)


def _compare(place: polars.DataFrame, report: Report) -> figures.Panel:
    """Plot the first shown metric against the second one or, if there is none, pumped water."""
    y, x, *_ = *report.show, "pumped_m3"
    rows = place.drop_nulls([x, y]).to_dicts()
    bound = [place.to_dicts()[0].get(BOUNDS.get(name, "")) for name in (x, y)]
    if None not in bound:
        rows.append({"case": "minimum possible", x: bound[0], y: bound[1]})
    points = figures.distinguish_series("case", [row["case"] for row in rows], points=True)
    years = report.years.drop_nulls(["year", x, y]).filter(place=place["place"][0])
    base = alt.Chart(alt.InlineData(rows)).encode(
        x=_axis(alt.X, x), y=_axis(alt.Y, y), color=points["color"]
    )
    return figures.Panel(alt.layer(
        base.mark_rule(opacity=0.5).encode(x=f"{x}_min:Q", x2=f"{x}_max:Q"),
        base.mark_rule(opacity=0.5).encode(y=f"{y}_min:Q", y2=f"{y}_max:Q"),
        base.mark_point(opacity=0.5, size=15).encode(shape=points["shape"]).properties(
            data=alt.InlineData(years.select("case", x, y).to_dicts())
        ),
        base.mark_point(filled=True, opacity=1, size=80).encode(**points),
    ), place["place"][0], 280)


def _axis(axis: Any, metric: str) -> Any:
    """Return the axis of a metric."""
    column = COLUMNS[metric]
    form = alt.Axis(format="%" if column.unit == "%" else alt.Undefined)
    return axis(f"{metric}:Q", title=column.heading, axis=form)


MAX_POINTS = 500
"""approximate number of points in a drawn line"""

# Runs longer than this (h) have no times of day on their axis.
_MAX_HOURS = 96.0
# Size of a panel, and height of the rain's (px).
_WIDTH, _HEIGHT, _RAIN_HEIGHT = 640, 130, 70
# Room for the numbers of an axis, so that the axes of a column are in line.
_EXTENT = 44
_RAIN, _SEWER, _OPENING = "rain (mm/h)", "to the sewer (L/s)", "valve opening (1)"

# The curve of each panel, by its title.
_CURVES: dict[str, Callable[[Site, Trajectory], NDArray[np.float64]]] = {
    _RAIN: lambda site, run: 3.6e6 * run.precipitation,
    "roof level (mm)": lambda site, run: 1000 / site.a2 * run.roof,
    "cistern level (m)": lambda site, run: run.cistern / site.a1,
    "pump flow (L/s)": lambda site, run: 1000 * run.pump_flow,
    _SEWER: lambda site, run: 1000 * (
        run.outflow + (1 - site.drainage_to_cistern) * run.drainage
    ),
    _OPENING: lambda site, run: np.zeros_like(run.time) if run.outlet is None else run.outlet,
}
# The reference levels of a panel; None for what a site does not have.
_LEVELS: dict[str, Callable[[Site], dict[str, float | None]]] = {
    "roof level (mm)": lambda site: {"target": 1000 * site.x2_star / site.a2},
    "cistern level (m)": lambda site: {"overflow": site.z_o, "low outlet": site.low_outlet_level},
}


def select_samples(values: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the samples to draw: the first, the last, and the minimum and maximum of every bucket.

    Args:
        values: at least one value, shape (n,); all values are kept if there are no more than
            :data:`MAX_POINTS`.
    """
    count = len(values)
    size = -(-count // (MAX_POINTS // 2))
    buckets = np.pad(values, (0, -count % size), mode="edge").reshape(-1, size)
    first = size * np.arange(len(buckets))
    extremes = first + buckets.argmin(axis=1), first + buckets.argmax(axis=1)
    return np.unique(np.minimum(np.concatenate([*extremes, [0, count - 1]]), count - 1))


def draw_over_time(runs: Mapping[str, tuple[Site, Trajectory]]) -> list[figures.Panel]:
    """Return a panel for rain, roof, cistern and pump, and for sewer and valve if they are used.

    Args:
        runs: sites and trajectories of at least two samples, by the names of their lines. The rain
            is that of the longest run; the time axis begins with the first run, in its time zone.
            Reference levels are drawn if the sites are the same.
    """
    (site, first), *others = runs.values()
    longest = max(runs, key=lambda name: float(runs[name][1].time[-1]))
    hours = runs[longest][1].time[-1] / 3600
    axis = alt.Axis(
        tickCount=5, labelOverlap=True,
        format="%-d %b %H:%M" if hours <= _MAX_HOURS else "%-d %b",
    )
    x = alt.X(
        "t:T", title=f"from {first.start:%-d %B %Y}, UTC{first.start.isoformat()[-6:]}", axis=axis,
        scale=alt.Scale(type="utc", nice=False),
    )
    panels = []
    for title, curve in _CURVES.items():
        rows: figures.Rows = []
        for name in [longest] if title == _RAIN else runs:
            own, run = runs[name]
            values = curve(own, run)
            if title not in _LEVELS:  # flows after the last sample never held
                values = np.append(values[:-1], values[-2])
            # Local time as if it were UTC, so that every browser shows it.
            start = run.start.astimezone(first.start.tzinfo).replace(tzinfo=timezone.utc)
            rows += [
                {"case": name, "t": 1000 * (start.timestamp() + float(run.time[index])),
                 "v": figures.round_value(float(values[index]))} for index in select_samples(values)
            ]
        if title in (_SEWER, _OPENING) and not any(row["v"] for row in rows):
            continue
        y = alt.Y("v:Q", title=title, scale=alt.Scale(
            # Rain hangs from the top, as is usual in hydrology.
            zero=title not in _LEVELS, nice=False, padding=10, reverse=title == _RAIN,
        ))
        chart: Any = alt.Chart(alt.InlineData(rows)).encode(x=x, y=y)
        if title == _RAIN:
            area = chart.mark_area(interpolate="step-after", line={"color": "#0072B2"})
            panels.append(figures.Panel(area.encode(color=alt.value("#56B4E9")), "", _RAIN_HEIGHT))
            continue
        series = figures.distinguish_series("case", list(runs))
        chart = chart.mark_line(strokeWidth=1.6).encode(**series)
        if title in _LEVELS and all(other == site for other, _ in others):
            levels = _LEVELS[title](site).items()
            rule: Any = alt.Chart(alt.InlineData(
                [{"v": value, "text": text} for text, value in levels if value is not None]
            )).encode(y=y)
            chart = rule.mark_rule(color="#555555", strokeDash=[3, 2]) + rule.mark_text(
                align="right", baseline="bottom", dx=-4, dy=-2
            ).encode(x=alt.XValue("width"), text="text:N") + chart
        panels.append(figures.Panel(chart, "", _HEIGHT))
    return panels


def overlay_simulations(simulations: Mapping[str, tuple[Site, Trajectory]]) -> alt.VConcatChart:
    """Return a chart with the panels of :func:`draw_over_time` and a line per simulation.

    Args:
        simulations: sites and trajectories, by the names of the lines.
    """
    chart: alt.VConcatChart = alt.VConcatChart(
        vconcat=[panel.sized(_WIDTH) for panel in draw_over_time(simulations)], spacing=10
    ).resolve_scale(x="shared", color="shared", strokeDash="shared").configure(
        **figures.CONFIG
    ).configure_axisY(minExtent=_EXTENT)
    return chart
