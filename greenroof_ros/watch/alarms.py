"""Alarms and events of a graph, as page, status and bridge show them.

:mod:`greenroof_ros.common.alarms` judges what is an alarm, also for the supervisor of a live site.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from greenroof_ros.common.alarms import Alarm, Judge
from greenroof_ros.common.states import PUMP
from greenroof_ros.watch.registry import Registry
from greenroof_ros.watch.wire import WireStatus
from greenroof_ros.watch.words import clean_text

_MAX_ROWS, _MAX_EVENTS = 100, 50
_SEVERITY = {"error": 0, "stale": 1, "warn": 2}


class Alarms:
    """The alarms and events of one graph.

    Times called ``wall`` are of the steady clock (s); ``now`` is the graph's time (s since 1970).

    Attributes:
        registry: what each node reports.
        judge: what is wrong now, and what is only missing while the site starts.
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
        self.judge = Judge()
        self._events: deque[tuple[float, str]] = deque(maxlen=_MAX_EVENTS)
        # By name: number, level and subjects of the alarm that someone acknowledged.
        self._acknowledged: dict[str, tuple[int, str, tuple[str, ...]]] = {}

    def receive(self, wall: float, now: float, statuses: Sequence[WireStatus], **more: Any) -> None:
        """Receive the statuses of one or more messages; ``more`` goes to the registry."""
        self._now = now
        self.registry.receive(wall, statuses, now=now, **more)
        self.update(wall, now)

    def update(self, wall: float, now: float) -> None:
        """Update the alarms: called with each message, and about twice a second."""
        diagnoses, starting = self.registry.diagnoses(wall), self.registry.starting(wall)
        ended: dict[str, Alarm] = {}
        for what, alarm in self.judge.update(wall, now, diagnoses, starting=starting):
            if what == "ends":
                ended[alarm.name] = alarm
            elif what == "begins" and (before := ended.get(alarm.name)):
                self._on_event(f"{alarm.name}: {alarm.sentence}; before: {before.sentence}")

    # --- reports --------------------------------------------------------------------------------

    def rows(self) -> list[dict[str, Any]]:
        """Return the alarms: causes, what follows from them, other devices, and last what is over.

        Within each group the order is: the pump's state, alarms that are not acknowledged, the
        worst, the newest. Older and acknowledged alarms are already known.
        """

        def order(alarm: Alarm) -> tuple[bool, bool, int, bool, int, float]:
            # First the pump node (without it no one knows whether the pump runs), then its state.
            rank = {(PUMP, ""): 0, (PUMP, PUMP): 1}.get((alarm.role, alarm.part), 2)
            return (
                not alarm.role, bool(alarm.follows), rank, self._is_acknowledged(alarm),
                _SEVERITY[alarm.level], -alarm.since,
            )

        alarms = [*sorted(self.judge.present.values(), key=order), *self.judge.over]
        return [self._row(alarm) for alarm in alarms[:_MAX_ROWS]]

    def _row(self, alarm: Alarm) -> dict[str, Any]:
        """Return an alarm as a row of the document, without its times in words.

        ``plain`` is whether ``do`` is written for its code: an operator then reads ``do`` instead
        of the node's own words in ``what``.
        """
        return {
            "id": alarm.name, "level": alarm.level, "what": clean_text(alarm.sentence),
            "code": alarm.code, "do": alarm.advice, "plain": alarm.is_known, "since": alarm.since,
            "acknowledged": self._is_acknowledged(alarm), "over": alarm.ended,
            "follows": alarm.follows or None,
        }

    def events(self) -> list[dict[str, Any]]:
        """Return the events, the newest first."""
        return [{"at": at, "what": what} for at, what in reversed(self._events)]

    def _on_event(self, text: str) -> None:
        self.add_event(self._now, text)

    def add_event(self, now: float, text: str) -> None:
        """Add an event."""
        self._events.append((now, clean_text(text)))

    def acknowledge(self, alarm_id: str) -> bool:
        """Acknowledge an alarm, until it changes; False if there is no such alarm."""
        alarm = self.judge.alarms.get(alarm_id)
        if alarm is not None:
            self._acknowledged = {
                name: known for name, known in self._acknowledged.items()
                if name in self.judge.alarms
            } | {alarm_id: (alarm.number, alarm.level, alarm.about)}
        return alarm is not None

    def _is_acknowledged(self, alarm: Alarm) -> bool:
        """Return whether it is acknowledged: as bad as it is now, and about the same."""
        return self._acknowledged.get(alarm.name) == (alarm.number, alarm.level, alarm.about)

    def counts(self) -> tuple[int, int, int]:
        """Return how many causes are alarms, how many are warnings, and how many alarms follow.

        A cause counts by the worst of itself and what follows from it.
        """
        present = self.judge.present.values()
        following = sum(bool(alarm.follows) for alarm in present)
        serious = {alarm.follows or alarm.name for alarm in present if alarm.is_serious}
        return len(serious), len(present) - following - len(serious), following

    def advice(self) -> str:
        """Return what to do now: about the cause of the first alarm that is not acknowledged.

        If it is only a hold, that is intended: what to do about a second alarm is added.
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
