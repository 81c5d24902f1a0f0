"""Planning ahead: what ``planning_mpc`` and ``scenario_mpc`` have in common."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.controllers.after_forecast import AfterForecast
from greenroof_ros.controllers.cistern_ahead import cistern_ahead
from greenroof_ros.controllers.exact_program import ExactProgram
from greenroof_ros.controllers.objective import NO_PRICES, Prices, Program
from greenroof_ros.controllers.protocol import (
    LEAST_COMMAND,
    NO_NEW_PLAN,
    UNDECIDED,
    solver_statistics,
)
from greenroof_ros.controllers.regret_budget import RegretBudget
from greenroof_ros.controllers.roof_observer import RoofObserver
from greenroof_ros.controllers.scenario_tree import halved_by_rain
from greenroof_ros.controllers.tick_times import TickTimes
from greenroof_ros.model.look_ahead import MOST_MEMBERS
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import free_changes, kept_share, lasting_share, water_stress

_log = logging.getLogger(__name__)

# A plan is followed this long at most (s), and left when the roof has come this far off it (m3).
_LONGEST_PLAN_S = 600.0
_OFF_PLAN_M3 = 2e-3
# So often it looks (s) whether the forecast of what comes to the roof has changed by more than this
# (m); a smaller change waits for the next plan.
_LOOK_S = 60.0
_CHANGED_M = 5e-4
# So much of the pumps' flow (s) is planned beyond what the cistern has.
_BEYOND_S = 60.0
# So far below the target it follows evapotranspiration (m3), where nothing cuts the pumps.
_BELOW_TARGET_M3 = 1e-6
Array = NDArray[np.float64]


class Planner:
    """Plans the pumped flow over steps that grow, and follows the plan until something changes.

    Decided are the volumes P_i (m3) pumped from now to the end of step i, of a measured roof those
    that its soil keeps: the share 1 - S^2 that it keeps now. The pump curve is inverted exactly - a
    command is a flow over the maximum flow at the cistern's level - so that the prediction is the
    exact mass balance of Eq. (1): the roof deviates from its target by c_i + P_i at the end of step
    i, where c_i is what state, rain and evapotranspiration make of it alone
    (:func:`greenroof_ros.model.soil.free_changes`). Of what is pumped onto a measured roof a share
    is left later, since the fuller soil lets more rain pass
    (:func:`greenroof_ros.model.soil.lasting_share`); with prices, squares or a low outlet all of it
    counts as left. With the deviation taken as linear within a step the program is

        minimise    sum_i h_i |m_i + (P_{i-1} + P_i) / 2|,  m_i = (c_{i-1} + c_i) / 2
        subject to  0 <= P_i - P_{i-1} <= h_i u_max q(x1)     what the pumps can do,
                    P_i <= max_{j<=i} (-c_j)^+                pumped only while the roof is too dry,
                    P_i <= what lies above the suction level, and a minute's flow
                                                              pumped only while the cistern has it,

    plus the price of energy and of pump starts if there is one, or with squares in place of the
    absolute values. The rules on the third and fourth line are those of Eq. (3a): water is pumped
    at a time j only if it is missing then, which is more than anything pumped before. What is above
    the cistern's outlet now is not counted on in the fourth line: it may be gone in minutes. The
    minute is there because the last tick that pumps may end below the suction level: where a plan
    asks for no more than there is, that tick has too little of it, and once below, nothing works.

    Where the cistern has a low outlet, what that takes has its part in the program: what is left
    in each step (:class:`~greenroof_ros.controllers.cistern_ahead.CisternAhead`), how high it must
    be lifted from there, which is what energy costs, and how much the pumps can lift. Without one
    the lift is that from the outlet, and the flow that of now.

    Steps and forecast go on for ``days_after`` after the horizon
    (:class:`~greenroof_ros.controllers.after_forecast.AfterForecast`), since what is on the roof
    then stays there.

    With an ensemble of forecasts (``scenario_mpc``) each member has such a program, and the
    objective is the mean over the members. What is pumped until ``recourse`` is the same for all -
    one decision now - and from then on for those that newer forecasts have not told apart
    (:func:`~greenroof_ros.controllers.scenario_tree.halved_by_rain`).

    It decides again when there is no plan, the plan is 600 s old or in its last step, the roof has
    come 2 litres off it, or the forecast has changed, which it looks for once a minute. Without
    prices and without a low outlet the program is solved exactly
    (:class:`~greenroof_ros.controllers.exact_program.ExactProgram`). The others are solved by OSQP,
    whose first guess is the last solution, moved on. Where it finds no solution the
    plan is the exact one, as if there were no prices, no squares and no low outlet; ``fallbacks``
    counts it.

    From one start of the pumps to the next it waits 3600 s / ``starts_per_hour`` of the site. The
    program does not know of starts, and would have more. What evaporates meanwhile is little:
    0.05 mm at 1 mm/h and 20 starts.

    The roof's level is not taken as read, and forecasts of rain not for ever: see
    :class:`~greenroof_ros.controllers.roof_observer.RoofObserver` and
    :class:`~greenroof_ros.controllers.regret_budget.RegretBudget`.

    The children are the controllers: each has its table of parameters.

    Attributes:
        plan: a plan that was made in this tick, a row for each step, shape (steps, 3): the step's
            end (s from this tick), the mean flow of the pumps in it (m3/s), and the level of the
            roof that the program expects at its end (m), at least 0; what would drain off a roof
            that is too full is still on it. With an ensemble flow and level are the means over the
            members: until ``recourse`` the flow is that of all, from then on that of none. Shape
            (0, 3) where the last plan is followed on; one row of NaN where the controller did not
            decide.
        solves: how many programs were solved, or tried.
        fallbacks: how many of them had no solution.
        solve_seconds: wall time of each :meth:`command` (s), most of which solve nothing.
    """

    outputs: ClassVar[Mapping[str, str]] = {
        "/controller/plan": "plan",
        "/controller/planned_deviation": "planned_deviation",
        "/controller/solver_status": "status",
    }

    def __init__(
        self,
        site: Site,
        horizon: float,
        days_after: float,
        max_command: float,
        observer_time_constant: float,
        waiting_budget: float,
        waiting_share: float,
        *,
        power: float = 1,
        prices: Prices = NO_PRICES,
        recourse: float | None = None,
        max_iterations: int = 10000,
    ) -> None:
        """Set the program up once; every decision only updates it.

        Args:
            site: the parameters of Table I.
            horizon: how far to plan ahead (h).
            days_after: days that count after it.
            max_command: upper bound of the commands (1).
            observer_time_constant: over how long (s) readings of the roof's level are averaged.
            waiting_budget: what waiting for rain may cost (h of an empty roof).
            waiting_share: and besides, as a share of what plain on/off costs.
            power: of the deviation in the objective: 1, as in the paper's metric, or 2, as in its
                controller.
            prices: of energy and starts.
            recourse: from one halving of an ensemble to the next (s); None for single forecasts.
            max_iterations: OSQP's limit.
        """
        self._site = site
        self._max_command = max_command
        self._after = AfterForecast(site, horizon, days_after)
        self._edges = self._after.edges
        self._lengths = np.diff(self._edges)
        # The plan's last step is its end, for which nothing more is worth pumping.
        self._longest = min(_LONGEST_PLAN_S, float(self._edges[-2]))
        self._power = power
        self._prices = prices
        self._recourse = recourse
        self._exact = ExactProgram(self._edges, max_command)
        self._program = self._make_program(max_iterations)
        self._members = 1
        self._pumped: Array | None = None  # P at the edges, shape (members, steps + 1)
        self._inflow: Array | None = None  # to the roof, of the forecast looked at last
        self._unlooked = math.inf  # since then (s)
        self._observer = RoofObserver(site, observer_time_constant)
        self._regret_budget = RegretBudget(site, waiting_budget, waiting_share)
        self.plan = UNDECIDED
        self.solves = 0
        self.fallbacks = 0
        self.solve_seconds = TickTimes()
        self._age = 0.0  # of the plan (s)
        self._rain_counts = True  # for the plan
        self._expected = math.nan  # x2 at the next tick, if all goes to plan
        self._off_plan = 0.0  # how far x2 has come off the plan since it was made (m3)
        self._flow = 0.0  # commanded in the last tick (m3/s)
        self._since_start = math.inf  # (s)

    def _make_program(self, max_iterations: int) -> Program:
        plain = self._power == 1 and self._prices == NO_PRICES
        if plain and self._site.low_outlet_level is None:
            return self._exact
        # Its solver takes half a second to import, which those who do not need it are spared.
        from greenroof_ros.controllers.planning_program import PlanningProgram

        return PlanningProgram(
            self._site, self._edges, self._max_command, self._power, self._prices, max_iterations
        )

    @property
    def status(self) -> int:
        """Status of the last program by OSQP's numbers, 1 = solved."""
        return self._program.status

    @property
    def planned_deviation(self) -> float:
        """Objective of the last program (m3); NaN if it was not solved.

        It is the mean deviation over the horizon and the days after it, of all members, and
        prices; with squares the square root of that, so that the unit is one.
        """
        cost = self._program.cost
        return math.sqrt(cost) if self._power == 2 else cost

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[Any],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Follow the plan, or make a new one.

        See :class:`greenroof_ros.controllers.protocol.Controller`.

        The forecasts are means over the steps of
        :func:`greenroof_ros.model.look_ahead.growing_steps`; of the rain, shape
        (steps,), or with an ensemble (members, steps).
        """
        started = time.perf_counter()
        site, steps = self._site, self._after.steps
        # In one order in memory, whatever the caller's: that of numpy's sums follows it.
        rain = np.array(precipitation, dtype=float, order="C", ndmin=2)
        members = len(rain)
        most = 1 if self._recourse is None else MOST_MEMBERS
        if rain.shape[1] != steps or len(evapotranspiration) != steps or members > most:
            raise ConfigurationError(
                f"the forecasts of rain have {members} members of {rain.shape[1]} entries, that of "
                f"evapotranspiration {len(evapotranspiration)}; the plan has {steps} steps, and at "
                f"most {most} members; give weather and controller the same horizon, and only "
                "scenario_mpc all members"
            )
        if members != self._members:
            self._change_members(members)
        evaporated = np.asarray(evapotranspiration)
        x1 = site.cistern_volume(cistern_level)
        if not math.isfinite(x1 + roof_level + float(rain.sum() + evaporated.sum())):
            # Nothing can be planned on it, and OSQP would not refuse it.
            self.skip()
            return 0.0
        self.plan = NO_NEW_PLAN
        self._after.pass_tick(evaporated)
        x2 = self._observer.correct(roof_level)
        self._off_plan += x2 - self._expected
        fraction = min(self._max_command, 1.0)
        waits = self._prices == NO_PRICES or bool(rain[:, 1:].any())
        rain_counts = not self._regret_budget.judge(x1, x2, fraction, counts=waits)
        if self._must_decide(rain, evaporated, rain_counts):
            self._rain_counts = rain_counts
            if not rain_counts:
                rain[:, 1:] = 0.0
            self._decide(x1, x2, *self._after.lengthen(rain, evaporated))
        share = 0.0
        if x2 < site.x2_star and cistern_level >= site.suction_level:
            missing = site.x2_star - site.roof_volume(roof_level)
            share = self._share(x1, x2, missing, float(rain[0, 0]), float(evaporated[0]))
        self._flow = share * maximum_pump_flow(site, x1) if share else 0.0
        self._regret_budget.move(
            x1, x2, fraction, self._flow, float(rain[0, 0]), float(evaporated[0])
        )
        self._expected = self._observer.predict(
            x2, float(rain[0, 0]), float(evaporated[0]), self._flow
        )
        self._pass_tick()
        self.solve_seconds.append(time.perf_counter() - started)
        return share

    def _share(
        self, x1: float, x2: float, missing: float, rain: float, evaporated: float
    ) -> float:
        """Return the command for a roof that is too dry: the plan's, but not beyond the target.

        Args:
            x1: in the cistern (m3).
            x2: on the roof (m3).
            missing: to the target, by what the sensor reads (m3).
            rain: in the present tick (m/s).
            evaporated: in the present tick (m3/s).
        """
        site = self._site
        kept = self._kept(x2)
        stays = kept * maximum_pump_flow(site, x1)
        if stays <= 0:
            return 0.0
        share = self._planned_flow() / stays
        if site.x2_star - x2 < _OFF_PLAN_M3:
            # The pumps are cut at the target, and would start again: no more than leads there.
            if missing <= 0:
                return 0.0
            inflow = rain * site.a2 * kept - evaporated * water_stress(site, x2)
            share = min(share, ((missing - _BELOW_TARGET_M3) / site.tau - inflow) / stays)
        share = min(share, self._max_command) if share >= LEAST_COMMAND else 0.0
        return share if self._flow else self._start(share)

    def skip(self) -> None:
        """Wait for the next reading; what the plan expected of this tick has not happened."""
        self._observer.skip()
        self._regret_budget.skip()
        self.plan = UNDECIDED
        self._flow, self._expected = 0.0, math.nan
        self._pass_tick()

    def _pass_tick(self) -> None:
        self._age += self._site.tau
        self._unlooked += self._site.tau
        self._since_start += self._site.tau

    def _start(self, share: float) -> float:
        """Return the command of pumps that stand still: 0 while it is too early for a start."""
        # Half a tick less: the sum of the ticks is rounded.
        if self._since_start < 3600 / self._site.starts_per_hour - self._site.tau / 2:
            return 0.0
        if share:
            self._since_start = 0.0
        return share

    def statistics(self) -> dict[str, float]:
        """Return the solver's figures.

        See :class:`greenroof_ros.controllers.protocol.Controller`.
        """
        return solver_statistics(self.solves, self.fallbacks, self.solve_seconds)

    def _change_members(self, members: int) -> None:
        """Go on with another number of forecasts; what is planned for now stays."""
        self._members = members
        if self._pumped is not None:
            self._pumped = np.repeat(self._pumped[:1], members, axis=0)
        self._inflow, self._unlooked = None, math.inf

    def _must_decide(self, rain: Array, evaporated: Array, rain_counts: bool) -> bool:
        """Whether plan, state or forecast has changed."""
        changed = self._unlooked >= _LOOK_S and self._forecast_changed(rain, evaporated)
        if changed or self._pumped is None or self._age >= self._longest:
            return True
        return rain_counts != self._rain_counts or not abs(self._off_plan) <= _OFF_PLAN_M3

    def _forecast_changed(self, rain: Array, evaporated: Array) -> bool:
        """Look at the forecast, and return whether it is another than at the last look."""
        before, lengths = self._inflow, self._lengths[: self._after.steps]
        self._inflow = np.cumsum((rain * self._site.a2 - evaporated) * lengths, axis=1)
        self._unlooked = 0.0
        most = _CHANGED_M * self._site.a2
        return before is None or bool(np.abs(self._inflow - before).max() > most)

    def _planned_flow(self) -> float:
        """Return the plan's mean flow into the soil in the present tick (m3/s), of all members."""
        if self._pumped is None or self._age >= self._edges[-1]:
            return 0.0
        tau = self._site.tau
        begin, end = np.interp((self._age, self._age + tau), self._edges, self._pumped[0])
        return float((end - begin) / tau)

    def _decide(self, x1: float, x2: float, rain: Array, evaporated: Array) -> None:
        """Make a new plan; where the solver finds none, the exact one without prices."""
        site = self._site
        start = np.zeros((self._members, 1))
        weather = rain, evaporated, self._lengths
        changes = free_changes(site, x2, *weather)
        inflow = np.cumsum(changes, axis=1)
        before = x2 - site.x2_star + np.hstack([start, inflow])
        missing = np.maximum.accumulate(np.maximum(-before, 0.0), axis=1)[:, 1:]
        # What will be above the suction level by then, and below the outlet.
        collected = np.cumsum(rain * self._lengths, axis=1) * site.effective_catchment
        there = np.minimum(x1 + collected, site.a1 * site.z_o)
        full = maximum_pump_flow(site, x1)
        if site.mains_level is not None and site.mains_flow is not None:
            filled = site.cistern_volume(site.mains_level)
            given = site.mains_flow * self._edges[1:]
            there = np.maximum(there, np.minimum(x1 + collected, filled) + given)
        slack = max(_BEYOND_S, site.tau) * full
        kept = self._kept(x2)
        there = kept * np.maximum(there - site.a1 * site.suction_level + slack, 0.0)
        ahead = None
        if site.low_outlet_level is not None:
            ahead = cistern_ahead(site, x1, rain, self._lengths, slack, kept)
        self.solves += 1
        problem = (
            (before[:, :-1] + before[:, 1:]) / 2,
            np.minimum(missing, there),
            kept * full,
            kept * self._flow,
            self._moved_on(),
            halved_by_rain(rain, self._edges, self._recourse or math.inf),
        )
        pumped, lasting = None, None
        if self._program is not self._exact:
            pumped = self._program.solve(*problem, ahead)
            if pumped is None:
                self.fallbacks += 1
                if self.fallbacks == 1:
                    _log.warning(
                        "OSQP's status is %d; planning without prices, squares and low outlet "
                        "instead; further ones are only counted", self.status,
                    )
        if pumped is None:
            lasting = lasting_share(site, x2, changes, *weather)
            pumped = self._exact.solve(
                *problem, None, lasting, None if lasting is None else there
            )
        self._pumped = np.hstack([start, pumped])
        self._age = self._off_plan = 0.0
        flows = np.diff(self._pumped) / self._lengths / kept
        if lasting is not None:
            pumped = lasting * np.cumsum(np.diff(self._pumped) / lasting, axis=1)
        levels = np.maximum(before[:, 1:] + pumped + site.x2_star, 0.0) / site.a2
        self.plan = np.column_stack(
            (self._edges[1:], flows.mean(axis=0), levels.mean(axis=0))
        )[: self._after.steps]

    def _kept(self, x2: float) -> float:
        """Return the share of a pumped volume that the soil keeps; no more is on it than x2*."""
        return kept_share(self._site, min(x2, self._site.x2_star))

    def _moved_on(self) -> Array | None:
        """Return the plan as it is from now on, shape (members, steps)."""
        if self._pumped is None:
            return None
        ends = np.minimum(self._edges[1:] + self._age, self._edges[-1])
        times = np.concatenate(([self._age], ends))
        volumes = np.stack([np.interp(times, self._edges, pumped) for pumped in self._pumped])
        return np.asarray(volumes[:, 1:] - volumes[:, :1])
