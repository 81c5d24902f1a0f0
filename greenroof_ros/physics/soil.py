"""The soil of a roof in a tick: the paper's soil, Eq. (4), or a field-capacity soil.

The field-capacity soil is modeled by the soil routine of HBV (Bergstrom 1976, SMHI Reports RHO No.
7; Seibert and Vis 2012, doi:10.5194/hess-16-3315-2012, soil moisture routine): of the arriving
water i, the share S^beta percolates, where S is the filled share of the available water TAW and
beta is the ``percolation_exponent``. In a tick of constant i,

    dS/du = 1 - S^beta,  u = i t / TAW.

For beta = 2 the solution is S(u) = (S + g) / (1 + S g) with g = tanh(u). For any other exponent,
the equation is solved in v = -ln(1 - S), in which it stays smooth up to S = 1,

    dv/du = (1 - S^beta) / (1 - S),

by the Runge-Kutta method of fourth order with fixed steps in u, and its inverse by Simpson's rule
with fixed steps in v. Below the substrate, the drainage layer is a reservoir with an outflow
proportional to the square of its volume.
"""

from __future__ import annotations

import math

from greenroof_ros.physics.parameters import PlantParameters

ALMOST_FULL = 1 - 1e-9
"""share of TAW that counts as full, because only an infinite volume would fill the soil to field
capacity (1)
"""
# Steps of the Runge-Kutta method in u, and of Simpson's rule in v; and the u from which a soil is
# full, whatever its exponent.
_STEP, _FULL_AFTER = 0.1, 25.0


def filled_share(p: PlantParameters, x2: float) -> float:
    """Return S (1): the filled share of the available water capacity at x2 (m3).

    S is 0 at and below the wilting point, and 1 at and above field capacity.
    """
    if x2 >= p.z_cap:
        return 1.0
    return max(0.0, (x2 - p.wilting_volume) / p.available_volume)


def water_stress(p: PlantParameters, x2: float) -> float:
    """Return K_s = (TAW - D_r) / ((1 - p) TAW), at most 1, FAO-56 Eq. 84; 1 for the paper's soil.

    TAW is the water that plants can take up at field capacity, and D_r is the depleted part of this
    water. K_s is the ratio of actual to potential evapotranspiration.
    """
    return min(1.0, filled_share(p, x2) / p.stress_onset) if p.has_field_capacity else 1.0


def retained_share(p: PlantParameters, x2: float) -> float:
    """Return 1 - S^beta: the share of arriving water that stays in the soil; 1 for the paper's."""
    if not p.has_field_capacity:
        return 1.0
    filled = filled_share(p, x2)
    if p.percolation_exponent == 2:
        return 1 - filled * filled
    return 1 - math.pow(filled, p.percolation_exponent)


def _slope(exponent: float, v: float) -> float:
    """Return dv/du = (1 - S^beta) / (1 - S) with S = 1 - exp(-v)."""
    if v <= 0:
        return 1.0
    empty = math.exp(-v)
    # The logarithm of S, without cancellation at either end.
    log_filled = math.log1p(-empty) if empty < 0.5 else math.log(-math.expm1(-v))
    return -math.expm1(exponent * log_filled) / empty


def fill(exponent: float, filled: float, u: float) -> float:
    """Return the filled share (1) after the water u (1, as a share of TAW) has arrived.

    For beta = 2, :func:`percolation` has the closed form.
    """
    if u <= 0 or filled >= 1:
        return filled
    u = min(u, _FULL_AFTER)
    v, steps = -math.log1p(-filled), math.ceil(u / _STEP)
    step = u / steps
    for _ in range(steps):
        first = _slope(exponent, v)
        second = _slope(exponent, v + step / 2 * first)
        third = _slope(exponent, v + step / 2 * second)
        fourth = _slope(exponent, v + step * third)
        v += step / 6 * (first + 2 * second + 2 * third + fourth)
    return -math.expm1(-v)


def water_to_fill(exponent: float, filled: float, reached: float) -> float:
    """Return the water u (1, as a share of TAW) that fills a soil from one share to another (1)."""
    if exponent == 2:
        return math.atanh(max(0.0, (reached - filled) / (1 - filled * reached)))
    if reached <= filled:
        return 0.0
    begin, end = -math.log1p(-filled), -math.log1p(-reached)
    steps = math.ceil((end - begin) / _STEP)
    step, total = (end - begin) / steps, 0.0
    for number in range(steps):
        v = begin + number * step
        total += 1 / _slope(exponent, v) + 4 / _slope(exponent, v + step / 2)
        total += 1 / _slope(exponent, v + step)
    return total * step / 6


def percolation(p: PlantParameters, x2: float, arriving: float, seconds: float) -> float:
    """Return the mean flow that leaves the soil downwards in a tick (m3/s), Eq. (4) or HBV.

    On the paper's soil, if Eq. (4) would drain much more than the water above the capacity in a
    tick, the drainage is limited to this water and the arriving water. On a field-capacity soil,
    all water stays in the substrate below the wilting point, and water above field capacity
    percolates within the tick.

    Args:
        p: parameters of the plant.
        x2: volume in the soil at the start of the tick (m3).
        arriving: rain and pumped water (m3/s).
        seconds: duration of the tick (s).
    """
    above = x2 - p.z_cap
    if not p.has_field_capacity:
        if above < 0:
            return 0.0
        drainage = p.K * p.a2 * (x2 / p.a2 + p.z_soil) / p.z_soil
        return min(drainage, above / seconds + arriving) if p.overdraws else drainage
    if above >= 0:
        return arriving + above / seconds
    if arriving <= 0:
        return 0.0
    arrived, filled = arriving * seconds, filled_share(p, x2)
    first = min(arrived, max(0.0, p.wilting_volume - x2))
    u, available = (arrived - first) / p.available_volume, p.available_volume
    if p.percolation_exponent == 2:
        g = math.tanh(u)
        gained = available * g * (1 - filled * filled) / (1 + filled * g)
    else:
        gained = available * (fill(p.percolation_exponent, filled, u) - filled)
    return max(0.0, arriving - (first + gained) / seconds)


def water_to_raise(p: PlantParameters, x2: float, to: float) -> float:
    """Return the water (m3) that must arrive in a tick that raises the soil from x2 to ``to``."""
    if not p.has_field_capacity:
        return to - x2
    first = max(0.0, min(to, p.wilting_volume) - x2)
    reached = min(filled_share(p, to), ALMOST_FULL)
    filled = min(filled_share(p, x2), ALMOST_FULL)
    return first + p.available_volume * water_to_fill(p.percolation_exponent, filled, reached)


def layer_outflow(p: PlantParameters, layer: float, inflow: float, seconds: float) -> float:
    """Return the mean flow that leaves the roof through the drainage layer in a tick (m3/s).

    The layer's volume V follows dV/dt = i - k V^2 with k = 1 / (a2 drainage_storage drainage_time),
    solved exactly for a constant inflow i, so that the result is stable for ticks of any length:

        V(t) = (V + i g) / (1 + k V g),  g = tanh(t sqrt(i k)) / sqrt(i k), or t where i = 0.

    Any volume above the layer's storage also drains within the tick. Without a layer, the inflow
    drains immediately.

    Args:
        p: parameters of the plant.
        layer: volume in the drainage layer (m3).
        inflow: percolation during the tick (m3/s).
        seconds: duration of the tick (s).
    """
    if p.layer_storage == 0 or (inflow == 0 and layer == 0):
        return inflow
    k = p.layer_rate
    rate = math.sqrt(inflow * k) if inflow > 0 else 0.0
    g = math.tanh(rate * seconds) / rate if rate > 0 else seconds
    remaining = min((layer + inflow * g) / (1 + k * layer * g), p.layer_storage)
    return max(0.0, inflow + (layer - remaining) / seconds)


def flows_in_tick(
    p: PlantParameters, x2: float, arriving: float, potential: float
) -> tuple[float, float, bool]:
    """Return the flows that leave the soil in a tick, limited to the available water.

    On the paper's soil, if less water is available than Eqs. (1) and (4) demand, both flows are
    scaled down. Percolation through a field-capacity soil is never limited by the available water.

    Args:
        p: parameters of the plant.
        x2: volume in the soil at the start of the tick (m3).
        arriving: rain and pumped water (m3/s).
        potential: potential evapotranspiration from the whole bed (m3/s).

    Returns:
        Percolation and evapotranspiration (m3/s), and whether less water was available than was
        demanded.
    """
    available, drained = x2 / p.tau + arriving, percolation(p, x2, arriving, p.tau)
    if p.has_field_capacity:
        evaporated, remaining = potential * water_stress(p, x2), available - drained
        return drained, min(evaporated, max(0.0, remaining)), evaporated > remaining
    demand = potential + drained
    if demand > available:
        share = available / demand
        return drained * share, potential * share, True
    return drained, potential, False


def roof_after_tick(p: PlantParameters, x2: float, arriving: float, potential: float) -> float:
    """Return the volume on a roof (m3) at the end of a tick; negative if the roof would dry out.

    Args:
        p: parameters of the plant.
        x2: volume on the roof at the start of the tick (m3).
        arriving: rain and pumped water (m3/s).
        potential: potential evapotranspiration from the whole bed (m3/s).
    """
    evaporated = potential * water_stress(p, x2)
    return x2 + p.tau * (arriving - evaporated - percolation(p, x2, arriving, p.tau))
