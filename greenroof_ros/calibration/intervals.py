"""Intervals of fitted parameters: the jackknife that leaves out one group after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from greenroof_ros.calibration.record import Values

_CONFIDENCE = 0.95


def moves(jacobian: Values, residuals: Values, groups: NDArray[np.int64]) -> Values:
    """Return by how much a least-squares fit moves without one group, shape (groups, parameters).

    Those fits are linear: to leave out a group with Jacobian J_g and residuals r_g moves the
    parameters by (J'J - J_g'J_g)^-1 J_g' r_g.

    Args:
        jacobian: at the fit, shape (n, parameters).
        residuals: there, shape (n,).
        groups: number of the group that each residual belongs to, shape (n,). Those of one group
            may depend on each other.
    """
    normal = jacobian.T @ jacobian
    moved = []
    for group in np.unique(groups):
        own = jacobian[groups == group]
        moved.append(np.linalg.pinv(normal - own.T @ own) @ (own.T @ residuals[groups == group]))
    return np.array(moved)


def half_intervals(moved: Values) -> Values:
    """Return half of each 95 % interval, from how each value moves without one group.

    Tukey's jackknife (Efron 1982, doi:10.1137/1.9781611970319), with Student's t of as many degrees
    of freedom as there are groups, less one.

    Args:
        moved: shape (groups, values), but for what is the same in each group.
    """
    count = len(moved)
    variance = np.var(moved, axis=0) * (count - 1)
    quantile = student.ppf((1 + _CONFIDENCE) / 2, max(1, count - 1))
    return np.asarray(quantile * np.sqrt(variance))
