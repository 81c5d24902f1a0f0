"""The figures of a report: the comparison of cases and their seasons, and runs over time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import altair as alt
import polars

from greenroof_ros.analysis import figures
from greenroof_ros.analysis.report.cases import Report
from greenroof_ros.analysis.report.trajectories import draw_over_time
from greenroof_ros.analysis.tables import BOUNDS, COLUMNS

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
    return axis(
        f"{metric}:Q", title=column.heading, scale=alt.Scale(padding=8),
        axis=alt.Axis(format="%" if column.unit == "%" else alt.Undefined),
    )
