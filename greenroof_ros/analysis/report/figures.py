"""The figures of results by case, and the choice of a report's figures."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import altair as alt
import numpy as np

from greenroof_ros.analysis.figures import (
    COLOURS,
    Chart,
    Figure,
    Panel,
    Rows,
    cycle_choices,
    distinguish_points,
    make_tooltips,
    round_value,
    value_scale,
)
from greenroof_ros.analysis.report.groups import TOTAL, CaseRuns, Item, Report
from greenroof_ros.analysis.report.trajectories import (
    Drawn,
    figures_over_time,
    select_curves,
)
from greenroof_ros.results.table import EventRow

# With more lines than this in one panel, every controller has its own figures.
_MAX_LINES = len(COLOURS)

# The names of all figures begin with one of these; numbers and a controller can follow.
_KINDS = ("deviation", "discharge", "events", "water", "flows")


def is_figure(name: str) -> bool:
    """Return whether a file has the name of a figure in a report."""
    return re.fullmatch(rf"({'|'.join(_KINDS)})(-[\w.]+)*\.(svg|png)", name) is not None


def make_figures(report: Report) -> Iterator[Figure]:
    """Yield the figures, in the order in which they appear.

    Raises:
        ConfigurationError: if the trajectory of a run cannot be read.
    """
    windows = {f"{number}": cases for number, cases in enumerate(report.windows(), start=1)}
    if len(report.cases) > 1:
        for name, cases in windows.items():
            yield draw_deviation(cases, name)
            yield from _of_discharge(cases, name)
    for number, place in enumerate(report.places(), start=1):
        yield from _of_events(place, f"{number}")
        yield from _over_time(place, f"{number}")


def _over_time(place: Sequence[CaseRuns], name: str) -> Iterator[Figure]:
    """Yield the figures over time for the single-run cases of one window and initial state."""
    window, initial = place[0].place
    title = f"from {initial}: {window}"
    lines: dict[str, dict[str, Drawn]] = {}
    for case in place:
        trajectory = case.runs[0].trajectory() if len(case.runs) == 1 else None
        if trajectory is None:
            continue
        curves = select_curves(case.runs[0].site, trajectory)
        lines.setdefault(case.row["controller"], {})[case.label] = curves
    for end, of, runs in _split(lines):
        yield from figures_over_time(runs, f"{name}{end}", f"{of} {title}")


def _of_events(place: Sequence[CaseRuns], name: str) -> Iterator[Figure]:
    """Yield the figures of the rain events for one window and initial state, if any."""
    window, initial = place[0].place
    title = f"from {initial}: {window}"
    events: dict[str, dict[str, list[EventRow]]] = {}
    for case in place:
        whole = [event for run in case.runs for event in run.events() if event["complete"]]
        if whole:
            events.setdefault(case.row["controller"], {})[case.label] = whole
    for end, of, cases in _split(events):
        yield draw_events(cases, f"events-{name}{end}", f"{of} {title}")


def _split(
    by_controller: Mapping[str, Mapping[str, Item]]
) -> Iterator[tuple[str, str, Mapping[str, Item]]]:
    """Yield all cases together or, if they are too many, those of each controller.

    Yields:
        Ends of a figure's name and of the first words of its title, and the cases by their labels.
    """
    together = {label: case for own in by_controller.values() for label, case in own.items()}
    if 0 < len(together) <= _MAX_LINES:
        yield "", "", together
    else:
        for controller, own in by_controller.items():
            yield f"-{controller}", f", {controller},", own


# --- discharge and mains water --------------------------------------------------------------------

_MAINS, _WET = "mains water (m³)", "discharge in wet weather (m³)"


def _of_discharge(cases: Sequence[CaseRuns], name: str) -> Iterator[Figure]:
    """Yield the figure that plots a window's discharge against its mains water.

    Only sites with a valve and a mains top-up have this figure: at other sites, reducing the
    discharge costs no mains water.
    """
    here = [
        case for case in cases
        if case.row.get("parameter:outlet") and case.row.get("mains_m3") is not None
    ]
    if len(here) > 1:
        yield draw_discharge(here, f"discharge-{name}")


def draw_discharge(cases: Sequence[CaseRuns], name: str) -> Figure:
    """Plot the discharge in wet weather against the mains water, with a panel per initial state."""
    panels, data = list[Panel](), dict[str, Rows]()
    for initial in dict.fromkeys(case.place[1] for case in cases):
        here = [case for case in cases if case.place[1] == initial]
        bounds = list(dict.fromkeys(
            (case.row["bound_mains_m3"], case.row["bound_wet_discharge_m3"]) for case in here
            if case.row.get("bound_wet_discharge_m3") is not None
        ))
        points = [
            *(("minimum possible", *bound) for bound in bounds[:1]),
            *((
                case.label, case.row["mains_m3"], case.row["wet_discharge_m3"],
            ) for case in here if case.row.get("wet_discharge_m3") is not None),
        ]
        dataset = f"{name}-{len(panels) + 1}"
        data[dataset] = [
            {"case": label, "mains": round_value(mains), "wet": round_value(wet)}
            for label, mains, wet in points
        ]
        zero = alt.Scale(type="linear", zero=True)
        chart = alt.Chart(alt.NamedData(dataset)).encode(
            x=alt.X("mains:Q", title=_MAINS, scale=zero),
            y=alt.Y("wet:Q", title=_WET, scale=zero),
            tooltip=make_tooltips("case:N", ("mains:Q", _MAINS), ("wet:Q", _WET)),
            **distinguish_points("case", [label for label, *_ in points]),
        ).mark_point(filled=True, opacity=1, size=60)
        panels.append(Panel(chart, f"from {initial}", 260))
    return Figure(
        name, f"Effect of each controller on storm water in the sewer: {cases[0].place[0]}",
        "Minimum possible: the lowest discharge for the irrigation of on/off control, if all "
        "weather is known in advance",
        tuple(panels), min(len(panels), 2), data,
    )


# --- rain events ----------------------------------------------------------------------------------

_REDUCTIONS = {
    "volume_reduction": "reduction of the volume", "peak_reduction": "reduction of the peak",
}
# A valve can release more from the cistern than a small event brings: the axis ends here.
_MIN_REDUCTION = -1.0


def draw_events(events: Mapping[str, Sequence[EventRow]], name: str, title: str) -> Figure:
    """Plot the reduction of volume and peak in every event against the depth of its rain.

    Args:
        events: events of every case, by its label.
        name: name of the figure.
        title: last part of the figure's title.
    """
    rows = [
        {
            "case": label, "start": event["start"], "depth": round_value(event["rain_mm"]),
            **{key: round_value(event[key]) for key in _REDUCTIONS},
        }
        for label, own in events.items() for event in own
    ]
    base = alt.Chart(alt.NamedData(name)).encode(
        x=alt.X("depth:Q", title="rain of the event (mm)", scale=value_scale(
            row["depth"] for row in rows
        )),
        **distinguish_points("case", list(events)),
        tooltip=make_tooltips(
            "case:N", "start:N", ("depth:Q", "rain (mm)"),
            *((f"{key}:Q", text) for key, text in _REDUCTIONS.items()),
        ),
    )
    panels = [
        Panel(base.mark_point(filled=True, opacity=0.6, size=30).encode(y=alt.Y(
            f"{key}:Q", title=None, axis=alt.Axis(format="%"), scale=alt.Scale(
                domain=[_lowest(event[key] for own in events.values() for event in own), 1.0],
                clamp=True,
            ),
        )), text, 220)
        for key, text in _REDUCTIONS.items()
    ]
    return Figure(
        name, f"Rain events{title}",
        "Each point compares the discharge of an event in wet weather with the runoff of the "
        "same area without green roof and cistern. Events that the run does not fully cover are "
        "left out. Values below -100 % are drawn at -100 %",
        tuple(panels), 2, {name: rows},
    )


def _lowest(reductions: Iterable[float]) -> float:
    """Return the lower end of the axis of reductions, which is 0 if no reduction is negative."""
    return max(_MIN_REDUCTION, min([0.0, *reductions]))


# --- results by case ------------------------------------------------------------------------------

_DEVIATION = "total deviation (m³)"


def draw_deviation(cases: Sequence[CaseRuns], name: str) -> Figure:
    """Plot the total deviation of a window's cases, with a panel for every initial state."""
    panels, data = list[Panel](), dict[str, Rows]()
    for initial in dict.fromkeys(case.place[1] for case in cases):
        here = [case for case in cases if case.place[1] == initial]
        dataset = f"deviation-{name}-{len(panels) + 1}"
        data[dataset] = list(map(_make_row, here))
        bounds = [case.row["bound_m3"] for case in here if case.row["ratio"] is not None]
        chart = _draw_rows(dataset, data[dataset], bounds[0] if bounds else None)
        height = max(60, 18 * len({row["case"] for row in data[dataset]}))
        panels.append(Panel(chart, f"from {initial}", height))
    return Figure(
        f"deviation-{name}", f"Total deviation: {cases[0].place[0]}",
        "Lines extend from the smallest to the largest value of a case's runs. The dashed line "
        "is the minimum possible value",
        tuple(panels), min(len(panels), 3), data,
    )


def _make_row(case: CaseRuns) -> dict[str, Any]:
    """Return the row of a case: mean ``v``, minimum ``low`` and maximum ``high`` (m3)."""
    totals = np.concatenate([*case.totals.values()])
    return {
        "case": case.label, "controller": case.row["controller"],
        "v": round_value(case.row[TOTAL]), "low": round_value(totals.min()),
        "high": round_value(totals.max()),
    }


def _draw_rows(dataset: str, rows: Rows, reference: float | None) -> Chart:
    """Return a chart with a row for every case: its value, and a line from low to high.

    Args:
        dataset: name of the data set with the rows.
        rows: rows from :func:`_make_row`.
        reference: value of the dashed line; None for no line.
    """
    controllers = list(dict.fromkeys(row["controller"] for row in rows))
    cases = list(dict.fromkeys(row["case"] for row in rows))
    ends = [reference, *(row[key] for row in rows for key in ("v", "low", "high"))]
    x = alt.X("v:Q", title=_DEVIATION, scale=value_scale(ends))
    base = alt.Chart(alt.NamedData(dataset)).encode(
        y=alt.Y("case:N", sort=cases, title=None, axis=alt.Axis(labelLimit=190)),
        color=alt.Color("controller:N", scale=cycle_choices(COLOURS, controllers), legend=None),
        tooltip=make_tooltips("case:N", ("v:Q", _DEVIATION), "low:Q", "high:Q"),
    )
    layers: list[Chart] = [
        base.mark_rule(strokeWidth=2).encode(x=alt.X("low:Q"), x2=alt.X2("high:Q")),
        base.mark_point(filled=True, opacity=1, size=60).encode(x=x),
    ]
    if reference is not None:
        layers.insert(0, alt.Chart(alt.InlineData([{"v": round_value(reference)}])).mark_rule(
            strokeDash=[6, 3], color="black"
        ).encode(x=x))
    return alt.layer(*layers)
