"""Registry of the nodes of a graph and their latest reports on /diagnostics.

No other module reads the reports: alarms, tiles and subscriptions are all based on the registry. A
node is identified by its name; another process with the same name counts as a restart of the node.
"""

from __future__ import annotations

import json
import math
import re
import socket
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

from greenroof_ros.base.text import clean_text
from greenroof_ros.interface.alarm import ERROR, OK, STALE
from greenroof_ros.interface.states import ENDED, FINISHED, PLANT, PUMP, STATES
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.reports import SILENT_S, StatusDiagnosis, make_diagnosis
from greenroof_ros.watch.node_reports import NodeReport, PartReport, is_starting
from greenroof_ros.watch.wire import WireStatus
from greenroof_ros.watch.words import clean_sentence, list_names, name_source

# Other devices may be slower than this package's nodes: they are lost after this silence (s).
_FOREIGN_SILENT_S = 5.0
# A silent node may be replaced by another process; after this time (s), it is gone.
_GONE_S = 10.0
# Shortest and longest time over which the speed of a simulation is measured (s).
_SPEED_S, _SPEED_MAX_S = 1.0, 3.0
# Limits to what a hostile sender can fill, in addition to those of :mod:`.wire`: nodes of a role,
# so that it does not take another role's room, parts of each node, statuses of other devices, and
# characters of a name. A graph has at most two nodes of a role.
_NODES, _PARTS, _FOREIGN, _NAME = 8, 24, 200, 160
_NEWEST = 50  # how many changes of parameters, and warnings, are reported at a time
# Maximum tick of a run, and the latest time of a run (ns since 1970), which is in the year 2116.
_LAST_TICK, _LAST_NS = 2**40, 2**62
# A name that ROS allows for a node, since the name becomes part of commands that users are advised
# to run.
_NODE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


class Node(NodeReport):
    """A process of this package, with the information that the page takes from its values.

    Attributes:
        number: number of the last message from the process, as counted by its publisher.
        copied_at: time of the last report that another publisher sent as this process (steady
            clock, s).
    """

    number = 0
    copied_at = -math.inf

    def count_message(self, wall: float, number: int) -> None:
        """Detect a second publisher: the message numbers of a single publisher only increase."""
        if number <= self.number:
            self.copied_at = wall
        self.number = number

    @property
    def lockstep(self) -> bool:
        """Whether the node runs in lockstep; nodes in a live graph do not number their ticks."""
        return "run_length" in self.values

    @property
    def runs_on(self) -> bool:
        """Whether a pump node reports that the pump turns or delivers water although it is off."""
        return any(part.diagnosis.code == "runs_on" for part in self.parts.values())

    @property
    def may_turn(self) -> bool:
        """Whether a pump that should be off may be turning, according to its node."""
        unknown = "speed" in self.values and self.values["speed"] is None
        return self.runs_on or (unknown and self.values.get("stands") is not True)

    def is_present(self, wall: float) -> bool:
        """Return whether the node has reported within the last 10 s and has not ended."""
        return not self.has_ended and wall - self.received_at < _GONE_S

    def code_of(self, part: str) -> str:
        """Return the code that a part reports; empty if it reports no code."""
        return self.parts[part].diagnosis.code if part in self.parts else ""

    def text(self, key: str) -> str:
        """Return the text of a key that the node reports; empty if it reports none."""
        value = self.values.get(key)
        return clean_sentence(value) if isinstance(value, str) else ""


class Registry:
    """Registry of the nodes in one namespace, filled from their reports on /diagnostics.

    Attributes:
        runs: number of new runs that began with a restart of the plant node.
        time_ns: time of the plant's latest tick (ns since 1970); 0 before the first tick.
        offered: names of the nodes that offer a hold service for the pump, regardless of any
            reports.
    """

    def __init__(self, namespace: str = "", on_event: Callable[[str], None] | None = None) -> None:
        """Start without nodes.

        Args:
            namespace: namespace such as ``/site1``; nodes in other namespaces are treated as other
                devices.
            on_event: callback that receives each event as a sentence.
        """
        self.runs = 0
        self.time_ns = 0
        self.offered: Collection[str] = ()
        self._namespace = "/" + namespace.strip("/")
        self._on_event = on_event or (lambda _: None)
        self._nodes: dict[tuple[str, str], Node] = {}  # by name and process
        self._latest: dict[str, Node] = {}  # by name: the process heard last
        self._by_role: dict[str, Node] = {}  # by role: the node that has it
        self._foreign: dict[str, PartReport] = {}
        self._ticks: deque[tuple[float, int]] = deque()

    # --- receiving ------------------------------------------------------------------------------

    def is_own(self, status: WireStatus) -> bool:
        """Return whether a status belongs to a node in this namespace or to one of its parts."""
        name = status.name.partition(": ")[0]
        return (
            len(name) <= _NAME and _NODE_NAME.fullmatch(name) is not None
            and (name.rpartition("/")[0] or "/") == self._namespace
        )

    def receive(
        self, wall: float, statuses: Sequence[WireStatus], *, now: float = 0.0, stamp_ns: int = 0,
        number: int | None = None,
    ) -> None:
        """Receive the statuses from one or more messages; invalid content raises no exception.

        Args:
            wall: current time (steady clock, s).
            statuses: the statuses.
            now: graph time with which alarms are time-stamped (s since 1970).
            stamp_ns: time stamp of the message (ns since 1970); in a simulation, the time of the
                tick.
            number: number of the message, as counted by its publisher; None if unknown.
        """
        if len(self._foreign) >= _FOREIGN:
            self._foreign = {
                name: part for name, part in self._foreign.items()
                if wall - part.received_at <= _FOREIGN_SILENT_S
            }
        # A node comes before its parts.
        for status in sorted(statuses, key=lambda status: ": " in status.name):
            name = clean_text(status.name, _NAME)
            values = self._values_of(name, status)
            if values is None:
                self._receive_other(wall, name, status)
            elif (
                node := self._receive_node(wall, now, name, status.message, values)
            ) is not None:
                if number is not None:
                    node.count_message(wall, number)
                if self._by_role.get(PLANT) is node:
                    self._receive_plant(wall, node, stamp_ns)

    def _receive_other(self, wall: float, name: str, status: WireStatus) -> None:
        """Receive the status of a part of a node, or of another device."""
        node_name, _, part = name.partition(": ")
        if "process" in status.values and status.message in (FINISHED, ENDED):
            self._forget(name)  # a node of another graph, which may now be silent
            return
        node = self._latest.get(node_name) if part else None
        report = (
            wall, status.level, clean_sentence(status.message) or "reports nothing",
            {key: clean_text(text) for key, text in status.values.items()},
        )
        if node is None and (name in self._foreign or len(self._foreign) < _FOREIGN):
            self._foreign[name] = PartReport.receive(self._foreign.get(name), *report)
        elif node is not None and (part in node.parts or len(node.parts) < _PARTS):
            node.receive_part(part, *report)

    def _values_of(self, name: str, status: WireStatus) -> dict[str, Any] | None:
        """Return the values in a status of a node of this graph; None for any other status."""
        if ": " in name or status.message not in STATES or not self.is_own(status):
            return None
        try:
            values = {key: _read_value(text) for key, text in status.values.items()}
        except (ValueError, RecursionError):
            return None
        role, process = values.get("role"), values.get("process")
        named = isinstance(role, str) and role in _list_roles() and isinstance(process, str)
        return values if named else None

    def _receive_node(
        self, wall: float, now: float, name: str, state: str, values: dict[str, Any]
    ) -> Node | None:
        role, process = (clean_text(values[key], _NAME) for key in ("role", "process"))
        node = self._nodes.get((name, process))
        if node is None:
            if not self._make_room(wall, role):
                return None
            node = Node(name, role, process, state, values, wall)
            node.replace_process(self._latest.get(name))
            if name in self._latest:
                self._on_event(f"{name_source(name)} was restarted")
            self._nodes[name, process] = node
            self._forget(name)
        elif node.role != role:
            return None
        # When a run is over, its nodes finish and then end, which is one event.
        elif state == ENDED and not node.has_ended:
            self._on_event(f"{name_source(name)} ended")
        before = node.values
        node.receive(wall, now, state, values)
        self._report_changes(node, before)
        self._latest[name] = node
        self._assign_role(wall, node)
        return node

    def _forget(self, name: str) -> None:
        """Remove another device, and its parts."""
        for other in [other for other in self._foreign if other.partition(": ")[0] == name]:
            del self._foreign[other]

    def _make_room(self, wall: float, role: str) -> bool:
        """Return whether a role can accept a node, after dropping a silent node if necessary."""
        same = [node for node in self._nodes.values() if node.role == role]
        if len(same) < _NODES:
            return True
        silent = min(same, key=lambda node: node.received_at)
        if wall - silent.received_at <= SILENT_S:
            return False
        self._remove(silent)
        return True

    def _remove(self, node: Node) -> None:
        del self._nodes[node.name, node.process]
        for table, key in ((self._latest, node.name), (self._by_role, node.role)):
            if table.get(key) is node:
                del table[key]

    def _assign_role(self, wall: float, node: Node) -> None:
        """Assign a node its role, unless another online node or a newer process already has it."""
        before = self._by_role.get(node.role)
        if before is not None:
            again = before.name == node.name
            if before is node or (before.began > node.began if again else before.is_online(wall)):
                return
        self._by_role[node.role] = node
        if node.role == PLANT:
            self.runs += before is not None
            self.time_ns = 0
            self._ticks.clear()
            # Reports of silent nodes are about the previous run or site.
            for other in list(self._nodes.values()):
                if not other.is_online(wall):
                    self._remove(other)

    def _report_changes(self, node: Node, before: Mapping[str, Any]) -> None:
        """Report the changes in a node's values as events."""
        values, name = node.values, name_source(node.name)
        changes, left_out = _find_changes(before, values)
        if left_out:
            self._on_event(
                f"{name}: {left_out} earlier changes of parameters are not listed"
            )
        for change in changes:
            if isinstance(change, dict):
                what, old, new = (change.get(key) for key in ("parameter", "before", "value"))
                self._on_event(f"{name}: {what} was changed from {old} to {new}")
        known, warnings = before.get("warnings"), values.get("warnings")
        if isinstance(known, list) and isinstance(warnings, list):
            for warning in warnings[:_NEWEST]:
                if warning not in known:
                    self._on_event(f"{name} warns: {clean_sentence(str(warning))}")
        holder, fault = _find_holder(values), node.text("fault")
        if _find_holder(before) != holder:
            self._on_event(f"The pump is held off by {holder}" if holder else "The hold has ended")
        if before.get("fault", "") != values.get("fault", ""):
            self._on_event(
                "The pump is off until the fault is reset: "
                f"{fault}" if fault else "The fault was reset"
            )

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
        for parts in (self._foreign, *(node.parts for node in self._nodes.values())):
            for part in parts.values():
                part.received_at += seconds

    # --- kind of graph --------------------------------------------------------------------------

    def node(self, role: str) -> Node | None:
        """Return the node with a given role; None if no node with this role has reported."""
        return self._by_role.get(role)

    def starting(self, wall: float) -> bool:
        """Return whether the site is starting."""
        return is_starting([*self._latest.values()], wall)

    def factor(self, tau: float) -> float | None:
        """Return the ratio of simulated to wall time over the last few seconds; None if unknown."""
        if len(self._ticks) < 2:
            return None
        (began, first), (ended, last) = self._ticks[0], self._ticks[-1]
        return None if ended - began < _SPEED_S else (last - first) * tau / (ended - began)

    def mode(self, wall: float) -> str:
        """Return the kind of graph: ``none``, ``simulated``, ``live`` or ``ended``."""
        plant = self._by_role.get(PLANT)
        nodes = self._by_role.values()
        here = [node for node in nodes if node.is_present(wall)]
        if plant is not None and plant.is_present(wall):
            return "simulated"
        if any(not node.lockstep for node in here):
            return "live"
        if here and plant is None:
            return "none"  # they are waiting for their plant
        # A live site is not over: if its program ends or falls silent, nobody waters the roof.
        if any(not node.lockstep for node in nodes):
            return "live"
        return "ended" if nodes else "none"

    def gone_since(self, wall: float) -> float | None:
        """Return when the last node of a live site reported (s since 1970); None while one does."""
        nodes = self._by_role.values()
        if not nodes or any(node.lockstep or node.is_online(wall) for node in nodes):
            return None
        return max(node.heard for node in nodes)

    def pump(self, wall: float) -> Node | None:
        """Return the pump node if it is present; otherwise None."""
        node = self._by_role.get(PUMP)
        return node if node is not None and node.is_present(wall) else None

    def pumps(self, wall: float) -> list[str]:
        """Return the names of all nodes that may be the pump node and are present."""
        return sorted({*self.offered} | {
            node.name for node in self._latest.values()
            if node.role == PUMP and node.is_present(wall)
        })

    def _claimants(self, wall: float) -> list[str]:
        """Return the names of the nodes that claim to be the pump node, by service or report."""
        return sorted({*self.offered} | {
            node.name for node in self._latest.values()
            if node.role == PUMP and node.is_online(wall)
        })

    def two_pumps(self, wall: float) -> str:
        """Return a warning if it is unclear which process is the pump node; otherwise empty."""
        names, pump = self._claimants(wall), self._by_role.get(PUMP)
        if len(names) < 2 and (pump is None or self._find_twins(pump.name, wall) is None):
            return ""
        return (
            f"Two nodes claim to be the pump node ({list_names(names)}), so it is unknown which "
            "of them controls the pump. A stop is sent to all of them; no other request is sent "
            "from here. Shut down the node that should not be running."
        )

    def _find_twins(self, name: str, wall: float) -> tuple[Node, Node] | None:
        """Return two processes that alternate under one name, older first; None if none do.

        If another publisher copies a process's reports, that process is returned twice. A process
        that replaced an earlier one is not a twin, because the earlier process did not report after
        the later one had started.
        """
        online = [
            node for node in self._nodes.values() if node.name == name and node.is_online(wall)
        ]
        for older, newer in combinations(sorted(online, key=lambda node: node.began), 2):
            if older.received_at > newer.began:
                return older, newer
        return next(((node, node) for node in online if wall - node.copied_at <= SILENT_S), None)

    def site(self) -> Path | None:
        """Return the site file of the graph; None if it is not on this machine."""
        return self._path(PLANT, "site") or self._path("controller", "site")

    def _path(self, role: str, key: str) -> Path | None:
        node = self._by_role.get(role)
        if node is None or node.process.rpartition(" ")[0] != socket.gethostname():
            return None
        text = node.values.get(key)
        if not isinstance(text, str) or not text.startswith("/") or "\0" in text:
            return None
        path = Path(text)
        try:
            return path if path.exists() else None
        except OSError:
            return None

    # --- what is wrong ----------------------------------------------------------------------------

    def diagnoses(self, wall: float) -> dict[str, StatusDiagnosis]:
        """Return the diagnoses of all current faults, keyed by the name of the status."""
        diagnoses: dict[str, StatusDiagnosis] = {}
        for name, part in self._foreign.items():
            silent = wall - part.received_at > _FOREIGN_SILENT_S
            # A device that has reported only once may not be meant to report regularly.
            if silent and part.again:
                silence = make_diagnosis(STALE, "", "not_heard", "silent", time=_FOREIGN_SILENT_S)
                diagnoses[name] = replace(silence, code="")
            elif part.diagnosis.level != OK and not silent:
                diagnoses[name] = part.diagnosis
        for node in self._latest.values():
            other = self._by_role.get(node.role, node)
            if other is not node and other.is_online(wall) and (
                wall - node.received_at > _GONE_S
            ):
                continue  # another node has its role, or there was never such a node
            diagnoses.update(node.diagnoses(wall))
            if (twins := self._find_twins(node.name, wall)) is not None:
                older, newer = twins
                diagnoses[node.name] = make_diagnosis(
                    ERROR, node.role, "two_processes", older=older.process, newer=newer.process
                )
        if len(names := self._claimants(wall)) > 1:
            pump = self._by_role.get(PUMP)
            diagnoses[f"{pump.name if pump else names[0]}: pump nodes"] = make_diagnosis(
                ERROR, PUMP, "two_pump_nodes", nodes=list_names(names)
            )
        return diagnoses


def _find_holder(values: Mapping[str, Any]) -> str:
    """Return who holds the pump, from a node's values; empty if no one does."""
    hold = values.get("hold")
    owner = hold.get("owner") if isinstance(hold, dict) else None
    return clean_text(owner) if isinstance(owner, str) else ""


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


def _find_changes(before: Mapping[str, Any], values: Mapping[str, Any]) -> tuple[list[Any], int]:
    """Return a node's new parameter changes, and the number of changes that it does not list.

    The node keeps only the latest changes, but counts all of them.
    """
    listed = values.get("parameter_changes")
    first, last = (known.get("parameter_change_count") for known in (before, values))
    if not (isinstance(listed, list) and isinstance(first, int) and isinstance(last, int)):
        return [], 0
    new = listed[-min(last - first, _NEWEST):] if last > first else []
    return new, max(0, last - first) - len(new)


@cache
def _list_roles() -> frozenset[str]:
    """Return the roles of all nodes in the interface."""
    return frozenset(
        role for topic in read_topics().values() for roles in (
            topic.publishers, topic.subscribers, topic.live_publishers, topic.live_subscribers
        ) for role in roles
    )
