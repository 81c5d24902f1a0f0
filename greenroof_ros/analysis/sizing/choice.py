"""Choice of the recommended design: the target by lost evapotranspiration, the cistern by savings.

The knee is the smallest cistern beyond which every additional m3 saves less than a stated amount.
For volumes V_1 < V_2 < ... that save the water or the money S_1, S_2, ... in a season,

    knee = the smallest V_i with (S_{j+1} - S_j) / (V_{j+1} - V_j) < amount for all j >= i.

Saved water is mains water that is not used and storm water that does not reach the sewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.parameter import entry

Values = NDArray[np.float64]

KNEE = 1.0
"""Water that another m3 of cistern must save (m3 a season): one filling [assumed]."""

MAX_LOST = 0.001
"""share of the potential evapotranspiration that plants may lose at the recommended target, for
lack of water [assumed]"""


@dataclass(frozen=True)
class Prices:
    """Prices of water and cistern, in any currency; without prices no costs are calculated.

    Waste-water fees are charged on the metered mains water, and storm-water fees on the connected
    area. No meter measures the discharge of a cistern, in dry or in wet weather, so the price of
    storm water is usually one that a city sets for the water that it must treat or store.
    """

    mains_price: float = entry(
        "price of 1 m3 of mains water, including the waste-water fee if it is charged on the "
        "metered water", 0.0, 1e9,
    )
    storm_water_price: float = entry(
        "value of 1 m3 of storm water that does not reach the sewer in wet weather; 0 if the "
        "storm-water fee is charged on the connected area, which neither cistern nor valve changes",
        0.0, 1e9,
    )
    cistern_price: float = entry("price of a cistern, per m3 of volume", 0.0, 1e9)
    cistern_years: float = entry(
        "period over which the cistern's price is spread, without interest", 1.0, 200.0,
        unit="years",
    )

    def cost_water(self, mains: Values, wet: Values) -> Values:
        """Return the cost of a season's water.

        Args:
            mains: mains water used (m3).
            wet: discharge in wet weather (m3).
        """
        return np.asarray(self.mains_price * mains + self.storm_water_price * wet)

    @property
    def yearly_cistern_price(self) -> float:
        """Price of one m3 of cistern for one year."""
        return self.cistern_price / self.cistern_years


def find_knee(volumes: Sequence[float], saved: Values, amount: float) -> int:
    """Return the index of the knee; that of the largest cistern if it is smaller than the knee.

    Args:
        volumes: volumes of the cisterns (m3), in ascending order.
        saved: savings of each cistern in a season, relative to any one of the cisterns (m3, or
            money), shape (n,).
        amount: minimum savings per additional m3 of cistern (m3, or money).
    """
    brings = np.diff(saved) / np.diff(volumes)
    enough = np.flatnonzero(brings >= amount)
    return int(enough[-1]) + 1 if enough.size else 0


def find_target(targets: Sequence[float], lost: Values) -> float:
    """Return the lowest target at which plants lose at most 0.1 % of their evapotranspiration (mm).

    A higher target takes more water, also from the mains. If there is no such target, return the
    target at which plants lose least.

    Args:
        targets: targets to choose from (mm), in ascending order.
        lost: mean share of the potential evapotranspiration that is lost at each target (1), shape
            (n,).
    """
    fits = np.flatnonzero(lost <= MAX_LOST)
    return targets[int(fits[0] if fits.size else np.argmin(lost))]


def choose_volume(
    volumes: Sequence[float], mains: Values, wet: Values, prices: Prices | None, knee: float
) -> float:
    """Return the volume that is recommended (m3): the knee, or else the largest.

    Args:
        volumes: volumes of the cisterns (m3), in ascending order.
        mains: mean mains water of a season with each of them (m3).
        wet: mean discharge in wet weather with each of them (m3).
        prices: prices of water and cistern; None to save water.
        knee: minimum volume of water that each additional m3 of cistern must save (m3).
    """
    saved, amount = -(mains + wet), knee
    if prices is not None:
        saved, amount = -prices.cost_water(mains, wet), prices.yearly_cistern_price
    return volumes[find_knee(volumes, saved, amount)]
