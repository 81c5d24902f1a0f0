"""The controller that looks ahead: it fills the roof as far as the coming rain lets it."""

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
from greenroof_ros.controllers.order_up_to import (
    BELOW_M3,
    OrderUpTo,
    Policy,
    halved_by_rain,
)
from greenroof_ros.controllers.regret_budget import WAITING_BUDGET, WAITING_SHARE, RegretBudget
from greenroof_ros.controllers.roof_observer import OBSERVER_TIME_CONSTANT, RoofObserver
from greenroof_ros.controllers.tick_times import TickTimes
from greenroof_ros.controllers.trust import TRUST_MEMORY, Trust
from greenroof_ros.model.look_ahead import LONGEST_HORIZON, MOST_MEMBERS
from greenroof_ros.model.plant import command_to, maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of

_HOUR_S = 3600.0
# A plan is followed for so long (s), and this share of the horizon, at most.
_LONGEST_PLAN_S = 3600.0
_LONGEST_SHARE = 1 / 48
# So often it looks (s) whether the rain of a member's forecast, with what has fallen since the
# plan, is another by more than this (m); what comes at another time waits for the next plan.
_LOOK_S = 60.0
_CHANGED_M = 1e-3
# In a plan for an ensemble a step is at least so long (s), and at least this share of the time
# until then: the forecasts are out by more.
_LEAST_STEP_S = 3600.0
_LEAST_SHARE = 1 / 8
# It pumps nothing at commands below it (1), so that no smaller bound is useful.
_LEAST_COMMAND = 1e-5
Array = NDArray[np.float64]

# In place of a plan: where the last one is followed on, and where the controller did not decide.
_NO_NEW_PLAN, _UNDECIDED = np.empty((0, 4)), np.full((1, 4), np.nan)


class Lookahead:
    """Fills the roof to the level that is best for the rain to come, and holds it there.

    The level comes from :class:`~greenroof_ros.controllers.order_up_to.OrderUpTo`, for all members
    of an ensemble of forecasts or for a single one, over steps that grow, and the days after the
    forecast (:class:`~greenroof_ros.controllers.after_forecast.AfterForecast`). What is known of
    the members' future says
    :func:`~greenroof_ros.controllers.order_up_to.halved_by_rain`. Without a forecast it fills the
    roof to its target and holds it there, which is best if no rain comes; but what is missing for a
    moment ends no wait for rain, since the last plan is followed until it is old.

    It plans again when the plan is an hour old, or a 48th of the horizon, and when a member's rain
    has become more or less. Between plans it follows the levels of the last one, which it has for
    whatever the roof holds. The steps of a plan for an ensemble are longer than its forecasts'.

    Of quiet hours it plans to pump nothing: the flow that a step may have is less by the share of
    it that is quiet. It plans again when they begin and end.

    From one start of the pumps to the next it waits 3600 s / ``starts_per_hour`` of the site. At
    the level it follows evapotranspiration with a small flow, which needs no starts.

    The roof's level is not taken as read, and forecasts of rain are trusted as far as that paid of
    late, and not for ever: see :class:`~greenroof_ros.controllers.roof_observer.RoofObserver`,
    :class:`~greenroof_ros.controllers.trust.Trust` and
    :class:`~greenroof_ros.controllers.regret_budget.RegretBudget`.

    Attributes:
        fill_to: level of the roof (m) to which it is filled, or at which it is held, in this tick;
            NaN where it is left alone, and where the controller did not decide.
        trust: share of the room for forecast rain that is left (1).
        plan: a plan that was made in this tick, a row for each step, shape (steps, 4): the step's
            end (s from this tick), the mean flow of the pumps in it (m3/s), and the level of the
            roof that is expected at its end (m), both means over the members; and the level to
            which the roof is filled in it if no rain has come until then (m), 0 where it is left
            alone. Shape (0, 4) where the last plan is followed on; one row of NaN where the
            controller did not decide.
        planned_deviation: mean deviation over the horizon and the days after it, of all members,
            that the last plan expects (m3); NaN before the first.
        solves: how many plans were made.
        solve_seconds: wall time of each :meth:`command` (s); most plan nothing.
        time_ns: the time (ns since 1970), at a site with quiet hours.
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (
        HORIZON,
        DAYS_AFTER,
        Parameter(
            "max_command", 1.0, "1", _LEAST_COMMAND, math.inf,
            "largest command; 1 is the most of a real pump",
        ),
        Parameter(
            "recourse", 48.0, "h", 1.0, LONGEST_HORIZON, "until then one level serves all members; "
            "each time it has passed, newer forecasts tell which half of them was wrong",
        ),
        Parameter(
            "cvar_level", 0.0, "1", 0.0, 0.99, "share of the members, those with the least "
            "deviation, that do not count: 0 for the mean of all, 0.8 for the worst fifth",
        ),
        OBSERVER_TIME_CONSTANT,
        TRUST_MEMORY,
        WAITING_BUDGET,
        WAITING_SHARE,
    )
    ensemble: ClassVar[bool] = True
    needs_forecast: ClassVar[bool] = False
    outputs: ClassVar[Mapping[str, str]] = {
        "/controller/fill_to": "fill_to",
        "/controller/plan": "plan",
        "/controller/trust": "trust",
        "/controller/planned_deviation": "planned_deviation",
    }

    def __init__(
        self,
        site: Site,
        horizon: float,
        days_after: float,
        max_command: float,
        recourse: float,
        cvar_level: float,
        observer_time_constant: float,
        trust_memory: float,
        waiting_budget: float,
        waiting_share: float,
    ) -> None:
        """Take the site and the parameters; :attr:`parameters` has their units and meanings."""
        self._site, self._soil = site, soil_of(site)
        self._max_command = max_command
        self._recourse = recourse * _HOUR_S
        self._after = AfterForecast(site, horizon, days_after)
        self._lengths = np.diff(self._after.edges)
        self._longest = min(_LONGEST_PLAN_S, _LONGEST_SHARE * horizon * _HOUR_S)
        edges = self._after.edges
        forecast_edges, days = (
            edges[: self._after.steps + 1], range(self._after.steps + 1, len(edges))
        )
        self._plan_edges = [
            [*_put_together(forecast_edges, site.tau, 0.0), *days],
            [*_put_together(forecast_edges, max(site.tau, _LEAST_STEP_S), _LEAST_SHARE), *days],
        ]
        self._program = OrderUpTo(site, cvar_level)
        self._observer = RoofObserver(site, observer_time_constant)
        self._trust = Trust(site, self._program, trust_memory)
        self._regret_budget = RegretBudget(site, waiting_budget, waiting_share)
        self._policy: Policy | None = None
        self._age = 0.0  # of the policy (s)
        self._rain_counts = True  # for the policy
        self._unlooked = 0.0  # at the forecast (s)
        self._planned_rain: Array = np.zeros(0)  # in its horizon, by member (m)
        self._fallen = 0.0  # since then (m)
        self._flow = 0.0  # commanded in the last tick (m3/s)
        self._since_start = math.inf  # (s)
        self._quiet_when_planned = False
        self.time_ns = 0
        self.fill_to = math.nan
        self._rows: Array | Callable[[], Array] = _UNDECIDED
        self.planned_deviation = math.nan
        self.solves = 0
        self.solve_seconds = TickTimes()

    @property
    def learned(self) -> dict[str, float]:
        """What waiting has cost, and how far forecasts are trusted, and why."""
        return {**self._regret_budget.learned, **self._trust.learned}

    @learned.setter
    def learned(self, values: Mapping[str, float]) -> None:
        values = {name: values[name] for name in self.learned}  # all of it, or nothing
        self._regret_budget.learned = values
        self._trust.learned = values

    @property
    def trust(self) -> float:
        """Share of the room for forecast rain that is left (1)."""
        return self._trust.share

    @property
    def plan(self) -> Array:
        """The plan, which is worked out when it is asked for: few do."""
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
        """Follow the levels of the last plan, or plan again.

        See :class:`greenroof_ros.controllers.protocol.Controller`.

        The forecasts are means over the steps of
        :func:`greenroof_ros.model.look_ahead.growing_steps`; of the rain, shape (members, steps).
        """
        started = time.perf_counter()
        site = self._site
        rain, evaporated = np.empty((1, 0)), np.empty(0)
        if np.size(precipitation) or np.size(evapotranspiration):
            forecast = precipitation, evapotranspiration
            rain, evaporated = self._after.checked(*forecast, MOST_MEMBERS)
        x1 = site.cistern_volume(cistern_level)
        if not math.isfinite(x1 + roof_level + float(rain.sum() + evaporated.sum())):
            self.skip()
            return 0.0
        self._rows = _NO_NEW_PLAN
        quiet = site.quiet is not None and site.quiet.quiet_at(self.time_ns)
        x2 = self._observer.correct(roof_level)
        fraction = min(self._max_command, 1.0)
        rain_counts = not self._regret_budget.judge(x1, x2, fraction)
        if evaporated.size:
            self._after.pass_tick(evaporated)
            if self._must_plan(rain, rain_counts) or quiet != self._quiet_when_planned:
                self._rain_counts, self._quiet_when_planned = rain_counts, quiet
                self._planned_rain = self._total(rain)
                if not rain_counts:
                    rain[:, 1:] = 0.0
                self._plan(x1, x2, *self._after.lengthen(rain, evaporated))
        elif self._age >= self._longest or rain_counts != self._rain_counts:
            self._policy = None
        now = (float(rain[0, 0]), float(evaporated[0])) if evaporated.size else (0.0, 0.0)
        self._fallen += now[0] * site.tau
        if self._trust.pass_tick(x2, *now):
            able = cistern_level >= site.suction_level and not quiet
            most = self._most_flow(x1) if able else 0.0
            self._trust.move(most, functools.partial(self._levels, x1))
        level = -1.0 if quiet else float(self._levels(x1, x2, self._trust.share))
        share = 0.0
        if level >= x2 and cistern_level >= site.suction_level:
            share = self._share(x1, x2, level, *now)
        self.fill_to = site.roof_level(level) if level >= x2 else math.nan
        self._flow = share * maximum_pump_flow(site, x1) if share else 0.0
        predicted = max(0.0, self._observer.predict(x2, *now, self._flow))
        self._regret_budget.move(x1, x2, predicted, 0.0 if quiet else fraction, self._flow, *now)
        self._pass_tick()
        self.solve_seconds.append(time.perf_counter() - started)
        return share

    def skip(self) -> None:
        """Wait for the next reading."""
        self._observer.skip()
        self._regret_budget.skip()
        self._rows, self.fill_to = _UNDECIDED, math.nan
        self._flow = 0.0
        self._pass_tick()

    def statistics(self) -> dict[str, float]:
        """Return how many plans were made, and the time of a tick.

        See :class:`greenroof_ros.controllers.protocol.Controller`.
        """
        return self.solve_seconds.statistics(self.solves, 0)

    def _must_plan(self, rain: Array, rain_counts: bool) -> bool:
        """Whether the plan is old, or the forecast another than it was."""
        if self._policy is None or self._age >= self._longest:
            return True
        if rain_counts != self._rain_counts or len(rain) != len(self._planned_rain):
            return True
        if self._unlooked < _LOOK_S:
            return False
        self._unlooked = 0.0
        total = self._total(rain) + self._fallen
        return float(np.abs(total - self._planned_rain).max()) > _CHANGED_M

    def _total(self, rain: Array) -> Array:
        """Return what rain is forecast in all (m), shape (members,)."""
        return np.asarray(np.add.reduce(rain * self._lengths[: self._after.steps], axis=1))

    def _plan(self, x1: float, x2: float, rain: Array, evaporated: Array) -> None:
        """Find the levels for the forecast, whose members' order changes no bit of them."""
        chosen = self._plan_edges[len(rain) > 1]
        edges = self._after.edges[chosen]
        rain = self._means(rain[np.lexsort(rain.T[::-1])], chosen)
        evaporated = self._means(evaporated, chosen)
        flow = np.full(len(edges) - 1, self._most_flow(x1))
        if self._site.quiet is not None:
            flow *= self._site.quiet.pumping_shares(self.time_ns, edges)
        groups = halved_by_rain(rain, edges, self._recourse)
        self._policy = self._program.solve(edges, x1, x2, rain, evaporated, flow, groups)
        self._age = self._fallen = 0.0
        self.solves += 1
        self.planned_deviation = self._policy.cost
        inputs = x1, x2, rain, evaporated, flow
        self._rows = functools.partial(self._plan_of, self._policy, inputs)

    def _plan_of(
        self, policy: Policy, inputs: tuple[float, float, Array, Array, Array]
    ) -> Array:
        """Return the rows of :attr:`plan`; the inputs are those that the policy was found for."""
        x1, x2, rain, evaporated, flow = inputs
        flows, roofs, _ = self._program.follow(policy, *inputs, self.trust)
        driest = int((rain @ np.diff(policy.edges)).argmin())
        dry = x1, x2, np.zeros_like(rain[:1]), evaporated, flow
        _, _, (aims,) = self._program.follow(policy, *dry, self.trust, driest)
        depths = roofs.mean(axis=0) / self._site.a2, aims / self._site.a2
        rows = policy.edges[1:], flows.mean(axis=0), *depths
        horizon = self._after.edges[self._after.steps]
        return np.asarray(np.column_stack(rows)[policy.edges[1:] <= horizon])

    def _means(self, rates: Array, chosen: list[int]) -> Array:
        """Return means over a plan's steps of means over the forecast's, both on the last axis."""
        amounts = np.add.reduceat(rates * self._lengths, chosen[:-1], axis=-1)
        return np.asarray(amounts / np.diff(self._after.edges[chosen]))

    def _most_flow(self, x1: float) -> float:
        """Return the most that is pumped (m3/s) from a cistern of x1 (m3)."""
        # Without a bound of the commands: pumps that fill the whole soil in a second.
        full = maximum_pump_flow(self._site, x1)
        return min(self._max_command * full, self._site.z_cap) if full else 0.0

    def _levels(self, x1: float, x2: Any, trusted: Any) -> Any:
        """Return what roofs are filled to, or held at (m3); a fuller roof is left alone.

        Args:
            x1: in the cistern (m3).
            x2: on each roof (m3).
            trusted: share of the room for forecast rain that each leaves (1).
        """
        policy = self._policy
        if policy is None:
            return self._site.x2_star + 0.0 * x2
        step = int(policy.edges[1:-1].searchsorted(self._age, side="right"))
        usable = self._program.usable(x1)
        return self._program.levels(policy, step, 0, usable, x2, trusted)

    def _share(
        self, x1: float, x2: float, level: float, rain: float, evaporated: float
    ) -> float:
        """Return the command that leads to a level, and not beyond it; 0 too early for a start.

        Args:
            x1: in the cistern (m3).
            x2: on the roof (m3).
            level: to which it is filled (m3).
            rain: in the present tick (m/s).
            evaporated: in the present tick (m3/s).
        """
        share = command_to(
            self._site, self._soil, x1, x2, level - BELOW_M3, rain, evaporated
        )
        if share < _LEAST_COMMAND:
            return 0.0
        if not self._flow:
            # Half a tick less: the sum of the ticks is rounded.
            if self._since_start < _HOUR_S / self._site.starts_per_hour - self._site.tau / 2:
                return 0.0
            self._since_start = 0.0
        return min(share, self._max_command)

    def _pass_tick(self) -> None:
        self._age += self._site.tau
        self._unlooked += self._site.tau
        self._since_start += self._site.tau


def _put_together(edges: Array, shortest: float, share: float) -> list[int]:
    """Return which ends of steps stay, the first and the last too, where steps are put together.

    Args:
        edges: of all steps (s from now).
        shortest: length of a step (s), at least.
        share: of the time until it begins, likewise (1).
    """
    chosen, last = [0], len(edges) - 1
    for index, edge in enumerate(edges):
        begin = edges[chosen[-1]]
        if edge - begin >= max(shortest, share * begin):
            chosen.append(index)
    return [*(chosen[:-1] or chosen), last]
