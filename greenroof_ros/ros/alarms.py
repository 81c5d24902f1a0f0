"""Derivation of alarms, each with a beginning, an end and a cause, from the reports of nodes.

Only this module decides which diagnoses are alarms, according to the table of conditions. The
alarms node (:mod:`greenroof_ros.nodes.alarms`) publishes the alarms on /alarms, and everything that
shows alarms shows those.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace

from greenroof_ros.interface.alarm import ERROR, LEVELS, WARN, Alarm
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.reports import StatusDiagnosis

ROLE = "alarms"
"""role and name of the alarms node"""
RESTARTED = "GREENROOF_ROS_RESTARTED"
"""environment variable with the reason why the process of the alarms node was restarted"""
# Devices that fall silent within this time of one another (s) do so for one reason.
_TOGETHER_S = 15.0
# How many alarms that are over are kept.
_MAX_OVER = 20

Diagnoses = Mapping[str, StatusDiagnosis]
"""What is wrong now, by status name."""


# --- the judge ------------------------------------------------------------------------------------


class Judge:
    """The derivation of alarms from diagnoses.

    Arguments named ``wall`` are times on the steady clock (s).

    Attributes:
        present: the active alarms, by status name.
        over: the latest past alarms, latest first.
        diagnoses: the diagnoses at the last update, by status name.
        causes: name of the causing diagnosis for every diagnosis that follows from another
            diagnosis.
        missing: diagnoses about nodes and values that may still arrive while the site is starting,
            by status name.
    """

    def __init__(self, number: int = 0) -> None:
        """Start without alarms; the first alarm will have the number after the given number."""
        self.present: dict[str, Alarm] = {}
        self.over: deque[Alarm] = deque(maxlen=_MAX_OVER)
        self.diagnoses: Diagnoses = {}
        self.causes: dict[str, str] = {}
        self.missing: dict[str, Alarm] = {}
        self._number = number
        self._began: dict[str, float] = {}  # of each active alarm (steady clock, s)

    @property
    def shown(self) -> list[Alarm]:
        """Everything on /alarms: active and past alarms, and what is missing at the start."""
        return [*self.present.values(), *self.over, *self.missing.values()]

    def update(
        self, wall: float, now: float, diagnoses: Diagnoses, *, starting: bool = False
    ) -> list[Alarm]:
        """Update the alarms, and return those that begin, end, or change in level or cause.

        Args:
            wall: current time on the steady clock (s).
            now: current time of the graph (s since 1970).
            diagnoses: all current diagnoses, keyed by status name.
            starting: True while the site is starting; nodes and values that are merely late then
                cause no alarm.
        """
        groups = dict(_group_devices(diagnoses))
        self.diagnoses = {**diagnoses, **{name: group for name, (group, _) in groups.items()}}
        self.causes = find_causes(self.diagnoses, {
            name: group for group, (_, names) in groups.items() for name in names
        })
        changed, self.missing = [*self._end(wall, now)], {}
        # Causes first: what follows from something that is not yet an alarm is not one, either.
        for name in sorted(self.diagnoses, key=lambda name: name in self.causes):
            diagnosis, before = self.diagnoses[name], self.present.get(name)
            cause = self.causes.get(name, "")
            alarm = Alarm(
                0, *_split(name), diagnosis.role, diagnosis.code, LEVELS[diagnosis.level],
                _headline(diagnosis), diagnosis.since or now - (wall - diagnosis.began),
                follows=cause, about=diagnosis.about, fault=diagnosis.fault,
            )
            if before is not None:
                follows = cause if cause in self.present else ""
                alarm = replace(alarm, number=before.number, since=before.since, follows=follows)
            elif starting and diagnosis.condition.late and not diagnosis.was_good:
                self.missing[name] = replace(alarm, level=LEVELS[WARN])
                continue
            elif not self.has_lasted(wall, name) or (cause and cause not in self.present):
                continue
            else:
                self._number, self._began[name] = self._number + 1, diagnosis.began
                alarm = replace(alarm, number=self._number)
            self.present[name] = alarm
            if before is None or (alarm.level, alarm.follows) != (before.level, before.follows):
                changed.append(alarm)
        return changed

    def has_lasted(self, wall: float, name: str) -> bool:
        """Return whether a diagnosis has lasted long enough to be an alarm."""
        diagnosis = self.diagnoses[name]
        return wall - diagnosis.began >= diagnosis.condition.lasts

    def _end(self, wall: float, now: float) -> Iterator[Alarm]:
        """End the alarms whose diagnosis has ended or has been replaced by another diagnosis."""
        for name, alarm in [*self.present.items()]:
            diagnosis = self.diagnoses.get(name)
            if diagnosis is None or diagnosis.identity != (alarm.code, alarm.fault):
                del self.present[name]
                # The stamp of its node may be ahead of this clock, which may also be set back.
                self.over.appendleft(replace(
                    alarm, ended=max(now, alarm.since),
                    seconds=round(wall - self._began.pop(name), 1),
                ))
                yield self.over[0]


def name_source(name: str) -> str:
    """Return a plain name for the source of an alarm: ``Roof sensor`` for ``/roof_sensor: x``."""
    return _split(name)[0].rpartition("/")[2].replace("_", " ").capitalize()


def _split(name: str) -> tuple[str, str]:
    """Return node and part in the name of a status."""
    node, _, part = name.partition(": ")
    return node, part


def _headline(diagnosis: StatusDiagnosis) -> str:
    """Return the sentence of a diagnosis in an operator's words, if the table has one."""
    topics = read_topics()
    labels = [
        display.label.lower() for name in diagnosis.about
        if name in topics and (display := topics[name].display) is not None
    ]
    headline = diagnosis.condition.headline.format(inputs=" or ".join(labels) or "value")
    return headline or diagnosis.sentence


# --- causes ---------------------------------------------------------------------------------------


def _group_devices(diagnoses: Diagnoses) -> Iterator[tuple[str, tuple[StatusDiagnosis, list[str]]]]:
    """Yield what the devices on a line or broker have in common that fell silent together.

    Yields:
        The name of the common diagnosis, and that diagnosis with the names of the devices'.
    """
    lines: dict[str, list[str]] = {}
    for name in _older_first(diagnoses):
        diagnosis = diagnoses[name]
        if diagnosis.line and diagnosis.condition.device:
            together = lines.setdefault(diagnosis.line, [])
            if len(together) == 1 and (
                diagnosis.began - diagnoses[together[0]].began > _TOGETHER_S
            ):
                together.clear()
            together.append(name)
    for line, names in lines.items():
        devices = sorted({name_source(name).lower() for name in names})
        if len(devices) < 2:
            continue
        first = diagnoses[names[0]]
        sentence = Diagnosis.of(
            "devices_lost", devices=f"{', '.join(devices[:-1])} and {devices[-1]}"
        ).sentence
        about = {topic: None for name in names for topic in diagnoses[name].about}
        yield f"{names[0].partition(': ')[0].rpartition('/')[0]}/{ROLE}: {line}", (StatusDiagnosis(
            max(diagnoses[name].level for name in names), sentence, "devices_lost", ROLE,
            first.since, first.began, tuple(about),
            was_good=any(diagnoses[name].was_good for name in names),
        ), names)


def find_causes(diagnoses: Diagnoses, groups: Mapping[str, str] = {}) -> dict[str, str]:
    """Return the name of the root cause of every diagnosis that follows from another diagnosis.

    An error does not follow from a warning. A state of the pump that requires a visit to the pump
    does not follow from any other diagnosis, because advice about a cause would conceal the need
    for this visit.

    Args:
        diagnoses: diagnoses of the graph's nodes, keyed by status name.
        groups: name of the diagnosis of the group to which a device belongs, by status name.
    """
    causes: dict[str, str] = {}

    def root_of(name: str) -> str:
        return root_of(causes[name]) if name in causes else name

    names = _older_first(diagnoses)
    for name in names:
        ranks = {
            other: 1 if groups.get(name) == other else _rank(name, other, diagnoses)
            for other in names if other != name
        }
        for other in sorted(filter(ranks.get, ranks), key=lambda other: ranks[other]):
            root = root_of(other)
            if root != name and not _is_worse(diagnoses[name], diagnoses[root]):
                causes[name] = other
                break
    return {
        name: root for name in causes
        if not _is_worse(diagnoses[name], diagnoses[root := root_of(name)])
    }


def _older_first(diagnoses: Diagnoses) -> list[str]:
    return sorted(diagnoses, key=lambda name: diagnoses[name].began)


def _is_worse(diagnosis: StatusDiagnosis, cause: StatusDiagnosis) -> bool:
    return (diagnosis.level, cause.level) == (ERROR, WARN)


def _rank(name: str, other: str, diagnoses: Diagnoses) -> int:
    """Return how well another diagnosis explains one: 1 is best, and 0 is not at all."""
    (node, part), (other_node, other_part) = _split(name), _split(other)
    diagnosis, cause = diagnoses[name], diagnoses[other]
    condition, interlock = diagnosis.condition, diagnosis.condition.interlock
    if part == PUMP and condition.needs_operator:
        return 0
    about, own = {*diagnosis.about}, node == other_node
    sends = part and condition.no_data and other_part != "inputs" and _sends(cause, diagnosis)
    reports_more = other_part in (condition.explained_by if interlock is None else interlock.parts)
    rules = (
        own and not other_part,  # the node as a whole, for example if it is silent
        not part and not other_part and {other_node.rpartition("/")[2], cause.role} & about,
        sends and not other_part,
        sends,
        # Of an interlock, another node may know more, such as the temperature in frost.
        reports_more and (own if interlock is None else part == PUMP or not own),
        # A part of the pump node that stops the pump because of that input knows more about it.
        part == "inputs" != other_part and cause.role == PUMP and {*cause.about} & about,
    )
    return next((rank for rank, rule in enumerate(rules, start=1) if rule), 0)


def _sends(cause: StatusDiagnosis, diagnosis: StatusDiagnosis) -> bool:
    """Return whether a node of another role publishes what a diagnosis is about."""
    topics = read_topics()
    return cause.role != diagnosis.role and any(
        cause.role in (*topics[name].publishers, *topics[name].live_publishers)
        for name in diagnosis.about if name in topics
    )
