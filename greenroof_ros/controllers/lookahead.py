"""The look-ahead controller, which fills the roof as far as the coming rain allows."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.after_forecast import DAYS_AFTER, HORIZON, AfterForecast
from greenroof_ros.controllers.decide import TickTimes
from greenroof_ros.controllers.order_up_to import (
    BELOW_M3,
    OrderUpTo,
    Policy,
    halve_by_rain,
)
from greenroof_ros.controllers.outlet import PLAN
from greenroof_ros.controllers.regret_budget import WAITING_BUDGET, WAITING_SHARE, RegretBudget
from greenroof_ros.controllers.roof_observer import OBSERVER_TIME_CONSTANT, RoofObserver
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.tick import command_to
from greenroof_ros.site.horizon import MAX_HORIZON, MAX_MEMBERS
from greenroof_ros.site.site import Site

_HOUR_S = 3600.0
# A plan is followed for no longer than this (s), and no longer than this share of the horizon.
_MAX_PLAN_S = 3600.0
_MAX_PLAN_SHARE = 1 / 48
# Interval (s) at which it checks whether a member's forecast rain, plus the rain since the plan,
# has changed by more than this (m). Rain that only shifts in time waits for the next plan.
_CHECK_S = 60.0
_CHANGED_M = 1e-3
# In a plan for an ensemble, a step is at least this long (s), and at least this share of the time
# until it begins: the forecasts are less precise than that.
_MIN_STEP_S = 3600.0
_MIN_SHARE = 1 / 8
# Commands smaller than this (1) become 0, so max_command must be at least this.
_MIN_COMMAND = 1e-5
Array = NDArray[np.float64]

# The plan while the last plan is still followed, and if the controller did not decide.
_NO_NEW_PLAN, _UNDECIDED = np.empty((0, 4)), np.full((1, 4), np.nan)


class Lookahead:
    """Fills the roof to the level that best suits the coming rain, and holds it there.

    :class:`~greenroof_ros.controllers.order_up_to.OrderUpTo` finds this level, for all members of
    an ensemble of forecasts or for a single forecast, over steps of increasing length and the days
    after the forecast (:class:`~greenroof_ros.controllers.after_forecast.AfterForecast`).
    :func:`~greenroof_ros.controllers.order_up_to.halve_by_rain` describes the assumption about when
    members turn out to be wrong. Without a forecast, the controller fills the roof to its target
    and holds it there, which is the best strategy if no rain falls. If the forecast is lost for a
    short time, the controller continues to wait for rain, and follows the last plan until this plan
    is too old. During this time, the rain gauge provides the current rain, and evapotranspiration
    is assumed to be the mean of the past day. A forecast with a missing value is treated as lost.

    The controller makes a new plan when the last plan is older than an hour or a 48th of the
    horizon, whichever is less, when a member's total rain has changed, and when the budget starts
    or stops ignoring forecasts of rain. Between plans, the controller follows the levels of the
    last plan, which are known for every volume on the roof. The steps of a plan for an ensemble are
    longer than the steps of its forecasts.

    No pumping is planned in quiet hours: the maximum flow of a step is reduced by the share of the
    step that falls in quiet hours. The controller also makes a new plan when quiet hours begin and
    when they end.

    Between two starts of the pumps, the controller waits for at least 3600 s / ``starts_per_hour``
    of the site, and it fills the roof slowly enough that the pumps stay on for ``min_on``. Once the
    roof is at the level, a small flow balances evapotranspiration, so that the pumps do not have to
    start again.

    An observer filters the roof's level, and a budget limits the cost of waiting for rain:
    :class:`~greenroof_ros.controllers.roof_observer.RoofObserver` and
    :class:`~greenroof_ros.controllers.regret_budget.RegretBudget`.

    Attributes:
        horizon: length of the forecast that is used (h).
        fill_to: level (m) to which the roof is filled, or at which it is held, in this tick; NaN if
            the roof is left alone, or if the controller did not decide.
        plan: the plan made in this tick, shape (steps, 4). Each row describes a step with four
            numbers: its end (s from this tick), its mean pump flow (m3/s), the expected level on
            the roof at its end (m), and the level to which the roof is filled if no rain has come
            by then (m; 0 if the roof is left alone). Pump flow and expected level are means over
            the members. The array is empty, with shape (0, 4), while the last plan is still
            followed. If the controller did not decide, the plan has a single row of NaN.
        planned_deviation: deviation predicted by the last plan, as a mean over the horizon, the
            days after it and all members (m3); NaN before the first plan.
        solves: number of plans made.
        solve_seconds: wall time of every call to :meth:`command` (s), most of which make no plan.
        time_ns: current time (ns since 1970), set at a site with quiet hours.
        gauge_rain: rain measured by the gauge of a live site (m/s); 0 without a gauge.
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (
        HORIZON,
        DAYS_AFTER,
        Parameter(
            "max_command", 1.0, "1", _MIN_COMMAND, math.inf,
            "maximum command; a real pump cannot exceed 1",
        ),
        Parameter(
            "recourse", 48.0, "h", 1.0, MAX_HORIZON, "period for which a common level is chosen "
            "for all members; after each such period, later forecasts are assumed to have revealed "
            "which half of the members is wrong",
        ),
        Parameter(
            "min_on", 0.0, "s", 0.0, 86_400.0, "minimum on-time of the pumps (in a simulation, at "
            "least pump_min_on); filling is planned to take at least this long, so that the "
            "pumps do not keep running afterwards",
        ),
        OBSERVER_TIME_CONSTANT,
        WAITING_BUDGET,
        WAITING_SHARE,
    )
    ensemble: ClassVar[bool] = True
    outlet_policy: ClassVar[str] = PLAN
    needs_forecast: ClassVar[bool] = False
    outputs: ClassVar[Mapping[str, str]] = {
        "/controller/fill_to": "fill_to",
        "/controller/plan": "plan",
        "/controller/planned_deviation": "planned_deviation",
    }

    def __init__(
        self,
        site: Site,
        horizon: float,
        days_after: float,
        max_command: float,
        recourse: float,
        min_on: float,
        observer_time_constant: float,
        waiting_budget: float,
        waiting_share: float,
    ) -> None:
        """Set the site and the parameters; see :attr:`parameters` for their units and meanings."""
        self._site, self._p = site, plant_parameters(site)
        self.horizon, self._max_command = horizon, max_command
        self._min_on = max(min_on, site.tau)
        self._recourse = recourse * _HOUR_S
        self._after = AfterForecast(site, horizon, days_after)
        self._lengths = np.diff(self._after.edges)
        self._max_age = min(_MAX_PLAN_S, _MAX_PLAN_SHARE * horizon * _HOUR_S)
        edges = self._after.edges
        forecast_edges, days = (
            edges[: self._after.steps + 1], range(self._after.steps + 1, len(edges))
        )
        self._plan_edges = [
            [*_merge_steps(forecast_edges, site.tau, 0.0), *days],
            [*_merge_steps(forecast_edges, max(site.tau, _MIN_STEP_S), _MIN_SHARE), *days],
        ]
        self._program = OrderUpTo(site)
        self._observer = RoofObserver(site, observer_time_constant)
        self._regret_budget = RegretBudget(site, waiting_budget, waiting_share)
        self._policy: Policy | None = None
        self._age = 0.0  # age of the policy (s)
        self._rain_counts = True  # whether it counts in the policy
        self._unchecked = 0.0  # time since the forecast was last compared (s)
        self._planned_rain: Array = np.zeros(0)  # total over the forecast, by member (m)
        self._fallen = 0.0  # rain since the plan (m)
        self._flow = 0.0  # flow commanded in the last tick (m3/s)
        self._since_start = math.inf  # time since the pumps started (s)
        self._steady = math.inf  # maximum command during ``min_on`` after a start
        self._quiet_when_planned = False
        self.time_ns = 0
        self.gauge_rain = 0.0
        self.fill_to = math.nan
        self._rows: Array | Callable[[], Array] = _UNDECIDED
        self.planned_deviation = math.nan
        self.solves = 0
        self.solve_seconds = TickTimes()

    @property
    def learned(self) -> dict[str, float]:
        """The costs of waiting and of plain on/off control so far."""
        return self._regret_budget.learned

    @learned.setter
    def learned(self, values: Mapping[str, float]) -> None:
        self._regret_budget.learned = values

    @property
    def plan(self) -> Array:
        """The plan, which is computed only when it is read."""
        if not isinstance(self._rows, np.ndarray):
            self._rows = self._rows()
        return self._rows

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[Any],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Follow the levels of the last plan, or make a new plan.

        See :class:`greenroof_ros.controllers.protocol.Controller`.

        The forecasts are means over the steps of
        :func:`greenroof_ros.site.horizon.growing_steps`; rain has shape (members, steps).
        """
        started = time.perf_counter()
        site = self._site
        rain, evaporated = np.empty((1, 0)), np.empty(0)
        if np.size(precipitation) or np.size(evapotranspiration):
            forecast = precipitation, evapotranspiration
            rain, evaporated = self._after.check(*forecast, MAX_MEMBERS)
        x1 = site.cistern_volume(cistern_level)
        if not math.isfinite(x1 + roof_level):
            self.skip()
            return 0.0
        self._rows = _NO_NEW_PLAN
        quiet = site.quiet is not None and site.quiet.quiet_at(self.time_ns)
        x2 = self._observer.correct(roof_level)
        fraction = min(self._max_command, 1.0)
        rain_counts = not self._regret_budget.judge(x1, x2, fraction)
        plans = evaporated.size > 0 and (
            self._must_plan(rain, rain_counts) or quiet != self._quiet_when_planned
        )
        now = self.gauge_rain, self._after.mean
        if evaporated.size and math.isfinite(float(rain.sum() + evaporated.sum())):
            now = float(rain[0, 0]), float(evaporated[0])
            self._after.pass_tick(evaporated)
            if plans:
                self._rain_counts, self._quiet_when_planned = rain_counts, quiet
                self._planned_rain = self._total(rain)
                if not rain_counts:
                    rain = np.hstack((rain[:, :1], np.zeros_like(rain[:, 1:])))
                self._plan(x1, x2, *self._after.lengthen(rain, evaporated))
        elif self._age >= self._max_age or rain_counts != self._rain_counts:
            self._policy = None
        self._fallen += now[0] * site.tau
        level = -1.0 if quiet else self._level(x1, x2)
        share = 0.0
        if level >= x2 and cistern_level >= site.suction_level:
            share = self._share(x1, x2, level, *now)
        self.fill_to = site.roof_level(level) if level >= x2 else math.nan
        self._flow = share * maximum_pump_flow(self._p, x1) if share else 0.0
        self._observer.predict(x2, *now, self._flow)
        self._regret_budget.move(x1, x2, 0.0 if quiet else fraction, share, *now)
        self._pass_tick()
        self.solve_seconds.append(time.perf_counter() - started)
        return share

    def skip(self) -> None:
        """Skip a tick without a reading."""
        self._observer.skip()
        self._regret_budget.skip()
        self._rows, self.fill_to = _UNDECIDED, math.nan
        self._flow = 0.0
        self._pass_tick()

    def statistics(self) -> dict[str, float]:
        """Return the number of plans, and statistics of the wall times.

        See :class:`greenroof_ros.controllers.protocol.Controller`.
        """
        return self.solve_seconds.statistics(self.solves, 0)

    def _must_plan(self, rain: Array, rain_counts: bool) -> bool:
        """Return whether the plan is too old, or the forecast has changed."""
        if self._policy is None or self._age >= self._max_age:
            return True
        if rain_counts != self._rain_counts or len(rain) != len(self._planned_rain):
            return True
        if self._unchecked < _CHECK_S:
            return False
        self._unchecked = 0.0
        total = self._total(rain) + self._fallen
        return float(np.abs(total - self._planned_rain).max()) > _CHANGED_M

    def _total(self, rain: Array) -> Array:
        """Return the total rain in the forecast (m), shape (members,)."""
        return np.asarray(np.add.reduce(rain * self._lengths[: self._after.steps], axis=1))

    def _plan(self, x1: float, x2: float, rain: Array, evaporated: Array) -> None:
        """Make a plan that is bit-identical regardless of the order of the forecast's members."""
        chosen = self._plan_edges[len(rain) > 1]
        edges = self._after.edges[chosen]
        rain = self._means(rain[np.lexsort(rain.T[::-1])], chosen)
        evaporated = self._means(evaporated, chosen)
        flow = np.full(len(edges) - 1, self._max_flow(x1))
        if self._site.quiet is not None:
            flow *= self._site.quiet.pumping_shares(self.time_ns, edges)
        groups = halve_by_rain(rain, edges, self._recourse)
        self._policy = self._program.solve(edges, x1, x2, rain, evaporated, flow, groups)
        self._age = self._fallen = 0.0
        self.solves += 1
        self.planned_deviation = self._policy.cost
        inputs = x1, x2, rain, evaporated, flow
        self._rows = functools.partial(self._plan_of, self._policy, inputs)

    def _plan_of(
        self, policy: Policy, inputs: tuple[float, float, Array, Array, Array]
    ) -> Array:
        x1, x2, rain, evaporated, flow = inputs
        flows, roofs, _ = self._program.simulate(policy, *inputs)
        driest = int((rain @ np.diff(policy.edges)).argmin())
        dry = x1, x2, np.zeros_like(rain[:1]), evaporated, flow
        _, _, (aims,) = self._program.simulate(policy, *dry, driest)
        depths = roofs.mean(axis=0) / self._site.a2, aims / self._site.a2
        rows = policy.edges[1:], flows.mean(axis=0), *depths
        horizon = self._after.edges[self._after.steps]
        return np.asarray(np.column_stack(rows)[policy.edges[1:] <= horizon])

    def _means(self, rates: Array, chosen: list[int]) -> Array:
        """Average rates over the steps of a plan, along the last axis."""
        amounts = np.add.reduceat(rates * self._lengths, chosen[:-1], axis=-1)
        return np.asarray(amounts / np.diff(self._after.edges[chosen]))

    def _max_flow(self, x1: float) -> float:
        """Return the maximum pump flow (m3/s) from a cistern that holds x1 (m3)."""
        # If commands have no bound: the flow that fills the whole soil in a second.
        full = maximum_pump_flow(self._p, x1)
        return min(self._max_command * full, self._site.z_cap) if full else 0.0

    def _level(self, x1: float, x2: float) -> float:
        """Return the volume up to which the roof is filled (m3); a fuller roof is left alone.

        Args:
            x1: volume in the cistern (m3).
            x2: volume on the roof (m3).
        """
        policy = self._policy
        if policy is None:
            return self._site.x2_star
        step = int(policy.edges[1:-1].searchsorted(self._age, side="right"))
        return float(self._program.levels(policy, step, 0, self._program.cistern.usable(x1), x2))

    def _share(
        self, x1: float, x2: float, level: float, rain: float, evaporated: float
    ) -> float:
        """Return the command that fills the roof to a level; 0 if the pumps must not start yet.

        Args:
            x1: volume in the cistern (m3).
            x2: volume on the roof (m3).
            level: volume to which the roof is filled (m3).
            rain: rain in the current tick (m/s).
            evaporated: evapotranspiration in the current tick (m3/s).
        """
        share = command_to(
            self._p, x1, x2, level - BELOW_M3, rain, evaporated
        )
        if share < _MIN_COMMAND:
            return 0.0
        if not self._flow:
            # Half a tick less: the sum of the ticks is rounded.
            if self._since_start < _HOUR_S / self._site.starts_per_hour - self._site.tau / 2:
                return 0.0
            self._steady = share * self._site.tau / self._min_on
            if self._steady < _MIN_COMMAND:
                return 0.0
            self._since_start = 0.0
        if self._since_start < self._min_on:
            share = min(share, self._steady)
        return min(share, self._max_command)

    def _pass_tick(self) -> None:
        self._age += self._site.tau
        self._unchecked += self._site.tau
        self._since_start += self._site.tau


def _merge_steps(edges: Array, min_length: float, share: float) -> list[int]:
    """Return the indices of the boundaries that remain when short steps are merged.

    The first and the last boundary always remain.

    Args:
        edges: boundaries of all steps (s from now).
        min_length: minimum length of a step (s).
        share: minimum length as a share of the time until the step begins (1).
    """
    chosen, last = [0], len(edges) - 1
    for index, edge in enumerate(edges):
        begin = edges[chosen[-1]]
        if edge - begin >= max(min_length, share * begin):
            chosen.append(index)
    return [*(chosen[:-1] or chosen), last]
