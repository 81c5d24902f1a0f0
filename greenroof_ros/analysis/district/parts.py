"""A part of a district: a group of buildings that are simulated together on any machine."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.district.buildings import Buildings, Values
from greenroof_ros.analysis.district.district_file import (
    NONE,
    ORIFICE,
    District,
    is_of_policy,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.onoff import LEVEL
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.physics.start import find_state
from greenroof_ros.physics.storm_water import connected_area
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.file import SiteFile, check_site
from greenroof_ros.site.site import WITHOUT_VALVE, Site

SITE_FILE = "site.yaml"
"""name of the input file with the site that all buildings have in common"""
METRICS = (
    "discharge_m3", "wet_discharge_m3", "overflow_m3", "overflow_days", "pumped_m3", "mains_m3",
    "demand_met_share", "stress_hours",
)
"""metrics that are kept for every building"""
# Number of cells whose weather a worker keeps in memory.
_CELLS_KEPT = 8


def weather_file(cell: int) -> str:
    """Return the name of the input file with the weather of a cell."""
    return f"weather-{cell}.pickle"


@dataclass(frozen=True)
class Part:
    """Some buildings, and the outlets with which they are simulated.

    Attributes:
        places: positions of the buildings among all buildings of the district.
        district: the district, with the values that all buildings share.
        outlets: kinds of outlet to simulate, one after the other.
        buildings: the buildings.
        groups: adoption groups to which the buildings belong.
        group_count: number of groups; buildings that are in no group stay as they are.
        valves: whether each building has a valve, or an orifice in its place.
    """

    places: slice
    district: District
    outlets: tuple[str, ...]
    buildings: Buildings
    groups: NDArray[np.intp]
    group_count: int
    valves: NDArray[np.bool_]


@dataclass(frozen=True)
class PartResult:
    """The results of a part.

    Attributes:
        areas: connected area of each building (m2), shape (n,).
        hydrographs: discharge of each group to the sewer in each interval, and its part that leaves
            through low outlets (m3), by outlet, shape (groups, 2, intervals). For the outlet
            ``none``, the groups of buildings with a valve come first, and then the groups of
            buildings without a valve. The last groups are left out if they have no buildings.
        metrics: metrics of each building, by outlet and name, shape (n,); NaN if the building has a
            different outlet, or if the metric is undefined.
    """

    areas: Values
    hydrographs: dict[str, Values]
    metrics: dict[str, dict[str, Values]]


@lru_cache(_CELLS_KEPT)
def _read_run(file: Path) -> Run:
    run: Run = pickle.loads(file.read_bytes())  # noqa: S301 - of this command
    return run


def simulate_part(
    directory: Path, part: Part, threads: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> PartResult:
    """Simulate a part.

    Args:
        directory: directory of the input files.
        part: the part to simulate.
        threads: number of threads that share the buildings.
        progress: as for :func:`.season.simulate_season`.

    Raises:
        ConfigurationError: if a building's site is invalid.
    """
    buildings, count = part.buildings, part.group_count
    sites = [*make_sites(directory / SITE_FILE, buildings)]
    adopts = part.groups < count
    simulated: dict[str, NDArray[np.intp]] = {}
    groups, variants = list[NDArray[np.intp]](), list[_Variant]()
    rows: dict[str, slice] = {}
    first = 0
    for outlet in part.outlets:
        everyone = outlet == NONE
        places = np.flatnonzero(adopts & (part.valves | everyone))
        simulated[outlet] = places
        groups.append(first + part.groups[places] + count * (everyone & ~part.valves[places]))
        variants += [
            with_outlet(part.district, outlet, sites, buildings, n) for n in places.tolist()
        ]
        rows[outlet] = slice(first, first := first + count * (1 + everyone))
    if not variants:
        return PartResult(_areas(sites), {}, {})
    places = np.concatenate([*simulated.values()])
    results, hydrograph = simulate_season([
        Case(
            variant.site, variant.parameters, _read_run(directory / weather_file(cell)),
            *variant.state, part.district.forecast == PERFECT, group,
        )
        for variant, cell, group in zip(
            variants, buildings.cells[places].tolist(), np.concatenate(groups).tolist(), strict=True
        )
    ], progress=progress, threads=threads)
    made, metrics = iter(results), {}
    for outlet, places in simulated.items():
        values = np.full((len(METRICS), len(buildings)), np.nan)
        for place in places.tolist():
            of_site = next(made)[0].metrics
            values[:, place] = [of_site.get(name, np.nan) for name in METRICS]
        metrics[outlet] = dict(zip(METRICS, values, strict=True))
    hydrographs = {outlet: hydrograph[own] for outlet, own in rows.items()}
    return PartResult(_areas(sites), hydrographs, metrics)


def _areas(sites: Sequence[Site]) -> Values:
    return np.array([connected_area(site) for site in sites])


def make_sites(file: Path, buildings: Buildings) -> Iterator[Site]:
    """Yield the site of each building.

    Args:
        file: site file that the buildings have in common.
        buildings: the buildings.

    Raises:
        ConfigurationError: if a building's site is invalid.
    """
    names = [name for name in buildings.values if not is_of_policy(name)]
    common = SiteFile(file)
    for place in range(len(buildings)):
        try:
            yield common.change({name: buildings.values[name][place] for name in names})
        except ConfigurationError as error:
            raise buildings.refuse(place, error) from None


class _Variant(NamedTuple):
    """A building with one kind of outlet."""

    site: Site
    parameters: dict[str, Any]
    """parameters of the on/off controller and of the valve's policy"""
    state: tuple[float, float]
    """initial volumes in the cistern and on the roof (m3)"""


def with_outlet(
    district: District, outlet: str, sites: Sequence[Site], buildings: Buildings, place: int
) -> _Variant:
    """Return a building with a kind of outlet.

    Args:
        district: the district.
        outlet: kind of outlet.
        sites: sites of the buildings.
        buildings: the buildings.
        place: position of the building among ``buildings``.

    Raises:
        ConfigurationError: if the building's site is invalid with this outlet.
    """
    site = sites[place]
    given = {
        name: values[place] for name, values in buildings.values.items() if is_of_policy(name)
    }
    if outlet in (NONE, ORIFICE):
        changes = dict.fromkeys(("low_outlet_level", "low_outlet_radius")) if outlet == NONE else {
            name: value for name, value in asdict(district.orifice).items() if value is not None
        }
        site = replace(site, **WITHOUT_VALVE, **changes)
        given = {name: value for name, value in given.items() if name == LEVEL.name}
    else:
        given["outlet"] = outlet
    try:
        if outlet == ORIFICE:
            check_site(site)
        parameters = find_controller("onoff").complete_parameters(site, given)
        return _Variant(site, parameters, find_state(site)[1:])
    except ConfigurationError as error:
        raise buildings.refuse(place, error) from None
