"""Choice of the recommended design: the target by lost evapotranspiration, the cistern by savings.

The knee is the smallest cistern beyond which every additional m3 saves less than a stated amount.
For volumes V_1 < V_2 < ... that save the water S_1, S_2, ... in a season,

    knee = the smallest V_i with (S_{j+1} - S_j) / (V_{j+1} - V_j) < amount for all j >= i.

Saved water is mains water that is not used and storm water that does not reach the sewer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

KNEE = 1.0
"""Water that another m3 of cistern must save (m3 a season): one filling [assumed]."""

MAX_LOST = 0.001
"""share of the potential evapotranspiration that plants may lose at the recommended target, for
lack of water [assumed]"""


def find_knee(volumes: Sequence[float], saved: Values, amount: float) -> int:
    """Return the index of the knee; that of the largest cistern if it is smaller than the knee.

    Args:
        volumes: volumes of the cisterns (m3), in ascending order.
        saved: water that each cistern saves in a season, relative to any one of them (m3), shape
            (n,).
        amount: minimum savings per additional m3 of cistern (m3).
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
