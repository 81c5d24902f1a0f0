"""Adoption: which buildings have a green roof and a cistern, and which of them have a valve.

Buildings adopt in a random order: a building that has a green roof at a low level of adoption also
has a green roof at every higher level. Buildings that adopt at the same share form a group. Every
building is simulated once, and the district at any adoption is a sum of groups.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Adoption:
    """The groups of a district.

    Attributes:
        buildings: total number of buildings.
        shares: shares of the buildings with a green roof and a cistern (1), in ascending order.
        valve_share: share of these buildings that have a valve (1).
    """

    buildings: int
    shares: Sequence[float]
    valve_share: float

    @property
    def counts(self) -> list[int]:
        """Number of buildings with a green roof at each share."""
        return [math.floor(share * self.buildings + 0.5) for share in self.shares]

    def groups(self, ranks: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the index of the first share at which each building has a green roof.

        For a building that never gets a green roof, the index is the number of shares.

        Args:
            ranks: positions of the buildings in the order of adoption.
        """
        return np.searchsorted(self.counts, ranks, side="right")

    def have_valve(self, ranks: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return a mask of the buildings that have a valve once they have a cistern.

        The share of these buildings is the same at every level of adoption, to within one building.

        Args:
            ranks: positions of the buildings in the order of adoption.
        """
        return np.asarray(
            np.floor((ranks + 1) * self.valve_share + 1e-9)
            > np.floor(ranks * self.valve_share + 1e-9)
        )
