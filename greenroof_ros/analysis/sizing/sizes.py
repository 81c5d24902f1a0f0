"""The result of a sizing, with its table, sentence, charts and page."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from greenroof_ros.analysis.sizing.choice import MAX_STRESS, Prices, Values, find_knee, find_target
from greenroof_ros.analysis.sizing.columns import (
    COLUMNS,
    COST,
    ENDS,
    KEPT,
    Column,
    Spread,
    format_share,
)
from greenroof_ros.analysis.sizing.designs import NONE, Design, choose_outlet
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.text import number_of
from greenroof_ros.controllers.outlet import PLAN
from greenroof_ros.results.forked_polars import make_frame
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import format_csv
from greenroof_ros.site.site import Site

if TYPE_CHECKING:
    import altair
    import polars

    from greenroof_ros.analysis.figures import Figure

PAGE, TABLE = "sizes.html", "sizes.csv"
_FIGURE = re.compile(r"sizes-[\d.]+mm\.(svg|png)")

_DESIGN = ("volume_m3", "target_mm", "outlet")


@dataclass(frozen=True, eq=False, repr=False)
class Sizes:
    """Cisterns, targets and outlets, compared over the seasons of a record.

    Attributes:
        site: the site that all designs share.
        designs: the designs, by outlet, target and volume.
        seasons: names of the seasons.
        window: the days of a season, in words.
        hours: length of a season (h).
        values: every metric of each design in each season, by name, shape (designs, seasons).
        incomplete: for each season that the record covers only in part, by name, the reason why it
            is incomplete.
        notes: assumptions, and notes about the weather for the reader.
        prices: prices of water and cistern; None if no costs are calculated.
        knee_m3: minimum volume of water that each additional m3 of cistern must save per season
            (m3).
        tried: designs that were also run from other initial states: every second cistern, with
            one target and the recommended outlet.
        starts: means of every metric of the designs in ``tried``, for seasons that begin with an
            empty and with a full cistern, by name, shape (2, designs).
    """

    site: Site
    designs: Sequence[Design]
    seasons: Sequence[str]
    window: str
    hours: float
    values: Mapping[str, Values]
    incomplete: Mapping[str, str]
    notes: Sequence[str]
    prices: Prices | None
    knee_m3: float
    tried: Sequence[Design]
    starts: Mapping[str, Values]

    def __repr__(self) -> str:
        """Return the number of designs and seasons as text."""
        designs, seasons = len(self.designs), len(self.seasons)
        return f"<Sizes: {number_of(designs, 'design')}, {number_of(seasons, 'season')}>"

    @property
    def volumes(self) -> list[float]:
        """Volumes of the cistern (m3), in ascending order."""
        return sorted({design.volume for design in self.designs})

    @property
    def targets(self) -> list[float]:
        """Targets (mm), in ascending order."""
        return sorted({design.target for design in self.designs})

    @property
    def outlets(self) -> list[str]:
        """Names of the outlets."""
        return list(dict.fromkeys(design.outlet for design in self.designs))

    @property
    def columns(self) -> dict[str, Column]:
        """Results that are printed and drawn; costs are included only if prices are given."""
        return {name: column for name, column in COLUMNS.items() if name in self.values}

    def spread(self, name: str, design: Design) -> Spread:
        """Return the mean, the lowest and the highest value of a column over the seasons."""
        values = self.values[name][self.designs.index(design)]
        known = values[~np.isnan(values)]
        if not known.size:
            return Spread(np.nan, np.nan, np.nan)
        return Spread(float(known.mean()), float(known.min()), float(known.max()))

    def select(self, target: float, outlet: str) -> list[Design]:
        """Return the designs with a target (mm) and an outlet, by volume."""
        return [
            design for design in self.designs
            if (design.target, design.outlet) == (target, outlet)
        ]

    # --- what is recommended ----------------------------------------------------------------------

    def find_knee(self, target: float, outlet: str) -> Design | None:
        """Return the smallest cistern beyond which each additional m3 saves less than the minimum.

        See :mod:`greenroof_ros.analysis.sizing.choice`.

        Args:
            target: one of :attr:`targets` (mm).
            outlet: one of :attr:`outlets`.

        Returns:
            The design, or None if even an additional m3 beyond the largest cistern would save at
            least the minimum.
        """
        designs = self.select(target, outlet)
        means = [
            [self.spread(name, design).mean for design in designs]
            for name in ("mains_m3", "wet_discharge_m3")
        ]
        mains, wet = np.array(means)
        saved, amount = -(mains + wet), self.knee_m3
        if self.prices is not None:
            saved = -self.prices.cost_water(mains, wet)
            amount = self.prices.yearly_cistern_price
        place = find_knee([design.volume for design in designs], saved, amount)
        return None if place is None else designs[place]

    @property
    def outlet(self) -> str:
        """Name of the recommended outlet."""
        return choose_outlet(self.site, self.outlets)

    @cached_property
    def recommended(self) -> Design:
        """The recommended design: lowest target without stress, the site's outlet, and the knee."""
        target = find_target(self.targets, np.array(list(map(self._stress, self.targets))))
        return self.find_knee(target, self.outlet) or self.select(target, self.outlet)[-1]

    @property
    def by_interest(self) -> list[float]:
        """Targets (mm), beginning with the recommended target."""
        own = self.recommended.target
        return [own, *(target for target in self.targets if target != own)]

    @cached_property
    def sentence(self) -> str:
        """The result in one sentence: the recommended cistern, and the next larger cistern."""
        own = self.recommended
        group = self.select(own.target, own.outlet)
        text = self.describe(own)
        for larger in group[group.index(own) + 1 :][:1]:
            shares = (self.spread(name, larger).mean for name in ("demand_met_share", KEPT))
            text += f"; {larger.volume:g} m³: " + " and ".join(
                f"{format_share(share)} %" for share in shares if not np.isnan(share)
            )
        return f"{text}."

    def describe(self, design: Design) -> str:
        """Return a clause that states the benefits of a design."""
        met, kept = (self.spread(name, design) for name in ("demand_met_share", KEPT))
        return f"A cistern of {design.volume:g} m³ " + " and ".join((
            "has nothing to irrigate" if np.isnan(met.mean)
            else f"meets {_share(met)} of the demand",
            "receives no rain" if np.isnan(kept.mean)
            else f"keeps {_share(kept)} of the storm water out of the sewer",
        ))

    def _stress(self, target: float) -> float:
        """Return the share of a season's hours in which plants lack water at a target (mm)."""
        designs = self.select(target, self.outlet)
        hours = [self.spread("stress_hours", design).mean for design in designs]
        return float(np.mean(hours)) / self.hours

    def describe_target(self) -> str:
        """Return a sentence with the reason why this target is recommended."""
        stress, most = self._stress(self.recommended.target), f"{MAX_STRESS:.0%}".replace("%", " %")
        if stress > MAX_STRESS:
            least = "" if len(self.targets) == 1 else ", and at this target in the fewest hours"
            return f"plants lack water in more than {most} of the hours of a season{least}."
        if len(self.targets) == 1:
            return f"plants lack water in at most {most} of the hours of a season."
        return (
            f"this is the lowest of {len(self.targets)} targets at which plants lack water in at "
            f"most {most} of the hours of a season."
        )

    def describe_outlet(self) -> str:
        """Return a sentence with the reason why this outlet is recommended."""
        if self.outlet == PLAN and self.site.low_outlet_valve:
            return "the site file has a valve on the low outlet."
        if self.outlet == NONE and not self.site.low_outlet_valve:
            return "the site file has no valve."
        return "this is the first outlet of those compared."

    def describe_knee(self) -> str:
        """Return a sentence with the reason why this cistern is recommended."""
        amount = f"another m³ of cistern saves less than {self.knee_m3:g} m³ of water in a season"
        what = "mains water and storm water in the sewer together"
        if self.prices is not None:
            amount = "another m³ of cistern saves less than it costs"
            what = (
                "mains water and storm water in the sewer, against "
                f"{self.prices.yearly_cistern_price:.4g} a year"
            )
        if len(self.volumes) == 1:
            return "this is the only size compared."
        if self.find_knee(self.recommended.target, self.outlet) is None:
            return (
                f"this is the largest size compared. There is no size beyond which {amount} "
                f"({what}), so larger sizes are worth trying."
            )
        if self.recommended.volume == self.volumes[0]:
            return (
                f"this is the smallest size compared. Beyond it, {amount} ({what}), so smaller "
                "sizes are worth trying."
            )
        return f"beyond this size, {amount} ({what})."

    def format_knee(self, target: float, outlet: str) -> str:
        """Return the knee as text; for the smallest and the largest cistern, it is only a limit."""
        knee = self.find_knee(target, outlet)
        if knee is None:
            return f"above {self.volumes[-1]:g} m³"
        is_limit = knee.volume == self.volumes[0] and len(self.volumes) > 1
        return "at most " * is_limit + f"{knee.volume:g} m³"

    def describe_starts(self) -> str:
        """Return sentences about the effect of the initial state of a season."""
        ratios = [abs(np.log(one.volume / self.recommended.volume)) for one in self.tried]
        place = int(np.argmin(ratios))  # the recommended cistern, or one next to it
        design = self.tried[place]
        names = "demand_met_share", "mains_m3", "wet_discharge_m3"
        half = [self.spread(name, design).mean for name in names]
        empty, full = ([self.starts[name][end, place] for name in names] for end in (0, 1))
        empty_text, half_text, full_text = (
            ("" if np.isnan(met) else f"{format_share(met)} % of the demand, ")
            + f"{mains:.1f} m³ of mains water and {wet:.1f} m³ of discharge in wet weather"
            for met, mains, wet in (empty, half, full)
        )
        return (
            f"Every season begins with the cistern half full. With {design.volume:g} m³ and a "
            f"target of {design.target:g} mm, the result is {half_text}"
            f"{' on average' * (len(self.seasons) > 1)}. If the cistern is empty at the beginning, "
            f"the result is {empty_text}, and if the cistern is full, {full_text}."
        )

    # --- tables and files -------------------------------------------------------------------------

    @property
    def _names(self) -> list[str]:
        """Names of all results, which are the metrics and additional results."""
        order = [*(metric.name for metric in METRICS), KEPT, COST]
        return [name for name in order if name in self.values]

    @property
    def table(self) -> polars.DataFrame:
        """Results, with one row per design: the mean, lowest and highest value over the seasons.

        The columns are named as in ``summary.json``, with ``_min`` and ``_max`` added for the
        lowest and the highest season. ``storm_water_kept_share`` is the share of the rain on roof
        and catchment that did not reach the sewer in wet weather. If prices are given, ``cost`` is
        the cost of one season's water plus the annual cost of the cistern.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        return make_frame([self._row(design) for design in self.designs])

    def _row(self, design: Design) -> dict[str, Any]:
        return {
            **_name(design),
            **{
                f"{name}{end}": value for name in self._names
                for end, value in zip(ENDS, self.spread(name, design), strict=True)
            },
        }

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
                **{name: float(self.values[name][row, column]) for name in self._names},
            }
            for (row, design), (column, season) in itertools.product(
                enumerate(self.designs), enumerate(self.seasons)
            )
        ]

    def plot(self, target: float | None = None) -> altair.ConcatChart:
        """Return a chart of the results against the cistern's volume, with a line per outlet.

        A line shows the mean of the seasons, and its band extends from the lowest to the highest
        season.

        Args:
            target: one of :attr:`targets` (mm); by default the recommended target.

        Raises:
            ConfigurationError: if altair is not installed.
        """
        chart: altair.ConcatChart = self._draw(target or self.recommended.target).chart()
        return chart

    def _draw(self, target: float) -> Figure:
        with require_extra("study"):
            from greenroof_ros.analysis.sizing.page import draw
        rows = [self._row(design) for design in self.designs if design.target == target]
        return draw(rows, self.columns, target, self.seasons)

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the page ``sizes.html``, the table ``sizes.csv``, and the figures; return the page.

        Args:
            directory: output directory, which is created if it does not exist. Files of an earlier
                result are replaced, and figures of targets that are no longer compared are removed.

        Raises:
            ConfigurationError: if the packages that a page needs are not installed.
            OSError: if the directory cannot be written to.
        """
        with require_extra("study"):
            from greenroof_ros.analysis.sizing.page import render
        made = Path(directory)
        with add_path_to_errors(made):
            made.mkdir(parents=True, exist_ok=True)
            for file in made.iterdir():
                if _FIGURE.fullmatch(file.name):
                    file.unlink()
            (made / TABLE).write_text(self.to_csv(), encoding="utf-8")
        figures = [self._draw(target) for target in self.by_interest]
        for figure in figures:
            figure.save(made)
        page = made / PAGE
        with add_path_to_errors(page):
            page.write_text(render(figures, self, self.columns), encoding="utf-8")
        return page

    def to_csv(self) -> str:
        """Return all results of all seasons as CSV, with the assumptions as comments."""
        rows = self._rows()
        return "".join(f"# {note}\n" for note in self.list_remarks()) + format_csv(rows[0], (
            {name: "" if value != value else value for name, value in row.items()} for row in rows
        ))

    def list_remarks(self) -> list[str]:
        """Return :attr:`notes`, and a remark about every season that was left out.

        Every remark begins with a capital letter, unless it begins with the name of a file.
        """
        left_out = (f"season {name} is left out: {why}" for name, why in self.incomplete.items())
        return [
            f"{note[0].upper()}{note[1:]}" if note.partition(" ")[0].isalpha() else note
            for note in (*self.notes, *left_out)
        ]


def _name(design: Design) -> dict[str, Any]:
    return dict(zip(_DESIGN, (design.volume, design.target, design.outlet), strict=True))


def _share(spread: Spread) -> str:
    if spread.low == spread.high and spread.low in (0, 1):
        return "all" if spread.low else "none"
    mean, low, high = map(format_share, spread)
    return f"{mean} %" if low == high else f"{mean} % ({low} to {high})"

