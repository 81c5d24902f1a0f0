"""The soils of many roofs, as in :mod:`.soil`: all the paper's, or all measured.

In dry weather a soil is **settled**: it has less water than its capacity, and no less than
evaporates. Then formulas need no cases, and work in place.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.sites import Sites
from greenroof_ros.model.soil import ALMOST_FULL

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]


class PaperSoils:
    """Those of Table I. The methods are called in the order in which they are here, once a tick."""

    def __init__(self, sites: Sites) -> None:
        """Set the sites."""
        self._sites, self._tau = sites, float(sites.tau[0])

    def begin(self, x2: Values, potential: Values, raining: bool) -> Values:
        """Begin a tick; return the evapotranspiration that the soil would yield (m3/s).

        Args:
            x2: on each roof (m3).
            potential: evapotranspiration off each bed (m3/s), of plants that lack no water.
            raining: whether it rains anywhere.
        """
        self._x2, self._potential = x2, potential
        self._settled = not raining and bool(
            ((x2 < self._sites.z_cap) & (x2 >= self._tau * potential)).all()
        )
        return potential

    def water_to_raise(self, to: Values) -> Values:
        """Return the water that raises each soil to a volume (m3)."""
        return to - self._x2

    def lose(self, arriving: Values | None) -> tuple[Values | None, Values, Flags | None]:
        """Return percolation and evapotranspiration (m3/s), and where they are limited.

        Args:
            arriving: rain and pumped water (m3/s); None for none.
        """
        sites, x2, tau, potential = self._sites, self._x2, self._tau, self._potential
        if self._settled:
            return None, potential, None
        arriving = np.zeros_like(x2) if arriving is None else arriving
        available = x2 / tau + arriving
        above = x2 - sites.z_cap
        darcy = sites.K * sites.a2 * (x2 / sites.a2 + sites.z_soil) / sites.z_soil
        darcy = np.where(sites.overdraws, np.minimum(darcy, above / tau + arriving), darcy)
        drainage = np.where(above < 0, 0.0, darcy)
        demand = potential + drainage
        limited = demand > available
        share = np.divide(available, demand, out=np.ones_like(x2), where=limited)
        return share * drainage, share * potential, limited


class MeasuredSoils:
    """Substrates; the methods are those of :class:`PaperSoils`."""

    def __init__(self, sites: Sites) -> None:
        """Set the sites."""
        self._sites, self._tau = sites, float(sites.tau[0])
        self._settled = False
        self._filled, self._evaporated, *self._work = np.empty((5, len(sites)))
        self._weather = np.empty(0)

    def begin(self, x2: Values, potential: Values, raining: bool) -> Values:
        """Begin a tick; see :class:`PaperSoils`."""
        self._x2, sites = x2, self._sites
        # Once settled a soil remains so until it rains, or more can evaporate.
        if raining or potential is not self._weather or not self._settled:
            self._weather = potential
            decays = self._tau * potential <= sites.stress_onset * sites.available_volume
            self._settled = not raining and bool(
                ((x2 >= sites.wilting_volume) & (x2 < sites.z_cap) & decays).all()
            )
        self._fill(x2, self._filled)
        stress = np.divide(self._filled, sites.stress_onset, out=self._evaporated)
        np.minimum(stress, 1.0, out=stress)
        return np.multiply(potential, stress, out=stress)

    def _fill(self, x2: Values, out: Values) -> Values:
        """Write the filled share at volumes (m3)."""
        sites = self._sites
        np.subtract(x2, sites.wilting_volume, out=out)
        np.divide(out, sites.available_volume, out=out)
        if not self._settled:
            np.maximum(out, 0.0, out=out)
            out[x2 >= sites.z_cap] = 1.0
        return out

    def water_to_raise(self, to: Values) -> Values:
        """Return the water that raises each soil to a volume (m3)."""
        sites, filled, (reached, part, _) = self._sites, self._filled, self._work
        np.minimum(self._fill(to, reached), ALMOST_FULL, out=reached)
        np.multiply(filled, reached, out=part)
        np.subtract(1, part, out=part)
        g = np.subtract(reached, filled, out=reached)
        np.divide(g, part, out=g)
        if not self._settled:
            np.maximum(g, 0.0, out=g)
        np.arctanh(g, out=g)
        water = np.multiply(sites.available_volume, g, out=g)
        if not self._settled:
            water += np.maximum(np.minimum(to, sites.wilting_volume) - self._x2, 0.0)
        return water

    def lose(self, arriving: Values | None) -> tuple[Values | None, Values, Flags | None]:
        """Return percolation and evapotranspiration; see :class:`PaperSoils`."""
        sites, x2, tau = self._sites, self._x2, self._tau
        if self._settled:
            return None if arriving is None else self._percolate(arriving), self._evaporated, None
        arriving = np.zeros_like(x2) if arriving is None else arriving
        above = arriving + (x2 - sites.z_cap) / tau
        percolated = np.where(x2 >= sites.z_cap, above, self._percolate(arriving))
        remaining = x2 / tau + arriving - percolated
        limited = self._evaporated > remaining
        evaporated = np.where(limited, np.maximum(remaining, 0.0), self._evaporated)
        return percolated, evaporated, limited

    def _percolate(self, arriving: Values) -> Values:
        """Return the percolation out of each substrate that is not full (m3/s)."""
        sites, filled, (g, part, retained) = self._sites, self._filled, self._work
        first: Values | float = 0.0
        np.multiply(arriving, self._tau, out=g)
        if not self._settled:
            first = np.minimum(g, np.maximum(sites.wilting_volume - self._x2, 0.0))
            g -= first
        np.divide(g, sites.available_volume, out=g)
        np.tanh(g, out=g)
        np.multiply(filled, filled, out=part)
        np.subtract(1, part, out=part)
        np.multiply(sites.available_volume, g, out=retained)
        np.multiply(retained, part, out=retained)
        np.multiply(filled, g, out=part)
        np.add(1, part, out=part)
        np.divide(retained, part, out=retained)
        if not self._settled:
            retained += first
        np.divide(retained, self._tau, out=retained)
        np.subtract(arriving, retained, out=retained)
        return np.maximum(retained, 0.0, out=retained)


Soils: TypeAlias = PaperSoils | MeasuredSoils


def soils_of(sites: Sites) -> Soils:
    """Return the soils of sites of one kind."""
    return MeasuredSoils(sites) if sites.measured[0] else PaperSoils(sites)
