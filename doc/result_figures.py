"""Draw the figures of the results, in the style and colours of the report."""

from __future__ import annotations

from typing import Any

import altair as alt
import vl_convert
from result_tables import LEAST, Figure, Mark, numbers_of

from greenroof_ros.analysis.report.drawing import COLOURS, CONFIG

_CONTROLLERS = ("mpc", "onoff", "anticipating_onoff", "lookahead", LEAST)
# Widths (px): a figure, a letter of its rows' names; height of a row (px).
_WIDTH, _LETTER, _ROW = 440, 6.5, 20
_INK = "#222222"


def draw(figure: Figure) -> str:
    """Return a figure as SVG, with the digest of the numbers in it."""
    panels = list(dict.fromkeys(mark.panel for mark in figure.marks))
    rows = list(dict.fromkeys(mark.row for mark in figure.marks))
    names = _LETTER * max(map(len, rows))
    width = (_WIDTH - names) / figure.columns
    charts = [
        _panel(figure, panel, rows, named=number % figure.columns == 0).properties(
            title=panel, width=width, height=_ROW * len(rows)
        )
        for number, panel in enumerate(panels)
    ]
    chart = alt.concat(*charts, columns=figure.columns, spacing=14).configure(**CONFIG)
    svg: str = vl_convert.vegalite_to_svg(chart.to_dict())
    return svg.replace("<svg ", f'<svg data-drawn-from="{figure.digest}" ', 1)


def _panel(figure: Figure, panel: str, rows: list[str], *, named: bool) -> alt.LayerChart:
    """Return a panel; the rows' names stand beside it only if ``named``."""
    values = [_values(figure, mark) for mark in figure.marks if mark.panel == panel]
    x: dict[str, Any] = {
        "scale": alt.Scale(domain=_domain(figure), nice=False), "title": figure.axis,
        "axis": alt.Axis(tickCount=3),
    }
    names = alt.Axis(labels=named, ticks=named, labelLimit=0)
    base = alt.Chart(alt.Data(values=values)).encode(
        y=alt.Y("row:N", title=None, sort=rows, scale=alt.Scale(domain=rows), axis=names)
    )
    colour = alt.Color("colour:N", scale=None)
    if figure.ratio:
        onoff = alt.Chart(alt.Data(values=[{"value": 1}])).mark_rule(color="#888888")
        layers = [
            onoff.encode(x=alt.X("value:Q", **x)),
            base.mark_rule(strokeWidth=2).encode(x=alt.X("low:Q", **x), x2="high:Q", color=colour),
            base.mark_point(filled=True, size=60, opacity=1).encode(
                x=alt.X("value:Q", **x), color=colour
            ),
        ]
    else:
        layers = [
            base.mark_bar(height=13).encode(x=alt.X("value:Q", **x), color=colour),
            base.mark_rule(strokeWidth=1.5, color=_INK).encode(x=alt.X("low:Q", **x), x2="high:Q"),
        ]
    layers += [
        base.mark_tick(color=_INK, thickness=2, height=15).encode(x=alt.X("beside:Q", **x)),
        base.mark_text(align="left", dx=5, fontSize=11, color=_INK).encode(
            x=alt.X("end:Q", **x), text="label:N"
        ),
    ]
    return alt.layer(*layers)


def _domain(figure: Figure) -> list[float]:
    """Return the ends of all horizontal axes, with room for a number beside the last mark."""
    ends = [end for mark in figure.marks for end in _ends(mark)]
    low, high = (min(*ends, 1.0), max(*ends, 1.0)) if figure.ratio else (0.0, max(ends))
    margin = 0.05 * (high - low) if figure.ratio else 0.0
    letters = max(len(numbers_of(figure, mark)) for mark in figure.marks)
    return [low - margin, high + 0.035 * letters * figure.columns * (high - low)]


def _ends(mark: Mark) -> list[float]:
    ends = (mark.value, mark.beside, mark.low, mark.high)
    return [end for end in ends if end is not None]


def _values(figure: Figure, mark: Mark) -> dict[str, Any]:
    colours = dict(zip(_CONTROLLERS, COLOURS, strict=False))
    return {
        **mark._asdict(), "colour": colours.get(mark.controller, COLOURS[0]),
        "end": max(_ends(mark)), "label": numbers_of(figure, mark),
    }
