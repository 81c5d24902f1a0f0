"""Tables and figures of a district's results."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import altair as alt
import polars as pl

from greenroof_ros.analysis import tables
from greenroof_ros.analysis.district.file import DRAIN, NONE, ORIFICE, PLAN, ROOF
from greenroof_ros.analysis.figures import Figure, Panel, distinguish_series, draw_band
from greenroof_ros.analysis.references import NO_IRRIGATION, PEAKS
from greenroof_ros.analysis.seasons import find_ranges
from greenroof_ros.analysis.tables import COLUMNS, Column, Table, format_number, write_range
from greenroof_ros.analysis.tables import format_share as share

LESS = "wet_discharge_reduction"
VOLUMES = {
    **{name: COLUMNS[name] for name in ("wet_discharge_m3", "discharge_m3", "retention_share")},
    LESS: Column("less in wet weather", "%", share),
    "sewer_overflow_m3": Column("flow beyond the capacity, unrouted", "m³", format_number),
    "sewer_overflow_days": Column("days with flow beyond the capacity", "", format_number),
    "mains_m3": COLUMNS["mains_m3"],
}
"""columns of the tables, by the names of the results"""
ROUTED = {
    "routed_overflow_m3": Column("sewer overflow, routed", "m³", format_number),
    "routed_peak_l_s": Column("peak in the sewer, routed", "L/s", format_number),
}
UNROUTED = {
    name: Column(f"peak over {width} min, unrouted", "L/s", format_number)
    for width, name in PEAKS.items()
}
ENDS = ("_p5", "_p95")
"""endings of the columns with the 5th and the 95th percentile"""
RESTS_ON = {name: VOLUMES[name] for name in (LESS, "retention_share", "mains_m3")}
_LABELS = {
    ROOF: NO_IRRIGATION, NONE: "overflow only", ORIFICE: "orifice", DRAIN: "valve, drain",
    PLAN: "valve, plan",
}


def label(row: Mapping[str, Any]) -> str:
    """Return the outlet of a row in words."""
    return _LABELS[row["outlet"]] if row["adoption"] else "as it is"


def say(row: Mapping[str, Any], name: str) -> str:
    """Return the mean of a result with its range and its unit."""
    column = (VOLUMES | ROUTED)[name.removeprefix("dry_")]
    return f"{write_range(row, name, column, *ENDS)} {column.unit}"


def tabulate(table: pl.DataFrame, columns: Mapping[str, Column], caption: str) -> Table:
    """Return a table of results with their ranges, a row for each flow that has them."""
    return Table(caption, ["outlet", "buildings", *columns.values()], [
        [label(row), f"{row['buildings']:,.0f}",
         *(write_range(row, *each, *ENDS) for each in columns.items())]
        for row in table.drop_nulls(list(columns)).iter_rows(named=True)
    ])


def tabulate_assumptions(assumptions: pl.DataFrame, outlet: str) -> Table:
    """Return the table of the results at the ends of every assumption.

    Args:
        assumptions: results of every season, as used and at the ends, with both of these in words.
        outlet: the outlet in words.
    """
    by = ["assumption", "value"]
    ranges = find_ranges(assumptions.select(*by, "season", *RESTS_ON), by)
    return Table(
        f"The first ten buildings with a green roof of the first draw ({outlet}), which differ "
        "from all buildings, with each assumption at both ends of its range, one at a time; lowest "
        "and highest season in brackets",
        [*by, *RESTS_ON.values()], [
            [*(row[name] for name in by), *(write_range(row, *each) for each in RESTS_ON.items())]
            for row in ranges.iter_rows(named=True)
        ], frozenset({0}),
    )


def tabulate_peaks(rows: pl.DataFrame, best: Mapping[str, Any], minutes: int) -> Table:
    """Return the table of the seasons' highest flows by return period, for two of the flows.

    Args:
        rows: results of every flow in every draw and season; peaks are means of the draws.
        best: the flow that is compared with the district as it is.
        minutes: width of the window of the peaks (min).
    """
    peaks = dict[str, pl.Series]()
    for flow in (rows.row(0, named=True), best):
        own = rows.filter(outlet=flow["outlet"], adoption=flow["adoption"])
        means = own.group_by("season").agg(pl.col(PEAKS[minutes]).mean())
        peaks[label(flow)] = means[PEAKS[minutes]]
    caption = f"The seasons' highest flows over {minutes} min, unrouted (L/s)"
    return tables.tabulate_peaks(caption, peaks)


def draw_adoption(table: pl.DataFrame) -> Figure:
    """Return the figure of the volumes against adoption."""
    names = ["wet_discharge_m3", "discharge_m3", "sewer_overflow_m3", "mains_m3"]
    table = table.with_columns(pl.col("outlet").replace(_LABELS))
    outlets = table["outlet"].unique(maintain_order=True).to_list()
    data = pl.concat([
        *(table[:1].with_columns(outlet=pl.lit(outlet)) for outlet in outlets), table[1:]
    ])
    base = alt.Chart(alt.NamedData("adoption")).encode(
        x=alt.X("adoption:Q", title="buildings with green roof and cistern",
                axis=alt.Axis(format="%")), **distinguish_series("outlet", outlets),
    )
    panels = [
        Panel(draw_band(base, name, ENDS), VOLUMES[name].heading) for name in names
    ]
    return Figure("adoption", "Volumes in a season, by adoption", "Lines are means; bands extend "
                  "from the 5th to the 95th percentile.", tuple(panels), 2,
                  {"adoption": data.to_dicts()})
