"""The page of a district, its figures, and the answer in a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import altair as alt
import numpy as np

from greenroof_ros.analysis.district.file import DRAIN, NO_FORECAST, NONE, ORIFICE, PLAN
from greenroof_ros.analysis.district.scene import AS_IS, PEAK_MIN, PERCENTILES, Flow, find_best
from greenroof_ros.analysis.figures import Figure, Panel, Rows, distinguish_series, round_value
from greenroof_ros.analysis.page import Section, make_page
from greenroof_ros.analysis.tables import COLUMNS, Column, Table, format_number, format_range
from greenroof_ros.analysis.tables import format_share as share
from greenroof_ros.base.text import number_of

if TYPE_CHECKING:
    from greenroof_ros.analysis.district.result import DistrictResult

_LABELS = {NONE: "overflow only", ORIFICE: "orifice", DRAIN: "valve, drain", PLAN: "valve, plan"}
_ROUTED = {
    "routed_overflow_m3": Column("sewer overflow, routed", "m³", format_number),
    "routed_peak_l_s": Column("peak in the sewer, routed", "L/s", format_number),
}
SHOWN = {
    **{name: COLUMNS[name] for name in ("wet_discharge_m3", "discharge_m3", "retention_share")},
    "wet_discharge_reduction": Column("less in wet weather", "%", share),
    "sewer_overflow_m3": Column("flow beyond the capacity, unrouted", "m³", format_number),
    "mains_m3": COLUMNS["mains_m3"],
}
"""columns of the main table, by the names of the results"""
_PEAKS = {
    f"peak_{each}min_mm_h": Column(f"peak over {each} min, unrouted", "mm/h", format_number)
    for each in PEAK_MIN
}
_RESTS_ON = ("wet_discharge_reduction", "retention_share", "mains_m3")
# The drawn storm: hours before and after its peak, and minutes between two points.
_BEFORE_H, _AFTER_H, _POINT_MIN = 6, 24, 15


def _name(flow: Flow) -> str:
    return _LABELS[flow.outlet] if flow.adoption else "as it is"


def _range(result: DistrictResult, flow: Flow, name: str, column: Column) -> str:
    """Return the mean of a result with its range."""
    table = result.table
    row = table.row(result.storm.flows.index(flow), named=True)
    low, high = (row[f"{name}_p{end}"] for end in PERCENTILES)
    return format_range(row[name], low, high, column)


def describe_numbers(result: DistrictResult) -> str:
    """Return a sentence that says for what the numbers stand."""
    seasons = result.all_rows["season"].unique(maintain_order=True).to_list()
    years = " to ".join(dict.fromkeys((seasons[0], seasons[-1])))
    when, draws = f"{result.window}, {years}", result.district.draws
    if len(seasons) * draws == 1:
        return f"Numbers are those of one draw of the buildings in one period ({when})."
    return (
        f"Numbers are means of {number_of(len(seasons), 'season')} ({when}) with "
        f"{number_of(draws, 'draw')} of the buildings each; in brackets, the 5th to the 95th "
        "percentile of these."
    )


def summarise(result: DistrictResult) -> str:
    """Return the effect of the best outlet at the highest and at half of the highest adoption."""
    best = find_best(result.all_rows)
    if best == AS_IS:
        return "No green roofs and cisterns of this district reduce the water in the sewer."
    counts = dict(zip(result.storm.flows, result.table["buildings"].to_list(), strict=True))
    percent = Column("", "", lambda value: f"{share(value)} %")
    less, kept = (
        _range(result, best, name, percent) for name in _RESTS_ON[:2]
    )
    text = (
        f"With green roofs and cisterns on {counts[best]:,.0f} of {len(result.buildings):,} "
        f"buildings ({_name(best)}), {less} less water reaches the sewer in wet weather; over all "
        f"weather, they retain {kept} of the rain."
    )
    lower = [
        flow for flow in counts
        if flow.outlet == best.outlet and 0 < flow.adoption <= best.adoption / 2
    ]
    if lower:
        less = _range(result, lower[-1], _RESTS_ON[0], percent)
        text += f" On {counts[lower[-1]]:,.0f} buildings, {less} less."
    for name, how in (
        ("routed_overflow_m3", "Routed through a sewer network (SWMM), the sewer overflows with"),
        ("sewer_overflow_m3", "Without routing, the flow beyond the capacity of the sewer is"),
    ):
        if name in result.table.columns and result.table[name][0] is not None:
            after, before = (
                _range(result, flow, name, Column("", "", format_number)) for flow in (best, AS_IS)
            )
            text += f" {how} {after} m³ a season instead of {before} m³."
            break
    return f"{text} {describe_numbers(result)}"


def tabulate(result: DistrictResult, names: dict[str, Column], caption: str) -> Table:
    """Return a table of results with their ranges, a row for each flow that has them."""
    columns = {name: each for name, each in names.items() if name in result.table.columns}
    rows, counts = [], result.table["buildings"].to_list()
    for flow, count, known in zip(
        result.storm.flows, counts, result.table[next(iter(columns))].to_list(), strict=True
    ):
        if known is not None:
            cells = (_range(result, flow, name, each) for name, each in columns.items())
            rows.append([_name(flow), f"{count:,.0f}", *cells])
    return Table(caption, ["outlet", "buildings", *columns.values()], rows)


def make(result: DistrictResult, figures: Sequence[Figure]) -> str:
    """Return the page as HTML."""
    district, site, routed = result.district, result.site, "routed_peak_l_s" in result.table.columns
    count = number_of(len(result.buildings), "building")
    forecast = f"no rain (forecast: {NO_FORECAST})" if district.forecast == NO_FORECAST else (
        f"the forecast '{district.forecast}'"
    )
    tables = [tabulate(result, SHOWN, "Volumes in a season")]
    if routed and result.table["routed_peak_l_s"][0] is not None:
        tables.append(tabulate(result, _ROUTED, "Routed by SWMM, first draw of the buildings"))
    tables.append(tabulate(result, _PEAKS, "Highest flows of the sum of all buildings, unrouted"))
    return make_page(f"Green roofs in a district of {count}", result.sentence, [
        Section("The results", [
            f"{count} have a connected area of {result.storm.areas.sum() / 1e4:.3g} ha. They are "
            "compared with the same buildings as they are, from whose roofs all rain runs off at "
            f"once. Wet weather is the time of rain and the {site.wet_after:g} h after it. What "
            "valves release in dry weather reaches the same sewer: it counts in the discharge and "
            "in the retention.",
            *tables, *([result.warnings] if result.warnings else []),
        ]),
        Section("Pictures", figures),
        Section("What it rests on", [
            *([_tabulate_assumptions(result)] if result.tested else []),
            [
                "Unrouted flows add up in the minute in which they leave their buildings. In pipes "
                "they spread out and arrive one after another: real peaks are lower.",
                "Streets, yards, other buildings and storage in the sewer are left out.",
                "If rain was measured hourly, peaks over less than an hour are those of the hour.",
                *([f"The valve's plan receives {forecast}."] if PLAN in district.outlets else []),
            ],
        ]),
        Section("What was read", [result.notes]),
        Section("How it was made", [
            f"greenroof district {district.path.name}, seeds {district.seed} to "
            f"{district.seed + district.draws - 1}, ticks of {district.tau:g} s. results.csv has "
            "the means and percentiles, seasons.csv the results of every draw and season, "
            "buildings.csv those of every building of the first draw, hydrographs.parquet the "
            "flows in the season of the highest flow.",
        ]),
    ])


def _tabulate_assumptions(result: DistrictResult) -> Table:
    """Return the table of the best flow at the ends of every assumption, with the first draw."""
    best = find_best(result.all_rows)
    names = [name for name in _RESTS_ON if name in result.table.columns]
    cases = [
        ("as used", "", each.rows) if each.assumption is None else (
            f"{each.assumption.label}; used: {getattr(result.site, each.assumption.name):g}",
            f"{each.value:g}", each.rows,
        ) for each in result.tested
    ]
    return Table(
        f"Some of the buildings with a green roof ({_name(best)}), with each assumption at both "
        "ends of its range, one at a time; lowest and highest season in brackets",
        ["assumption", "value", *(SHOWN[name] for name in names)],
        [
            [label, value, *(
                format_range(float(each.mean()), float(each.min()), float(each.max()), SHOWN[name])
                for name in names for each in [rows[name].to_numpy()]
            )] for label, value, rows in cases
        ], frozenset({0}),
    )


def draw_figures(result: DistrictResult) -> list[Figure]:
    """Return the figures: results against adoption, and the storm."""
    table, rows = result.table, list[dict[str, Any]]()
    names = ["wet_discharge_m3", "discharge_m3", "sewer_overflow_m3", "mains_m3"]
    names = [name for name in names if name in table.columns]
    outlets = list(dict.fromkeys(flow.outlet for flow in result.storm.flows))
    for row in table.iter_rows(named=True):
        for outlet in [row["outlet"]] if row["adoption"] else outlets:
            ends = (f"{name}{end}" for name in names for end in ("", "_p5", "_p95"))
            rows.append({"outlet": _LABELS[outlet], "adoption": row["adoption"],
                         **{end: round_value(row[end]) for end in ends}})
    base = alt.Chart(alt.NamedData("adoption")).encode(
        x=alt.X("adoption:Q", title="buildings with green roof and cistern",
                axis=alt.Axis(format="%")),
        **distinguish_series("outlet", [_LABELS[outlet] for outlet in outlets]),
    )
    panels = [
        Panel(alt.layer(
            base.mark_area(opacity=0.12, strokeOpacity=0).encode(
                y=alt.Y(f"{name}_p5:Q", title=None), y2=alt.Y2(f"{name}_p95:Q")
            ),
            base.mark_line(point=True, strokeWidth=2).encode(y=alt.Y(f"{name}:Q", title=None)),
        ), SHOWN[name].heading) for name in names
    ]
    return [
        Figure("adoption", "Volumes in a season, by adoption", "Lines are means; bands extend from "
               "the 5th to the 95th percentile.", tuple(panels), 2, {"adoption": rows}),
        _draw_storm(result),
    ]


def _draw_storm(result: DistrictResult) -> Figure:
    """Return a figure of the flows around the peak hour, at the highest level of adoption."""
    scene = result.storm
    seconds, highest = float(scene.durations[0]), scene.flows[-1].adoption
    size, hour = (max(1, round(each / seconds)) for each in (60 * _POINT_MIN, 3600))
    reference = scene.group_discharges(AS_IS).sum(axis=0)
    peak = int(np.convolve(reference, np.ones(hour)).argmax())
    first = max(0, peak - _BEFORE_H * hour)
    places = np.arange(first, min(len(reference), peak + _AFTER_H * hour), size)
    factor, start = 3.6e6 / scene.areas.sum(), result.storm_run.start.replace(tzinfo=None)
    last, rows, labels = min(places[-1] + size, len(reference)), Rows(), []
    lengths = np.add.reduceat(scene.durations[:last], places)
    for flow in scene.flows:
        if flow.adoption not in (0, highest):
            continue
        labels.append(_name(flow))
        volumes = scene.group_discharges(flow).sum(axis=0)[:last]
        for place, value in zip(places, np.add.reduceat(volumes, places) / lengths, strict=True):
            time = start + timedelta(seconds=place * seconds)
            rows.append({"t": f"{time.isoformat()}Z", "outlet": labels[-1],
                         "v": round_value(factor * value)})
    lines = alt.Chart(alt.NamedData("storm")).mark_line(
        clip=True, strokeWidth=1.5, interpolate="step-after"
    ).encode(
        x=alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
                axis=alt.Axis(tickCount=6, format="%d %b %H:%M")),
        y=alt.Y("v:Q", title="mm/h over the connected area"),
        **distinguish_series("outlet", labels),
    )
    capacity = result.district.sewer_capacity
    layers = [lines]
    if capacity is not None:
        data = alt.InlineData([{"v": capacity}])
        rule = alt.Chart(data).mark_rule(strokeDash=[6, 3], color="#555555")
        layers.insert(0, rule.encode(y="v:Q"))
    note = "" if capacity is None else f" The dashed line is the capacity, {capacity:g} mm/h."
    return Figure(
        "storm", "The hour with the highest flow, and the day after it",
        f"Unrouted means over {_POINT_MIN} minutes, first draw of the buildings.{note}",
        (Panel(alt.layer(*layers), "", 300),), 1, {"storm": rows},
    )
