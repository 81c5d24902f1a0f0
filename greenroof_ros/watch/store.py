"""State of one graph: latest values and their history, plan, forecast, alarms, and reports.

:mod:`.feed` passes each message to the store once. From the store, :mod:`.document` creates the
document shown to operators.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.text import clean_text
from greenroof_ros.base.times import clock_time
from greenroof_ros.interface.alarm import Alarm, read_status
from greenroof_ros.interface.states import PLANT, PUMP
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.reports import NodeReport, Reports, Status
from greenroof_ros.site.file import read_site
from greenroof_ros.watch.lines import History, Steps, read_steps

FLOW, RAIN_FORECAST, PLAN = "/pump/flow", "/forecast/precipitation", "/controller/plan"
LINES = {
    "roof": "/roof/level", "cistern": "/cistern/level", "flow": FLOW,
    "rain": "/weather/precipitation",
}
"""Lines of the charts, each with its topic."""
TOPICS = (
    *LINES.values(), RAIN_FORECAST, PLAN, "/pump/command", "/weather/frost",
    "/gauge/temperature", "/outlet/command",
)
"""Topics of which the values are shown."""
GIVEN = "given"
"""Additional history: the volume that has been pumped since the first value (m3)."""

# Speed of the fastest run, in multiples of real time, whose values are shown: 60, and some jitter.
FASTEST = 90.0
# A value is stale after this many ticks, or after the age at which readers no longer use it, but at
# the earliest after the second number (s). A line of the charts has a gap after the third one (s).
TICKS, _STALE_S, GAP_S = 3, 5.0, 600.0
# Alarms older than this mean that the program of the site no longer runs (s): they are published
# once a second, and a process that died is back within a few seconds. After the same silence of its
# plant, a run is over.
_GONE_S = 10.0
# How long a watcher that starts may need to hear of a site (s).
_DISCOVERY_S = 3.0
# A plan is valid for this time (s): a controller makes a new one when it starts and every hour.
_PLAN_S = 2 * 3600.0
_PAPERS = "Levels are judged by the parameters of the paper's site, config/site.yaml."
# Times that a calendar contains (s since 1970).
_FIRST, _LAST = 0.0, 4e9


class Newest(NamedTuple):
    """The latest value on a topic.

    Attributes:
        time: time of the value (s since 1970).
        value: the value; None if it is implausible or its publisher does not know it.
        received_at: when it was received (steady clock, s).
    """

    time: float
    value: float | None
    received_at: float


class GraphStore(Reports):
    """The state of one graph; any thread may call any method, and may read under ``lock``.

    Times of the graph are either simulated times or system times. ``steady`` is a time of the
    steady clock (s), so a change in the system clock does not affect the age of a value.

    Attributes:
        lock: lock that must be held while more than one attribute is read.
        namespace: namespace of the graph; empty if it has none.
        site: site whose parameters are used to judge levels: the paper's until another is known.
        site_note: note for the operator about the site file.
        steady: the current time (steady clock, s).
        system: the system's current time (s since 1970).
        mode: ``none`` if nothing has been received yet, ``simulated``, ``live``, or ``ended`` for a
            run that is over.
        factor: ratio of simulated to real time; NaN if it is unknown.
        allow_release: whether the pump may be released from the page.
        seen_at: when a live site was last seen before this watcher began (s since 1970); None if it
            was not in the past week.
        offered: names of the nodes that offer a hold service for the pump, and so may control it,
            whatever is reported, each with the number of nodes that have this name.
        alarms: the alarms as last published, also those that are over or are not counted yet.
        newest: latest value on each topic.
        past: history of each line of the charts, and of the pumped volume.
        forecast: latest rain forecast; None if unknown.
    """

    def __init__(self, namespace: str = "") -> None:
        """Initialize the store with an empty state.

        Args:
            namespace: namespace of the graph; empty if it has none.
        """
        super().__init__(namespace)
        self.lock = threading.RLock()
        self.namespace = namespace
        self.offered: Mapping[str, int] = {}
        self.allow_release = False
        self.seen_at: float | None = None
        self._read_site("")
        self.steady = self.system = 0.0
        self._listening_since = 0.0  # since the first update (steady clock, s)
        self.mode, self.factor = "none", math.nan
        self._began: float | None = None  # when its plant began (steady clock, s); -1 if live
        self.reset()

    def reset(self) -> None:
        """Reset everything for a new run, except the nodes and the settings for watching them."""
        self.alarms: list[Alarm] = []
        self._alarms_at = -math.inf  # when they came (steady clock, s)
        self.newest: dict[str, Newest] = {}
        self.past = {name: History() for name in (*LINES, GIVEN)}
        self.forecast: Steps | None = None
        self._plan: Steps | None = None

    # --- the graph that is watched --------------------------------------------------------------

    def update(self, steady: float, system: float) -> None:
        """Update what is known of the graph as a whole; reset everything if another run has begun.

        Args:
            steady: current time (steady clock, s).
            system: the system's current time (s since 1970).
        """
        with self.lock:
            self.steady, self.system = steady, system
            self._listening_since = self._listening_since or steady
            self.mode, plant = self._find_mode(), self.node(PLANT)
            if self.mode != "none":
                began = -1.0 if self.mode == "live" or plant is None else plant.began
                if self._began not in (None, began):
                    self.nodes = {key: node for key, node in self.nodes.items()
                                  if node.is_online(steady)}
                    self.reset()
                self._began = began
            site = self.value("site")
            if (file := site if isinstance(site, str) else "") != self._file:
                self._read_site(file)
            values = {} if plant is None else plant.values
            tick, lasted = (number_in(values, key) or 0.0 for key in ("tick", "up_s"))
            known = tick > 0 and lasted > 0
            self.factor = tick * self.site.tau / lasted if known else math.nan

    def _find_mode(self) -> str:
        plant = self.node(PLANT)
        if plant is not None and not plant.has_ended and self.steady - plant.received_at < _GONE_S:
            return "simulated"
        # A live site is not over: if its program ends or falls silent, nobody waters the roof.
        if any("run_length" not in node.values for node in self.nodes.values()):
            return "live"
        return "none" if plant is None else "ended"  # without a plant, nodes wait for theirs

    def _read_site(self, file: str) -> None:
        """Read the site file of the graph; the paper's if it cannot be read on this machine."""
        self._file = file
        self.site, self.site_note = read_site(default_site_file()), _PAPERS
        with suppress(ConfigurationError, OSError, ValueError):
            if file.startswith("/"):
                self.site, self.site_note = read_site(Path(file)), ""

    @property
    def pump(self) -> NodeReport | None:
        """The last report of the pump node; None if there is none, or if several may be it."""
        return self.node(PUMP) if sum(self.offered.values()) < 2 else None

    @property
    def pump_values(self) -> Mapping[str, Any]:
        """The values that the pump node last reported; empty if it never has."""
        return {} if self.pump is None else self.pump.values

    # --- alarms ---------------------------------------------------------------------------------

    def add_alarms(self, steady: float, statuses: Sequence[Status]) -> None:
        """Receive the alarms in a message on /alarms; a status that is not an alarm is left out.

        Args:
            steady: current time (steady clock, s).
            statuses: statuses of the message.
        """
        alarms = []
        for status in statuses:
            with suppress(ValueError, OverflowError):
                alarms.append(read_status(
                    clean_text(status.name), status.level, clean_text(status.message),
                    {key: clean_text(value) for key, value in status.values.items()},
                ))
        with self.lock:
            self.alarms, self._alarms_at = alarms, steady

    @property
    def present(self) -> list[Alarm]:
        """The present alarms, and what may still arrive while the site is starting.

        If the site's program as a whole is gone, that is all that is known.
        """
        gone = self.gone_since is not None
        return [] if gone else [alarm for alarm in self.alarms if alarm.ended is None]

    @property
    def alarms_known(self) -> bool:
        """Whether the alarms are of now, or of an ended run."""
        return self.mode == "ended" or self.steady - self._alarms_at <= _GONE_S

    @property
    def gone_since(self) -> float | None:
        """When the program of a live site last reported (s since 1970), if it is gone.

        None while it publishes its alarms, or while a node of the site reports: then it is only
        unknown whether there are alarms. Nothing else about the nodes is concluded here.
        """
        nodes = self.nodes.values()
        if nodes and (
            self.mode != "live" or self.alarms_known
            or any(node.is_online(self.steady) for node in nodes)
        ):
            return None
        reported = [self.system - self.steady + node.received_at for node in nodes]
        is_known = self.steady - self._listening_since >= _DISCOVERY_S
        return max(reported, default=self.seen_at if is_known else None)

    @property
    def runs_on(self) -> bool:
        """Whether the pump turns or delivers water although it is off."""
        turns = PUMP, "runs_on", None
        return any((alarm.role, alarm.code, alarm.ended) == turns for alarm in self.alarms)

    # --- messages -------------------------------------------------------------------------------

    def add_statuses(self, steady: float, stamp_ns: int, statuses: Sequence[Status]) -> None:
        """Add the statuses in a message on /diagnostics.

        Args:
            steady: current time (steady clock, s).
            stamp_ns: time stamp of the message (ns since 1970); in a simulation, a simulated time.
            statuses: statuses of one message.
        """
        with self.lock:
            self.steady = steady
            self.receive(steady, statuses, stamp_ns)

    def add(self, topic: str, time_ns: int, value: Any) -> None:
        """Add a value of any topic but those of reports and alarms.

        A value outside the topic's range is shown as unknown, and leaves a gap in its chart line.

        Args:
            topic: name of the topic in the interface, without a namespace.
            time_ns: time of the value (ns since 1970).
            value: value in the topic's unit; for rows of numbers, a
                :class:`greenroof_ros.ros.messages.WithFront`.
        """
        with self.lock:
            at = time_ns / 1e9
            if topic == RAIN_FORECAST:
                self.forecast = read_steps(at, value.front[1:], value.values)
            elif topic == PLAN:
                rows = np.asarray(value.values)
                if rows.shape[1:] == (4,):  # otherwise the plan is unchanged
                    self._plan = read_steps(at, rows[:, 0], rows[:, 1:3].T)
            else:
                self._add_number(topic, time_ns, value)

    def _add_number(self, topic: str, time_ns: int, value: float) -> None:
        entry, before, at = read_topics()[topic], self.newest.get(topic), time_ns / 1e9
        known = math.isfinite(value) and entry.low <= value <= entry.high
        if topic == FLOW:  # the pump node publishes 0 for an unknown flow
            known = known and self.pump_values.get("flow", value) is not None
        shown = value + 0.0 if known else None  # no minus zero
        self.newest[topic] = Newest(at, shown, self.steady)
        for name, line in LINES.items():
            if line == topic:
                self.past[name].add(time_ns, value if known else math.nan)
        if topic == FLOW and before and before.value:
            passed = at - before.time
            total = self.past[GIVEN].value_at(time_ns) + before.value * passed
            if 0 < passed <= max(_STALE_S, TICKS * self.site.tau):
                self.past[GIVEN].add(time_ns, total)

    def present_value(self, topic: str) -> float | None:
        """Return the current value on a topic; None if there is none or the next is overdue.

        Nothing is overdue once the run has ended.
        """
        if (newest := self.newest.get(topic)) is None or self.mode == "ended":
            return newest and newest.value
        limit, age = TICKS * self.site.tau, read_topics()[topic].max_age
        if self.mode == "live":
            limit = limit if age is None else age.default
        elif self.factor > 0:
            limit /= self.factor
        overdue = self.steady - newest.received_at > max(_STALE_S, limit)
        return None if overdue or self.gone_since is not None else newest.value

    @property
    def plan(self) -> Steps | None:
        """The controller's plan; None if there is none, or if it is too old."""
        plan = self._plan
        if plan is None or self.gone_since is not None:
            return None
        return plan if self.now <= min(float(plan.ends[-1]), plan.at + _PLAN_S) else None

    # --- time -----------------------------------------------------------------------------------

    @property
    def now(self) -> float:
        """The graph's time (s since 1970); 0 if no time is known yet.

        On a live site, also if it is gone, this is the system time; otherwise, it is the time of
        the latest value or of the plant's last report, whichever is later.
        """
        if self.mode == "live" or self.gone_since is not None:
            return self.system
        newest = max((value.time for value in self.newest.values()), default=0.0)
        return max(newest, self.time_ns / 1e9)

    @property
    def flow_since(self) -> float | None:
        """Time of the first known flow (s since 1970); None if there is none."""
        rows = self.past["flow"].rows
        return float(rows["ended"][0]) / 1e9 if len(rows) else None

    def given_since(self, begin: float) -> float:
        """Return the volume pumped since a time (s since 1970, m3), as far as it is known."""
        given = self.past[GIVEN]
        return given.value_at(round(self.now * 1e9)) - given.value_at(round(begin * 1e9))

    def local(self, at: float) -> datetime:
        """Return a time (s since 1970) on the site's clock, or on this machine's without a site."""
        zone = None if self.mode == "none" else self.site.zone
        return datetime.fromtimestamp(min(max(at, _FIRST), _LAST), timezone.utc).astimezone(zone)

    def time_text(self, at: float) -> str:
        """Write a time (s since 1970) on the site's clock, with the date unless it is today."""
        return clock_time(self.local(at), self.local(self.now or at))


def text_of(values: Mapping[str, Any], key: str) -> str:
    """Return a text among the values that a node reports; empty if it reports none."""
    value = values.get(key)
    return clean_text(value) if isinstance(value, str) else ""


def number_in(values: Mapping[str, Any], key: str) -> float | None:
    """Return a number among the values that a node reports; None if it reports none."""
    value = values.get(key)
    return value if isinstance(value, (int, float)) else None
