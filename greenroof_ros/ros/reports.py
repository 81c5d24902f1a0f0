"""What the nodes of a graph, and other devices, last reported on /diagnostics.

The alarms node judges these reports; a watcher takes the nodes' values from them. Any program may
publish on the topic, so the number and the length of everything that is kept are limited.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache
from itertools import combinations
from typing import Any, NamedTuple

from greenroof_ros.base.text import clean_text
from greenroof_ros.interface.alarm import ERROR, OK, STALE, WARN
from greenroof_ros.interface.conditions import (
    Condition,
    Diagnosis,
    Value,
    identity_of,
    read_conditions,
)
from greenroof_ros.interface.states import ENDED, FINISHED, PLANT, PUMP, STARTING, STATES
from greenroof_ros.interface.topics import read_topics

SILENT_S = 3.5
"""silence after which a node counts as not responding (s): it may miss two reports, one a second"""
PAUSE_S = 1.0
"""a longer gap between two steps of a process means that the process was paused (s)"""
# Other devices may be slower than this package's nodes: they are lost after this silence (s).
_OTHER_SILENT_S = 5.0
# If a node has been silent for this long (s) when another process reports under its name, it has
# died; after the second time, another node may have its role.
_DIED_S, _GONE_S = 1.5, 10.0
# While all nodes have run for less than this (s), the site is starting: what is late may still
# come.
_START_S = 60.0
MAX_BYTES = 8_000_000
"""largest message that is read (bytes): an ensemble of forecasts has some hundred thousand"""
# Limits to what a hostile sender can fill: statuses in a message, values of each and characters of
# each text; nodes of a role and processes of a node; parts of a node; statuses of
# other devices; characters of a name; topics or nodes that a diagnosis is about.
_STATUSES, _VALUES, _TEXT = 1000, 100, 20_000
_NODES, _PARTS, _OTHERS, _NAME, _ABOUT = 8, 24, 200, 160, 10
# Maximum tick of a run, and the latest time of a run (ns since 1970), which is in the year 2116.
_LAST_TICK, _LAST_NS, _NS = 2**40, 2**62, 1_000_000_000
# A name that ROS allows for a node, since the name becomes part of commands that users are advised
# to run.
_NODE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
# The broker or gateway in a device's address, or its serial line.
_LINE = re.compile(r"[a-z]+://([^/, ]+)|(/dev/[^, ]+)")


class Status(NamedTuple):
    """A status on /diagnostics; the values of this package's nodes are JSON."""

    name: str
    level: int
    message: str
    values: Mapping[str, str] = {}
    hardware: str = ""


def read_statuses(message: bytes) -> tuple[int, list[Status]]:
    """Return the time (ns) and the statuses of a ``diagnostic_msgs/msg/DiagnosticArray``.

    Raises:
        Exception: if the message is incomplete, too large, or not UTF-8.
    """
    from diagnostic_msgs.msg import DiagnosticArray  # only processes that join a graph need ROS
    from rclpy.serialization import deserialize_message

    if len(message) > MAX_BYTES:
        raise ValueError(f"has {len(message)} bytes")
    read = deserialize_message(message, DiagnosticArray)
    return read.header.stamp.sec * _NS + read.header.stamp.nanosec, [
        # An unknown level is treated as ERROR, the worst one that someone can do something about.
        Status(
            status.name[:_TEXT], level if (level := status.level[0]) <= STALE else ERROR,
            status.message[:_TEXT],
            {pair.key[:_TEXT]: pair.value[:_TEXT] for pair in status.values[:_VALUES]},
            status.hardware_id[:_TEXT],
        )
        for status in read.status[:_STATUSES]
    ]


@dataclass(frozen=True)
class StatusDiagnosis:
    """A fault that a status currently reports.

    Attributes:
        level: WARN, ERROR or STALE.
        sentence: sentence that describes the fault.
        code: code of the condition; empty for another device without codes.
        role: the node's role in the interface; empty for another device.
        about: the topics concerned, or the nodes that are being waited for.
        fault: a device's own fault or warning; a new alarm begins when it changes.
        since: beginning of the fault (s since 1970); None if the status does not report it.
        age_s: duration of the fault when it was reported (steady clock, s).
        was_good: for a part, True if its status has ever been OK.
        line: the broker, gateway or serial line of the part's device; empty if unknown.
        received_at: time at which the report was received (steady clock, s).
        again: True if an earlier report about the part was received.
    """

    level: int
    sentence: str
    code: str = ""
    role: str = ""
    about: tuple[str, ...] = ()
    fault: str = ""
    since: float | None = None
    age_s: float = 0.0
    was_good: bool = False
    line: str = ""
    received_at: float = 0.0
    again: bool = False

    @property
    def identity(self) -> tuple[str, str]:
        """Code and fault.

        A new alarm begins when the code or the fault changes, but not when the sentence changes.
        """
        return self.code, self.fault

    @property
    def condition(self) -> Condition | None:
        """The condition with the code; None for another device or an unknown code."""
        return read_conditions().get(self.code) if self.role else None

    @property
    def stops_pump(self) -> bool:
        """Whether the pump cannot start while the fault lasts."""
        condition = self.condition
        return condition is not None and self.level != WARN and (
            condition.stops_pump or condition.interlock is not None
        )


def make_diagnosis(
    level: int, role: str, code: str, *cases: str, **values: Value
) -> StatusDiagnosis:
    """Return a diagnosis that the receiver of the reports makes itself."""
    return StatusDiagnosis(level, Diagnosis.of(code, *cases, **values).sentence, code, role)


def read_diagnosis(
    before: StatusDiagnosis | None, wall: float, status: Status, role: str = "",
    namespace: str = "",
) -> StatusDiagnosis:
    """Return the content of a status of a part, or of another device, even if its level is OK.

    Args:
        before: content of the previous status; None for the first.
        wall: current time (steady clock, s).
        status: the status.
        role: the node's role in the interface; empty for another device.
        namespace: namespace of the node, which is removed from the topics.
    """
    values = {key: clean_text(text) for key, text in status.values.items()}
    about = (values.get("topics") or values.get("topic", "")).split()[:_ABOUT]
    code, fault = identity_of(values)
    line = _LINE.search(status.hardware)
    return StatusDiagnosis(
        status.level, clean_text(status.message) or "reports nothing", code, role,
        tuple(topic.removeprefix(namespace) for topic in about),
        fault, _parse_time(values.get("since", "")), _parse_number(values.get("age_s", "")),
        status.level == OK or (before is not None and before.was_good),
        clean_text(line[1] or line[2]) if line else "", wall, before is not None,
    )


@dataclass
class NodeReport:
    """The last reports of a node of this package, which one process runs after another.

    Attributes:
        name: fully qualified name of the node.
        role: the node's role in the interface.
        state: one of the states in :mod:`greenroof_ros.interface.states`.
        values: all other values in the node's report.
        began: time at which the present process first reported (steady clock, s).
        received_at: time at which the last report was received (steady clock, s).
        since: time at which the node entered its state (steady clock, s).
        last_time: time at which the last report was received, in the graph's time (s since 1970).
        parts: reports about the node's parts, keyed by part name.
        refused_at: time of the last increase in the number of rejected values (steady clock, s).
        refused: topics of the values that were rejected at that time.
        lost: until the next report, ``last_time`` and ``received_at`` of the previous process if it
            died; otherwise None.
        copied_at: time of the last report that another publisher sent as this process (steady
            clock, s).
    """

    name: str
    role: str
    state: str = STARTING
    values: Mapping[str, Any] = field(default_factory=dict)
    began: float = 0.0
    received_at: float = -math.inf
    since: float = 0.0
    last_time: float = 0.0
    parts: dict[str, StatusDiagnosis] = field(default_factory=dict)
    refused_at: float = -math.inf
    refused: tuple[str, ...] = ()
    lost: tuple[float, float] | None = None
    copied_at: float = -math.inf

    def __post_init__(self) -> None:
        # When each process reported first and last (steady clock, s), by machine and process ID.
        self._processes: dict[str, tuple[float, float]] = {}

    @property
    def has_ended(self) -> bool:
        """Whether the node has reported that its run is over or that it is stopping."""
        return self.state in (FINISHED, ENDED)

    def is_online(self, wall: float) -> bool:
        """Return True if the node's reports are currently arriving."""
        return not self.has_ended and wall - self.received_at <= SILENT_S

    def receive(self, wall: float, now: float, state: str, values: Mapping[str, Any]) -> None:
        """Store the status of the node itself; see the attributes."""
        process = clean_text(values["process"], _NAME)
        if process in self._processes:
            self.lost = None
            if _number(values, "up_s") < _number(self.values, "up_s"):
                self.copied_at = wall
        elif not self._begin(wall, process):
            return
        if state != self.state:
            self.since = wall
        known, counts = _read_counts(self.values), _read_counts(values)
        if grown := [topic for topic, n in counts.items() if n > known.get(topic, 0)]:
            self.refused_at, self.refused = wall, tuple(map(clean_text, grown[:_ABOUT]))
        self._processes[process] = self._processes[process][0], wall
        self.state, self.values, self.received_at, self.last_time = state, values, wall, now

    def _begin(self, wall: float, process: str) -> bool:
        """Replace the node's previous process; return False if there are too many processes."""
        silent = [name for name, (_, last) in self._processes.items() if wall - last > SILENT_S]
        if len(self._processes) >= _NODES:
            if not silent:
                return False
            del self._processes[silent[0]]
        died = self._processes and not self.has_ended and wall - self.received_at > _DIED_S
        self.lost = (self.last_time, self.received_at) if died else None
        self.began = self.since = wall
        self.values, self.parts = {}, {}
        self._processes[process] = wall, wall
        return True

    def receive_part(self, part: str, wall: float, status: Status) -> None:
        """Store the status of a part; see :func:`read_diagnosis`."""
        if part in self.parts or len(self.parts) < _PARTS:
            self.parts[part] = read_diagnosis(
                self.parts.get(part), wall, status, self.role, self.name.rpartition("/")[0],
            )

    def excuse_silence(self, seconds: float) -> None:
        """Exclude a period without reception (s) from the silent time."""
        self.received_at += seconds
        self.parts = _postpone(self.parts, seconds)

    def find_twins(self, wall: float) -> tuple[str, str] | None:
        """Return two processes that alternate under the name, older first; None if none do.

        If another publisher copies a process's reports, that process is returned twice. A process
        that replaced an earlier one is not a twin, because the earlier process did not report after
        the later one had started.
        """
        online = [
            (first, last, process) for process, (first, last) in self._processes.items()
            if wall - last <= SILENT_S
        ]
        for (_, last, older), (first, _, newer) in combinations(sorted(online), 2):
            if last > first:
                return older, newer
        if wall - self.copied_at <= SILENT_S:
            process = str(self.values.get("process"))
            return process, process
        return None

    def diagnoses(self, wall: float) -> Iterator[tuple[str, StatusDiagnosis]]:
        """Yield the diagnoses of the node and its parts, each with the name of its status."""
        if self.has_ended:
            failure = self.values.get("failure")
            if isinstance(failure, str) and failure:
                text = clean_text(failure)
                failed = make_diagnosis(ERROR, self.role, "node_failed", failure=text)
                yield self.name, replace(failed, since=self.last_time)
            return
        online = self.is_online(wall)
        lost = make_diagnosis(STALE, self.role, "not_heard", time=SILENT_S)
        lost = replace(lost, since=self.last_time)
        waiting = self.values.get("waiting")
        if twins := online and self.find_twins(wall):
            older, newer = twins
            yield self.name, make_diagnosis(
                ERROR, self.role, "two_processes", older=older, newer=newer
            )
        elif not online:
            yield self.name, lost
        elif self.lost is not None:
            since, received_at = self.lost
            yield self.name, replace(lost, since=since, age_s=wall - received_at)
        elif self.state == STARTING and isinstance(waiting, list):
            peers = tuple(clean_text(str(peer)) for peer in waiting[:_ABOUT])
            waits = make_diagnosis(WARN, self.role, "peers_awaited", peers=", ".join(peers))
            yield self.name, replace(waits, about=peers, age_s=wall - self.since)
        if wall - self.refused_at <= SILENT_S:
            topics = ", ".join(self.refused)
            refused = make_diagnosis(WARN, self.role, "values_refused", topics=topics)
            yield f"{self.name}: refused", replace(refused, about=self.refused)
        for part, diagnosis in self.parts.items():
            # Whatever was wrong when a silent node last reported stays.
            if online and self.received_at - diagnosis.received_at > SILENT_S:
                yield f"{self.name}: {part}", lost
            elif diagnosis.level != OK:
                yield f"{self.name}: {part}", diagnosis


class Reports:
    """The latest reports of the nodes in one namespace, and of other devices.

    Attributes:
        nodes: the nodes that have reported, by name.
        expected: the nodes that must report, by name.
        time_ns: time of the plant's latest tick (ns since 1970); 0 before the first tick.
    """

    def __init__(self, namespace: str = "", expected: Iterable[str] = ()) -> None:
        """Start without reports.

        Args:
            namespace: namespace such as ``/site1``; nodes in other namespaces are treated as other
                devices.
            expected: names of the nodes that must report.
        """
        self.nodes: dict[str, NodeReport] = {}
        self.time_ns = 0
        self._namespace = "/" + namespace.strip("/")
        self.expected = {f"{namespace.rstrip('/')}/{name}": name for name in expected}
        self._others: dict[str, StatusDiagnosis] = {}

    def receive(
        self, wall: float, now: float, statuses: Sequence[Status], stamp_ns: int = 0
    ) -> None:
        """Receive the statuses from a message; invalid content raises no exception.

        Args:
            wall: current time (steady clock, s).
            now: current time of the graph (s since 1970).
            statuses: the statuses.
            stamp_ns: time stamp of the message (ns since 1970); in a simulation, the time of the
                tick.
        """
        if len(self._others) >= _OTHERS:
            self._others = {
                name: part for name, part in self._others.items()
                if wall - part.received_at <= _OTHER_SILENT_S
            }
        # A node comes before its parts.
        for status in sorted(statuses, key=lambda status: ": " in status.name):
            name = clean_text(status.name, _NAME)
            values = self._values_of(name, status)
            if values is None:
                self._receive_part(wall, name, status)
                continue
            node = self.nodes.get(name) or self._make(wall, name, values["role"])
            if node is not None and node.role == values["role"]:
                node.receive(wall, now, status.message, values)
                if node.role == PLANT and 0 < _number(values, "tick") <= _LAST_TICK:
                    self.time_ns = stamp_ns if 0 < stamp_ns < _LAST_NS else self.time_ns

    def _values_of(self, name: str, status: Status) -> dict[str, Any] | None:
        """Return the values in a status of a node of this graph; None for any other status."""
        own = (name.rpartition("/")[0] or "/") == self._namespace and _NODE_NAME.fullmatch(name)
        if status.message not in STATES or not own:
            return None
        try:
            values = {key: _read_value(text) for key, text in status.values.items()}
        except (ValueError, RecursionError):
            return None
        role, process = values.get("role"), values.get("process")
        named = isinstance(role, str) and role in _list_roles() and isinstance(process, str)
        return values if named else None

    def _receive_part(self, wall: float, name: str, status: Status) -> None:
        """Receive the status of a part of a node, or of another device."""
        node_name, _, part = name.partition(": ")
        if "process" in status.values and status.message in (FINISHED, ENDED):
            self._forget(name)  # a node of another graph, which may now be silent
        elif part and (node := self.nodes.get(node_name)) is not None:
            node.receive_part(part, wall, status)
        elif name in self._others or len(self._others) < _OTHERS:
            self._others[name] = read_diagnosis(self._others.get(name), wall, status)

    def _forget(self, name: str) -> None:
        """Remove another device, and its parts."""
        for other in [other for other in self._others if other.partition(": ")[0] == name]:
            del self._others[other]

    def _make(self, wall: float, name: str, role: str) -> NodeReport | None:
        """Add a node, in the place of a silent one if its role has too many; None if no place."""
        same = [node for node in self.nodes.values() if node.role == role]
        if len(same) >= _NODES:
            silent = min(same, key=lambda node: node.received_at)
            if wall - silent.received_at <= SILENT_S:
                return None
            del self.nodes[silent.name]
        self._forget(name)
        self.nodes[name] = NodeReport(name, role)
        return self.nodes[name]

    def excuse_silence(self, seconds: float) -> None:
        """Exclude a period without reception (s) from the silent time of all nodes."""
        for node in self.nodes.values():
            node.excuse_silence(seconds)
        self._others = _postpone(self._others, seconds)

    def value(self, role: str, key: str) -> Any:
        """Return a value in the last report of the node with a role; None if there is none."""
        nodes = [node for node in self.nodes.values() if node.role == role]
        latest = max(nodes, key=lambda node: node.received_at, default=None)
        return None if latest is None else latest.values.get(key)

    @property
    def warnings(self) -> set[str]:
        """The warnings of the nodes, each with the node's name."""
        listed = ((node.name, node.values.get("warnings")) for node in self.nodes.values())
        return {
            f"{name}: {clean_text(str(text))}" for name, texts in listed if isinstance(texts, list)
            for text in texts[:_ABOUT]
        }

    def level(self, name: str) -> float | None:
        """Return the level of a tank (m), as a node knows it; None if no node does."""
        levels = (node.values.get(f"{name}_level") for node in self.nodes.values())
        return next((level for level in levels if isinstance(level, (int, float))), None)

    def is_starting(self, wall: float) -> bool:
        """Return True if the site is starting: its online nodes all started less than 60 s ago."""
        up = [node.values.get("up_s") for node in self.nodes.values() if node.is_online(wall)]
        return bool(up) and all(isinstance(age, (int, float)) and age < _START_S for age in up)

    def diagnoses(self, wall: float) -> dict[str, StatusDiagnosis]:
        """Return the diagnoses of all current faults, keyed by the name of the status."""
        diagnoses = {
            name: make_diagnosis(STALE, _role_of(node), "node_awaited")
            for name, node in self.expected.items() if name not in self.nodes
        }
        for name, part in self._others.items():
            silent = wall - part.received_at > _OTHER_SILENT_S
            # A device that has reported only once may not be meant to report regularly.
            if silent and part.again:
                silence = make_diagnosis(STALE, "", "not_heard", time=_OTHER_SILENT_S)
                diagnoses[name] = replace(silence, code="")
            elif part.level != OK and not silent:
                diagnoses[name] = part
        online = [node for node in self.nodes.values() if node.is_online(wall)]
        for node in self.nodes.values():
            replaced = any(other.role == node.role for other in online if other is not node)
            if not (replaced and wall - node.received_at > _GONE_S):
                diagnoses.update(node.diagnoses(wall))
        if len(pumps := sorted(node.name for node in online if node.role == PUMP)) > 1:
            diagnoses[f"{pumps[0]}: pump nodes"] = make_diagnosis(
                ERROR, PUMP, "two_pump_nodes", nodes=" and ".join(pumps)
            )
        return diagnoses


def _postpone(
    parts: Mapping[str, StatusDiagnosis], seconds: float
) -> dict[str, StatusDiagnosis]:
    """Return reports as if they had been received later (s)."""
    return {
        name: replace(part, received_at=part.received_at + seconds) for name, part in parts.items()
    }


def _read_value(text: str) -> Any:
    """Return the value of a JSON string in a status from a node of this package.

    Numbers that are not finite and integers of 20 or more characters are read as None, since no
    quantity has such values, and calculations with them would fail.
    """
    return json.loads(
        text, parse_int=lambda digits: int(digits) if len(digits) < 20 else None,
        parse_float=lambda digits: value if math.isfinite(value := float(digits)) else None,
        parse_constant=lambda _: None,
    )


def _number(values: Mapping[str, Any], key: str) -> float:
    """Return a number among a node's values; 0 if there is none."""
    value = values.get(key)
    return value if isinstance(value, (int, float)) else 0.0


def _read_counts(values: Mapping[str, Any]) -> dict[str, int]:
    """Return the number of values that a node has rejected so far, by topic."""
    refused = values.get("refused")
    counts = refused.items() if isinstance(refused, dict) else ()
    return {topic: count for topic, count in counts if isinstance(count, int)}


def _parse_time(text: str) -> float | None:
    """Return an ISO 8601 time as seconds since 1970; None if the text is not an ISO 8601 time."""
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        return None


def _parse_number(text: str) -> float:
    """Return the number of seconds in a text; 0 if the text is not a number."""
    try:
        seconds = float(text)
    except ValueError:
        return 0.0
    return seconds if 0 <= seconds < 1e9 else 0.0


@cache
def _list_roles() -> frozenset[str]:
    """Return the roles of all nodes in the interface."""
    return frozenset(
        role for topic in read_topics().values() for roles in (
            topic.publishers, topic.subscribers, topic.live_publishers, topic.live_subscribers
        ) for role in roles
    )


def _role_of(name: str) -> str:
    """Return the role of a node by its name: the controller's name is that of its class."""
    return name if name in _list_roles() else "controller"
