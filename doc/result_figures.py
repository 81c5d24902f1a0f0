"""The figures of the results whose numbers make a curve, in the style of the report."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import altair as alt
import vl_convert
from result_tables import read, roof

from greenroof_ros.analysis.report.drawing import COLOURS, CONFIG

_WIDTH, _HEIGHT = 290, 180
"""of a panel (px): narrow enough for a phone"""


class Point(NamedTuple):
    """A point of a curve.

    Attributes:
        panel: title of its panel.
        curve: name of its curve.
        x: horizontal position.
        y: vertical position.
        low: lower end of its 95 % interval.
        high: upper end.
    """

    panel: str
    curve: str
    x: float
    y: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Figure:
    """The content of a figure: titles of axes and curves, ends of the vertical axis, and points."""

    x: str
    y: str
    curves: str
    ends: tuple[float, float]
    points: tuple[Point, ...]

    @property
    def digest(self) -> str:
        """Identifies the numbers of the figure."""
        return hashlib.sha256(json.dumps(asdict(self)).encode()).hexdigest()


def horizons() -> Figure:
    """Return the deviation by horizon of forecasts with errors, and of perfect ones."""
    return Figure(
        "forecast horizon (h)", "deviation relative to on/off", "forecasts", (0.5, 1.0),
        tuple(
            Point(
                roof(row), "perfect" if row["forecast"] == "perfect" else "real skill",
                float(row["parameter:horizon"]),
                *(float(row[name]) for name in ("over_onoff", "low", "high")),
            )
            for row in read("horizons") if row["parameter:horizon"]
        ),
    )


def sizing() -> Figure:
    """Return the mains water that each cistern saves."""
    starts = {"site": "start at the mains level", "full": "start with a full cistern"}
    return Figure(
        "cistern (m³)", "mains water saved (m³)", "green roof", (0.0, 150.0),
        tuple(
            Point(
                starts[row["initial"]], f"{float(row['green_roof_m2']):g} m²",
                float(row["cistern_m3"]),
                *(float(row[name]) for name in ("saved_m3", "low", "high")),
            )
            for row in read("sizing")
        ),
    )


FIGURES: dict[str, Callable[[], Figure]] = {"horizons": horizons, "sizing": sizing}


def draw(figure: Figure) -> str:
    """Return a figure as SVG, with the digest of the numbers in it."""
    panels = dict.fromkeys(point.panel for point in figure.points)
    charts = [
        _panel(figure, panel).properties(title=panel, width=_WIDTH, height=_HEIGHT)
        for panel in panels
    ]
    chart = alt.vconcat(*charts, spacing=20).configure(**CONFIG)
    svg: str = vl_convert.vegalite_to_svg(chart.to_dict())
    return svg.replace("<svg ", f'<svg data-drawn-from="{figure.digest}" ', 1)


def _panel(figure: Figure, panel: str) -> alt.LayerChart:
    values = [point._asdict() for point in figure.points if point.panel == panel]
    curves = list(dict.fromkeys(point.curve for point in figure.points))
    ticks = sorted({point.x for point in figure.points})
    x: dict[str, Any] = {
        "scale": alt.Scale(type="log", nice=False, padding=12),
        "axis": alt.Axis(values=ticks, format="d"), "title": figure.x,
    }
    y = alt.Scale(domain=list(figure.ends), nice=False)
    legend = alt.Legend(titleOrient="top", columnPadding=20)
    colour = alt.Color(
        "curve:N", title=figure.curves, legend=legend,
        scale=alt.Scale(domain=curves, range=list(COLOURS[: len(curves)])),
    )
    base = alt.Chart(alt.Data(values=values)).encode(x=alt.X("x:Q", **x), color=colour)
    return alt.layer(
        base.mark_rule(strokeWidth=1.5, opacity=0.7).encode(
            y=alt.Y("low:Q", scale=y, title=figure.y), y2="high:Q"
        ),
        base.mark_line(strokeWidth=2).encode(y=alt.Y("y:Q", scale=y)),
        base.mark_point(filled=True, size=45, opacity=1).encode(
            y=alt.Y("y:Q", scale=y),
            shape=alt.Shape(
                "curve:N", title=figure.curves, legend=legend, scale=alt.Scale(domain=curves)
            ),
        ),
    )
