"""The run of a district, and its results: every draw of the buildings in every season."""

from __future__ import annotations

import io
import itertools
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from greenroof_ros.analysis.assumptions import Assumption, list_ends
from greenroof_ros.analysis.district import swmm
from greenroof_ros.analysis.district.buildings import Buildings, make_buildings, make_sites
from greenroof_ros.analysis.district.file import District, check_outlets, read_district
from greenroof_ros.analysis.district.scene import (
    AS_IS,
    PERCENTILES,
    Scene,
    find_best,
    list_flows,
)
from greenroof_ros.analysis.page import claim_output, write_output
from greenroof_ros.analysis.seasons import find_seasons, list_notes, read_window
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import replace_file
from greenroof_ros.base.text import number_of
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.inputs import RunInputs, make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.summary import as_lines, summarize

PAGE, TABLES = "page.html", ("results.csv", "seasons.csv", "buildings.csv")
FILES = (*TABLES, "hydrographs.parquet", "district.yaml", "swmm")
"""other files of the output than the page and its figures"""
_KEYS = ("draw", "season", "outlet", "adoption")

Seasons = dict[str, list[Run]]
"""run of the site in each cell, by the name of the season"""


# Number of buildings with which the ends of assumptions are simulated.
_SAMPLE = 20


class Tested(NamedTuple):
    """The best flow of some buildings of the first draw at one end of an assumption."""

    assumption: Assumption | None
    """the assumption; None as used"""
    value: float
    rows: pl.DataFrame
    """results, a row for each season"""


@dataclass(frozen=True, eq=False)
class DistrictResult:
    """The discharge of many buildings to one sewer.

    Attributes:
        district: contents of the district file.
        site: the site that all buildings have in common.
        window: the days of a season in words, or the start of a single run.
        all_rows: results of every flow in every draw and season; names include the units.
        storm: the scene of the first draw with the highest flow over an hour.
        storm_run: run of the site in the season of the storm.
        buildings: a row for every building of the first draw: when it adopts, and the means of its
            results over the seasons.
        tested: the best flow as used, and at both ends of each assumption.
        notes: what was read, and what was missing in it.
    """

    district: District
    site: Site
    window: str
    all_rows: pl.DataFrame
    storm: Scene
    storm_run: Run
    buildings: pl.DataFrame
    tested: Sequence[Tested]
    notes: Sequence[str]

    @property
    def table(self) -> pl.DataFrame:
        """Means of the results, a row for each flow, with their 5th and 95th percentiles."""
        names = [name for name in self.all_rows.columns if name not in _KEYS]
        table = self.all_rows.group_by("outlet", "adoption", maintain_order=True).agg(
            each for name in names for each in (
                pl.col(name).mean(), *(
                    pl.col(name).quantile(end / 100, "linear").alias(f"{name}_p{end}")
                    for end in PERCENTILES
                ),
            )
        )
        if "sewer_overflow_m3" in names and (whole := table["sewer_overflow_m3"][0]):
            table = table.with_columns(
                sewer_overflow_reduction=1 - pl.col("sewer_overflow_m3") / whole
            )
        return table

    @property
    def sentence(self) -> str:
        """The main result, and for what its numbers stand."""
        from greenroof_ros.analysis.district.page import summarise  # the page draws results

        return summarise(self)

    @property
    def warnings(self) -> list[str]:
        """A warning if the flow from all valves exceeds the sewer's capacity in dry weather."""
        capacity, table = self.district.sewer_capacity, self.table
        if capacity is None or not (table["dry_sewer_overflow_m3"] > 0).any():
            return []
        worst = table.row(table["dry_peak_5min_mm_h"].arg_max(), named=True)
        return [
            "the cisterns empty at the same time: in dry weather they release up to "
            f"{worst['dry_peak_5min_mm_h']:.3g} mm/h ({worst['outlet']}, "
            f"{number_of(round(worst['buildings']), 'building')}), which exceeds the sewer's "
            f"capacity of {capacity:g} mm/h; choose a smaller low_outlet_radius"
        ]

    @property
    def hydrographs(self) -> pl.DataFrame:
        """Flows (m3/s) in the season of the storm, with the start of every interval."""
        scene, start = self.storm, self.storm_run.start
        seconds = np.cumsum(scene.durations) - scene.durations
        cells = [*(self.district.weather.cells or [""])]
        return pl.DataFrame({
            f"time_utc{start.isoformat()[-6:]}": [
                start.replace(tzinfo=None) + timedelta(seconds=each) for each in seconds.tolist()
            ],
            **{
                f"rain_{cell}_mm_h" if cell else "rain_mm_h": 3.6e6 * rain / scene.durations
                for cell, rain in zip(cells, scene.rain, strict=True)
            },
            "wet": scene.wet,
            **{
                f"{flow.name}_m3_s": scene.group_discharges(flow).sum(axis=0) / scene.durations
                for flow in scene.flows
            },
        })

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write page, figures, tables and hydrographs to a directory, and return the page's path.

        Raises:
            ConfigurationError: if the directory contains anything but an earlier output.
            OSError: if writing fails, for instance because the disk is full.
        """
        from greenroof_ros.analysis.district.page import draw_figures, make

        directory, figures = Path(directory), draw_figures(self)
        claim_output(directory, PAGE, FILES)
        shutil.copyfile(self.district.path, directory / "district.yaml")
        flows = io.BytesIO()  # to a file, polars would not raise an OSError
        self.hydrographs.write_parquet(flows)
        replace_file(
            directory / "hydrographs.parquet", lambda stream: stream.write(flows.getbuffer())
        )
        frames = self.table, self.all_rows, self.buildings
        return write_output(directory, PAGE, make(self, figures), figures, {
            name: frame.write_csv() for name, frame in zip(TABLES, frames, strict=True)
        })


def simulate_district(
    path: Path, search: Sequence[Path] = (), threads: int = 1, with_swmm: Path | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> DistrictResult:
    """Read a district file and all files that it names, and simulate the district.

    Args:
        path: path of the district file.
        search: additional directories to search for weather files.
        threads: number of threads that share the buildings.
        with_swmm: directory for the networks that SWMM routes; None without routing.
        progress: function that receives the current task and the completed share of the work; an
            error that it raises ends the work.

    Raises:
        ConfigurationError: if a file is invalid.
    """
    district = read_district(path)
    site = read_site(district.find_files("site", district.site)[0], district.ticks)
    check_outlets(district, site)
    notes, cells = list[str](), [*(district.weather.cells or ())]
    window, seasons = _read_seasons(district, site, search, notes)
    flows, scenes = list_flows(district), len(seasons) * district.draws
    rows, kept = list[dict[str, Any]](), list[tuple[Scene, Run]]()
    first: tuple[Buildings, list[Site]] | None = None
    for draw in range(district.draws):
        buildings = make_buildings(district, site, cells, draw, notes)
        sites = make_sites(district, buildings)
        first = first or (buildings, sites)
        for number, (season, runs) in enumerate(seasons.items(), draw * len(seasons)):
            text = f"season {season}, draw {draw + 1} of {district.draws}"
            def report(share: float, done: int = number, text: str = text) -> None:
                progress(text, (done + share) / scenes)

            scene = Scene(
                district, buildings, sites,
                [replace(run, forecast_choice=district.choose_forecast(draw)) for run in runs],
                flows, threads, report,
            )
            own = scene.rows()
            if draw == 0:
                kept.append((scene, runs[0]))
            if draw == 0 and with_swmm is not None:
                progress(f"SWMM, season {season}", number / scenes)
                swmm.route_scene(with_swmm / season.replace("/", "-"), scene, runs[0].start, own,
                                 district.sewer_capacity)
            rows += [{"draw": draw + 1, "season": season} | row for row in own]
    assert first is not None
    all_rows = pl.DataFrame(rows, infer_schema_length=None).fill_nan(None)
    best, (buildings, sites) = find_best(all_rows), first
    places = np.flatnonzero(buildings.groups < len(district.shares))[:_SAMPLE].tolist()
    tested = []
    for end in [None, *list_ends(site)] if best.adoption and places else []:
        name = "" if end is None else end.assumption.name
        if name in buildings.values:
            continue
        progress(f"assuming {name}", 1.0)
        change: dict[str, Any] = {} if end is None else {name: end.value}
        ended = seasons
        if end is not None and name == "k_Rs":  # evapotranspiration depends on it
            ended = _read_seasons(district, end.site, search, [])[1]
        tested.append(Tested(
            end and end.assumption, end.value if end else 0.0, pl.DataFrame([
                Scene(
                    district, buildings.take(places),
                    [replace(sites[place], **change) for place in places],
                    [replace(run, site=replace(run.site, **change),
                             forecast_choice=district.choose_forecast(0)) for run in runs],
                    [AS_IS, best], threads,
                ).rows()[1] for runs in ended.values()
            ])
        ))
    storm = max(kept, key=lambda each: each[0].rows()[0]["peak_60min_l_s"])
    return DistrictResult(
        district, site, window, all_rows, *storm,
        _tabulate_buildings(district, buildings, [scene for scene, _ in kept]), tested,
        list(dict.fromkeys(notes)),
    )


def _read_seasons(
    district: District, site: Site, places: Sequence[Path], notes: list[str]
) -> tuple[str, Seasons]:
    """Return the simulated days in words, and the run of the site in each season and cell.

    Seasons that are incomplete in any cell are left out and noted.
    """
    given, runs = district.weather, list[Mapping[str, Run]]()
    files = {"weather.file": given.file or ""} if given.cells is None else {
        f"weather.cells.{name}": file for name, file in given.cells.items()
    }
    window, start = f"from {given.start}", given.start
    for key, name in files.items():
        values = {each: getattr(given, each) for each in ("evapotranspiration", "gaps")}
        try:
            inputs: RunInputs = make_inputs(find_controller("onoff"), {
                "site": site, "weather": district.find_files(key, name, places), **values,
            })
            weather, _ = inputs.read_records(site)
            contents, *others = as_lines(summarize(weather, site))
            notes += [f"{weather.source}: {contents}", *others]
            if start is None:
                days = read_window(given.season, site)
                window = f"{days}"
                made, incomplete = find_seasons(inputs, site, weather, days)
                notes += [f"season {each} is left out: {why}" for each, why in incomplete.items()]
            else:
                run = replace(inputs, weather=weather, start=start, hours=given.hours).build()
                start, made = run.start.isoformat(), {f"{run.start:%Y-%m-%d}": run}
        except ConfigurationError as error:
            if error.file is not None or not hasattr(given, error.key or ""):
                raise
            raise district.refuse(f"weather.{error.key}", error.expected, error.value) from None
        notes += [
            *list_notes(made, site),
            *(note for run in made.values() for note in run.forecast.notes),
        ]
        runs.append(made)
    shared = [name for name in runs[0] if all(name in each for each in runs)]
    if not shared:
        raise district.refuse("weather.cells", "have no complete season in common")
    return window, {name: [each[name] for each in runs] for name in shared}


def _tabulate_buildings(
    district: District, buildings: Buildings, scenes: Sequence[Scene]
) -> pl.DataFrame:
    """Return a row for every building, with the means of its results over the seasons."""
    shares, cells = [*district.shares, None], [*(district.weather.cells or ())]
    adopts = buildings.groups < len(district.shares)
    return pl.DataFrame({
        "id": buildings.ids,
        **({"cell": [cells[cell] for cell in buildings.cells]} if cells else {}),
        **buildings.values,
        "connected_area_m2": scenes[0].areas,
        "adopts_at": [shares[group] for group in buildings.groups],
        "low_outlet": [
            bool(valve) if adopt else None
            for valve, adopt in zip(buildings.valves, adopts, strict=True)
        ],
        **{
            f"{outlet}:{name}": np.mean([scene.metrics[outlet][name] for scene in scenes], axis=0)
            for outlet, name in itertools.product(scenes[0].metrics, scenes[0].metrics["none"])
        },
    }, strict=False).fill_nan(None)
