"""The policies of :mod:`.outlet`, applied to many sites together.

Dry weather depends only on the rain, so dry ticks are determined in advance for a whole run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.outlet import DRAIN, MIN_RAIN, OPEN, PLAN
from greenroof_ros.controllers.outlet_plan import PlannedLevels
from greenroof_ros.model.sites import Sites

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

_HOUR_S = 3600.0


@dataclass(frozen=True, eq=False)
class OutletGroup:
    """Sites with the same weather and the same ``wet_after``.

    Attributes:
        rows: indices of the sites.
        dry: whether the weather is dry in each tick, from :func:`find_dry_ticks`.
        ends: boundaries of the forecasts' steps (s from now), starting at 0.
        foresee: function that returns a tick's forecast: rain (m/s), shape (members, steps), and
            evapotranspiration of a bed with a crop coefficient of 1 (m/s), shape (steps,).
        has_rain: whether the forecasts contain rain and can therefore change.
    """

    rows: Rows
    dry: Flags
    ends: Array
    foresee: Callable[[int], tuple[Array, Array]]
    has_rain: bool = True


def find_dry_ticks(rain: Array, tau: float, wet_after: float) -> Flags:
    """Return whether the weather is dry in each tick, as :class:`.outlet.Drain` defines it.

    Args:
        rain: rain rate in all ticks of the run (m/s), shape (ticks,).
        tau: duration of a tick (s).
        wet_after: time after rain that counts as wet weather (h).
    """
    ticks = np.arange(len(rain))
    heavy = np.maximum.accumulate(np.where(rain >= MIN_RAIN, ticks, -1))
    rains = (rain > 0) & (heavy >= 0) & ((ticks - heavy) * tau < _HOUR_S)
    last = np.maximum.accumulate(np.where(rains, ticks, -1))
    return np.asarray(~rains & ((ticks - last - 1) * tau / _HOUR_S >= wet_after))


class Outlets:
    """Decides how far to open each low outlet; an outlet without a valve is always open."""

    def __init__(
        self, sites: Sites, policies: Sequence[str], reserves: Array, prices: Array,
        reaches: Array, beds: Array, groups: Sequence[OutletGroup],
    ) -> None:
        """Set the policies; :data:`.outlet.PARAMETERS` describes their parameters, with units.

        Args:
            sites: n sites with the same tau.
            policies: name of each site's policy, which has no effect if the site has no valve.
            reserves: ``outlet_reserve`` of each site.
            prices: ``outlet_price`` of each site.
            reaches: ``outlet_reach`` of each site.
            beds: areas that, with a crop coefficient of 1, evaporate as much as the beds (m2).
            groups: groups of sites; every site is in one group.
        """
        self._sites, names = sites, np.array(policies)
        moves = sites.low_outlet_valve & np.isin(names, (DRAIN, PLAN))
        self._fixed = np.where(sites.low_outlet_valve & (names != OPEN), 0.0, 1.0)
        self._low, self._full = sites.a1 * sites.low_outlet_level, sites.tau * sites.c_low
        self._volumes = reserves.copy()  # volumes to which the cisterns are drained
        # Volume above which each valve opens in the current weather.
        self._opens_above = np.full(len(sites), math.inf)
        self._moving = [
            _Moving(group, rows) for group in groups if len(rows := group.rows[moves[group.rows]])
        ]
        self._planning = [
            (_Moving(group, rows), PlannedLevels(
                sites.take(rows), group.ends, reserves[rows], prices[rows], reaches[rows],
                beds[rows], **({} if group.has_rain else {"check_s": math.inf}),
            ))
            for group in groups
            if len(rows := group.rows[moves[group.rows] & (names[group.rows] == PLAN)])
        ]

    def command(self, tick: int, x1: Array, x2: Array) -> Array:
        """Return the share to which each low outlet is open (1); call this once in every tick.

        While no valve opens, the same array is returned every time.

        Args:
            tick: number of the tick.
            x1: volume in each cistern (m3).
            x2: volume on each roof (m3).
        """
        for planning, plans in self._planning:
            group, rows, dry = planning.group, planning.rows, bool(planning.group.dry[tick])
            levels = plans.update(dry, lambda: (
                x1[rows], x2[rows], *group.foresee(tick)  # noqa: B023 - called immediately
            ))
            if levels is not planning.levels:
                planning.levels = self._volumes[rows] = levels
                self._set_dry(rows, dry)
        for moving in self._moving:
            dry = bool(moving.group.dry[tick])
            if dry != moving.dry:
                moving.dry = dry
                self._set_dry(moving.rows, dry)
        rows = (x1 > self._opens_above).nonzero()[0]
        if not len(rows):
            return self._fixed
        sites, shares = self._sites, self._fixed.copy()
        head = x1[rows] / sites.a1[rows] - sites.low_outlet_level[rows]
        full = self._full[rows] * np.sqrt(np.maximum(head, 0.0))
        above = np.maximum(x1[rows] - self._volumes[rows], 0.0)
        share = np.divide(above, full, out=np.zeros_like(full), where=full > 0)
        shares[rows] = np.minimum(share, 1.0)
        return shares

    def _set_dry(self, rows: Rows, dry: bool) -> None:
        """Set whether the weather is dry at some sites."""
        opens = np.maximum(self._volumes[rows], self._low[rows])
        self._opens_above[rows] = opens if dry else math.inf


@dataclass(eq=False)
class _Moving:
    """The sites of a group whose valves open and close."""

    group: OutletGroup
    rows: Rows
    dry: bool = False
    levels: Array | None = None
