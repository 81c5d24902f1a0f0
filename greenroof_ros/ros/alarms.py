"""Derivation of alarms, each with a beginning, an end and a cause, from the reports of nodes.

Only this module decides which diagnoses are alarms, according to the table of conditions. The
alarms node (:mod:`greenroof_ros.nodes.alarms`) publishes the alarms on /alarms, and everything that
shows alarms shows those.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from greenroof_ros.interface.alarm import ERROR, LEVELS, WARN, Alarm
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.reports import StatusDiagnosis

ROLE = "alarms"
"""role and name of the alarms node"""
RESTARTED = "GREENROOF_ROS_RESTARTED"
"""environment variable with the reason why the process of the alarms node was restarted"""
# An alarm that comes back within this time (s) is the same one.
_AGAIN_S = 10.0
# Devices that fall silent within this time of one another (s) do so for one reason.
_TOGETHER_S = 15.0
# How far a node's time stamps may be ahead of the graph's time (s).
_AHEAD_S = 60.0
# How many alarms that are over are kept.
_MAX_OVER = 20
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
        self._groups: dict[str, str] = {}
        # When the present alarms began, and when the past ones ended (steady clock, s).
        self._began: dict[str, float] = {}
        self._ended: dict[str, float] = {}

    @property
    def shown(self) -> list[Alarm]:
        """Everything on /alarms: active and past alarms, and what is missing at the start."""
        missing = (
            Alarm(0, *_split(name), diagnosis.role, diagnosis.code, LEVELS[WARN],
                  _headline(diagnosis), self._lasting[name].since, about=diagnosis.about,
                  follows=self.causes.get(name, ""), fault=diagnosis.fault)
            for name, diagnosis in self.missing.items()
        )
        return [*self.present.values(), *self.over, *missing]

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
        self._groups = {}
        self.diagnoses = diagnoses = {**diagnoses, **dict(self._group_devices(diagnoses))}
        older_first = sorted(diagnoses, key=lambda name: self._lasting[name].began)
        self.causes = find_causes(
            {name: diagnoses[name] for name in older_first if diagnoses[name].role}, self._groups
        )
        self.missing = {
            name: diagnosis for name, diagnosis in diagnoses.items()
            if starting and self._is_awaited(name, diagnosis)
        }
        changes = [*self._end(wall, now, diagnoses)]
        # Causes first: what follows from something that is not yet an alarm is not one, either.
        for name in sorted(diagnoses, key=lambda name: name in self.causes):
            if name not in self.missing:
                changes += self._judge(wall, name, diagnoses[name], self.causes.get(name, ""))
        for alarm in self.over[_MAX_OVER:]:
            del self.alarms[alarm.name], self._ended[alarm.name], self._began[alarm.name]
        return changes

    def has_lasted(self, wall: float, name: str) -> bool:
        """Return whether a diagnosis has lasted long enough to be an alarm."""
        condition = self.diagnoses[name].condition
        lasts = condition.lasts if condition is not None else 0.0
        return wall - self._lasting[name].began >= lasts

    def _group_devices(
        self, diagnoses: Mapping[str, StatusDiagnosis]
    ) -> Iterator[tuple[str, StatusDiagnosis]]:
        """Yield a diagnosis for the devices on each line or broker that fell silent together."""
        lines: dict[str, list[str]] = {}
        for name in sorted(diagnoses, key=lambda name: self._lasting[name].began):
            condition = diagnoses[name].condition
            if condition is None or not condition.device or not diagnoses[name].line:
                continue
            together = lines.setdefault(diagnoses[name].line, [])
            before = self._lasting[together[-1]].began if together else -math.inf
            if len(together) < 2 and self._lasting[name].began - before > _TOGETHER_S:
                together.clear()
            together.append(name)
        for line, names in lines.items():
            devices = dict.fromkeys(map(name_source, names))
            if len(devices) < 2:
                continue
            first = self._lasting[names[0]]
            group = f"{names[0].partition(': ')[0].rpartition('/')[0]}/{ROLE}: {line}"
            self._groups |= dict.fromkeys(names, group)
            *others, last = (device.lower() for device in devices)
            yield group, StatusDiagnosis(
                max(diagnoses[name].level for name in names),
                Diagnosis.of("devices_lost", devices=f"{', '.join(others)} and {last}").sentence,
                "devices_lost", ROLE,
                tuple({topic: None for name in names for topic in diagnoses[name].about}),
                was_good=any(diagnoses[name].was_good for name in names),
            )
            self._lasting[group] = _Lasting(("devices_lost", ""), first.began, first.since)

    def _is_awaited(self, name: str, diagnosis: StatusDiagnosis) -> bool:
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
            "level": LEVELS[diagnosis.level], "sentence": _headline(diagnosis),
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
        # What follows from something that is not yet an alarm is not one, either.
        waits = cause and not news["follows"] and self._lasting[cause].began <= lasting.began
        if waits or not self.has_lasted(wall, name):
            return
        self._number += 1
        self._ended.pop(name, None)
        self._began[name] = lasting.began
        self.alarms[name] = Alarm(
            self._number, *_split(name), diagnosis.role, diagnosis.code, fault=diagnosis.fault,
            since=lasting.since, **news,
        )
        yield Change("begins", self.alarms[name])


def name_source(name: str) -> str:
    """Return a plain name for the source of an alarm: ``Roof sensor`` for ``/roof_sensor: x``."""
    return _split(name)[0].rpartition("/")[2].replace("_", " ").capitalize()


def _split(name: str) -> tuple[str, str]:
    """Return node and part in the name of a status."""
    node, _, part = name.partition(": ")
    return node, part


def _headline(diagnosis: StatusDiagnosis) -> str:
    """Return the sentence of a diagnosis in an operator's words, if the table has one."""
    condition = diagnosis.condition
    if condition is None or not condition.headline:
        return diagnosis.sentence
    topics = read_topics()
    labels = [
        display.label.lower() for name in diagnosis.about
        if name in topics and (display := topics[name].display) is not None
    ]
    return condition.headline.format(inputs=" or ".join(labels) or "value")


# --- causes ---------------------------------------------------------------------------------------


def find_causes(
    diagnoses: Mapping[str, StatusDiagnosis], groups: Mapping[str, str] = {}
) -> dict[str, str]:
    """Return the name of the root cause of every diagnosis that follows from another diagnosis.

    The pump's state follows from the diagnosis of the part that reports the reason in more detail.
    A node's missing input follows from the diagnosis of the publisher. An error does not follow
    from a warning. A state of the pump that requires a visit to the pump does not follow from any
    other diagnosis, because advice about a cause would conceal the need for this visit.

    Args:
        diagnoses: diagnoses of the graph's own nodes, keyed by status name, oldest first.
        groups: name of the diagnosis of the group to which a device belongs, by status name.
    """
    causes: dict[str, str] = {}
    for name, diagnosis in diagnoses.items():
        grouped = [groups[name]] if name in groups else []
        for other in (*grouped, *_find_candidates(name, diagnosis, diagnoses)):
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
        yield from _find_publishers(diagnosis, diagnoses)
    interlock = condition.interlock
    more: Sequence[str] = condition.explained_by if interlock is None else interlock.parts
    if interlock is None or part == PUMP:
        yield from (own for explains in more if (own := f"{node}: {explains}") in diagnoses)
    if interlock is not None:  # another node may know more, such as the temperature in frost
        yield from (
            other for explains in more for other in diagnoses
            if other.endswith(f": {explains}") and not other.startswith(f"{node}: ")
        )
    if part == "inputs":
        # A part of the pump node that stops the pump because of that input reports more about it.
        yield from (
            name for name, other in diagnoses.items()
            if other.role == PUMP and not name.endswith(_OF_INPUTS)
            and {*other.about} & {*diagnosis.about}
        )


def _find_publishers(
    diagnosis: StatusDiagnosis, diagnoses: Mapping[str, StatusDiagnosis]
) -> Iterator[str]:
    """Yield the names of the diagnoses of the nodes that publish what a diagnosis is about.

    Diagnoses of whole nodes come before diagnoses of parts of nodes.
    """
    interface, roles = read_topics(), set[str]()
    for topic in interface.keys() & {*diagnosis.about}:
        roles.update(interface[topic].publishers, interface[topic].live_publishers)
    roles.discard(diagnosis.role)
    names = [
        name for name, other in diagnoses.items()
        if other.role in roles and not name.endswith(_OF_INPUTS)
    ]
    yield from sorted(names, key=lambda name: ": " in name)
