"""The page that shows the result of a sizing to a client, and its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import altair as alt

from greenroof_ros.analysis.figures import (
    Figure,
    Panel,
    Rows,
    distinguish_series,
    make_tooltips,
    round_value,
)
from greenroof_ros.analysis.report.page import make_page
from greenroof_ros.analysis.sizing.columns import (
    ENDS,
    Column,
    format_per_roof,
    format_share,
    format_spread,
)
from greenroof_ros.base.text import number_of


def render(figures: Sequence[Figure], sizes: object, columns: Mapping[str, Column]) -> str:
    """Return the page as HTML.

    Args:
        figures: figures from :func:`draw`.
        sizes: the :class:`.sizes.Sizes`.
        columns: the results, by name.
    """
    return make_page(
        __package__, figures, sizes=sizes, columns=columns, number_of=number_of,
        spread=format_spread, per_roof=format_per_roof, warnings=(), percent=format_share,
    )


# --- figures --------------------------------------------------------------------------------------

_VOLUME = "cistern (m³)"


def draw(
    rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Column], target: float,
    seasons: Sequence[str],
) -> Figure:
    """Return a figure of the results at a target against the volume of the cistern.

    Each result has its own panel.

    Args:
        rows: the rows of the designs at the target, as in :attr:`.sizes.Sizes.table`.
        columns: the results to draw, by name.
        target: the target (mm).
        seasons: names of the seasons.
    """
    name = f"sizes-{target:g}mm"
    data = [
        {"outlet": row["outlet"], "volume": row["volume_m3"], **_cells(row, columns)}
        for row in rows
    ]
    panels = [_draw_panel(data, key, column, name) for key, column in columns.items()]
    caption = (
        f"Lines show the means of {len(seasons)} seasons. Bands extend from the lowest to the "
        "highest season."
        if len(seasons) > 1 else f"The lines show the season {seasons[0]}."
    )
    return Figure(name, f"Target {target:g} mm", caption, tuple(panels), 2, {name: data})


def _cells(row: Mapping[str, Any], columns: Mapping[str, Column]) -> dict[str, Any]:
    return {
        f"{key}{end}": round_value((100.0 if column.unit == "%" else 1.0) * row[f"{key}{end}"])
        for key, column in columns.items() for end in ENDS
    }


def _draw_panel(data: Rows, key: str, column: Column, dataset: str) -> Panel:
    axis = f"{column.label} ({column.unit})"
    volumes = sorted({row["volume"] for row in data})
    scale = alt.Scale(type="log", nice=False, domain=[volumes[0], volumes[-1]])
    series = distinguish_series("outlet", list(dict.fromkeys(row["outlet"] for row in data)))
    for channel in series.values():
        channel.legend = alt.Legend(symbolType="stroke", symbolSize=400, columns=3)
    base = alt.Chart(alt.NamedData(dataset)).encode(
        x=alt.X(
            "volume:Q", title=_VOLUME, scale=scale,
            axis=alt.Axis(values=volumes, format="~g", labelOverlap=True),
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
