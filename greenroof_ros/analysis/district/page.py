"""The page of a district: a self-contained HTML file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta
from typing import Any

import altair as alt
import numpy as np

from greenroof_ros.analysis.district.adoption import Adoption
from greenroof_ros.analysis.district.district_file import DRAIN, NONE, ORIFICE, PLAN
from greenroof_ros.analysis.district.run import DistrictRun
from greenroof_ros.analysis.district.totals import AS_IS, Flow, Totals
from greenroof_ros.analysis.figures import (
    Figure,
    Rows,
    make_tooltips,
    round_value,
    series_panel,
)
from greenroof_ros.analysis.report.page import make_page
from greenroof_ros.base.text import number_of
from greenroof_ros.base.times import to_people

LABELS = {
    NONE: "overflow only", ORIFICE: "orifice", DRAIN: "valve, drain", PLAN: "valve, plan",
}
"""Labels of the kinds of outlet."""
AS_IS_LABEL = "as it is"
"""Label of the district without green roofs and cisterns."""
# The drawn storm: hours before and after its peak, and minutes between two points.
_BEFORE_H, _AFTER_H, _POINT_MIN = 6, 48, 5


def render(
    run: DistrictRun, area: float, rows: Sequence[dict[str, Any]], figures: Sequence[Figure]
) -> str:
    """Return the page as HTML.

    Args:
        run: the simulated district.
        area: connected area of all buildings (m2).
        rows: rows of the results.
        figures: figures from :func:`draw_figures`.
    """
    return make_page(
        __package__, figures, headline=summarise(run, rows), rows=rows,
        labels=LABELS, run=run, area=area, start=to_people(run.runs[0].start),
        capacity=run.district.sewer_capacity, columns=COLUMNS, warnings=warn(run, rows),
        number_of=number_of, notes=run.notes, cells=len(run.runs), shown=_shown, percent=percent,
    )


# --- words ----------------------------------------------------------------------------------------

COLUMNS = {
    "wet_discharge_m3": "in wet weather (m³)",
    "wet_discharge_reduction": "less",
    "peak_5min_mm_h": "peak, 5 min (mm/h)",
    "peak_15min_mm_h": "15 min",
    "peak_60min_mm_h": "60 min",
    "peak_60min_reduction": "less",
    "sewer_overflow_m3": "sewer overflow (m³)",
    "sewer_overflow_reduction": "less",
    "sewer_overflow_hours": "hours of overflow",
    "wet_low_outlet_m3": "through low outlets in wet weather (m³)",
    "low_outlet_peak_5min_mm_h": "peak through low outlets, 5 min (mm/h)",
    "mains_m3": "mains water (m³)",
    "demand_met_share": "irrigation without mains water",
}
"""Headers of the table's columns, by the results' names."""


def summarise(run: DistrictRun, rows: Sequence[dict[str, Any]]) -> str:
    """Return the main result in a sentence or two: the best outlet, at two levels of adoption."""
    reference, *others = (row for row in rows if row["buildings"] or not row["adoption"])
    if not others:
        return "No building has a green roof: there is nothing to compare."
    best = min(others, key=lambda row: (row["wet_discharge_m3"], row["adoption"]))
    lower = [
        row for row in others
        if row["outlet"] == best["outlet"] and row["adoption"] <= best["adoption"] / 2
    ]
    what = "a green roof and a cistern" if len(run.buildings) == 1 else "green roofs and cisterns"
    sentences = [
        f"With {what} on {name_share(best['adoption'], len(run.buildings))} "
        f"({LABELS[best['outlet']]}), {_compare(reference, best)}."
    ]
    sentences += [
        f"On {percent(row['adoption'])} of them, {_compare(reference, row)}." for row in lower[-1:]
    ]
    return " ".join(sentences)


def name_share(adoption: float, count: int) -> str:
    """Return a share of the buildings in words, as in ``all 1,000 buildings``.

    Args:
        adoption: share of the buildings (1).
        count: total number of buildings.
    """
    if Adoption(count, (adoption,), 1.0).counts[0] < count:
        return f"{percent(adoption)} of the {number_of(count, 'building')}"
    return f"all {count:,} buildings" if count > 1 else "the only building"


# Compared results: the name, and the words if it is zero, if it is unchanged and if it has changed.
_COMPARED = (
    ("wet_discharge_m3", "no storm water reaches the sewer in wet weather",
     "just as much storm water reaches the sewer in wet weather",
     "{percent} {less} storm water reaches the sewer in wet weather", ("less", "more")),
    ("sewer_overflow_m3", "the sewer no longer overflows", "the sewer overflows just as much",
     "the sewer overflows {percent} {less}", ("less", "more")),
    ("peak_60min_l_s", "no water reaches the sewer in any hour",
     "the peak over an hour is the same", "the peak over an hour is {percent} {less}",
     ("lower", "higher")),
)


def _compare(reference: dict[str, Any], row: dict[str, Any]) -> str:
    parts = []
    for key, none, same, changed, (less, more) in _COMPARED:
        if not reference.get(key):
            continue
        change = 1 - row[key] / reference[key]
        amount = percent(abs(change))
        if not row[key]:
            parts.append(none)
        elif amount == percent(0.0):
            parts.append(same)
        else:
            parts.append(changed.format(percent=amount, less=less if change > 0 else more))
    if not reference.get("sewer_overflow_m3") and row.get("sewer_overflow_m3"):
        parts.append("the sewer, which is large enough for the buildings as they are, overflows")
    return " and ".join([*filter(None, [", ".join(parts[:-1])]), *parts[-1:]]) or "nothing changes"


def describe_valves(rows: Sequence[dict[str, Any]], count: int) -> list[str]:
    """Return sentences about the time and the rate at which each valve policy releases water.

    Args:
        rows: rows of the results.
        count: number of buildings.
    """
    storm, sentences = rows[0]["peak_5min_mm_h"], []
    for outlet in (DRAIN, PLAN):
        row = max(
            (row for row in rows if row["outlet"] == outlet and row["low_outlet_m3"]),
            key=lambda row: float(row["adoption"]), default=None,
        )
        if row is not None:
            peak = row["low_outlet_peak_5min_mm_h"]
            wet = row["wet_low_outlet_m3"] / row["low_outlet_m3"]
            sentences.append(
                f"{LABELS[outlet].capitalize()}, {name_share(row['adoption'], count)}: "
                f"{percent(wet) if wet else 'none'} of the water from the valves is released in "
                f"wet weather. Together, the valves release at most {peak:.3g} mm/h"
                + (f", which is {percent(peak / storm)} of the storm's peak." if storm else ".")
            )
    return sentences


def warn(run: DistrictRun, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return a warning if the flow from all valves exceeds the sewer's dry-weather capacity."""
    capacity = run.district.sewer_capacity
    if capacity is None:
        return []
    over = [row for row in rows if row["dry_sewer_overflow_m3"] > 0]
    if not over:
        return []
    worst = max(over, key=lambda row: float(row["dry_peak_5min_mm_h"]))
    return [
        "the cisterns empty at the same time: in dry weather they release up to "
        f"{worst['dry_peak_5min_mm_h']:.3g} mm/h ({LABELS[worst['outlet']]}, "
        f"{name_share(worst['adoption'], len(run.buildings))}), which exceeds the sewer's "
        f"capacity of {capacity:g} mm/h; choose a smaller low_outlet_radius"
    ]


def percent(share: float) -> str:
    """Return a share (1) in per cent, with a decimal if it would round to 0 or 100.

    A non-breaking space keeps the number and the per cent sign on one line.
    """
    text = f"{round(100 * share)}"
    if text in ("0", "100") and f"{100 * share:.1f}" not in ("0.0", "-0.0", "100.0"):
        text = f"{100 * share:.1f}"
    return f"{text}\N{NO-BREAK SPACE}%"


def _shown(key: str, value: float | None) -> str:
    if value is None:
        return "-"
    if key.endswith(("_reduction", "_share")):
        return percent(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


# --- figures --------------------------------------------------------------------------------------


def draw_figures(
    run: DistrictRun, totals: Totals, rows: Sequence[dict[str, Any]]
) -> Iterator[Figure]:
    """Yield the figures: results against adoption, water from the valves, and the peak hour."""
    names = [LABELS[outlet] for outlet in totals.outlets]
    capacity = run.district.sewer_capacity
    amounts = [
        ("wet_discharge_m3", "Discharge in wet weather", "m³", None),
        *((("sewer_overflow_m3", "Sewer overflow", "m³", None),) if capacity else ()),
        ("peak_60min_mm_h", "Peak over 60 minutes", "mm/h", capacity),
        *((("mains_m3", "Mains water for irrigation", "m³", None),) if "mains_m3" in rows[0]
          else ()),
    ]
    yield _draw_over_adoption(
        "adoption", "Discharge to the sewer, by adoption",
        "The values are for all buildings together, over their connected area. "
        + _capacity_note(capacity),
        rows, names, amounts,
    )
    valves = describe_valves(rows, len(run.buildings))
    yield _draw_over_adoption(
        "together",
        "Do the valves open together?" if valves else "The highest flow over five minutes",
        " ".join([
            *(
                ["The valves open together in dry weather.", *valves,
                 "The figure shows the highest flow over five minutes."]
                if valves else ["No valve opens."]
            ),
            _capacity_note(capacity),
        ]),
        rows, names, [
            ("peak_5min_mm_h", "At any time", "mm/h", capacity),
            ("low_outlet_peak_5min_mm_h", "Through valves or orifices", "mm/h", capacity),
        ],
    )
    yield _draw_storm(run, totals, [*names, AS_IS_LABEL])


def _capacity_note(capacity: float | None) -> str:
    return f"The dashed line is the sewer's capacity, {capacity:g} mm/h." if capacity else ""


def _draw_over_adoption(
    name: str, title: str, caption: str, rows: Sequence[dict[str, Any]], names: list[str],
    amounts: Sequence[tuple[str, str, str, float | None]],
) -> Figure:
    """Return a figure of results against adoption; every line begins with the district as it is."""
    reference, *others = rows
    data: Rows = [
        {"outlet": LABELS[row["outlet"]], "adoption": row["adoption"],
         **{key: round_value(row[key]) for key, *_ in amounts}}
        for row in (*({**reference, "outlet": outlet} for outlet in LABELS), *others)
        if LABELS[row["outlet"]] in names
    ]
    panels = []
    for key, what, unit, line in amounts:
        lines = alt.Chart(alt.NamedData(name)).mark_line(point=True, strokeWidth=1.5).encode(
            x=alt.X("adoption:Q", title="buildings with green roof and cistern",
                    axis=alt.Axis(format="%")),
            y=alt.Y(f"{key}:Q", title=unit, scale=alt.Scale(zero=True)),
            tooltip=make_tooltips(
                "outlet:N", alt.Tooltip("adoption:Q", format=".0%"),
                alt.Tooltip(f"{key}:Q", title=f"{what} ({unit})", format=",.4~g"),
            ),
        )
        below = [] if line is None else [_draw_level(line)]
        panels.append(series_panel(lines, "outlet", names, what, below))
    return Figure(name, title, caption, tuple(panels), 2, {name: data})


def _draw_level(value: float) -> alt.Chart:
    rule: alt.Chart = alt.Chart(alt.InlineData([{"v": value}])).mark_rule(
        strokeDash=[6, 3], color="#555555"
    ).encode(y="v:Q")
    return rule


def _draw_storm(run: DistrictRun, totals: Totals, names: list[str]) -> Figure:
    """Return a figure of the flows around the peak hour, at the highest level of adoption."""
    size = max(1, round(60 * _POINT_MIN / totals.seconds))
    hour = max(1, round(3600 / totals.seconds))
    reference = totals.discharge(AS_IS)
    sums = np.convolve(reference, np.ones(hour))
    peak = int(sums.argmax())
    first = max(0, peak - _BEFORE_H * hour) // size * size
    last = min(len(reference), peak + _AFTER_H * hour)
    highest = max(totals.adoption.shares, default=0.0)
    series = {AS_IS_LABEL: reference} | {
        LABELS[outlet]: totals.discharge(Flow(outlet, highest)) for outlet in totals.outlets
    }
    factor = 1000 * 3600 / totals.seconds / totals.area
    start: datetime = run.runs[0].start.replace(tzinfo=None)
    rows: Rows = []
    for name, volumes in series.items():
        points = np.add.reduceat(volumes[first:last], np.arange(0, last - first, size)) / size
        for number, value in enumerate(points.tolist()):
            time = start + timedelta(seconds=(first + number * size) * totals.seconds)
            rows.append({"t": f"{time.isoformat()}Z", "outlet": name,
                         "v": round_value(factor * value)})
    lines = alt.Chart(alt.NamedData("storm")).mark_line(
        clip=True, strokeWidth=1.2, interpolate="step-after"
    ).encode(
        x=alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
                axis=alt.Axis(tickCount=6, format="%d %b %H:%M")),
        y=alt.Y("v:Q", title="mm/h over the connected area"),
        tooltip=make_tooltips(
            "outlet:N", alt.Tooltip("t:T", title="time", timeUnit="utcyearmonthdatehoursminutes",
                                    format="%Y-%m-%d %H:%M"),
            alt.Tooltip("v:Q", title="mm/h", format=".3~g"),
        ),
    )
    capacity = run.district.sewer_capacity
    below = [] if capacity is None else [_draw_level(capacity)]
    panel = series_panel(lines, "outlet", names, f"Means over {_POINT_MIN} minutes", below)
    return Figure(
        "storm", "The hour with the highest flow, and the days after it",
        f"With green roofs and cisterns on {name_share(highest, len(run.buildings))}. "
        + _capacity_note(capacity), (panel._replace(height=320),), 1, {"storm": rows},
    )
