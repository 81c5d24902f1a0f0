"""The metrics of many runs at once: those of :mod:`greenroof_ros.model.metrics` on arrays.

They are added up in blocks of ticks, so they need no memory that grows with the length of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.metrics import NEAR_TARGET, find_calendar_days
from greenroof_ros.model.site import Site
from greenroof_ros.model.sites import Sites
from greenroof_ros.model.storm_water import MIN_DEPTH, connected_area

Values = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

_HOUR_S = 3600.0
_PEAKS_MIN = (5, 15, 60)


class Block(NamedTuple):
    """Some ticks of n runs; each array has shape (ticks, n).

    The volumes in the tanks are those at the beginning of a tick, the others move in it (m3).
    """

    roof: Values
    outflow: Values
    pump: Values
    drainage: Values
    evapotranspiration: Values
    limited: Values
    mains: Values
    low_outlet: Values


class Clock(NamedTuple):
    """Runs with the same clock."""

    rows: Rows
    site: Site
    """one of them"""
    start: float
    """of the runs (s since 1970)"""


class BatchMetrics:
    """The metrics of runs in progress."""

    def __init__(
        self, sites: Sites, per_interval: int, wet: Sequence[tuple[Rows, Flags]],
        clocks: Sequence[Clock], groups: NDArray[np.intp] | None = None,
        hydrograph: Values | None = None,
    ) -> None:
        """Start.

        Args:
            sites: n of them, with the same tau.
            per_interval: ticks in an interval of :mod:`greenroof_ros.model.storm_water`.
            wet: rows, and which intervals are in wet weather for them.
            clocks: each row is in one of them.
            groups: number of each row's group; None without a hydrograph.
            hydrograph: where the discharge of each group is added (m3), shape (groups, intervals).
        """
        self._sites, self._tau, self._per_interval = sites, float(sites.tau[0]), per_interval
        self._wet, self._clocks = wet, clocks
        self._groups, self._hydrograph = groups, hydrograph
        self._area: Values = connected_area(cast(Any, sites))  # type: ignore[assignment]
        n = len(sites)
        self._sums = {name: np.zeros(n) for name in (*Block._fields, "overflow")}
        self._counts = {name: np.zeros(n) for name in ("near", "stress")}
        self._discharge, self._wet_discharge = np.zeros(n), np.zeros(n)
        self._day, self._of_day = [0] * len(clocks), np.zeros(n)
        self._overflow_days = np.zeros(n)
        seconds = self._tau * per_interval
        self._windows = [60.0 * minutes / seconds for minutes in _PEAKS_MIN]
        # Before the run nothing flowed.
        self._before = np.zeros((1 + int(max(self._windows)), n))
        self._peaks = np.zeros((len(_PEAKS_MIN), n))

    def add(self, first: int, block: Block) -> None:
        """Add ticks, the first of which begins an interval."""
        self._add_roof(block.roof)
        for name, values in zip(Block._fields[1:], block[1:], strict=True):
            self._sums[name] += values.sum(axis=0)
        flows = block.outflow + (1 - self._sites.drainage_to_cistern) * block.drainage
        flows = np.add.reduceat(flows, range(0, len(flows), self._per_interval), axis=0)
        total = flows.sum(axis=0)
        if total.any():
            self._add_discharge(first // self._per_interval, flows)
            self._discharge += total
        self._add_peaks(flows)
        overflow = block.outflow - block.low_outlet
        if overflow.any():
            self._add_overflow(first, overflow)

    def _add_roof(self, volumes: Values) -> None:
        """Add what depends on the roofs' volumes (m3), shape (ticks, n)."""
        target = self._sites.x2_star
        deviation = np.abs(volumes - target)
        self._sums["roof"] += deviation.sum(axis=0)
        self._counts["near"] += (deviation <= NEAR_TARGET * target).sum(axis=0)
        dry = (volumes < self._sites.stress_volume) | (volumes <= 0)
        self._counts["stress"] += dry.sum(axis=0)

    def _add_discharge(self, first: int, flows: Values) -> None:
        """Add the discharge of intervals (m3), shape (intervals, n)."""
        last = first + len(flows)
        for rows, wet in self._wet:
            now = wet[first:last]
            if now.any():
                self._wet_discharge[rows] += flows[now][:, rows].sum(axis=0)
        if self._groups is not None and self._hydrograph is not None:
            for group in np.unique(self._groups):
                of_group = flows[:, self._groups == group].sum(axis=1)
                self._hydrograph[group, first:last] += of_group

    def _add_peaks(self, flows: Values) -> None:
        """Find the peaks of the windows that end in these intervals.

        The mean of constant pieces is largest where the window begins or ends with one of them.
        """
        both = np.concatenate((self._before, flows))
        kept = len(self._before)
        self._before = both[-kept:]
        if not (both.sum(axis=0) > self._peaks[0]).any():
            return
        volumes = np.concatenate((np.zeros((1, both.shape[1])), np.cumsum(both, axis=0)))
        ends = np.arange(kept + 1, len(volumes))
        for peak, window in zip(self._peaks, self._windows, strict=True):
            whole, part = int(window), window - int(window)
            sums = volumes[ends] - volumes[ends - whole]
            if part:
                # What a piece at the other end of the window adds: after it, or before it.
                after = part * both[ends - whole - 1]
                np.maximum(peak, (sums + after).max(axis=0), out=peak)
                sums = volumes[ends - 1] - volumes[ends - 1 - whole] + part * both[ends - 1]
            np.maximum(peak, sums.max(axis=0), out=peak)

    def _add_overflow(self, first: int, overflow: Values) -> None:
        """Add what leaves through upper outlets in ticks (m3), shape (ticks, n)."""
        self._sums["overflow"] += overflow.sum(axis=0)
        times = self._tau * (first + np.arange(len(overflow), dtype=float))
        for number, (rows, site, start) in enumerate(self._clocks):
            days = find_calendar_days(site, start, times)
            for day in np.unique(days):
                if day != self._day[number]:
                    self._end_day(rows)
                    self._day[number] = day
                self._of_day[rows] += overflow[days == day][:, rows].sum(axis=0)

    def _end_day(self, rows: Rows) -> None:
        """Count a day of overflow where it was one."""
        self._overflow_days[rows] += self._of_day[rows] >= MIN_DEPTH * self._area[rows]
        self._of_day[rows] = 0.0

    def results(
        self, ticks: int, x1: Values, x2: Values, layer: Values, rain: Values
    ) -> dict[str, Values]:
        """Return the metrics of the whole runs, by their names.

        Args:
            ticks: of each run.
            x1: final volume in each cistern (m3).
            x2: on each roof (m3).
            layer: in each drainage layer (m3).
            rain: depth on each site (m).
        """
        sites, sums = self._sites, self._sums
        self._add_roof(x2[None])
        for rows, _, _ in self._clocks:
            self._end_day(rows)
        self._add_peaks(np.zeros_like(self._before))  # after the run nothing flows
        area = self._area
        hours = self._tau / _HOUR_S
        result = {
            "total_deviation_m3": sums["roof"],
            "near_target_hours": self._counts["near"] * hours,
            "mean_deviation_mm": 1000 * sums["roof"] / (ticks + 1) / sites.a2,
            "stress_hours": self._counts["stress"] * hours,
            "mains_m3": sums["mains"],
            "demand_met_share": _share_without(sums["mains"], sums["pump"]),
            "final_cistern_m3": x1,
            "final_roof_m3": x2,
            "final_layer_m3": layer,
            "pumped_m3": sums["pump"],
            "outflow_m3": sums["outflow"],
            "drainage_m3": sums["drainage"],
            "discharge_m3": self._discharge,
            "wet_discharge_m3": self._wet_discharge,
        }
        seconds = self._tau * self._per_interval
        for peak, window, minutes in zip(self._peaks, self._windows, _PEAKS_MIN, strict=True):
            result[f"peak_discharge_{minutes}min_l_s"] = 1000 * peak / (window * seconds)
        for minutes in _PEAKS_MIN:
            depth = result[f"peak_discharge_{minutes}min_l_s"] * _HOUR_S / area
            result[f"peak_discharge_{minutes}min_mm_h"] = depth
        return result | {
            "overflow_m3": sums["overflow"],
            "overflow_days": self._overflow_days,
            "retention_share": _share_without(self._discharge, rain * area),
            "rain_m3": rain * area,
            "rain_cistern_m3": rain * sites.effective_catchment,
            "rain_roof_m3": rain * sites.a2,
            "evapotranspiration_m3": sums["evapotranspiration"],
            "limited_steps": sums["limited"],
        }


def _share_without(part: Values, whole: Values) -> Values:
    """Return the share of a sum that a part of it does not make up, at least 0; NaN of nothing."""
    share = np.divide(part, whole, out=np.full_like(whole, np.nan), where=whole > 0)
    return np.asarray(np.maximum(1 - share, 0.0))
