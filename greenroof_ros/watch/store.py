"""State of one graph: latest values and their history, plan, forecast, alarms, and reports.

Each message that :mod:`.feed` receives is passed to the store once, with
:meth:`GraphStore.receive`, :meth:`GraphStore.add_statuses` or :meth:`GraphStore.add_alarms`. From
the store, :mod:`.document` creates the document shown to operators.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.text import clean_text
from greenroof_ros.base.times import duration
from greenroof_ros.interface.alarm import Alarm
from greenroof_ros.interface.states import PUMP, PUMP_STATES, PumpState
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.alarm_status import read_status
from greenroof_ros.ros.reports import NodeReport, Status
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.watch import wire, words
from greenroof_ros.watch.graph import Graph
from greenroof_ros.watch.history import History
from greenroof_ros.watch.outlook import Forecast, Plan, read_forecast, read_plan

FLOW, RAIN_FORECAST, PLAN = "/pump/flow", "/forecast/precipitation", "/controller/plan"
LINES = {
    "roof": "/roof/level", "cistern": "/cistern/level", "flow": FLOW,
    "rain": "/weather/precipitation",
}
"""Lines of the charts, each with its topic."""
GIVEN = "given"
"""Additional history: the volume that has been pumped since the first value (m3)."""
_NAMES = {topic: name for name, topic in LINES.items()}

_NUMBER = "std_msgs/msg/Float64"
# No quantity of any site is greater than this in any unit, even if its topic has no limit.
_MAX_VALUE = 1e9
# A value is stale after this many ticks or usual intervals, or after the age at which readers no
# longer use it, but at the earliest after the second number (s). A flow holds, and an interval is
# usual, for at most the third number (s).
INTERVALS, _STALE_S, _MAX_S = 3, 5.0, 600.0
# Alarms older than this mean that the program of the site no longer runs (s): they are published
# once a second, and a process that died is back within a few seconds.
ALARMS_OLD_S = 10.0
# Times of a graph are before this (ns since 1970): the year 2116.
_LATEST_NS = 2**62
# By how much the system's clock may be set back (s), which is made up for within a minute.
_SET_BACK_S = 60.0
_MAX_EVENTS = 50
_TWO = "two_pump_nodes", "two_processes"


class Newest(NamedTuple):
    """The latest value on a topic.

    Attributes:
        time_ns: time of the value (ns since 1970).
        value: the value; None if it is implausible.
        received_at: when it was received (steady clock, s).
        interval_s: time since the value before (s); infinite for the first.
        stale_after_s: time after which the next value is overdue (s).
    """

    time_ns: int
    value: float | None
    received_at: float
    interval_s: float
    stale_after_s: float


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
        graph: the nodes and their reports.
        alarms: the alarms as last published, also those that are over or are not counted yet.
        events: latest events other than alarms, each with its time (s since 1970).
        newest: latest value on each topic.
        past: history of each line of the charts, and of the pumped volume.
        forecast: latest rain forecast; None if unknown.
    """

    def __init__(self, namespace: str = "") -> None:
        """Initialize the store with an empty state.

        Args:
            namespace: namespace of the graph; empty if it has none.
        """
        self.lock = threading.RLock()
        self.namespace = namespace
        self.allow_release = False
        self.site = read_site(default_site_file())
        self.notes = ["", ""]
        self.mode = "none"
        self.factor: float | None = None
        self.graph = Graph(namespace)
        self._interface = read_topics()
        self.wall = 0.0
        self._system: float | None = None  # the system's time at the last update (s since 1970)
        self.reset()

    def reset(self) -> None:
        """Reset everything for a new run, except the nodes and the settings for watching them."""
        with self.lock:
            self.alarms: list[Alarm] = []
            self._alarms_at = -math.inf  # when they came (steady clock, s)
            self._alarms_of = 0.0  # the graph's time then (s since 1970)
            self.events: deque[tuple[float, str]] = deque(maxlen=_MAX_EVENTS)
            self._forget_values()

    def _forget_values(self) -> None:
        self.newest: dict[str, Newest] = {}
        self.past = {name: History() for name in (*LINES, GIVEN)}
        self.forecast: Forecast | None = None
        self._plan: Plan | None = None

    # --- the graph that is watched --------------------------------------------------------------

    @property
    def pump(self) -> NodeReport | None:
        """The pump node with its last report; None if no pump node has reported."""
        return self.graph.node(PUMP, self.wall)

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
        """Update the overdue values; call this often, even if no document is made.

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

    @property
    def ended(self) -> bool:
        """Whether the run is over, so that no more messages will arrive."""
        return self.mode == "ended"

    def is_lost(self, node: NodeReport | None) -> bool:
        """Return whether a node was present and is now silent; False if the run is over."""
        return node is not None and not self.ended and not node.is_online(self.wall)

    @property
    def two_pumps(self) -> str:
        """A warning if it is unclear which node is the pump node; otherwise empty."""
        twins = any(alarm.role == PUMP and alarm.code in _TWO for alarm in self.present)
        if not twins and not self.graph.has_two_pumps:
            return ""
        return (
            f"Two nodes claim to be the pump node ({words.list_names(self.graph.offered)}), so it "
            "is unknown which of them controls the pump. A stop is sent to all of them; no other "
            "request is sent from here. Shut down the node that should not be running."
        )

    @property
    def pump_report(self) -> PumpState | None:
        """The pump's state and reason, as last reported by the pump node; None if not reported.

        The state is unknown if it is unclear which node is the pump node.
        """
        if two := self.two_pumps:
            return PumpState("unknown", two)
        values = {} if self.pump is None else self.pump.values
        if not (state := words.text_of(values, "pump_state")):
            return None
        known = state if state in PUMP_STATES else "unknown"
        # Of a hold, the page states more, and in the site's time.
        hold = values.get("hold")
        sentence = words.text_of(hold, "sentence") if isinstance(hold, dict) else ""
        why = words.text_of(values, "pump_why").removeprefix(sentence)
        return PumpState(known, why.lstrip("; "))

    @property
    def flow_known(self) -> bool:
        """Whether the pump node knows the flow; if not, its flow topic reports 0."""
        return self.pump is None or self.pump.values.get("flow", 0.0) is not None

    # --- alarms ---------------------------------------------------------------------------------

    def add_alarms(self, wall: float, stamp_ns: int, statuses: Sequence[Status]) -> None:
        """Receive the alarms in a message on /alarms; a status that is not an alarm is left out.

        Args:
            wall: current time (steady clock, s).
            stamp_ns: time of the message (ns since 1970).
            statuses: statuses of the message.
        """
        alarms = []
        for status in statuses:
            with suppress(ValueError, OverflowError):
                alarms.append(read_status(
                    clean_text(status.name), status.level, words.clean_sentence(status.message),
                    {key: clean_text(value) for key, value in status.values.items()},
                ))
        with self.lock:
            self.alarms = alarms
            self._alarms_at, self._alarms_of = wall, stamp_ns / 1e9

    @property
    def present(self) -> list[Alarm]:
        """The present alarms."""
        return [alarm for alarm in self.alarms if alarm.ended is None and alarm.number]

    @property
    def alarms_known(self) -> bool:
        """Whether the alarms are of now."""
        return self.wall - self._alarms_at <= ALARMS_OLD_S

    @property
    def gone_since(self) -> float | None:
        """When the program of a live site last published its alarms (s since 1970).

        None while it publishes them, or while a node of the site reports: then it is only unknown
        whether there are alarms. Nothing else about the state of the nodes is concluded here.
        """
        nodes = self.graph.nodes.values()
        if self.mode != "live" or self.alarms_known or not self._alarms_of or any(
            node.is_online(self.wall) for node in nodes
        ):
            return None
        return self._alarms_of

    def excuse_silence(self, seconds: float) -> None:
        """Exclude a pause of this process (s) from the time for which others have been silent."""
        with self.lock:
            self.graph.excuse_silence(seconds)
            self._alarms_at += seconds

    # --- messages -------------------------------------------------------------------------------

    def receive(self, topic: str, time_ns: int, message: bytes) -> None:
        """Receive a message with values, that is, of any topic but those of reports and alarms.

        Args:
            topic: name of the topic in the interface, without a namespace.
            time_ns: time of the message (ns since 1970).
            message: serialized message (CDR); an incomplete message is ignored.
        """
        if topic in (PLAN, RAIN_FORECAST):
            if (rows := wire.read_rows(message)) is not None:
                if topic == PLAN:
                    self.add_plan(time_ns, rows.values)
                else:
                    self.add_forecast(time_ns, rows.values, rows.front)
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
            before = self.newest.get(topic)
            if not (before.time_ns if before else 0) < time_ns < _LATEST_NS:
                return
            interval = self.site.tau / (self.factor or 1.0)
            if self.mode == "live" and entry.max_age is not None:
                interval = entry.max_age.default / INTERVALS
            since, usual = self.wall - before.received_at if before else math.inf, 0.0
            if before is not None and math.isfinite(since):  # a single gap is not usual
                usual = min(since, before.interval_s, _MAX_S)
            self.newest[topic] = Newest(
                time_ns, None if math.isnan(value) else value, self.wall, since,
                max(_STALE_S, INTERVALS * interval, INTERVALS * usual),
            )
            if topic == FLOW and not self.flow_known:
                value = math.nan
            if topic in _NAMES:
                self.past[_NAMES[topic]].add(time_ns, value)
            passed = (time_ns - before.time_ns) / 1e9 if before else math.inf
            holds = before.stale_after_s if before and self.mode == "live" else _MAX_S
            if topic == FLOW and before and before.value and passed <= holds:
                self.past[GIVEN].add(time_ns, self.past[GIVEN].last + before.value * passed)

    def is_stale(self, topic: str) -> bool:
        """Return whether the next value on a topic is overdue; None is once the run has ended."""
        newest = self.newest.get(topic)
        return newest is not None and not self.ended and (
            self.gone_since is not None or self.wall - newest.received_at > newest.stale_after_s
        )

    def present_value(self, topic: str) -> float | None:
        """Return the current value on a topic; None if there is none or it is stale."""
        newest = self.newest.get(topic)
        return None if newest is None or self.is_stale(topic) else newest.value

    def add_forecast(self, time_ns: int, values: Any, front: Any) -> None:
        """Add a rain forecast; an invalid forecast clears the current one.

        Args:
            time_ns: beginning of the first step (ns since 1970).
            values: rain rate in each step (m/s), shape (steps,), or (members, steps) for an
                ensemble.
            front: time of issue (s since 1970, NaN if unknown), and the end of each step (s after
                ``time_ns``), shape (1 + steps,).
        """
        at = time_ns / 1e9
        if 0 < time_ns < _LATEST_NS:
            with self.lock:
                forecast = read_forecast(at, values, front)
                if forecast is None or self.forecast is None or at > self.forecast.at:
                    self.forecast = forecast

    def add_plan(self, time_ns: int, rows: Any) -> None:
        """Add a plan of the controller.

        Args:
            time_ns: time of planning (ns since 1970); a plan that is not newer than the current
                plan is ignored.
            rows: for each step, its end (s after ``time_ns``), the mean flow (m3/s), the expected
                roof level at the end (m), and a level that is not shown; shape (steps, 4). Empty
                rows leave the plan unchanged. Rows with an impossible value clear the plan.
        """
        at = time_ns / 1e9
        with self.lock:
            if 0 < time_ns < _LATEST_NS and np.size(rows) and (
                self._plan is None or at > self._plan.at
            ):
                self._plan = read_plan(at, rows)

    @property
    def plan(self) -> Plan | None:
        """The latest plan of the controller; None if it was made before the controller's start."""
        node, plan, now = self.graph.node("controller", self.wall), self._plan, self.now
        age = None if node is None else node.values.get("up_s")
        if plan is None or now is None or self.gone_since is not None:
            return None
        old = self.mode == "live" and isinstance(age, (int, float)) and plan.at < now - age - 2.0
        return None if old else plan

    def add_statuses(
        self, wall: float, statuses: Sequence[Status], stamp_ns: int = 0
    ) -> None:
        """Add the statuses in a message on /diagnostics.

        Args:
            wall: current time (steady clock, s).
            statuses: statuses of one message.
            stamp_ns: time stamp of the message (ns since 1970); in a simulation, a simulated time.
        """
        with self.lock:
            self.wall = wall
            self.graph.receive(wall, self._event_time, statuses, stamp_ns)

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

    def given_since(self, begin: float) -> float | None:
        """Return the volume pumped since a time (s since 1970, m3); None if that is not known."""
        first, given = self.past["flow"].first_ns, self.past[GIVEN]
        if first is None or begin < first / 1e9:
            return None
        return given.last - given.value_at(round(begin * 1e9))

    def given_today(self) -> float | None:
        """Return the volume pumped on the present day of the site's clock (m3); None if unknown."""
        now = None if self.now is None else words.convert_time(self.now, self.site.zone)
        midnight = None if now is None else now.replace(hour=0, minute=0, second=0)
        return None if midnight is None else self.given_since(midnight.timestamp())

    def clock(self) -> dict[str, Any]:
        """Return the time as text, and the clock of the page's charts.

        The clock is the name of a time zone, or an offset from UTC, as browsers know it.
        """
        now, zone = self.now, self.site.zone
        at = None if now is None else words.convert_time(now, zone)
        if now is None or at is None:
            return {"now": now, "text": words.UNKNOWN, "zone": "UTC"}
        name, offset = at.strftime("%Z"), at.isoformat()[-6:]
        name = name if name[:1].isalpha() else f"UTC{offset}"  # some are called by a number
        return {
            "now": now, "text": f"{at:%Y-%m-%d %H:%M:%S} {name}",
            "zone": self.site.time_zone or offset,
        }

    def time_of_day(self, at: float) -> str:
        """Write a past time of the graph (s since 1970), with the date unless it is today.

        In a simulation, events before the first tick are stamped with the system time, which is
        later than the simulated time. Their time is written as ``the start``.
        """
        if self.now is not None and self.mode != "live" and at > self.now:
            return "the start"
        return words.write_clock_time(at, self.site.zone, at if self.now is None else self.now)

    def hour(self, at: float) -> str:
        """Write a future time (s since 1970)."""
        return words.write_coming_time(at, self.site.zone, self.now or at)
