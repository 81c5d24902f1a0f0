"""The parts of all figures: panels, colours that everybody can distinguish, and files."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import altair as alt
import vl_convert

from greenroof_ros.base.files import add_path_to_errors

# Okabe and Ito's colours without yellow, which is too pale on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
# For readers who cannot see colours. The numbers of dashes and of colours have no common factor.
_DASHES = ([1, 0], [8, 3], [2, 2], [10, 3, 2, 3], [5, 2, 1, 2, 1, 2])
_SHAPES = ("circle", "square", "triangle-up", "diamond", "cross")
_PANEL_WIDTH = 400
VEGA_LITE = ".".join(alt.SCHEMA_VERSION.removeprefix("v").split(".")[:2])
CONFIG: dict[str, Any] = {
    "font": "Arial, Helvetica, sans-serif",
    "background": "white",
    "view": {"stroke": "#cccccc"},
    # Numbers of an axis closer than labelSeparation (px) read as one.
    "axis": {"labelFontSize": 11, "titleFontWeight": "normal", "labelSeparation": 6},
    "legend": {
        "orient": "bottom", "columns": 1, "labelFontSize": 11, "symbolStrokeWidth": 2,
        "labelLimit": 340, "symbolOpacity": 1,
    },
    "title": {"anchor": "start"},
}

Rows = list[dict[str, Any]]
Chart = alt.Chart | alt.LayerChart | alt.FacetChart
_Whole = TypeVar("_Whole", bound=Chart | alt.ConcatChart)


class Panel(NamedTuple):
    """One view of a figure."""

    chart: Chart
    """the chart, without size and title"""
    title: str
    height: int = 190
    """height of its plotting area (px)"""

    def sized(self, width: int | str = _PANEL_WIDTH) -> Chart:
        """Return the chart with its title and size; the width is in px, or ``container``."""
        sized: Chart = self.chart.properties(width=width, height=self.height, title=self.title)
        return sized


@dataclass(frozen=True)
class Figure:
    """A figure: its panels and their data.

    Attributes:
        name: name of the figure's files, without extension.
        title: title of the figure.
        caption: short explanation of the marks; it may be empty.
        panels: panels in reading order.
        columns: number of panels side by side.
        data: data rows, by the names that the panels use.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: int
    data: dict[str, Rows] = field(default_factory=dict)

    def chart(self) -> alt.ConcatChart:
        """Return the figure with its data as one chart."""
        whole: alt.ConcatChart = alt.ConcatChart(
            concat=[panel.sized() for panel in self.panels], columns=self.columns, title=self.title
        ).resolve_scale(color="independent", shape="independent", strokeDash="independent")
        return self._complete(whole)

    def _complete(self, chart: _Whole) -> _Whole:
        """Return a chart with the data and the look of the figure."""
        complete: _Whole = chart.configure(**CONFIG)
        complete.datasets = self.data
        return complete

    def pictures(self) -> list[str]:
        """Return the address of each panel as a picture, which contains the picture itself."""
        vectors = (_draw(self._complete(panel.sized())) for panel in self.panels)
        return [
            f"data:image/svg+xml;base64,{base64.b64encode(each.encode()).decode()}"
            for each in vectors
        ]

    def save(self, directory: Path) -> None:
        """Write the figure as SVG and as PNG."""
        vectors = _draw(self.chart())  # laid out once for both
        pixels = vl_convert.svg_to_png(vectors, scale=2)
        for ending, content in ((".svg", vectors.encode()), (".png", pixels)):
            file = directory / f"{self.name}{ending}"
            with add_path_to_errors(file):
                file.write_bytes(content)


def _draw(chart: Any) -> str:
    """Return a chart as SVG, without scripts."""
    return vl_convert.vegalite_to_svg(chart.to_dict(validate=False), VEGA_LITE)


def distinguish_series(name: str, values: list[str], *, points: bool = False) -> dict[str, Any]:
    """Distinguish the series of a field by colour, and lines by dashes or points by shape.

    Vega repeats them if there are too few. A single series needs no legend.
    """
    own: Any = ("strokeDash", alt.StrokeDash, _DASHES)
    legend = alt.Legend(symbolSize=600, symbolType="stroke")
    if points:
        own, legend = ("shape", alt.Shape, _SHAPES), alt.Legend(symbolSize=60)
    return {
        key: channel(
            f"{name}:N", title=None, scale=alt.Scale(domain=values, range=[*choices]),
            legend=legend if len(values) > 1 else None,
        ) for key, channel, choices in (("color", alt.Color, COLOURS), own)
    }


def draw_band(
    base: alt.Chart, name: str, ends: tuple[str, str] = ("_min", "_max"), form: str = ""
) -> Chart:
    """Draw the mean of a result as a line, and its range as a band.

    Args:
        base: chart with the data, x and the series.
        name: field of the mean.
        ends: endings of the names of the fields of the lower and the upper end.
        form: format of the result's axis; Vega's own if empty.
    """
    axis = alt.Axis(format=form) if form else alt.Axis()
    low, high = (name + end for end in ends)
    return alt.layer(
        base.mark_area(opacity=0.08, strokeOpacity=0).encode(
            y=alt.Y(f"{low}:Q", title=None, axis=axis), y2=alt.Y2(f"{high}:Q")
        ),
        base.mark_line(strokeWidth=2, point=True).encode(
            y=alt.Y(f"{name}:Q", title=None, scale=alt.Scale(zero=True))
        ),
    )


def round_value(value: float | None) -> float | None:
    """Return a value with as many digits as a figure can show; None if it is not finite."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.7g}")
