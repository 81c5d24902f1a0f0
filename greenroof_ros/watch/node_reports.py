"""The last reports of nodes and other devices, as the page reads them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

from greenroof_ros.interface.alarm import ERROR, OK, STALE, WARN
from greenroof_ros.interface.conditions import identity_of
from greenroof_ros.interface.states import ENDED, FINISHED, STARTING
from greenroof_ros.ros.reports import SILENT_S, StatusDiagnosis, make_diagnosis

_DIED_S, _START_S, _MAX_ABOUT = 1.5, 60.0, 10


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
