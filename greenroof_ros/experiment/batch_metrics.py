"""The metrics of :mod:`greenroof_ros.results.metrics`, computed on arrays for many runs together.

The metrics are added up tick by tick, and discharges in blocks, so that the memory needed does not
grow with the length of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.plants import Moved, Plants
from greenroof_ros.physics.storm_water import MIN_DEPTH, connected_area
from greenroof_ros.results.metrics import NEAR_TARGET, find_calendar_days
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

_HOUR_S = 3600.0
_PEAKS_MIN = (5, 15, 60)
_MAX_BYTE = 255
# Number of discharges that are kept until they are added up.
_VALUES = 400_000


class Clock(NamedTuple):
    """Runs with the same clock."""

    rows: Rows
    site: Site
    """one of the sites"""
    start: float
    """start of the runs (s since 1970)"""


class BatchMetrics:
    """The metrics of runs in progress, tick by tick."""

    def __init__(
        self, plants: Plants, ticks: int, per_interval: int, wet: Sequence[tuple[Rows, Flags]],
        clocks: Sequence[Clock], groups: Rows | None = None, hydrograph: Values | None = None,
        low_outlet: Values | None = None,
    ) -> None:
        """Start with the initial state.

        Args:
            plants: cisterns and roofs of n sites.
            ticks: number of steps of the runs, N.
            per_interval: ticks in an interval of :mod:`greenroof_ros.physics.storm_water`.
            wet: groups of rows, and whether their weather is wet in each interval.
            clocks: groups of runs with the same clock; every row is in one group.
            groups: index of each row's group; None without a hydrograph.
            hydrograph: array to which each group's discharge is added (m3), shape (groups,
                intervals).
            low_outlet: array to which the part of the discharge through low outlets is added, of
                the same shape.
        """
        self._plants, self._sites = plants, (sites := plants.sites)
        self._tau, self._per_interval, n = float(sites.tau[0]), per_interval, len(sites)
        self._area: Values = connected_area(cast(Any, sites))  # type: ignore[assignment]
        self._sums = np.zeros((len(Moved._fields), n))
        self._deviation, self._near, self._stress = np.zeros((3, n))
        # Ticks since the counts were last added, in bytes: numpy adds them quickly.
        self._near_now, self._stress_now = np.zeros((2, n), np.uint8)
        self._near_deviation = NEAR_TARGET * sites.x2_star
        # Without a stress volume, plants lack water only on an empty roof.
        self._stress_below = np.maximum(sites.stress_volume, np.nextafter(0.0, 1.0))
        self._of_day, self._overflow_days = np.zeros((2, n))
        self._midnights = _find_midnights(clocks, self._tau, ticks)
        self._wet, self._groups = wet, list[tuple[int, Rows]]()
        if groups is not None:
            self._groups += [(n, np.flatnonzero(groups == n)) for n in np.unique(groups).tolist()]
        self._hydrograph, self._low_outlet = hydrograph, low_outlet
        self._discharge, self._wet_discharge = np.zeros((2, n))
        self._to_sewer = 1 - sites.drainage_to_cistern
        self._peaks = np.zeros((len(_PEAKS_MIN), n))
        seconds = self._tau * per_interval
        self._windows = [60.0 * minutes / seconds for minutes in _PEAKS_MIN]
        # Discharge in the last intervals (m3); before the run nothing flowed.
        self._before = 1 + int(max(self._windows))
        self._flows = np.zeros((self._before + max(1, _VALUES // n), n))
        self._low_flows = np.zeros_like(self._flows)  # the part of it through low outlets
        self._filled, self._interval = self._before, 0
        self._work, self._flag = np.empty(n), np.empty(n, bool)
        self._add_roof(0)

    def add(self, tick: int) -> None:
        """Add the water that moved in a tick, and the state at its end."""
        plants = self._plants
        moved, row, low = plants.moved, self._flows[self._filled], self._low_flows[self._filled]
        np.add(self._sums, plants.all_moved, out=self._sums)
        if tick % self._per_interval == 0:
            np.multiply(self._to_sewer, moved.drainage, out=row)
            low.fill(0.0)
        else:
            row += self._to_sewer * moved.drainage
        if tick in self._midnights:
            self._end_day(self._midnights[tick])
        if plants.flowed:
            row += moved.outflow
            low += moved.low_outlet
            self._of_day += moved.outflow - moved.low_outlet
        self._add_roof(tick + 1)
        if (tick + 1) % self._per_interval == 0:
            self._filled += 1
            if self._filled == len(self._flows):
                self._add_intervals()

    def _add_roof(self, tick: int) -> None:
        """Add the metrics that depend on the roofs' volumes at the beginning of a tick."""
        x2, flag = self._plants.x2, self._flag
        deviation = np.subtract(x2, self._sites.x2_star, out=self._work)
        np.absolute(deviation, out=deviation)
        np.add(self._deviation, deviation, out=self._deviation)
        np.less_equal(deviation, self._near_deviation, out=flag)
        np.add(self._near_now, flag.view(np.uint8), out=self._near_now)
        np.less(x2, self._stress_below, out=flag)
        np.add(self._stress_now, flag.view(np.uint8), out=self._stress_now)
        if tick % _MAX_BYTE == 0:
            self._add_counts()

    def _add_counts(self) -> None:
        self._near += self._near_now
        self._stress += self._stress_now
        self._near_now[:] = self._stress_now[:] = 0

    def _add_intervals(self) -> None:
        """Add the discharge of all complete intervals."""
        before = self._before
        flows = self._flows[before : self._filled]
        first, last = self._interval, self._interval + len(flows)
        self._discharge += flows.sum(axis=0)
        for rows, wet in self._wet:
            now = wet[first:last]
            if now.any():
                of_rows = flows[now] if len(rows) == flows.shape[1] else flows[now][:, rows]
                self._wet_discharge[rows] += of_rows.sum(axis=0)
        for hydrograph, values in (
            (self._hydrograph, flows), (self._low_outlet, self._low_flows[before : self._filled])
        ):
            if hydrograph is not None:
                for group, rows in self._groups:
                    hydrograph[group, first:last] += values.take(rows, axis=1).sum(axis=1)
        self._find_peaks(self._flows[: self._filled])
        self._flows[:before] = self._flows[self._filled - before : self._filled]
        self._filled, self._interval = before, last

    def _find_peaks(self, flows: Values) -> None:
        """Update the peaks (m3) from the windows that end within the given intervals.

        The flow is piecewise constant, so its mean over a window is largest if the window begins or
        ends at the boundary of a piece.
        """
        highest = np.multiply.outer(self._windows, flows.max(axis=0))
        rows = np.flatnonzero((highest > self._peaks).any(axis=0))
        if not len(rows):
            return
        flows, before = flows.take(rows, axis=1), self._before
        volumes = np.zeros((len(flows) + 1, len(rows)))
        for above, flow, volume in zip(volumes, flows, volumes[1:], strict=False):
            np.add(above, flow, out=volume)  # in a fifth of the time of cumsum
        count = len(flows) - before
        for peak, window in zip(self._peaks, self._windows, strict=True):
            whole, part = int(window), window - int(window)
            # The volume of whole intervals up to each end, and of the one before or after them.
            end = volumes[before + 1 - whole :][:count]
            sums = volumes[before + 1 :] - end
            largest = (sums + part * flows[before - whole :][:count]).max(axis=0)
            if part:
                sums = volumes[before:-1] - volumes[before - whole :][:count]
                largest = np.maximum(largest, (sums + part * flows[before:]).max(axis=0))
            peak[rows] = np.maximum(peak[rows], largest)

    def _end_day(self, rows: Rows) -> None:
        """Count the day as a day of overflow for the runs in which the cistern overflowed."""
        self._overflow_days[rows] += self._of_day[rows] >= MIN_DEPTH * self._area[rows]
        self._of_day[rows] = 0.0

    def results(self, ticks: int, rain: Values) -> dict[str, Values]:
        """Return the metrics of the whole runs, by name.

        Args:
            ticks: number of steps of the runs, N.
            rain: depth of rain on each site (m).
        """
        plants, sites, sums, area = self._plants, self._sites, Moved(*self._sums), self._area
        self._add_counts()
        self._end_day(np.arange(len(sites)))
        self._filled += ticks % self._per_interval > 0
        if self._filled > self._before:
            self._add_intervals()
        # After the run nothing flows.
        self._find_peaks(np.concatenate((
            self._flows[: self._before], np.zeros((self._before, len(sites)))
        )))
        hours, seconds = self._tau / _HOUR_S, self._tau * self._per_interval
        peaks = [
            1000 * peak / (window * seconds)
            for peak, window in zip(self._peaks, self._windows, strict=True)
        ]
        return {
            "total_deviation_m3": self._deviation,
            "near_target_hours": self._near * hours,
            "mean_deviation_mm": 1000 * self._deviation / (ticks + 1) / sites.a2,
            "stress_hours": self._stress * hours,
            "mains_m3": sums.mains,
            "demand_met_share": _share_without(sums.mains, sums.pump),
            "final_cistern_m3": plants.x1,
            "final_roof_m3": plants.x2,
            "final_layer_m3": plants.layer,
            "pumped_m3": sums.pump,
            "outflow_m3": sums.outflow,
            "drainage_m3": sums.drainage,
            "discharge_m3": self._discharge,
            "wet_discharge_m3": self._wet_discharge,
            **{
                f"peak_discharge_{minutes}min_l_s": peak
                for minutes, peak in zip(_PEAKS_MIN, peaks, strict=True)
            },
            **{
                f"peak_discharge_{minutes}min_mm_h": peak * _HOUR_S / area
                for minutes, peak in zip(_PEAKS_MIN, peaks, strict=True)
            },
            "overflow_m3": sums.outflow - sums.low_outlet,
            "overflow_days": self._overflow_days,
            "retention_share": _share_without(self._discharge, rain * area),
            "rain_m3": rain * area,
            "rain_cistern_m3": rain * sites.effective_catchment,
            "rain_roof_m3": rain * sites.a2,
            "evapotranspiration_m3": sums.evapotranspiration,
            "limited_steps": sums.limited,
        }


def _find_midnights(clocks: Sequence[Clock], tau: float, ticks: int) -> dict[int, Rows]:
    """Return the ticks in which a calendar day begins, each with the rows for which it begins."""
    midnights: dict[int, list[Rows]] = {}
    times = tau * np.arange(ticks, dtype=float)
    for rows, site, start in clocks:
        days = find_calendar_days(site, start, times)
        for tick in (1 + np.flatnonzero(np.diff(days))).tolist():
            midnights.setdefault(tick, []).append(rows)
    return {tick: np.concatenate(rows) for tick, rows in midnights.items()}


def _share_without(part: Values, whole: Values) -> Values:
    """Return the share of a total that is outside a part, at least 0; NaN if the total is zero."""
    share = np.divide(part, whole, out=np.full_like(whole, np.nan), where=whole > 0)
    return np.asarray(np.maximum(1 - share, 0.0))
