"""The two soils over steps of any length, at many volumes at once: for whoever plans ahead.

What :mod:`greenroof_ros.model.plant` does in ticks is solved here for a step in which rain comes
first, at one rate, and evapotranspiration after it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.site import Site

Array = NDArray[np.float64]

# Where an infinite volume must be pumped to reach field capacity, so much (of TAW) is counted.
_ALMOST_FULL = 1 - 1e-9


class Soil(Protocol):
    """What a roof does with water. Volumes are in m3, of any shapes that go together."""

    def after(self, x2: Array, arriving: Array | float, asked: float, seconds: float) -> Array:
        """Return what the roof holds after a step.

        Args:
            x2: what it holds before.
            arriving: rain and pumped water in the step.
            asked: what would evaporate from plants that lack no water.
            seconds: the step's length.
        """
        ...

    def pumped(self, x2: Array) -> Array:
        """Return what must be pumped onto an empty roof until it holds x2."""
        ...

    def filled(self, pumped: Array) -> Array:
        """Return what an empty roof holds when so much has been pumped onto it."""
        ...


class PaperSoil:
    """Eqs. (1) and (4): it keeps all below ``z_cap``, and drains above."""

    def __init__(self, site: Site) -> None:
        self._capacity = site.z_cap
        self._conductance = site.K / site.z_soil  # 1/s
        self._bottom = site.a2 * site.z_soil

    def after(self, x2: Array, arriving: Array | float, asked: float, seconds: float) -> Array:
        """See :meth:`Soil.after`; what stands above ``z_cap`` drains at the end of the step."""
        left = x2 + (arriving - asked)
        drained = self._conductance * (left + self._bottom) * seconds
        left = np.minimum(left, np.maximum(left - drained, self._capacity))
        return np.maximum(left, 0.0)

    def pumped(self, x2: Array) -> Array:
        """All stays."""
        return x2

    def filled(self, pumped: Array) -> Array:
        """All stays."""
        return pumped


class MeasuredSoil:
    """The substrate of :mod:`greenroof_ros.model.soil`: it keeps 1 - S^2 of what arrives."""

    def __init__(self, site: Site) -> None:
        self._wilting, self._available = site.wilting_volume, site.available_volume
        self._drying = site.stress_onset * site.available_volume

    def after(self, x2: Array, arriving: Array | float, asked: float, seconds: float) -> Array:
        """See :meth:`Soil.after`: dS/dt = (1 - S^2) i / TAW, and then decay below the stress."""
        wilting, available = self._wilting, self._available
        held = x2
        if np.any(arriving):
            first = np.minimum(arriving, np.maximum(wilting - x2, 0.0))
            share = np.minimum(np.maximum((x2 - wilting) / available, 0.0), 1.0)
            gained = np.tanh((arriving - first) / available)
            wet = (share + gained) / (1 + share * gained)
            held = np.minimum(x2, wilting) + first + available * wet
        easy = np.minimum(np.maximum(held - (wilting + self._drying), 0.0), asked)
        held = held - easy
        lost = np.expm1((easy - asked) / self._drying)
        return np.asarray(held + np.maximum(held - wilting, 0.0) * lost)

    def pumped(self, x2: Array) -> Array:
        """Return w of :func:`greenroof_ros.model.soil.water_to_fill`."""
        share = np.clip((x2 - self._wilting) / self._available, 0.0, _ALMOST_FULL)
        return np.minimum(x2, self._wilting) + self._available * np.arctanh(share)

    def filled(self, pumped: Array) -> Array:
        """Return its inverse."""
        more = np.maximum(pumped - self._wilting, 0.0) / self._available
        return np.minimum(pumped, self._wilting) + self._available * np.tanh(more)


def make_soil(site: Site) -> Soil:
    """Return the soil of a site: a measured one where its file has a field capacity."""
    return PaperSoil(site) if site.field_capacity is None else MeasuredSoil(site)
