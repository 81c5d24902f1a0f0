"""A predictive controller that plans half a day ahead, on the exact mass balance."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence

import numpy as np
import osqp
import scipy.sparse
from numpy.typing import NDArray

from greenroof_ros.errors import ConfigurationError
from greenroof_ros.look_ahead import growing_steps
from greenroof_ros.plant import maximum_pump_flow
from greenroof_ros.site import Site

_log = logging.getLogger(__name__)

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
# Weights of the rows of what the pumps can do, and of the volumes; of 1 to 20 the least iterations.
_CAPACITY, _VOLUME = 5.0, 2.0
_USABLE = (osqp.SolverStatus.OSQP_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE)
# A plan is followed this long at most (s), and left when the roof is this far from it (m3).
_LONGEST_PLAN_S = 60.0
_OFF_PLAN_M3 = 1e-4
# Less is the solver's tolerance (share of the maximum flow).
_LEAST_COMMAND = 1e-5
_JOULES_PER_KWH = 3.6e6
_WATER = 1000.0  # kg/m3

Array = NDArray[np.float64]


class PlanningMpc:
    """Plans the pumped flow over steps that grow, and follows the plan until something changes.

    Decided are the volumes P_i (m3) pumped from now to the end of step i. The pump curve is
    inverted exactly - a command is a flow over the maximum flow at the cistern's level - so that
    the prediction is the exact mass balance of Eq. (1): the roof deviates from its target by
    c_i + P_i at the end of step i, where c_i is what state, rain and evapotranspiration make of it
    alone.
    With the deviation taken as linear within a step the program is

        minimise    sum_i h_i |m_i + (P_{i-1} + P_i) / 2|,  m_i = (c_{i-1} + c_i) / 2
        subject to  0 <= P_i - P_{i-1} <= h_i u_max q(x1)     what the pumps can do,
                    P_i <= max_{j<=i} (-c_j)^+                pumped only while the roof is too dry,
                    P_i <= what lies above the suction level  pumped only while the cistern has it,

    plus the price of energy and of pump starts if there is one, or with squares in place of the
    absolute values. The rules on the third and fourth line are those of Eq. (3a): water is pumped
    at a time j only if it is missing then, which is more than anything pumped before. What the
    cistern loses over its outlet is left out of the fourth line on the safe side.

    Each deviation is scaled by its step's length, so that seconds and hours are alike to the
    solver. It decides anew when there is no plan, the plan is 60 s old, the roof is not where the
    plan has it, or the forecast has changed; the last solution, moved on, is its first guess. A
    tick without a solution follows the last plan, which was good for the whole horizon;
    ``fallbacks`` counts it.

    Attributes:
        fallbacks: how many programs had no solution.
        status: OSQP's status value of the last program, 1 = solved.
        cost: its objective: the mean deviation over the horizon (m3); NaN after a fallback.
        solve_seconds: wall time of each :meth:`command` (s).
    """

    def __init__(
        self,
        site: Site,
        horizon: float,
        max_command: float = 1.0,
        power: float = 1.0,
        energy_weight: float = 0.0,
        start_weight: float = 0.0,
        max_iterations: int = 4000,
    ) -> None:
        """Set the program up once; every decision only updates it.

        Args:
            site: the parameters of Table I.
            horizon: how far to plan ahead (h).
            max_command: upper bound of the commands (1).
            power: of the deviation in the objective: 1, as in the paper's metric, or 2, as in its
                controller.
            energy_weight: what a kWh of hydraulic energy counts as deviation (m3 s).
            start_weight: what a pump start at full flow counts as deviation (m3 s).
            max_iterations: OSQP's limit.

        Raises:
            ConfigurationError: the power is neither 1 nor 2.
        """
        if power not in (1.0, 2.0):
            raise ConfigurationError("must be 1 or 2", key="power", value=power)
        self._site = site
        self._max_command = max_command
        self._quadratic = power == 2.0
        self._starts = start_weight > 0
        self.fallbacks = 0
        self.status = 0
        self.cost = math.nan
        self.solve_seconds: list[float] = []
        self._edges = growing_steps(horizon)
        self._lengths = np.diff(self._edges)
        self._seconds = float(self._edges[-1])
        self._pumped: Array | None = None  # P at the edges, of the plan
        self._age = 0.0  # of the plan (s)
        self._expected = math.nan  # x2 at the next tick, if all goes to plan
        self._inflow: Array | None = None  # of the last tick's forecast, see _inflow_by_step
        self._flow = 0.0  # commanded in the last tick (m3/s)
        self._solver = osqp.OSQP()
        self._set_up(energy_weight, start_weight, max_iterations)

    def _set_up(self, energy_weight: float, start_weight: float, max_iterations: int) -> None:
        """Build the program; its variables are P, the scaled deviations, and starts if priced."""
        site, lengths = self._site, self._lengths
        n = len(lengths)
        # Scaled so that they are 1 on average.
        self._weights = lengths / lengths.mean()
        eye = scipy.sparse.identity(n, format="csc")
        none = scipy.sparse.csc_matrix((n, n))
        step = scipy.sparse.diags([np.ones(n), -np.ones(n - 1)], [0, -1], format="csc")
        middle = scipy.sparse.diags([np.full(n, 0.5), np.full(n - 1, 0.5)], [0, -1], format="csc")
        self._middle = middle
        scaled = scipy.sparse.diags([self._weights], [0]) @ middle
        rows = [[_CAPACITY * step, none], [scaled, -eye], [scaled, eye], [_VOLUME * eye, none]]
        full = maximum_pump_flow(site, site.a1 * site.z_o)
        # In the objective everything is mean deviation (m3): per second of the horizon.
        price = energy_weight / self._seconds * _WATER * site.g / _JOULES_PER_KWH  # per m3 and m
        linear = [np.zeros(n), np.zeros(n) if self._quadratic else np.full(n, 1 / n)]
        linear[0][-1] = price * (site.d - site.z_o)
        friction = 2 * price * site.pipe_resistance * full
        hessian = [step.T @ scipy.sparse.diags([friction / lengths], [0]) @ step]
        hessian.append(
            scipy.sparse.diags([2 / self._weights / n], [0]) if self._quadratic else none
        )
        if self._starts:
            # Each rise of the flow, of the first step from what flows now.
            rise = scipy.sparse.diags([1 / lengths], [0]) @ step / full
            rise = rise - scipy.sparse.diags([np.ones(n - 1)], [-1]) @ rise
            rows = [[*row, none] for row in rows] + [[-rise, none, eye], [none, none, eye]]
            linear.append(np.full(n, start_weight / self._seconds))
            hessian.append(none)
        self._full = full
        self._infinite = np.full(n, np.inf)
        lower, upper = self._bounds(np.zeros(n), np.zeros(n), full, 0.0)
        self._solver.setup(
            P=scipy.sparse.triu(scipy.sparse.block_diag(hessian), format="csc"),
            q=np.concatenate(linear),
            A=scipy.sparse.bmat(rows, format="csc"),
            l=lower,
            u=upper,
            max_iter=max_iterations,
            **_SOLVER_SETTINGS,
        )

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Follow the plan, or make a new one; see :class:`greenroof_ros.controllers.Controller`.

        The forecasts are means over the steps of :func:`greenroof_ros.look_ahead.growing_steps`.
        """
        started = time.perf_counter()
        site = self._site
        if not len(precipitation) == len(evapotranspiration) == len(self._lengths):
            raise ConfigurationError(
                f"the forecasts have {len(precipitation)} and {len(evapotranspiration)} entries, "
                f"but the plan has {len(self._lengths)} steps; give weather and controller the "
                "same horizon"
            )
        x1, x2 = site.cistern_volume(cistern_level), site.roof_volume(roof_level)
        rain, evaporated = np.asarray(precipitation), np.asarray(evapotranspiration)
        inflow = np.cumsum((rain * site.a2 - evaporated) * self._lengths)
        if self._must_decide(x2, inflow, float(rain.max()), float(evaporated.max())):
            self._decide(x1, x2, inflow, float((rain * self._lengths).sum()))
        self._inflow = inflow
        full = maximum_pump_flow(site, x1)
        share = self._planned_flow() / full if full > 0 else 0.0
        dry = roof_level < site.z_veg and cistern_level >= site.suction_level
        if not dry or share < _LEAST_COMMAND:
            share = 0.0
        share = min(share, self._max_command)
        self._flow = share * full
        self._expected = x2 + site.tau * (
            precipitation[0] * site.a2 - evapotranspiration[0] + self._flow
        )
        self._age += site.tau
        self.solve_seconds.append(time.perf_counter() - started)
        return share

    def statistics(self) -> dict[str, float]:
        """Return what the solver did; see :class:`greenroof_ros.controllers.Controller`."""
        times = np.array(self.solve_seconds or [0.0])
        return {
            "solves": len(self.solve_seconds),
            "fallbacks": self.fallbacks,
            "mean_s": float(times.mean()),
            "p99_s": float(np.percentile(times, 99)),
        }

    def _must_decide(self, x2: float, inflow: Array, rain: float, evaporated: float) -> bool:
        """Whether plan, state or forecast has changed."""
        if self._pumped is None or self._inflow is None or self._age >= _LONGEST_PLAN_S:
            return True
        if not abs(x2 - self._expected) <= _OFF_PLAN_M3:
            return True
        # Moved on by a tick, the same forecast differs by what comes in a tick at its ends.
        in_a_tick = self._site.tau * (rain * self._site.a2 + evaporated)
        return bool(np.abs(inflow - self._inflow).max() > 2 * in_a_tick + 1e-9)

    def _planned_flow(self) -> float:
        """Return what the plan has flow now (m3/s)."""
        if self._pumped is None or self._age >= self._seconds:
            return 0.0
        index = int(np.searchsorted(self._edges, self._age, side="right")) - 1
        return float((self._pumped[index + 1] - self._pumped[index]) / self._lengths[index])

    def _decide(self, x1: float, x2: float, inflow: Array, rain: float) -> None:
        """Make a new plan; keep the old one where the solver finds none."""
        site = self._site
        before = x2 - site.x2_star + np.concatenate(([0.0], inflow))
        mean = (before[:-1] + before[1:]) / 2
        missing = np.maximum.accumulate(np.maximum(-before, 0.0))[1:]
        # What is above the suction level now, or stays under the outlet until then.
        there = min(x1 + rain * site.a_in, max(x1, site.a1 * site.z_o))
        there = max(there - site.a1 * site.suction_level, 0.0)
        most = np.minimum(missing, there)
        full = maximum_pump_flow(site, x1)
        lower, upper = self._bounds(mean, most, full, self._flow)
        self._solver.update(l=lower, u=upper)
        if self._pumped is not None:
            self._solver.warm_start(x=self._guess(mean))
        result = self._solver.solve(raise_error=False)
        self.status = int(result.info.status_val)
        solution = result.x[: len(mean)]
        if self.status not in _USABLE or not np.isfinite(solution).all():
            self.fallbacks += 1
            self.cost = math.nan
            _log.warning("OSQP reports '%s'; following the last plan", result.info.status)
            return
        self.cost = float(result.info.obj_val)
        # The solver ends within its tolerance of the constraints, on either side.
        pumped = np.maximum.accumulate(np.clip(solution, 0.0, most))
        self._pumped = np.concatenate(([0.0], pumped))
        self._age = 0.0

    def _bounds(self, mean: Array, most: Array, full: float, flow: float) -> tuple[Array, Array]:
        """Return the bounds of the program's rows."""
        zero = np.zeros_like(mean)
        scaled = self._weights * mean
        lower = [zero, -self._infinite, -scaled, zero]
        upper = [
            _CAPACITY * self._lengths * full * self._max_command,
            -scaled,
            self._infinite,
            _VOLUME * most,
        ]
        if self._starts:
            now = np.zeros_like(mean)
            now[0] = -flow / self._full
            lower += [now, zero]
            upper += [self._infinite, self._infinite]
        return np.concatenate(lower), np.concatenate(upper)

    def _guess(self, mean: Array) -> Array:
        """Return the last solution, moved on to now."""
        assert self._pumped is not None
        ends = np.minimum(self._edges[1:] + self._age, self._seconds)
        now = float(np.interp(self._age, self._edges, self._pumped))
        pumped = np.interp(ends, self._edges, self._pumped) - now
        deviation = self._weights * np.abs(mean + self._middle @ pumped)
        parts = [pumped, deviation]
        if self._starts:
            flows = np.diff(pumped, prepend=0.0) / self._lengths / self._full
            parts.append(np.maximum(np.diff(flows, prepend=self._flow / self._full), 0.0))
        return np.concatenate(parts)
