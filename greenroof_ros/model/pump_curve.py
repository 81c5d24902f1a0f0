"""A pump from its data sheet: the coefficients of the paper's pump curve."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyfit
from numpy.typing import ArrayLike


class PumpCurve(NamedTuple):
    """phi(y) = a_hat y^2 + c_hat, the head (m) at a flow y (m3/s), Eq. (3b)."""

    a_hat: float
    """s2/m5, negative"""
    c_hat: float
    """m"""


def fit_pump_curve(flow: ArrayLike, head: ArrayLike) -> PumpCurve:
    """Fit Eq. (3b) to points read off a data sheet, by least squares.

    Args:
        flow: flow rates (m3/s), not negative, shape (n,), at least two different ones. The paper
            doubles the flow of one pump, because its site has two; the caller must do the same.
        head: heads (m) at those flows, not negative, shape (n,).

    Returns:
        The coefficients ``a_hat`` and ``c_hat`` for a site file.

    Raises:
        ValueError: fewer than two flows differ, or the head rises with the flow.
    """
    flows = np.asarray(flow, dtype=float)
    heads = np.asarray(head, dtype=float)
    if flows.size < 2 or np.ptp(flows) <= 1e-6 * flows.max():
        raise ValueError("at least two different flows are needed")
    c_hat, a_hat = polyfit(flows**2, heads, 1)
    if a_hat * flows.max() ** 2 >= -1e-9 * heads.max():
        raise ValueError("the head must fall as the flow rises; are flow and head swapped?")
    return PumpCurve(float(a_hat), float(c_hat))
