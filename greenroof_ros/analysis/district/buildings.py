"""The buildings of a district, drawn from distributions or listed in a CSV file; and their scenes.

Buildings adopt in a random order: a building that has a green roof at a low level of adoption also
has one at every higher level. Those that adopt at the same level form a group, so that every
building is simulated once, and the district at any adoption is a sum of groups.

A scene is one draw of the buildings in one season, with the sums over the buildings. Flows are
added without routing, so the peaks in a real sewer are attenuated and delayed.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from scipy.special import ndtr, ndtri

from greenroof_ros.analysis.district import file as keys
from greenroof_ros.analysis.district.file import BUILDING_KEYS, POLICY_KEYS, District, Draw
from greenroof_ros.analysis.references import PEAKS, find_peak, remove_cistern
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.onoff import LEVEL
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.storm_water import HOUR_S, connected_area, find_wet, interval_seconds
from greenroof_ros.simulation.run import Run, Values
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.file import SiteFile, check_site
from greenroof_ros.site.site import WITHOUT_VALVE, Site
from greenroof_ros.weather.table import read_table

ID, LINE, GROUP = "id", "line", "group"


def list_buildings(district: District, notes: list[str]) -> pl.DataFrame:
    """Return the names of the buildings, their lines in the CSV file, and its other columns.

    Args:
        district: the district.
        notes: list to which a note on unused columns is added.

    Raises:
        ConfigurationError: if the CSV file is invalid.
    """
    if district.file is None:
        ids = [str(number) for number in range(1, (district.buildings or 0) + 1)]
        return pl.DataFrame({ID: ids, LINE: [0] * len(ids)})
    table = read_table(district.find_files("file", district.file)[0])
    columns = [name for name in table.header if name in BUILDING_KEYS]
    if others := [name for name in table.header if name not in (ID, *columns)]:
        notes.append(
            f"{table.file.name}: these columns are not keys of a building and are ignored: "
            + ", ".join(others)
        )
    rows = dict[str, dict[str, Any]]()
    for row in table.rows:
        name = table.cell(row, ID)
        if not name or name in rows:
            raise table.refuse("must be a name or number of its own", ID, row)
        rows[name] = {ID: name, LINE: row.line} | {
            each: table.read_number(row, each, BUILDING_KEYS[each].range) for each in columns
        }
    return pl.DataFrame([*rows.values()])


def make_buildings(district: District, site: Site, listed: pl.DataFrame, draw: int) -> pl.DataFrame:
    """Return the buildings of a draw.

    The values of one key depend neither on the other keys nor on the number of buildings: if the
    number grows, the first buildings stay the same.

    Args:
        district: the district.
        site: the site that the buildings have in common.
        listed: the buildings of :func:`list_buildings`.
        draw: number of the draw, from 0.

    Returns:
        The listed columns and the drawn keys; ``adopts_at``, the first level of adoption at which
        each building has a green roof, if it ever has one; and its ``group``, the index of this
        level, or the number of levels.

    Raises:
        ConfigurationError: if a value is outside the range of its key.
    """
    count, seed = len(listed), district.seed + draw
    values = {name: listed[name].to_numpy() for name in listed.columns[2:]}
    for name, each in sorted(district.draw.items(), key=lambda item: item[1].times is not None):
        if name in listed.columns:
            raise district.refuse(f"draw.{name}", f"is also a column of {district.file}", name)
        drawn = _draw(name, each, count, seed)
        if each.times is not None:
            factor = values.get(each.times, getattr(site, each.times, None))
            drawn = drawn * np.asarray(factor, float)  # NaN without a value
        key = BUILDING_KEYS[name]
        for value in (float(drawn.min()), float(drawn.max())):
            if value not in key.range:
                raise district.refuse(f"draw.{name}", f"must be {key.limits}", value)
        values[name] = drawn
    ranks = np.random.default_rng(seed).permutation(count)
    counts = [math.floor(share * count + 0.5) for share in district.shares]
    groups = np.searchsorted(counts, ranks, side="right")
    return listed.with_columns(
        **{name: pl.Series(each) for name, each in values.items()}, group=pl.Series(groups),
        adopts_at=pl.Series([*district.shares, None], dtype=pl.Float64).gather(groups),
    )


def make_sites(district: District, buildings: pl.DataFrame) -> list[Site]:
    """Return the site of each building.

    Raises:
        ConfigurationError: if a building's site is invalid.
    """
    common, sites = SiteFile(district.find_files("site", district.site)[0]), []
    for building in buildings.iter_rows(named=True):
        own = {n: v for n, v in building.items() if n in BUILDING_KEYS and n not in POLICY_KEYS}
        try:
            sites.append(common.change({"tau": district.tau, "M": 1} | own))
        except ConfigurationError as error:
            raise refuse_building(district, building, error) from None
    return sites


def refuse_building(
    district: District, building: dict[str, Any], error: ConfigurationError
) -> ConfigurationError:
    """Return an error about a building's site that names the building and the value's source."""
    expected, key = f"{error.expected} (building {building[ID]})", error.key or ""
    name = key.partition(" ")[0]  # the paper's name may follow a plain key
    if name in district.draw:
        return district.refuse(f"draw.{name}", expected, error.value)
    file, line = (Path(district.file), building[LINE]) if district.file else (district.path, None)
    return ConfigurationError(expected, file=file, line=line, key=key, value=error.value)


def _draw(name: str, draw: Draw, count: int, seed: int) -> Values:
    """Return a key's value for each building, from the inverse of its distribution."""
    shares = np.random.default_rng([seed, zlib.crc32(name.encode())]).random(count)
    if draw.values:
        return np.asarray(np.array(draw.values)[(shares * len(draw.values)).astype(int)])
    mean, sd = np.array([draw.mean, draw.sd], float).tolist()
    low, high = draw.low or 0.0, math.inf if draw.high is None else draw.high
    variance = math.log1p((sd / mean) ** 2)
    middle, width = math.log(mean) - variance / 2, math.sqrt(variance)
    below, up_to = (
        ndtr((math.log(end) - middle) / width) if end > 0 else 0.0 for end in (low, high)
    )
    drawn = np.exp(middle + width * ndtri(below + (up_to - below) * shares))
    return np.asarray(np.clip(drawn, low, high))  # rounding may exceed the limits


# --- scenes ---------------------------------------------------------------------------------------

METRICS = (
    "discharge_m3", "wet_discharge_m3", "overflow_m3", "pumped_m3", "mains_m3", "stress_hours"
)
"""metrics that are kept for every building"""
DAY_S = 86_400.0
# More than the rounding errors of an interval's sums, and too little water to matter (m3).
_NOTHING = 1e-6

class Flow(NamedTuple):
    """One kind of outlet at one level of adoption."""

    outlet: str
    adoption: float

AS_IS = Flow(keys.NONE, 0.0)
"""no building has a green roof or a cistern"""


def list_flows(district: District) -> list[Flow]:
    """Return the district as it is, and every kind of outlet at every level of adoption."""
    outlets = [name for name in keys.OUTLETS if name in (keys.NONE, *district.outlets)]
    return [AS_IS, *(Flow(name, share) for name in outlets for share in district.shares)]


class Scene:
    """One draw of the buildings in one season.

    Attributes:
        district: the district.
        flows: the flows that are simulated.
        start: time at which the scene begins, on its clock.
        areas: connected area of each building (m2).
        durations: duration of each interval (s); the last one may be shorter.
        rain: depth of rain in each interval (m).
        wet: whether the weather is wet in each interval.
        metrics: metrics of each building, such as ``plan:mains_m3``; NaN if the building never
            adopts, or if the metric is undefined.
    """

    def __init__(
        self, district: District, buildings: pl.DataFrame, sites: Sequence[Site], run: Run,
        flows: Sequence[Flow], threads: int = 1,
        progress: Callable[[float], None] = lambda share: None,
    ) -> None:
        """Simulate the scene.

        Args:
            district: the district.
            buildings: its buildings.
            sites: their sites.
            run: run of the season.
            flows: flows to simulate.
            threads: number of threads that share the buildings.
            progress: callback that receives the completed share; its error ends the simulation.

        Raises:
            ConfigurationError: if a building's site is invalid.
        """
        self.district, self.flows, self.start = district, flows, run.start.replace(tzinfo=None)
        self._ids, self._groups, site = buildings[ID], buildings[GROUP].to_numpy(), run.site
        self.areas = np.array([connected_area(each) for each in sites])
        firsts = np.arange(0, run.steps, round(interval_seconds(site) / site.tau))
        self.durations = site.tau * np.diff(np.append(firsts, run.steps))
        rates = np.array(run.series.precipitation[: run.steps])
        self.rain = np.add.reduceat(site.tau * rates, firsts)
        wet, _ = find_wet(rates.tolist(), site.tau, HOUR_S * site.wet_after, run.without_rain_s)
        self.wet = np.logical_or.reduceat(wet, firsts)
        self.metrics, self._volumes = dict[str, Values](), dict[str, Values]()
        adopting = np.flatnonzero(self._groups < len(district.shares)).tolist()
        outlets = list(dict.fromkeys(flow.outlet for flow in flows if flow.adoption))
        for number, outlet in enumerate(outlets if adopting else ()):
            def report(share: float, done: int = number) -> None:
                progress((done + share) / len(outlets))

            equipped = [
                _equip(district, outlet, buildings.row(place, named=True), sites[place])
                for place in adopting
            ]
            results, volumes = simulate_season([
                Case(own, parameters, run, own.a1 * own.z_o / 2, own.x2_star, group=int(group))
                for (own, parameters), group in zip(equipped, self._groups[adopting], strict=True)
            ], threads=threads, progress=report)
            values = np.full((len(METRICS), len(sites)), np.nan)
            for place, (result, _) in zip(adopting, results, strict=True):
                values[:, place] = [result.metrics.get(name, np.nan) for name in METRICS]
            self.metrics |= {f"{outlet}:{n}": v for n, v in zip(METRICS, values, strict=True)}
            self._volumes[outlet] = volumes[:, 0]

    def _count(self, flow: Flow) -> int:
        """Return the number of groups that have a green roof."""
        return sum(share <= flow.adoption for share in self.district.shares)

    def group_discharges(self, flow: Flow) -> Values:
        """Return the discharge of each group (m3), shape (groups, intervals).

        The last group is that of the buildings that never adopt. All rain on buildings without a
        green roof runs off at once.
        """
        areas = np.bincount(self._groups, self.areas, len(self.district.shares) + 1)
        volumes = areas[:, np.newaxis] * self.rain
        made = self._volumes.get(flow.outlet, volumes[:0])[: self._count(flow)]
        volumes[: len(made)] = made
        return np.asarray(volumes)

    def add(self, flow: Flow) -> dict[str, Any]:
        """Return the results of a flow, summed over all buildings; names include the units."""
        volumes, as_is = (self.group_discharges(each).sum(axis=0) for each in (flow, AS_IS))
        adopts, area = self._groups < self._count(flow), self.areas.sum()
        with np.errstate(invalid="ignore"):  # NaN without rain
            row: dict[str, Any] = {
                **flow._asdict(), "buildings": int(adopts.sum()), "rain_m3": as_is.sum(),
                "discharge_m3": volumes.sum(), "retention_share": 1 - volumes.sum() / as_is.sum(),
                "wet_discharge_m3": volumes[self.wet].sum(), "wet_discharge_reduction":
                1 - volumes[self.wet].sum() / as_is[self.wet].sum(),
            }
        beyond = volumes - self.district.sewer_capacity / 1000 / HOUR_S * area * self.durations
        over = beyond > _NOTHING
        peaks = {
            name: 1000 * find_peak(volumes, self.durations, width) for width, name in PEAKS.items()
        }
        days = np.cumsum(self.durations)[over] // DAY_S
        return row | peaks | {
            "sewer_overflow_m3": beyond[over].sum(), "sewer_overflow_days": len({*days}),
            "dry_sewer_overflow_m3": beyond[over & ~self.wet].sum(),
        } | {
            name: np.nansum(self.metrics[f"{flow.outlet}:{name}"][adopts]) if adopts.any() else 0.0
            for name in ("overflow_m3", "pumped_m3", "mains_m3")
        }

    def list_buildings(self) -> pl.DataFrame:
        """Return the name, connected area and metrics of each building."""
        return pl.DataFrame({ID: self._ids, "connected_area_m2": self.areas, **self.metrics})


def _equip(
    district: District, outlet: str, building: dict[str, Any], site: Site
) -> tuple[Site, dict[str, Any]]:
    """Return a building's site with a kind of outlet, and the parameters of its controller."""
    given = {name: building[name] for name in POLICY_KEYS if name in building}
    if outlet in (keys.DRAIN, keys.PLAN):
        given["outlet"] = outlet
    elif outlet == keys.ROOF:
        site, given = remove_cistern(site), {}
    else:
        changes: dict[str, Any] = dict.fromkeys(("low_outlet_level", "low_outlet_radius"))
        if outlet == keys.ORIFICE:
            changes = {n: each for n, each in asdict(district.orifice).items() if each is not None}
        site = replace(site, **WITHOUT_VALVE, **changes)
        given = {name: value for name, value in given.items() if name == LEVEL.name}
    try:
        if outlet == keys.ORIFICE:
            check_site(site)
        return site, find_controller("onoff").complete_parameters(site, given)
    except ConfigurationError as error:
        raise refuse_building(district, building, error) from None
