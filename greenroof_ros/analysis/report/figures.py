"""The figures of a report: the comparison of cases, their seasons, and runs over time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import altair as alt
import polars

from greenroof_ros.analysis.figures import (
    COLOURS,
    Figure,
    Panel,
    distinguish_points,
    distinguish_series,
)
from greenroof_ros.analysis.report.cases import Report
from greenroof_ros.analysis.report.sources import BOUNDS
from greenroof_ros.analysis.report.trajectories import draw_over_time
from greenroof_ros.analysis.tables import COLUMNS

# Places whose runs are drawn over time.
_MAX_PLACES = 2


def make_figures(report: Report) -> Iterator[Figure]:
    """Yield the figures, for places with several cases, seasons or trajectories.

    With more cases than colours, only the best ones are drawn over years and over time.

    Raises:
        ConfigurationError: if the trajectory of a run cannot be read.
    """
    if compared := [_compare(place, report) for place in report.places if len(place) > 1]:
        yield Figure(
            "comparison", "Comparison of the cases",
            "Points are means; lines extend from the lowest to the highest run", tuple(compared),
            min(len(compared), 2),
        )
    years = report.years.drop_nulls("year")
    seasons = [
        _draw_seasons(place, years, report.show[0]) for place in report.places
        if place["place"][0] in years["place"]
    ]
    if seasons:
        yield Figure(
            "seasons", "Season by season", "Means over the random seeds of each year",
            tuple(seasons), min(len(seasons), 2),
        )
    for number, place in enumerate(report.places[:_MAX_PLACES], start=1):
        runs = {
            case["case"]: (run.site, trajectory)
            for case in place.filter(runs=1).head(len(COLOURS)).to_dicts()
            for run in [report.sources.runs[case["first"]]]
            if (trajectory := run.trajectory()) is not None
        }
        if runs:
            yield Figure(
                f"time-{number}", f"Rain, levels and flows {place['place'][0]}".strip(), "",
                tuple(draw_over_time(runs)), 2,
            )


def _compare(place: polars.DataFrame, report: Report) -> Panel:
    """Plot the first shown metric against the second one or, if there is none, pumped water."""
    names = dict(zip("yx", [*report.show, "pumped_m3"], strict=False))
    rows = place.drop_nulls(names.values()).select("case", *(
        polars.col(f"{name}{end}").alias(f"{axis}{end}")
        for axis, name in names.items() for end in ("", "_low", "_high")
    )).to_dicts()
    bound = {axis: place.to_dicts()[0].get(BOUNDS.get(name, "")) for axis, name in names.items()}
    if None not in bound.values():
        rows.append({"case": "minimum possible", **bound})
    points = distinguish_points("case", [row["case"] for row in rows])
    base = alt.Chart(alt.InlineData(rows)).encode(
        x=_axis(alt.X, names["x"], "x"), y=_axis(alt.Y, names["y"], "y"), color=points["color"]
    )
    return Panel(alt.layer(
        base.mark_rule(opacity=0.5).encode(x="x_low:Q", x2="x_high:Q"),
        base.mark_rule(opacity=0.5).encode(y="y_low:Q", y2="y_high:Q"),
        base.mark_point(filled=True, opacity=1, size=80).encode(**points),
    ), place["place"][0], 280)


def _draw_seasons(place: polars.DataFrame, years: polars.DataFrame, metric: str) -> Panel:
    """Plot a metric over the years."""
    cases = place["case"].head(len(COLOURS)).to_list()
    rows = place.head(len(COLOURS)).select("place", "case").join(years, on=("place", "case"))
    chart = alt.Chart(alt.InlineData(rows.select("case", "year", v=metric).to_dicts()))
    return Panel(chart.mark_line(point=True).encode(
        x=alt.X("year:O", title="season", axis=alt.Axis(labelAngle=0)),
        y=_axis(alt.Y, metric, "v"), **distinguish_series("case", cases),
    ), place["place"][0], 220)


def _axis(axis: Any, metric: str, field: str) -> Any:
    """Return the axis of a metric."""
    column = COLUMNS[metric]
    return axis(
        f"{field}:Q", title=column.heading, scale=alt.Scale(padding=8),
        axis=alt.Axis(format="%" if column.unit == "%" else alt.Undefined),
    )
