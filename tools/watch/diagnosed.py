"""What nodes report as wrong on /diagnostics, by independent rules, to compare the page with.

A part of a node reports what is wrong itself. A node is wrong if it ended with a failure, was
silent for longer than bringup's limit, is there twice, waits for others, or refuses values.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from greenroof_ros.common.conditions import LATCHED, read_interlocks
from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.messages import qos_profile
from greenroof_ros.graph.states import ENDED, STARTING, STATES

# A node reports four times a second; bringup holds the pump after 2 s (doc/explanation/live.md).
SILENT_S = 2.0
# A node that waits for another one for longer than this reports an alarm (s).
_WAITS_S = 5.0
_POLL_S = 0.1
_LEVELS = ("", "warn", "error", "stale")
_LATCHED = {code for code, interlock in read_interlocks().items() if interlock.kind == LATCHED}


@dataclass
class _Node:
    process: str
    state: str
    since: float  # in this state
    last: float
    values: dict[str, Any]
    before: dict[str, float] = field(default_factory=dict)  # when other processes last reported
    twice: float = -math.inf  # when two processes last reported in turn
    refuses: float = -math.inf  # when it last refused more values than before
    refused: dict[str, dict[str, int]] = field(default_factory=dict)  # by process, then topic
    parts: dict[str, tuple[float, str]] = field(default_factory=dict)  # time, what is wrong


class Diagnosed:
    """Receives /diagnostics in a node that a caller spins. Times are of `time.monotonic` (s).

    Attributes:
        changes: changes by the name of a status: the time, and what is wrong from then on, as level
            and code; empty if nothing is.
        restarts: when a new process appeared under the name of a node, and the name.
    """
    def __init__(self, node: Node) -> None:
        self.changes: dict[str, list[tuple[float, str]]] = {}
        self.restarts: list[tuple[float, str]] = []
        self._nodes: dict[str, _Node] = {}
        profile = qos_profile(read_topics()["/diagnostics"].qos)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._receive, profile)
        node.create_timer(_POLL_S, self._update)

    @property
    def problems(self) -> dict[str, str]:
        """What is wrong now, by the name of its status."""
        changes = list(self.changes.items())  # another thread adds to it
        return {name: changes[-1][1] for name, changes in changes if changes[-1][1]}

    def _receive(self, message: Any) -> None:
        at = time.monotonic()
        for status in message.status:
            name, _, part = status.name.partition(": ")
            level = _LEVELS[status.level[0]]
            if part and name in self._nodes:
                code = next((entry.value for entry in status.values if entry.key == "code"), "")
                values = self._nodes[name].values
                if part == "pump" and level and not values["stands"]:
                    if values["speed"] is None:  # it is unknown whether the pump turns
                        level, code = "error", code if code in _LATCHED else "stands_unknown"
                    elif values["hold"] and code not in _LATCHED:
                        code = "stop_not_followed"
                self._nodes[name].parts[part] = at, f"{level} {code}" if level else ""
            elif not part and status.message in STATES:
                values = {entry.key: json.loads(entry.value) for entry in status.values}
                self._receive_node(at, name, status.message, values)
        self._update()

    def _receive_node(self, at: float, name: str, state: str, values: dict[str, Any]) -> None:
        process = values["process"]
        node = self._nodes.get(name)
        if node is None:
            node = self._nodes[name] = _Node(process, state, at, at, values)
            node.refused[process] = values.get("refused") or {}
            return
        if process != node.process:
            node.before[node.process] = node.last
            if at - node.before.get(process, -math.inf) <= SILENT_S:
                node.twice = at
            else:
                self.restarts.append((at, name))
                node.parts.clear()
                node.values = {}
        counts = values.get("refused") or {}
        before = node.refused.setdefault(process, counts)
        if any(count > before.get(topic, 0) for topic, count in counts.items()):
            node.refuses = at
        node.refused[process] = counts
        if state != node.state:
            node.since = at
        node.process, node.state, node.last, node.values = process, state, at, values

    def _update(self) -> None:
        at = time.monotonic()
        wrong = {}
        for name, node in self._nodes.items():
            wrong.update(_wrong(at, name, node))
        for name in self.changes.keys() | wrong.keys():
            changes, now = self.changes.get(name, [(at, "")]), wrong.get(name, "")
            if now != changes[-1][1]:
                self.changes[name] = [*changes, (at, now)]


def _wrong(at: float, name: str, node: _Node) -> dict[str, str]:
    """Return what is wrong with a node, by the name of the status that the page shows."""
    if node.state == ENDED:
        return {name: "error node_failed"} if node.values.get("failure") else {}
    silent = "stale not_heard"
    wrong = {
        f"{name}: {part}": what if at - last <= SILENT_S or at - node.last > SILENT_S else silent
        for part, (last, what) in node.parts.items()
    }
    if at - node.last > SILENT_S:
        wrong[name] = silent
    elif at - node.twice <= SILENT_S:
        wrong[name] = "error two_processes"
    elif node.state == STARTING and at - node.since > _WAITS_S and node.values.get("waiting"):
        wrong[name] = "warn waits"
    if at - node.refuses <= SILENT_S:
        wrong[f"{name}: refused"] = "warn values_refused"
    return {status: what for status, what in wrong.items() if what}
