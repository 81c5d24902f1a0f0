"""What the nodes of a graph last reported on /diagnostics, and what is wrong according to it.

The alarms node judges these reports; a watcher takes the nodes' values from them. Any program may
publish on the topic, so the number and the length of everything that is kept are limited. Statuses
of other programs are ignored.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

from greenroof_ros.base.errors import MalformedMessageError
from greenroof_ros.base.text import clean_text
from greenroof_ros.interface.alarm import ERROR, LEVELS, OK, STALE, WARN, Alarm
from greenroof_ros.interface.conditions import Condition, Diagnosis, identity_of, read_conditions
from greenroof_ros.interface.states import ENDED, FINISHED, PLANT, STARTING, STATES
from greenroof_ros.interface.topics import node_names

SILENT_S = 3.5
"""silence after which a node counts as not responding (s): it may miss two reports, one a second"""
PAUSE_S = 1.0
"""a longer gap between two steps of a process means that the process was paused (s)"""
# For how long it is told that another process has replaced one that did not end (s).
_REPLACED_S = 1.0
# While all nodes have run for less than this (s), the site is starting: what is late may still
# come.
_START_S = 60.0
# Limits to what a sender can fill: bytes of a message; nodes, parts of each, characters of a name;
# topics or nodes that a diagnosis is about.
_BYTES, _NODES, _PARTS, _NAME, _ABOUT = 1_000_000, 24, 24, 160, 10
# The latest time of a run (ns since 1970), which is in the year 2116.
_LAST_NS, _NS = 2**62, 1_000_000_000
# A name that ROS allows for a node, since the name becomes part of commands that users are advised
# to run.
_NODE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_UNKNOWN = Condition("", "")
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
        MalformedMessageError: if the message is incomplete, too large, or not UTF-8.
    """
    from diagnostic_msgs.msg import DiagnosticArray  # only processes that join a graph need ROS

    from greenroof_ros.ros.messages import deserialize

    if len(message) > _BYTES:
        raise MalformedMessageError(f"has {len(message)} bytes")
    read = deserialize(DiagnosticArray, message)
    return read.header.stamp.sec * _NS + read.header.stamp.nanosec, [
        # An unknown level is treated as ERROR, the worst one that someone can do something about.
        Status(
            status.name, level if (level := status.level[0]) <= STALE else ERROR, status.message,
            {pair.key: pair.value for pair in status.values}, status.hardware_id,
        )
        for status in read.status
    ]


@dataclass(frozen=True)
class StatusDiagnosis(Alarm):
    """What is wrong with a node or one of its parts: an alarm without number and time.

    Attributes:
        began: beginning of the fault on the steady clock (s).
        was_good: for a part, True if its status has ever been OK.
        line: the broker, gateway or serial line of the part's device; empty if unknown.
    """

    since: float = 0.0
    began: float = 0.0
    was_good: bool = False
    line: str = ""

    @classmethod
    def of(
        cls, node: str, part: str, role: str, code: str, level: int, began: float,
        **values: float | str,
    ) -> StatusDiagnosis:
        """Return a diagnosis with the sentence of the conditions table, and with these values."""
        sentence = Diagnosis.of(code, **values).sentence
        return cls(0, node, part, role, code, LEVELS[level], sentence, began=began)

    @property
    def identity(self) -> tuple[str, str]:
        """Code and fault; if they change, but not if the sentence does, a new alarm begins."""
        return self.code, self.fault

    @property
    def condition(self) -> Condition:
        """The condition with the code; one without properties if the code is unknown."""
        return read_conditions().get(self.code, _UNKNOWN)

    @property
    def stops_pump(self) -> bool:
        """Whether the pump cannot start while the fault lasts."""
        condition = self.condition
        return self.is_serious and (condition.stops_pump or condition.interlock is not None)


@dataclass
class NodeReport:
    """The last report of a node of this package.

    Attributes:
        name: fully qualified name of the node.
        role: the node's role in the interface.
        state: one of the states in :mod:`greenroof_ros.interface.states`.
        values: all other values in the node's report.
        began: time at which the present process first reported (steady clock, s).
        received_at: time at which the last report was received (steady clock, s).
        parts: states of the node's parts, keyed by part name.
    """

    name: str
    role: str
    state: str = STARTING
    values: Mapping[str, Any] = field(default_factory=dict)
    began: float = 0.0
    received_at: float = -math.inf
    parts: dict[str, StatusDiagnosis] = field(default_factory=dict)
    # received_at of the process before, unless it reported that it ended.
    _lost: float | None = field(default=None, init=False)

    @property
    def has_ended(self) -> bool:
        """Whether the node has reported that its run is over or that it is stopping."""
        return self.state in (FINISHED, ENDED)

    def is_online(self, steady: float) -> bool:
        """Return True if the node's reports are currently arriving."""
        return not self.has_ended and steady - self.received_at <= SILENT_S

    def receive(
        self, steady: float, state: str, values: Mapping[str, Any], parts: Sequence[Status] = ()
    ) -> None:
        """Store a report of the node; see the attributes."""
        if values["process"] != self.values.get("process"):
            died = self.values and not self.has_ended
            self._lost = self.received_at if died else None
            self.began, self.values, self.parts = steady, {}, {}
        self.state, self.values, self.received_at = state, values, steady
        reported = (self._read_part(steady, status) for status in parts[:_PARTS])
        self.parts = {diagnosis.part: diagnosis for diagnosis in reported}

    def _read_part(self, steady: float, status: Status) -> StatusDiagnosis:
        part = clean_text(status.name.partition(": ")[2], _NAME)
        values = {key: clean_text(text) for key, text in status.values.items()}
        about = (values.get("topics") or values.get("topic", "")).split()[:_ABOUT]
        namespace = self.name.rpartition("/")[0]
        line = _LINE.search(status.hardware)
        before, (code, fault) = self.parts.get(part), identity_of(values)
        began = steady - _read_age(values.get("age_s", ""))
        if before is not None and before.identity == (code, fault):
            began = before.began
        return StatusDiagnosis(
            0, self.name, part, self.role, code, LEVELS[status.level],
            clean_text(status.message) or "reports nothing", fault=fault, began=began,
            about=tuple(topic.removeprefix(namespace) for topic in about),
            was_good=status.level == OK or (before is not None and before.was_good),
            line=clean_text(line[1] or line[2]) if line else "",
        )

    def diagnoses(self, steady: float) -> Iterator[StatusDiagnosis]:
        """Yield what is wrong with the node and its parts."""
        diagnose = partial(StatusDiagnosis.of, self.name, "", self.role)
        last = self.received_at
        failure, waiting = self.values.get("failure"), self.values.get("waiting")
        if self.has_ended:
            if failure:
                yield diagnose("node_failed", ERROR, last, failure=clean_text(str(failure)))
            return
        if not self.values:
            yield diagnose("node_awaited", STALE, last)
        elif not self.is_online(steady):
            yield diagnose("node_silent", STALE, last, time=SILENT_S)
        elif self._lost is not None and steady - self.began <= _REPLACED_S:
            yield diagnose("node_silent", STALE, self._lost, time=SILENT_S)
        elif self.state == STARTING and isinstance(waiting, list):
            about = tuple(clean_text(str(peer), _NAME) for peer in waiting[:_ABOUT])
            awaits = diagnose("peers_awaited", WARN, self.began, peers=", ".join(about))
            yield replace(awaits, about=about)
        # That of a silent node stays.
        yield from (part for part in self.parts.values() if part.level != LEVELS[OK])


class Reports:
    """The latest reports of the nodes in one namespace.

    Attributes:
        nodes: the nodes that have reported, by name.
        expected: the nodes that must report, by name.
        time_ns: time of the plant's latest tick (ns since 1970); 0 before the first tick.
    """

    def __init__(self, namespace: str = "", expected: Iterable[str] = ()) -> None:
        """Start without reports.

        Args:
            namespace: namespace such as ``/site1``; nodes in other namespaces are ignored.
            expected: names of the nodes that must report.
        """
        self.nodes: dict[str, NodeReport] = {}
        self.time_ns = 0
        self._awaited_since = math.inf  # since when nodes are awaited (steady clock, s)
        self._namespace = "/" + namespace.strip("/")
        self.expected = {f"{namespace.rstrip('/')}/{name}": name for name in expected}

    def receive(self, steady: float, statuses: Sequence[Status], stamp_ns: int = 0) -> None:
        """Receive the statuses from a message; invalid content raises no exception.

        Args:
            steady: current time (steady clock, s).
            statuses: the statuses; a node reports its own state and those of its parts together.
            stamp_ns: time stamp of the message (ns since 1970); in a simulation, the time of the
                tick.
        """
        for status in statuses:
            values, node = self._values_of(status), self.nodes.get(status.name)
            if values is None:
                continue
            role = values["role"]
            if node is None and len(self.nodes) < _NODES and role in {*node_names(), "controller"}:
                node = self.nodes[status.name] = NodeReport(status.name, role)
            if node is None or node.role != role:
                continue
            parts = [part for part in statuses if part.name.startswith(f"{status.name}: ")]
            node.receive(steady, status.message, values, parts)
            if node.role == PLANT and values.get("tick") and 0 < stamp_ns < _LAST_NS:
                self.time_ns = stamp_ns

    def _values_of(self, status: Status) -> dict[str, Any] | None:
        """Return the values in a status of a node of this graph; None for any other status."""
        name = status.name if len(status.name) <= _NAME else ""
        own = _NODE_NAME.fullmatch(name) and (name.rpartition("/")[0] or "/") == self._namespace
        if status.message not in STATES or not own:
            return None
        try:
            values = {key: _read_value(text) for key, text in status.values.items()}
        except (ValueError, RecursionError):
            return None
        role, process = values.get("role"), values.get("process")
        return values if isinstance(role, str) and isinstance(process, str) else None

    def excuse_silence(self, seconds: float) -> None:
        """Exclude a period without reception (s) from the silent time of all nodes."""
        for node in self.nodes.values():
            node.received_at += seconds

    def node(self, role: str) -> NodeReport | None:
        """Return the node with a role that has reported last; None if none has."""
        nodes = [node for node in self.nodes.values() if node.role == role]
        return max(nodes, key=lambda node: node.received_at, default=None)

    def value(self, key: str) -> Any:
        """Return a value that a node last reported, the latest one; None if no node reports it."""
        latest = sorted(self.nodes.values(), key=lambda node: -node.received_at)
        values = (node.values.get(key) for node in latest)
        return next((value for value in values if value is not None), None)

    def is_starting(self, steady: float) -> bool:
        """Return True if the site is starting: its online nodes all started less than 60 s ago."""
        up = [node.values.get("up_s") for node in self.nodes.values() if node.is_online(steady)]
        return bool(up) and all(isinstance(age, (int, float)) and age < _START_S for age in up)

    def diagnoses(self, steady: float) -> dict[str, StatusDiagnosis]:
        """Return everything that is wrong, by the name of its status."""
        self._awaited_since = min(self._awaited_since, steady)
        awaited = [
            NodeReport(
                name, node if node in node_names() else "controller",
                received_at=self._awaited_since,
            ) for name, node in self.expected.items() if name not in self.nodes
        ]
        return {
            diagnosis.name: diagnosis for node in (*awaited, *self.nodes.values())
            for diagnosis in node.diagnoses(steady)
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


def _read_age(text: str) -> float:
    """Return the number of seconds in a text; 0 if the text is not a number of seconds."""
    with suppress(ValueError):
        return seconds if 0 <= (seconds := float(text)) < 1e9 else 0.0
    return 0.0
