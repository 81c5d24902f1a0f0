"""Alarms of a graph, as shown by the page, the status command and the bridge.

:mod:`greenroof_ros.ros.alarms` decides which conditions are alarms, as it does for the
supervisor of a live site.
"""

from __future__ import annotations

from typing import Any

from greenroof_ros.base.text import clean_text
from greenroof_ros.interface.alarm import Alarm, advise
from greenroof_ros.interface.states import PUMP
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.words import name_source

_MAX_ROWS = 100
_SEVERITY = {"error": 0, "stale": 1, "warn": 2}


def list_alarms(store: GraphStore) -> list[dict[str, Any]]:
    """Return the present alarms, the most important one first.

    An alarm that follows from another one is not listed, but makes its cause as serious as itself.
    If the site's program as a whole no longer runs, that is the only alarm.
    """
    if (since := store.gone_since) is not None:
        return [{
            "id": "site", "name": "Site", "level": "error", "code": "not_heard",
            "what": "the site's program no longer runs", "do": explain_start(store),
            "since": since, "since_text": store.time_of_day(since),
        }]
    present = store.judge.present.values()
    serious = {alarm.follows or alarm.name for alarm in present if alarm.is_serious}

    def level(alarm: Alarm) -> str:
        if alarm.name not in serious:
            return "warn"
        return "error" if alarm.level == "warn" else alarm.level

    def order(alarm: Alarm) -> tuple[bool, int, int, float]:
        # The pump node comes first (without it, no one knows whether the pump runs), then its
        # state; other devices come last.
        rank = {(PUMP, ""): 0, (PUMP, PUMP): 1}.get((alarm.role, alarm.part), 2)
        return not alarm.role, rank, _SEVERITY[level(alarm)], -alarm.since

    return [
        {
            "id": alarm.name, "name": name_source(alarm.name), "level": level(alarm),
            "code": alarm.code, "what": clean_text(alarm.sentence),
            "do": advise(alarm.code, alarm.role, alarm.node),
            "since": alarm.since, "since_text": store.time_of_day(alarm.since),
        }
        for alarm in sorted((alarm for alarm in present if not alarm.follows), key=order)
    ][:_MAX_ROWS]


def explain_start(store: GraphStore) -> str:
    """Explain how to start the program of a live site that no longer runs."""
    space = f" --namespace {store.namespace.strip('/')}" if store.namespace else ""
    return (
        "Start it with: sudo systemctl start greenroof, if it is a service, or else with greenroof "
        f"live{space} and its options. If the pump is still turning, stop it at its drive's panel "
        "or at the main switch."
    )
