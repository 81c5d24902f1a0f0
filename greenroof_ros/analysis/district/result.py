"""The run of a district: every draw of the buildings in every season; and its results."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from greenroof_ros.analysis.assumptions import list_ends
from greenroof_ros.analysis.district import file as keys
from greenroof_ros.analysis.district import page as shown
from greenroof_ros.analysis.district import swmm as routing
from greenroof_ros.analysis.district.buildings import (
    Flow,
    Scene,
    list_buildings,
    list_flows,
    make_buildings,
    make_sites,
)
from greenroof_ros.analysis.page import Section, claim_output, make_page, write_output
from greenroof_ros.analysis.seasons import find_seasons, list_notes, read_window
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.text import number_of
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.forecast.choice import PERFECT, ForecastChoice
from greenroof_ros.simulation.inputs import RunInputs, make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.climate import CLIMATE
from greenroof_ros.weather.summary import as_lines, summarize

PAGE, TABLES = "page.html", ("results.csv", "seasons.csv", "buildings.csv")
FILES = (*TABLES, "district.yaml", "swmm")
"""other files of the output than the page and its figures"""
# Number of buildings with which the ends of assumptions are simulated.
_SAMPLE = 10
# Width of the window of the peaks whose return periods are shown (min).
_PEAK_MIN = 15


@dataclass(frozen=True, eq=False)
class DistrictResult:
    """The discharge of many buildings to one sewer.

    Attributes:
        district: contents of the district file.
        site: the site that all buildings have in common.
        all_rows: results of every flow in every draw and season; names include the units.
        buildings: a row for every building of the first draw: when it adopts, and the means of its
            results over the seasons.
        assumptions: results of the best flow of some buildings in every season, as used and at both
            ends of each assumption.
        notes: what was read, and what was missing in it.
    """

    district: keys.District
    site: Site
    all_rows: pl.DataFrame
    buildings: pl.DataFrame
    assumptions: pl.DataFrame
    notes: Sequence[str]

    @property
    def table(self) -> pl.DataFrame:
        """Means of the results, a row for each flow, with their 5th and 95th percentiles."""
        values = pl.exclude("draw", "season", "outlet", "adoption")
        return self.all_rows.group_by("outlet", "adoption", maintain_order=True).agg(
            values.mean(), *(
                values.quantile(share, "linear").name.suffix(end)
                for share, end in zip((0.05, 0.95), shown.ENDS, strict=True)
            ),
        )

    @property
    def best(self) -> dict[str, Any]:
        """The row of :attr:`table` with the least discharge in wet weather."""
        return self.table.sort("wet_discharge_m3", maintain_order=True).row(0, named=True)

    @property
    def sentence(self) -> str:
        """The effect of the best outlet, and for what the numbers stand."""
        table, best = self.table, self.best
        if not best["adoption"]:
            return "No green roofs and cisterns of this district reduce the water in the sewer."
        text = (
            f"With green roofs and cisterns on {best['buildings']:,.0f} of "
            f"{len(self.buildings):,} buildings ({shown.label(best)}), "
            f"{shown.say(best, shown.LESS)} less water reaches the sewer in wet weather; over all "
            f"weather, they retain {shown.say(best, 'retention_share')} of the rain."
        )
        first = table.row(0, named=True)
        name, how = "sewer_overflow_m3", "unrouted"
        if "routed_overflow_m3" in first:
            name, how = "routed_overflow_m3", "routed, first draw"
        after, before = (shown.say(row, name) for row in (best, first))
        text += f" The sewer overflows with {after} a season instead of {before} ({how})."
        seasons, draws = self.all_rows["season"].unique(maintain_order=True), self.district.draws
        days = read_window(self.district.weather.season, self.site)
        when = f"{days}, {' to '.join(dict.fromkeys((seasons[0], seasons[-1])))}"
        return (
            f"{text} Numbers are means of {number_of(len(seasons), 'season')} ({when}) with "
            f"{number_of(draws, 'draw')} of the buildings each; in brackets, the 5th to the 95th "
            "percentile of these."
        )

    @property
    def warnings(self) -> list[str]:
        """A warning if the flow from all valves exceeds the sewer's capacity in dry weather."""
        name = "dry_sewer_overflow_m3"
        return [
            f"in dry weather, {shown.say(row, name)} a season flow beyond the sewer's capacity "
            f"({shown.label(row)}, {row['buildings']:,.0f} buildings), because the cisterns empty "
            "at the same time; choose a smaller low_outlet_radius"
            for row in self.table.sort(name)[-1:].iter_rows(named=True) if row[name]
        ]

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write page, figures and tables to a directory, and return the page's path.

        Raises:
            ConfigurationError: if the directory contains anything but an earlier output.
            OSError: if writing fails, for instance because the disk is full.
        """
        directory, district, table = Path(directory), self.district, self.table
        count = number_of(len(self.buildings), "building")
        area = float(self.buildings["connected_area_m2"].sum()) / 1e4
        figures = [shown.draw_adoption(table)]
        claim_output(directory, PAGE, FILES)
        shutil.copyfile(district.path, directory / "district.yaml")
        title = f"Green roofs in a district of {count}: {district.path.stem}"
        html = make_page(title, self.sentence, [
            Section("The results", [
                f"{count} have a connected area of {area:.3g} ha in the first draw. "
                "A season begins with cisterns half full and roofs at their targets. The buildings "
                "are compared with the same buildings as they are, from whose roofs all rain runs "
                f"off at once. Wet weather is the time of rain and the {self.site.wet_after:g} h "
                "after it. What valves release in dry weather reaches the same sewer: it counts in "
                "the discharge and in the retention.",
                shown.tabulate(table, shown.VOLUMES, "Volumes in a season"),
                *([
                    shown.tabulate(table, shown.ROUTED, "Routed by SWMM, first draw")
                ] if {*shown.ROUTED} <= {*table.columns} else []),
                shown.tabulate(table, shown.UNROUTED, "Highest flows of the sum of all buildings"),
                shown.tabulate_peaks(self.all_rows, self.best, _PEAK_MIN),
                *([self.warnings] if self.warnings else []),
            ]),
            Section("Pictures", figures),
            Section("What it rests on", [
                *([] if self.assumptions.is_empty() else [shown.tabulate_assumptions(
                    self.assumptions, shown.label(self.best)
                )]), [
                    "Unrouted flows add up in the minute in which they leave their buildings. In "
                    "pipes they spread out and arrive one after another; SWMM computes this.",
                    "Streets, yards, other buildings and storage in the sewer are left out; SWMM "
                    "adds the sewage of 125 people per ha.",
                    f"The sewer takes {district.sewer_capacity:g} mm/h from the connected area.",
                    "The valve's plan receives " + (
                        "perfect forecasts" if district.forecast == PERFECT
                        else "forecasts as good as services give"
                    ) + ".",
                ],
            ]),
            Section("What was read", [self.notes]),
            Section("How it was made", [
                f"greenroof district {district.path.name}, seeds {district.seed} to "
                f"{district.seed + district.draws - 1}, ticks of {district.tau:g} s.",
            ]),
        ])
        texts = (frame.write_csv() for frame in (table, self.all_rows, self.buildings))
        return write_output(directory, PAGE, html, figures, dict(zip(TABLES, texts, strict=True)))


def district(
    file: str | os.PathLike[str], *, jobs: int = 1, swmm: str | os.PathLike[str] | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> DistrictResult:
    """Simulate the discharge of many buildings into one sewer, like ``greenroof district``.

    Args:
        file: path of the district file.
        jobs: number of threads, which share the buildings.
        swmm: directory for networks that EPA SWMM routes; None without routing.
        progress: function that receives the current task and the completed share of the work; an
            error that it raises ends the work.

    Returns:
        The results: ``.sentence``, ``.table`` (means with 5th and 95th percentiles), ``.all_rows``
        (every draw and season), ``.buildings`` and ``.save(directory)``, which writes the page.

    Raises:
        ConfigurationError: if a file is invalid; the message names the file and states what
            would be right.

    Example:
        >>> import greenroof_ros as gr
        >>> result = gr.district("my_district.yaml", jobs=2)  # doctest: +SKIP
        >>> result.table["outlet", "adoption", "wet_discharge_m3"]  # doctest: +SKIP
    """
    given, notes = keys.read_district(Path(file)), list[str]()
    site = read_site(given.find_files("site", given.site)[0], {"tau": given.tau, "M": 1})
    if site.low_outlet_level is None and {*given.outlets} != {keys.NONE}:
        raise given.refuse("site", "needs a low outlet, as in site_valve.yaml, or outlets: [none]")
    runs = _read_runs(given, site, make_run_inputs(given, site), notes)
    listed, flows = list_buildings(given, notes), list_flows(given)
    drawn = [make_buildings(given, site, listed, draw) for draw in range(given.draws)]
    rows, made = list[dict[str, Any]](), list[pl.DataFrame]()
    for draw, buildings in enumerate(drawn):
        sites = make_sites(given, buildings)
        for season, run in runs.items():
            text, done = f"season {season}, draw {draw + 1} of {given.draws}", len(rows)
            def report(share: float, text: str = text, done: int = done) -> None:
                progress(text, (done / len(flows) + share) / len(runs) / given.draws)

            choice = replace(run.forecast_choice, seed=given.seed + draw)
            scene = Scene(given, buildings, sites, replace(run, forecast_choice=choice), flows,
                          jobs, report)
            own = [scene.add(flow) for flow in flows]
            if draw == 0:
                made.append(scene.list_buildings())
                if swmm is not None:
                    routing.route_scene(Path(swmm) / season.replace("/", "-"), scene, own)
            rows += [{"draw": draw + 1, "season": season} | row for row in own]
    means = pl.concat(made).group_by("id").mean()
    result = DistrictResult(
        given, site, pl.DataFrame(rows, infer_schema_length=None).fill_nan(None),
        drawn[0].drop("line", "group").join(means, on="id", maintain_order="left").fill_nan(None),
        pl.DataFrame(), list(dict.fromkeys(notes)),
    )
    tested = pl.DataFrame([*_test(result, drawn[0], runs, jobs)])
    return replace(result, assumptions=tested)


def make_run_inputs(given: keys.District, site: Site) -> RunInputs:
    """Return the inputs of a run of the district's weather."""
    weather = given.weather
    return make_inputs(find_controller("onoff"), {
        "site": site, "weather": given.find_files("weather.file", weather.file),
        "evapotranspiration": weather.evapotranspiration, "gaps": weather.gaps,
        **{name: getattr(weather, name) for name in CLIMATE},
    })


def _read_runs(
    given: keys.District, site: Site, inputs: RunInputs, notes: list[str]
) -> dict[str, Run]:
    """Return the run of the site in each season; incomplete ones are left out and noted."""
    weather = given.weather
    try:
        records, _ = inputs.read_records(site)
        contents, *others = as_lines(summarize(records, site))
        notes += [f"{records.source}: {contents}", *others]
        runs, gaps = find_seasons(inputs, site, records, read_window(weather.season, site))
        notes += [f"season {each} is left out: {why}" for each, why in gaps.items()]
    except ConfigurationError as error:
        if error.file is not None or not hasattr(weather, error.key or ""):
            raise
        raise given.refuse(f"weather.{error.key}", error.expected, error.value) from None
    notes += list_notes(runs, site)
    notes += [note for run in runs.values() for note in run.forecast.notes]
    choice = ForecastChoice(given.forecast, seed=given.seed)
    return {name: replace(run, forecast_choice=choice) for name, run in runs.items()}


def _test(
    result: DistrictResult, buildings: pl.DataFrame, runs: dict[str, Run], jobs: int
) -> Iterator[dict[str, Any]]:
    """Yield the best flow of some buildings in each season, as used and at ends of assumptions."""
    given, site, best = result.district, result.site, result.best
    buildings = buildings.filter(pl.col("adopts_at").is_not_null())[:_SAMPLE]
    sites, flow = make_sites(given, buildings), Flow(best["outlet"], best["adoption"])
    read_runs = partial(_read_runs, given, notes=[])
    ends = list_ends(site, make_run_inputs(given, site), runs, read_runs)
    for words, change, own in ends if flow.adoption and sites else ():
        for season, run in own.items() if not {*change} & {*buildings.columns} else ():
            run = replace(run, site=replace(run.site, **change))
            changed = [replace(each, **change) for each in sites]
            scene = Scene(given, buildings, changed, run, [flow], jobs)
            yield words | {"season": season} | scene.add(flow)
