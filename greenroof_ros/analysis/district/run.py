"""The run of a district: its parts, which workers simulate, and the sums over them."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.analysis.district.adoption import Adoption
from greenroof_ros.analysis.district.buildings import Buildings, make_buildings
from greenroof_ros.analysis.district.district_file import NONE, OUTLETS, District, read_district
from greenroof_ros.analysis.district.parts import SITE_FILE, Part, simulate_part, weather_file
from greenroof_ros.analysis.district.totals import Totals
from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.analysis.workers.processes import Workers
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import YamlMapping
from greenroof_ros.base.processes import scratch_directory
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.storm_water import HOUR_S, find_wet, interval_seconds
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import merge_site_file
from greenroof_ros.site.site import Site
from greenroof_ros.weather.summary import as_lines

# Buildings of a part. A part needs memory for all its buildings at once.
_PART = 500
_REFRESH_S = 0.5

Progress = Callable[[str, float], None]
"""receives a text about the completed work, and its share of all work; an error that it raises ends
the run"""


@dataclass(frozen=True)
class DistrictRun:
    """A district that has been read and can be simulated.

    Attributes:
        district: contents of the district file.
        site: the site that all buildings have in common.
        buildings: all buildings.
        runs: run of the site in each cell, with the weather of the cell.
        cells: names of the cells; empty if all buildings have the same weather.
        notes: notes that the reader must see before the results.
    """

    district: District
    site: Site
    buildings: Buildings
    runs: Sequence[Run]
    cells: Sequence[str]
    notes: Sequence[str]

    @property
    def adoption(self) -> Adoption:
        """Groups of buildings by adoption."""
        shares = [share for share in self.district.shares if share]
        return Adoption(len(self.buildings), shares, self.district.valve_share)

    @property
    def outlets(self) -> tuple[str, ...]:
        """Kinds of outlet; ``none`` is always included, since some cisterns have no valve."""
        return tuple(name for name in OUTLETS if name in (NONE, *self.district.outlets))

    def make_totals(self) -> Totals:
        """Return the sums of the district before its first part."""
        tau, after, seconds = (
            self.site.tau, HOUR_S * self.site.wet_after, interval_seconds(self.site)
        )
        firsts = np.arange(0, self.runs[0].steps, round(seconds / tau))
        rain = np.array([run.series.precipitation[: run.steps] for run in self.runs])
        wet = np.any([
            find_wet(of_cell, tau, after, run.without_rain_s)[0]
            for of_cell, run in zip(rain.tolist(), self.runs, strict=True)
        ], axis=0)
        return Totals(
            self.buildings, self.adoption, self.outlets, seconds,
            np.add.reduceat(tau * rain, firsts, axis=1), np.logical_or.reduceat(wet, firsts),
            self.district.sewer_capacity,
        )

    @property
    def files(self) -> dict[str, bytes]:
        """Contents of the workers' input files, by name."""
        return {
            SITE_FILE: merge_site_file(self.district.site_file, self.district.ticks).encode(),
            **{weather_file(n): pickle.dumps(run) for n, run in enumerate(self.runs)},
        }

    def parts(self) -> Iterator[Part]:
        """Yield the parts, which do not depend on the number of workers."""
        adoption = self.adoption
        for first in range(0, len(self.buildings), _PART):
            places = slice(first, first + _PART)
            buildings = self.buildings.part(places)
            yield Part(
                places, replace(self.district, content=YamlMapping()), self.outlets, buildings,
                adoption.groups(buildings.ranks), len(adoption.shares),
                adoption.have_valve(buildings.ranks),
            )


def read_run(path: Path, places: Sequence[Path] = ()) -> DistrictRun:
    """Read a district file and all files that it names.

    Args:
        path: path of the district file.
        places: additional directories to search for weather files.

    Raises:
        ConfigurationError: if a file is invalid.
    """
    district, site = read_district(path)
    weather, notes = district.weather, list[str]()
    if weather.cells is not None:
        files = {f"weather.cells.{name}": file for name, file in weather.cells.items()}
    else:
        files = {"weather.file": weather.file or ""}
    runs: list[Run] = []
    for key, name in files.items():
        found = district.find_files(key, name, places)
        given = {
            name: getattr(weather, name)
            for name in ("start", "hours", "evapotranspiration", "gaps")
        }
        if runs:  # all cells begin at the same instant, even if their files' offsets differ
            given["start"] = runs[0].start.isoformat()
        try:
            run = make_inputs(
                find_controller("onoff"), {"site": site, "weather": found, **given}
            ).build()
        except ConfigurationError as error:
            if error.file is not None or error.key not in given:
                raise
            raise district.refuse(f"weather.{error.key}", error.expected, error.value) from None
        runs.append(run)
        notes += [*as_lines(run.series.summary), *run.notes()]
    cells = [*(weather.cells or ())]
    buildings = make_buildings(district, site, cells, notes)
    return DistrictRun(district, site, buildings, runs, cells, notes)


def simulate_district(
    run: DistrictRun, threads: int = 1, progress: Progress = lambda text, share: None
) -> Totals:
    """Simulate a district in this process.

    Args:
        run: the district.
        threads: number of threads that share the buildings.
        progress: see :data:`Progress`.

    Raises:
        ConfigurationError: if a building's site is invalid.
    """
    totals, parts = run.make_totals(), [*run.parts()]
    with scratch_directory() as directory:
        write_inputs(run.files, directory)
        for number, part in enumerate(parts):
            def report(share: float, before: int = number) -> None:
                progress(f"{before} of {len(parts)} parts", (before + share) / len(parts))

            totals.add(part.places, simulate_part(directory, part, threads, report))
    return totals


def distribute_district(
    run: DistrictRun, workers: Workers, progress: Progress = lambda text, share: None
) -> Totals:
    """Simulate a district with workers; the results equal those of :func:`simulate_district`.

    Args:
        run: the district.
        workers: workers that have the input files.
        progress: see :data:`Progress`.

    Raises:
        ConfigurationError: if a building's site is invalid.
        WorkersLostError: if no worker is left.
    """
    totals = run.make_totals()
    pending: dict[Future[Any], Part] = {
        workers.submit(simulate_part, part): part for part in run.parts()
    }
    count = len(pending)
    while pending:
        workers.check()
        done, _ = wait(pending, timeout=_REFRESH_S, return_when=FIRST_COMPLETED)
        for future in done:
            totals.add(pending.pop(future).places, workers.result(future))
        ready = count - len(pending)
        progress(f"{ready} of {count} parts", ready / count)
    return totals
