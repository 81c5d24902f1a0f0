"""The sums over a district: the discharge at each level of adoption with each kind of outlet.

Flows are added without routing, so the peaks in a real sewer are attenuated and delayed. Weather is
wet if it is wet in any cell, because all cells share one sewer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.district.adoption import Adoption
from greenroof_ros.analysis.district.buildings import Buildings, Values
from greenroof_ros.analysis.district.district_file import NONE
from greenroof_ros.analysis.district.parts import METRICS, PartResult
from greenroof_ros.physics.storm_water import (
    Intervals,
    find_peak,
    find_wet_weather,
    interval_seconds,
)
from greenroof_ros.site.site import Site

PEAK_MIN = (5, 15, 60)
"""times over which the flow is averaged for a peak (min)"""
_HOUR_S = 3600.0
# More than the rounding errors of an interval's sums, and too little water to matter (m3).
_NOTHING = 1e-6
# The sums of volumes are in units of 2^-40 m3. A million buildings stay below 2^63 units.
_PER_M3 = 2.0**40
# Results whose reduction is stated, compared with the district as it is.
_REDUCED = {
    "wet_discharge": "wet_discharge_m3",
    **{f"peak_{minutes}min": f"peak_{minutes}min_l_s" for minutes in PEAK_MIN},
    "sewer_overflow": "sewer_overflow_m3",
}


class Flow(NamedTuple):
    """A row of the results: one kind of outlet at one level of adoption."""

    outlet: str
    adoption: float


AS_IS = Flow(NONE, 0.0)
"""no building has a green roof or a cistern"""


class Totals:
    """The sums of the results of parts, which can be added in any order.

    Volumes are added as whole multiples of 2^-40 m3, which makes the sums bit-identical in any
    order of addition. The results of each building are stored at its own position.
    """

    def __init__(
        self, site: Site, buildings: Buildings, adoption: Adoption, outlets: Sequence[str],
        rain: Values, capacity: float | None,
    ) -> None:
        """Initialize all sums to zero.

        Args:
            site: the site that all buildings have in common.
            buildings: all buildings.
            adoption: groups of the buildings.
            outlets: kinds of outlet, including ``none``.
            rain: depth of rain in each cell and interval (m), shape (cells, intervals).
            capacity: capacity of the sewer per unit of connected area (mm/h); None if unknown.
        """
        self.outlets, self.adoption, self.rain = outlets, adoption, rain
        self.seconds = interval_seconds(site)
        """duration of an interval (s)"""
        self._capacity, self._buildings = capacity, buildings
        self._groups = adoption.groups(buildings.ranks)
        self._valves = adoption.have_valve(buildings.ranks)
        count = len(adoption.shares)
        self.areas = np.zeros(len(buildings))
        """connected area of each building (m2)"""
        self._volumes, self._let_out = ({
            outlet: np.zeros((count * (1 + (outlet == NONE)), rain.shape[1]), np.int64)
            for outlet in outlets
        } for _ in range(2))
        self.metrics = {
            outlet: {name: np.full(len(buildings), np.nan) for name in METRICS}
            for outlet in outlets
        }
        """metrics of each building, by outlet and name"""
        self.wet = np.any([
            find_wet_weather(site.wet_after, Intervals(self.seconds, cell, cell)) for cell in rain
        ], axis=0)
        """whether the weather is wet in each interval, shape (intervals,)"""

    def add(self, places: slice, result: PartResult) -> None:
        """Add the result of a part; no building may be added twice with the same outlet.

        Args:
            places: positions of the part's buildings.
            result: result of the part.
        """
        self.areas[places] = result.areas
        for outlet, volumes in result.hydrographs.items():
            for sums, added in (
                (self._volumes, volumes), (self._let_out, result.low_outlets[outlet]),
            ):
                sums[outlet] += np.rint(added * _PER_M3).astype(np.int64)
            for name, values in result.metrics[outlet].items():
                self.metrics[outlet][name][places] = values

    @property
    def area(self) -> float:
        """Connected area of all buildings (m2)."""
        return float(self.areas.sum())

    @property
    def flows(self) -> list[Flow]:
        """The district as it is, and every kind of outlet at every level of adoption."""
        return [AS_IS, *(
            Flow(outlet, share) for outlet in self.outlets for share in self.adoption.shares
        )]

    def discharge(self, flow: Flow) -> Values:
        """Return the discharge to the sewer in each interval (m3), shape (intervals,).

        Buildings without a low outlet discharge the same volume with every kind of outlet. All rain
        on buildings without a green roof runs off immediately.
        """
        others = np.where(self._groups < self._adopted(flow), 0.0, self.areas)
        areas = np.bincount(self._buildings.cells, others, len(self.rain))
        return np.asarray(self._add_groups(self._volumes, flow) + areas @ self.rain)

    def let_out(self, flow: Flow) -> Values:
        """Return the water from low outlets in each interval (m3), shape (intervals,)."""
        return self._add_groups(self._let_out, flow)

    def _add_groups(self, sums: Mapping[str, NDArray[np.int64]], flow: Flow) -> Values:
        total = np.zeros(self.rain.shape[1], np.int64)
        for outlet, groups in self._parts(flow):
            total += sums[outlet][groups].sum(axis=0)
        return np.asarray(total / _PER_M3)

    def sum(self, flow: Flow, name: str) -> float:
        """Return the sum of a metric over the buildings with a green roof."""
        adopts = self._groups < self._adopted(flow)
        return sum(
            float(self.metrics[outlet][name][adopts & (self._valves == has_valve)].sum())
            for outlet, has_valve in ((flow.outlet, True), (NONE, False))
        )

    def _adopted(self, flow: Flow) -> int:
        """Return the number of groups that have a green roof."""
        return sum(share <= flow.adoption for share in self.adoption.shares)

    def _parts(self, flow: Flow) -> list[tuple[str, slice]]:
        """Return the outlet and groups of the buildings that adopted, with and without a valve."""
        count, adopted = len(self.adoption.shares), self._adopted(flow)
        return [(flow.outlet, slice(adopted)), (NONE, slice(count, count + adopted))]

    def rows(self) -> list[dict[str, Any]]:
        """Return the results, one row per entry of :attr:`flows`; the names include the units."""
        reference = self._row(AS_IS, {})
        return [self._row(flow, reference) for flow in self.flows]

    def _row(self, flow: Flow, reference: Mapping[str, Any]) -> dict[str, Any]:
        volumes, area = self.discharge(flow), self.area
        wet = float(volumes[self.wet].sum())
        row: dict[str, Any] = {
            **flow._asdict(),
            "buildings": self.adoption.counts[self._adopted(flow) - 1] if flow.adoption else 0,
            "rain_m3": float(self.areas @ self.rain.sum(axis=1)[self._buildings.cells]),
            "discharge_m3": float(volumes.sum()),
            "wet_discharge_m3": wet,
        }
        for weather, where in (("", volumes), ("dry_", np.where(self.wet, 0.0, volumes))):
            for minutes in PEAK_MIN:
                peak = find_peak(Intervals(self.seconds, self.rain[0], where), minutes)
                row[f"{weather}peak_{minutes}min_l_s"] = 1000 * peak
                row[f"{weather}peak_{minutes}min_mm_h"] = 1000 * _HOUR_S * peak / area
        let_out = self.let_out(flow)
        row |= {
            "low_outlet_m3": float(let_out.sum()),
            "wet_low_outlet_m3": float(let_out[self.wet].sum()),
            "low_outlet_peak_5min_mm_h": 1000 * _HOUR_S / area * find_peak(
                Intervals(self.seconds, self.rain[0], let_out), 5
            ),
        }
        if self._capacity is not None:
            beyond = volumes - self._capacity / 1000 / _HOUR_S * area * self.seconds
            hours = self.seconds / _HOUR_S
            row |= {
                "sewer_overflow_m3": float(beyond[beyond > _NOTHING].sum()),
                "sewer_overflow_hours": hours * int((beyond > _NOTHING).sum()),
                "dry_sewer_overflow_m3": float(beyond[(beyond > _NOTHING) & ~self.wet].sum()),
            }
        for name in METRICS:
            row.setdefault(name, self.sum(flow, name))
        row["demand_met_share"] = (
            1 - row["mains_m3"] / row["pumped_m3"] if row["pumped_m3"] else None
        )
        return row | {
            f"{what}_reduction": 1 - row[name] / reference[name]
            for what, name in _REDUCED.items() if reference.get(name)
        }
