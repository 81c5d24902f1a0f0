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
        return np.asarray(self._filled(x2, slice(None)) ** 2)

    def _filled(self, x2: Values, rows: Rows) -> Values:
        """Return the filled share of the water that plants can take (1)."""
        sites = self._sites
        share = (x2 - sites.wilting_volume[rows]) / sites.available_volume[rows]
        np.maximum(share, 0.0, out=share)
        share[x2 >= sites.z_cap[rows]] = 1.0
        return np.asarray(share)

    def water_to_raise(self, x2: Values, to: Values, rows: Rows) -> Values:
        """Return the water that raises some of the soils; see :class:`PaperSoils`."""
        filled, reached = self._filled(x2, rows), self._filled(to, rows)
        np.minimum(reached, ALMOST_FULL, out=reached)
        g = np.maximum((reached - filled) / (1 - filled * reached), 0.0)
        first = np.maximum(np.minimum(to, self._sites.wilting_volume[rows]) - x2, 0.0)
        return np.asarray(first + self._sites.available_volume[rows] * np.arctanh(g))

    def percolate(self, x2: Values, arrived: Values, rows: Rows) -> Values:
        """Return what percolates out of some of the soils; see :class:`PaperSoils`."""
        sites, filled, available = self._sites, self._filled(x2, rows), self._sites.available_volume
        first = np.minimum(arrived, np.maximum(sites.wilting_volume[rows] - x2, 0.0))
        g = np.tanh((arrived - first) / available[rows])
        retained = available[rows] * g * (1 - filled * filled)
        retained /= 1 + filled * g
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
