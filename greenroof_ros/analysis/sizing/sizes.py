"""The results of a sizing: a recommendation, tables, a chart and a page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from greenroof_ros.analysis.seasons import find_ranges
from greenroof_ros.analysis.sizing.designs import BY_DESIGN, KEPT, NONE, PAGE, SHOWN, TABLE, Design
from greenroof_ros.analysis.tables import write_range
from greenroof_ros.base.errors import require_extra
from greenroof_ros.site.site import Site

if TYPE_CHECKING:
    import altair
    import polars


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
        return find_ranges(self.table_of_seasons, BY_DESIGN)

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
        kept = "" if row[KEPT] is None else (
            f", {text[KEPT]} % less than the rain on the roofs"
        )
        return (
            f"A cistern of {own.volume_m3:g} m³ ({own.described_outlet}) and a target of "
            f"{own.target_mm:g} mm of water on the roof are recommended. In a season, {watered}"
            f"{text['wet_discharge_m3']} m³ reaches the sewer in wet weather{kept}. In all "
            f"weather, {text['discharge_m3']} m³ reaches the sewer, a retention of "
            f"{text['retention_share']} %.{self._compare()}"
        )

    def _compare(self) -> str:
        """Return what the recommended cistern does without its valve; empty without a valve."""
        own = self.recommended._replace(outlet=NONE)
        plain = self.table.filter(**own._asdict()).to_dicts()
        if not plain or own == self.recommended:
            return ""
        mains, wet = (
            write_range(plain[0], name, SHOWN[name]) for name in ("mains_m3", "wet_discharge_m3")
        )
        return f" Without the valve, {mains} m³ would be mains water, and {wet} m³ wet discharge."

    def plot(self) -> altair.ConcatChart:
        """Return a chart of the results against the cistern's volume, with a line per outlet.

        A line shows the mean of the seasons, and its band extends from the lowest to the highest
        season.

        Raises:
            ConfigurationError: if altair is not installed.
        """
        with require_extra("study"):
            from greenroof_ros.analysis.sizing.page import draw_volumes
        chart: altair.ConcatChart = draw_volumes(self).chart()
        return chart

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the page ``sizes.html``, the table ``sizes.csv``, and the figures; return the page.

        Args:
            directory: output directory, which is created if it does not exist, and may contain an
                earlier result, which is replaced.

        Raises:
            ConfigurationError: if the packages that a page needs are not installed, or if the
                directory contains anything else.
            OSError: if the directory cannot be written to.
        """
        with require_extra("study"):
            from greenroof_ros.analysis.page import claim_output
            from greenroof_ros.analysis.sizing.page import write_page
        claim_output(Path(directory), PAGE, [TABLE])
        return write_page(self, Path(directory))
