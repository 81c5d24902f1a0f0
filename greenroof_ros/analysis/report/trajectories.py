"""Runs over time: the figure of a report, and the chart of simulations."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Any

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
_RAIN, _SEWER = "rain (mm/h)", "to the sewer (L/s)"


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


def _draw(site: Site, run: Trajectory) -> dict[str, tuple[NDArray[np.float64], dict[str, Any]]]:
    """Return the curve of each panel, and its reference levels, None for those that do not exist.

    The run ends at the last sample: its flows never held, so the values before it are drawn.
    """
    sewer = run.outflow + (1 - site.drainage_to_cistern) * run.drainage
    flows = {_RAIN: 3.6e6 * run.precipitation, "pump flow (L/s)": 1000 * run.pump_flow,
             _SEWER: 1000 * sewer}
    curves = {name: (np.append(flow[:-1], flow[-2:-1]), {}) for name, flow in flows.items()}
    return {
        _RAIN: curves[_RAIN],
        "roof level (mm)": (1000 / site.a2 * run.roof, {"target": 1000 * site.x2_star / site.a2}),
        "cistern level (m)": (run.cistern / site.a1, {
            "overflow": site.z_o, "suction limit": site.suction_level,
            "low outlet": site.low_outlet_level,
        }), **curves,
    }


def draw_over_time(runs: Mapping[str, tuple[Site, Trajectory]]) -> list[Panel]:
    """Return a panel for rain, roof, cistern and pump, and for the sewer if water flows there.

    Args:
        runs: sites and trajectories, by the names of their lines. The rain is that of the longest
            run; the time axis begins with the first run, in its time zone. Reference levels are
            drawn if the sites are the same.
    """
    (site, begun), *others = runs.values()
    longest = max(runs, key=lambda name: float(runs[name][1].time[-1]))
    hours = runs[longest][1].time[-1] / 3600
    x = alt.X(
        "t:T", title=f"from {begun.start:%-d %B %Y}, UTC{begun.start.isoformat()[-6:]}",
        scale=alt.Scale(type="utc", nice=False), axis=alt.Axis(
            tickCount=5, labelOverlap=True,
            format="%-d %b %H:%M" if hours <= _MAX_HOURS else "%-d %b",
        ),
    )
    curves, panels = {name: _draw(*run) for name, run in runs.items()}, []
    for title, (_, levels) in curves[longest].items():
        rows: Rows = []
        for name in [longest] if title == _RAIN else runs:
            run, values = runs[name][1], curves[name][title][0]
            index = select_samples(values)
            # Local time as if it were UTC, so that every browser shows it.
            local = run.start.astimezone(begun.start.tzinfo).replace(tzinfo=timezone.utc)
            rows += [
                {"case": name, "t": 1000 * (local.timestamp() + time), "v": round_value(value)}
                for time, value in zip(run.time[index].tolist(), values[index].tolist(), strict=True)
            ]
        if title == _SEWER and not any(row["v"] for row in rows):
            continue
        # Rain hangs from the top, as is usual in hydrology.
        y = alt.Y("v:Q", title=title, scale=alt.Scale(
            zero="level" not in title, nice=False, padding=10, reverse=title == _RAIN,
        ))
        chart = alt.Chart(alt.InlineData(rows)).encode(x=x, y=y)
        if title == _RAIN:
            area = chart.mark_area(interpolate="step-after", line={"color": "#0072B2"})
            panels.append(Panel(area.encode(color=alt.value("#56B4E9")), "", _RAIN_HEIGHT))
            continue
        marks = [{"v": value, "text": text} for text, value in levels.items() if value is not None]
        rule = alt.Chart(alt.InlineData(marks if [site] * len(others) == [
            other for other, _ in others
        ] else [])).encode(y=y)
        lines = chart.mark_line(strokeWidth=1.6).encode(
            **distinguish_series("case", list(runs) if others else [])
        )
        panels.append(Panel(alt.layer(
            rule.mark_rule(color="#555555", strokeDash=[3, 2]),
            rule.mark_text(align="right", baseline="bottom", dx=-4, dy=-2, color="#333333").encode(
                x=alt.XValue("width"), text="text:N"
            ), lines,
        ), "", _HEIGHT))
    return panels


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
