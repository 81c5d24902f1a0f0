"""The results of a sizing: a recommendation, tables, figures, and a page for a client."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import altair as alt
import polars

from greenroof_ros.analysis.figures import Figure, Panel, distinguish_series, draw_band
from greenroof_ros.analysis.page import Section, claim_output, make_page, write_output
from greenroof_ros.analysis.references import PEAKS
from greenroof_ros.analysis.seasons import find_ranges
from greenroof_ros.analysis.sizing import designs as plans
from greenroof_ros.analysis.sizing.designs import KEPT, LOST, SHOWN, TABLE, Design
from greenroof_ros.analysis.tables import Table, tabulate_peaks, write_range
from greenroof_ros.controllers.outlet import PLAN
from greenroof_ros.site.site import Site

_TITLE = "Which cistern for the green roof?"
_RESTS_ON = ("mains_m3", "wet_discharge_m3", KEPT, "discharge_m3", LOST)
_OF_TARGETS = (*plans.MAIN, LOST, "stress_hours")
_COMPARED = ("wet_discharge_m3", "discharge_m3", "retention_share", "overflow_days")
# The peaks that are shown (min).
_PEAK_MIN = 5
_VARIED = {"volume_m3": "cistern (m³)", "target_mm": "target (mm)", "outlet": "outlet"}


@dataclass(frozen=True, eq=False, repr=False)
class Sizes:
    """Targets, cisterns and outlets, compared over the seasons of a record.

    Attributes:
        name: name of the site's file, without its extension; empty without a file.
        site: the site that all designs share.
        table_of_seasons: results, with a row for each design and season. The columns are named as
            in ``summary.json``, besides those of :data:`KEPT` and :data:`LOST`. First come the
            designs that compare targets, then those that compare cisterns with the recommended
            target.
        recommended: the recommended design.
        tested: results of the recommended design in each season, as used and at both ends of each
            assumption, and of the initial state; :data:`.designs.BY_TEST` says which.
        references: metrics without a green roof, and of one without irrigation, in each season,
            by ``case``.
        seasons: names of the seasons.
        window: the days of a season, in words.
        notes: assumptions, and remarks on the results.
        read: what the weather contains, what was missing in it, and which seasons are left out.
        knee_m3: minimum volume of water that each additional m3 of cistern must save per season
            (m3).
    """

    name: str
    site: Site
    table_of_seasons: polars.DataFrame
    recommended: Design
    tested: polars.DataFrame
    references: polars.DataFrame
    seasons: Sequence[str]
    window: str
    notes: Sequence[str]
    read: Sequence[str]
    knee_m3: float

    @property
    def table(self) -> polars.DataFrame:
        """The mean, lowest and highest value of each result over the seasons, by design.

        The columns of the lowest and the highest value end in ``_min`` and ``_max``.
        """
        return find_ranges(self.table_of_seasons, plans.BY_DESIGN)

    @property
    def sentence(self) -> str:
        """The recommendation, and what it brings in a season."""
        own = self.recommended
        (row,) = self.table.filter(**own._asdict()).to_dicts()
        text = {
            name: write_range(row, name, column) for name, column in SHOWN.items() if name in row
        }
        other = self.site.monthly_other_demand is not None
        uses = "the irrigation and other uses" if other else "the irrigation"
        watered = "" if row["demand_met_share"] is None else (
            f"{text['demand_met_share']} % of {uses} is rain, {text['mains_m3']} m³ is "
            "mains water, and "
        )
        kept = "" if row[KEPT] is None else f", {text[KEPT]} % less than the rain on the roofs"
        few = "" if len(self.seasons) > 1 else (
            "One season is too few for a recommendation: what the cistern holds at its start "
            "counts as much as the rain. "
        )
        return (
            f"{few}A cistern of {own.volume_m3:g} m³ ({own.described_outlet}) and a target of "
            f"{own.target_mm:g} mm of water on the roof are recommended. In a season, {watered}"
            f"{text['wet_discharge_m3']} m³ reaches the sewer in wet weather{kept}. In all "
            f"weather, {text['discharge_m3']} m³ reaches the sewer, a retention of "
            f"{text['retention_share']} %."
        )

    def plot(self) -> alt.ConcatChart:
        """Return a chart of the results against the cistern's volume, with a line per outlet.

        A line shows the mean of the seasons, and its band extends from the lowest to the highest
        season.
        """
        return _draw_volumes(self).chart()

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the page ``sizes.html``, the table ``sizes.csv``, and the figures; return the page.

        Args:
            directory: output directory, which is created if it does not exist, and may contain an
                earlier result, which is replaced.

        Raises:
            ConfigurationError: if the directory contains anything else.
            OSError: if the directory cannot be written to.
        """
        claim_output(Path(directory), plans.PAGE, [TABLE])
        figures = [_draw_volumes(self), _draw_targets(self)]
        title = f"{_TITLE} {self.name}".strip()
        html = make_page(title, self.sentence, list_sections(self, figures))
        remarks = "".join(f"# {note}\n" for note in (*self.notes, *self.read))
        table = remarks + self.table_of_seasons.write_csv()
        return write_output(Path(directory), plans.PAGE, html, figures, {TABLE: table})


def list_sections(sizes: Sizes, figures: Sequence[Figure]) -> list[Section]:
    """Return the sections of the page; the figures show the cisterns, and then the targets."""
    own, site = sizes.recommended, sizes.site
    used = sizes.table_of_seasons.filter(**own._asdict())
    rain, on_roof, lost = used.select("rain_m3", "rain_roof_m3", LOST).mean().row(0)
    most = plans.MAX_LOST
    losing = f"at most {100 * most:g} %" if lost <= most else "the smallest part"
    first, *others = tabulate_volumes(sizes)
    outlets, remarks = describe_outlets(sizes)
    ranges = ", with the lowest and the highest season in brackets" * (len(sizes.seasons) > 1)
    return [
        Section("The recommendation", [
            f"The green roof covers {site.a2:g} m². Another {site.a_in:g} m² of roofs drain to the "
            f"cistern, which receives {100 * site.runoff_coefficient:g} % of the rain on them. In "
            f"a season, {1000 * on_roof / site.a2:.0f} mm of rain falls, {rain:.3g} m³ on all of "
            f"these roofs. Numbers are means of the seasons ({sizes.window}, "
            f"{', '.join(sizes.seasons)}){ranges}; percentages are means of the seasons' "
            "percentages.",
            f"Beyond a cistern of {own.volume_m3:g} m³ ({1000 * own.volume_m3 / site.a2:.0f} L per "
            f"m² of green roof), another m³ saves less than {sizes.knee_m3:g} m³ of mains water "
            f"and wet-weather discharge a season. Of the targets compared, {own.target_mm:g} mm is "
            f"the lowest at which plants lose {losing} of their evapotranspiration for lack of "
            "water. A higher target takes more water; add what the level sensor may be wrong by.",
            f"Wet weather is the time of rain and the {site.wet_after:g} h after it. Water that "
            "the valve releases in dry weather reaches the same sewer: it counts in the discharge "
            "and in the retention, but not in the discharge in wet weather.",
            *outlets, *remarks, first,
        ]),
        Section("Compared with no green roof", [
            _tabulate_references(sizes), *[_tabulate_peaks(sizes)] * bool(ranges),
        ]),
        Section("Pictures", figures),
        Section("What it rests on", [
            _tabulate_assumptions(sizes),
            sizes.notes,
        ]),
        Section("Other targets and outlets", [
            _tabulate(sizes, f"Targets, cistern {sizes.table['volume_m3'][0]:g} m³, "
                      f"{own.described_outlet}", "target_mm", _select_targets(sizes), _OF_TARGETS),
            *others,
        ], folded=True),
        Section("What was read", [sizes.read]),
        Section("How it was made", [
            "Every design was simulated in every season. First, targets were compared with one "
            f"cistern, and then cisterns with the best target. {plans.TABLE} contains every design "
            "and season.",
        ]),
    ]


def _select_targets(sizes: Sizes) -> polars.DataFrame:
    """Return the means and ranges of the designs that compare targets, by target."""
    volume, outlet = sizes.table.select("volume_m3", "outlet").row(0)
    return sizes.table.filter(volume_m3=volume, outlet=outlet).sort("target_mm")


def describe_outlets(sizes: Sizes) -> tuple[list[Table], list[str]]:
    """Return tables of several outlets, and remarks: that ``plan`` has no effect, if so.

    The first one is for the compared volume that is nearest to that of the site's own cistern, and
    the second one for the recommended volume.
    """
    own = plans.find_volume(sizes.site)
    rows = sizes.table.filter(target_mm=sizes.recommended.target_mm).sort("outlet")
    nearest = min(rows["volume_m3"], key=lambda volume: abs(volume - own))
    tables = [
        _tabulate(sizes, f"Outlets, cistern {each:g} m³", "outlet", rows.filter(volume_m3=each))
        for each in dict.fromkeys([nearest, sizes.recommended.volume_m3])
    ]
    wet = dict(rows.filter(volume_m3=nearest)["outlet", "wet_discharge_m3"].iter_rows())
    alike = {plans.NONE, PLAN} <= wet.keys() and wet[PLAN] > 0.99 * wet[plans.NONE]
    return tables * (len(wet) > 1), alike * [
        f"With {nearest:g} m³, plan equals none: without a forecast, it keeps 20 days of demand, "
        "more than the cistern holds. With one (greenroof simulate --outlet plan), it makes room."
    ]


def tabulate_volumes(sizes: Sizes) -> list[Table]:
    """Return a table of the cisterns for each outlet, beginning with the recommended outlet."""
    own, table = sizes.recommended, sizes.table.filter(target_mm=sizes.recommended.target_mm)
    outlets = sorted({*table["outlet"]}, key=lambda outlet: (outlet != own.outlet, outlet))
    return [
        _tabulate(
            sizes, f"Cisterns, {own._replace(outlet=outlet).described_outlet}, target "
            f"{own.target_mm:g} mm", "volume_m3", table.filter(outlet=outlet).sort("volume_m3"),
        ) for outlet in outlets
    ]


def _tabulate(
    sizes: Sizes, caption: str, varied: str, table: polars.DataFrame,
    names: Sequence[str] = plans.MAIN,
) -> Table:
    """Return the table of designs that differ in a column of :data:`_VARIED`."""
    shown = {name: SHOWN[name] for name in names}
    rows = table.to_dicts()
    own = getattr(sizes.recommended, varied)
    return Table(
        caption, [_VARIED[varied], *shown.values()],
        [[f"{row[varied]}".removesuffix(".0"), *(write_range(row, *each) for each in shown.items())]
         for row in rows],
        frozenset(place for place, row in enumerate(rows) if row[varied] == own),
    )


def _tabulate_assumptions(sizes: Sizes) -> Table:
    """Return the table of the recommended design at both ends of every assumption."""
    shown = {name: SHOWN[name] for name in _RESTS_ON}
    return Table(
        "The recommended design with each assumption at the ends of its range, one at a time",
        ["assumption", "value", *shown.values(), "best cistern (m³)"],
        [
            [row["assumption"], row["value"], *(write_range(row, *each) for each in shown.items()),
             f"{row['best_cistern_m3']:g}"]
            for row in find_ranges(sizes.tested, plans.BY_TEST).to_dicts()
        ],
        frozenset({0}),
    )


def _select_references(sizes: Sizes) -> polars.DataFrame:
    """Return the results of each season with the recommended design, and what it is compared with.

    The column ``case`` names them.
    """
    own, rows = sizes.recommended, sizes.references
    case = polars.lit(f"{own.volume_m3:g} m³, {own.described_outlet}").alias("case")
    used = sizes.table_of_seasons.filter(**own._asdict()).with_columns(case)
    named = used.select(rows.columns)
    return polars.concat([rows, named], how="vertical_relaxed")


def _tabulate_references(sizes: Sizes) -> Table:
    """Return the table of the recommended design and of what it is compared with."""
    shown = {name: SHOWN[name] for name in _COMPARED}
    return Table("A season", ["", *shown.values()], [
        [row["case"], *(write_range(row, *each) for each in shown.items())]
        for row in find_ranges(_select_references(sizes), ["case"]).to_dicts()
    ])


def _tabulate_peaks(sizes: Sizes) -> Table:
    """Return the table of the seasons' highest peaks by return period."""
    return tabulate_peaks(f"The seasons' highest discharge over {_PEAK_MIN} min", {
        str(case): rows[PEAKS[_PEAK_MIN]]
        for (case,), rows in _select_references(sizes).group_by("case", maintain_order=True)
    })


# --- figures --------------------------------------------------------------------------------------

_DRAWN = ("mains_m3", "wet_discharge_m3", "discharge_m3", "demand_met_share")


def _draw_volumes(sizes: Sizes) -> Figure:
    """Return the figure of the results against the volume, with a line for each outlet."""
    table = sizes.table.filter(target_mm=sizes.recommended.target_mm)
    return _draw("cisterns", "Cisterns and outlets", "volume_m3", table, _DRAWN, "log")


def _draw_targets(sizes: Sizes) -> Figure:
    """Return the figure of the water that a target takes, and of what plants lose."""
    table = _select_targets(sizes)
    title = f"Targets, with a cistern of {table['volume_m3'][0]:g} m³"
    return _draw("targets", title, "target_mm", table, ("mains_m3", LOST), "linear")


def _draw(
    name: str, title: str, varied: str, table: polars.DataFrame, names: Sequence[str], scale: Any
) -> Figure:
    """Return a figure with a panel for each result."""
    x = alt.X(
        f"{varied}:Q", title=_VARIED[varied],
        axis=alt.Axis(values=sorted({*table[varied]}), format="~g", labelOverlap=True),
        scale=alt.Scale(type=scale, nice=False, zero=False),
    )
    series = distinguish_series("outlet", list(dict.fromkeys(table["outlet"])))
    base, panels = alt.Chart(alt.NamedData(name)).encode(x=x, **series), []
    for each in names:
        form = "%" if SHOWN[each].unit == "%" else ""
        panels.append(Panel(draw_band(base, each, form=form), SHOWN[each].heading, 200))
    drawn = table.select(varied, "outlet", *(
        f"{each}{end}" for each in names for end in ("", "_min", "_max")
    ))
    return Figure(
        name, title, "Lines are means of the seasons; bands extend from the lowest to the highest "
        "season.", tuple(panels), 2, {name: drawn.to_dicts()},
    )
