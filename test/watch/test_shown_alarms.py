"""Alarms and events from statuses on /diagnostics, from nodes and from hostile senders."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from page_inputs import ERROR, HELD, HOLD, OK, STALE, WARN, node

from greenroof_ros.interface.conditions import read_conditions
from greenroof_ros.watch.alarms import list_alarms
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.wire import WireStatus

Steps = list[tuple[float, list[WireStatus]]]


def pump(*parts: tuple[Any, ...], **said: Any) -> list[WireStatus]:
    return node("/pump", "pump", *parts, **said)


def mpc(*parts: tuple[Any, ...], **said: Any) -> list[WireStatus]:
    return node("/mpc", "controller", *parts, **said)


def heard(*steps: tuple[float, list[WireStatus]], namespace: str = "") -> GraphStore:
    """Return a store after messages, each with its time."""
    alarms = GraphStore(namespace)
    for at, statuses in steps:
        receive(alarms, at, statuses)
    return alarms


def receive(alarms: GraphStore, at: float, statuses: list[WireStatus]) -> None:
    """Receive a message; the graph's time is that of the steady clock."""
    alarms.update(at, at)
    alarms.add_statuses(at, statuses)


def advice(alarms: GraphStore) -> str:
    text: str = make_document(alarms, alarms.wall)["advice"]
    return text


def each_quarter(seconds: float, *statuses: list[WireStatus], begin: float = 0.0) -> Steps:
    """Return messages four times a second for this long (s), with these statuses in turn."""
    return [(begin + at / 4, statuses[at % len(statuses)]) for at in range(round(4 * seconds))]


def rows(alarms: GraphStore) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in list_alarms(alarms)}


def present(alarms: GraphStore) -> list[str]:
    return list(rows(alarms))


def happened(alarms: GraphStore) -> list[str]:
    """Return the events, the oldest first."""
    return [what for _, what in alarms.events]


WRONG, RIGHT = ("drive", ERROR, "no connection", "drive_lost"), ("drive", OK, "connected")


BAD = ("x", ERROR, "bad")
TWICE = [pump(process=f"host {number}") for number in (0, 1)]
STARTING = mpc(state="starting", waiting=["roof_sensor", "weather"])
_NAMES = "two processes report under this name: host 0 and host 1"


@pytest.mark.parametrize(("steps", "alarms_then", "events"), [
    # The end of a run or of a node is not an alarm.
    ([(0.0, pump(BAD)), (0.5, pump(BAD, state="finished")), (1.0, pump(BAD, state="ended")),
      (60.0, [])], {}, []),
    ([(0.0, pump(BAD)), (0.5, pump(BAD, state="ended")), (60.0, [])], {}, ["Pump ended"]),
    # A restart is an event; alarms of the previous process are over.
    ([(0.0, pump(BAD)), (1.0, pump(process="host 2", state="starting")),
      (2.0, pump(process="host 2"))], {}, ["Pump was restarted"]),
    # Two processes with one name: not a restart each time, but an alarm while both report.
    (each_quarter(5, *TWICE), {"/pump": ("error", _NAMES)},
     ["Pump was restarted", f"Pump: {_NAMES}"]),
    ([*each_quarter(5, *TWICE), *each_quarter(5, TWICE[1], begin=5.0)], {},
     ["Pump was restarted", f"Pump: {_NAMES}", f"Over: Pump: {_NAMES}"]),
])
def test_what_is_wrong_with_a_node(
    steps: Steps, alarms_then: dict[str, tuple[str, str]], events: list[str]
) -> None:
    """Alarms of the present, and events, each with its end."""
    alarms = heard(*steps)
    listed = rows(alarms)
    assert {name: (row["level"], row["what"]) for name, row in listed.items()} == alarms_then
    bad = ["Pump: bad", "Over: Pump: bad"] if BAD[0] in str(steps[0]) else []
    assert sorted(happened(alarms)) == sorted([*bad, *events])
    assert {row["code"] for row in listed.values()} <= read_conditions().keys()


def test_what_may_still_come_is_a_note_while_a_site_starts() -> None:
    alarms = heard(*each_quarter(5, pump(WRONG, up_s=9)))
    assert not list_alarms(alarms) and not happened(alarms)
    notes = make_document(alarms, 5.0)["notes"]
    assert notes[:2] == ["The site is starting. Still missing:", "Pump: no connection."]


def test_events_of_parameters_and_warnings() -> None:
    """A node reports the newest changes and the number of all; the page counts what it missed.

    Each new warning is an event, although a warning that has gone makes room for it.
    """
    alarms = GraphStore()
    changes = [{"parameter": "w", "before": 1, "value": number} for number in range(25)]
    for known in (1, 2, 2, 5, 11, 25):
        newest = changes[max(0, known - 10):known]
        receive(alarms, 0.0, mpc(parameter_changes=newest, parameter_change_count=known))
    assert happened(alarms) == [
        *(f"Mpc: w was changed from 1 to {number}" for number in range(1, 11)),
        "Mpc: 4 earlier changes of parameters are not listed",
        *(f"Mpc: w was changed from 1 to {number}" for number in range(15, 25)),
    ]
    alarms = heard(*((0.0, mpc(warnings=said)) for said in ([], ["a"], ["a"], ["b"], [], ["b"])))
    assert happened(alarms) == ["Mpc warns: a", "Mpc warns: b", "Mpc warns: b"]


def test_events_of_a_hold_and_a_fault() -> None:
    alarms = GraphStore()
    overheat = "the drive reports: overheat"
    other = HOLD | {"owner": "the page"}
    for hold, fault in (
        (None, ""), (HOLD, ""), (HOLD, ""), (other, ""), (None, ""), (None, overheat), (None, ""),
    ):
        receive(alarms, 5.0, pump(hold=hold, fault=fault))
    assert happened(alarms) == [
        "The pump is held off by the operator", "The pump is held off by the page",
        "The hold has ended",
        "The pump is off until the fault is reset: the drive reports: overheat",
        "The fault was reset",
    ]
    for number in range(100):
        alarms.add_event(str(number))
    assert len(alarms.events) == 50
    assert alarms.events[-1] == (5.0, "99")


@pytest.mark.parametrize(("code", "said", "advised"), [
    ("stands_unknown", {"stands": False, "speed": None}, "Go and see"),
    ("drive_fault", {"stands": False, "speed": None}, "clear the fault"),
    ("hold", {"stands": True, "hold": HOLD}, "greenroof release"),
    ("stop_not_followed", {"stands": False, "speed": 0.8, "hold": HOLD}, "at its drive's panel"),
])
def test_a_state_of_the_pump_that_its_cause_does_not_tell(
    code: str, said: dict[str, Any], advised: str
) -> None:
    """Its own advice comes first: the drive's alarm must not hide a reset, a release or a check."""
    alarms = heard((0.0, pump(WRONG, ("pump", ERROR, "why", code), **said)))
    assert present(alarms) == ["/pump: pump", "/pump: drive"]
    assert advised in advice(alarms)
    alarms.update(3.6, 3.6)  # the last report of a node that is silent now
    assert "The pump's state is unknown: the pump may be running" in advice(alarms)


def test_the_order_of_alarms() -> None:
    """The pump's state, then errors, stale parts and warnings; other devices last."""
    other = WireStatus("/camera", ERROR, "no picture")
    alarms = heard((0.0, [other, *mpc()]), (4.0, [
        other,
        *node("/weather", "weather", ("rain gauge", WARN, "/gauge/precipitation is older")),
        *node("/recorder", "recorder", ("recording", ERROR, "nothing is recorded: full")),
        *pump(("limits", WARN, "5 m3 are outstanding"),
              ("pump", WARN, f"held: {HELD}", "hold"), hold=HOLD, stands=True),
    ]))
    assert present(alarms) == [
        "/pump: pump", "/recorder: recording", "/mpc", "/weather: rain gauge", "/pump: limits",
        "/camera",
    ]
    assert "greenroof release" in advice(alarms)


def test_advice_is_on_what_is_new() -> None:
    """Among equals, the newest is first."""
    file = ("drive file", WARN, "have not been verified", "drive_file_unverified")
    blind = ("delivery", WARN, "blind for 3 s", "delivery_blind")
    alarms = heard((0.0, pump(file)), (0.1, pump(file, blind)))
    assert present(alarms) == ["/pump: delivery", "/pump: drive file"]
    assert advice(alarms) == rows(alarms)["/pump: delivery"]["do"]


def test_a_namespace_has_its_own_alarms() -> None:
    """Another graph's nodes are other devices, and never describe this graph's pump.

    Their end is no alarm, but that they fall silent is one.
    """
    alarms = heard((0.0, [
        *node("/site2/pump", "pump", ("pump", ERROR, "fault: burst"), flow=2.0, hold=HOLD),
        *node("/site1/pump", "pump", ("pump", WARN, "held", "hold"), flow=1.0, hold=HOLD,
              stands=True),
    ]), namespace="/site1")
    there = alarms.graph.node("pump")
    assert there is not None
    assert (there.name, there.values["flow"], there.process) == ("/site1/pump", 1.0, "host 1")
    assert present(alarms) == ["/site1/pump: pump", "/site2/pump: pump"]
    assert "greenroof release --namespace site1" in advice(alarms)
    there = [node(f"/site2/{name}", name) for name in ("mpc", "pump")]
    alarms = heard(*each_quarter(2, there[0] + there[1]), (
        2.0, node("/site2/mpc", "mpc", state="ended")
    ), namespace="/site1")
    alarms.update(7.1, 7.1)
    assert present(alarms) == ["/site2/pump"]


def test_other_devices() -> None:
    """They have 5 s; a device received only once is not missed; they are never errors."""
    once, often = WireStatus("/camera", OK, "fine"), WireStatus("disk usage", ERROR, "99 %")
    alarms = heard((0.0, [once, often]))
    assert present(alarms) == ["disk usage"]
    alarms.set_present(mode="live", factor=None, note="")
    assert make_document(alarms, 0.0)["tiles"]["summary"]["word"] == "1 warning."
    receive(alarms, 1.0, [often])
    for wall, what in ((5.9, "99 %"), (6.1, "no message for 5 s")):
        alarms.update(wall, wall)
        assert [(row["what"], row["level"]) for row in list_alarms(alarms)] == [(what, "warn")]


# --- hostile messages -----------------------------------------------------------------------------

_TEXTS = st.one_of(
    st.text(max_size=30),
    st.sampled_from([
        "/pump", "/pump: drive", "/mpc: inputs", "ready", "ended", "starting", "", ": ", "/",
        "<script>alert(1)</script>", "\ud800\x00\u202e", "[" * 2000, "9" * 401, "1e999", "NaN",
        '"pump"', '"controller"', "{}", "[[1]]", '["x"]', '{"/a": 1}', '{"/a": 9' + "9" * 400 + "}",
        '[{"parameter": [[]], "value": {}}]', "null", "true", "-Infinity",
    ]),
)
_STATUSES = st.builds(
    WireStatus, _TEXTS, st.sampled_from([OK, WARN, ERROR, STALE]), _TEXTS,
    st.dictionaries(
        st.sampled_from([
            "role", "refused", "hold", "fault", "warnings", "waiting", "parameter_changes",
            "failure", "parameter_change_count",
        ]) | _TEXTS, _TEXTS, max_size=8,
    ),
)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.sampled_from([0.0, 0.1, 3.0]), st.lists(_STATUSES, max_size=4)),
                max_size=4))
def test_nothing_that_is_reported_raises(messages: list[tuple[float, list[WireStatus]]]) -> None:
    """And everything shown can be printed, and sent as JSON in UTF-8."""
    alarms, wall = GraphStore(), 0.0
    for passed, statuses in messages:
        wall += passed
        receive(alarms, wall, statuses)
        alarms.update(wall, wall)
        shown = [make_document(alarms, wall), alarms.graph.mode(wall), alarms.graph.two_pumps(wall)]
        json.dumps(shown, allow_nan=False)
        for row in list_alarms(alarms):
            row["what"].encode()
            assert row["what"].isprintable()
            assert row["id"].isprintable()
            assert len(row["what"]) <= 501


def test_a_watcher_that_stood_still_takes_no_one_for_silent() -> None:
    alarms = heard((0.0, [*pump(RIGHT), *mpc()]))
    alarms.graph.excuse_silence(6.0)
    receive(alarms, 6.0, mpc())  # the first of the waiting messages
    assert list_alarms(alarms) == []
    alarms.update(10.0, 10.0)
    assert {row["id"] for row in list_alarms(alarms)} == {"/pump", "/mpc"}


def test_a_stop_hides_no_other_alarm() -> None:
    hold = ("pump", WARN, f"held: {HELD}", "hold")
    wrong = "sensor", ERROR, "wrong", "sensor_lost", {"age_s": "3.0"}
    alarms = heard((0.0, pump(hold, wrong, hold=HOLD, stands=True)))
    do = read_conditions()["sensor_lost"].advise("/pump", "pump")
    assert advice(alarms) == (
        f"The pump is held off by the operator, until someone releases it. {do} If it may run "
        "again, release it with: greenroof release"
    )


def test_what_follows_is_not_listed_but_counts() -> None:
    """A dead sensor is one alarm, though the pump node warns of its level, too."""
    sensor = node("/roof_sensor", "roof_sensor", ("sensor", WARN, "no answer", "sensor_lost",
                                                  {"age_s": "9.0"}))
    level = ("levels", ERROR, "/roof/level is old", "input_silent",
             {"topics": "/roof/level", "age_s": "9.0"})
    alarms = heard((0.0, sensor), (0.1, sensor + pump(level)))
    both = {name: alarm.follows for name, alarm in alarms.judge.present.items()}
    listed = [(row["id"], row["level"]) for row in list_alarms(alarms)]
    assert both["/pump: levels"] in ("", "/roof_sensor: sensor")
    assert len(listed) == sum(not cause for cause in both.values())
    assert "error" in [level for _, level in listed]
