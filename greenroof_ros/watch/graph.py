"""The nodes of the watched graph by their latest reports on /diagnostics, and its times."""

from __future__ import annotations

import json
import math
import re
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from greenroof_ros.base.text import clean_text
from greenroof_ros.interface.states import ENDED, FINISHED, PLANT, STATES
from greenroof_ros.interface.topics import Topic, read_topics
from greenroof_ros.ros.alarms import SILENT_S
from greenroof_ros.watch.wire import WireStatus
from greenroof_ros.watch.words import clean_sentence, name_source

# A silent node may be replaced by another process; after this time (s), it is gone.
_GONE_S = 10.0
# Shortest and longest time over which the speed of a simulation is measured (s).
_SPEED_S, _SPEED_MAX_S = 1.0, 3.0
# Limits to what a hostile sender can fill, in addition to those of :mod:`.wire`: characters of a
# name, and events from one report.
_NAME, _NEWEST = 160, 10
# Maximum tick of a run, and the latest time of a run (ns since 1970), which is in the year 2116.
_LAST_TICK, _LAST_NS = 2**40, 2**62
# A message further than this from the clock (ticks) comes from a publisher that was restarted: the
# plant is at most 32 ticks ahead of the recorder, and messages received together are closer.
_FAR = 64
# A name that ROS allows for a node, since the name becomes part of commands that users are advised
# to run.
_NODE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@dataclass
class Node:
    """The latest report of a node of this package.

    Attributes:
        name: fully qualified name of the node.
        role: the node's role in the interface.
        process: machine and process ID of the node's process.
        state: one of the states in :mod:`greenroof_ros.interface.states`.
        values: all other values in the node's report.
        received_at: time at which the report was received (steady clock, s).
    """

    name: str
    role: str
    process: str
    state: str
    values: Mapping[str, Any]
    received_at: float

    @property
    def has_ended(self) -> bool:
        """Whether the node has reported that its run is over or that it is stopping."""
        return self.state in (FINISHED, ENDED)

    def is_online(self, wall: float) -> bool:
        """Return whether the node's reports are currently arriving."""
        return not self.has_ended and wall - self.received_at <= SILENT_S

    def is_present(self, wall: float) -> bool:
        """Return whether the node has reported within the last 10 s and has not ended."""
        return not self.has_ended and wall - self.received_at < _GONE_S

    @property
    def lockstep(self) -> bool:
        """Whether the node runs in lockstep; nodes in a live graph do not number their ticks."""
        return "run_length" in self.values

    def text(self, key: str) -> str:
        """Return the text of a key that the node reports; empty if it reports none."""
        value = self.values.get(key)
        return clean_sentence(value) if isinstance(value, str) else ""


class Graph:
    """The nodes in one namespace, one for each role, and the times of the graph's messages.

    In a simulated graph, the time of a message is that of the tick; at a live site, it is the time
    of arrival. In lockstep, the j-th message on a topic belongs to tick j - 1, where j is the
    number assigned by its publisher. The order of arrival is less reliable, since the plant's next
    clock message may arrive before the messages of the previous tick.

    Attributes:
        runs: number of new runs, or of changes between a run and a live site.
        live: whether the current or last graph is live; None before the first graph.
        time_ns: time of the plant's latest tick (ns since 1970); 0 before the first tick.
        offered: names of the nodes that offer a hold service for the pump, and so may control it,
            whatever is reported, each with the number of nodes that have this name.
    """

    def __init__(self, namespace: str = "", on_event: Callable[[str], None] | None = None) -> None:
        """Start without nodes.

        Args:
            namespace: namespace such as ``/site1``; nodes in other namespaces are ignored.
            on_event: callback that receives each event as a sentence.
        """
        self.runs = self.time_ns = 0
        self.live: bool | None = None
        self.offered: Mapping[str, int] = {}
        self._namespace = "/" + namespace.strip("/")
        self._on_event = on_event or (lambda _: None)
        self._nodes: dict[str, Node] = {}  # by role
        self._replaced: dict[str, str] = {}  # by role: the process before
        self._ticks: deque[tuple[float, int]] = deque()
        self.forget_clock()

    # --- reports --------------------------------------------------------------------------------

    def receive(
        self, wall: float, statuses: Sequence[WireStatus], stamp_ns: int = 0
    ) -> None:
        """Receive the statuses of one message; invalid content raises no exception.

        Args:
            wall: current time (steady clock, s).
            statuses: the statuses.
            stamp_ns: time stamp of the message (ns since 1970); in a simulation, the time of the
                tick.
        """
        for status in statuses:
            if (node := self._read_node(wall, status)) is not None:
                self._receive_node(wall, node, stamp_ns)

    def is_own(self, name: str) -> bool:
        """Return whether a name is that of a node in this namespace."""
        return (
            len(name) <= _NAME and _NODE_NAME.fullmatch(name) is not None
            and (name.rpartition("/")[0] or "/") == self._namespace
        )

    def _read_node(self, wall: float, status: WireStatus) -> Node | None:
        """Return the node of this graph that a status is about; None for any other status."""
        if status.message not in STATES or not self.is_own(status.name):
            return None
        try:
            values = {key: _read_value(text) for key, text in status.values.items()}
        except (ValueError, RecursionError):
            return None
        role, process = values.get("role"), values.get("process")
        if not (isinstance(role, str) and role in _list_roles() and isinstance(process, str)):
            return None
        return Node(status.name, role, clean_text(process, _NAME), status.message, values, wall)

    def _receive_node(self, wall: float, node: Node, stamp_ns: int) -> None:
        before = self._nodes.get(node.role)
        if before is not None and before.name != node.name and before.is_online(wall):
            return  # a role has one node
        if before is not None and before.process != node.process:
            if self._replaced.get(node.role) == node.process:
                return
            self._replaced[node.role] = before.process
        if before is None or before.process != node.process:
            if node.role == PLANT:
                self._begin_run(wall, before)
        else:
            self._report_changes(before.values, node)
        self._nodes[node.role] = node
        if node.role == PLANT:
            self._receive_plant(wall, node, stamp_ns)

    def _begin_run(self, wall: float, before: Node | None) -> None:
        """Forget the previous run: its ticks, and the reports of nodes that are silent."""
        self.runs += before is not None
        self.time_ns = 0
        self._ticks.clear()
        self._nodes = {role: node for role, node in self._nodes.items() if node.is_online(wall)}

    def _report_changes(self, before: Mapping[str, Any], node: Node) -> None:
        """Report a node's new parameter changes as events."""
        listed = node.values.get("parameter_changes")
        first, last = (
            values.get("parameter_change_count") for values in (before, node.values)
        )
        if isinstance(listed, list) and isinstance(first, int) and isinstance(last, int):
            for change in listed[-min(last - first, _NEWEST):] if last > first else ():
                if isinstance(change, dict):
                    what, old, new = (change.get(key) for key in ("parameter", "before", "value"))
                    name = name_source(node.name, node.role)
                    self._on_event(f"{name}: {what} was changed from {old} to {new}")

    def _receive_plant(self, wall: float, node: Node, stamp_ns: int) -> None:
        tick = node.values.get("tick")
        if type(tick) is not int or not 0 < tick <= _LAST_TICK:
            return  # before the first tick, the stamp is not the run's
        self._ticks.append((wall, tick))
        while wall - self._ticks[0][0] > _SPEED_MAX_S:
            self._ticks.popleft()
        if stamp_ns < _LAST_NS:
            self.time_ns = stamp_ns

    def excuse_silence(self, seconds: float) -> None:
        """Exclude a period without reception (s) from the silent time of all nodes."""
        for node in self._nodes.values():
            node.received_at += seconds

    # --- what is known --------------------------------------------------------------------------

    def node(self, role: str) -> Node | None:
        """Return the node with a given role; None if no node with this role has reported."""
        return self._nodes.get(role)

    def update(self, wall: float) -> str:
        """Return the kind of graph now: ``none``, ``simulated``, ``live`` or ``ended``."""
        plant, was_live = self.node(PLANT), self.live
        if plant is not None and plant.is_present(wall):
            mode, self.live = "simulated", False
        # A live site is not over: if its program ends or falls silent, nobody waters the roof.
        elif any(not node.lockstep for node in self._nodes.values()):
            mode, self.live = "live", True
        else:  # without a plant, nodes are waiting for theirs
            mode = "none" if plant is None else "ended"
        if was_live not in (None, self.live):
            self.runs += 1
        return mode

    def factor(self, tau: float) -> float | None:
        """Return the ratio of simulated to wall time over the last few seconds; None if unknown."""
        if len(self._ticks) < 2:
            return None
        (began, first), (ended, last) = self._ticks[0], self._ticks[-1]
        return None if ended - began < _SPEED_S else (last - first) * tau / (ended - began)

    @property
    def has_two_pumps(self) -> bool:
        """Whether more than one node may control the pump."""
        return sum(self.offered.values()) > 1

    def site(self) -> Path | None:
        """Return the site file of the graph; None if it is not on this machine."""
        for role in (PLANT, "controller"):
            node = self.node(role)
            if node is not None and node.process.rpartition(" ")[0] == socket.gethostname():
                text = node.values.get("site")
                if isinstance(text, str) and text.startswith("/") and "\0" not in text:
                    try:
                        if (path := Path(text)).exists():
                            return path
                    except OSError:
                        pass
        return None

    # --- times of messages ----------------------------------------------------------------------

    def forget_clock(self) -> None:
        """Forget all clock messages received so far."""
        self._newest_ns = 0  # time of the newest clock message (since 1970)
        self._clock = 0  # number of that message
        self._period = 0  # ns

    def receive_clock(self, number: int | None, time_ns: int) -> None:
        """Receive a clock message and its number, as counted by its publisher."""
        number = self._clock + 1 if number is None else number
        if self._clock and number > self._clock:
            self._period = (time_ns - self._newest_ns) // (number - self._clock)
        self._clock, self._newest_ns = number, time_ns

    def time_of(self, topic: Topic, number: int | None, arrived_ns: int) -> int | None:
        """Return the time of a message (ns since 1970); None if it cannot be determined yet.

        Args:
            topic: topic of the message.
            number: number of the message, counted by its publisher from 1; None if unknown.
            arrived_ns: time of arrival (ns since 1970).
        """
        if self.live:
            return arrived_ns
        if not topic.per_tick:
            return self._newest_ns or None
        if not self._period:
            return None  # fewer than two clocks were received
        # A pump driver from another package may have begun at any tick, so the newest time applies.
        # There is no other plant, and its status may arrive after its first messages.
        own = topic.publishers == (PLANT,) or any(map(self.node, topic.publishers))
        ahead = number - self._clock if own and number is not None else 0
        return None if abs(ahead) > _FAR else self._newest_ns + ahead * self._period


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


@cache
def _list_roles() -> frozenset[str]:
    """Return the roles of all nodes in the interface."""
    return frozenset(
        role for topic in read_topics().values() for roles in (
            topic.publishers, topic.subscribers, topic.live_publishers, topic.live_subscribers
        ) for role in roles
    )
