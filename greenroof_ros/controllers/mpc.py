"""The paper's model predictive controller, whose quadratic program OSQP solves in every tick."""

from __future__ import annotations

import ctypes
import logging
import math
import os
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.decide import TickTimes
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.smooth import linearise
from greenroof_ros.site.site import Site

_log = logging.getLogger(__name__)

# Commands are accurate to 1e-8 (compared with an exact solution in the tests). The adaptation of
# rho is timed in iterations; timed by the clock, two equal runs would differ. A tick that needs
# more than max_iter falls back.
_SOLVER_SETTINGS: dict[str, Any] = {
    "max_iter": 4000,
    "eps_abs": 1e-10,
    "eps_rel": 1e-10,
    "rho": 1.0,
    "adaptive_rho": 1,
    "adaptive_rho_interval": 25,
    "check_termination": 5,
    "polishing": False,
    "warm_starting": True,
    "verbose": False,
}
# A command this close to a bound is set to it: ten times the solver's tolerance, a tenth of what
# the tests allow.
_AT_BOUND = 1e-9

# OSQP installs its own handler of SIGINT while it solves, and then restores the one it found: in a
# second thread, this could be the first one's, and Ctrl-C would be lost from then on.
_SOLVING = threading.Lock()
os.register_at_fork(
    before=_SOLVING.acquire, after_in_parent=_SOLVING.release, after_in_child=_SOLVING.release
)


class Mpc:
    """Minimises Eq. (11) over the look-ahead, subject to the linear model of Eq. (10).

    The states are eliminated. If U is the vector of the M commands, the predicted roof depths minus
    the target are r + G U, and the cost divided by 2 lambda leads to the program

        minimise  1/2 U' P U + q' U   subject to  0 <= U <= max_command,
        P = I + G'G / lambda,  q = G'r / lambda,

    whose entries are of the order of 1. (The cost as printed in the paper is of the order of 1e-6,
    far below OSQP's default tolerances.) If the solver does not report the program as solved, its
    result is not used: the command is 0, the pumps stay off for a tick, and ``fallbacks`` is
    incremented.

    Attributes:
        weight: lambda, the price of pumping (1); it can be changed between ticks.
        cost: J of Eq. (11) for the last tick's solution (m2); NaN after a fallback.
        status: OSQP's status value in the last tick; 1 means solved.
        fallbacks: number of ticks without a solution.
        solve_seconds: wall time of every call to :meth:`command` (s).
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "weight", 0.001, "1", 1e-9, 1e6,
            "lambda of Eq. (11): price of pumping relative to deviation", may_change=True,
        ),
        Parameter(
            "max_command", math.inf, "1", 1e-9, math.inf,
            "maximum command, by default unlimited as in the paper; a real pump cannot exceed 1",
        ),
    )
    outputs: ClassVar[Mapping[str, str]] = {
        "/controller/cost": "cost", "/controller/solver_status": "status",
    }

    def __init__(self, site: Site, weight: float, max_command: float) -> None:
        """Set up the solver once; every tick only updates its data.

        Args:
            site: parameters of the site (Table I); ``site.M`` is the look-ahead.
            weight: lambda of Eq. (11), greater than 0.
            max_command: upper bound on the commands; ``inf`` for none, as in the paper.
        """
        # Imported here: it takes half a second, and the class's parameters do not need it.
        import osqp
        import scipy.sparse

        self._site, self._p = site, plant_parameters(site)
        self.weight = weight
        self.cost = math.nan
        self.status = 0
        self.fallbacks = 0
        self.solve_seconds = TickTimes()
        self._command = 0.0
        self._max_command = max_command
        self._rain_sum = self._evapotranspiration_sum = 0.0
        self._ticks = 0

        size = site.M
        lag = np.arange(size)[:, None] - np.arange(size)[None, :]
        self._lag = np.where(lag >= 0, lag, size)
        self._identity = np.eye(size)
        # The upper triangle of P, column by column, as OSQP stores it.
        self._columns, self._rows = np.tril_indices(size)
        pattern = scipy.sparse.csc_matrix(np.triu(np.ones((size, size))))
        self._statuses = osqp.SolverStatus
        self._solver = osqp.OSQP()
        # Not every build of OSQP exports this function; the status also shows most interrupts.
        library = ctypes.CDLL(self._solver.ext.__file__)
        self._is_interrupted = getattr(library, "osqp_is_interrupted", bool)
        self._solver.setup(
            P=pattern, q=np.zeros(size), A=scipy.sparse.identity(size, format="csc"),
            l=np.zeros(size), u=np.full(size, max_command), **_SOLVER_SETTINGS,
        )

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Carry out steps 1 to 3 and 6 of the paper's algorithm.

        See :class:`greenroof_ros.controllers.protocol.Controller`.

        Steps 4 and 5, which apply the command and advance the state, are left to the plant.
        """
        started = time.perf_counter()
        site = self._site
        if not len(precipitation) == len(evapotranspiration) == site.M:
            raise ConfigurationError(
                f"the forecast of rain has {len(precipitation)} entries and the forecast of "
                f"evapotranspiration has {len(evapotranspiration)}, but the look-ahead of the "
                f"controller is M = {site.M} ticks; use the same site file for the weather node "
                "and the controller, and use all members only with lookahead"
            )
        # Step 6: the operating point. The first disturbance average is 0, as in the paper; f is
        # affine in w, so the average cancels in the prediction and only determines where b is
        # evaluated.
        x1 = site.cistern_volume(cistern_level)
        x2 = site.roof_volume(roof_level)
        rain_mean = self._rain_sum / self._ticks if self._ticks else 0.0
        evapotranspiration_mean = self._evapotranspiration_sum / self._ticks if self._ticks else 0.0
        # Steps 1 and 2.
        model = linearise(self._p, x1, x2, self._command, rain_mean, evapotranspiration_mean)
        (a11, a12), (a21, a22) = model.A
        b1, b2 = model.B
        (c11, c12), (c21, c22) = model.C
        # Eqs. (10a) and (10b): x~' = A x~ + B u + C w~ + k, with k = b - B times the last command.
        k1 = model.b[0] - b1 * self._command
        k2 = model.b[1] - b2 * self._command
        response = []  # change of the roof's depth one tick after a unit of command, two ticks, ...
        free = []  # the roof's depth minus the target, without any command
        g1, g2 = b1, b2
        d1 = d2 = 0.0
        deviation = x2 / site.a2 - site.z_veg
        for rain, evaporated in zip(precipitation, evapotranspiration, strict=True):
            response.append(g2 / site.a2)
            g1, g2 = a11 * g1 + a12 * g2, a21 * g1 + a22 * g2
            rain -= rain_mean
            evaporated -= evapotranspiration_mean
            d1, d2 = (
                a11 * d1 + a12 * d2 + c11 * rain + c12 * evaporated + k1,
                a21 * d1 + a22 * d2 + c21 * rain + c22 * evaporated + k2,
            )
            free.append(deviation + d2 / site.a2)
        response.append(0.0)
        # Step 3.
        G = np.array(response)[self._lag]
        r = np.array(free)
        with np.errstate(all="ignore"):  # _solve rejects values that are not finite
            P = self._identity + G.T @ G / self.weight
            q = r @ G / self.weight
        solution = self._solve(P, q)
        if solution is None:
            self.fallbacks += 1
            self.cost = math.nan
            self._command = 0.0
        else:
            first, objective = solution
            # At a bound, the solver ends within its tolerance of the bound, on either side.
            if first < _AT_BOUND:
                first = 0.0
            elif first > self._max_command - _AT_BOUND:
                first = self._max_command
            self._command = first
            self.cost = 2 * self.weight * objective + float(r @ r) + deviation * deviation
            self._rain_sum += precipitation[0]
            self._evapotranspiration_sum += evapotranspiration[0]
            self._ticks += 1
        self.solve_seconds.append(time.perf_counter() - started)
        return self._command

    def skip(self) -> None:
        """Do nothing: the averages cover only ticks with a solution."""

    def statistics(self) -> dict[str, float]:
        """Return the statistics of the solver.

        See :class:`greenroof_ros.controllers.protocol.Controller`.
        """
        return self.solve_seconds.statistics(self.solve_seconds.count, self.fallbacks)

    def _solve(self, P: NDArray[np.float64], q: NDArray[np.float64]) -> tuple[float, float] | None:
        """Return the first command and the objective of the program's solution.

        Return None if the program is not finite or the solver does not report it as solved.
        """
        hessian = P[self._rows, self._columns]
        if not (np.isfinite(hessian).all() and np.isfinite(q).all()):
            # OSQP does not reject these; it returns numbers.
            self.status = int(self._statuses.OSQP_UNSOLVED)
            _log.warning("the prediction is not finite; falling back to no pumping for one tick")
            return None
        self._solver.update(q=q, Px=hessian)
        with _SOLVING:
            result = self._solver.solve(raise_error=False)
            is_interrupted = self._is_interrupted()
        info, first = result.info, float(result.x[0])
        if is_interrupted or info.status_val == self._statuses.OSQP_SIGINT:
            # Whatever its result is: the program's own handler decides what follows.
            signal.raise_signal(signal.SIGINT)
            return self._solve(P, q)
        self.status = int(info.status_val)
        if self.status != self._statuses.OSQP_SOLVED or not math.isfinite(first):
            _log.warning(
                "OSQP reports '%s'; falling back to no pumping for one tick", info.status
            )
            zeros = np.zeros_like(q)
            self._solver.warm_start(zeros, zeros)
            return None
        return first, float(info.obj_val)
