"""Which graph is there, from what its nodes say of themselves on /diagnostics."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.supervision import ENDED, FINISHED, PUMP, RECORDER, STATES
from greenroof_ros.watch.alarms import SILENT_S, Status, is_node_name, read_value

_PLANT = "plant"
# A node that is silent may be replaced by another process; after so long (s) it is gone.
_GONE_S = 10.0
# Over what time the speed of a simulation is measured, at least and at most (s).
_SPEED_S, _SPEED_MOST_S = 1.0, 3.0
# So many roles a hostile sender can make this remember; a graph has eight.
_ROLES = 32

# No tick of a run is beyond this, and no time (ns since 1970) fits into 64 bits beyond that.
_LAST_TICK, _LAST_NS = 2**40, 2**63


def _is_tick(value: object) -> TypeGuard[int]:
    return type(value) is int and 0 <= value <= _LAST_TICK


@dataclass
class Node:
    """A node of this package, as it was last heard.

    Attributes:
        name: fully qualified.
        process: that runs it: its machine and number.
        state: one of :mod:`greenroof_ros.graph.supervision`.
        values: what else it says.
        heard: when (s of the steady clock).
    """

    name: str
    process: str
    state: str
    values: dict[str, Any]
    heard: float

    @property
    def here(self) -> bool:
        """Whether it runs on this machine, so that a path that it says can be opened."""
        return self.process.rpartition(" ")[0] == socket.gethostname()

    @property
    def lockstep(self) -> bool:
        """Whether it acts in lockstep; those of a live graph do not number their ticks."""
        return "run_length" in self.values


class GraphState:
    """The nodes of one namespace.

    Attributes:
        runs: counts the runs: a plant that was started again begins another one.
        samples: levels and command that the plant said last, with the tick's time (ns since 1970);
            None before it said any.
    """

    def __init__(self, namespace: str) -> None:
        """Begin without any.

        Args:
            namespace: such as ``/site1``; empty for none.
        """
        self.runs = 0
        self.samples: tuple[int, dict[str, float]] | None = None
        self._namespace = namespace
        self._nodes: dict[str, Node] = {}
        self._replaced: set[str] = set()
        self._rivals: dict[str, tuple[Node, float]] = {}  # with when each was first heard
        self._ticks: deque[tuple[float, int]] = deque()
        self._start_ns = 0

    def own(self, status: Status) -> bool:
        """Whether a status has the name of a node of this namespace, or of a part of one."""
        name = status.name.partition(": ")[0]
        return is_node_name(name) and name.rpartition("/")[0] == self._namespace

    def hear(
        self, stamp_ns: int, arrived_s: float, statuses: Sequence[Status], now: float, tau: float
    ) -> None:
        """Take what nodes say.

        Args:
            stamp_ns: the time that the message says, in a simulation the tick's (ns since 1970).
            arrived_s: when it came (s).
            statuses: all of a message.
            now: of the steady clock (s).
            tau: duration of a tick (s).
        """
        for status in statuses:
            if status.message not in STATES or ": " in status.name or not self.own(status):
                continue
            values = {}
            for key, text in status.values.items():
                try:
                    values[key] = read_value(text)
                except (ValueError, RecursionError):
                    continue
            role, process = values.get("role"), values.get("process")
            if not isinstance(role, str) or not isinstance(process, str) or (
                role not in self._nodes and len(self._nodes) >= _ROLES
            ):
                continue
            node = Node(status.name, process, status.message, values, now)
            if self._takes_part(role, node):
                self._nodes[role] = node
                if role in self._rivals and self._rivals[role][0].process == process:
                    del self._rivals[role]
                if role == _PLANT:
                    self._hear_plant(node, stamp_ns, arrived_s, tau)
            elif node.state not in (FINISHED, ENDED):
                self._hear_rival(role, node)

    def _hear_rival(self, role: str, node: Node) -> None:
        """Note a node that reports under a role that another one has."""
        before = self._rivals.get(role)
        since = node.heard
        if before is not None and before[0].process == node.process and (
            node.heard - before[0].heard < SILENT_S
        ):
            since = before[1]
        self._rivals[role] = node, since

    def _takes_part(self, role: str, node: Node) -> bool:
        """Whether a node counts; another process does when the one before is silent or over."""
        before = self._nodes.get(role)
        if before is None or before.process == node.process:
            return True
        if node.process in self._replaced or (
            before.state not in (FINISHED, ENDED) and node.heard - before.heard < SILENT_S
        ):
            return False
        self._replaced.add(before.process)
        if role == _PLANT:
            self.runs += 1
            self._start_ns = 0
            self.samples = None
            self._ticks.clear()
            # What the others said was of the run before.
            self._nodes = {
                role: one for role, one in self._nodes.items()
                if node.heard - one.heard < SILENT_S and one.state not in (FINISHED, ENDED)
            }
        return True

    def _hear_plant(self, node: Node, stamp_ns: int, arrived_s: float, tau: float) -> None:
        tick = node.values.get("tick")
        if not _is_tick(tick) or tick == 0:
            return  # until the first tick the stamp is not yet the run's
        self._ticks.append((arrived_s, tick))
        while arrived_s - self._ticks[0][0] > _SPEED_MOST_S:
            self._ticks.popleft()
        # The tick that waits for its time is not yet on the clock, so that the later start is it.
        self._start_ns = max(self._start_ns, stamp_ns - round(tick * tau * 1e9))
        found = {}
        for topic, key in (
            ("/cistern/level", "cistern_level"), ("/roof/level", "roof_level"),
            ("/pump/command", "command"),
        ):
            value = node.values.get(key)
            if isinstance(value, (int, float)):
                found[topic] = float(value)
        time_ns = self._start_ns + round(tick * tau * 1e9)
        self.samples = (time_ns, found) if time_ns < _LAST_NS else None

    def factor(self, tau: float) -> float | None:
        """Return the simulated time per wall time of the last seconds; None where unknown."""
        if len(self._ticks) < 2:
            return None
        (began, first), (ended, last) = self._ticks[0], self._ticks[-1]
        if ended - began < _SPEED_S:
            return None
        return (last - first) * tau / (ended - began)

    def mode(self, now: float) -> str:
        """Return what graph it is: ``none``, ``simulated``, ``loop``, ``live`` or ``ended``."""
        plant = self._nodes.get(_PLANT)
        pump = self.pump(now) is not None
        if plant is not None and self._present(plant, now):
            return "loop" if pump else "simulated"
        if any(self._present(one, now) and not one.lockstep for one in self._nodes.values()):
            return "live"
        if plant is not None and pump:
            return "loop"  # a pump may turn when its plant is gone
        if any(self._present(one, now) for one in self._nodes.values()) and plant is None:
            return "none"  # they wait for their plant
        # Who fell silent without a word may run on unheard, and so may a pump.
        silent = [one for one in self._nodes.values() if one.state not in (FINISHED, ENDED)]
        if any(not one.lockstep for one in silent):
            return "live" if plant is None else "loop"
        return "ended" if self._nodes else "none"

    def _present(self, node: Node, now: float) -> bool:
        return node.state not in (FINISHED, ENDED) and now - node.heard < _GONE_S

    def pump(self, now: float) -> str | None:
        """Return the fully qualified name of the pump node; None where there is none."""
        node = self._nodes.get(PUMP)
        return node.name if node is not None and self._present(node, now) else None

    def two_pumps(self, now: float) -> str:
        """Return which two present nodes say that they are the pump's; empty where no two do.

        One that is started again in place of one that is gone makes no two: the one before is not
        heard any more.
        """
        node, (rival, since) = self._nodes.get(PUMP), self._rivals.get(PUMP, (None, 0.0))
        if node is None or rival is None or node.heard <= since or not all(
            self._present(one, now) and now - one.heard < SILENT_S for one in (node, rival)
        ):
            return ""
        return " and ".join(f"{one.name} ({one.process})" for one in (node, rival))

    def begins_with_run(self, topic: Topic) -> bool:
        """Whether a topic's publisher is a node of this package: its first message is tick 0's."""
        return any(role in self._nodes for role in topic.publishers)

    @property
    def records(self) -> bool:
        """Whether there is a recorder, be it on another machine."""
        return RECORDER in self._nodes

    def bag(self) -> Path | None:
        """Return the bag that the recorder writes, if it is on this machine."""
        return self._path(RECORDER, "bag")

    def site(self) -> Path | None:
        """Return the site file of the graph, if it is on this machine."""
        return self._path(_PLANT, "site") or self._path("controller", "site")

    def _path(self, role: str, key: str) -> Path | None:
        node = self._nodes.get(role)
        text = None if node is None or not node.here else node.values.get(key)
        if not isinstance(text, str) or not text.startswith("/") or "\0" in text:
            return None
        path = Path(text)
        try:
            return path if path.exists() else None
        except OSError:
            return None
