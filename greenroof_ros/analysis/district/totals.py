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
# Metrics of the buildings whose sums are results, in addition to the mains water.
_ADDED = ("overflow_m3", "overflow_days", "pumped_m3", "stress_hours")


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
        self, buildings: Buildings, adoption: Adoption, outlets: Sequence[str], seconds: float,
        rain: Values, wet: NDArray[np.bool_], capacity: float | None,
    ) -> None:
        """Initialize all sums to zero.

        Args:
            buildings: all buildings.
            adoption: groups of the buildings.
            outlets: kinds of outlet, including ``none``.
            seconds: duration of an interval (s).
            rain: depth of rain in each cell and interval (m), shape (cells, intervals).
            wet: whether the weather is wet in any cell in each interval, shape (intervals,).
            capacity: capacity of the sewer per unit of connected area (mm/h); None if unknown.
        """
        self.outlets, self.adoption = outlets, adoption
        self.seconds, self.rain, self.wet = seconds, rain, wet
        self._capacity, self._buildings = capacity, buildings
        self._groups = adoption.groups(buildings.ranks)
        self._valves = adoption.have_valve(buildings.ranks)
        count = len(adoption.shares)
        self.areas = np.zeros(len(buildings))
        """connected area of each building (m2)"""
        self._volumes = {
            outlet: np.zeros((count * (1 + (outlet == NONE)), 2, rain.shape[1]), np.int64)
            for outlet in outlets
        }
        self.metrics = {
            outlet: {name: np.full(len(buildings), np.nan) for name in METRICS}
            for outlet in outlets
        }
        """metrics of each building, by outlet and name"""

    def add(self, places: slice, result: PartResult) -> None:
        """Add the result of a part; no building may be added twice with the same outlet.

        Args:
            places: positions of the part's buildings.
            result: result of the part.
        """
        self.areas[places] = result.areas
        for outlet, hydrographs in result.hydrographs.items():
            for sums, volumes in zip(self._volumes[outlet], hydrographs, strict=False):
                sums += np.rint(volumes * _PER_M3).astype(np.int64)
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
        return np.asarray(self._add_groups(flow, 0) + areas @ self.rain)

    def let_out(self, flow: Flow) -> Values:
        """Return the water from low outlets in each interval (m3), shape (intervals,)."""
        return self._add_groups(flow, 1)

    def _add_groups(self, flow: Flow, quantity: int) -> Values:
        count, adopted = len(self.adoption.shares), self._adopted(flow)
        total = np.zeros(self.rain.shape[1], np.int64)
        # Of the buildings that adopted, those with and those without a valve.
        for outlet, first in ((flow.outlet, 0), (NONE, count)):
            total += self._volumes[outlet][first : first + adopted, quantity].sum(axis=0)
        return np.asarray(total / _PER_M3)

    def values(self, flow: Flow, name: str) -> Values:
        """Return a metric of the buildings with a green roof, shape (buildings,)."""
        own, without = (self.metrics[outlet][name] for outlet in (flow.outlet, NONE))
        adopts = self._groups < self._adopted(flow)
        return np.asarray(np.where(self._valves, own, without)[adopts])

    def _adopted(self, flow: Flow) -> int:
        """Return the number of groups that have a green roof."""
        return sum(share <= flow.adoption for share in self.adoption.shares)

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
                peak = find_peak(where, self.seconds, minutes)
                row[f"{weather}peak_{minutes}min_l_s"] = 1000 * peak
                row[f"{weather}peak_{minutes}min_mm_h"] = 1000 * _HOUR_S * peak / area
        let_out = self.let_out(flow)
        row |= {
            "low_outlet_m3": float(let_out.sum()),
            "wet_low_outlet_m3": float(let_out[self.wet].sum()),
            "low_outlet_peak_5min_mm_h": (
                1000 * _HOUR_S / area * find_peak(let_out, self.seconds, 5)
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
        for name in _ADDED:
            row[name] = float(self.values(flow, name).sum())
        if not np.isnan(self.metrics[NONE]["mains_m3"]).all():  # the cisterns have mains water
            pumped, met = (self.values(flow, name) for name in ("pumped_m3", "demand_met_share"))
            row["mains_m3"] = float(self.values(flow, "mains_m3").sum())
            # A building that pumps nothing has no share, and no part in that of all.
            row["demand_met_share"] = (
                float(np.nansum(pumped * met)) / row["pumped_m3"] if row["pumped_m3"] else None
            )
        return row | {
            f"{what}_reduction": 1 - row[name] / reference[name]
            for what, name in _REDUCED.items() if reference.get(name)
        }


def find_peak(volumes: Values, seconds: float, minutes: float) -> float:
    """Return the highest mean of a flow over a number of minutes (m3/s).

    The window may begin at any time, as for the peaks in :mod:`.results.sums`.

    Args:
        volumes: volume in each interval (m3), shape (intervals,).
        seconds: duration of an interval (s).
        minutes: width of the window (min).
    """
    window, edges = 60 * minutes, seconds * np.arange(len(volumes) + 1.0)
    total = np.append(0.0, np.cumsum(volumes))
    # The mean of constant pieces is largest where the window begins or ends with one of them.
    starts = np.concatenate((edges - window, edges))
    sums = np.interp(starts + window, edges, total) - np.interp(starts, edges, total)
    return float(sums.max()) / window
