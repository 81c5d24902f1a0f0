"""Everything known about one graph, as it comes: newest values, past, and reports of the nodes.

*Now* is the newest value of each topic, from either source. The *past* is what charts and
account use; it comes in the order of time, from the recording if there is one, and may be some
seconds behind. :mod:`.document` makes from it what people see.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from greenroof_ros.common.files import default_site_file
from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.states import PUMP, PUMP_STATES, PumpState
from greenroof_ros.model.look_ahead import MOST_MEMBERS
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.watch import wire, words
from greenroof_ros.watch.account import HOLDS_NS, Account
from greenroof_ros.watch.account import TOPICS as ACCOUNTED
from greenroof_ros.watch.alarms import Alarm, Alarms
from greenroof_ros.watch.history import Gaps, History, Stamps, Values
from greenroof_ros.watch.outlook import Forecast, Plan
from greenroof_ros.watch.registry import Node, Registry
from greenroof_ros.watch.wire import WireStatus

_Outlook = TypeVar("_Outlook", Forecast, Plan)

FLOW, RAIN_FORECAST = "/pump/flow", "/forecast/precipitation"
PLAN, PUMP_STATE = "/controller/plan", "/pump/state"
_NUMBER = "std_msgs/msg/Float64"
# No quantity of any site is greater than this in any unit, even if its topic has no limit.
_LARGEST = 1e9
# A value is stale after this many of its usual intervals, and at the earliest after the second (s).
# The usual interval is assumed to be at most the third (s).
INTERVALS, _STALE_S, _LONGEST_S = 3, 5.0, 600.0
# Times of a graph are before this (ns since 1970): the year 2116.
_LATEST_NS = 2**62
# An account waits for topics that are behind, until an ended run was silent for this long (s).
_QUIET_S = 2.0
# How far the system's clock may be set back, or a live site's values be ahead of it (s): that much
# is caught up within a minute.
_SET_BACK_S = 60.0
# A forecast is reported as new if its rain differs by this much (m), at most once in this time (s).
_NEW_FORECAST_M, _NEW_FORECAST_S = 2e-3, 3600.0
# How long ahead a level was predicted if it is compared with the measured level, and how often such
# a prediction is kept (s).
_LEAD_S, _EXPECTED_EVERY_S = 3600.0, 300.0
# The most steps of a forecast or a plan, as the longest look-ahead has.
_MOST_STEPS = 1000


class TopicValue:
    """The newest value of a topic, and how often values come, judged at each update.

    Attributes:
        time_ns: its time (ns since 1970).
        value: None if it is not plausible.
        past: the values before it.
        past_ns: up to when the past has come (ns since 1970).
        stale: whether the next value is overdue.
    """

    def __init__(self) -> None:
        """Start without a value."""
        self.time_ns = self.past_ns = 0
        self.value: float | None = None
        self.past = History()
        self.stale = False
        self._received = False
        self._received_at: float | None = None  # wall time (s)
        self._intervals: deque[float] = deque(maxlen=9)

    def receive(self, time_ns: int, value: float) -> None:
        """Receive a value, NaN if it is not plausible, unless there is a newer one."""
        self._received = True
        if time_ns >= self.time_ns:
            self.time_ns, self.value = time_ns, None if math.isnan(value) else value

    def update(self, wall: float, *, ended: bool) -> None:
        """Update whether the next value is overdue: never in an ended run."""
        if self._received or self._received_at is None:
            if self._received_at is not None:
                self._intervals.append(min(wall - self._received_at, _LONGEST_S))
            self._received, self._received_at = False, wall
        usual = float(np.median(self._intervals)) if self._intervals else 0.0
        self.stale = not ended and wall - self._received_at > max(_STALE_S, INTERVALS * usual)

    def silent_s(self, wall: float) -> float:
        """Return how long ago a value came (s of wall time); 0 if none ever did."""
        return 0.0 if self._received_at is None else max(0.0, wall - self._received_at)


class GraphStore:
    """The state of one graph; any thread may call any method, and read under ``lock``.

    Times of the graph are its own: simulated, or the system's. ``wall`` is the steady clock's time
    (s): setting the system's clock makes no value old or new.

    Attributes:
        lock: to be held while several attributes are read.
        namespace: of the graph; empty if it has none.
        site: the site by which levels are judged: the paper's, until another one is known.
        wall: when the store was last updated (steady clock, s).
        notes: notes to the operator about the site file, and about the graph that is watched.
        mode: ``none`` if nothing was received yet, ``simulated``, ``loop`` for a simulation with
            the drive of a real pump, ``live``, or ``ended`` for a run that is over.
        factor: simulated time per wall time; None if there is none.
        allow_release: whether the pump may be released from here.
        alarms: alarms of the nodes, and the registry of their reports.
        newest: the newest value of each topic, with its past.
        expected: the roof level as expected an hour before.
        account: the water account.
        pump_state: from a recording: when it was reported (ns since 1970), and what.
        recorded_controller: the controller of the recorded run that is shown; empty if unknown.
        recorded_incidents: the incidents of that run.
    """

    def __init__(self, namespace: str = "") -> None:
        """Start without knowing anything.

        Args:
            namespace: of the graph; empty if it has none.
        """
        self.lock = threading.RLock()
        self.namespace = namespace
        self.allow_release = False
        self.site = read_site(default_site_file())
        self.notes = ["", ""]
        self.mode = "none"
        self.factor: float | None = None
        self.recorded_controller = ""
        self.recorded_incidents: Sequence[Alarm] = ()
        self.alarms = Alarms(namespace)
        self._interface = read_topics()
        self.wall = 0.0
        self._started_at = time.time()  # s since 1970
        self._system: float | None = None  # the system's time at the last update (s since 1970)
        # The graph's time as its nodes last reported it (s since 1970); kept when a new run begins.
        self._stamp: float | None = None
        self.reset()

    def reset(self) -> None:
        """Reset everything except the nodes and how they are watched: another run began."""
        with self.lock:
            self.alarms.reset()
            self._received_since: float | None = None  # when nodes first reported (s since 1970)
            self._forget_values()

    def _forget_values(self) -> None:
        self.newest: dict[str, TopicValue] = {}
        self.expected = History()
        self._expected_at = -math.inf  # when an expected level was last kept (s since 1970)
        self._start_account()
        self._forecast: Forecast | None = None
        self._reported_forecast: tuple[float, float] | None = None  # when (s), and rain (m)
        # The present plan, and the newest of the past, or None for no plan; each with when that was
        # reported (s since 1970).
        self._plan: tuple[float, Plan | None] = -math.inf, None
        self._past_plan: tuple[float, Plan | None] = -math.inf, None
        self.pump_state: tuple[int, PumpState] | None = None
        self._controller: tuple[str, str] | None = None  # name and process
        self._controller_at = -math.inf  # when it last reported (s since 1970)
        self.unknown_flow = Gaps()
        self._clock_started_at: float | None = None  # of a simulation, if known (s since 1970)

    def _start_account(self) -> None:
        self.account = Account(self.site)
        self.account.live = self.mode == "live"

    # --- the graph that is watched --------------------------------------------------------------

    @property
    def graph(self) -> Registry:
        """The registry of the shown graph; an empty one if another graph is there."""
        return self.alarms.registry if self.alarms.shown else Registry()

    @property
    def pump(self) -> Node | None:
        """The pump node, as last received; None if there was none."""
        return self.graph.node(PUMP)

    def set_site(self, site: Site, note: str = "") -> None:
        """Set the site by which levels are judged; with another site the account starts again.

        Args:
            site: its parameters.
            note: what an operator should know about that; empty for nothing.
        """
        with self.lock:
            before, self.site = self.site, site
            if site != before:
                self._start_account()
            self.notes[0] = words.plain(note)

    def set_present(
        self, *, mode: str, factor: float | None, note: str, graph_shown: bool = True
    ) -> None:
        """Set how the graph is watched now.

        Args:
            mode: as in the attributes.
            factor: simulated time per wall time; None if there is none.
            note: what an operator should know about that; empty for nothing.
            graph_shown: whether the present graph is shown, rather than the bag of another one.
        """
        with self.lock:
            self.mode, self.alarms.shown = mode, graph_shown
            self.factor = factor if factor is not None and math.isfinite(factor) else None
            self.notes[1] = words.plain(note)
            self.account.live = mode == "live"

    def update(self, wall: float, system: float | None = None) -> None:
        """Update what is overdue; called often, even if no document is shown.

        If the clock of a live site is set back, charts and account start again: new values would be
        older than those already there.

        Args:
            wall: now.
            system: the system's time, which a live site has (s since 1970); None if unchanged.
        """
        with self.lock:
            before, self._system = self._system, self._system if system is None else system
            if self.mode == "live" and before is not None and self._system is not None and (
                back := before - self._system
            ) > _SET_BACK_S:
                self._forget_values()
                self.alarms.add_event(
                    self._system, f"The system's clock was set back by {words.length_of_time(back)}"
                    ": charts and account start again",
                )
            self.wall = wall
            for newest in self.newest.values():
                newest.update(wall, ended=self.ended)
            self._update_clock()
            self.alarms.update(wall, self._now_or(time.time()))
            if self.ended and self.silent_s > _QUIET_S:
                self.account.end()

    @property
    def silent_s(self) -> float:
        """How long no value of any topic has come (s); 0 if none ever did."""
        return min((newest.silent_s(self.wall) for newest in self.newest.values()), default=0.0)

    @property
    def ended(self) -> bool:
        """Whether the run is over: nothing more will come."""
        return self.mode == "ended"

    def is_lost(self, node: Node | None) -> bool:
        """Return whether a node was there and is silent now; False if the run is over."""
        return node is not None and not self.ended and not node.is_online(self.wall)

    @property
    def pump_report(self) -> PumpState | None:
        """The pump's state and why, from its node or else from the recording; None if unknown."""
        if self.pump is not None and (state := self.pump.text("pump_state")):
            return PumpState(
                state if state in PUMP_STATES else "unknown", self.pump.text("pump_why")
            )
        return None if self.pump_state is None else self.pump_state[1]

    # --- values ---------------------------------------------------------------------------------

    def add(self, topic: str, times_ns: Stamps, values: Values) -> None:
        """Add values of a topic of single numbers, now and for the past.

        Values that are not newer than the past are left out. Values out of the topic's range are
        shown as not plausible, and are not counted.

        Args:
            topic: its name in the interface, without a namespace.
            times_ns: since 1970, shape (n,), in their order.
            values: in the topic's unit, shape (n,).
        """
        if not self.is_number(topic) or not len(times_ns):
            return
        # A copy: the argument may be a view of a longer batch.
        times = np.array(times_ns, dtype=np.int64)
        with self.lock:
            newest = self.newest.get(topic) or TopicValue()
            possible = np.where(times < _LATEST_NS, times, 0)
            before = np.append(newest.past_ns, possible[:-1])
            newer = (possible > np.maximum.accumulate(before)) & (possible <= self._latest_ns())
            times, numbers = times[newer], self._plausible(topic, np.asarray(values)[newer])
            if not len(times):
                return
            self.newest[topic] = newest
            newest.receive(int(times[-1]), float(numbers[-1]))
            newest.past_ns = int(times[-1])
            if topic == FLOW:
                numbers[self.unknown_flow.at(times / 1e9)] = np.nan
            known = np.isfinite(numbers)
            newest.past.add(times[known], numbers[known])
            if topic in ACCOUNTED:
                self.account.add(topic, times, numbers)

    def add_present(self, topic: str, time_ns: int, value: float) -> None:
        """Add a present value; the past comes another way.

        Args:
            topic: its name in the interface, without a namespace.
            time_ns: since 1970; if there is a newer value, this one is left out.
            value: in the topic's unit.
        """
        if not self.is_number(topic):
            return
        with self.lock:
            newest = self.newest.get(topic) or TopicValue()
            if newest.time_ns < time_ns <= self._latest_ns():
                self.newest[topic] = newest
                newest.receive(time_ns, float(self._plausible(topic, np.array(value))))
                newest.past.add_ahead(time_ns, newest.value)

    def is_number(self, topic: str) -> bool:
        """Return whether the interface has this topic, and it is of single numbers."""
        return topic in self._interface and self._interface[topic].type == _NUMBER

    def _plausible(self, topic: str, values: Values) -> Values:
        """Return values of a topic, with NaN for those that are not plausible; no minus zero."""
        entry = self._interface[topic]
        low, high = max(entry.low, -_LARGEST), min(entry.high, _LARGEST)
        return np.where((values >= low) & (values <= high), values + 0.0, np.nan)

    def present_value(self, topic: str) -> float | None:
        """Return the present value of a topic; None if there is none, or it is stale."""
        newest = self.newest.get(topic)
        return None if newest is None or newest.stale else newest.value

    def _latest_ns(self) -> float:
        """Return the latest time that a value may have (ns since 1970)."""
        if self.mode == "live" and self._system is not None:
            return (self._system + _SET_BACK_S) * 1e9
        return _LATEST_NS

    def receive(self, topic: str, time_ns: int, message: bytes, *, past: bool) -> None:
        """Receive a message of a topic that is not of single numbers, live or recorded.

        Args:
            topic: its name in the interface, without a namespace.
            time_ns: since 1970.
            message: in CDR; an incomplete message is left out.
            past: for a plan, as in :meth:`add_plan`.
        """
        if topic == PUMP_STATE:
            if text := wire.text(message):
                self.add_pump_state(time_ns, text)
        elif (rows := wire.rows(message)) is None:
            return
        elif topic == PLAN:
            self.add_plan(time_ns, rows[0], past=past)
        elif topic == RAIN_FORECAST:
            self.add_forecast(time_ns, *rows)

    def add_pump_state(self, time_ns: int, message: str) -> None:
        """Add a message of /pump/state."""
        with self.lock:
            if self.pump_state is None or time_ns > self.pump_state[0]:
                state = PumpState.read(message)
                self.pump_state = time_ns, replace(state, why=words.sentence(state.why))

    # --- forecast and plan ----------------------------------------------------------------------

    def add_forecast(self, time_ns: int, values: Values, front: Values) -> None:
        """Add a forecast of rain; after one that is not valid, no forecast is known.

        Args:
            time_ns: when its first step begins, since 1970.
            values: m/s, shape (steps,), or (members, steps) for an ensemble.
            front: when it was issued (s since 1970, NaN if unknown), and the end of each step (s
                from ``time_ns``), shape (1 + steps,).
        """
        if not 0 < time_ns < _LATEST_NS:
            return
        rain = np.atleast_2d(np.asarray(values, dtype=np.float64))
        limits, at = self._interface[RAIN_FORECAST], time_ns / 1e9
        members, steps = rain.shape if rain.ndim == 2 else (0, 0)
        ends = front[1:]
        fits = (
            0 < members <= MOST_MEMBERS and 0 < steps <= _MOST_STEPS and len(ends) == steps
            and np.all(np.diff(ends, prepend=0.0) > 0) and ends[-1] < _LARGEST
            and np.all((rain >= limits.low) & (rain <= limits.high))
        )
        with self.lock:
            if not fits:
                self._forecast = None
            elif self._forecast is None or at > self._forecast.at:
                issued = float(front[0]) if 0 < front[0] <= at else None
                self._forecast = Forecast(at, at + ends, rain, issued)
                self._report_forecast(at)

    def _report_forecast(self, now: float) -> None:
        """Report an event if the expected rain has changed enough."""
        assert self._forecast is not None
        amount = self._forecast.amount(now)
        if amount is None or amount.reach_s < _NEW_FORECAST_S:
            return
        if self._reported_forecast is None:
            self._reported_forecast = (now, amount.mean)
            return
        at, before = self._reported_forecast
        if abs(amount.mean - before) >= _NEW_FORECAST_M and now - at >= _NEW_FORECAST_S:
            self._reported_forecast = (now, amount.mean)
            reach = words.horizon(amount.reach_s)
            self.alarms.add_event(
                now, f"New forecast: {words.rain(amount.mean)} of rain in the next {reach}; "
                f"before, it was {words.rain(before)}",
            )

    def add_plan(self, time_ns: int, rows: Values, *, past: bool = True) -> None:
        """Add a plan of the controller.

        Args:
            time_ns: when it was planned, since 1970; if there is a newer plan, this is left out.
            rows: of each step its end (s from then), mean flow (m3/s), expected roof level at its
                end (m), and the level to which the roof is filled if no rain has come (m), shape
                (steps, 4); older bags lack the last column. Empty: nothing has changed. With an
                impossible number: there is no plan now.
            past: whether it is of the past: all plans before it have come, and the level that it
                expects is kept.
        """
        at = time_ns / 1e9
        if not 0 < time_ns < _LATEST_NS:
            return
        with self.lock:
            if np.size(rows):
                if past and at > self._past_plan[0]:
                    self._past_plan = at, _plan_of(at, rows)
                if not past and at > self._plan[0]:
                    self._plan = at, _plan_of(at, rows)
            if past and at >= self._expected_at + _EXPECTED_EVERY_S:
                self._add_expected(at)

    def _add_expected(self, at: float) -> None:
        """Add the level that the plan at a time expects an hour later."""
        plan, later = self._past_plan[1], at + _LEAD_S
        if plan is not None and later <= plan.ends[-1]:
            level = np.interp([later], plan.ends, plan.level)
            self.expected.add(np.array([round(later * 1e9)]), level)
            self._expected_at = at

    @property
    def plan(self) -> Plan | None:
        """The newest plan; None if it is unknown, or there is none."""
        at, plan = self._plan
        return plan if at > self._past_plan[0] else self._if_current(self._past_plan[1])

    @property
    def forecast(self) -> Forecast | None:
        """The newest forecast of rain; None if it is unknown."""
        return self._if_current(self._forecast)

    def _if_current(self, newest: _Outlook | None) -> _Outlook | None:
        """Return a forecast or plan; None if a newer one may not have been read yet."""
        now_ns = max((value.time_ns for value in self.newest.values()), default=0)
        past_ns = self._past_ns()
        if newest is None or (now_ns - past_ns > HOLDS_NS and newest.at * 1e9 <= past_ns):
            return None
        return newest

    # --- reports of the nodes -------------------------------------------------------------------

    def add_statuses(
        self, wall: float, statuses: Sequence[WireStatus], stamp_ns: int = 0,
        arrived: float | None = None,
    ) -> None:
        """Add the statuses of a message on /diagnostics.

        Args:
            wall: now.
            statuses: of one message.
            stamp_ns: time stamp of the message (ns since 1970), in a simulation by its clock.
            arrived: when it arrived (s since 1970); None if unknown.
        """
        with self.lock:
            own = any(map(self.alarms.registry.is_own, statuses))
            if self.alarms.shown and own and 0 < stamp_ns < _LATEST_NS:
                self._stamp = stamp_ns / 1e9
            now = self._now_or(time.time())
            if self._received_since is None:
                self._received_since = time.time()
            self._update_clock()
            self.alarms.receive(wall, now, statuses, stamp_ns=stamp_ns, arrived=arrived)
            self._update_controller(now)
            pump = self.pump
            if pump is not None and "flow" in pump.values:
                # While the flow is unknown, its topic reports 0.
                known = pump.values["flow"] is not None
                self.unknown_flow.update(self._stamp or now, known=known)

    def _update_controller(self, now: float) -> None:
        """Drop the plan of a controller that another controller or process has replaced."""
        node = self.graph.node("controller")
        if node is None:
            return
        controller = node.name, node.process
        if self._controller not in (None, controller):
            # The first plan of the new one may have come before its first status, and stays.
            if self._past_plan[0] <= self._controller_at:
                self._past_plan = self._past_plan[0], None
            if self._plan[0] <= self._controller_at:
                self._plan = self._plan[0], None
        self._controller, self._controller_at = controller, now

    def add_event(self, system: float, text: str) -> None:
        """Add an event that happens now.

        Args:
            system: the system's time, for a graph that has reported none yet (s since 1970).
            text: what happened.
        """
        with self.lock:
            self.alarms.add_event(self._now_or(system), text)

    def acknowledge(self, alarm_id: str) -> bool:
        """Acknowledge an alarm; return False if there is no such alarm."""
        with self.lock:
            return self.alarms.acknowledge(alarm_id)

    def incidents(self) -> list[Alarm]:
        """Return the recorded incidents that have begun; none if nodes report how they are.

        On a live site: those that were over before nodes were received here.
        """
        if self.mode == "live" and self._received_since is not None:
            return [
                incident for incident in self.recorded_incidents
                if incident.ended_at is not None and incident.ended_at < self._received_since
            ]
        now = self.now
        if self.graph.has_received or not self.ended or now is None:
            return []
        return [
            incident if incident.ended_at is None or incident.ended_at <= now
            else replace(incident, ended_at=None)  # not over at the time that is shown
            for incident in self.recorded_incidents if incident.since <= now
        ]

    @property
    def lost_pump(self) -> bool:
        """Whether, by a recording, it is unknown what the pump does now."""
        return any(
            incident.ended_at is None and incident.trouble.hides_pump
            for incident in self.incidents()
        )

    # --- time -----------------------------------------------------------------------------------

    @property
    def now(self) -> float | None:
        """The graph's time (s since 1970); None if no time is known yet.

        On a live site it is the system's time, otherwise the time of the newest value.
        """
        if self.mode == "live" and self._system is not None:
            return self._system
        times = [newest.time_ns for newest in self.newest.values()]
        return max(times) / 1e9 if times else None

    def clock(self) -> dict[str, Any]:
        """Return the time in words, and the clock for the page's charts.

        The clock is a list of times (s since 1970), each with the offset from UTC (h) from then
        on. It covers the longest chart.
        """
        now, zone = self.now, self.site.zone
        if now is None or words.moment(now, zone) is None:
            return {"now": now, "text": words.UNKNOWN, "clock": []}
        text = f"{words.date_and_time(now, zone)} {words.clock_name(now, zone)}"
        return {"now": now, "text": text, "clock": words.offsets(zone, int(now // 86400))}

    def time_of_day(self, at: float) -> str:
        """Write a time of the graph (s since 1970)."""
        return words.time_of_day(at, self.site.zone, at if self.now is None else self.now)

    def hour(self, at: float) -> str:
        """Write a time to come (s since 1970)."""
        return words.hour_and_minute(at, self.site.zone, self.now or at)

    def _is_of_system(self, at: float) -> bool:
        """Return whether a time (s since 1970) is by the system's clock since the watcher began."""
        return self._started_at - _SET_BACK_S <= at <= time.time() + _SET_BACK_S

    def _update_clock(self) -> None:
        """Update when the clock of a simulation began, if that is known."""
        times = (self._clock_started_at, self.now, self._stamp)
        known = [at for at in times if at is not None and not self._is_of_system(at)]
        if known and self.mode in ("simulated", "loop"):
            self._clock_started_at = min(known)

    def dated(self, at: float) -> float:
        """Return the time to show for an alarm or event (s since 1970).

        If it was noted before the clock of a simulation was known, it is when that clock began.
        """
        began = self._clock_started_at
        return at if began is None or not self._is_of_system(at) else began

    def _now_or(self, system: float) -> float:
        """Return the time of an event that happens now (s since 1970): the graph's time.

        Before any value is known, it is the time that nodes report; before that, the system's.
        """
        known = (self.now, self._stamp, system)
        return next(at for at in known if at is not None)

    def _past_ns(self) -> int:
        """Return up to when the past has come (ns since 1970): its newest value of any topic."""
        return max((newest.past_ns for newest in self.newest.values()), default=0)


def _plan_of(at: float, rows: Values) -> Plan | None:
    """Return the plan made at a time (s since 1970); None if one of its numbers is impossible."""
    plan = np.asarray(rows, dtype=np.float64)
    if plan.ndim != 2 or plan.shape[1] not in (3, 4) or len(plan) > _MOST_STEPS:
        return None
    ends, flow, level, *fill_to = plan.T
    if not np.all((plan >= 0) & (plan <= _LARGEST)) or np.any(np.diff(ends, prepend=0.0) <= 0):
        return None
    return Plan(at, at + ends, flow, level, fill_to[0] if fill_to else np.zeros_like(ends))
