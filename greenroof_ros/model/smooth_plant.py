"""The smooth plant, Eqs. (5)-(9), and its linear model, Eq. (10). It serves only to linearise.

The soil of a measured roof, in place of Eq. (9), is taken as it is: continuous, and between its
wilting point, the onset of stress and field capacity as smooth as can be. At these three points
the slopes are those of one side.
"""
from __future__ import annotations

import math
from typing import NamedTuple

from greenroof_ros.model.plant import mains_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import filled_share, kept_share, water_stress


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
    if site.low_outlet_level is not None:
        nu = x1 / site.a1 - site.low_outlet_level
        q_out += site.c_low * smooth_sqrt(nu, epsilon)
        q_out_1 += site.c_low * smooth_sqrt_slope(nu, epsilon) / site.a1

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

    soil = _soil(site, x2)
    into_roof = precipitation * site.a2 + q_pump
    f1 = precipitation * site.effective_catchment + mains_flow(site, x1) - q_out - q_pump
    f2 = into_roof * soil.kept - evapotranspiration * soil.stress - soil.drain
    f2_2 = (
        q_pump_2 * soil.kept + into_roof * soil.kept_2 - evapotranspiration * soil.stress_2
        - soil.drain_2
    )
    return Linearisation(
        A=(
            (1 + tau * (-q_out_1 - q_pump_1), tau * -q_pump_2),
            (tau * q_pump_1 * soil.kept, 1 + tau * f2_2),
        ),
        B=(tau * -q_pump_u, tau * q_pump_u * soil.kept),
        C=((tau * site.effective_catchment, 0.0), (tau * site.a2 * soil.kept, -tau * soil.stress)),
        b=(tau * f1, tau * f2),
    )


class _Soil(NamedTuple):
    """What the soil makes of water, at a volume x2, and the derivatives by x2 (1/m3)."""

    kept: float
    """share of the arriving water that stays"""
    kept_2: float
    stress: float
    """share of the evapotranspiration that it gives"""
    stress_2: float
    drain: float
    """what drains beside the share that does not stay (m3/s)"""
    drain_2: float


def _soil(site: Site, x2: float) -> _Soil:
    """Return Eq. (9) of the paper's soil, and the soil of a measured roof."""
    if site.field_capacity is None:
        darcy = site.K * site.a2 * (x2 / site.a2 + site.z_soil) / site.z_soil
        sigma_3 = sigmoid((x2 - site.z_cap) / site.epsilon)
        slope = site.K / site.z_soil * sigma_3 + darcy * sigma_3 * (1 - sigma_3) / site.epsilon
        return _Soil(1.0, 0.0, 1.0, 0.0, darcy * sigma_3, slope)
    stress = water_stress(site, x2)
    excess = max(0.0, x2 - site.z_cap)
    filled_2 = 1 / site.available_volume if site.wilting_volume <= x2 < site.z_cap else 0.0
    return _Soil(
        kept_share(site, x2), -2 * filled_share(site, x2) * filled_2,
        stress, filled_2 / site.stress_onset if stress < 1 else 0.0,
        excess / site.tau, 1 / site.tau if excess else 0.0,
    )
