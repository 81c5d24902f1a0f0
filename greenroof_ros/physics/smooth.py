"""The smooth plant, Eqs. (5)-(9), used only for linearisation, and its linear model, Eq. (10).

Each equation has its own function: :func:`f` for Eq. (5), :func:`psi` for Eq. (6), :func:`q_out`
for Eq. (7), :func:`q_pump` for Eq. (8) and :func:`q_drain` for Eq. (9). The last four functions
also return the derivatives that Eq. (10) requires. A field-capacity soil replaces Eq. (9). This
soil is not smoothed, because it is continuous everywhere, and smooth except at the wilting point,
the onset of stress and field capacity.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from greenroof_ros.physics.cistern import mains_inflow
from greenroof_ros.physics.parameters import PlantParameters
from greenroof_ros.physics.soil import filled_share, retained_share, water_stress


def linearise_soil(
    p: PlantParameters, x2: float
) -> tuple[float, float, float, float, float, float]:
    """Return the response of the soil at x2 (m3); :func:`q_drain` replaces Eq. (4).

    A field-capacity soil is not smoothed. At the wilting point, the onset of stress and field
    capacity, its slopes are one-sided.

    Returns:
        The share of the arriving water that stays in the soil (1), the share of the potential
        evapotranspiration that the soil yields (1), and the drainage in addition to the arriving
        water that does not stay (m3/s), each followed by its slope in x2 (per m3).
    """
    if not p.has_field_capacity:
        return 1.0, 0.0, 1.0, 0.0, *q_drain(p, x2)
    filled, stress, exponent = filled_share(p, x2), water_stress(p, x2), p.percolation_exponent
    filled_2 = 1 / p.available_volume if p.wilting_volume <= x2 < p.z_cap else 0.0
    excess = max(0.0, x2 - p.z_cap)
    return (
        retained_share(p, x2), -exponent * filled ** (exponent - 1) * filled_2,
        stress, filled_2 / p.stress_onset if stress < 1 else 0.0,
        excess / p.tau, 1 / p.tau if excess else 0.0,
    )


def f(
    p: PlantParameters, x1: float, w_r: float, w_e: float, out: float, pumped: float,
    retained: float, stress: float, drained: float,
) -> tuple[float, float]:
    """Return f^epsilon: the rates of change of the two volumes (m3/s), Eq. (5).

    The mains supply of the plant is added. Drainage that flows into the cistern is neglected.

    Args:
        p: parameters of the plant.
        x1: water volume in the cistern (m3).
        w_r: precipitation (m/s).
        w_e: evapotranspiration (m3/s).
        out: q_out, Eq. (7) (m3/s).
        pumped: q_pump, Eq. (8) (m3/s).
        retained: share of the arriving water that stays in the soil (1).
        stress: share of the potential evapotranspiration that the soil yields (1).
        drained: q_drain, Eq. (9) (m3/s).
    """
    f1 = w_r * p.effective_catchment + mains_inflow(p, x1, 0.0, p.tau) - out - pumped
    return f1, (w_r * p.a2 + pumped) * retained - w_e * stress - drained


def psi(y: float, epsilon: float) -> tuple[float, float]:
    """Return psi^epsilon, a smooth square root, and its slope, Eq. (6).

    The function is Eq. 3 of Duan and Lian (2016).
    """
    if y > epsilon:
        root = math.sqrt(y)
        return root, 0.5 / root
    minimum = 2 / 3 * math.sqrt(epsilon)
    if y > 0:
        return minimum + y**1.5 / (3 * epsilon), math.sqrt(y) / (2 * epsilon)
    return minimum, 0.0


def q_out(p: PlantParameters, x1: float) -> tuple[float, float]:
    """Return the flow to the sewer, q_out^epsilon (m3/s), Eq. (7), and its slope in x1 (1/s).

    A low outlet with a valve is treated as closed.
    """
    root, slope = psi(x1 / p.a1 - p.z_o, p.epsilon)
    flow, flow_1 = p.c_out * root, p.c_out * slope / p.a1
    if p.always_drains:
        root, slope = psi(x1 / p.a1 - p.low_outlet_level, p.epsilon)
        flow += p.c_low * root
        flow_1 += p.c_low * slope / p.a1
    return flow, flow_1


def q_pump(p: PlantParameters, x1: float, x2: float, u: float) -> tuple[float, float, float, float]:
    """Return the flow of the pumps, q_pump^epsilon (m3/s), Eq. (8), and its slopes.

    The slopes are those in x1 and x2 (1/s), and in the command u (m3/s).
    """
    epsilon = p.epsilon
    root, slope = psi(x1 / p.a1 + p.c_hat - p.d, epsilon)
    full, full_1 = p.b * root, p.b * slope / p.a1  # eta at u = 1
    sigma_1 = sigma(x1 - p.a1 * p.suction_level, epsilon)
    sigma_2 = sigma(p.a2 * p.z_veg - x2, epsilon)
    sigma_1_1 = sigma_1 * (1 - sigma_1) / epsilon
    sigma_2_2 = -sigma_2 * (1 - sigma_2) / epsilon
    by_u = full * sigma_1 * sigma_2
    by_x1 = u * sigma_2 * (full_1 * sigma_1 + full * sigma_1_1)
    return u * by_u, by_x1, u * full * sigma_1 * sigma_2_2, by_u


def q_drain(p: PlantParameters, x2: float) -> tuple[float, float]:
    """Return the drainage, q_drain^epsilon (m3/s), Eq. (9), and its slope in x2 (1/s)."""
    sigma_3 = sigma(x2 - p.z_cap, p.epsilon)
    flow = p.K * p.a2 * (x2 / p.a2 + p.z_soil) / p.z_soil * sigma_3
    return flow, p.K / p.z_soil * sigma_3 + flow * (1 - sigma_3) / p.epsilon


def sigma(y: float, epsilon: float) -> float:
    """Return 1 / (1 + exp(-y / epsilon)) without overflow: a smooth step, Eqs. (8) and (9)."""
    if y >= 0:
        return 1 / (1 + math.exp(-y / epsilon))
    growth = math.exp(y / epsilon)
    return growth / (1 + growth)


class Linearisation(NamedTuple):
    """The linear model x' ~ A x~ + B u~ + C w~ + b at an operating point, Eq. (10).

    The paper prints C_p as a 2x1 matrix, but with two disturbances w = (w_r, w_e), it is 2x2.
    """

    A: tuple[tuple[float, float], tuple[float, float]]
    """I + tau df/dx, shape (2, 2), dimensionless"""
    B: tuple[float, float]
    """tau df/du, shape (2,), m3"""
    C: tuple[tuple[float, float], tuple[float, float]]
    """tau df/dw, shape (2, 2); columns w_r (m2 s) and w_e (s)"""
    b: tuple[float, float]
    """tau f, shape (2,), m3: the change of the state in a tick at the operating point"""


def linearise(
    p: PlantParameters, x1: float, x2: float, u: float, w_r: float, w_e: float
) -> Linearisation:
    """Linearise the smooth plant about p = (x, u, w), Eq. (10).

    Args:
        p: parameters of the plant.
        x1: water volume in the cistern (m3).
        x2: water volume on the roof (m3).
        u: command, share of the maximum flow (1).
        w_r: precipitation (m/s).
        w_e: evapotranspiration (m3/s).
    """
    tau = p.tau
    retained, retained_2, stress, stress_2, drained, drained_2 = linearise_soil(p, x2)
    out, out_1 = q_out(p, x1)
    pumped, pumped_1, pumped_2, pumped_u = q_pump(p, x1, x2, u)
    f1, f2 = f(p, x1, w_r, w_e, out, pumped, retained, stress, drained)
    into_roof = w_r * p.a2 + pumped
    f2_2 = pumped_2 * retained + into_roof * retained_2 - w_e * stress_2 - drained_2
    return Linearisation(
        A=(
            (1 + tau * (-out_1 - pumped_1), tau * -pumped_2),
            (tau * pumped_1 * retained, 1 + tau * f2_2),
        ),
        B=(tau * -pumped_u, tau * pumped_u * retained),
        C=((tau * p.effective_catchment, 0.0), (tau * p.a2 * retained, -tau * stress)),
        b=(tau * f1, tau * f2),
    )
