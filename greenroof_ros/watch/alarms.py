"""Alarms and events of a graph: what is wrong, since when, what to do, and what follows from what.

An alarm is a status that is not OK, a node that failed, or a node that is silent. It is
identified by the name of its status and its code, and a drive's or latched fault also by that
fault: other words under the same code are the same alarm, since numbers in them change. Its meaning
and the advice come from the table of conditions, by its code; sentences are not parsed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from greenroof_ros.common.conditions import read_conditions, read_interlocks
from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.states import PUMP
from greenroof_ros.watch.registry import ERROR, STALE, WARN, Registry, Trouble
from greenroof_ros.watch.wire import WireStatus
from greenroof_ros.watch.words import plain

# An alarm that comes back within this time (s) is the same one to an operator.
_AGAIN_S = 10.0
_ROWS, _OVER, _EVENTS = 100, 20, 50
_LEVELS = {WARN: "warn", ERROR: "error", STALE: "stale"}
_SEVERITY = {ERROR: 0, STALE: 1, WARN: 2}

# Advice for unknown codes, and for other devices, about which nothing is known here.
OTHER = "There is no advice for this; read the log of the node that reports it."
FOREIGN = "Reported by another device or program, not by the green roof: see its instructions."

# A ROS command means nothing to a person at the pump.
_RESET = "greenroof reset, in a terminal of its machine"
_PUMP_INPUTS = {interlock.input for interlock in read_interlocks().values()} - {""}
# For other parts: the parts of the same node that give more detail.
_DETAILED_BY = {
    "delivery": ("levels",), "frost": ("forecast",),
    "refused": ("command", "levels", "frost", "inputs"),
}
# The roles from which each part of a node gets data; the part reports if no good data come.
_SENSORS = ("cistern_sensor", "roof_sensor", "plant")
_SOURCES = {
    "levels": _SENSORS, "command": ("controller",), "frost": ("weather",),
    "forecast": ("weather",), "rain gauge": ("rain_gauge",), "thermometer": ("thermometer",),
    "inputs": (*_SENSORS, "weather", "controller"), "refused": (),
}


def advise(code: str, role: str, node: str) -> tuple[str, bool]:
    """Return what to do about an alarm, and whether its code is known.

    Args:
        code: of the condition.
        role: role of the node in the interface; empty for another device.
        node: its fully qualified name, for the services that the advice names.
    """
    if not role:
        return FOREIGN, False
    known = read_conditions().get(code)
    return (OTHER, False) if known is None else (known.advise(node, role, reset=_RESET), True)


@dataclass
class Alarm:
    """A trouble with its history.

    Attributes:
        trouble: what is wrong, as last reported.
        since: when it began (the graph's time, s since 1970).
        at_least: whether it may have begun earlier.
        ended_at: when it ended; None if it has not.
        wall: when it began (steady clock, s).
        ended_wall: when it ended (steady clock, s).
        acknowledged: the trouble as someone acknowledged it; None if no one has.
    """

    trouble: Trouble
    since: float
    at_least: bool = False
    ended_at: float | None = None
    wall: float = 0.0
    ended_wall: float = 0.0
    acknowledged: Trouble | None = None

    @property
    def is_serious(self) -> bool:
        """Whether it is treated as an alarm, not a warning; other devices cause only warnings."""
        return bool(self.trouble.role) and self.trouble.level in (ERROR, STALE)

    @property
    def is_acknowledged(self) -> bool:
        """Whether it is acknowledged: as bad as it is now, and about the same nodes or topics."""
        before, now = self.acknowledged, self.trouble
        return before is not None and (before.level, before.names) == (now.level, now.names)

    def row(self, name: str, follows: str | None = None) -> dict[str, Any]:
        """Return it as a row of the document, without its times in words.

        ``plain`` is whether ``do`` is written for this code: an operator then reads ``do``
        instead of the node's own words in ``what``.

        Args:
            name: of its status.
            follows: the name of the alarm that causes it; None if there is none.
        """
        trouble = self.trouble
        do, known = advise(trouble.code, trouble.role, name.partition(": ")[0])
        return {
            "id": name, "level": _LEVELS[trouble.level], "what": trouble.what,
            "code": trouble.code, "do": do, "plain": known, "since": self.since,
            "since_at_least": self.at_least, "acknowledged": self.is_acknowledged,
            "over": self.ended_at, "follows": follows,
        }


class Alarms:
    """The alarms and events of one graph; see the module.

    Times called ``wall`` are of the steady clock (s); ``now`` is the graph's time (s since 1970).

    Attributes:
        registry: what each node reports.
        starting: whether the site starts.
        missing: what it then still waits for, each by the name of its status.
    """

    def __init__(self, namespace: str = "") -> None:
        """Start without alarms.

        Args:
            namespace: of the graph; nodes in other namespaces are treated as other devices.
        """
        self.registry = Registry(namespace, self._on_event)
        self._now = 0.0
        self.reset()

    def reset(self) -> None:
        """Reset all alarms and events, but not the nodes."""
        self._alarms: dict[str, Alarm] = {}
        self.starting, self.missing = False, dict[str, Trouble]()
        self._events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)

    def receive(self, wall: float, now: float, statuses: Sequence[WireStatus], **more: Any) -> None:
        """Receive the statuses of one or more messages; ``more`` goes to the registry."""
        self._now = now
        self.registry.receive(wall, statuses, **more)
        self.update(wall, now)

    def update(self, wall: float, now: float) -> None:
        """Update the alarms: called with each message, and about twice a second."""
        troubles = self.registry.troubles(wall)
        self.starting = self.registry.starting(wall)
        # While a site starts, what has not come yet is no alarm and no event: it is only listed.
        self.missing = {
            name: trouble for name, trouble in troubles.items()
            if self.starting and trouble.is_missing and name not in self._present()
        }
        troubles = {name: what for name, what in troubles.items() if name not in self.missing}
        for name, trouble in troubles.items():
            alarm = self._alarms.get(name)
            if alarm is None or (alarm.ended_at is not None and wall - alarm.ended_wall > _AGAIN_S):
                self._alarms[name] = Alarm(trouble, now, trouble.at_least, wall=wall)
                continue
            before = alarm.trouble
            if (before.code, before.gist) != (trouble.code, trouble.gist):
                self._on_event(f"{name}: {trouble.what}; before: {before.what}")
                self._alarms[name] = Alarm(trouble, now, trouble.at_least, wall=wall)
            else:
                alarm.trouble, alarm.ended_at = trouble, None
        for name, alarm in self._alarms.items():
            if name not in troubles and alarm.ended_at is None:
                alarm.ended_at, alarm.ended_wall = now, wall
        for name in self._past()[_OVER:]:
            del self._alarms[name]

    # --- reports --------------------------------------------------------------------------------

    def rows(self) -> list[dict[str, Any]]:
        """Return the alarms: causes, what follows from them, other devices, and last what is over.

        Within each group the order is: the pump's state, alarms that are not acknowledged, the
        worst, the newest. Older and acknowledged alarms are already known.
        """
        present, causes = self._present(), self._causes()

        def order(name: str) -> tuple[bool, bool, int, bool, int, float]:
            alarm = present[name]
            trouble = alarm.trouble
            # First the pump node (without it no one knows whether the pump runs), then its state.
            rank = {(PUMP, ""): 0, (PUMP, PUMP): 1}.get((trouble.role, trouble.part), 2)
            return (
                not trouble.role, name in causes, rank, alarm.is_acknowledged,
                _SEVERITY[trouble.level], -alarm.wall,
            )

        names = [*sorted(present, key=order), *self._past()]
        return [self._alarms[name].row(name, causes.get(name)) for name in names[:_ROWS]]

    def _present(self) -> dict[str, Alarm]:
        """Return the present alarms, by name."""
        return {name: alarm for name, alarm in self._alarms.items() if alarm.ended_at is None}

    def _past(self) -> list[str]:
        """Return the names of the alarms that are over, the newest first."""
        ended = [name for name, alarm in self._alarms.items() if alarm.ended_at is not None]
        return sorted(ended, key=lambda name: -self._alarms[name].ended_wall)

    def _causes(self) -> dict[str, str]:
        """Return the cause of each present alarm that follows from another one, by name."""
        own = [item for item in self._present().items() if item[1].trouble.role]
        own.sort(key=lambda item: item[1].wall)
        return find_causes({name: alarm.trouble for name, alarm in own})

    def events(self) -> list[dict[str, Any]]:
        """Return the events, the newest first."""
        return [{"at": at, "what": what} for at, what in reversed(self._events)]

    def _on_event(self, text: str) -> None:
        self.add_event(self._now, text)

    def add_event(self, now: float, text: str) -> None:
        """Add an event."""
        self._events.append((now, plain(text)))

    def acknowledge(self, alarm_id: str) -> bool:
        """Acknowledge an alarm, until it changes; False if there is no such alarm."""
        alarm = self._alarms.get(alarm_id)
        if alarm is not None:
            alarm.acknowledged = alarm.trouble
        return alarm is not None

    def counts(self) -> tuple[int, int, int]:
        """Return how many causes are alarms, how many are warnings, and how many alarms follow.

        A cause counts by the worst of itself and what follows from it.
        """
        causes, present = self._causes(), self._present()
        serious = {causes.get(name, name) for name in present if present[name].is_serious}
        return len(serious), len(present) - len(causes) - len(serious), len(causes)

    def advice(self) -> Any:
        """Return what to do now: about the cause of the first alarm that is not acknowledged.

        If it is only a hold, that is intended: what to do about a second trouble is added.
        """
        present = {row["id"]: row for row in self.rows() if row["over"] is None}
        rows = sorted(present.values(), key=lambda row: row["acknowledged"])
        if not rows:
            return "Nothing to do."
        first = present.get(rows[0]["follows"], rows[0])
        second = next((
            row["do"] for row in rows
            if row is not first and row["level"] != "warn" and not row["follows"]
        ), "")
        more = f" Besides: {second}" if first["code"] == "hold" and second else ""
        return f"{first['do']}{more}"


# --- causes ---------------------------------------------------------------------------------------


def find_causes(troubles: Mapping[str, Trouble]) -> dict[str, str]:
    """Return the name of the root cause of each alarm that follows from another one.

    The pump's state follows from the part that reports more about its reason. Missing input of a
    node follows from trouble with the publisher. An error does not follow from a warning, and a
    state of the pump that needs a person at it follows from nothing: advice on its cause would hide
    that.

    Args:
        troubles: of the graph's own nodes, the older ones first.
    """
    causes: dict[str, str] = {}
    for name, trouble in troubles.items():
        for other in _candidates(name, trouble, troubles):
            first = causes.get(other, other)
            group = [name, *(follower for follower, cause in causes.items() if cause == name)]
            worse = troubles[first].level == WARN and any(
                troubles[follower].level == ERROR for follower in group
            )
            if first != name and not worse:
                causes.update(dict.fromkeys(group, first))
                break
    return causes


def _candidates(
    name: str, trouble: Trouble, troubles: Mapping[str, Trouble]
) -> Iterator[str]:
    """Yield the alarms that may cause this one, the likeliest first."""
    node, part, code = name.partition(": ")[0], trouble.part, trouble.code
    state, condition = (trouble.role, part) == (PUMP, PUMP), read_conditions().get(code)
    if condition is not None and condition.needs_operator and part == PUMP:
        return
    if part and node in troubles:  # the node as a whole, such as a silent node
        yield node
    if not part:
        yield from _other_nodes(node, trouble, troubles)
    if condition is not None and condition.no_data and (part in _SOURCES or trouble.names):
        yield from _publishers(trouble, troubles)
    interlock = read_interlocks().get(code)
    more = (interlock.parts if interlock else ()) if state else _DETAILED_BY.get(part, ())
    yield from (name for name in (f"{node}: {part}" for part in more) if name in troubles)
    if part == "inputs":
        # A part of the pump node that stops the pump because of that input reports more.
        yield from (
            name for name, other in troubles.items()
            if other.role == PUMP and other.part in _PUMP_INPUTS
            and (other.code == code or trouble.role == PUMP)
        )


def _other_nodes(node: str, trouble: Trouble, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Yield nodes wrong as a whole that are waited for."""
    for name, other in troubles.items():
        waited_for = {name.rpartition("/")[2], other.role} & set(trouble.names)
        if name != node and ": " not in name and waited_for:
            yield name


def _publishers(trouble: Trouble, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Yield the alarms of the nodes that publish the input that is missing."""
    interface, roles = read_topics(), {*_SOURCES.get(trouble.part, ())}
    for name in interface.keys() & set(trouble.names):
        roles.update(interface[name].publishers, interface[name].live_publishers)
    roles.discard(trouble.role)
    for whole in (True, False):  # first nodes as a whole, then their parts
        for name, other in troubles.items():
            if (
                other.role in roles and (not other.part) == whole
                and other.part not in ("inputs", "refused")
            ):
                yield name
