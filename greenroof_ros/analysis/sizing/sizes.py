"""The result of sizing: its table, its sentence, its chart and its page."""

from __future__ import annotations

import csv
import io
import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.sizing.choice import MAX_STRESS, Prices, find_knee, find_target
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
from greenroof_ros.common.errors import require_extra
from greenroof_ros.common.files import add_path_to_errors
from greenroof_ros.common.processes import refuse_forked_polars
from greenroof_ros.common.text import number_of
from greenroof_ros.controllers.outlet import PLAN
from greenroof_ros.experiment.run_directory import writable
from greenroof_ros.model.metrics import METRICS
from greenroof_ros.model.site import Site

if TYPE_CHECKING:
    import altair
    import polars

Values = NDArray[np.float64]

PAGE, TABLE = "sizes.html", "sizes.csv"

_DESIGN = ("volume_m3", "target_mm", "outlet")


@dataclass(frozen=True, eq=False, repr=False)
class Sizes:
    """Cisterns, targets and outlets compared over the seasons of a record.

    Attributes:
        site: of all designs.
        designs: by outlet, target and volume.
        seasons: their names.
        window: the days of a season, for people.
        hours: length of a season.
        values: each metric of each design in each season, shape (designs, seasons), by name.
        incomplete: seasons that the record has only in part, and what they lack.
        notes: what was assumed, and what a reader must know of the weather.
        prices: of water and cistern; None without costs.
        knee_m3: m3 of water that another m3 of cistern must save in a season.
        tried: the designs that were also run from other initial states: every second cistern, of
            one target and the recommended outlet.
        starts: means of each metric of these, from an empty and from a full cistern, shape (2,
            designs), by name.
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
        """Return how many designs and seasons there are."""
        designs, seasons = len(self.designs), len(self.seasons)
        return f"<Sizes: {number_of(designs, 'design')}, {number_of(seasons, 'season')}>"

    @property
    def volumes(self) -> list[float]:
        """The volumes of the cistern (m3), rising."""
        return sorted({design.volume for design in self.designs})

    @property
    def targets(self) -> list[float]:
        """The targets (mm), rising."""
        return sorted({design.target for design in self.designs})

    @property
    def outlets(self) -> list[str]:
        """The outlets."""
        return list(dict.fromkeys(design.outlet for design in self.designs))

    @property
    def columns(self) -> dict[str, Column]:
        """The results that are printed and drawn; costs only with prices."""
        return {name: column for name, column in COLUMNS.items() if name in self.values}

    def spread(self, name: str, design: Design) -> Spread:
        """Return the mean, the lowest and the highest of a column over the seasons."""
        values = self.values[name][self.designs.index(design)]
        known = values[~np.isnan(values)]
        if not known.size:
            return Spread(np.nan, np.nan, np.nan)
        return Spread(float(known.mean()), float(known.min()), float(known.max()))

    def select(self, target: float, outlet: str) -> list[Design]:
        """Return the designs of a target (mm) and an outlet, by volume."""
        return [
            design for design in self.designs
            if (design.target, design.outlet) == (target, outlet)
        ]

    # --- what is recommended ----------------------------------------------------------------------

    def find_knee(self, target: float, outlet: str) -> Design | None:
        """Return the smallest cistern beyond which another m3 brings less than it must.

        See :mod:`greenroof_ros.analysis.sizing.choice`.

        Returns:
            None if the largest cistern is not yet beyond it.
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
        """The recommended outlet."""
        return choose_outlet(self.site, self.outlets)

    @cached_property
    def recommended(self) -> Design:
        """The recommended design: lowest target without stress, the site's outlet, the knee."""
        target = find_target(self.targets, np.array(list(map(self._stress, self.targets))))
        return self.find_knee(target, self.outlet) or self.select(target, self.outlet)[-1]

    @property
    def by_interest(self) -> list[float]:
        """The targets (mm), the recommended one first."""
        own = self.recommended.target
        return [own, *(target for target in self.targets if target != own)]

    @cached_property
    def sentence(self) -> str:
        """The result in a sentence: the recommended cistern, and the next larger one."""
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
        """Return what a design does, in a clause."""
        met, kept = (self.spread(name, design) for name in ("demand_met_share", KEPT))
        return f"A cistern of {design.volume:g} m³ " + " and ".join((
            "has nothing to irrigate" if np.isnan(met.mean)
            else f"meets {_share(met)} of the demand",
            "gets no rain" if np.isnan(kept.mean)
            else f"keeps {_share(kept)} of the storm water out of the sewer",
        ))

    def _stress(self, target: float) -> float:
        """Return the share of a season's hours in which plants lack water (1), at a target (mm)."""
        designs = self.select(target, self.outlet)
        hours = [self.spread("stress_hours", design).mean for design in designs]
        return float(np.mean(hours)) / self.hours

    def describe_target(self) -> str:
        """Return why the recommended target is recommended, in a sentence."""
        stress, most = self._stress(self.recommended.target), f"{MAX_STRESS:.0%}".replace("%", " %")
        if stress > MAX_STRESS:
            least = "" if len(self.targets) == 1 else ", and least at this target"
            return f"plants lack water in more than {most} of the hours of a season{least}."
        if len(self.targets) == 1:
            return f"plants lack water in at most {most} of the hours of a season."
        return (
            f"the lowest of {len(self.targets)} at which plants lack water in at most {most} of "
            "the hours of a season."
        )

    def describe_outlet(self) -> str:
        """Return why the recommended outlet is recommended, in a sentence."""
        if self.outlet == PLAN and self.site.low_outlet_valve:
            return "the site file has a valve on the low outlet."
        if self.outlet == NONE and not self.site.low_outlet_valve:
            return "the site file has no valve."
        return "the first of those that were compared."

    def describe_knee(self) -> str:
        """Return why the recommended cistern is recommended, in a sentence."""
        amount = f"another m³ of cistern saves less than {self.knee_m3:g} m³ of water in a season"
        what = "mains water and storm water in the sewer together"
        if self.prices is not None:
            amount = "another m³ of cistern saves less than it costs"
            what = (
                "mains water and storm water in the sewer, against "
                f"{self.prices.yearly_cistern_price:.4g} a year"
            )
        if len(self.volumes) == 1:
            return "the only one that was compared."
        if self.find_knee(self.recommended.target, self.outlet) is None:
            return (
                f"the largest of all: there is no size from which on {amount} ({what}), so larger "
                "ones are worth a try."
            )
        if self.recommended.volume == self.volumes[0]:
            return (
                f"the smallest of all; from this size on {amount} ({what}), so smaller ones are "
                "worth a try."
            )
        return f"from this size on {amount} ({what})."

    def format_knee(self, target: float, outlet: str) -> str:
        """Return the knee as text; the smallest and the largest cistern are only limits of it."""
        knee = self.find_knee(target, outlet)
        if knee is None:
            return f"above {self.volumes[-1]:g} m³"
        is_limit = knee.volume == self.volumes[0] and len(self.volumes) > 1
        return "at most " * is_limit + f"{knee.volume:g} m³"

    def describe_starts(self) -> str:
        """Return how much the initial state of a season matters, in a sentence."""
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
            f"Each season begins with half of the cistern full. With {design.volume:g} m³ and a "
            f"target of {design.target:g} mm this gives {half_text}"
            f"{' on average' * (len(self.seasons) > 1)}; from an empty cistern {empty_text}, and "
            f"from a full one {full_text}."
        )

    # --- tables and files -------------------------------------------------------------------------

    @property
    def _names(self) -> list[str]:
        """The names of all results: the metrics, and those beside them."""
        order = [*(metric.name for metric in METRICS), KEPT, COST]
        return [name for name in order if name in self.values]

    @property
    def table(self) -> polars.DataFrame:
        """The results, a row for each design: means over the seasons, with lowest and highest.

        The columns have the names of ``summary.json``; ``_min`` and ``_max`` are added for the
        lowest and the highest season. ``storm_water_kept_share`` is the share of the rain on roof
        and catchment that did not reach the sewer in wet weather, and ``cost``, with prices, is
        that of a season's water and a year's cistern.

        Raises:
            ConfigurationError: polars is not installed.
        """
        return _frame([
            {
                **_name(design),
                **{
                    f"{name}{end}": value for name in self._names
                    for end, value in zip(ENDS, self.spread(name, design), strict=True)
                },
            } for design in self.designs
        ])

    @property
    def table_of_seasons(self) -> polars.DataFrame:
        """The results of each season, a row for each design and season; see :attr:`table`.

        Raises:
            ConfigurationError: polars is not installed.
        """
        return _frame(self._rows())

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
        """Return a chart of the results over the volume of the cistern, with a line per outlet.

        A line is the mean of the seasons; its band reaches from the lowest to the highest.

        Args:
            target: mm, one of :attr:`targets`; by default the recommended one.

        Raises:
            ConfigurationError: altair is not installed.
        """
        with require_extra("study"):
            from greenroof_ros.analysis.sizing.page import draw
        chart: altair.ConcatChart = draw(self, target or self.recommended.target).chart()
        return chart

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the page ``sizes.html``, the table ``sizes.csv``, and the figures; return the page.

        Args:
            directory: is made if there is none; earlier files of the same names are replaced.

        Raises:
            ConfigurationError: it cannot be written, or the packages of a page are not installed.
        """
        with require_extra("study"):
            from greenroof_ros.analysis.sizing.page import draw, render
        made = Path(directory)
        with writable(made):
            made.mkdir(parents=True, exist_ok=True)
            (made / TABLE).write_text(self.to_csv(), encoding="utf-8")
        figures = [draw(self, target) for target in self.by_interest]
        for figure in figures:
            figure.save(made)
        page = made / PAGE
        with add_path_to_errors(page):
            page.write_text(render(self, figures), encoding="utf-8")
        return page

    def to_csv(self) -> str:
        """Return the results of each design in each season, with what was assumed as comments."""
        text = io.StringIO()
        for note in self.list_remarks():
            text.write(f"# {note}\n")
        rows = self._rows()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {name: "" if value != value else value for name, value in row.items()} for row in rows
        )
        return text.getvalue()

    def list_remarks(self) -> list[str]:
        """Return :attr:`notes`, and which seasons were left out.

        Each begins with a capital letter, unless it begins with the name of a file.
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


def _frame(rows: Sequence[Mapping[str, Any]]) -> polars.DataFrame:
    refuse_forked_polars()
    with require_extra("study"):
        import polars
    return polars.DataFrame(rows)
