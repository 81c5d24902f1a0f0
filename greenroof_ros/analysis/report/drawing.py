"""The parts of every figure: panels, colours that everybody can distinguish, and its files."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import altair as alt
import vl_convert

from greenroof_ros.common.files import naming

# Okabe and Ito's colours without yellow, which is too pale on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
# For readers who cannot see colours. The numbers of dashes and colours have no common factor.
_DASHES = ([1, 0], [8, 3], [2, 2], [10, 3, 2, 3], [5, 2, 1, 2, 1, 2])
SHAPES = ("circle", "diamond", "square", "triangle-up", "cross", "triangle-down")
_PANEL_WIDTH = 400
_VEGA_LITE = ".".join(alt.SCHEMA_VERSION.removeprefix("v").split(".")[:2])
# Widths in a legend (px): a symbol with its margins, the widest label, and a letter of a label.
_LEGEND_SYMBOL, _LEGEND_LABEL, _LETTER = 46, 240, 7
CONFIG: dict[str, Any] = {
    "font": "Arial, Helvetica, sans-serif",
    "background": "white",
    "view": {"stroke": "#cccccc"},
    "axis": {
        "labelFontSize": 11, "titleFontSize": 12, "titleFontWeight": "normal",
        "labelColor": "#222222", "titleColor": "#222222", "gridColor": "#e6e6e6",
        # Numbers closer than this (px) read as one; the last is moved inwards.
        "labelSeparation": 6,
    },
    "legend": {
        "orient": "bottom", "direction": "horizontal", "columns": 3, "labelFontSize": 11,
        "titleFontSize": 11, "titleFontWeight": "normal", "titleOrient": "left",
        "labelColor": "#222222", "titleColor": "#222222", "symbolStrokeWidth": 2,
        "labelLimit": _LEGEND_LABEL, "symbolOpacity": 1,
    },
    "title": {"anchor": "start", "fontSize": 13, "fontWeight": "bold", "color": "#222222"},
}


Rows = list[dict[str, Any]]
Chart = alt.Chart | alt.LayerChart | alt.FacetChart


@dataclass(frozen=True)
class Panel:
    """One view of a figure.

    Attributes:
        chart: without size and title.
        title: of the panel, line by line.
        height: of its plotting area (px).
        hover: invisible points on the lines that show their values under the pointer on the page.
        toggle: field with a legend that switches series on and off on the page; empty for none.
        zoom: whether a reader can zoom along x on the page.
    """

    chart: Chart
    title: str | list[str]
    height: int = 190
    hover: alt.Chart | None = None
    toggle: str = ""
    zoom: bool = False

    def specification(self) -> dict[str, Any]:
        """Return the specification for the page, without data and :data:`CONFIG`."""
        chart = self.chart if self.hover is None else self.chart + self.hover
        sized = chart.properties(width="container", height=self.height, title=self.title)
        specification: dict[str, Any] = sized.to_dict()
        del specification["config"]  # altair's own defaults
        layers = specification.get("layer", [specification])
        for layer in layers:
            _fit_legend(layer.get("encoding", {}).get("color", {}))
        if self.toggle:
            toggled = [
                layer for layer in layers
                if layer.get("encoding", {}).get("color", {}).get("field") == self.toggle
            ]
            for layer in toggled:
                layer.setdefault("transform", []).append({"filter": {"param": "shown"}})
            names = toggled[0]["encoding"]["color"]["scale"]["domain"]
            toggled[0].setdefault("params", []).append({
                "name": "shown",
                "select": {"type": "point", "fields": [self.toggle], "toggle": "true"},
                "value": [{self.toggle: name} for name in names],
                "bind": "legend",
            })
        if self.zoom:
            along = next(layer for layer in layers if "field" in layer["encoding"].get("x", {}))
            # With shift only: the wheel alone must still scroll the page.
            wheel = {"type": "interval", "encodings": ["x"], "zoom": "wheel![event.shiftKey]"}
            along.setdefault("params", []).append(
                {"name": "zoom", "select": wheel, "bind": "scales"}
            )
        return specification


def _fit_legend(color: dict[str, Any]) -> None:
    """Give a legend as many columns as fit into the panel at any width of the page."""
    names = color.get("scale", {}).get("domain")
    if not names or color.get("legend", {}) is None:
        return
    entry = _LEGEND_SYMBOL + min(_LEGEND_LABEL, _LETTER * max(map(len, names)))
    title = _LETTER * len(color.get("title") or "")
    columns = f"clamp(floor((width - {title:g}) / {entry:g}), 1, {len(names)})"
    color.setdefault("legend", {})["columns"] = {"expr": columns}


@dataclass(frozen=True)
class Figure:
    """A figure: its panels and their data.

    Attributes:
        name: of its files.
        title: what it shows.
        caption: a few words that name the marks; may be empty.
        panels: in reading order.
        columns: how many panels go side by side.
        data: the rows that the panels refer to by name.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: int
    data: dict[str, Rows] = field(default_factory=dict)

    @property
    def page_columns(self) -> int:
        """How many panels go side by side on the page, which has room for three."""
        return 2 if self.columns == 4 else min(self.columns, 3)

    def save(self, directory: Path) -> None:
        """Write the figure as SVG and as PNG."""
        charts = [
            panel.chart.properties(width=_PANEL_WIDTH, height=panel.height, title=panel.title)
            for panel in self.panels
        ]
        whole = alt.concat(*charts, columns=self.columns).resolve_scale(
            color="independent", shape="independent", strokeDash="independent"
        )
        specification = whole.properties(title=self.title).configure(**CONFIG).to_dict()
        # Added here, as altair would check every row. The PNG is made from the SVG, laid out once.
        specification.setdefault("datasets", {}).update(self.data)
        vectors = vl_convert.vegalite_to_svg(specification, _VEGA_LITE)
        file = directory / f"{self.name}.svg"
        with naming(file):
            file.write_text(vectors, encoding="utf-8")
        file = directory / f"{self.name}.png"
        with naming(file):
            file.write_bytes(vl_convert.svg_to_png(vectors, scale=2))


def distinct(
    name: str, values: list[str], title: str, drawn: Collection[str] | None = None
) -> dict[str, Any]:
    """Distinguish the series of a field by colour and by dashes; see :func:`cycled`."""
    colour, dash = cycled(COLOURS, values, drawn), cycled(_DASHES, values, drawn)
    legend = alt.Legend(symbolSize=600, symbolType="stroke")
    return {
        "color": alt.Color(f"{name}:N", title=title or None, scale=colour, legend=legend),
        "strokeDash": alt.StrokeDash(f"{name}:N", title=title or None, scale=dash),
    }


def pointed(*fields: str | tuple[str, str] | alt.Tooltip) -> list[alt.Tooltip]:
    """Return the tooltips for some fields; numbers of a field with a title have six digits.

    They are made here because Altair would search all of its classes for a channel given only by
    name, which takes longer than the rest of a chart.
    """
    def tooltip(shown: str | tuple[str, str] | alt.Tooltip) -> alt.Tooltip:
        if isinstance(shown, tuple):
            form = ".6~g" if shown[0].endswith(":Q") else alt.Undefined
            return alt.Tooltip(shown[0], title=shown[1], format=form)
        return alt.Tooltip(shown) if isinstance(shown, str) else shown

    return list(map(tooltip, fields))


def cycled(
    choices: Sequence[Any], values: list[str], drawn: Collection[str] | None = None
) -> alt.Scale:
    """Return a scale that gives each value a choice; choices repeat if there are more values.

    Args:
        choices: such as colours.
        values: of the whole figure, so that a value has one colour in all panels.
        drawn: the values that have a mark in the panel, and so an entry in its legend; by default
            all of them.
    """
    chosen = {
        value: choice for value, choice in zip(values, itertools.cycle(choices))
        if drawn is None or value in drawn
    }
    return alt.Scale(domain=list(chosen), range=list(chosen.values()))


def value_axis(values: Sequence[float]) -> dict[str, Any]:
    """Return scale and axis of a quantity: around its values, so that their differences are seen.

    If a few values are so large that half of the others would share a tenth of a linear axis, it is
    logarithmic; with values of 0 it is linear below the smallest other value.
    """
    ordered = sorted(values)
    low, middle, high = ordered[0], ordered[len(ordered) // 2], ordered[-1]
    positive = [value for value in ordered if value > 0]
    if low >= 0 and positive and high - low > 10 * (middle - low) > 0:
        least = positive[0]
        if low > 0:
            return {"scale": alt.Scale(type="log", domain=[low / 1.1, 1.1 * high], nice=False)}
        ticks = [10.0**power for power in range(math.ceil(math.log10(least)), 1 + math.floor(
            math.log10(high)))]
        return {
            "scale": alt.Scale(type="symlog", constant=least, domain=[0, 1.5 * high], nice=False),
            "axis": alt.Axis(values=[0.0, *ticks], format=".12~g"),
        }
    margin = 0.08 * (high - low) or 0.08 * abs(high) or 1.0
    bottom = low - margin
    if low >= 0 > bottom:
        bottom = 0.0
    return {"scale": alt.Scale(domain=[bottom, high + margin], nice=False)}


def hover_points(lines: alt.Chart) -> alt.Chart:
    """Return invisible points on the lines, which show their values under the pointer."""
    points: alt.Chart = lines.copy().mark_point(opacity=0, size=60, filled=True)
    points.encoding.strokeDash = alt.Undefined
    return points


def short(value: float) -> float:
    """Return a value with as many digits as a figure can show."""
    return float(f"{value:.7g}")


def series_panel(
    lines: alt.Chart, field: str, names: list[str], title: str, *, legend: str = "",
    below: Sequence[alt.Chart] = (), height: int = 190, zoom: bool = False,
) -> Panel:
    """Return a panel of lines with tooltips, and a legend that switches them on and off.

    Args:
        lines: chart with axes and tooltips.
        field: that distinguishes the lines.
        names: of the lines, the values of ``field``.
        title: of the panel.
        legend: its title.
        below: charts to draw underneath the lines.
        height: see :class:`Panel`.
        zoom: see :class:`Panel`.
    """
    lines = lines.encode(**distinct(field, names, legend))
    return Panel(
        alt.layer(*below, lines) if below else lines, title, height, hover_points(lines), field,
        zoom,
    )


def reference_line(points: Rows, x: alt.X, y: alt.Y) -> alt.Chart:
    """Return a thin grey line, such as the one on which a perfect forecast lies."""
    line: alt.Chart = alt.Chart(alt.InlineData(points)).mark_line(
        color="#888888", strokeWidth=1
    ).encode(x=x, y=y)
    return line
