"""Intervals of fitted parameters: the jackknife that leaves out one group after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


def freedom(jacobian: Values, groups: NDArray[np.int64]) -> Values:
    """Return the degrees of freedom of each parameter's variance by the jackknife.

    That variance is a sum of squares of what :func:`moves` returns. With residuals that are
    independent and alike it is near to a chi-squared distribution of as many degrees as give its
    mean and variance (Satterthwaite's; Bell and McCaffrey, Survey Methodology 28, 2002, 169-181).
    Groups that all tell the same about a parameter have one less than there are; with groups that
    tell more than others there are fewer, and Student's t is wider (Imbens and Kolesar 2016,
    doi:10.1162/REST_a_00552).

    Args:
        jacobian: at the fit, shape (n, parameters).
        groups: number of the group that each residual belongs to, shape (n,).
    """
    normal = jacobian.T @ jacobian
    own = np.array([
        jacobian[groups == group].T @ jacobian[groups == group] for group in np.unique(groups)
    ])
    without = np.linalg.pinv(normal - own)
    # Moves are linear in the residuals: covariances of those of all groups, for each parameter.
    told = own @ without
    alone = np.einsum("gkp,gkp->gp", without, told)
    shared = np.einsum("gkp,kl,hlp->pgh", told, np.linalg.pinv(normal), told)
    covariance = np.einsum("gp,gh->pgh", alone, np.eye(len(own))) - shared
    return np.asarray(
        np.einsum("pgg->p", covariance) ** 2 / np.einsum("pgh,pgh->p", covariance, covariance)
    )


def half_intervals(moved: Values, freedom: Values | None = None) -> Values:
    """Return half of each 95 % interval, from how each value moves without one group.

    Tukey's jackknife (Efron 1982, doi:10.1137/1.9781611970319) with Student's t. One group says
    nothing: the halves are infinite.

    Args:
        moved: shape (groups, values), but for what is the same in each group.
        freedom: degrees of freedom of each value; None takes as many as there are groups, less one.
    """
    count = len(moved)
    if count < 2:  # nothing is left without the only group
        return np.full(moved.shape[1], np.inf)
    variance = np.var(moved, axis=0) * (count - 1)
    from scipy.stats import t as student  # half of what the command imports, before it refuses

    quantile = student.ppf((1 + _CONFIDENCE) / 2, max(1, count - 1) if freedom is None else freedom)
    return np.asarray(quantile * np.sqrt(variance))
