"""The pumps in series, Eqs. (3a) and (3e), and their speed according to the affinity laws.

Eq. (3e) is Eqs. (3b) to (3d) solved for the flow. Its coefficients b and pipe_resistance are those
of :class:`.Site`.

A pump that delivers the flow y at the head phi(y) and at its rated speed delivers the flow s y at
the head s^2 phi(y) and at the share s of this speed (affinity laws, e.g. White, Fluid Mechanics,
Sec. 11.3). Therefore Eq. (3b) becomes phi_s(q) = s^2 c_hat + a_hat q^2. This head equals the head
loss L(q) of Eq. (3c) if s^2 c_hat = (pipe_resistance - a_hat) q^2 + d - x1/a1. The curve represents
all of the site's pumps together, which run at the same speed.
"""

from __future__ import annotations

import math

from greenroof_ros.physics.parameters import PlantParameters
from greenroof_ros.site.site import Site

PumpCurve = PlantParameters | Site
"""the numbers of a site that determine the flow of its pumps"""

STANDSTILL = 0.02
"""share of the rated speed up to which a pump counts as stopped, because readings are noisy"""
RUNNING_SHARE = 0.01
"""share of their maximum flow above which the pumps count as running"""


def maximum_pump_flow(p: PumpCurve, x1: float) -> float:
    """Return the pumps' flow (m3/s) at command 1 from a cistern with x1 (m3), Eq. (3e).

    The flow is 0 if the pumps cannot lift water to the roof; they must not run at such a level.
    """
    head = x1 / p.a1 + p.c_hat - p.d
    return p.b * math.sqrt(head) if head > 0 else 0.0


def pump_flow(p: PlantParameters, x1: float, x2: float, command: float) -> float:
    """Return q_pump (m3/s) for volumes (m3) and a command (share of the maximum flow), Eq. (3a)."""
    if x2 / p.a2 >= p.z_veg or x1 / p.a1 < p.suction_level:
        return 0.0
    return command * maximum_pump_flow(p, x1)


def running_flow(p: PlantParameters) -> float:
    """Return the flow (m3/s) above which the pumps count as running: 1 % of the maximum flow.

    The maximum flow is that from a cistern filled to its overflow. Smaller flows are caused by a
    lag whose output never quite reaches 0, or by the noise of a flow meter.
    """
    return RUNNING_SHARE * maximum_pump_flow(p, p.a1 * p.z_o)


def flow_at(p: PumpCurve, speed: float, cistern_level: float) -> float:
    """Return the flow (m3/s) of the pumps at a given speed; 0 if no water reaches the roof.

    Stopped pumps deliver nothing, even from a cistern above the roof, because a check valve is
    assumed. At speed 1, the result is bit-identical to that of :func:`maximum_pump_flow`.

    Args:
        p: parameters of the plant.
        speed: share of the rated speed, at least 0.
        cistern_level: depth of water in the cistern (m).
    """
    head = cistern_level + speed**2 * p.c_hat - p.d
    return p.b * math.sqrt(head) if speed > 0 and head > 0 else 0.0


def speed_for(p: PumpCurve, share: float, cistern_level: float) -> float:
    """Return the speed (share of the rated speed) that yields a share of the maximum flow.

    The speed is 0 if the share is 0, or if the pumps cannot lift water to the roof at their rated
    speed. If the cistern is above the roof, even a slow pump delivers more than a small share. For
    such a share, the speed is the smallest positive number, so that a positive share never stops
    the pumps.

    Args:
        p: parameters of the plant.
        share: share of the maximum flow at this level, 0 to 1.
        cistern_level: depth of water in the cistern (m).
    """
    max_head = cistern_level + p.c_hat - p.d
    if share <= 0 or max_head <= 0:
        return 0.0
    squared = (share**2 * max_head + p.d - cistern_level) / p.c_hat
    return max(math.sqrt(max(squared, 0.0)), math.ulp(0.0))
