"""The figure of runs under forecast errors of many seeds: deviation over the forecasts' skill."""

from __future__ import annotations

from typing import Any

import altair as alt

from greenroof_ros.recording.results_table import differing
from greenroof_ros.report.drawing import COLOURS, SHAPES, Chart, Figure, Panel, Rows, cycle, short
from greenroof_ros.report.results import Report, heading
from greenroof_ros.report.seeds import Place, Spread, best_first, spreads
from greenroof_ros.report.settings import controller_name

_AMOUNTS = ("mean", "mean of the worst tenth")
_AXIS = "total |x2 - x2*| (m³)"


def forecast_errors(report: Report) -> Figure:
    """Return mean and worst tenth of the total deviation over the forecasts' skill."""
    found = spreads(report)
    places = list(dict.fromkeys(one.place for one in found))
    panels, data = [], {}
    for number, place in enumerate(places, start=1):
        here = [one for one in found if one.place == place]
        dataset = f"forecast-errors-{number}"
        data[dataset] = _rows(here)
        panels.append(
            Panel(
                _chart(report, here, dataset), _title(place, places), height=260, toggle="series"
            )
        )
    seeds = sorted({len(one.totals) for one in found})
    count = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"{seeds[0]}"
    caption = (
        f"Total deviation of {count} seeds of errors each, over the skill of the forecasts. "
        "Colours: controllers; shapes: their settings. Filled marks on full lines: the mean; "
        "hollow ones on dashed lines: the mean of the worst tenth of the runs. The panels' axes do "
        "not begin at 0."
    )
    if any(one.bound_m3 for one in found):
        caption += " Black: the least that any controller with commands up to 1 could reach."
    return Figure(
        "forecast-errors", "Deviation under forecast errors", caption, tuple(panels),
        min(len(panels), 3), data,
    )


def _series(one: Spread) -> str:
    return f"{controller_name(one.controller)} {one.setting}".strip()


def _rows(found: list[Spread]) -> Rows:
    return [
        {
            "series": _series(one), "skill": one.skill, "amount": amount, "v": short(value),
            "seeds": len(one.totals),
        }
        for one in found
        for amount, value in zip(_AMOUNTS, (one.mean, one.worst_tenth), strict=True)
    ]


def _title(place: Place, places: list[Place]) -> str | list[str]:
    """Return what distinguishes a panel from the others: its window and its initial state."""
    apart = differing([other.facts for other in places])
    initial = f"from {place.initial}"
    if not apart:
        return initial
    return [heading({name: place.facts[name] for name in apart}, apart), initial]


def _look(report: Report, found: list[Spread]) -> dict[str, Any]:
    """Return colours by controller and shapes by the controller's setting."""
    colours = dict(zip(report.controllers, cycle(COLOURS, report.controllers), strict=True))
    shapes: dict[str, str] = {}
    settings: dict[str, list[str]] = {}
    for one in found:
        of = settings.setdefault(one.controller, [])
        if one.setting not in of:
            of.append(one.setting)
        shapes[_series(one)] = SHAPES[of.index(one.setting) % len(SHAPES)]
    names = {_series(one): colours[one.controller] for one in found}
    return {
        "color": alt.Color(
            "series:N", title=None,
            scale=alt.Scale(domain=list(names), range=list(names.values())),
            legend=alt.Legend(columns=2),
        ),
        "shape": alt.Shape(
            "series:N", title=None,
            scale=alt.Scale(domain=list(names), range=[shapes[name] for name in names]),
        ),
    }


def _chart(report: Report, found: list[Spread], dataset: str) -> Chart:
    """Return a panel: lines and marks of each series, and the least possible."""
    values = [value for one in found for value in (one.mean, one.worst_tenth)]
    bounds = sorted({one.bound_m3 for one in found if one.bound_m3 is not None})
    low, high = min(values + bounds), max(values + bounds)
    # Enough for the words below the line.
    margin = 0.08 * (high - low) or 0.08 * high or 1.0
    scale = alt.Scale(domain=[max(0.0, low - margin), high + margin], nice=False)
    x = alt.X(
        "skill:O", title="skill of the forecasts", sort=best_first(one.skill for one in found),
        axis=alt.Axis(labelAngle=0),
    )
    y = alt.Y("v:Q", title=_AXIS, scale=scale)
    look = _look(report, found)
    layers = [
        alt.Chart(alt.InlineData([{"v": bound, "text": "least possible"}])).mark_rule(
            color="black", strokeWidth=1.5
        ).encode(y=y, tooltip=[alt.Tooltip("v:Q", title="least possible (m³)", format=".6~g")])
        for bound in bounds
    ]
    layers += [
        alt.Chart(alt.InlineData([{"v": bound, "text": "least possible"}])).mark_text(
            align="left", baseline="top", dx=4, dy=3, fontSize=10
        ).encode(x=alt.XValue(0), y=y, text=alt.Text("text:N"))
        for bound in bounds
    ]
    tooltip = [
        alt.Tooltip("series:N", title="controller"), alt.Tooltip("skill:N", title="skill"),
        alt.Tooltip("amount:N", title="of the seeds"), alt.Tooltip("seeds:Q"),
        alt.Tooltip("v:Q", title=_AXIS, format=".6~g"),
    ]
    base = alt.Chart(alt.NamedData(dataset))
    for amount, filled, dash in zip(_AMOUNTS, (True, False), ([1, 0], [4, 3]), strict=True):
        part = base.transform_filter(alt.datum.amount == amount)
        layers += [
            part.mark_line(strokeWidth=1.5, strokeDash=dash).encode(
                x=x, y=y, color=look["color"]
            ),
            part.mark_point(filled=filled, size=70, opacity=1).encode(
                x=x, y=y, **look, tooltip=tooltip
            ),
        ]
    return alt.layer(*layers)
