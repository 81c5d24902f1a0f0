"""The look-ahead controller, which fills the roof as far as the coming rain allows."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.anticipating import OF_FORECAST, OF_WAITING, Anticipating, Forecasts
from greenroof_ros.controllers.decide import TickTimes
from greenroof_ros.controllers.order_up_to import BELOW_M3, OrderUpTo, halve_by_rain
from greenroof_ros.controllers.outlet import PLAN
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.tick import command_to
from greenroof_ros.site.horizon import MAX_HORIZON, Array
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

# The plan while the last plan is still followed, and if the controller did not decide.
_NO_NEW_PLAN, _UNDECIDED = np.empty((0, 4)), np.full((1, 4), np.nan)


class Lookahead(Anticipating):
    """Fills the roof to the level that best suits the coming rain, and holds it there.

    :class:`~greenroof_ros.controllers.order_up_to.OrderUpTo` finds this level, for all members of
    an ensemble of forecasts or for a single forecast, over steps of increasing length and the days
    after the forecast (:class:`~greenroof_ros.controllers.anticipating.AfterForecast`).
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
    :class:`~greenroof_ros.controllers.roof.RoofObserver` and
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
        *OF_FORECAST,
        Parameter(
            "max_command", 1.0, "1", _MIN_COMMAND, math.inf,
            "maximum command; a real pump cannot exceed 1",
        ),
        Parameter(
            "recourse", 48.0, "h", 1.0, MAX_HORIZON, "period for which a common level is chosen "
            "for all members; later forecasts are assumed to have shown which half is wrong",
        ),
        Parameter(
            "min_on", 0.0, "s", 0.0, 86_400.0, "minimum on-time of the pumps, which filling is "
            "planned to take (in a simulation, at least pump_min_on)",
        ),
        *OF_WAITING,
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
        self, site: Site, max_command: float, recourse: float, min_on: float, **waiting: float,
    ) -> None:
        """Set the site and the parameters; see :attr:`parameters` for their units and meanings."""
        super().__init__(site, min(max_command, 1.0), **waiting)
        self._max_command, self._recourse = max_command, recourse * _HOUR_S
        self._min_on = max(min_on, site.tau)
        self._max_age = min(_MAX_PLAN_S, _MAX_PLAN_SHARE * self.horizon * _HOUR_S)
        edges, steps = self._after.edges, self._after.steps
        self._plan_edges = [
            [*_merge_steps(edges[: steps + 1], max(site.tau, length), share),
             *range(steps + 1, len(edges))]
            for length, share in ((0.0, 0.0), (_MIN_STEP_S, _MIN_SHARE))
        ]
        self._program = OrderUpTo(site)
        self._planned = -math.inf  # tick of the plan that is followed
        self._checked = 0  # tick of the last comparison with its forecast
        # What the plan was made for: whether rain counts, quiet hours, number of members.
        self._basis = True, False, 0
        self._coming: Array = np.zeros(0)  # rain that the plan still expects, by member (m)
        self._runs, self._started = False, -math.inf  # the pumps, and the tick of their last start
        self._steady = math.inf  # maximum command during ``min_on`` after a start
        self._rows: Callable[[], Array] = _UNDECIDED.copy
        self.time_ns, self.solves = 0, 0
        self.fill_to = self.planned_deviation = math.nan
        self.solve_seconds = TickTimes()

    @property
    def plan(self) -> Array:
        """The plan, which is computed only when it is read."""
        return self._rows()

    def command(self, *inputs: Any) -> float:
        """Follow the levels of the last plan, or make a new plan; see :class:`.Anticipating`."""
        began = time.perf_counter()
        command = super().command(*inputs)
        self.solve_seconds.append(time.perf_counter() - began)
        return command

    def _decide(self, x1: float, x2: float, forecast: Forecasts | None) -> float:
        site = self._site
        self._rows = _NO_NEW_PLAN.copy
        self._quiet = site.quiet is not None and site.quiet.quiet_at(self.time_ns)
        old = self._seconds_since(self._planned) >= self._max_age
        if forecast is None:
            if old or self._rain_counts != self._basis[0]:
                self._planned = -math.inf
        else:
            basis = self._rain_counts, self._quiet, len(forecast[0])
            if old or basis != self._basis or self._is_wrong(forecast[0]):
                self._basis = basis
                self._plan(x1, x2, *forecast)
        self._coming = self._coming - self._now[0] * site.tau
        level, age = -1.0, self._seconds_since(self._planned)
        if not self._quiet:
            level = self._program.level(age, x1, x2) if age < math.inf else site.x2_star
        share, self.fill_to = 0.0, math.nan
        if level >= x2:
            self.fill_to = site.roof_level(level)
            if x1 / site.a1 >= site.suction_level:
                share = self._share(command_to(self._p, x1, x2, level - BELOW_M3, *self._now))
        self._runs = share > 0
        return share

    def _is_wrong(self, rain: Array) -> bool:
        """Return whether a forecast's total rain is not what the plan still expects.

        This is checked once a minute.
        """
        if self._seconds_since(self._checked) < _CHECK_S:
            return False
        self._checked = self._tick
        return float(np.abs(self._total(rain) - self._coming).max()) > _CHANGED_M

    def _total(self, rain: Array) -> Array:
        """Return the total rain in the forecast (m), shape (members,)."""
        return np.asarray(np.add.reduce(rain * self._after.lengths[: self._after.steps], axis=1))

    def _plan(self, x1: float, x2: float, rain: Array, evaporated: Array) -> None:
        """Make a plan that is bit-identical regardless of the order of the forecast's members."""
        self._planned, self._coming = self._tick, self._total(rain)
        chosen = self._plan_edges[len(rain) > 1]
        edges = self._after.edges[chosen]
        if not self._rain_counts:
            rain = np.hstack((rain[:, :1], np.zeros_like(rain[:, 1:])))
        rain, evaporated = (
            np.add.reduceat(rates * self._after.lengths, chosen[:-1], axis=-1) / np.diff(edges)
            for rates in self._after.lengthen(rain[np.lexsort(rain.T[::-1])], evaporated)
        )
        # If commands have no bound: the flow that fills the whole soil in a second.
        full = maximum_pump_flow(self._p, x1)
        flow = np.full(len(edges) - 1, full and min(self._max_command * full, self._site.z_cap))
        if self._site.quiet is not None:
            flow *= self._site.quiet.pumping_shares(self.time_ns, edges)
        groups = halve_by_rain(rain, edges, self._recourse)
        self.planned_deviation = self._program.solve(
            edges, x1, x2, rain, evaporated, flow, groups
        )
        self.solves += 1
        self._rows = functools.partial(self._make_rows, edges, rain)

    def _make_rows(self, edges: Array, rain: Array) -> Array:
        """Return :attr:`plan` for a plan's steps and rain."""
        flows, roofs, _ = self._program.simulate(rain)
        driest = int((rain @ np.diff(edges)).argmin())
        _, _, (aims,) = self._program.simulate(np.zeros_like(rain[:1]), driest)
        depths = roofs.mean(axis=0) / self._site.a2, aims / self._site.a2
        rows = np.column_stack((edges[1:], flows.mean(axis=0), *depths))
        return np.asarray(rows[rows[:, 0] <= self._after.edges[self._after.steps]])

    def _share(self, share: float) -> float:
        """Return a command within its bounds; 0 if the pumps must not start yet."""
        if share < _MIN_COMMAND:
            return 0.0
        if not self._runs:
            # Half a tick less: the sum of the ticks is rounded.
            waited, tau = self._seconds_since(self._started), self._site.tau
            self._steady = share * tau / self._min_on
            if waited < _HOUR_S / self._site.starts_per_hour - tau / 2 or (
                self._steady < _MIN_COMMAND
            ):
                return 0.0
            self._started = self._tick
        if self._seconds_since(self._started) < self._min_on:
            share = min(share, self._steady)
        return min(share, self._max_command)

    def skip(self) -> None:
        """Skip a tick without a reading."""
        super().skip()
        self._rows, self.fill_to, self._runs = _UNDECIDED.copy, math.nan, False

    def statistics(self) -> dict[str, float]:
        """Return the number of plans, and statistics of the wall times.

        See :class:`greenroof_ros.controllers.protocol.Controller`.
        """
        return self.solve_seconds.statistics(self.solves, 0)

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
