"""The program that the planning controllers solve: volumes to pump over steps that grow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import osqp
import scipy.sparse
from numpy.typing import NDArray

from greenroof_ros.controllers.cistern_ahead import CisternAhead
from greenroof_ros.controllers.objective import Prices
from greenroof_ros.controllers.scenario_tree import Groups
from greenroof_ros.model.plant import JOULES_PER_KWH, WATER_DENSITY, maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import kept_share

# The solver gets near, its polishing does the rest. The program is scaled here: with the solver's
# own scaling some programs take ten times the iterations, and rho goes round in circles. The
# adaptation of rho is counted in iterations, since by the clock two equal runs would differ.
_SOLVER_SETTINGS = {
    "eps_abs": 3e-5,
    "eps_rel": 3e-5,
    "rho": 0.1,
    "adaptive_rho": 1,
    "adaptive_rho_interval": 50,
    "check_termination": 10,
    "scaling": 0,
    "polishing": True,
    "warm_starting": True,
    "verbose": False,
}
# An ensemble's program is some ten times larger and takes ten times the iterations. What it decides
# is good to 0.01 m3, a 0.2 mm of a forecast that errs by millimetres.
_ENSEMBLE_SETTINGS = {
    "eps_abs": 1e-3, "eps_rel": 1e-3, "rho": 0.03, "adaptive_rho": 0, "polishing": False,
}
# Weights of the rows of what the pumps can do, of the volumes, and of the balance of a cistern with
# a low outlet; those of the least iterations.
_CAPACITY, _VOLUME, _BALANCE = 5.0, 2.0, 8.0
_USABLE = (osqp.SolverStatus.OSQP_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE)

Array = NDArray[np.float64]
Matrix = Any  # scipy's sparse matrices have no types


class PlanningProgram:
    """The program of :class:`greenroof_ros.controllers.planner.Planner` for OSQP.

    It is for prices, squares and low outlets; without them there is
    :class:`~greenroof_ros.controllers.exact_program.ExactProgram`. The solver is set up once for
    the same groups of members; each further program only updates it.

    Attributes:
        status: OSQP's status value of the last program, 1 = solved.
        cost: its objective: the mean deviation over the horizon (m3; m6 where it is squared), of an
            ensemble its mean, and prices; NaN if it was not solved.
    """

    def __init__(
        self,
        site: Site,
        edges: Array,
        max_command: float,
        power: float,
        prices: Prices,
        max_iterations: int,
    ) -> None:
        """Take what all programs have in common.

        Args:
            site: the parameters of Table I.
            edges: ends of the steps (s from now), the first 0, shape (n + 1,).
            max_command: upper bound of the commands (1).
            power: of the deviation, 1 or 2.
            prices: of energy and starts.
            max_iterations: OSQP's limit.
        """
        self.status = 0
        self.cost = math.nan
        self._site = site
        self._max_command = max_command
        self._power = power
        self._prices = prices
        self._seconds = float(edges[-1])
        self._max_iterations = max_iterations
        self._lengths = np.diff(edges)
        # A step's deviation is scaled so that seconds and days are alike to the solver: half of
        # the difference by the rows, half by the costs.
        self._weights = np.sqrt(self._lengths / self._lengths.mean())
        self._starts = prices.start > 0
        self._drains = site.low_outlet_level is not None
        # A rise is scaled so that it costs as much as a deviation, or the solver takes ten times
        # the iterations, if it comes to an end.
        self._rise = max(1.0, prices.start / float(edges[-1]) * len(self._lengths))
        # Volumes are those that the soil keeps, here about its target.
        self._full = kept_share(site, site.x2_star) * maximum_pump_flow(site, site.a1 * site.z_o)
        n = len(self._lengths)
        self._infinite = np.full(n, np.inf)
        self._between = scipy.sparse.diags(
            [np.full(n, 0.5), np.full(n - 1, 0.5)], [0, -1], format="csc"
        )
        # Per m and m3 that is kept: more is lifted.
        self._price = prices.energy / float(edges[-1]) * WATER_DENSITY * site.g / JOULES_PER_KWH
        self._price /= kept_share(site, site.x2_star)
        self._groups: Groups = np.empty((0, n), dtype=np.intp)

    def _set_up(self, groups: Groups) -> None:
        """Set the solver up for members that are in these groups."""
        n, members = len(self._lengths), len(groups)
        self._groups, self._members = groups, members
        hessian, linear = self._objective()
        self._cost = linear  # of a member
        cost = np.tile(linear, members) / members
        quadratic = [scipy.sparse.csc_matrix(hessian / members)] * members
        self._columns = len(linear)
        # From the variables, in which the volumes of a group are there once, to all members'.
        self._spread = spread = self._shared()
        self._first = np.asarray(spread.argmax(axis=0)).ravel()
        zero = np.zeros((members, n))
        ahead, matrix = None, self._matrix()
        if self._drains:
            ahead = CisternAhead(0.0, zero, zero + 1.0, zero[0], zero, zero + self._full)
            self._mark_shares(matrix, self._matrix(share=0.5))
        lower, upper = self._bounds(zero, zero, self._full, 0.0, ahead)
        self._solver = osqp.OSQP()
        self._solver.setup(
            P=scipy.sparse.triu(
                n * spread.T @ scipy.sparse.block_diag(quadratic) @ spread, format="csc"
            ),
            q=n * spread.T @ cost,
            A=matrix,
            l=lower,
            u=upper,
            max_iter=self._max_iterations,
            **{**_SOLVER_SETTINGS, **(_ENSEMBLE_SETTINGS if members > 1 else {})},
        )

    def solve(
        self,
        mean: Array,
        most: Array,
        full: float,
        flow: float,
        guess: Array | None,
        groups: Groups,
        ahead: CisternAhead | None = None,
    ) -> Array | None:
        """Solve it; see :class:`greenroof_ros.controllers.objective.Program`."""
        if not np.array_equal(groups, self._groups):
            self._set_up(groups)
        lower, upper = self._bounds(mean, most, full, flow, ahead)
        self._solver.update(l=lower, u=upper)
        if ahead is not None:
            shares = self._share_weights * ahead.share[self._share_steps]
            self._solver.update(Ax=shares, Ax_idx=self._share_entries)
            if self._price:
                self._solver.update(q=self._linear(ahead))
        if guess is not None:
            self._solver.warm_start(x=self._variables(guess, mean, flow, ahead)[self._first])
        result = self._solver.solve(raise_error=False)
        self.status = int(result.info.status_val)
        self.cost = math.nan
        variables = self._spread @ result.x
        blocks = variables[: self._members * self._columns].reshape(self._members, -1)
        volumes = blocks[:, : len(self._lengths)]
        if self.status not in _USABLE or not np.isfinite(volumes).all():
            return None
        self.cost = float(result.info.obj_val) / len(self._lengths)
        # The solver ends within its tolerance of the constraints, on either side.
        return np.asarray(np.maximum.accumulate(np.clip(volumes, 0.0, most), axis=1))

    def _matrix(self, share: float = 1.0) -> Matrix:
        """Return the constraints; of a cistern with a low outlet if it leaves that share."""
        blocks = [self._rows(share)] * self._members
        matrix = scipy.sparse.block_diag(blocks, format="csc")
        matrix = scipy.sparse.csc_matrix(matrix @ self._spread)
        matrix.sort_indices()
        return matrix

    def _mark_shares(self, whole: Matrix, half: Matrix) -> None:
        """Find the entries that go with the share that a step's outlets leave, of 1 and of 1/2."""
        entries = np.flatnonzero(whole.data != half.data)
        n, rows = len(self._lengths), self._rows(1.0).shape[0]
        member, row = np.divmod(whole.indices[entries], rows)
        # A member's last rows but n are those with the shares.
        self._share_entries = entries.astype(np.int32)
        self._share_steps = member, row - (rows - 2 * n)
        self._share_weights = whole.data[entries]

    def _rows(self, share: float) -> Matrix:
        """Return the constraints of one member: on volumes, scaled deviations, rises, surplus."""
        n = len(self._lengths)
        eye = scipy.sparse.identity(n, format="csc")
        none = scipy.sparse.csc_matrix((n, n))
        step = self._step()
        scaled = scipy.sparse.diags([self._weights], [0]) @ self._between
        rows = [[_CAPACITY * step, none], [scaled, -eye], [scaled, eye], [_VOLUME * eye, none]]
        if self._starts:
            # Each rise of the flow (share of the full one), of the first step from what flows now.
            flow = scipy.sparse.diags([1 / self._lengths], [0]) @ step / self._full
            rise = flow - scipy.sparse.diags([np.ones(n - 1)], [-1]) @ flow
            rows = [[*row, none] for row in rows] + [
                [-self._rise * rise, none, eye], [none, none, eye]
            ]
        if self._drains:
            before = scipy.sparse.diags([np.ones(n - 1)], [-1])
            between = [none] * (len(rows[0]) - 1)
            rows = [[*row, none] for row in rows] + [
                [_BALANCE * step, *between, _BALANCE * (eye - before)],
                [_BALANCE * share * step, *between, _BALANCE * (eye - share * before)],
                [none, *between, eye],
            ]
        return scipy.sparse.bmat(rows, format="csc")

    def _step(self) -> Matrix:
        n = len(self._lengths)
        return scipy.sparse.diags([np.ones(n), -np.ones(n - 1)], [0, -1], format="csc")

    def _objective(self) -> tuple[Matrix, Array]:
        """Return Hessian and linear part for one member, in the mean deviation's unit."""
        n, site = len(self._lengths), self._site
        kept = kept_share(site, site.x2_star)
        price = self._price
        volume = np.zeros(n)
        volume[-1] = price * (site.d - site.z_o)
        # Friction goes with the cube of the flow; here with its square, exact at full flow.
        friction = 2 * price * site.pipe_resistance * self._full / kept**2
        step = self._step()
        hessian = [step.T @ scipy.sparse.diags([friction / self._lengths], [0]) @ step]
        if self._power == 2:
            hessian.append(scipy.sparse.diags([np.full(n, 2 / n)], [0]))
            linear = [volume, np.zeros(n)]
        else:
            hessian.append(scipy.sparse.csc_matrix((n, n)))
            linear = [volume, self._weights / n]
        if self._starts:
            hessian.append(scipy.sparse.csc_matrix((n, n)))
            linear.append(np.full(n, self._prices.start / self._seconds / self._rise))
        if self._drains:
            hessian.append(scipy.sparse.csc_matrix((n, n)))
            linear.append(np.zeros(n))
        return scipy.sparse.block_diag(hessian, format="csc"), np.concatenate(linear)

    def _linear(self, ahead: CisternAhead) -> Array:
        """Return the linear part, with what it costs to lift water from the level of each step."""
        parts = np.tile(self._cost, (self._members, 1))
        lift = self._site.d - ahead.volume / self._site.a1
        parts[:, : len(self._lengths)] = self._price * (lift @ self._step())
        return np.asarray(len(lift[0]) * self._spread.T @ (parts.ravel() / self._members))

    def _shared(self) -> Matrix:
        """Return what copies the volumes of each group to its members."""
        size, n = self._members * self._columns, len(self._lengths)
        source = np.arange(size).reshape(self._members, self._columns)
        source[:, :n] = self._groups * self._columns + np.arange(n)
        kept, column = np.unique(source.ravel(), return_inverse=True)
        return scipy.sparse.csc_matrix(
            (np.ones(size), (np.arange(size), column)), shape=(size, len(kept))
        )

    def _bounds(
        self, mean: Array, most: Array, full: float, flow: float, ahead: CisternAhead | None
    ) -> tuple[Array, Array]:
        """Return the bounds of all rows."""
        n = len(self._lengths)
        zero = np.zeros(n)
        # Where the pumps cannot lift, no bound on their commands makes them.
        flows = np.full_like(mean, full) if ahead is None else ahead.full
        largest = np.multiply(flows, self._max_command, out=np.zeros_like(mean), where=flows > 0)
        capacity = _CAPACITY * self._lengths * largest
        lower, upper = [], []
        for member, free in enumerate(self._weights * mean):
            lower += [zero, -self._infinite, -free, zero]
            upper += [capacity[member], -free, self._infinite, _VOLUME * most[member]]
            if self._starts:
                now = np.zeros(n)
                now[0] = -self._rise * flow / self._full
                lower += [now, zero]
                upper += [self._infinite, self._infinite]
            if ahead is not None:
                added = _BALANCE * ahead.rain[member]
                added[0] += _BALANCE * ahead.surplus
                lower += [-self._infinite, -self._infinite, ahead.least]
                upper += [added, ahead.share[member] * added, self._infinite]
        return np.concatenate(lower), np.concatenate(upper)

    def _variables(
        self, volumes: Array, mean: Array, flow: float, ahead: CisternAhead | None = None
    ) -> Array:
        """Return all variables at some volumes."""
        deviation = self._weights * np.abs(mean + volumes @ self._between.T)
        parts = [volumes, deviation]
        if self._starts:
            flows = np.diff(volumes, prepend=0.0, axis=1) / self._lengths / self._full
            rises = np.maximum(np.diff(flows, prepend=flow / self._full, axis=1), 0.0)
            parts.append(self._rise * rises)
        if ahead is not None:
            parts.append(ahead.left(volumes))
        return np.hstack(parts).ravel()
