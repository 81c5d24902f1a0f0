"""Adoption: which buildings have a green roof and a cistern, and which of these a valve.

Buildings adopt in a random order, so that who has a green roof at a low adoption has one at every
higher one. Buildings that begin at the same share are one group: each is simulated once, and the
district at any adoption is a sum of groups.
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
        buildings: number of all buildings.
        shares: with a green roof and a cistern, ascending.
        valve_share: share of these with a valve.
    """

    buildings: int
    shares: Sequence[float]
    valve_share: float

    @property
    def counts(self) -> list[int]:
        """How many buildings have a green roof at each share."""
        return [math.floor(share * self.buildings + 0.5) for share in self.shares]

    def groups(self, ranks: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the index of the first share at which buildings have a green roof.

        It is the number of shares if they never do.

        Args:
            ranks: the buildings' places in the order of adoption.
        """
        return np.searchsorted(self.counts, ranks, side="right")

    def have_valve(self, ranks: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which buildings have a valve once they have a cistern.

        At every adoption it is the same share of them, to one building.
        """
        return np.asarray(
            np.floor((ranks + 1) * self.valve_share + 1e-9)
            > np.floor(ranks * self.valve_share + 1e-9)
        )
