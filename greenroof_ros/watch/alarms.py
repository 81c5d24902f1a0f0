"""Alarms and events of a graph, as shown by the page, the status command and the bridge.

:mod:`greenroof_ros.graph.alarms` decides which conditions are alarms, as it does for the
supervisor of a live site.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from greenroof_ros.base.text import clean_text
from greenroof_ros.interface.alarm import Alarm
from greenroof_ros.interface.states import PUMP
from greenroof_ros.watch.store import GraphStore

_MAX_ROWS = 100
_SEVERITY = {"error": 0, "stale": 1, "warn": 2}


def list_alarms(store: GraphStore) -> list[dict[str, Any]]:
    """Return the alarms: causes, then their consequences, other devices and past alarms.

    Within each group, the alarms of the pump node and of the pump's state come first. The others
    are sorted by severity (worst first) and time (newest first), since operators already know about
    older alarms.

    ``plain`` states whether the alarm's code has an advice text, ``do``. If so, the page shows
    ``do`` more prominently than ``what``, which is the node's own wording.
    """

    def order(alarm: Alarm) -> tuple[bool, bool, int, int, float]:
        # The pump node comes first (without it, no one knows whether the pump runs), then its
        # state.
        rank = {(PUMP, ""): 0, (PUMP, PUMP): 1}.get((alarm.role, alarm.part), 2)
        return (
            not alarm.role, bool(alarm.follows), rank, _SEVERITY[alarm.level], -alarm.since,
        )

    return [
        {
            "id": alarm.name, "level": alarm.level, "what": clean_text(alarm.sentence),
            "code": alarm.code, "do": alarm.advice, "plain": alarm.is_known, "since": alarm.since,
            "since_text": store.time_of_day(alarm.since),
            "over": alarm.ended,
            "over_text": "" if alarm.ended is None else store.time_of_day(alarm.ended),
            "follows": alarm.follows or None,
        }
        for alarm in [
            *sorted(store.judge.present.values(), key=order), *store.judge.over
        ][:_MAX_ROWS]
    ]


def list_events(store: GraphStore) -> list[dict[str, Any]]:
    """Return the events, newest first."""
    return [
        {"at": at, "what": what, "at_text": store.time_of_day(at)}
        for at, what in reversed(store.events)
    ]


def count_alarms(store: GraphStore) -> tuple[int, int, int]:
    """Return the numbers of causes at alarm level, causes at warning level, and consequences.

    The level of a cause is the most severe of the levels of the cause itself and of its
    consequences.
    """
    present = store.judge.present.values()
    following = sum(bool(alarm.follows) for alarm in present)
    serious = {alarm.follows or alarm.name for alarm in present if alarm.is_serious}
    return len(serious), len(present) - following - len(serious), following


def choose_advice(present: Sequence[Mapping[str, Any]]) -> str:
    """Return the advice for the cause of the first alarm.

    If this cause is only a hold, which is intentional, the advice for a second alarm is added.

    Args:
        present: the current alarms as returned by :func:`list_alarms`; at least one.
    """
    first = next((row for row in present if row["id"] == present[0]["follows"]), present[0])
    second = next((
        row["do"] for row in present
        if row is not first and row["level"] != "warn" and not row["follows"]
    ), "")
    more = f" In addition: {second}" if first["code"] == "hold" and second else ""
    return f"{first['do']}{more}"
