"""The figures of a report: the comparison of cases, their seasons, and runs over time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import altair as alt
import polars

from greenroof_ros.analysis import figures
from greenroof_ros.analysis.report.cases import Report
from greenroof_ros.analysis.report.trajectories import draw_over_time
from greenroof_ros.analysis.tables import BOUNDS, COLUMNS

# With more cases than colours, only the best ones are drawn over years and over time.
_MAX_CASES = len(figures.COLOURS)
# Places whose runs are drawn over time.
_MAX_PLACES = 2


def make_figures(report: Report) -> Iterator[figures.Figure]:
    """Yield the figures, for places with several cases, seasons or trajectories.

    Raises:
        ConfigurationError: if the trajectory of a run cannot be read.
    """
    if compared := [_compare(place, report) for place in report.places if len(place) > 1]:
        yield figures.Figure(
            "comparison", "Comparison of the cases",
            "Points are means; lines extend from the lowest to the highest run", tuple(compared),
            min(len(compared), 2),
        )
    years = report.years.drop_nulls("year")
    best = [place.head(_MAX_CASES) for place in report.places]
    if seasons := [
        _draw_seasons(place, years, report.show[0]) for place in best
        if place["place"][0] in years["place"]
    ]:
        yield figures.Figure(
            "seasons", "Season by season", "Means over the random seeds of each year",
            tuple(seasons), min(len(seasons), 2),
        )
    for number, place in enumerate(best[:_MAX_PLACES], start=1):
        runs = {
            case: (run.site, trajectory)
            for case, first in place.filter(runs=1).select("case", "first").rows()
            if (trajectory := (run := report.sources.runs[first]).trajectory()) is not None
        }
        if runs:
            title = f"Rain, levels and flows, {place['place'][0]}".removesuffix(", ")
            yield figures.Figure(f"time-{number}", title, "", tuple(draw_over_time(runs)), 2)


def _compare(place: polars.DataFrame, report: Report) -> figures.Panel:
    """Plot the first shown metric against the second one or, if there is none, pumped water."""
    y, x, *_ = *report.show, "pumped_m3"
    rows = place.drop_nulls([x, y]).to_dicts()
    bound = [place.to_dicts()[0].get(BOUNDS.get(name, "")) for name in (x, y)]
    if None not in bound:
        rows.append({"case": "minimum possible", x: bound[0], y: bound[1]})
    points = figures.distinguish_series("case", [row["case"] for row in rows], points=True)
    base = alt.Chart(alt.InlineData(rows)).encode(
        x=_axis(alt.X, x), y=_axis(alt.Y, y), color=points["color"]
    )
    return figures.Panel(alt.layer(
        base.mark_rule(opacity=0.5).encode(x=f"{x}_min:Q", x2=f"{x}_max:Q"),
        base.mark_rule(opacity=0.5).encode(y=f"{y}_min:Q", y2=f"{y}_max:Q"),
        base.mark_point(filled=True, opacity=1, size=80).encode(**points),
    ), place["place"][0], 280)


def _draw_seasons(place: polars.DataFrame, years: polars.DataFrame, metric: str) -> figures.Panel:
    """Plot a metric over the years."""
    rows = place.select("place", "case").join(years, on=("place", "case"))
    chart = alt.Chart(alt.InlineData(rows.select("case", "year", metric).to_dicts()))
    return figures.Panel(chart.mark_line(point=True).encode(
        x=alt.X("year:O", title="season", axis=alt.Axis(labelAngle=0)), y=_axis(alt.Y, metric),
        **figures.distinguish_series("case", place["case"].to_list()),
    ), place["place"][0], 220)


def _axis(axis: Any, metric: str) -> Any:
    """Return the axis of a metric."""
    column = COLUMNS[metric]
    return axis(
        f"{metric}:Q", title=column.heading, scale=alt.Scale(padding=8),
        axis=alt.Axis(format="%" if column.unit == "%" else alt.Undefined),
    )
