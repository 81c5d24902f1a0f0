"""The page of a sizing for a client, and its figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import altair as alt

from greenroof_ros.analysis.figures import Figure, Panel, Rows, distinguish_series, round_value
from greenroof_ros.analysis.page import Section, make_page, write_output
from greenroof_ros.analysis.sizing.choice import MAX_LOST
from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.analysis.sizing.results import (
    KEPT,
    LOST,
    PAGE,
    SHOWN,
    TABLE,
    Results,
    find_spread,
)
from greenroof_ros.analysis.tables import Table, format_range

if TYPE_CHECKING:
    from greenroof_ros.analysis.sizing.sizes import Sizes

_TITLE = "Which cistern for the green roof?"
_RESTS_ON = ("mains_m3", "wet_discharge_m3", KEPT, "discharge_m3", LOST)


def write_page(sizes: Sizes, directory: Path) -> Path:
    """Write the page with its figures and its table, and return its path."""
    figures = [draw_volumes(sizes), _draw_targets(sizes)]
    html = make_page(_TITLE, sizes.sentence, list_sections(sizes, figures))
    return write_output(directory, PAGE, html, figures, {TABLE: sizes.to_csv()})


def list_sections(sizes: Sizes, figures: Sequence[Figure]) -> list[Section]:
    """Return the sections of the page; the figures show the cisterns, and then the targets."""
    own, site = sizes.recommended, sizes.site
    count, seasons = len(sizes.seasons), f"{sizes.window}, {', '.join(sizes.seasons)}"
    meaning = f"Numbers are those of one season, {seasons}."
    if count > 1:
        meaning = (
            f"Numbers are means of {count} seasons, with the lowest and the highest season in "
            f"brackets ({seasons})."
        )
    value = f"less than {sizes.knee_m3:g} m³ of mains water and wet-weather discharge a season"
    if sizes.prices is not None:
        value = f"less than it costs ({sizes.prices.yearly_cistern_price:.4g} a year)"
    empty, full = (
        " and ".join(
            f"{SHOWN[name].form(start[name].mean())} m³ of {SHOWN[name].label}"
            for name in ("mains_m3", "wet_discharge_m3")
        ) for start in sizes.starts
    )
    first, *others = tabulate_volumes(sizes)
    targets = sizes.select_targets()
    return [
        Section("The recommendation", [
            f"The green roof covers {site.a2:g} m². Another {site.a_in:g} m² of roofs drain to the "
            f"cistern, which receives {100 * site.runoff_coefficient:g} % of the rain on them. "
            f"{meaning}",
            f"Beyond a cistern of {own.volume:g} m³ ({1000 * own.volume / site.a2:.0f} L per m² of "
            f"green roof), another m³ saves {value}. Of the targets compared, {own.target:g} mm is "
            f"the lowest at which plants lose at most {100 * MAX_LOST:g} % of their "
            "evapotranspiration for lack of water, or else the one at which they lose least. A "
            "higher target takes more water.",
            f"Wet weather is the time of rain and the {site.wet_after:g} h after it. Water that "
            "the valve releases in dry weather reaches the same sewer: it counts in the discharge "
            "and in the retention, but not in the discharge in wet weather.",
            first,
        ]),
        Section("Pictures", figures),
        Section("What it rests on", [
            "If the cistern is empty at the start of a season, instead of half full, the result "
            f"is {empty}; if it is full, {full}.",
            _tabulate_assumptions(sizes),
            sizes.notes,
        ]),
        Section("Other targets and outlets", [
            _tabulate(sizes, f"Targets, cistern {targets[0].volume:g} m³, "
                      f"{targets[0].described_outlet}", "target (mm)", targets, "target"),
            *others,
        ], folded=True),
        Section("What was read", [sizes.read]),
        Section("How it was made", [
            "Every design was simulated in every season. First, targets were compared with one "
            f"cistern, and then cisterns with the best target. {TABLE} contains every design and "
            "season.",
        ]),
    ]


def tabulate_volumes(sizes: Sizes, names: Sequence[str] = ()) -> list[Table]:
    """Return a table of the cisterns for each outlet, beginning with the recommended outlet.

    Args:
        sizes: the sizes.
        names: names of the results to show; by default all.
    """
    return [
        _tabulate(
            sizes, f"Cisterns, {designs[0].described_outlet}, target {designs[0].target:g} mm",
            "cistern (m³)", designs, "volume", names,
        ) for designs in sizes.select_volumes().values()
    ]


def _tabulate(
    sizes: Sizes, caption: str, heading: str, designs: Sequence[Design], varied: str,
    names: Sequence[str] = (),
) -> Table:
    """Return the table of designs that differ in an attribute, ``volume`` or ``target``."""
    columns = {name: SHOWN[name] for name in names or sizes.columns}
    own = getattr(sizes.recommended, varied)
    rows = [
        [f"{getattr(design, varied):g}", *(sizes.format(name, design) for name in columns)]
        for design in designs
    ]
    chosen = (row for row, design in enumerate(designs) if getattr(design, varied) == own)
    return Table(caption, [heading, *columns.values()], rows, frozenset(chosen))


def _tabulate_assumptions(sizes: Sizes) -> Table:
    """Return the table of the recommended design at both ends of every assumption."""
    own, columns = sizes.recommended, {name: SHOWN[name] for name in _RESTS_ON}

    def row(label: str, value: str, results: Results, best: float) -> list[str]:
        cells = (format_range(*find_spread(results[name]), each) for name, each in columns.items())
        return [label, value, *cells, f"{best:g}"]

    return Table(
        "The recommended design with each assumption at the ends of its range, one at a time",
        ["assumption", "value", *columns.values(), "best cistern (m³)"],
        [
            row("as used", "", sizes.results[own], own.volume),
            *(
                row(f"{each.assumption.label}; used: "
                    f"{getattr(sizes.site, each.assumption.name):g}", f"{each.value:g}",
                    each.results, each.best) for each in sizes.tested
            ),
        ],
        frozenset({0}),
    )


# --- figures --------------------------------------------------------------------------------------

_DRAWN = ("mains_m3", "wet_discharge_m3", "discharge_m3", "demand_met_share")


def draw_volumes(sizes: Sizes) -> Figure:
    """Return the figure of the results against the volume, with a line for each outlet."""
    designs = [design for group in sizes.select_volumes().values() for design in group]
    rows = _list_rows(sizes, designs, "volume", _DRAWN)
    return _draw("cisterns", "Cisterns and outlets", "cistern (m³)", rows, _DRAWN, "log")


def _draw_targets(sizes: Sizes) -> Figure:
    """Return the figure of the water that a target takes, and of what plants lose."""
    names, designs = ("mains_m3", LOST), sizes.select_targets()
    title = f"Targets, with a cistern of {designs[0].volume:g} m³"
    rows = _list_rows(sizes, designs, "target", names)
    return _draw("targets", title, "target (mm)", rows, names, "linear")


def _list_rows(
    sizes: Sizes, designs: Sequence[Design], varied: str, names: Sequence[str]
) -> Rows:
    rows = []
    for design in designs:
        row: dict[str, Any] = {"outlet": design.outlet, "x": getattr(design, varied)}
        for name in names:
            factor = 100.0 if SHOWN[name].unit == "%" else 1.0
            spread = find_spread(sizes.results[design][name])
            row |= {
                f"{name}{end}": round_value(factor * value)
                for end, value in zip(("", "_low", "_high"), spread, strict=True)
            }
        rows.append(row)
    return rows


def _draw(
    name: str, title: str, axis: str, rows: Rows, names: Sequence[str], scale: Any
) -> Figure:
    """Return a figure with a panel for each result."""
    places = sorted({row["x"] for row in rows})
    x = alt.X(
        "x:Q", title=axis, axis=alt.Axis(values=places, format="~g", labelOverlap=True),
        scale=alt.Scale(type=scale, nice=False, zero=False),
    )
    series = distinguish_series("outlet", list(dict.fromkeys(row["outlet"] for row in rows)))
    for channel in series.values():
        channel.legend = alt.Legend(symbolType="stroke", symbolSize=400, columns=3)
    base, panels = alt.Chart(alt.NamedData(name)).encode(x=x, **series), []
    for each in names:
        band = base.mark_area(opacity=0.15, strokeOpacity=0).encode(
            y=alt.Y(f"{each}_low:Q", title=None), y2=alt.Y2(f"{each}_high:Q")
        )
        line = base.mark_line(strokeWidth=2, point=True).encode(
            y=alt.Y(f"{each}:Q", title=None, scale=alt.Scale(zero=True))
        )
        panels.append(Panel(alt.layer(band, line), SHOWN[each].heading, 200))
    return Figure(
        name, title, "Lines are means of the seasons; bands extend from the lowest to the highest "
        "season.", tuple(panels), 2, {name: rows},
    )
