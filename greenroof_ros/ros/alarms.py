"""Derivation of alarms, each with a beginning, an end and a cause, from the reports of nodes.

Only this module decides which diagnoses are alarms, according to the table of conditions. The
module receives reports and returns alarms. The supervisor of a live site passes the reports from
its sockets to this module; the page, the status command and the bridge pass the reports from
/diagnostics. A node sends the same report through both channels, with the code, the beginning and
the duration of each fault. Therefore all observers see the same alarms, with the same node, part,
code and beginning. A node that died counts as lost from its last report on /diagnostics onwards,
even if it is restarted before its silence alone would have been noticed. The supervisor prints the
alarms and records them next to the bag (:mod:`greenroof_ros.live.alarm_log`), and the bag
contains the reports themselves. Therefore alarms need not be published, and no alarm is hidden if
the supervisor dies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, NamedTuple

from greenroof_ros.interface.alarm import ERROR, LEVELS, OK, STALE, WARN, Alarm
from greenroof_ros.interface.conditions import (
    Condition,
    Diagnosis,
    Value,
    identity_of,
    read_conditions,
)
from greenroof_ros.interface.states import ENDED, FINISHED, PUMP, STARTING
from greenroof_ros.interface.topics import read_topics

# After this silence (s) a node counts as not responding: it reports at least once a second, so it
# may miss two reports.
SILENT_S = 3.5
# If it has been silent for this long (s) when another process reports under its name, it has died.
_DIED_S = 1.5
# An alarm that comes back within this time (s) is the same one.
_AGAIN_S = 10.0
# While all nodes have run for less than this (s), the site is starting: what is late may still
# come.
_START_S = 60.0
# How far a node's time stamps may be ahead of the graph's time (s).
_AHEAD_S = 60.0
# How many alarms that are over are kept, and how many names a diagnosis may be about.
_MAX_OVER, _MAX_ABOUT = 20, 10
# Endings of the names of statuses about what a node receives: they explain nothing elsewhere.
_OF_INPUTS = ": inputs", ": refused"


class Change(NamedTuple):
    """A change in an alarm.

    Attributes:
        what: type of the change: ``begins``, ``changes`` (of the level or the cause), ``ends`` or
            ``returns``.
        alarm: the alarm after the change.
    """

    what: str
    alarm: Alarm


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
    def has_lasted(self) -> bool:
        """Whether the fault had lasted long enough to be an alarm when it was reported."""
        return self.condition is None or self.age_s >= self.condition.lasts

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


@dataclass
class PartReport:
    """The last report received about a part of a node, or about another device.

    Attributes:
        diagnosis: content of the report, even if the level is OK.
        received_at: time at which the report was received (steady clock, s).
        again: True if an earlier report about the part was received.
    """

    diagnosis: StatusDiagnosis
    received_at: float
    again: bool

    @classmethod
    def receive(
        cls, before: PartReport | None, wall: float, level: int, sentence: str,
        values: Mapping[str, str], role: str = "", namespace: str = "",
    ) -> PartReport:
        """Return the next report about a part, with the namespace removed from its topics.

        Args:
            before: the previous report; None for the first.
            wall: current time (steady clock, s).
            level: OK, WARN, ERROR or STALE.
            sentence: sentence that the report contains.
            values: the code with its beginning and age, and the values that are inserted in the
                sentence.
            role: the node's role in the interface; empty for another device.
            namespace: namespace of the node.
        """
        about = (values.get("topics") or values.get("topic", "")).split()[:_MAX_ABOUT]
        code, fault = identity_of(values)
        return cls(StatusDiagnosis(
            level, sentence, code, role, tuple(topic.removeprefix(namespace) for topic in about),
            fault, _parse_time(values.get("since", "")), _parse_number(values.get("age_s", "")),
            level == OK or (before is not None and before.diagnosis.was_good),
        ), wall, before is not None)


@dataclass
class NodeReport:
    """The last reports received from a process of this package.

    Attributes:
        name: fully qualified name of the node.
        role: the node's role in the interface.
        process: machine and process ID of the node's process.
        state: one of the states in :mod:`greenroof_ros.interface.states`.
        values: all other values in the node's report.
        began: time at which the first report was received (steady clock, s).
        received_at: time at which the last report was received (steady clock, s); initially
            ``began``.
        since: time at which the node entered its state (steady clock, s); initially ``began``.
        heard: time at which the last report was received, in the graph's time (s since 1970).
        parts: reports about the node's parts, keyed by part name.
        refused_at: time of the last increase in the number of rejected values (steady clock, s).
        refused: topics of the values that were rejected at that time.
        ended: description of the end of the process, if known from another source; otherwise empty.
        lost: ``heard`` and ``received_at`` of the previous process if it died; otherwise None.
    """

    name: str
    role: str
    process: str
    state: str
    values: Mapping[str, Any]
    began: float
    heard: float = 0.0
    parts: dict[str, PartReport] = field(default_factory=dict)
    refused_at: float = -math.inf
    refused: tuple[str, ...] = ()
    ended: str = ""
    lost: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        self.received_at = self.since = self.began

    @property
    def has_ended(self) -> bool:
        """Whether the node has reported that its run is over or that it is stopping."""
        return self.state in (FINISHED, ENDED)

    def is_online(self, wall: float) -> bool:
        """Return True if the node's reports are currently arriving."""
        return not self.has_ended and not self.ended and wall - self.received_at <= SILENT_S

    def receive(self, wall: float, now: float, state: str, values: Mapping[str, Any]) -> None:
        """Store the status of the node itself; see the attributes."""
        if state != self.state:
            self.since = wall
        known, counts = _read_counts(self.values), _read_counts(values)
        if grown := [topic for topic, n in counts.items() if n > known.get(topic, 0)]:
            self.refused_at, self.refused = wall, tuple(grown[:_MAX_ABOUT])
        self.state, self.values, self.received_at, self.heard = state, values, wall, now
        self.ended = ""

    def replace_process(self, before: NodeReport | None) -> None:
        """Replace the node's previous process, and record that process as lost if it died."""
        if before is not None and not before.has_ended and (
            self.began - before.received_at > _DIED_S
        ):
            self.lost = before.heard, before.received_at

    def receive_part(
        self, part: str, wall: float, level: int, sentence: str, values: Mapping[str, str]
    ) -> None:
        """Store the status of a part; see :meth:`PartReport.receive`."""
        self.parts[part] = PartReport.receive(
            self.parts.get(part), wall, level, sentence, values, self.role,
            self.name.rpartition("/")[0],
        )

    def diagnoses(self, wall: float) -> Iterator[tuple[str, StatusDiagnosis]]:
        """Yield the diagnoses of the node and its parts, each with the name of its status."""
        if self.has_ended:
            failure = self.values.get("failure")
            if isinstance(failure, str) and failure:
                failed = make_diagnosis(ERROR, self.role, "node_failed", failure=failure)
                sentence = self.ended or failed.sentence
                yield self.name, replace(failed, sentence=sentence, since=self.heard)
            return
        online = self.is_online(wall)
        lost = replace(
            make_diagnosis(STALE, self.role, "not_heard", "ended", why=self.ended) if self.ended
            else make_diagnosis(STALE, self.role, "not_heard", "silent", time=SILENT_S),
            since=self.heard,
        )
        waiting = self.values.get("waiting")
        if not online:
            yield self.name, lost
        elif self.lost is not None and self.received_at == self.began:
            since, received_at = self.lost
            yield self.name, replace(lost, since=since, age_s=wall - received_at)
        elif self.state == STARTING and isinstance(waiting, list):
            peers = tuple(map(str, waiting[:_MAX_ABOUT]))
            waits = make_diagnosis(
                WARN, self.role, "peers_awaited", peers=", ".join(peers)
            )
            yield self.name, replace(waits, about=peers, age_s=wall - self.since)
        if wall - self.refused_at <= SILENT_S:
            topics = ", ".join(self.refused)
            refused = make_diagnosis(WARN, self.role, "values_refused", topics=topics)
            yield f"{self.name}: refused", replace(refused, about=self.refused)
        for part, report in self.parts.items():
            # Whatever was wrong when a silent node last reported stays.
            if online and self.received_at - report.received_at > SILENT_S:
                yield f"{self.name}: {part}", lost
            elif report.diagnosis.level != OK:
                yield f"{self.name}: {part}", report.diagnosis


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


def is_starting(nodes: Sequence[NodeReport], wall: float) -> bool:
    """Return True if the site is starting: all of its online nodes started less than 60 s ago."""
    up = [node.values.get("up_s") for node in nodes if node.is_online(wall)]
    return bool(up) and all(isinstance(age, (int, float)) and age < _START_S for age in up)


# --- the judge ------------------------------------------------------------------------------------


class _Lasting(NamedTuple):
    """The identity of a current diagnosis, and its start in steady and in graph time (s)."""

    identity: tuple[str, str]
    began: float
    since: float


class Judge:
    """The derivation of alarms from diagnoses.

    Arguments named ``wall`` are times on the steady clock (s).

    Attributes:
        alarms: the active alarms and the latest past alarms, keyed by status name.
        diagnoses: the diagnoses at the last update, keyed by status name.
        causes: name of the causing diagnosis for every diagnosis that follows from another
            diagnosis.
        missing: diagnoses about nodes and values that may still arrive while the site is starting,
            keyed by status name.
    """

    def __init__(self, number: int = 0) -> None:
        """Start without alarms; the first alarm will have the number after the given number."""
        self.alarms: dict[str, Alarm] = {}
        self.diagnoses: Mapping[str, StatusDiagnosis] = {}
        self.causes: dict[str, str] = {}
        self.missing: dict[str, StatusDiagnosis] = {}
        self._number = number
        self._lasting: dict[str, _Lasting] = {}
        # When the present alarms began, and when the past ones ended (steady clock, s).
        self._began: dict[str, float] = {}
        self._ended: dict[str, float] = {}

    @property
    def present(self) -> dict[str, Alarm]:
        """The active alarms, by name."""
        return {name: alarm for name, alarm in self.alarms.items() if alarm.ended is None}

    @property
    def over(self) -> list[Alarm]:
        """The past alarms, latest first."""
        ended = sorted(self._ended, key=lambda name: -self._ended[name])
        return [self.alarms[name] for name in ended]

    def update(
        self, wall: float, now: float, diagnoses: Mapping[str, StatusDiagnosis], *,
        starting: bool = False,
    ) -> list[Change]:
        """Update the alarms and return their changes.

        Args:
            wall: current time on the steady clock (s).
            now: current time of the graph (s since 1970).
            diagnoses: all current diagnoses, keyed by status name.
            starting: True while the site is starting; nodes and values that are merely late then
                cause no alarm.
        """
        before, self._lasting = self._lasting, {}
        for name, diagnosis in diagnoses.items():
            lasting = before.get(name)
            if lasting is None or lasting.identity != diagnosis.identity:
                since = diagnosis.since
                if since is None or since > now + _AHEAD_S:
                    since = now
                lasting = _Lasting(diagnosis.identity, wall - diagnosis.age_s, since)
            self._lasting[name] = lasting
        older_first = sorted(diagnoses, key=lambda name: self._lasting[name].began)
        self.diagnoses = diagnoses
        self.causes = find_causes({
            name: diagnoses[name] for name in older_first if diagnoses[name].role
        })
        self.missing = {
            name: diagnosis for name, diagnosis in diagnoses.items()
            if starting and self._may_come(name, diagnosis)
        }
        changes = [*self._end(wall, now, diagnoses)]
        # Causes first: what follows from something that is not yet an alarm is not one, either.
        for name in sorted(diagnoses, key=lambda name: name in self.causes):
            if name not in self.missing:
                changes += self._judge(wall, name, diagnoses[name], self.causes.get(name, ""))
        for alarm in self.over[_MAX_OVER:]:
            del self.alarms[alarm.name], self._ended[alarm.name], self._began[alarm.name]
        return changes

    def _may_come(self, name: str, diagnosis: StatusDiagnosis) -> bool:
        condition = diagnosis.condition
        late = condition is not None and condition.late and not diagnosis.was_good
        return late and not self._is_present(name)

    def _is_present(self, name: str) -> bool:
        return name in self.alarms and name not in self._ended

    def _end(
        self, wall: float, now: float, diagnoses: Mapping[str, StatusDiagnosis]
    ) -> Iterator[Change]:
        """End the alarms whose diagnosis has ended or has been replaced by another diagnosis."""
        for name, alarm in self.present.items():
            diagnosis = diagnoses.get(name)
            if diagnosis is None or diagnosis.identity != (alarm.code, alarm.fault):
                seconds = round(wall - self._began[name], 1)
                ahead = 0 < alarm.since - now <= _AHEAD_S  # otherwise the clock was set back
                ended = alarm.since if ahead else now
                self.alarms[name] = replace(alarm, ended=ended, seconds=seconds)
                self._ended[name] = wall
                yield Change("ends", self.alarms[name])

    def _judge(
        self, wall: float, name: str, diagnosis: StatusDiagnosis, cause: str
    ) -> Iterator[Change]:
        """Begin or continue the alarm for a diagnosis, if the diagnosis now counts as an alarm."""
        lasting, before = self._lasting[name], self.alarms.get(name)
        news: dict[str, Any] = {
            "level": LEVELS[diagnosis.level], "sentence": diagnosis.sentence,
            "about": diagnosis.about, "follows": cause if self._is_present(cause) else "",
        }
        if before is not None and (before.code, before.fault) == diagnosis.identity and (
            wall - self._ended.get(name, wall) <= _AGAIN_S
        ):
            alarm = self.alarms[name] = replace(before, ended=None, seconds=None, **news)
            if self._ended.pop(name, None) is not None:
                yield Change("returns", alarm)
            elif (alarm.level, alarm.follows) != (before.level, before.follows):
                yield Change("changes", alarm)
            return
        condition = diagnosis.condition
        lasts = condition.lasts if condition is not None else 0.0
        # What follows from something that is not yet an alarm is not one, either.
        waits = cause and not news["follows"] and self._lasting[cause].began <= lasting.began
        if waits or wall - lasting.began < lasts:
            return
        self._number += 1
        node, _, part = name.partition(": ")
        self._ended.pop(name, None)
        self._began[name] = lasting.began
        self.alarms[name] = Alarm(
            self._number, node, part, diagnosis.role, diagnosis.code, fault=diagnosis.fault,
            since=lasting.since, **news,
        )
        yield Change("begins", self.alarms[name])


# --- causes ---------------------------------------------------------------------------------------


def find_causes(diagnoses: Mapping[str, StatusDiagnosis]) -> dict[str, str]:
    """Return the name of the root cause of every diagnosis that follows from another diagnosis.

    The pump's state follows from the diagnosis of the part that reports the reason in more detail.
    A node's missing input follows from the diagnosis of the publisher. An error does not follow
    from a warning. A state of the pump that requires a visit to the pump does not follow from any
    other diagnosis, because advice about a cause would conceal the need for this visit.

    Args:
        diagnoses: diagnoses of the graph's own nodes, keyed by status name, oldest first.
    """
    causes: dict[str, str] = {}
    for name, diagnosis in diagnoses.items():
        for other in _find_candidates(name, diagnosis, diagnoses):
            first = causes.get(other, other)
            group = [name, *(follower for follower, cause in causes.items() if cause == name)]
            worse = diagnoses[first].level == WARN and any(
                diagnoses[follower].level == ERROR for follower in group
            )
            if first != name and not worse:
                causes.update(dict.fromkeys(group, first))
                break
    return causes


def _find_candidates(
    name: str, diagnosis: StatusDiagnosis, diagnoses: Mapping[str, StatusDiagnosis]
) -> Iterator[str]:
    """Yield the names of diagnoses that may be the cause of a diagnosis, the most likely first."""
    node, _, part = name.partition(": ")
    condition = diagnosis.condition
    if condition is not None and condition.needs_operator and part == PUMP:
        return
    if part and node in diagnoses:  # the node as a whole, for example if it is silent
        yield node
    if condition is None:
        return
    if not part:  # awaited nodes that are wrong as a whole
        for name, other in diagnoses.items():
            waited_for = {name.rpartition("/")[2], other.role} & {*diagnosis.about}
            if name != node and ": " not in name and waited_for:
                yield name
    elif condition.no_data:
        yield from find_publishers(diagnosis.about, diagnosis.role, diagnoses)
    more: Sequence[str] = condition.explained_by
    if condition.interlock is not None:
        more = condition.interlock.parts if part == PUMP else ()
    yield from (name for name in (f"{node}: {part}" for part in more) if name in diagnoses)
    if part == "inputs":
        # A part of the pump node that stops the pump because of that input reports more about it.
        yield from (
            name for name, other in diagnoses.items()
            if other.role == PUMP and not name.endswith(_OF_INPUTS)
            and {*other.about} & {*diagnosis.about}
        )


def find_publishers(
    topics: Iterable[str], reader: str, diagnoses: Mapping[str, StatusDiagnosis]
) -> Iterator[str]:
    """Yield the names of the diagnoses of the nodes that publish the given topics.

    Diagnoses of whole nodes come before diagnoses of parts of nodes.

    Args:
        topics: names of topics in the interface.
        reader: role of the node that reads the topics, to leave out its diagnoses; empty to leave
            out none.
        diagnoses: diagnoses of the graph's own nodes, keyed by status name.
    """
    interface, roles = read_topics(), set[str]()
    for topic in interface.keys() & {*topics}:
        roles.update(interface[topic].publishers, interface[topic].live_publishers)
    roles.discard(reader)
    names = [
        name for name, other in diagnoses.items()
        if other.role in roles and not name.endswith(_OF_INPUTS)
    ]
    yield from sorted(names, key=lambda name: ": " in name)
