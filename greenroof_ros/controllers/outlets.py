"""The policies of :mod:`.outlet` for many sites at once.

Whether the weather is dry depends on the rain alone, so it is known for a whole run.
"""

from __future__ import annotations

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
        rows: the sites.
        dry: whether the weather is dry in each tick, from :func:`find_dry_ticks`.
        ends: of the steps of the forecasts (s from now), the first 0.
        foresee: returns a tick's forecast for the group: rain (m/s), shape (members, steps), and
            evapotranspiration off each bed (m3/s), shape (sites of the batch, steps).
    """

    rows: Rows
    dry: Flags
    ends: Array
    foresee: Callable[[int], tuple[Array, Array]]


def find_dry_ticks(rain: Array, tau: float, wet_after: float) -> Flags:
    """Return in which ticks the weather is dry, as :class:`.outlet.Drain` counts it.

    Args:
        rain: in all ticks of the run (m/s).
        tau: duration of a tick (s).
        wet_after: of the site (h).
    """
    ticks = np.arange(len(rain))
    heavy = np.maximum.accumulate(np.where(rain >= MIN_RAIN, ticks, -1))
    rains = (rain > 0) & (heavy >= 0) & ((ticks - heavy) * tau < _HOUR_S)
    last = np.maximum.accumulate(np.where(rains, ticks, -1))
    return np.asarray(np.maximum(ticks - last - 1, 0) * tau / _HOUR_S >= wet_after)


class Outlets:
    """Decides how far each low outlet is open; one without a valve always is."""

    def __init__(
        self, sites: Sites, policies: Sequence[str], reserves: Array, prices: Array,
        reaches: Array, groups: Sequence[OutletGroup],
    ) -> None:
        """Set the policies; :data:`.outlet.PARAMETERS` has units and meanings.

        Args:
            sites: n of them, with the same tau.
            policies: the name of each; without effect at a site without a valve.
            reserves: ``outlet_reserve`` of each.
            prices: ``outlet_price`` of each.
            reaches: ``outlet_reach`` of each.
            groups: each site is in one of them.
        """
        self._sites, names = sites, np.array(policies)
        self._fixed = np.where(sites.low_outlet_valve & (names != OPEN), 0.0, 1.0)
        moves = sites.low_outlet_valve & np.isin(names, (DRAIN, PLAN))
        self._groups = [(group, group.rows[moves[group.rows]]) for group in groups]
        plans = ((group, rows[names[rows] == PLAN]) for group, rows in self._groups)
        self._plans = [
            (group, rows, PlannedLevels(
                sites.take(rows), group.ends, reserves[rows], prices[rows], reaches[rows]
            )) for group, rows in plans if len(rows)
        ]
        self._volumes = reserves.copy()  # to which the cisterns are drained
        self._low, self._full = sites.a1 * sites.low_outlet_level, sites.tau * sites.c_low

    def command(self, tick: int, x1: Array, x2: Array) -> Array:
        """Return the share to which each low outlet is open (1); call it once in each tick.

        Args:
            tick: its number.
            x1: in each cistern (m3).
            x2: on each roof (m3).
        """
        for group, rows, plans in self._plans:
            self._volumes[rows] = plans.update(bool(group.dry[tick]), lambda: self._observe(
                group, rows, tick, x1, x2  # noqa: B023 - called at once
            ))
        shares = self._fixed
        for group, rows in self._groups:
            if group.dry[tick]:
                held = x1[rows]
                above = held - np.maximum(self._volumes[rows], self._low[rows])
                if (above > 0).any():
                    if shares is self._fixed:
                        shares = self._fixed.copy()
                    shares[rows] = self._drain(rows, held)
        return shares

    def _drain(self, rows: Rows, held: Array) -> Array:
        """Return the shares with which cisterns are not below their volumes after the tick."""
        sites = self._sites
        head = held / sites.a1[rows] - sites.low_outlet_level[rows]
        full = self._full[rows] * np.sqrt(np.maximum(head, 0.0))
        above = np.maximum(held - self._volumes[rows], 0.0)
        share = np.divide(above, full, out=np.zeros_like(full), where=full > 0)
        return np.asarray(np.minimum(share, 1.0))

    def _observe(
        self, group: OutletGroup, rows: Rows, tick: int, x1: Array, x2: Array
    ) -> tuple[Array, Array, Array, Array]:
        rain, evaporated = group.foresee(tick)
        return x1[rows], x2[rows], rain, evaporated[rows]
