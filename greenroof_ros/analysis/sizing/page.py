"""The page of a sizing, which a client can be given, and its figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import altair as alt
import numpy as np

from greenroof_ros.analysis.report.drawing import (
    Figure,
    Panel,
    distinguish_series,
    make_tooltips,
    round_value,
)
from greenroof_ros.analysis.report.page import make_page
from greenroof_ros.analysis.sizing.choice import MAX_STRESS
from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.analysis.sizing.sizes import COST, ENDS, KEPT, Sizes, Spread, format_share
from greenroof_ros.model.metrics import METRICS

_METRICS = {metric.name: metric for metric in METRICS}


class Column(NamedTuple):
    """How a result is shown."""

    label: str
    unit: str
    form: Callable[[float], str]
    per_roof: bool = False
    """whether it is also shown for each m2 of green roof"""


def _format_volume(value: float) -> str:
    return f"{value:.{1 if abs(value) < 99.95 else 0}f}"


def _format_count(value: float) -> str:
    return f"{value:.0f}"


def _of_metric(
    name: str, unit: str, form: Callable[[float], str], per_roof: bool = False
) -> Column:
    return Column(_METRICS[name].label, unit, form, per_roof)


COLUMNS = {
    "demand_met_share": _of_metric("demand_met_share", "%", format_share),
    "mains_m3": _of_metric("mains_m3", "m³", _format_volume, True),
    "wet_discharge_m3": _of_metric("wet_discharge_m3", "m³", _format_volume, True),
    KEPT: Column("storm water kept out of the sewer", "%", format_share),
    "overflow_days": _of_metric("overflow_days", "days", _format_count),
    "stress_hours": _of_metric("stress_hours", "h", _format_count),
    COST: Column("cost of a season", "in the prices' currency", _format_volume),
}
"""the results that are printed and drawn"""


def list_columns(sizes: Sizes) -> dict[str, Column]:
    """Return the columns of a table; costs only with prices."""
    return {name: column for name, column in COLUMNS.items() if name in sizes.values}


def format_spread(spread: Spread, column: Column) -> str:
    """Return mean, lowest and highest as text: ``3.5 (1.2 to 7.9)``."""
    if np.isnan(spread.mean):
        return "none"
    mean, low, high = map(column.form, spread)
    return mean if low == high else f"{mean} ({low} to {high})"


def format_per_roof(sizes: Sizes, spread: Spread) -> str:
    """Return the mean of a volume (m3) for each m2 of green roof, as text."""
    return f"{1000 * spread.mean / sizes.site.a2:.0f} L/m²"


def render(sizes: Sizes, figures: Sequence[Figure]) -> str:
    """Return the page."""
    return make_page(
        __package__, figures, sizes=sizes, columns=list_columns(sizes),
        spread=format_spread, per_roof=format_per_roof, max_stress=MAX_STRESS, warnings=(),
        percent=format_share,
    )


# --- figures --------------------------------------------------------------------------------------

_VOLUME = "cistern (m³)"


def draw(sizes: Sizes, target: float) -> Figure:
    """Return the results of a target (mm) over the volume of the cistern, a panel for each."""
    name = f"sizes-{target:g}mm"
    panels = [_draw_panel(sizes, key, column, name) for key, column in list_columns(sizes).items()]
    rows = [
        {
            "outlet": design.outlet, "volume": design.volume,
            **{key: value for column in list_columns(sizes)
               for key, value in _cells(sizes, column, design).items()},
        }
        for outlet in sizes.outlets for design in sizes.select(target, outlet)
    ]
    return Figure(
        name, f"Target {target:g} mm",
        f"Lines: means of {len(sizes.seasons)} seasons. Bands: from the lowest season to the "
        "highest", tuple(panels), 2, {name: rows},
    )


def _cells(sizes: Sizes, column: str, design: Design) -> dict[str, Any]:
    factor = 100.0 if COLUMNS[column].unit == "%" else 1.0
    return {
        f"{column}{end}": round_value(factor * value)
        for end, value in zip(ENDS, sizes.spread(column, design), strict=True)
    }


def _draw_panel(sizes: Sizes, key: str, column: Column, dataset: str) -> Panel:
    axis = f"{column.label} ({column.unit})"
    scale = alt.Scale(type="log", nice=False, domain=[sizes.volumes[0], sizes.volumes[-1]])
    base = alt.Chart(alt.NamedData(dataset)).encode(
        x=alt.X(
            "volume:Q", title=_VOLUME, scale=scale,
            axis=alt.Axis(values=sizes.volumes, format="~g", labelOverlap=True),
        ),
        tooltip=make_tooltips(
            "outlet:N", ("volume:Q", _VOLUME), (f"{key}:Q", axis), (f"{key}_min:Q", "lowest"),
            (f"{key}_max:Q", "highest"),
        ),
        **distinguish_series("outlet", sizes.outlets),
    )
    y = alt.Y(f"{key}:Q", title=None, scale=alt.Scale(zero=True))
    band = base.mark_area(opacity=0.15, strokeOpacity=0).encode(
        y=alt.Y(f"{key}_min:Q", title=None), y2=alt.Y2(f"{key}_max:Q")
    )
    lines = base.mark_line(strokeWidth=2, point=True).encode(y=y)
    return Panel(alt.layer(band, lines), f"{axis[0].upper()}{axis[1:]}", 200)
