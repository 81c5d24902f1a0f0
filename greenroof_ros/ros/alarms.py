"""Derivation of alarms, each with a beginning, an end and a cause, from the reports of nodes.

Only this module decides which diagnoses are alarms, according to the table of conditions. The
alarms node (:mod:`greenroof_ros.nodes.alarms`) publishes the alarms on /alarms, and everything that
shows alarms shows those.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import itemgetter

from greenroof_ros.interface.alarm import ERROR, LEVELS, WARN, Alarm
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.reports import StatusDiagnosis

ROLE = "alarms"
"""role and name of the alarms node"""
RESTARTED = "GREENROOF_ROS_RESTARTED"
"""environment variable with the reason why the process of the alarms node was restarted"""
# Devices that fall silent, and alarms that end, within this time of one another (s) do so for one
# reason.
_TOGETHER_S = 15.0
# The part about what a node receives, which explains nothing elsewhere.
_INPUTS = "inputs"
# How many alarms that are over are kept.
_MAX_OVER = 20

Diagnoses = Mapping[str, StatusDiagnosis]
"""What is wrong now, by status name."""


# --- the judge ------------------------------------------------------------------------------------


class Judge:
    """The derivation of alarms from diagnoses.

    Attributes:
        present: the active alarms, by status name.
        over: the latest past alarms, latest first.
        missing: diagnoses about nodes and values that may still arrive while the site is starting,
            by status name.
    """

    def __init__(self, number: int = 0) -> None:
        """Start without alarms; the first alarm will have the number after the given number."""
        self.present: dict[str, StatusDiagnosis] = {}
        self.over: deque[Alarm] = deque(maxlen=_MAX_OVER)
        self.missing: dict[str, Alarm] = {}
        self._number = number
        # The causes from which alarms have followed, and until when (steady clock, s), by name.
        self._followed: dict[str, tuple[str, float]] = {}

    @property
    def shown(self) -> list[Alarm]:
        """Everything on /alarms: active and past alarms, and what is missing at the start."""
        return [*self.present.values(), *self.over, *self.missing.values()]

    def update(
        self, steady: float, now: float, diagnoses: Diagnoses, *, starting: bool = False
    ) -> list[Alarm]:
        """Update the alarms, and return those that begin, end, or change in level or cause.

        Args:
            steady: current time on the steady clock (s).
            now: current time of the graph (s since 1970).
            diagnoses: all current diagnoses, by status name.
            starting: True while the site is starting; nodes and values that are merely late then
                cause no alarm.
        """
        groups = dict(_group_devices(diagnoses))
        diagnoses = {**diagnoses, **{group.name: group for group in groups.values()}}
        causes = find_causes(diagnoses, groups)
        changed, self.missing = [*self._end(steady, now, diagnoses)], {}
        # Causes first: what follows from something that is not yet an alarm is not one, either.
        for name in sorted(diagnoses, key=lambda name: name in causes):
            diagnosis, before = diagnoses[name], self.present.get(name)
            has_lasted = steady - diagnosis.began >= diagnosis.condition.lasts
            cause = causes.get(name, "")
            alarm = replace(
                diagnosis, sentence=_headline(diagnosis), follows=cause,
                since=now - (steady - diagnosis.began),
            )
            if before is not None:
                follows = cause if cause in self.present else ""
                same = {key: getattr(before, key) for key in ("number", "since", "began")}
                alarm = replace(alarm, follows=follows, **same)
            elif starting and diagnosis.condition.late and not diagnosis.was_good:
                self.missing[name] = replace(alarm, level=LEVELS[WARN])
                continue
            elif not has_lasted or (cause and cause not in self.present):
                continue
            else:
                self._number += 1
                alarm = replace(alarm, number=self._number)
            self.present[name] = alarm
            if alarm.follows:
                self._followed[name] = alarm.follows, steady
            if before is None or (alarm.level, alarm.follows) != (before.level, before.follows):
                changed.append(alarm)
        return changed

    def _end(self, steady: float, now: float, diagnoses: Diagnoses) -> Iterator[Alarm]:
        """End the alarms whose diagnosis has ended or has been replaced by another diagnosis."""
        for name, alarm in [*self.present.items()]:
            diagnosis = diagnoses.get(name)
            if diagnosis is None or diagnosis.identity != alarm.identity:
                del self.present[name]
                # The stamp of its node may be ahead of this clock, which may also be set back.
                ended, seconds = max(now, alarm.since), round(steady - alarm.began, 1)
                cause, until = self._followed.pop(name, ("", 0.0))
                # It may end a little later than its cause.
                follows = cause if steady - until <= _TOGETHER_S else ""
                over = replace(alarm, ended=ended, seconds=seconds, follows=follows)
                self.over.appendleft(over)
                yield self.over[0]


def name_source(name: str, role: str = "") -> str:
    """Return a plain name for the source of a status: ``Roof sensor`` for ``/roof_sensor: x``.

    Args:
        name: name of the status.
        role: role of the node; a controller is called by its role.
    """
    plain = name.partition(": ")[0].rpartition("/")[2].replace("_", " ")
    return "Controller" if role == "controller" else f"{plain[:1].upper()}{plain[1:]}"


def describe_alarm(alarm: Alarm) -> str:
    """Return an alarm with its source, as all that shows alarms does: ``Roof sensor: no answer``.

    The alarms node itself is not named as a source.
    """
    if alarm.role == ROLE:
        return alarm.sentence[:1].upper() + alarm.sentence[1:]
    return f"{name_source(alarm.name, alarm.role)}: {alarm.sentence}"


def _headline(diagnosis: StatusDiagnosis) -> str:
    """Return the headline of a diagnosis, in an operator's words."""
    topics = read_topics()
    labels = [
        display.label.lower() for name in diagnosis.about
        if name in topics and (display := topics[name].display) is not None
    ]
    condition = diagnosis.condition
    return (condition.headline or condition.meaning).format(
        inputs=" or ".join(labels) or "value", sentence=diagnosis.sentence
    )


# --- causes ---------------------------------------------------------------------------------------


def _group_devices(diagnoses: Diagnoses) -> Iterator[tuple[str, StatusDiagnosis]]:
    """Yield the names of devices on one line or broker that fell silent together.

    Each comes with the diagnosis that the devices of its line have in common.
    """
    lines: dict[str, list[StatusDiagnosis]] = {}
    for diagnosis in _older_first(diagnoses):
        if diagnosis.line and diagnosis.condition.device:
            group = lines.setdefault(diagnosis.line, [])
            if len(group) == 1 and diagnosis.began - group[0].began > _TOGETHER_S:
                group.clear()
            group.append(diagnosis)
    for line, group in lines.items():
        devices = sorted({name_source(each.name).lower() for each in group})
        if len(devices) > 1:
            *others, last = devices
            lost = Diagnosis.of("devices_lost", devices=f"{', '.join(others)} and {last}")
            common = replace(
                group[0], node=f"{group[0].node.rpartition('/')[0]}/{ROLE}", part=line, role=ROLE,
                code=lost.code, sentence=lost.sentence, fault="", line="",
                level=max((each.level for each in group), key=LEVELS.index),
                about=tuple({topic: None for each in group for topic in each.about}),
                was_good=any(each.was_good for each in group),
            )
            yield from ((each.name, common) for each in group)


def find_causes(diagnoses: Diagnoses, groups: Mapping[str, StatusDiagnosis] = {}) -> dict[str, str]:
    """Return the name of the root cause of every diagnosis that follows from another diagnosis.

    An error does not follow from a warning. A state of the pump that requires a visit to the pump
    follows only from the loss of the device that would know more, because advice about another
    cause would conceal the need for this visit.

    Args:
        diagnoses: diagnoses of the graph's nodes, by status name.
        groups: the common diagnosis of the devices that fell silent together, by status name.
    """
    causes: dict[str, str] = {}

    def root_of(name: str) -> str:
        return root_of(causes[name]) if name in causes else name

    def may_follow(name: str, root: str) -> bool:
        levels = diagnoses[name].level, diagnoses[root].level
        return name != root and levels != (LEVELS[ERROR], LEVELS[WARN])

    ordered = _older_first(diagnoses)
    for diagnosis in ordered:
        senders = _find_senders(diagnosis)
        ranked = [
            (1 if groups.get(diagnosis.name) is cause else _rank(diagnosis, cause, senders), cause)
            for cause in ordered if cause is not diagnosis
        ]
        for _, cause in sorted(filter(itemgetter(0), ranked), key=itemgetter(0)):
            if may_follow(diagnosis.name, root_of(cause.name)):
                causes[diagnosis.name] = cause.name
                break
    return {name: root for name in causes if may_follow(name, root := root_of(name))}


def _older_first(diagnoses: Diagnoses) -> list[StatusDiagnosis]:
    return sorted(diagnoses.values(), key=lambda diagnosis: diagnosis.began)


def _find_senders(diagnosis: StatusDiagnosis) -> set[str]:
    """Return the roles that publish the data that a part of a node lacks."""
    if not diagnosis.part or not diagnosis.condition.no_data:
        return set()
    topics = read_topics()
    found = (topics[name].senders for name in diagnosis.about if name in topics)
    return set[str]().union(*found) - {diagnosis.role}


def _rank(diagnosis: StatusDiagnosis, cause: StatusDiagnosis, senders: set[str]) -> int:
    """Return how well one diagnosis explains another: 1 is best, and 0 is not at all."""
    part, about, own = diagnosis.part, {*diagnosis.about}, diagnosis.node == cause.node
    condition, interlock = diagnosis.condition, diagnosis.condition.interlock
    if part == PUMP and condition.needs_operator and cause.part not in condition.explained_by:
        return 0
    reports_more = cause.part in (condition.explained_by if interlock is None else interlock.parts)
    rules = (
        own and not cause.part,  # the node as a whole, for example if it is silent
        not part and not cause.part and {cause.node.rpartition("/")[2], cause.role} & about,
        cause.role in senders and not cause.part,
        cause.role in senders and cause.part != _INPUTS,
        # Of an interlock, another node may know more, such as the temperature in frost, but not
        # about the node's own device.
        reports_more and (
            own if interlock is None else part == PUMP if own else not cause.condition.device
        ),
        # A part of the pump node that stops the pump because of that input knows more about it.
        part == _INPUTS and cause.role == PUMP and cause.part != _INPUTS
        and not about.isdisjoint(cause.about),
    )
    return next((rank for rank, rule in enumerate(rules, start=1) if rule), 0)
