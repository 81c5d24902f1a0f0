"""The smooth plant, Eqs. (5)-(9), and its linear model, Eq. (10). It serves only to linearise."""

from __future__ import annotations

import math
from typing import NamedTuple

from greenroof_ros.model.site import Site


def smooth_sqrt(y: float, epsilon: float) -> float:
    """psi(y): the differentiable square root of Duan and Lian (2016, Eq. 3), Eq. (6)."""
    if y > epsilon:
        return math.sqrt(y)
    least = 2 / 3 * math.sqrt(epsilon)
    return least + y**1.5 / (3 * epsilon) if y > 0 else least


def smooth_sqrt_slope(y: float, epsilon: float) -> float:
    """d psi / d y."""
    if y > epsilon:
        return 0.5 / math.sqrt(y)
    return math.sqrt(y) / (2 * epsilon) if y > 0 else 0.0


def sigmoid(y: float) -> float:
    """1 / (1 + exp(-y)), for any y without overflow."""
    if y >= 0:
        return 1 / (1 + math.exp(-y))
    growth = math.exp(y)
    return growth / (1 + growth)


class Linearisation(NamedTuple):
    """x' ~ A x~ + B u~ + C w~ + b about an operating point, Eq. (10).

    The paper prints C_p as 2x1; with two disturbances w = (w_r, w_e) it is 2x2.
    """

    A: tuple[tuple[float, float], tuple[float, float]]
    """I + tau df/dx, shape (2, 2), dimensionless"""
    B: tuple[float, float]
    """tau df/du, shape (2,), m3"""
    C: tuple[tuple[float, float], tuple[float, float]]
    """tau df/dw, shape (2, 2); columns w_r (m2 s) and w_e (s)"""
    b: tuple[float, float]
    """tau f, shape (2,), m3: the change of state in a tick at the operating point"""


def linearise(
    site: Site,
    x1: float,
    x2: float,
    command: float,
    precipitation: float,
    evapotranspiration: float,
) -> Linearisation:
    """Linearise the smooth plant about p = (x, u, w), Eqs. (5)-(10).

    Args:
        site: the parameters of Table I.
        x1: water volume in the cistern (m3).
        x2: water volume in the roof (m3).
        command: share of the maximum flow (1).
        precipitation: w_r (m/s).
        evapotranspiration: w_e (m3/s).
    """
    epsilon, tau = site.epsilon, site.tau

    # q_out, Eq. (7)
    nu = x1 / site.a1 - site.z_o
    q_out = site.c_out * smooth_sqrt(nu, epsilon)
    q_out_1 = site.c_out * smooth_sqrt_slope(nu, epsilon) / site.a1

    # q_pump, Eq. (8), per unit of command first, because B needs it so
    rho = x1 / site.a1 + site.c_hat - site.d
    full = site.b * smooth_sqrt(rho, epsilon)
    full_1 = site.b * smooth_sqrt_slope(rho, epsilon) / site.a1
    sigma_1 = sigmoid((x1 - site.a1 * site.suction_level) / epsilon)
    sigma_2 = sigmoid((site.a2 * site.z_veg - x2) / epsilon)
    sigma_1_1 = sigma_1 * (1 - sigma_1) / epsilon
    sigma_2_2 = -sigma_2 * (1 - sigma_2) / epsilon
    q_pump_u = full * sigma_1 * sigma_2
    q_pump = command * q_pump_u
    q_pump_1 = command * sigma_2 * (full_1 * sigma_1 + full * sigma_1_1)
    q_pump_2 = command * full * sigma_1 * sigma_2_2

    # q_drain, Eq. (9)
    darcy = site.K * site.a2 * (x2 / site.a2 + site.z_soil) / site.z_soil
    sigma_3 = sigmoid((x2 - site.z_cap) / epsilon)
    q_drain = darcy * sigma_3
    q_drain_2 = site.K / site.z_soil * sigma_3 + darcy * sigma_3 * (1 - sigma_3) / epsilon

    f1 = precipitation * site.a_in - q_out - q_pump
    f2 = precipitation * site.a2 + q_pump - evapotranspiration - q_drain
    return Linearisation(
        A=(
            (1 + tau * (-q_out_1 - q_pump_1), tau * -q_pump_2),
            (tau * q_pump_1, 1 + tau * (q_pump_2 - q_drain_2)),
        ),
        B=(tau * -q_pump_u, tau * q_pump_u),
        C=((tau * site.a_in, 0.0), (tau * site.a2, -tau)),
        b=(tau * f1, tau * f2),
    )
