"""A scene: one draw of a district's buildings in one season, and the sums over the buildings.

Flows are added without routing, so the peaks in a real sewer are attenuated and delayed. Weather is
wet if it is wet in any cell, because all cells share one sewer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from greenroof_ros.analysis.district.buildings import Buildings, Values, refuse_building
from greenroof_ros.analysis.district.file import (
    NO_FORECAST,
    NONE,
    ORIFICE,
    OUTLETS,
    District,
    is_of_policy,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.onoff import LEVEL
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.start import find_state
from greenroof_ros.physics.storm_water import HOUR_S, connected_area, find_wet, interval_seconds
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.file import check_site
from greenroof_ros.site.site import WITHOUT_VALVE, Site

if TYPE_CHECKING:
    import polars

PEAK_MIN = (5, 15, 60)
"""times over which the flow is averaged for a peak (min)"""
METRICS = (
    "discharge_m3", "wet_discharge_m3", "overflow_m3", "overflow_days", "pumped_m3", "mains_m3",
    "demand_met_share", "stress_hours", "drainage_m3", "rain_roof_m3",
)
"""metrics that are kept for every building"""
# More than the rounding errors of an interval's sums, and too little water to matter (m3).
_NOTHING = 1e-6


class Flow(NamedTuple):
    """One kind of outlet at one level of adoption."""

    outlet: str
    adoption: float

    @property
    def name(self) -> str:
        """Name of the flow: ``as_is``, or ``drain_050`` for half of the buildings."""
        return f"{self.outlet}_{100 * self.adoption:03g}" if self.adoption else "as_is"


PERCENTILES = (5, 95)
"""the percentiles of the range that is stated for every result"""

AS_IS = Flow(NONE, 0.0)
"""no building has a green roof or a cistern"""


def list_flows(district: District) -> list[Flow]:
    """Return the district as it is, and every kind of outlet at every level of adoption."""
    outlets = [name for name in OUTLETS if name in (NONE, *district.outlets)]
    return [AS_IS, *(Flow(name, share) for name in outlets for share in district.shares)]


def find_best(rows: polars.DataFrame) -> Flow:
    """Return the flow with the least discharge in wet weather."""
    wet = rows["outlet", "adoption", "wet_discharge_m3"]
    means = wet.group_by("outlet", "adoption", maintain_order=True).mean()
    return Flow(*means.sort("wet_discharge_m3", maintain_order=True)["outlet", "adoption"].row(0))


class Scene:
    """One draw of the buildings in one season.

    Attributes:
        flows: the flows to which the results belong.
        areas: connected area of each building (m2).
        durations: duration of each interval (s); the last one may be shorter.
        rain: depth of rain in each cell and interval (m), shape (cells, intervals).
        wet: whether the weather is wet in any cell in each interval.
        metrics: metrics of each building, by outlet and name; NaN if the building has another
            outlet or if the metric is undefined.
    """

    def __init__(
        self, district: District, buildings: Buildings, sites: Sequence[Site], runs: Sequence[Run],
        flows: Sequence[Flow], threads: int = 1,
        progress: Callable[[float], None] = lambda share: None,
    ) -> None:
        """Simulate the scene.

        Args:
            district: the district.
            buildings: its buildings.
            sites: their sites.
            runs: run of the season in each cell.
            flows: flows to simulate.
            threads: number of threads that share the buildings.
            progress: callback that receives the completed share; its error ends the simulation.

        Raises:
            ConfigurationError: if a building's site is invalid.
        """
        self._district, self._buildings, self.flows = district, buildings, flows
        self.areas = np.array([connected_area(site) for site in sites])
        site, count = runs[0].site, len(district.shares)
        every = round(interval_seconds(site) / site.tau)
        firsts = np.arange(0, runs[0].steps, every)
        self.durations = site.tau * np.diff(np.append(firsts, runs[0].steps))
        rates = np.array([run.series.precipitation[: run.steps] for run in runs])
        self.rain = np.add.reduceat(site.tau * rates, firsts, axis=1)
        self.wet = np.logical_or.reduceat(np.any([
            find_wet(rate, site.tau, HOUR_S * site.wet_after, run.without_rain_s)[0]
            for rate, run in zip(rates.tolist(), runs, strict=True)
        ], axis=0), firsts)
        self._volumes: dict[str, Values] = {}
        self.metrics = dict[str, dict[str, Values]]()
        outlets = list(dict.fromkeys([NONE, *(flow.outlet for flow in flows)]))
        for number, outlet in enumerate(outlets):
            def report(share: float, done: int = number) -> None:
                progress((done + share) / len(outlets))

            adopts = buildings.groups < count
            places = np.flatnonzero(adopts & (buildings.valves | (outlet == NONE))).tolist()
            # With the outlet none, the groups without a valve follow those with one.
            volumes = np.zeros((2 * count, 2, len(firsts)))
            values = np.full((len(METRICS), len(sites)), np.nan)
            if places:
                results, made = simulate_season([
                    Case(
                        *_change(district, outlet, buildings, sites, place),
                        runs[buildings.cells[place]], *find_state(sites[place])[1:],
                        district.forecast != NO_FORECAST,
                        int(buildings.groups[place] + count * (not buildings.valves[place])),
                    ) for place in places
                ], threads=threads, progress=report)
                volumes[: len(made)] = made
                for place, (result, _) in zip(places, results, strict=True):
                    values[:, place] = [result.metrics.get(name, np.nan) for name in METRICS]
            self._volumes[outlet] = volumes
            self.metrics[outlet] = dict(zip(METRICS, values, strict=True))

    def _adopted(self, flow: Flow) -> int:
        """Return the number of groups that have a green roof."""
        return sum(share <= flow.adoption for share in self._district.shares)

    def _add(self, flow: Flow, quantity: int) -> Values:
        """Return the volumes of each group that adopted (m3), with and without a valve."""
        adopted, count = self._adopted(flow), len(self._district.shares)
        with_valve = self._volumes[flow.outlet][:adopted, quantity]
        return np.asarray(with_valve + self._volumes[NONE][count : count + adopted, quantity])

    def group_discharges(self, flow: Flow) -> Values:
        """Return the discharge of each group (m3), shape (groups, intervals).

        The last group is that of the buildings that never adopt. All rain on buildings without a
        green roof runs off at once.
        """
        groups, count = self._buildings.groups, len(self._district.shares) + 1
        key = groups * len(self.rain) + self._buildings.cells
        areas = np.bincount(key, self.areas, count * len(self.rain)).reshape(count, -1)
        volumes = areas @ self.rain
        volumes[: self._adopted(flow)] = self._add(flow, 0)
        return np.asarray(volumes)

    def values(self, flow: Flow, name: str) -> Values:
        """Return a metric of the buildings with a green roof, shape (buildings,)."""
        own, without = (self.metrics[outlet][name] for outlet in (flow.outlet, NONE))
        adopts = self._buildings.groups < self._adopted(flow)
        return np.asarray(np.where(self._buildings.valves, own, without)[adopts])

    def rows(self) -> list[dict[str, Any]]:
        """Return the results of each flow; the names include the units."""
        reference = self._row(AS_IS)
        return [self._compare(self._row(flow), reference) for flow in self.flows]

    def _compare(self, row: dict[str, Any], reference: dict[str, Any]) -> dict[str, Any]:
        compared = {"wet_discharge": "wet_discharge_m3", "discharge": "discharge_m3"}
        compared |= {f"peak_{each}min": f"peak_{each}min_l_s" for each in PEAK_MIN}
        return row | {
            f"{what}_reduction": 1 - row[name] / reference[name] if reference[name] else np.nan
            for what, name in compared.items()
        }

    def _row(self, flow: Flow) -> dict[str, Any]:
        volumes, area = self.group_discharges(flow).sum(axis=0), self.areas.sum()
        low, groups = self._add(flow, 1).sum(axis=0), self._buildings.groups
        rain = float(self.areas @ self.rain.sum(axis=1)[self._buildings.cells])
        row: dict[str, Any] = {
            **flow._asdict(), "buildings": int((groups < self._adopted(flow)).sum()),
            "rain_m3": rain, "discharge_m3": float(volumes.sum()),
            "retention_share": 1 - float(volumes.sum()) / rain if rain else np.nan,
            "wet_discharge_m3": float(volumes[self.wet].sum()),
            "low_outlet_m3": float(low.sum()), "wet_low_outlet_m3": float(low[self.wet].sum()),
        }
        for weather, where in (("", volumes), ("dry_", np.where(self.wet, 0.0, volumes))):
            for minutes in PEAK_MIN:
                peak = 1000 * find_peak(where, self.durations, minutes)
                row[f"{weather}peak_{minutes}min_l_s"] = peak
                row[f"{weather}peak_{minutes}min_mm_h"] = HOUR_S * peak / area
        if self._district.sewer_capacity is not None:
            capacity = self._district.sewer_capacity / 1000 / HOUR_S * area
            beyond = volumes - capacity * self.durations
            over = beyond > _NOTHING
            row |= {
                "sewer_overflow_m3": float(beyond[over].sum()),
                "sewer_overflow_hours": float(self.durations[over].sum()) / HOUR_S,
                "dry_sewer_overflow_m3": float(beyond[over & ~self.wet].sum()),
            }
        for name in ("overflow_m3", "overflow_days", "pumped_m3", "stress_hours", "drainage_m3",
                     "rain_roof_m3"):
            row[name] = float(self.values(flow, name).sum())
        if not np.isnan(self.metrics[NONE]["mains_m3"]).all():  # the cisterns have mains water
            pumped, met = (self.values(flow, name) for name in ("pumped_m3", "demand_met_share"))
            row["mains_m3"] = float(self.values(flow, "mains_m3").sum())
            # A building that pumps nothing has no share, and no part in that of all.
            row["demand_met_share"] = (
                float(np.nansum(pumped * met)) / pumped.sum() if pumped.sum() else np.nan
            )
        return row


def _change(
    district: District, outlet: str, buildings: Buildings, sites: Sequence[Site], place: int
) -> tuple[Site, dict[str, Any]]:
    """Return a building's site with a kind of outlet, and the parameters of its controller."""
    site = sites[place]
    given = {name: of[place] for name, of in buildings.values.items() if is_of_policy(name)}
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
        return site, find_controller("onoff").complete_parameters(site, given)
    except ConfigurationError as error:
        raise refuse_building(district, buildings, place, error) from None


def find_peak(volumes: Values, durations: Values, minutes: float) -> float:
    """Return the highest mean of a flow over a number of minutes (m3/s).

    The window may begin at any time, as for the peaks in :mod:`.results.sums`.

    Args:
        volumes: volume in each interval (m3), shape (intervals,).
        durations: duration of each interval (s), shape (intervals,).
        minutes: width of the window (min).
    """
    window, edges = 60 * minutes, np.append(0.0, np.cumsum(durations))
    total = np.append(0.0, np.cumsum(volumes))
    # The mean of constant pieces is largest where the window begins or ends with one of them.
    starts = np.concatenate((edges - window, edges))
    sums = np.interp(starts + window, edges, total) - np.interp(starts, edges, total)
    return float(sums.max()) / window
