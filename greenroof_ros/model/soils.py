"""The soils of many roofs, as in :mod:`.soil`: the paper's soils or field-capacity soils."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.sites import Sites
from greenroof_ros.physics.soil import ALMOST_FULL

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.intp] | slice
"""selection of some or all sites"""


class PaperSoils:
    """Soils with the model and the parameters of the paper's Table I."""

    def __init__(self, sites: Sites) -> None:
        """Set the sites."""
        self._sites, self._tau = sites, float(sites.tau[0])

    def set_weather(self, potential: Values, raining: bool) -> None:
        """Set the weather for the following ticks.

        Args:
            potential: potential evapotranspiration of each bed in a tick (m3).
            raining: whether it rains on any roof.
        """
        self._potential, self._raining = potential, raining

    def begin(self, x2: Values, evaporated: Values) -> bool:
        """Begin a tick, and write the evapotranspiration that each soil would yield.

        Args:
            x2: volume on each roof (m3).
            evaporated: array to which the evapotranspiration is written (m3).

        Returns:
            Whether there is no rain, all soils are below their capacity, and all of them can supply
            the evapotranspiration.
        """
        evaporated[:], self._x2 = self._potential, x2
        if self._raining:
            return False
        return bool(((x2 < self._sites.z_cap) & (x2 >= self._potential)).all())

    def passing(self, x2: Values) -> Values:
        """Return the share of the arriving water that percolates through each soil (1).

        Args:
            x2: volume on each roof (m3).
        """
        return np.zeros_like(x2)

    def water_to_raise(self, to: Values, rows: Rows) -> Values:
        """Return the water needed to fill selected soils to higher volumes in the tick (m3).

        Args:
            to: volumes to which the soils are filled (m3).
            rows: selection of the roofs.
        """
        return to - self._x2[rows]

    def percolate(self, arrived: Values, rows: Rows) -> Values:
        """Return the volume that percolates through selected soils in the tick (m3).

        The result holds only for soils below their capacity.

        Args:
            arrived: rain and pumped water in the tick (m3).
            rows: selection of the roofs.
        """
        return np.zeros_like(arrived)

    def lose(self, evaporated: Values, arrived: Values) -> tuple[Values, Values, Flags]:
        """Return percolation and evapotranspiration (m3), and a mask of soils that lack water.

        The result is valid in any tick, even with rain or with soils at their capacity.

        Args:
            evaporated: evapotranspiration written by :meth:`begin` (m3).
            arrived: rain and pumped water in the tick (m3).
        """
        sites, tau, x2, above = self._sites, self._tau, self._x2, self._x2 - self._sites.z_cap
        darcy = tau * sites.K * sites.a2 * (x2 / sites.a2 + sites.z_soil) / sites.z_soil
        darcy = np.where(sites.overdraws, np.minimum(darcy, above + arrived), darcy)
        drained = np.where(above < 0, 0.0, darcy)
        demand, available = evaporated + drained, x2 + arrived
        limited = demand > available
        share = np.divide(available, demand, out=np.ones_like(x2), where=limited)
        return share * drained, share * evaporated, limited


class FieldCapacitySoils:
    """Field-capacity soils; the methods are those of :class:`PaperSoils`."""

    def __init__(self, sites: Sites) -> None:
        """Set the sites."""
        self._sites, self._settled = sites, False
        self._drying = sites.stress_onset * sites.available_volume
        self._filled = np.empty(len(sites))
        """filled share of the water that plants can take up, at the beginning of the tick (1)"""

    def set_weather(self, potential: Values, raining: bool) -> None:
        """Set the weather for the following ticks; see :class:`PaperSoils`."""
        self._potential, self._raining, self._settled = potential, raining, False
        self._dries = potential / self._sites.stress_onset

    def begin(self, x2: Values, evaporated: Values) -> bool:
        """Begin a tick, and write the evapotranspiration; see :class:`PaperSoils`."""
        sites, self._x2 = self._sites, x2
        if not (self._raining or self._settled):
            # They stay so in this weather: K_s falls to 0 with the water that plants can take up.
            self._settled = bool((
                (x2 >= sites.wilting_volume) & (x2 < sites.z_cap)
                & (self._potential <= self._drying)
            ).all())
        self._fill(x2, self._filled)
        np.multiply(self._filled, self._dries, out=evaporated)
        np.minimum(evaporated, self._potential, out=evaporated)
        return self._settled

    def passing(self, x2: Values) -> Values:
        """Return the percolating share S^2; see :class:`PaperSoils`."""
        return np.asarray(self._fill(x2, np.empty_like(x2)) ** 2)

    def _fill(self, x2: Values, share: Values) -> Values:
        """Write and return the filled share S of the available water capacity (1)."""
        np.subtract(x2, self._sites.wilting_volume, out=share)
        np.divide(share, self._sites.available_volume, out=share)
        if not self._settled:
            np.maximum(share, 0.0, out=share)
            share[x2 >= self._sites.z_cap] = 1.0
        return share

    def water_to_raise(self, to: Values, rows: Rows) -> Values:
        """Return the water needed to fill the selected soils; see :class:`PaperSoils`."""
        wilting, available = self._sites.wilting_volume[rows], self._sites.available_volume[rows]
        filled, reached = self._filled[rows], to - wilting
        np.divide(reached, available, out=reached)
        np.minimum(reached, ALMOST_FULL, out=reached)
        rest = filled * reached
        np.subtract(1, rest, out=rest)
        g = np.subtract(reached, filled, out=reached)
        np.divide(g, rest, out=g)
        np.maximum(g, 0.0, out=g)
        water = available * np.arctanh(g, out=g)
        if not self._settled:
            water += np.maximum(np.minimum(to, wilting) - self._x2[rows], 0.0)
        return np.asarray(water)

    def percolate(self, arrived: Values, rows: Rows) -> Values:
        """Return the volume that percolates through selected soils; see :class:`PaperSoils`."""
        available, filled = self._sites.available_volume[rows], self._filled[rows]
        if not self._settled:  # the soil keeps the water that raises it to the wilting point
            wilting = self._sites.wilting_volume[rows]
            arrived = arrived - np.minimum(arrived, np.maximum(wilting - self._x2[rows], 0.0))
        g = arrived / available
        np.tanh(g, out=g)
        share = filled * filled
        np.subtract(1, share, out=share)
        share *= g
        g *= filled
        g += 1
        share /= g
        share *= available
        np.subtract(arrived, share, out=share)
        return np.asarray(np.maximum(share, 0.0, out=share))

    def lose(self, evaporated: Values, arrived: Values) -> tuple[Values, Values, Flags]:
        """Return percolation and evapotranspiration; see :class:`PaperSoils`."""
        x2, above = self._x2, self._x2 - self._sites.z_cap
        percolated = self.percolate(arrived, slice(None))
        percolated = np.where(above >= 0, arrived + above, percolated)
        remaining = x2 + arrived - percolated
        limited = evaporated > remaining
        return percolated, np.maximum(np.minimum(evaporated, remaining), 0.0), limited


Soils: TypeAlias = PaperSoils | FieldCapacitySoils


def soils_of(sites: Sites) -> Soils:
    """Return the soils of sites that all have the same kind of soil."""
    return FieldCapacitySoils(sites) if sites.has_field_capacity[0] else PaperSoils(sites)
