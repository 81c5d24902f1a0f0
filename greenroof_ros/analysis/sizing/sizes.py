"""The result of a sizing: all designs with their results, the recommendation, and its files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from greenroof_ros.analysis.assumptions import Assumption
from greenroof_ros.analysis.sizing.choice import Prices
from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.analysis.sizing.results import (
    KEPT,
    PAGE,
    SHOWN,
    TABLE,
    Results,
    find_spread,
)
from greenroof_ros.analysis.tables import Column, format_range
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.text import number_of
from greenroof_ros.results.forked_polars import make_frame
from greenroof_ros.results.table import format_csv
from greenroof_ros.site.site import Site

if TYPE_CHECKING:
    import altair
    import polars

class Tested(NamedTuple):
    """What the recommended design gives if an assumption is at one end of its range."""

    assumption: Assumption
    value: float
    """value of the assumption"""
    results: Results
    """results of the recommended design"""
    best: float
    """the cistern that would be recommended (m3)"""


@dataclass(frozen=True, eq=False, repr=False)
class Sizes:
    """Targets, cisterns and outlets, compared over the seasons of a record.

    Attributes:
        site: the site that all designs share.
        results: results of every design: first of those that compare targets, then of those that
            compare cisterns with the recommended target.
        recommended: the recommended design.
        tested: the recommended design at both ends of each assumption.
        starts: results of the recommended design for seasons that begin with an empty and with a
            full cistern.
        seasons: names of the seasons.
        window: the days of a season, in words.
        notes: assumptions, and remarks on the results.
        read: what the weather contains, what was missing in it, and which seasons are left out.
        prices: prices of water and cistern; None if no costs are calculated.
        knee_m3: minimum volume of water that each additional m3 of cistern must save per season
            (m3).
    """

    site: Site
    results: Mapping[Design, Results]
    recommended: Design
    tested: Sequence[Tested]
    starts: tuple[Results, Results]
    seasons: Sequence[str]
    window: str
    notes: Sequence[str]
    read: Sequence[str]
    prices: Prices | None
    knee_m3: float

    def __repr__(self) -> str:
        """Return the number of designs and seasons as text."""
        designs, seasons = len(self.results), len(self.seasons)
        return f"<Sizes: {number_of(designs, 'design')}, {number_of(seasons, 'season')}>"

    @property
    def columns(self) -> dict[str, Column]:
        """Results that are printed and drawn; costs are included only if prices are given."""
        shown = self.results[self.recommended]
        return {name: column for name, column in SHOWN.items() if name in shown}

    def format(self, name: str, design: Design | None = None) -> str:
        """Return a result of a design, by default the recommended one, with its range, as text."""
        return format_range(
            *find_spread(self.results[design or self.recommended][name]), SHOWN[name]
        )

    def select(self, **same: float | str) -> list[Design]:
        """Return the designs with the given attributes, in ascending order."""
        return sorted(
            design for design in self.results if design._asdict() | same == design._asdict()
        )

    def select_volumes(self) -> dict[str, list[Design]]:
        """Return the designs that compare cisterns by outlet, beginning with the recommended."""
        own, outlets = self.recommended, dict.fromkeys(design.outlet for design in self.results)
        return {
            outlet: self.select(target=own.target, outlet=outlet)
            for outlet in sorted(outlets, key=lambda each: each != own.outlet)
        }

    def select_targets(self) -> list[Design]:
        """Return the designs that compare targets, by target."""
        first = next(iter(self.results))
        return self.select(volume=first.volume, outlet=first.outlet)

    @property
    def sentence(self) -> str:
        """The recommendation, and what it brings in a season."""
        own = self.recommended
        shares = self.results[own]
        watered = "" if np.isnan(shares["demand_met_share"]).all() else (
            f"{self.format('demand_met_share')} % of the irrigation is rain, "
            f"{self.format('mains_m3')} m³ is mains water, and "
        )
        kept = "" if np.isnan(shares[KEPT]).all() else (
            f", {self.format(KEPT)} % less than the rain on the roofs"
        )
        return (
            f"A cistern of {own.volume:g} m³ ({own.described_outlet}) and a target of "
            f"{own.target:g} mm of water on the roof are recommended. In a season, {watered}"
            f"{self.format('wet_discharge_m3')} m³ reaches the sewer in wet weather{kept}. In all "
            f"weather, {self.format('discharge_m3')} m³ reaches the sewer, a retention of "
            f"{self.format('retention_share')} %."
        )

    # --- tables and files -------------------------------------------------------------------------

    @property
    def table(self) -> polars.DataFrame:
        """Results, with one row per design: the mean, lowest and highest value over the seasons.

        The columns are named as in ``summary.json``, with ``_min`` and ``_max`` added for the
        lowest and the highest season, besides those of :data:`KEPT`, :data:`LOST` and :data:`COST`.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        ends = ("", "_min", "_max")
        return make_frame([
            {
                **_name(design),
                **{
                    f"{name}{end}": value for name, values in results.items()
                    for end, value in zip(ends, find_spread(values), strict=True)
                },
            } for design, results in self.results.items()
        ])

    @property
    def table_of_seasons(self) -> polars.DataFrame:
        """Results of every season, with one row per design and season; see :attr:`table`.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        return make_frame(self._rows())

    def _rows(self) -> list[dict[str, Any]]:
        return [
            {
                **_name(design), "season": season,
                **{name: float(values[place]) for name, values in results.items()},
            }
            for design, results in self.results.items()
            for place, season in enumerate(self.seasons)
        ]

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

    def to_csv(self) -> str:
        """Return all results of all seasons as CSV, with the assumptions as comments."""
        rows = self._rows()
        remarks = "".join(f"# {note}\n" for note in (*self.notes, *self.read))
        return remarks + format_csv(rows[0], (
            {name: "" if value != value else value for name, value in row.items()} for row in rows
        ))


def _name(design: Design) -> dict[str, Any]:
    return {"volume_m3": design.volume, "target_mm": design.target, "outlet": design.outlet}
