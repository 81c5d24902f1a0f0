"""Which graph is present, by what nodes report of themselves; and messages that are not whole."""

from __future__ import annotations

import json
from typing import Any

from hostile_reports import STATUSES
from hypothesis import given, settings
from hypothesis import strategies as st
from page_inputs import START, node

from greenroof_ros.ros.reports import Status
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.store import GraphStore


def say(
    graph: GraphStore, now: float, role: str, state: str = "ready", *, run: bool = True,
    **values: Any,
) -> str:
    """Have a node report its state, in a run or at a live site; return the kind of graph."""
    more = {"run_length": 100} if run else {}
    graph.add_statuses(now, 0, node(f"/{role}", role, state=state, **more, **values))
    return mode(graph, now)


def mode(graph: GraphStore, now: float) -> str:
    graph.update(now, 0.0)
    return graph.mode


def test_a_live_site_that_falls_silent_has_not_ended() -> None:
    """Then nobody waters the roof; a simulation with all nodes killed has ended."""
    live, simulated = GraphStore(), GraphStore()
    assert mode(live, 0.0) == "none"
    assert say(simulated, 0.0, "controller") == "none"  # it waits for its plant
    assert (say(simulated, 0.0, "plant"), mode(simulated, 60.0)) == ("simulated", "ended")
    for role in ("controller", "pump"):
        assert say(live, 0.0, role, run=False) == mode(live, 60.0) == "live"
    assert say(live, 61.0, "pump", "ended", run=False) == "live"


def test_another_run_or_site_replaces_the_one_before() -> None:
    """Of which nothing is left; a run that has ended is still the same one."""
    graph = GraphStore()

    def is_new() -> bool:
        before = graph.newest.pop("/roof/level", None) is None
        graph.add("/roof/level", START, 0.04)
        return before

    for at, process, state, replaces in (
        (0.0, "host 1", "ready", True), (1.0, "host 2", "ready", True),
        (2.0, "host 2", "ended", False),
    ):
        say(graph, at, "plant", state, process=process, tick=5)
        assert is_new() == replaces
    assert say(graph, 3.0, "controller", run=False) == "live"
    assert is_new() and mode(graph, 3.1) == "live" and not is_new()
    assert graph.nodes.keys() == {"/controller"}
    assert say(graph, 60.0, "plant") == "simulated"
    assert is_new() and graph.nodes.keys() == {"/plant"}


# --- hostile messages -----------------------------------------------------------------------------

@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), STATUSES), max_size=4))
def test_nothing_that_is_reported_raises_or_switches_the_stop_off(
    messages: list[tuple[bool, list[Status]]]
) -> None:
    """And everything shown can be printed, and sent as JSON in UTF-8."""
    store, steady = GraphStore(), 0.0
    store.allow_release, store.offered = True, {"/pump": 1}
    for are_alarms, statuses in messages:
        steady += 0.5
        store.add_statuses(steady, START, statuses)
        if are_alarms:
            store.add_alarms(steady, statuses)
        store.update(steady, START / 1e9)
        document = make_document(store, steady)
        json.dumps(document, allow_nan=False).encode()
        assert document["stop"]["possible"] and "stop" in document["stop"]["actions"]
        for row in document["alarms"]:
            assert (row["id"] + row["what"] + row["do"]).isprintable()
            assert len(row["what"]) <= 501


