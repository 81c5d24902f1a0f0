"""The run of a district: its parts, which workers simulate, and the sums over them."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.analysis.district.adoption import Adoption
from greenroof_ros.analysis.district.buildings import Buildings, Values, make_buildings
from greenroof_ros.analysis.district.district_file import (
    NONE,
    OUTLETS,
    PLAN,
    District,
    read_district,
)
from greenroof_ros.analysis.district.parts import (
    SITE_FILE,
    Part,
    simulate_part,
    weather_file,
)
from greenroof_ros.analysis.district.totals import Totals
from greenroof_ros.analysis.workers.processes import Workers
from greenroof_ros.analysis.workers.progress import ShareFile
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping
from greenroof_ros.common.processes import scratch_directory
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.batch import BatchWeather
from greenroof_ros.physics.storm_water import interval_seconds
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site, merge_site_file

# A building takes less time in a larger part, but other processors need parts, too. Parts do not
# depend on the number of workers, so neither does the last bit of their sums.
_MIN_PART, _MAX_PART, _PARTS = 650, 2500, 8
_REFRESH_S = 0.5
PRELOADED = ["greenroof_ros.analysis.district.parts"]
"""modules that every worker imports"""


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

    @cached_property
    def weather(self) -> list[BatchWeather]:
        """The weather of each cell."""
        return [BatchWeather.of_run(run) for run in self.runs]

    @property
    def adoption(self) -> Adoption:
        """Groups of buildings by adoption."""
        shares = [share for share in self.district.shares if share]
        return Adoption(len(self.buildings), shares, self.district.valve_share)

    @property
    def outlets(self) -> tuple[str, ...]:
        """Kinds of outlet; ``none`` is always included, since some cisterns have no valve."""
        return tuple(name for name in OUTLETS if name in (NONE, *self.district.outlets))

    @property
    def rain(self) -> Values:
        """Depth of rain in each cell and interval (m), shape (cells, intervals)."""
        size = round(interval_seconds(self.site) / self.site.tau)
        ticks = self.site.tau * np.array([weather.rain[:-1] for weather in self.weather])
        return np.asarray(np.add.reduceat(ticks, np.arange(0, ticks.shape[1], size), axis=1))

    @property
    def files(self) -> dict[str, bytes]:
        """Contents of the workers' input files, by name."""
        return {
            SITE_FILE: merge_site_file(self.district.site_file, self.district.ticks).encode(),
            **{weather_file(n): pickle.dumps(cell) for n, cell in enumerate(self.weather)},
        }

    def parts(self, scratch: Path) -> Iterator[Part]:
        """Yield the parts.

        The simulation of the outlet ``plan`` takes as long as that of all other outlets together,
        so ``plan`` has parts of its own.

        Args:
            scratch: directory where workers on this machine write their progress.
        """
        adoption = self.adoption
        together = tuple(name for name in self.outlets if name != PLAN)
        count = len(self.buildings)
        most = min(max(count / _PARTS, _MIN_PART), _MAX_PART)
        size = math.ceil(count / math.ceil(count / most))
        for outlets in ((PLAN,) * (PLAN in self.outlets), together):  # the longest first
            for first in range(0, count * bool(outlets), size):
                places = slice(first, first + size)
                buildings = self.buildings.part(places)
                yield Part(
                    places, replace(self.district, content=YamlMapping()), outlets, buildings,
                    adoption.groups(buildings.ranks), len(adoption.shares),
                    adoption.have_valve(buildings.ranks),
                    ShareFile(scratch / f"{outlets[0]}-{first}"),
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
        notes += run.notes()
    cells = [*(weather.cells or ())]
    buildings = make_buildings(district, site, cells, notes)
    return DistrictRun(district, site, buildings, runs, cells, notes)


def simulate_district(
    run: DistrictRun, workers: Workers,
    progress: Callable[[str, float], None] = lambda text, share: None,
    check: Callable[[], None] = lambda: None,
) -> Totals:
    """Simulate all parts and add up their results.

    Args:
        run: the district.
        workers: workers that have the input files.
        progress: callback that receives a text about the completed work, and its share of all work.
        check: callback that is called often; an error that it raises stops the run.

    Raises:
        ConfigurationError: if a building's site is invalid.
        WorkersLostError: if no worker is left.
    """
    totals = Totals(
        run.site, run.buildings, run.adoption, run.outlets, run.rain, run.district.sewer_capacity
    )
    with scratch_directory() as scratch:
        parts = [*run.parts(scratch)]
        pending: dict[Future[Any], Part] = {
            workers.submit(simulate_part, part): part for part in parts
        }
        while pending:
            workers.check()
            done, _ = wait(pending, timeout=_REFRESH_S, return_when=FIRST_COMPLETED)
            for future in done:
                totals.add(pending.pop(future).places, workers.result(future))
            begun = sum(part.progress.read() for part in pending.values())
            ready = len(parts) - len(pending)
            progress(f"{ready} of {len(parts)} parts", (ready + begun) / len(parts))
            check()
    return totals
