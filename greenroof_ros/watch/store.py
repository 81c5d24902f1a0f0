"""State of one graph: latest values and their history, plan, forecast, and reports of the nodes.

Each message that :mod:`.feed` receives is passed to the store once, with :meth:`GraphStore.receive`
or :meth:`GraphStore.add_statuses`. From the store, :mod:`.document` creates the document shown to
operators.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.text import clean_text
from greenroof_ros.base.times import duration
from greenroof_ros.interface.states import PUMP, PUMP_STATES, PumpState
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.alarms import Judge
from greenroof_ros.site.file import read_site
from greenroof_ros.site.horizon import MAX_MEMBERS
from greenroof_ros.site.site import Site
from greenroof_ros.watch import wire, words
from greenroof_ros.watch.history import History, Values
from greenroof_ros.watch.outlook import Forecast, Plan
from greenroof_ros.watch.registry import Node, Registry
from greenroof_ros.watch.wire import WireStatus
from greenroof_ros.watch.words import name_source

FLOW, RAIN_FORECAST, PLAN = "/pump/flow", "/forecast/precipitation", "/controller/plan"
LINES = {
    "roof": "/roof/level", "cistern": "/cistern/level", "flow": FLOW,
    "rain": "/weather/precipitation",
}
"""Lines of the charts, each with its topic."""
EXPECTED = "roof_expected"
"""Additional line: the roof level as expected an hour earlier."""
_NAMES = {topic: name for name, topic in LINES.items()}

_NUMBER = "std_msgs/msg/Float64"
# No quantity of any site is greater than this in any unit, even if its topic has no limit.
_MAX_VALUE = 1e9
# A value is stale after this many of its usual intervals, but at the earliest after the second
# number (s). The usual interval is assumed to be at most the third number (s).
INTERVALS, _STALE_S, _MAX_S = 3, 5.0, 600.0
# Times of a graph are before this (ns since 1970): the year 2116.
_LATEST_NS = 2**62
# By how much the system's clock may be set back (s), which is made up for within a minute.
_SET_BACK_S = 60.0
# How far ahead a level that is compared with the measured one was expected, and the interval at
# which such an expectation is kept (s).
_LEAD_S, _EXPECTED_EVERY_S = 3600.0, 300.0
# Maximum number of steps of a forecast or a plan, which is that of the longest look-ahead.
_MAX_STEPS = 1000
_MAX_EVENTS = 50


class TopicValue:
    """The latest value on a topic; every update checks whether the next value is overdue.

    Attributes:
        time_ns: time of the value (ns since 1970).
        value: the value; None if it is implausible.
        stale: whether the next value is overdue.
    """

    def __init__(self) -> None:
        """Initialize without a value."""
        self.time_ns = 0
        self.value: float | None = None
        self.stale = False
        self._received = False
        self._received_at: float | None = None  # wall time (s)
        self._intervals: deque[float] = deque(maxlen=9)

    def receive(self, time_ns: int, value: float) -> None:
        """Receive a value, which is NaN if it is implausible."""
        self._received = True
        self.time_ns, self.value = time_ns, None if math.isnan(value) else value

    def update(self, wall: float, *, ended: bool) -> None:
        """Update ``stale``; no value is overdue once the run has ended."""
        if self._received or self._received_at is None:
            if self._received_at is not None:
                self._intervals.append(min(wall - self._received_at, _MAX_S))
            self._received, self._received_at = False, wall
        usual = float(np.median(self._intervals)) if self._intervals else 0.0
        self.stale = not ended and wall - self._received_at > max(_STALE_S, INTERVALS * usual)


class GraphStore:
    """The state of one graph; any thread may call any method, and may read under ``lock``.

    Times of the graph are either simulated times or system times. ``wall`` is a time of the steady
    clock (s), so a change in the system clock does not affect the age of a value.

    Attributes:
        lock: lock that must be held while more than one attribute is read.
        namespace: namespace of the graph; empty if it has none.
        site: site whose parameters are used to judge levels: the paper's until another is known.
        wall: time of the last update of the store (steady clock, s).
        notes: notes for the operator about the site file and the watched graph.
        mode: ``none`` if nothing has been received yet, ``simulated``, ``live``, or ``ended`` for a
            run that is over.
        factor: ratio of simulated to wall time; None if there is no such ratio.
        allow_release: whether the pump may be released from the page.
        graph: registry of the nodes and their reports.
        judge: judge of the current faults, and of nodes that are missing only because the site is
            still starting.
        events: latest events, each with its time (s since 1970).
        newest: latest value on each topic.
        past: history of each line of the charts.
        forecast: latest rain forecast; None if unknown.
        plan: plan of the controller; None if unknown or if there is none.
    """

    def __init__(self, namespace: str = "") -> None:
        """Initialize the store with an empty state.

        Args:
            namespace: namespace of the graph; empty if it has none. Nodes in other namespaces are
                treated as other devices.
        """
        self.lock = threading.RLock()
        self.namespace = namespace
        self.allow_release = False
        self.site = read_site(default_site_file())
        self.notes = ["", ""]
        self.mode = "none"
        self.factor: float | None = None
        self.graph = Registry(namespace, self.add_event)
        self._interface = read_topics()
        self.wall = 0.0
        self._system: float | None = None  # the system's time at the last update (s since 1970)
        self.reset()

    def reset(self) -> None:
        """Reset everything for a new run, except the nodes and the settings for watching them."""
        with self.lock:
            self.judge = Judge()
            self.events: deque[tuple[float, str]] = deque(maxlen=_MAX_EVENTS)
            self._was_gone = False
            self._forget_values()

    def _forget_values(self) -> None:
        self.newest: dict[str, TopicValue] = {}
        self.past = {name: History() for name in (*LINES, EXPECTED)}
        self._expected_at = -math.inf  # when an expected level was last kept (s since 1970)
        self.forecast: Forecast | None = None
        self.plan: Plan | None = None
        self._controller: tuple[str, str] | None = None  # name and process
        self._controller_at = -math.inf  # when it last reported (s since 1970)

    # --- the graph that is watched --------------------------------------------------------------

    @property
    def pump(self) -> Node | None:
        """The pump node with its last report; None if no pump node has reported."""
        return self.graph.node(PUMP)

    def set_site(self, site: Site, note: str = "") -> None:
        """Set the site whose parameters are used to judge levels.

        Args:
            site: parameters of the site.
            note: note for the operator about the site file; empty for none.
        """
        with self.lock:
            self.site = site
            self.notes[0] = clean_text(note)

    def set_present(self, *, mode: str, factor: float | None, note: str) -> None:
        """Set the mode and the speed of the watched graph.

        Args:
            mode: new value of the attribute ``mode``.
            factor: ratio of simulated to wall time; None if there is no such ratio.
            note: note for the operator about the graph; empty for none.
        """
        with self.lock:
            self.mode = mode
            self.factor = factor if factor is not None and math.isfinite(factor) else None
            self.notes[1] = clean_text(note)

    def update(self, wall: float, system: float | None = None) -> None:
        """Update the overdue values and the alarms; call this often, even if no document is made.

        If the clock of a live site is set back, the charts start afresh, since new values would be
        older than the existing ones.

        Args:
            wall: current time (steady clock, s).
            system: system time, which a live site follows (s since 1970); None if unchanged.
        """
        with self.lock:
            before, self._system = self._system, self._system if system is None else system
            if self.mode == "live" and before is not None and self._system is not None and (
                back := before - self._system
            ) > _SET_BACK_S:
                self._forget_values()
                self.add_event(
                    f"The system's clock was set back by {duration(round(back))}, so the charts "
                    "start again"
                )
            self.wall = wall
            self._judge(wall)
            for newest in self.newest.values():
                newest.update(wall, ended=self.ended)
                newest.stale |= self.gone_since is not None

    @property
    def ended(self) -> bool:
        """Whether the run is over, so that no more messages will arrive."""
        return self.mode == "ended"

    @property
    def gone_since(self) -> float | None:
        """When the program of a live site last reported (s since 1970); None while it runs."""
        return self.graph.gone_since(self.wall) if self.mode == "live" else None

    def is_lost(self, node: Node | None) -> bool:
        """Return whether a node was present and is now silent; False if the run is over."""
        return node is not None and not self.ended and not node.is_online(self.wall)

    @property
    def pump_report(self) -> PumpState | None:
        """The pump's state and reason, as last reported by the pump node; None if not reported.

        The state is unknown if it is unclear which node is the pump node.
        """
        if two := self.graph.two_pumps(self.wall):
            return PumpState("unknown", two)
        if self.pump is None or not (state := self.pump.text("pump_state")):
            return None
        return PumpState(state if state in PUMP_STATES else "unknown", self.pump.text("pump_why"))

    @property
    def flow_known(self) -> bool:
        """Whether the pump node knows the flow; if not, its flow topic reports 0."""
        return self.pump is None or self.pump.values.get("flow", 0.0) is not None

    # --- messages -------------------------------------------------------------------------------

    def receive(self, topic: str, time_ns: int, message: bytes) -> None:
        """Receive a message on any topic that is shown, except /diagnostics and /clock.

        Args:
            topic: name of the topic in the interface, without a namespace.
            time_ns: time of the message (ns since 1970).
            message: serialized message (CDR); an incomplete message is ignored.
        """
        if topic in (PLAN, RAIN_FORECAST):
            if (rows := wire.read_rows(message)) is not None:
                if topic == PLAN:
                    self.add_plan(time_ns, np.asarray(rows.values))
                else:
                    self.add_forecast(time_ns, np.asarray(rows.values), np.asarray(rows.front))
        elif self._interface[topic].type == _NUMBER:
            value = wire.read_value(_NUMBER, message)
            if value is not None:
                self.add(topic, time_ns, value)

    def add(self, topic: str, time_ns: int, value: float) -> None:
        """Add a value from a topic that carries single numbers.

        A value that is not newer than the last one is ignored. A value outside the topic's range is
        shown as implausible, and leaves a gap in its chart line.

        Args:
            topic: name of the topic in the interface, without a namespace.
            time_ns: time of the value (ns since 1970).
            value: value in the topic's unit.
        """
        entry = self._interface[topic]
        low, high = max(entry.low, -_MAX_VALUE), min(entry.high, _MAX_VALUE)
        value = value + 0.0 if low <= value <= high else math.nan  # no minus zero
        with self.lock:
            newest = self.newest.get(topic) or TopicValue()
            if not newest.time_ns < time_ns < _LATEST_NS:
                return
            self.newest[topic] = newest
            newest.receive(time_ns, value)
            if topic in _NAMES:
                is_known = topic != FLOW or self.flow_known
                self.past[_NAMES[topic]].add(time_ns, value if is_known else math.nan)

    def present_value(self, topic: str) -> float | None:
        """Return the current value on a topic; None if there is none or it is stale."""
        newest = self.newest.get(topic)
        return None if newest is None or newest.stale else newest.value

    def add_forecast(self, time_ns: int, values: Values, front: Values) -> None:
        """Add a rain forecast; an invalid forecast clears the current one.

        Args:
            time_ns: beginning of the first step (ns since 1970).
            values: rain rate in each step (m/s), shape (steps,), or (members, steps) for an
                ensemble.
            front: time of issue (s since 1970, NaN if unknown), and the end of each step (s after
                ``time_ns``), shape (1 + steps,).
        """
        if not 0 < time_ns < _LATEST_NS:
            return
        rain = np.atleast_2d(np.asarray(values, dtype=np.float64))
        limits, at = self._interface[RAIN_FORECAST], time_ns / 1e9
        members, steps = rain.shape if rain.ndim == 2 else (0, 0)
        ends = front[1:]
        fits = (
            0 < members <= MAX_MEMBERS and 0 < steps <= _MAX_STEPS and len(ends) == steps
            and np.all(np.diff(ends, prepend=0.0) > 0) and ends[-1] < _MAX_VALUE
            and np.all((rain >= limits.low) & (rain <= limits.high))
        )
        with self.lock:
            if not fits:
                self.forecast = None
            elif self.forecast is None or at > self.forecast.at:
                issued = float(front[0]) if 0 < front[0] <= at else None
                self.forecast = Forecast(at, at + ends, rain, issued)

    def add_plan(self, time_ns: int, rows: Values) -> None:
        """Add a plan of the controller.

        Args:
            time_ns: time of planning (ns since 1970); a plan that is not newer than the current
                plan is ignored.
            rows: for each step, its end (s after ``time_ns``), the mean flow (m3/s), the expected
                roof level at the end (m), and a level that is not shown; shape (steps, 4). Empty
                rows leave the plan unchanged. Rows with an impossible value clear the plan.
        """
        at = time_ns / 1e9
        if not 0 < time_ns < _LATEST_NS:
            return
        with self.lock:
            if np.size(rows) and (self.plan is None or at > self.plan.at):
                self.plan = _read_plan(at, rows)
            plan, later = self.plan, at + _LEAD_S
            due = at >= self._expected_at + _EXPECTED_EVERY_S
            if due and plan is not None and later <= plan.ends[-1]:
                level = float(np.interp(later, plan.ends, plan.level))
                self.past[EXPECTED].add(round(later * 1e9), level)
                self._expected_at = at

    def add_statuses(
        self, wall: float, statuses: Sequence[WireStatus], stamp_ns: int = 0,
        number: int | None = None,
    ) -> None:
        """Add the statuses in a message on /diagnostics.

        Args:
            wall: current time (steady clock, s).
            statuses: statuses of one message.
            stamp_ns: time stamp of the message (ns since 1970); in a simulation, a simulated time.
            number: number of the message, as counted by its publisher; None if unknown.
        """
        with self.lock:
            self.wall = wall
            self.graph.receive(
                wall, statuses, now=self._event_time, stamp_ns=stamp_ns, number=number
            )
            self._judge(wall)
            node = self.graph.node("controller")
            if node is None:
                return
            # The plan of a controller that another controller or process has replaced is dropped.
            # The first plan of the new one may have arrived before its first status, and is kept.
            controller = node.name, node.process
            if self._controller not in (None, controller) and self.plan is not None and (
                self.plan.at <= self._controller_at
            ):
                self.plan = None
            self._controller, self._controller_at = controller, self._event_time

    def _judge(self, wall: float) -> None:
        gone = self.gone_since is not None
        if gone != self._was_gone:
            self._was_gone = gone
            self.add_event(f"The site's program {'no longer runs' if gone else 'runs again'}")
        if gone:
            return  # this explains everything else
        diagnoses, starting = self.graph.diagnoses(wall), self.graph.starting(wall)
        for what, alarm in self.judge.update(wall, self._event_time, diagnoses, starting=starting):
            if what in ("begins", "ends") and not alarm.follows:
                over = "Over: " if what == "ends" else ""
                self.add_event(f"{over}{name_source(alarm.name)}: {alarm.sentence}")

    def add_event(self, text: str) -> None:
        """Add an event that has just happened."""
        with self.lock:
            self.events.append((self._event_time, clean_text(text)))

    # --- time -----------------------------------------------------------------------------------

    @property
    def now(self) -> float | None:
        """The graph's time (s since 1970); None if no time is known yet.

        On a live site, the graph's time is the system time; otherwise, it is the time of the latest
        value or of the plant's last report, whichever is later.
        """
        if self.mode == "live" and self._system is not None:
            return self._system
        newest = max((value.time_ns for value in self.newest.values()), default=0)
        return max(newest, self.graph.time_ns) / 1e9 or None

    @property
    def _event_time(self) -> float:
        """Time at which an event that occurs now is recorded (s since 1970)."""
        return (self._system or 0.0) if self.now is None else self.now

    def clock(self) -> dict[str, Any]:
        """Return the time as text, and the clock for the page's charts.

        The clock is a list of times (s since 1970), each with the offset from UTC (h) that applies
        from this time on. The list covers the longest chart.
        """
        now, zone = self.now, self.site.zone
        if now is None or words.convert_time(now, zone) is None:
            return {"now": now, "text": words.UNKNOWN, "clock": []}
        text = f"{words.write_time(now, zone)} {words.name_clock(now, zone)}"
        return {"now": now, "text": text, "clock": words.list_offsets(zone, int(now // 86400))}

    def time_of_day(self, at: float) -> str:
        """Write a time of the graph (s since 1970).

        In a simulation, events before the first tick are stamped with the system time, which is
        later than the simulated time. Their time is written as ``the start``.
        """
        if self.now is not None and self.mode != "live" and at > self.now:
            return "the start"
        return words.write_clock_time(at, self.site.zone, at if self.now is None else self.now)

    def hour(self, at: float) -> str:
        """Write a future time (s since 1970)."""
        return words.write_coming_time(at, self.site.zone, self.now or at)


def _read_plan(at: float, rows: Values) -> Plan | None:
    """Return the plan made at a time (s since 1970); None if any of its values is impossible."""
    plan = np.asarray(rows, dtype=np.float64)
    if plan.ndim != 2 or plan.shape[1] != 4 or len(plan) > _MAX_STEPS:
        return None
    ends, flow, level, _ = plan.T
    if not np.all((plan >= 0) & (plan <= _MAX_VALUE)) or np.any(np.diff(ends, prepend=0.0) <= 0):
        return None
    return Plan(at, at + ends, flow, level)
