"""Which graph is present, by what nodes report of themselves."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from page_inputs import START, node

from greenroof_ros.ros.reports import Status
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.graph import Graph
from greenroof_ros.watch.store import GraphStore


def say(
    graph: Graph, now: float, role: str, state: str = "ready", name: str = "", **values: Any
) -> None:
    """Have a node of a lockstep graph report its state."""
    graph.receive(now, 0.0, node(name or f"/{role}", role, state=state, run_length=100, **values))


def test_a_live_site_that_falls_silent_has_not_ended() -> None:
    """Then nobody waters the roof; a simulation with all nodes killed has ended."""
    live, simulated = Graph(), Graph()
    assert live.update(0.0) == "none"
    for role in ("controller", "pump"):
        live.receive(0.0, 0.0, node(f"/{role}", role))
    for role in ("plant", "controller"):
        say(simulated, 0.0, role)
    assert (live.update(1.0), simulated.update(1.0)) == ("live", "simulated")
    assert (live.update(60.0), simulated.update(60.0)) == ("live", "ended")
    for role in ("controller", "pump"):
        live.receive(61.0, 0.0, node(f"/{role}", role, state="ended"))
    assert (live.update(61.0), live.runs) == ("live", 0)
    say(live, 62.0, "plant")  # a run is another graph
    assert (live.update(62.0), live.update(90.0), live.runs) == ("simulated", "ended", 1)


def test_a_run_that_is_started_again_is_another_run() -> None:
    graph = Graph()
    for at, process, runs in ((0.0, "host 1", 0), (1.0, "host 2", 1), (2.0, "host 2", 1)):
        say(graph, at, "plant", process=process, tick=5)
        assert graph.update(at) == "simulated"
        assert graph.runs == runs


def test_a_role_has_the_node_that_was_there_first() -> None:
    """Who else claims it takes it when the first one has been silent; 3.5 s are too long."""
    graph = Graph()
    say(graph, 0.0, "pump")
    for number in range(100):
        say(graph, 1.0, "pump", name=f"/pump{number}", process=f"host {number}")
    for at, name in ((3.0, "/pump"), (4.0, "/pump0")):
        say(graph, at, "pump", name="/pump0", process="host 0")
        pump = graph.node("pump", at)
        assert pump is not None and pump.name == name


def test_a_namespace_has_its_own_nodes_and_a_name_is_one_that_ros_allows() -> None:
    graph = Graph("/site1")
    for name in ("/site2/pump", "pump", "/pump", "/site1/1", "/site1/x: y"):
        graph.receive(0.0, 0.0, node(name, "pump"))
        assert graph.node("pump", 0.0) is None, name
    graph.receive(0.0, 0.0, node("/site1/pump", "pump", flow=1.0))
    pump = graph.node("pump", 0.0)
    assert pump is not None
    assert (pump.name, pump.values["flow"]) == ("/site1/pump", 1.0)


def test_a_site_file_is_what_a_node_of_this_machine_reports(tmp_path: Path) -> None:
    here = f"{socket.gethostname()} 1"
    for process, place, site in (
        (here, f"{tmp_path}", tmp_path), ("another 1", f"{tmp_path}", None),
        (here, f"{tmp_path}/none", None), (here, "/etc/passwd\0", None), (here, ".", None),
        (here, 7, None), (here, "/" + "p" * 5000, None),
    ):
        graph = Graph()
        say(graph, 0.0, "controller", process=process, site=place)
        assert graph.site(0.0) == site, place


# --- hostile messages -----------------------------------------------------------------------------

_TEXTS = st.one_of(
    st.text(max_size=30),
    st.sampled_from([
        "/pump", "/pump: drive", "/mpc: inputs", "ready", "ended", "starting", "", ": ", "/",
        "<script>alert(1)</script>", "\ud800\x00\u202e", "[" * 2000, "9" * 401, "1e999", "NaN",
        '"pump"', '"controller"', "{}", "[[1]]", '["x"]', '{"/a": 1}', '{"/a": 9' + "9" * 400 + "}",
        '[{"parameter": [[]], "value": {}}]', "null", "true", "-Infinity", "1", "hold", "runs_on",
        "2021-07-20T05:00:30+00:00", "9999-12-31T23:59:59+00:00", "0001-01-01T00:00:00",
    ]),
)
_STATUSES = st.builds(
    Status, _TEXTS, st.sampled_from(range(4)), _TEXTS,
    st.dictionaries(
        st.sampled_from([
            "role", "process", "hold", "fault", "parameter_changes", "parameter_change_count",
            "dose", "min_dose", "max_dose", "number", "code", "since", "ended", "about", "follows",
        ]) | _TEXTS, _TEXTS, max_size=8,
    ),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.lists(_STATUSES, max_size=4)), max_size=4))
def test_nothing_that_is_reported_raises(
    messages: list[tuple[bool, list[Status]]]
) -> None:
    """And everything shown can be printed, and sent as JSON in UTF-8."""
    store, wall = GraphStore(), 0.0
    for are_alarms, statuses in messages:
        wall += 0.5
        store.add_statuses(wall, statuses, START)
        if are_alarms:
            store.add_alarms(wall, START, statuses)
        store.set_present(mode=store.graph.update(wall), factor=None, note="")
        document = make_document(store, wall)
        json.dumps(document, allow_nan=False).encode()
        assert not [note for note in document["notes"] if "cannot be shown" in note]
        for row in document["alarms"]:
            assert (row["id"] + row["what"] + row["do"]).isprintable()
            assert len(row["what"]) <= 501
