"""The page that shows the result of a sizing to a client, and its figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import altair as alt

from greenroof_ros.analysis.report.drawing import (
    Figure,
    Panel,
    distinguish_series,
    make_tooltips,
    round_value,
)
from greenroof_ros.analysis.report.page import make_page
from greenroof_ros.analysis.sizing.columns import (
    COLUMNS,
    ENDS,
    Column,
    format_per_roof,
    format_share,
    format_spread,
)
from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.common.text import number_of

if TYPE_CHECKING:
    from greenroof_ros.analysis.sizing.sizes import Sizes


def render(sizes: Sizes, figures: Sequence[Figure]) -> str:
    """Return the page as HTML."""
    return make_page(
        __package__, figures, sizes=sizes, columns=sizes.columns,
        number_of=number_of, spread=format_spread, per_roof=format_per_roof, warnings=(),
        percent=format_share,
    )


# --- figures --------------------------------------------------------------------------------------

_VOLUME = "cistern (m³)"


def draw(sizes: Sizes, target: float) -> Figure:
    """Return a figure of the results at a target (mm) against the volume of the cistern.

    Each result has its own panel.
    """
    name = f"sizes-{target:g}mm"
    panels = [_draw_panel(sizes, key, column, name) for key, column in sizes.columns.items()]
    rows = [
        {
            "outlet": design.outlet, "volume": design.volume,
            **{key: value for column in sizes.columns
               for key, value in _cells(sizes, column, design).items()},
        }
        for outlet in sizes.outlets for design in sizes.select(target, outlet)
    ]
    many = len(sizes.seasons)
    caption = (
        f"Lines show the means of {many} seasons. Bands extend from the lowest to the highest "
        "season."
        if many > 1 else f"The lines show the season {sizes.seasons[0]}."
    )
    return Figure(name, f"Target {target:g} mm", caption, tuple(panels), 2, {name: rows})


def _cells(sizes: Sizes, column: str, design: Design) -> dict[str, Any]:
    factor = 100.0 if COLUMNS[column].unit == "%" else 1.0
    return {
        f"{column}{end}": round_value(factor * value)
        for end, value in zip(ENDS, sizes.spread(column, design), strict=True)
    }


def _draw_panel(sizes: Sizes, key: str, column: Column, dataset: str) -> Panel:
    axis = f"{column.label} ({column.unit})"
    scale = alt.Scale(type="log", nice=False, domain=[sizes.volumes[0], sizes.volumes[-1]])
    series = distinguish_series("outlet", sizes.outlets)
    for channel in series.values():
        channel.legend = alt.Legend(symbolType="stroke", symbolSize=400, columns=3)
    base = alt.Chart(alt.NamedData(dataset)).encode(
        x=alt.X(
            "volume:Q", title=_VOLUME, scale=scale,
            axis=alt.Axis(values=sizes.volumes, format="~g", labelOverlap=True),
        ),
        tooltip=make_tooltips(
            "outlet:N", ("volume:Q", _VOLUME), (f"{key}:Q", axis), (f"{key}_min:Q", "lowest"),
            (f"{key}_max:Q", "highest"),
        ),
        **series,
    )
    y = alt.Y(f"{key}:Q", title=None, scale=alt.Scale(zero=True))
    band = base.mark_area(opacity=0.15, strokeOpacity=0).encode(
        y=alt.Y(f"{key}_min:Q", title=None), y2=alt.Y2(f"{key}_max:Q")
    )
    lines = base.mark_line(strokeWidth=2, point=True).encode(y=y)
    return Panel(alt.layer(band, lines), f"{axis[0].upper()}{axis[1:]}", 200)
