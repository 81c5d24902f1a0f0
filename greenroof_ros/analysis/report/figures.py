"""The figures of a report: the comparison of cases, their seasons, and runs over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import altair as alt

from greenroof_ros.analysis.figures import (
    COLOURS,
    Figure,
    Panel,
    Rows,
    distinguish_points,
    distinguish_series,
)
from greenroof_ros.analysis.report.cases import BOUND, BOUNDS, CaseRuns, Report
from greenroof_ros.analysis.report.trajectories import draw_over_time
from greenroof_ros.analysis.tables import COLUMNS

_ENDS = "", "_low", "_high"


def make_figures(report: Report) -> Iterator[Figure]:
    """Yield the figures of all places, each of which has several cases, seasons or trajectories.

    With more cases than colours, only the best ones are drawn over years and over time.

    Raises:
        ConfigurationError: if the trajectory of a run cannot be read.
    """
    compared = [place for place in report.places if len(place) > 1]
    if compared:
        yield Figure(
            "comparison", "Comparison of the cases",
            "Points are means; lines extend from the lowest to the highest run",
            tuple(_compare(place, report.show, report.name_place(place)) for place in compared),
            min(len(compared), 2),
        )
    seasons = [place for place in report.places if len(place[0].years) > 1]
    if seasons:
        yield Figure(
            "seasons", "Season by season", "Means over the random seeds of each year",
            tuple(
                _draw_seasons(place[: len(COLOURS)], report.show[0], report.name_place(place))
                for place in seasons
            ), min(len(seasons), 2),
        )
    for number, place in enumerate(report.places, start=1):
        runs = {
            case.label: (case.runs[0].site, trajectory)
            for case in place[: len(COLOURS)]
            if len(case.runs) == 1 and (trajectory := case.runs[0].trajectory()) is not None
        }
        if runs:
            yield Figure(
                f"time-{number}",
                f"Rain, levels and flows: {report.name_place(place)}".rstrip(": "), "",
                tuple(draw_over_time(runs)), 2,
            )


def _compare(place: Sequence[CaseRuns], show: Sequence[str], title: str) -> Panel:
    """Plot the first shown metric against the second one or, if there is none, for each case."""
    metrics = [name for name in show[:2] if any(name in case.ranges for case in place)]
    names = dict(zip("yx" if len(metrics) > 1 else "x", metrics, strict=True))
    rows: Rows = [
        {"case": case.label} | {
            axis + end: value for axis, name in names.items()
            for end, value in zip(_ENDS, (case.row[name], *case.ranges[name]), strict=True)
        } for case in place if {*metrics} <= case.ranges.keys()
    ]
    bound = {axis: place[0].row.get(BOUNDS.get(name, "")) for axis, name in names.items()}
    if None not in bound.values():
        rows.append({"case": BOUND, **bound})
    cases = [row["case"] for row in rows]
    channels: dict[str, Any] = {
        axis: _axis(axis, name, zero=len(names) > 1) for axis, name in names.items()
    }
    points = distinguish_points("case", cases) if len(names) > 1 else {}
    channels |= {key: points[key] for key in points.keys() - {"shape"}}
    if len(names) == 1:
        channels["y"] = alt.Y("case:N", sort=cases, title=None, axis=alt.Axis(labelLimit=190))
    base = alt.Chart(alt.InlineData(rows)).encode(**channels)
    layers: list[alt.Chart] = []
    for axis in names:
        ends: dict[str, Any] = {axis: f"{axis}_low:Q", f"{axis}2": f"{axis}_high:Q"}
        layers.append(base.mark_rule(opacity=0.5).encode(**ends))
    layers.append(base.mark_point(filled=True, opacity=1, size=80).encode(**points))
    height = 280 if len(names) > 1 else max(60, 18 * len(rows))
    return Panel(alt.layer(*layers), title, height)


def _draw_seasons(place: Sequence[CaseRuns], metric: str, title: str) -> Panel:
    """Plot a metric over the years."""
    rows: Rows = [
        {"case": case.label, "year": year, "v": value}
        for case in place for year, value in case.yearly(metric).items()
    ]
    return Panel(alt.Chart(alt.InlineData(rows)).mark_line(point=True).encode(
        x=alt.X("year:O", title="season", axis=alt.Axis(labelAngle=0)),
        y=_axis("y", metric, "v"),
        **distinguish_series("case", [case.label for case in place]),
    ), title, 220)


def _axis(axis: str, metric: str, field: str = "", *, zero: bool = True) -> Any:
    """Return the axis of a metric."""
    column = COLUMNS[metric]
    return {"x": alt.X, "y": alt.Y}[axis](
        f"{field or axis}:Q", title=column.heading, scale=alt.Scale(zero=zero, padding=8),
        axis=alt.Axis(format="%" if column.unit == "%" else alt.Undefined),
    )
