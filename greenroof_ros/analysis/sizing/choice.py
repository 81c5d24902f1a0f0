"""Which design is recommended: the target by water stress, the cistern by what another m3 brings.

The knee is the smallest cistern beyond which each further m3 brings less than a stated amount: for
volumes V_1 < V_2 < ... that save the water or the money S_1, S_2, ... in a season,

    knee = the smallest V_i with (S_{j+1} - S_j) / (V_{j+1} - V_j) < amount for all j >= i.

Water that is saved is mains water that is not used, and storm water that does not reach the sewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.parameter import entry

Values = NDArray[np.float64]

KNEE = 1.0
"""Amount that another m3 must bring (m3 a season), one filling [assumed]."""

MAX_STRESS = 0.01
"""share of a season's hours that plants may lack water at the recommended target [assumed]"""


@dataclass(frozen=True)
class Prices:
    """What water and cistern cost, in any currency; without prices there are no costs.

    Waste-water fees are by the metered mains water, and storm-water fees by the connected area: no
    meter counts what a cistern lets out, in dry weather or in wet. So the price of storm water is
    mostly one that a city sets for what it must treat or store.
    """

    mains_price: float = entry(
        "price of a m3 of mains water, with the waste-water fee if that is by the metered water",
        0.0, 1e9,
    )
    storm_water_price: float = entry(
        "worth of a m3 of storm water that does not reach the sewer in wet weather; 0 if the "
        "storm-water fee is by the connected area, which neither cistern nor valve changes",
        0.0, 1e9,
    )
    cistern_price: float = entry("price of a cistern for each m3 of its volume", 0.0, 1e9)
    cistern_years: float = entry(
        "time over which the cistern's price is spread, without interest", 1.0, 200.0, unit="years"
    )

    def cost_water(self, mains: Values, wet: Values) -> Values:
        """Return the cost of a season's water.

        Args:
            mains: mains water (m3).
            wet: discharge in wet weather (m3).
        """
        return np.asarray(self.mains_price * mains + self.storm_water_price * wet)

    @property
    def yearly_cistern_price(self) -> float:
        """Price of a m3 of cistern for a year."""
        return self.cistern_price / self.cistern_years


def find_knee(volumes: Sequence[float], saved: Values, amount: float) -> int | None:
    """Return the place of the knee; None if the largest cistern is not yet beyond it.

    Args:
        volumes: m3, rising.
        saved: by each in a season, compared with any of them (m3, or money), shape (n,).
        amount: that another m3 must bring, likewise.
    """
    brings = np.diff(saved) / np.diff(volumes)
    enough = np.flatnonzero(brings >= amount)
    knee = int(enough[-1]) + 1 if enough.size else 0
    return knee if knee < len(volumes) - 1 or len(volumes) == 1 else None


def find_target(targets: Sequence[float], stress_shares: Values) -> float:
    """Return the lowest target at which plants lack water for at most 1 % of a season.

    If there is none, it is the one with the least stress.

    Args:
        targets: mm, rising.
        stress_shares: mean share of a season's hours at each (1), shape (n,).
    """
    fits = np.flatnonzero(stress_shares <= MAX_STRESS)
    return targets[int(fits[0] if fits.size else np.argmin(stress_shares))]
