"""Alarms and events of a graph, from what its nodes report on /diagnostics.

An alarm is a status that is not OK, a node that failed, or one that is not heard. It is known by
the name of its status, so that a number that changes in its sentence makes no new one.
"""

from __future__ import annotations

import json
import math
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

from greenroof_ros.graph.supervision import ENDED, FINISHED, PUMP, STARTING, STATES
from greenroof_ros.watch.advice import FOREIGN, OTHER, advise
from greenroof_ros.watch.causes import Trouble, find_causes
from greenroof_ros.watch.words import plain

# A node reports four times a second; one that is not heard for so long (s) is not there, as for
# bringup. Of other devices, which report once a second, the default of diagnostic_aggregator.
SILENT_S, _FOREIGN_SILENT_S = 2.0, 5.0
# A node that waits for another one for so long (s) says so as an alarm: a start takes seconds.
_WAITS_S = 5.0
# An alarm that comes back within this time (s) was not over for an operator.
_AGAIN_S = 10.0
# What a hostile sender can make this remember: nodes, parts of each, statuses of other devices,
# characters of a sentence, a name and a value. A graph has seven nodes.
_NODES, _PARTS, _FOREIGN = 32, 24, 200
_TEXT, _NAME, _VALUE = 500, 160, 100_000
_ROWS, _OVER, _EVENTS = 100, 20, 50
_OK, _WARN, _ERROR, _STALE = range(4)
_LEVELS = {_WARN: "warn", _ERROR: "error", _STALE: "stale"}
_SEVERITY = {_ERROR: 0, _STALE: 1, _WARN: 2}
# What ROS lets a node be called; its name is part of a command that is advised.
_NODE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def is_node_name(name: str) -> bool:
    """Whether ROS lets a node be called so, fully qualified."""
    return len(name) <= _NAME and _NODE_NAME.fullmatch(name) is not None


def may_turn(values: Mapping[str, Any]) -> bool:
    """Whether a pump node says that it knows neither that the pump stands nor what it turns at."""
    return values.get("stands") is not True and "speed" in values and values["speed"] is None


def read_value(text: str) -> Any:
    """Return a value of a status of this package's nodes, which is a JSON text.

    A number that is not finite, or has 20 characters or more without being a fraction, is None: no
    quantity is such, and what is computed with it would fail.

    Raises:
        ValueError: it is no JSON.
        RecursionError: it is nested too deep.
    """
    return json.loads(text, parse_int=_integer, parse_float=_number, parse_constant=_nothing)


@dataclass(frozen=True)
class Status:
    """One status of /diagnostics.

    Attributes:
        name: fully qualified, of a node; of a part of it with the part behind ``": "``.
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        message: a sentence.
        hardware_id: the device that it is about; of a node the machine.
        values: as on the wire; those of this package's nodes are JSON texts.
    """

    name: str
    level: int
    message: str
    hardware_id: str
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass
class _Part:
    """A part of a node, or another device, as it was last heard."""

    level: int
    message: str
    heard: float  # wall time (s)
    first: bool  # whether it was heard now for the first time, and its node too
    times: int = 1


@dataclass
class _Node:
    """A node of the graph, as it was last heard."""

    name: str
    role: str
    process: str
    state: str
    heard: float  # wall time (s)
    since: float  # in this state, wall time (s)
    values: dict[str, Any]
    first: bool = True  # whether it was heard once so far
    parts: dict[str, _Part] = field(default_factory=dict)
    others: dict[str, float] = field(default_factory=dict)  # processes that were heard before
    twins_at: float = -math.inf  # when two processes were last heard in turn (wall, s)
    refused_at: float = -math.inf  # when the count of refused values last grew (wall, s)
    refused: str = ""  # topics

    def is_silent(self, wall: float) -> bool:
        """Whether it should be heard, and is not."""
        return wall - self.heard > SILENT_S and self.state not in (FINISHED, ENDED)


@dataclass
class _Alarm:
    """A trouble with its history."""

    trouble: Trouble
    since: float
    since_at_least: bool
    acknowledged: set[str] = field(default_factory=set)  # the gist of what was seen to
    over: float | None = None
    over_wall: float = 0.0

    @property
    def gist(self) -> str:
        """What is wrong, without the numbers that change."""
        return f"{self.trouble.level} {re.sub(r'[0-9.]+', '', self.trouble.what)}"

    @property
    def is_serious(self) -> bool:
        """Whether it counts as an alarm, and not as a warning: other devices warn at most."""
        return bool(self.trouble.role) and self.trouble.level in (_ERROR, _STALE)

    @property
    def is_acknowledged(self) -> bool:
        """Whether somebody has seen it as it is now, but for its numbers."""
        return self.gist in self.acknowledged


class Alarms:
    """The alarms and events of one graph; see the module.

    Times called ``wall`` are of a clock that is never set (s); ``now`` is the graph's time, epoch
    seconds.
    """

    def __init__(self, namespace: str = "") -> None:
        """Begin without any.

        Args:
            namespace: of the graph; the statuses of other ones are those of other devices.
        """
        self._namespace = "/" + namespace.strip("/")
        self._nodes: dict[str, _Node] = {}
        self._foreign: dict[str, _Part] = {}
        self._alarms: dict[str, _Alarm] = {}
        self._events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)

    # --- hearing --------------------------------------------------------------------------------

    def hear(self, wall: float, now: float, statuses: Sequence[Status]) -> None:
        """Take what came, from one message or several; nothing in it raises."""
        rest: list[tuple[str, Status]] = []
        fresh: set[str] = set()
        for status in statuses:
            name = plain(status.name, _NAME)
            report = self._report(name, status)
            if report is None:
                rest.append((name, status))
            elif self._hear_node(wall, now, name, *report):
                fresh.add(name)
        crowded = False
        for name, status in rest:
            node_name, _, part = name.partition(": ")
            node = self._nodes.get(node_name)
            if node is not None and part:
                self._hear_part(wall, node, part, status, node_name in fresh)
            else:
                crowded = self._hear_foreign(wall, name, status, crowded)
        self.look(wall, now)

    def _report(self, name: str, status: Status) -> tuple[str, dict[str, Any]] | None:
        """Return the state of a node of this graph and its values; None for any other status."""
        if (
            status.message not in STATES or not is_node_name(name)
            or (name.rpartition("/")[0] or "/") != self._namespace
        ):
            return None
        values = {}
        for key, text in list(status.values.items())[:100]:
            if len(text) > _VALUE:
                continue
            try:
                values[key] = read_value(text)
            except (ValueError, RecursionError):
                return None
        named = all(isinstance(values.get(key), str) for key in ("role", "process"))
        return (status.message, values) if named else None

    def _hear_node(
        self, wall: float, now: float, name: str, state: str, values: dict[str, Any]
    ) -> bool:
        """Take the report of a node, and return whether it is the first of it."""
        role, process = (plain(values[key], _NAME) for key in ("role", "process"))
        node = self._nodes.get(name)
        if node is None:
            if len(self._nodes) >= _NODES:
                silent = min(self._nodes.values(), key=lambda one: one.heard)
                if wall - silent.heard <= SILENT_S:
                    return False
                del self._nodes[silent.name]
            self._nodes[name] = _Node(name, role, process, state, wall, wall, values)
            for other in [one for one in self._foreign if one.startswith(f"{name}: ")]:
                del self._foreign[other]
            return True
        before, node.values, node.first = node.values, values, False
        if process != node.process:
            if wall - node.others.get(process, -math.inf) <= SILENT_S:
                node.twins_at = wall
            else:
                self.add_event(now, f"{name} was started again")
                node.parts.clear()
                before = {}
            node.others[node.process] = node.heard
            while len(node.others) > 4:
                del node.others[next(iter(node.others))]
            node.others.pop(process, None)
            node.process = process
        if state != node.state:
            node.since = wall
            if state == FINISHED:
                self.add_event(now, f"{name} has finished: the run is over")
            elif state == ENDED:
                self.add_event(now, f"{name} ended")
        node.role, node.state, node.heard = role, state, wall
        self._compare(wall, now, node, before)
        return False

    def _compare(self, wall: float, now: float, node: _Node, before: dict[str, Any]) -> None:
        """Note as events, and as trouble, what changed in a node's values."""
        values = node.values
        for change in _new(before, values, "parameter_changes", "parameter_change_count"):
            if isinstance(change, dict):
                name, old, new = (change.get(key) for key in ("parameter", "before", "value"))
                self.add_event(now, f"{node.name}: {name} was changed from {old} to {new}")
        for warning in _new(before, values, "warnings", ""):
            self.add_event(now, f"{node.name} warns: {warning}")
        grown = [
            topic for topic, count in _counts(values).items()
            if count > _counts(before).get(topic, 0)
        ]
        if grown and before:
            node.refused_at, node.refused = wall, ", ".join(grown[:10])
        if not before:
            return
        was_stopped, stopped = (bool(_text(one, "stop")) for one in (before, values))
        if stopped != was_stopped:
            self.add_event(
                now, "stop was asked for: the pump is held off" if stopped
                else "the stop was released",
            )
        was, fault = (_text(one, "fault") for one in (before, values))
        if fault != was:
            self.add_event(
                now, f"the pump is off until it is reset: {fault}" if fault
                else "the fault was reset"
            )

    def _hear_part(
        self, wall: float, node: _Node, part: str, status: Status, first: bool
    ) -> None:
        if part not in node.parts and len(node.parts) >= _PARTS:
            return
        node.parts[part] = _Part(_level(status), _message(status), wall, first)

    def _hear_foreign(self, wall: float, name: str, status: Status, crowded: bool) -> bool:
        """Take the status of another device; return whether there is no room for a new one.

        One that is all right gives way to one that is not.
        """
        known, level = self._foreign.get(name), _level(status)
        if known is None and len(self._foreign) >= _FOREIGN:
            if crowded:
                return True
            least = min(
                self._foreign, key=lambda one: (
                    self._foreign[one].level != _OK
                    and wall - self._foreign[one].heard <= _FOREIGN_SILENT_S,
                    self._foreign[one].heard,
                ),
            )
            gone = wall - self._foreign[least].heard > _FOREIGN_SILENT_S
            if not gone and (level == _OK or self._foreign[least].level != _OK):
                return level != _OK
            del self._foreign[least]
        times = 1 if known is None else known.times + 1
        self._foreign[name] = _Part(level, _message(status), wall, times == 1, times)
        return False

    def forgive(self, seconds: float) -> None:
        """Count a time in which nobody could be heard (s) as no silence of anybody."""
        for node in self._nodes.values():
            node.heard += seconds
            for part in node.parts.values():
                part.heard += seconds
        for part in self._foreign.values():
            part.heard += seconds

    # --- looking --------------------------------------------------------------------------------

    def look(self, wall: float, now: float) -> None:
        """Bring the alarms up to date: called with each message, and about twice a second."""
        self._foreign = {
            name: part for name, part in self._foreign.items()
            if wall - part.heard <= _FOREIGN_SILENT_S or not self._has_ended(name, part)
        }
        troubles = dict(self._troubles(wall))
        for name, trouble in troubles.items():
            alarm = self._alarms.get(name)
            if alarm is None or (alarm.over is not None and wall - alarm.over_wall > _AGAIN_S):
                self._alarms[name] = _Alarm(trouble, now, trouble.at_least)
            else:
                alarm.trouble, alarm.over = trouble, None
        for name, alarm in self._alarms.items():
            if name not in troubles and alarm.over is None:
                alarm.over, alarm.over_wall = now, wall
        over = sorted(
            (name for name, alarm in self._alarms.items() if alarm.over is not None),
            key=lambda name: self._alarms[name].over_wall,
        )
        for name in over[:-_OVER]:
            del self._alarms[name]

    def _has_ended(self, name: str, part: _Part) -> bool:
        """Whether it is of another graph's node, or a part of it, whose last word was its end."""
        node = self._foreign.get(name.partition(": ")[0])
        return node is not None and node.message in (FINISHED, ENDED) and part.heard <= node.heard

    def _troubles(self, wall: float) -> Iterator[tuple[str, Trouble]]:
        """Return all that is wrong, each by its name."""
        for name, part in self._foreign.items():
            # One that was heard once perhaps never meant to report again and again.
            if wall - part.heard > _FOREIGN_SILENT_S and part.times > 1:
                yield name, Trouble(_STALE, f"not heard for {_FOREIGN_SILENT_S:g} s")
            elif part.level != _OK and wall - part.heard <= _FOREIGN_SILENT_S:
                yield name, Trouble(part.level, part.message, at_least=part.first)
        for node in self._nodes.values():
            yield from self._troubles_of(node, wall)

    def _troubles_of(self, node: _Node, wall: float) -> Iterator[tuple[str, Trouble]]:
        name, role = node.name, node.role
        failure = _text(node.values, "failure")
        if node.state in (FINISHED, ENDED):
            if failure:
                yield name, Trouble(_ERROR, f"ended: {failure}", role, "", node.first)
            return
        silent = node.is_silent(wall)
        waiting = node.values.get("waiting")
        if silent:
            yield name, Trouble(_STALE, f"not heard for {SILENT_S:g} s", role)
        elif wall - node.twins_at <= SILENT_S:
            two = " and ".join([node.process, *list(node.others)[-1:]])
            yield name, Trouble(_ERROR, f"two processes report under this name: {two}", role)
        elif node.state == STARTING and wall - node.since > _WAITS_S and isinstance(waiting, list):
            who = ", ".join(str(one) for one in waiting[:10])
            yield name, Trouble(_WARN, f"waits for {plain(who, _TEXT)}", role)
        if wall - node.refused_at <= SILENT_S:
            yield f"{name}: refused", Trouble(
                _WARN, f"values of {plain(node.refused, _TEXT)} are refused: not plausible",
                role, "refused",
            )
        for part, one in node.parts.items():
            # What a silent node last said was wrong stays so, as far as anybody knows.
            if not silent and wall - one.heard > SILENT_S:
                yield f"{name}: {part}", Trouble(
                    _STALE, f"not heard for {SILENT_S:g} s", role, part
                )
            elif one.level != _OK:
                level = one.level
                if (role, part) == (PUMP, PUMP) and level == _WARN and may_turn(node.values):
                    level = _ERROR  # it may flood the roof, whatever the pump was told
                yield f"{name}: {part}", Trouble(level, one.message, role, part, one.first)

    # --- telling --------------------------------------------------------------------------------

    def rows(self, say_time: Callable[[float], str] | None = None) -> list[dict[str, Any]]:
        """Return the alarms: causes, then what follows from them, and what is over last.

        What only follows from another alarm, such as a level that is unknown since its sensor is
        silent, names that in ``follows``. Of both kinds the pump's state comes first, then the
        worst. The newest of a severity comes first: what has stood for long is known. So is what
        was acknowledged, which comes later. ``plain`` is whether ``do`` is about that alarm, so
        that an operator reads it instead of the node's own words in ``what``.

        Args:
            say_time: says a time of the graph; without it, in UTC.
        """
        say, causes = say_time or _clock, self._causes()
        names = [*self._present(causes), *self._past()]
        return [self._row(name, say, causes.get(name)) for name in names[:_ROWS]]

    def _row(
        self, name: str, say: Callable[[float], str], cause: str | None
    ) -> dict[str, Any]:
        alarm = self._alarms[name]
        return {
            "id": name, "level": _LEVELS[alarm.trouble.level], "what": alarm.trouble.what,
            "do": (do := _advice(name, alarm.trouble)),
            "plain": do not in (FOREIGN, OTHER),
            "since": alarm.since, "since_at_least": alarm.since_at_least,
            "since_text": say(alarm.since),
            "acknowledged": alarm.is_acknowledged,
            "over": alarm.over, "over_text": "" if alarm.over is None else say(alarm.over),
            "follows": cause, "recorded": False,
        }

    def _causes(self) -> dict[str, str]:
        """Return of the alarms of now that follow from another one which that is."""
        own = [
            name for name, one in self._alarms.items() if one.over is None and one.trouble.role
        ]
        own.sort(key=lambda name: self._alarms[name].since)
        return find_causes({name: self._alarms[name].trouble for name in own})

    def _present(self, causes: Mapping[str, str]) -> list[str]:
        """Return the names of the alarms of now, in order."""
        def order(name: str) -> tuple[bool, bool, int, bool, int, float]:
            alarm = self._alarms[name]
            trouble = alarm.trouble
            states = [(PUMP, ""), (PUMP, PUMP)]  # whether it runs, or that this is not known
            place = (trouble.role, trouble.part)
            rank = states.index(place) if place in states else len(states)
            return (
                not trouble.role, name in causes, rank, alarm.is_acknowledged,
                _SEVERITY[trouble.level], -alarm.since,
            )

        return sorted((one for one in self._alarms if self._alarms[one].over is None), key=order)

    def _past(self) -> list[str]:
        """Return the names of the alarms that are over, the newest first."""
        over = [one for one in self._alarms if self._alarms[one].over is not None]
        return sorted(over, key=lambda one: -self._alarms[one].over_wall)

    def events(self, say_time: Callable[[float], str] | None = None) -> list[dict[str, Any]]:
        """Return the events, the newest first."""
        say = say_time or _clock
        return [
            {"at": at, "at_text": say(at), "what": what} for at, what in reversed(self._events)
        ]

    def add_event(self, now: float, text: str) -> None:
        """Note an event."""
        self._events.append((now, plain(text, _TEXT)))

    def date_anew(self, first: float, last: float, begin: float) -> None:
        """Have all that is dated from one time to another one (s since 1970) be of a third time.

        It was noted before the graph's clock was known, by the system's.
        """
        for alarm in self._alarms.values():
            if first <= alarm.since <= last:
                alarm.since, alarm.since_at_least = begin, True
            if alarm.over is not None and first <= alarm.over <= last:
                alarm.over = begin
        self._events = deque(
            ((begin if first <= at <= last else at, text) for at, text in self._events),
            maxlen=_EVENTS,
        )

    def acknowledge(self, alarm_id: str) -> bool:
        """Note that somebody saw an alarm, until it is another one; False if there is none such."""
        alarm = self._alarms.get(alarm_id)
        if alarm is None:
            return False
        if len(alarm.acknowledged) >= 20:
            alarm.acknowledged.clear()
        alarm.acknowledged.add(alarm.gist)
        return True

    @property
    def heard(self) -> bool:
        """Whether anything was heard of any node or device."""
        return bool(self._nodes or self._foreign)

    def worst(self) -> str:
        """Return how it is: ``ok``, ``warn`` or ``error``; other devices warn at most."""
        present = [one for one in self._alarms.values() if one.over is None]
        if any(one.is_serious for one in present):
            return "error"
        return "warn" if present else "ok"

    def counts(self) -> tuple[int, int, int]:
        """Return how many causes are alarms and how many warnings, and how many follow from these.

        A cause counts by the worst of itself and of what follows from it.
        """
        causes = self._causes()
        present = [name for name, one in self._alarms.items() if one.over is None]
        serious = {causes.get(one, one) for one in present if self._alarms[one].is_serious}
        return len(serious), len(present) - len(causes) - len(serious), len(causes)

    def advice(self) -> str:
        """Return what to do now: about the cause of what is first and was not acknowledged."""
        causes = self._causes()
        present = self._present(causes)
        if not present:
            return "Nothing to do."
        new = (name for name in present if not self._alarms[name].is_acknowledged)
        first = next(new, present[0])
        first = causes.get(first, first)
        return _advice(first, self._alarms[first].trouble)

    def said(self, role: str, name: str | None = None) -> Mapping[str, Any] | None:
        """Return what the node of a role said last; None where none was heard.

        Where it is known which of several nodes of that role is meant, it has this ``name``.

        With its values come ``name``, ``state``, ``process`` and ``heard`` (wall time, s). Numbers
        that are not finite are None.
        """
        node = self._node(role) if name is None else self._nodes.get(name)
        if node is None or node.role != role:
            return None
        return {
            **node.values, "name": node.name, "state": node.state, "process": node.process,
            "heard": node.heard,
        }

    def controller(self) -> str | None:
        """Return the name of the controller that commands, without its namespace."""
        node = self._node("controller")
        return None if node is None else node.name.rpartition("/")[2]

    def _node(self, role: str) -> _Node | None:
        """Return the node of a role: of two, the one that has not ended, or was heard last."""
        return max(
            (one for one in self._nodes.values() if one.role == role),
            key=lambda one: (one.state not in (FINISHED, ENDED), one.heard), default=None,
        )


def _advice(name: str, trouble: Trouble) -> str:
    return advise(name.partition(": ")[0], trouble.role, trouble.part, trouble.what)


def _message(status: Status) -> str:
    return plain(status.message, _TEXT) or "says nothing"


def _level(status: Status) -> int:
    """Return a status's level; one that there is not is an error of its sender."""
    return status.level if status.level in (_OK, *_LEVELS) else _ERROR


def _integer(text: str) -> int | None:
    return int(text) if len(text) < 20 else None


def _number(text: str) -> float | None:
    return value if math.isfinite(value := float(text)) else None


def _nothing(_: str) -> None:
    """NaN and infinities, which are no JSON."""


def _text(values: Mapping[str, Any], key: str) -> str:
    value = values.get(key)
    return plain(value, _TEXT) if isinstance(value, str) else ""


def _counts(values: Mapping[str, Any]) -> dict[str, int]:
    """Return how many values of each topic a node refused so far."""
    refused = values.get("refused")
    given: Iterable[tuple[str, Any]] = refused.items() if isinstance(refused, dict) else ()
    return {topic: count for topic, count in given if isinstance(count, int)}


def _new(before: Mapping[str, Any], values: Mapping[str, Any], key: str, count: str) -> list[Any]:
    """Return what came to the end of a list, of which perhaps only the newest are kept."""
    old, all_now = before.get(key), values.get(key)
    if not isinstance(old, list) or not isinstance(all_now, list):
        return []
    counts = [one.get(count) for one in (before, values)]
    lengths = [
        number if isinstance(number, int) else len(entries)
        for number, entries in zip(counts, (old, all_now), strict=True)
    ]
    added = max(0, lengths[1] - lengths[0])
    return all_now[-min(added, _EVENTS):] if added else []


def _clock(time: float) -> str:
    """Return the time of day, UTC."""
    try:
        return datetime.fromtimestamp(time, timezone.utc).strftime("%H:%M:%S")
    except (ValueError, OverflowError, OSError):
        return "unknown"
