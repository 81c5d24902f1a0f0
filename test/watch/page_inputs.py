"""Input for the tests of the page: nodes' messages on /diagnostics, values, and a store."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from paper import PAPER_SITE

from greenroof_ros.ros.reports import Status
from greenroof_ros.site.site import Site
from greenroof_ros.watch.store import GraphStore

OK, WARN, ERROR, STALE = range(4)
SECOND = 10**9
START = 1_626_757_200 * SECOND  # 2021-07-20 05:00 UTC, a multiple of 20 s
HELD = "a hold by the operator"
HOLD = {"owner": "the operator", "reason": "", "until": None, "sentence": HELD}


def node(
    name: str, role: str, *, process: str = "host 1", state: str = "ready", **values: Any
) -> list[Status]:
    """Return what a node reports of itself on /diagnostics."""
    pairs = {"role": role, "process": process, **values}
    return [Status(name, OK, state, {key: json.dumps(value) for key, value in pairs.items()})]


def alarm(
    name: str, role: str, code: str, sentence: str, level: int = ERROR, *,
    since: str = "2021-07-20T05:00:30+00:00", **values: str,
) -> Status:
    """Return the status of an alarm on /alarms; other devices have no role, and only warn."""
    pairs = {
        "number": "1", "role": role, "code": code, "since": since,
        "serious": "true" if role and level != WARN else "false", **values,
    }
    return Status(name, level, sentence, {key: text for key, text in pairs.items() if text})


def pump_report(text: str) -> dict[str, str]:
    """Return the values with which a pump node reports a state and its reason."""
    state, _, why = text.partition(": ")
    return {"pump_state": state, "pump_why": why}


def store(
    mode: str = "simulated", site: Site = PAPER_SITE, *alarms: Status, wall: float = 100.0
) -> GraphStore:
    """Return a store that knows only the site of its graph, and its alarms at a time."""
    graph = GraphStore()
    graph.set_site(site)
    graph.set_present(mode=mode, factor=30.0, note="")
    graph.update(wall)
    graph.add_alarms(wall, START + 60 * SECOND, alarms)
    return graph


def add_series(graph: GraphStore, topic: str, times_ns: Any, values: Any) -> None:
    """Add values of a topic, each with its time; one value may be for all times."""
    times = np.asarray(times_ns, np.int64)
    for time_ns, value in zip(times.tolist(), np.broadcast_to(values, times.shape).tolist(),
                              strict=True):
        graph.add(topic, time_ns, value)


def add_values(
    graph: GraphStore, first: int, last: int, values: Mapping[str, float], every: int = 1
) -> None:
    """Add each topic's value from one second to another, the last one not included."""
    for topic, value in values.items():
        add_series(graph, topic, START + SECOND * np.arange(first, last, every), value)


def fail(*_: Any, **__: Any) -> Any:
    """Stand for a part of the package with a bug."""
    raise ZeroDivisionError("a bug")
