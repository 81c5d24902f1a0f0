"""Which graph is present, by what nodes report of themselves; and messages that are not whole."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from page_inputs import START, node
from rosbags.typesys import Stores, get_typestore

from greenroof_ros.ros.reports import Status
from greenroof_ros.watch import wire
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
    assert live.mode(0.0) == "none"
    for role in ("controller", "pump"):
        live.receive(0.0, 0.0, node(f"/{role}", role))
    say(simulated, 0.0, "controller")
    assert simulated.mode(0.0) == "none"  # it waits for its plant
    say(simulated, 0.0, "plant")
    for graph, modes in ((live, ["live", "live"]), (simulated, ["simulated", "ended"])):
        assert [graph.mode(1.0), graph.mode(60.0)] == modes
    live.receive(61.0, 0.0, node("/pump", "pump", state="ended"))
    assert live.mode(61.0) == "live"


def test_another_run_or_site_replaces_the_one_before() -> None:
    """Of which nothing is left; a run that has ended is still the same one."""
    graph = Graph()
    for at, process, state, is_new in (
        (0.0, "host 1", "ready", False), (1.0, "host 2", "ready", True),
        (2.0, "host 2", "ended", False),
    ):
        say(graph, at, "plant", state, process=process, tick=5)
        assert graph.is_of_another_run(at) == is_new
    graph.receive(3.0, 0.0, node("/onoff", "controller"))
    assert graph.is_of_another_run(3.0) and not graph.is_of_another_run(3.1)
    assert graph.nodes.keys() == {"/onoff"}
    say(graph, 60.0, "plant")
    assert graph.is_of_another_run(60.0) and graph.nodes.keys() == {"/plant"}
    assert graph.mode(90.0) == "ended"


def test_the_speed_and_the_site_file(tmp_path: Path) -> None:
    """100 ticks of 10 s in 20 s."""
    graph = Graph()
    for tick, up_s, factor in ((0, 3.0, "nan"), (100, 20.0, "50.0")):
        say(graph, 0.0, "plant", tick=tick, up_s=up_s)
        assert str(graph.factor(0.0, 10.0)) == factor
    for place, site in (
        (f"{tmp_path}", tmp_path), (f"{tmp_path}/none", None), ("/etc/passwd\0", None),
        (".", None), (7, None), ("/" + "p" * 5000, None),
    ):
        say(graph, 0.0, "plant", site=place)
        assert graph.site(0.0) == site, place


# --- hostile messages -----------------------------------------------------------------------------

_TEXTS = st.one_of(
    st.text(max_size=30),
    st.sampled_from([
        "/pump", "/pump: drive", "/mpc: inputs", "ready", "ended", "starting", "", ": ", "/",
        "<script>alert(1)</script>", "\ud800\x00\u202e", "[" * 2000, "9" * 401, "1e999", "NaN",
        '"pump"', '"controller"', "{}", "[[1]]", '["x"]', '{"/a": 1}', '{"/a": 9' + "9" * 400 + "}",
        '{"owner": "x", "since": 1e300, "until": -1e300}', '{"volume": 1e300, "delivered": -1e300}',
        "null", "true", "-Infinity", "1", "hold", "runs_on",
        "2021-07-20T05:00:30+00:00", "9999-12-31T23:59:59+00:00", "0001-01-01T00:00:00",
    ]),
)
_STATUSES = st.builds(
    Status, _TEXTS, st.sampled_from(range(4)), _TEXTS,
    st.dictionaries(
        st.sampled_from([
            "role", "process", "hold", "fault", "dose", "min_dose", "max_dose", "flow", "tick",
            "number", "code", "since", "ended", "about", "follows",
        ]) | _TEXTS, _TEXTS, max_size=8,
    ),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.lists(_STATUSES, max_size=4)), max_size=4))
def test_nothing_that_is_reported_raises(messages: list[tuple[bool, list[Status]]]) -> None:
    """And everything shown can be printed, and sent as JSON in UTF-8."""
    store, wall = GraphStore(), 0.0
    store.allow_release = True
    for are_alarms, statuses in messages:
        wall += 0.5
        store.add_statuses(wall, statuses, START)
        if are_alarms:
            store.add_alarms(wall, START, statuses)
        store.update(wall, START / 1e9)
        document = make_document(store, wall)
        json.dumps(document, allow_nan=False).encode()
        for row in document["alarms"]:
            assert (row["id"] + row["what"] + row["do"]).isprintable()
            assert len(row["what"]) <= 501


TYPES = get_typestore(Stores.ROS2_JAZZY)


def written(kind: str, *fields: Any) -> bytes:
    """Return a message of a type in CDR."""
    return bytes(TYPES.serialize_cdr(TYPES.types[kind](*fields), kind))


def array_of(count: int) -> bytes:
    layout = TYPES.types["std_msgs/msg/MultiArrayLayout"]([], 1)
    return written("std_msgs/msg/Float64MultiArray", layout, np.arange(float(count)))


@pytest.mark.parametrize(("kind", "message", "value"), [
    ("std_msgs/msg/Float64", written("std_msgs/msg/Float64", -1.5e300), "-1.5e+300"),
    ("std_msgs/msg/Float64MultiArray", array_of(3),
     "WithFront(front=array('d', [0.0]), values=array('d', [1.0, 2.0]))"),
])
def test_what_is_not_whole_is_none(kind: str, message: bytes, value: str) -> None:
    """Cut anywhere, it is None; with any bytes changed, it is a value or None, and never raises."""
    assert str(wire.read_value(kind, message)) == value
    for length in range(len(message)):
        # Padding at the end of a message may be missing.
        cut = wire.read_value(kind, message[:length])
        assert cut is None or message[length:].strip(b"\0") == b""
    random = Random(1)
    for _ in range(1000):
        changed = bytearray(message)
        changed[random.randrange(len(changed))] = random.choice((0, 1, 127, 255))
        wire.read_value(kind, bytes(changed))
        wire.read_reports(bytes(changed))
    assert wire.read_value("std_msgs/msg/Float64MultiArray", array_of(1_000_001)) is None
