"""Conversion between pump flow and speed with the affinity laws and the site's pump curve.

A pump that delivers the flow y at the head phi(y) and at its rated speed delivers the flow s y at
the head s^2 phi(y) and at the share s of this speed (affinity laws, e.g. White, Fluid Mechanics,
Sec. 11.3). Therefore Eq. (3b) becomes phi_s(q) = s^2 c_hat + a_hat q^2. This head equals the head
loss L(q) of Eq. (3c) if s^2 c_hat = (pipe_resistance - a_hat) q^2 + d - x1/a1. The curve represents
all of the site's pumps together, which run at the same speed.
"""

from __future__ import annotations

import math

from greenroof_ros.site.site import Site

STANDSTILL = 0.02
"""share of the rated speed up to which a pump counts as stopped, because readings are noisy"""


def flow_at(site: Site, speed: float, cistern_level: float) -> float:
    """Return the flow (m3/s) of the pumps at a given speed; 0 if no water reaches the roof.

    Stopped pumps deliver nothing, even from a cistern above the roof, because a check valve is
    assumed. At speed 1, the result is bit-identical to that of
    :func:`greenroof_ros.physics.plant.maximum_pump_flow`.

    Args:
        site: site with the pump curve.
        speed: share of the rated speed, at least 0.
        cistern_level: depth of water in the cistern (m).
    """
    head = cistern_level + speed**2 * site.c_hat - site.d
    return site.b * math.sqrt(head) if speed > 0 and head > 0 else 0.0


def speed_for(site: Site, share: float, cistern_level: float) -> float:
    """Return the speed (share of the rated speed) that yields a share of the maximum flow.

    The speed is 0 if the share is 0, or if the pumps cannot lift water to the roof at their rated
    speed. If the cistern is above the roof, even a slow pump delivers more than a small share. For
    such a share, the speed is the smallest positive number, so that a positive share never stops
    the pumps.

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
