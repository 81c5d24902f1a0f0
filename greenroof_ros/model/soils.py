"""The soils of many roofs, as in :mod:`.soil`: all the paper's, or all measured."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.sites import Sites
from greenroof_ros.model.soil import ALMOST_FULL

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.intp] | slice
"""some of the sites, or all"""


class PaperSoils:
    """Those of Table I."""

    def __init__(self, sites: Sites) -> None:
        """Set the sites."""
        self._sites, self._tau = sites, float(sites.tau[0])

    def set_weather(self, potential: Values, raining: bool) -> None:
        """Set the weather of the ticks that follow.

        Args:
            potential: evapotranspiration off each bed in a tick (m3), of plants that lack no water.
            raining: whether it rains anywhere.
        """
        self._potential, self._raining = potential, raining

    def begin(self, x2: Values, evaporated: Values) -> bool:
        """Write the evapotranspiration that each soil would yield in a tick; call it in each.

        Args:
            x2: on each roof (m3).
            evaporated: where it is written (m3).

        Returns:
            Whether it does not rain, each soil is below its capacity, and it has that much.
        """
        evaporated[:] = self._potential
        if self._raining:
            return False
        return bool(((x2 < self._sites.z_cap) & (x2 >= self._potential)).all())

    def passing(self, x2: Values) -> Values:
        """Return the share of the arriving water that passes each soil, at volumes (m3) (1)."""
        return np.zeros_like(x2)

    def water_to_raise(self, x2: Values, to: Values, rows: Rows) -> Values:
        """Return the water that raises some of the soils from x2 to a higher volume (m3)."""
        return to - x2

    def percolate(self, x2: Values, arrived: Values, rows: Rows) -> Values:
        """Return what percolates out of some of the soils in a tick (m3), none at its capacity.

        Args:
            x2: on the roofs (m3).
            arrived: rain and pumped water in the tick (m3).
            rows: which roofs.
        """
        return np.zeros_like(arrived)

    def lose(self, x2: Values, evaporated: Values, arrived: Values) -> tuple[Values, Values, Flags]:
        """Return percolation and evapotranspiration in any tick (m3), and where they are limited.

        Args:
            x2: on each roof (m3).
            evaporated: what :meth:`begin` returned (m3).
            arrived: rain and pumped water in the tick (m3).
        """
        sites, tau, above = self._sites, self._tau, x2 - self._sites.z_cap
        darcy = tau * sites.K * sites.a2 * (x2 / sites.a2 + sites.z_soil) / sites.z_soil
        darcy = np.where(sites.overdraws, np.minimum(darcy, above + arrived), darcy)
        drained = np.where(above < 0, 0.0, darcy)
        demand, available = evaporated + drained, x2 + arrived
        limited = demand > available
        share = np.divide(available, demand, out=np.ones_like(x2), where=limited)
        return share * drained, share * evaporated, limited


class MeasuredSoils:
    """Substrates; the methods are those of :class:`PaperSoils`."""

    def __init__(self, sites: Sites) -> None:
        """Set the sites."""
        self._sites, self._settled = sites, False
        self._drying = sites.stress_onset * sites.available_volume
        self._volumes = np.stack((sites.wilting_volume, sites.available_volume, sites.z_cap))
        self._rows: Rows | None = None

    def set_weather(self, potential: Values, raining: bool) -> None:
        """Set the weather; see :class:`PaperSoils`."""
        self._potential, self._raining, self._settled = potential, raining, False

    def begin(self, x2: Values, evaporated: Values) -> bool:
        """Write evapotranspiration; see :class:`PaperSoils`."""
        sites = self._sites
        if not (self._raining or self._settled):
            # They remain so in this weather: K_s falls to 0 with what plants can take.
            self._settled = bool((
                (x2 >= sites.wilting_volume) & (x2 < sites.z_cap)
                & (self._potential <= self._drying)
            ).all())
        share = np.subtract(x2, sites.wilting_volume, out=evaporated)
        np.divide(share, self._drying, out=share)
        np.minimum(share, 1.0, out=share)
        if not self._settled:
            np.maximum(share, 0.0, out=share)
        np.multiply(share, self._potential, out=evaporated)
        return self._settled

    def passing(self, x2: Values) -> Values:
        """Return S^2; see :class:`PaperSoils`."""
        return np.asarray(self._fill(x2, *self._volumes) ** 2)

    def _take(self, rows: Rows) -> tuple[Values, Values, Values]:
        """Return wilting, available and full volume of some soils (m3)."""
        if rows is not self._rows:
            self._rows, self._taken = rows, self._volumes[:, rows]
        wilting, available, full = self._taken
        return wilting, available, full

    def _fill(self, x2: Values, wilting: Values, available: Values, full: Values) -> Values:
        """Return the filled share of the water that plants can take (1)."""
        share = (x2 - wilting) / available
        if not self._settled:
            np.maximum(share, 0.0, out=share)
            share[x2 >= full] = 1.0
        return np.asarray(share)

    def water_to_raise(self, x2: Values, to: Values, rows: Rows) -> Values:
        """Return the water that raises some of the soils; see :class:`PaperSoils`."""
        volumes = self._take(rows)
        filled, reached = self._fill(x2, *volumes), self._fill(to, *volumes)
        np.minimum(reached, ALMOST_FULL, out=reached)
        g = np.maximum((reached - filled) / (1 - filled * reached), 0.0)
        water = volumes[1] * np.arctanh(g)
        if not self._settled:
            water += np.maximum(np.minimum(to, volumes[0]) - x2, 0.0)
        return np.asarray(water)

    def percolate(self, x2: Values, arrived: Values, rows: Rows) -> Values:
        """Return what percolates out of some of the soils; see :class:`PaperSoils`."""
        wilting, available, full = self._take(rows)
        filled, first = self._fill(x2, wilting, available, full), np.zeros(1)
        if not self._settled:
            first = np.minimum(arrived, np.maximum(wilting - x2, 0.0))
        g = np.tanh((arrived - first) / available)
        retained = available * g * (1 - filled * filled) / (1 + filled * g)
        return np.asarray(np.maximum(arrived - (first + retained), 0.0))

    def lose(self, x2: Values, evaporated: Values, arrived: Values) -> tuple[Values, Values, Flags]:
        """Return percolation and evapotranspiration; see :class:`PaperSoils`."""
        above = x2 - self._sites.z_cap
        percolated = self.percolate(x2, arrived, slice(None))
        percolated = np.where(above >= 0, arrived + above, percolated)
        remaining = x2 + arrived - percolated
        limited = evaporated > remaining
        return percolated, np.maximum(np.minimum(evaporated, remaining), 0.0), limited


Soils: TypeAlias = PaperSoils | MeasuredSoils


def soils_of(sites: Sites) -> Soils:
    """Return the soils of sites of one kind."""
    return MeasuredSoils(sites) if sites.measured[0] else PaperSoils(sites)
