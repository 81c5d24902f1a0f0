"""Conversion between pump flow and speed with the affinity laws and the site's pump curve.

If a pump has the flow y and the head phi(y) at its rated speed, it has the flow s y and the head
s^2 phi(y) at the share s of this speed (affinity laws, e.g. White, Fluid Mechanics, Sec. 11.3).
Therefore Eq. (3b) becomes phi_s(q) = s^2 c_hat + a_hat q^2. This head equals the head loss L(q) of
Eq. (3c) if s^2 c_hat = (pipe_resistance - a_hat) q^2 + d - x1/a1. The curve represents all pumps of
the site together, which run at the same speed.
"""

from __future__ import annotations

import math

from greenroof_ros.model.site import Site

STANDSTILL = 0.02
"""share of the rated speed up to which a pump counts as stopped, because readings are noisy"""


def flow_at(site: Site, speed: float, cistern_level: float) -> float:
    """Return the flow (m3/s) of pumps at a speed; 0 if no water reaches the roof.

    Stopped pumps deliver nothing, even from a cistern above the roof, because a check valve is
    assumed. At speed 1 the result has the same bits as
    :func:`greenroof_ros.model.plant.maximum_pump_flow`.

    Args:
        site: site with the pump curve.
        speed: share of the rated speed, at least 0.
        cistern_level: depth of water in the cistern (m).
    """
    head = cistern_level + speed**2 * site.c_hat - site.d
    return site.b * math.sqrt(head) if speed > 0 and head > 0 else 0.0


def speed_for(site: Site, share: float, cistern_level: float) -> float:
    """Return the speed (share of the rated speed) for a share of the maximum flow at a level.

    The speed is 0 for the share 0, and if the pumps cannot lift water to the roof at rated speed.
    If the cistern is above the roof, even a slow pump exceeds a small share. The speed is then the
    smallest positive number, so that a positive share never stops the pumps.

    Args:
        site: site with the pump curve.
        share: share of the maximum flow at this level, 0 to 1.
        cistern_level: depth of water in the cistern (m).
    """
    max_head = cistern_level + site.c_hat - site.d
    if share <= 0 or max_head <= 0:
        return 0.0
    squared = (share**2 * max_head + site.d - cistern_level) / site.c_hat
    return max(math.sqrt(max(squared, 0.0)), math.ulp(0.0))
