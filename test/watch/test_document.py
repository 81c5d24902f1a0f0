"""The store and the document: what an operator is shown of values and of what nodes report."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from page_inputs import (
    HELD,
    HOLD,
    SECOND,
    START,
    STATUSES,
    add_values,
    alarm,
    node,
    pump,
    store,
    valve,
)
from paper import PAPER_SITE

from greenroof_ros.interface.alarm import OK, WARN
from greenroof_ros.interface.conditions import read_conditions
from greenroof_ros.ros.reports import Status
from greenroof_ros.watch import document
from greenroof_ros.watch.document import make_document, make_series
from greenroof_ros.watch.store import GraphStore

SITE = replace(PAPER_SITE, utc_offset=-5.0)  # START is 00:00 there
QUIET = {
    "/roof/level": 0.0457, "/cistern/level": 2.5, "/pump/command": 0.0, "/pump/flow": 0.0,
    "/weather/precipitation": 0.0, "/weather/frost": 0.0,
}


@pytest.fixture(autouse=True)
def short_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shell finds the program, and the domain is 0."""
    monkeypatch.setattr(document, "which", lambda _: "/bin/greenroof")
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")


def watched(mode: str = "simulated", *alarms: Status, **values: float) -> GraphStore:
    """Return a store after a minute with these values and alarms; ``_`` stands for ``/``."""
    given = {**QUIET, **{f"/{name.replace('_', '/')}": value for name, value in values.items()}}
    graph = store(mode, SITE, *alarms)
    add_values(graph, 0, 61, given)
    return graph


def shown(graph: GraphStore, steady: float = 100.0) -> dict[str, Any]:
    """Return the document as a browser reads it."""
    document: dict[str, Any] = json.loads(json.dumps(make_document(graph, steady), allow_nan=False))
    return document


def codes(document: dict[str, Any]) -> dict[str, Any]:
    """Return each tile's value and state, and the codes of summary and stop."""
    tiles, stop = document["tiles"], document["stop"]
    return {
        **{name: (tile["value"], tile["state"]) for name, tile in tiles.items() if "state" in tile},
        "level": tiles["summary"]["level"], "possible": stop["possible"],
        "stopped": stop["stopped"], "held": bool(stop["hold"]), "actions": {*stop["actions"]},
    }


def tile_of(graph: GraphStore, name: str, steady: float = 100.0) -> Any:
    return codes(shown(graph, steady))[name]


def pump_says(graph: GraphStore, steady: float, text: str, **said: Any) -> None:
    """Have the pump node report its state; it offers its service for a hold."""
    graph.offered = {"/pump": 1}
    graph.add_statuses(steady, 0, pump(text, **said))


# --- what is shown of each state ------------------------------------------------------------------

DEAD = alarm("/roof_sensor: sensor", "roof_sensor", "sensor_lost", "no answer")
UNREAD = alarm("/pump: levels", "pump", "input_silent", "the level is old", about="/roof/level")
TURNS = alarm("/pump: pump", "pump", "stop_not_followed", "held; the pump is still turning", WARN)
LOST = alarm("/pump: pump", "pump", "standstill_unknown", "off: no connection to the drive")
FOLLOWS = LOST._replace(values={**LOST.values, "follows": "/alarms: broker"})
BROKER = alarm("/alarms: broker", "alarms", "devices_lost", "relay and sensor fell silent together")
WELDED = alarm("/pump: pump", "pump", "runs_on", "the flow meter has shown a flow")
TURNING, AT_REST = {"at_rest": False, "speed": None}, {"at_rest": True, "speed": 0.0}
OPEN = {"at_rest": False, "speed": 1.0, "position": 1, "commanded": True, "flow": 1e-3}
BLIND = OPEN | {"position": None, "flow": None, "open_until": START / SECOND + 1800}
VALVE = {"level": "error", "valve": ("may be open", "alarm")}
# What a person at the pump must do.
RELEASE, PANEL, SEE, SWITCH_OFF = (
    "If the pump may run again, release it with", "stop it at its drive's panel",
    "Go and see whether the pump is stopped. ", "main switch. Find",
)
MAY_RUN = {"pump": ("may be running", "alarm"), "level": "error", "actions": {"stop"}}
# Values, alarms, what pump and valve report; what is shown, in codes; and in the advice.
STATES: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    # The roof's band is 5 % of the target of 45.7 mm.
    ({"roof_level": 0.04566}, {"roof": ("45.7 mm", "good"), "possible": False}, ""),
    ({"roof_level": math.nan}, {"roof": ("unknown", "unknown")}, ""),
    ({}, {"cistern": ("2500 mm", "good"), "temperature": ("above 0 °C", "good")}, ""),
    ({"cistern_level": 0.75}, {"cistern": ("750 mm", "low")}, ""),
    ({"cistern_level": 3.01}, {"cistern": ("3010 mm", "high")}, ""),
    ({"weather_frost": 1.0, "gauge_temperature": -1.5}, {"temperature": ("-1.5 °C", "cold")}, ""),
    ({"alarms": [UNREAD]}, {"roof": ("45.7 mm", "doubtful"), "cistern": ("2500 mm", "good")}, ""),
    # A pump is stopped if it is held and at rest, not if the stop is only accepted.
    ({"pump": ("running: as commanded", {"at_rest": False})},
     {"possible": True, "stopped": False, "held": False}, ""),
    ({"pump": (f"held: {HELD}; there is frost", AT_REST | {"hold": HOLD})},
     {"stopped": True, "held": True}, RELEASE),
    ({"alarms": [TURNS], "pump": (f"held: {HELD}", {"at_rest": False, "hold": HOLD})},
     {"stopped": False, "held": True}, PANEL),
    ({"pump": ("off: of another version", AT_REST | {"hold": 7})},
     {"stopped": False, "held": False}, ""),
    # A pump that may turn is an alarm, and is not released; nor is one whose node is gone.
    *(({"alarms": alarms, "pump": ("off: why", {**TURNING, "flow": flow, "hold": HOLD})},
       MAY_RUN, SEE)
      for alarms in ([], [LOST], [LOST, BROKER], [FOLLOWS, BROKER]) for flow in (None, 1e-3)),
    # Also without a flow meter, by the levels alone.
    *(({"alarms": [WELDED], "pump": ("held: why", {**AT_REST, "flow": flow, "hold": HOLD})},
       MAY_RUN, SWITCH_OFF) for flow in (1e-3, 0.0)),
    ({"gone": True, "pump": ("running: why", {"at_rest": False, "hold": HOLD})},
     {"held": False, "stopped": False, "pump": ("may be running", "alarm")}, ""),
    # The drive's own timeout. Your own driver. As intended.
    ({"pump": ("off: why", {"at_rest": True, "speed": None, "flow": None})},
     {"pump": ("off", "off"), "level": "ok"}, ""),
    ({"pump": ("running: why", {"at_rest": None, "flow": 1e-3})},
     {"pump": ("running", "running"), "level": "ok"}, ""),
    ({"pump": ("held: quiet hours are in force", {"at_rest": True, "flow": 0.0})},
     {"pump": ("off", "off"), "level": "ok"}, ""),
    # A valve that may be open unnoticed is an alarm.
    ({"valve": ("open: as commanded", OPEN)}, {"valve": ("open", "open"), "level": "ok"}, ""),
    ({"valve": ("opening: by MQTT", BLIND)}, {"valve": ("opening", "opening"), "level": "ok"}, ""),
    ({"valve": ("closed: dry", {}), "gone": True}, {"valve": ("unknown", "unknown")}, ""),
    ({"valve": ("open: as commanded", OPEN), "gone": True}, VALVE, ""),
    ({"valve": ("held: lost", TURNING)}, VALVE, ""),
]


@pytest.mark.parametrize(("given", "expected", "advice"), STATES)
def test_what_is_shown_of_a_state(
    given: dict[str, Any], expected: dict[str, Any], advice: str
) -> None:
    """``gone``: the nodes that report have fallen silent."""
    given = dict(given)
    alarms, gone = given.pop("alarms", []), given.pop("gone", False)
    text, said = given.pop("pump", ("off: why" if "valve" in given else "", {}))
    valve_text, valve_said = given.pop("valve", ("", {}))
    graph = watched("live", *alarms, **given)
    graph.allow_release = True
    if text:
        pump_says(graph, 100.0, text, **said)
    if valve_text:
        graph.add_statuses(100.0, 0, valve(valve_text, **valve_said))
    document = shown(graph, 104.0 if gone else 100.0)
    found = codes(document)
    assert {key: found[key] for key in expected} == expected
    assert advice in document["advice"]
    shared = read_conditions()["devices_lost"].advice
    assert (shared in document["advice"]) == (BROKER in alarms)
    valves = {"valve_close", "valve_open"} if valve_text else set()
    assert found["actions"] & {"valve_close", "valve_open"} == valves or gone


def test_a_level_that_was_never_received_is_unknown_and_why() -> None:
    """Another program may publish it, and have died: only its readers report that."""
    for alarms, why in (([], ""), ([DEAD, UNREAD], "no answer"), ([UNREAD], "the level is old")):
        graph = store("live", SITE, *alarms)
        assert tile_of(graph, "roof") == tile_of(graph, "cistern") == ("unknown", "unknown")
        assert why in shown(graph)["tiles"]["roof"]["sentence"]


def test_placeholders_are_no_flow() -> None:
    """If the pump node knows no flow, what it publishes is not drawn."""
    for flow in (None, 0.0, 1e-3):
        graph = watched("live", pump_flow=1e-3)
        graph.system += 1
        pump_says(graph, 100.0, "running: why", at_rest=None, flow=flow)
        add_values(graph, 61, 62, {"/pump/flow": flow or 0.0})
        assert shown(graph)["tiles"]["pump"]["number"] == flow
        drawn = make_series(graph, 3)["lines"]["flow"][-2][1]  # before the line's end
        assert (drawn is None) == (flow is None)


def test_a_site_without_a_pump_needs_none() -> None:
    graph = store("live", replace(SITE, irrigation="none", low_outlet_valve=True))
    add_values(graph, 0, 61, {"/cistern/level": 2.5, "/weather/frost": 0.0})
    graph.add_statuses(100.0, 0, valve("closed: the command is 0"))
    document = shown(graph)
    assert document["tiles"]["summary"]["level"] == "ok" and not document["stop"]["needed"]


@pytest.mark.parametrize(("mode", "tau", "factor", "limit"), [
    ("simulated", 10.0, 30.0, 5.0), ("simulated", 10.0, 1.0, 30.0), ("live", 10.0, math.nan, 5.0),
])
def test_a_value_that_does_not_come_any_more_is_unknown(
    mode: str, tau: float, factor: float, limit: float
) -> None:
    """After three ticks, or at a live site when no reader uses it, but at the earliest after 5 s.

    Nothing of an ended run is.
    """
    graph = store(mode, replace(SITE, tau=tau))
    graph.factor = factor
    add_values(graph, 0, 1, QUIET)
    graph.add_alarms(130.0, [])
    assert tile_of(graph, "roof", 100.0 + limit)[1] == "good"
    assert tile_of(graph, "roof", 100.1 + limit) == ("unknown", "unknown")
    graph.mode = "ended"
    assert tile_of(graph, "roof", 9999.0)[1] == "good"


# --- release, dose --------------------------------------------------------------------------------

SLOW = {"fault": "slow", "no_clear": ""}
LEAK = {"fault": "a leak", "no_clear": "someone has to look"}
DOSE = {"max_dose": 0.688, "min_dose": 0.00688, "no_dose": ""}
FROST = "the pump may not run: there is frost"


@pytest.mark.parametrize(("said", "actions", "refusal"), [
    ({"hold": HOLD}, {"release"}, ""), ({"hold": HOLD, "at_rest": False}, set(), ""),
    (SLOW, {"clear"}, ""), ({"hold": HOLD, **SLOW}, {"release", "clear"}, ""), (LEAK, set(), ""),
    (DOSE, {"dose"}, ""), (DOSE | {"no_dose": FROST}, set(), FROST),
    (DOSE | {"max_dose": None, "no_dose": "none allowed"}, set(), ""),
])
def test_what_else_may_be_done_here(said: dict[str, Any], actions: set[str], refusal: str) -> None:
    """Only if it was allowed, and while one pump node responds, by the services offered."""
    graph = watched("live")
    pump_says(graph, 100.0, "held: stopped", **said)
    assert shown(graph)["stop"]["actions"].keys() == {"stop"}
    graph.allow_release = True
    stop = shown(graph)["stop"]
    assert stop["actions"].keys() == {"stop", *actions}
    assert all("must lock it out" in question for question in stop["actions"].values())
    assert stop["dose"]["refusal"] == refusal
    for steady, offered in ((105.0, {"/pump": 1}), (100.0, {"/a": 1, "/b": 1}), (100.0, {"/a": 2})):
        graph.offered = offered
        document = shown(graph, steady)
        assert document["stop"]["possible"] and document["stop"]["actions"].keys() == {"stop"}
        assert steady > 100.0 or document["tiles"]["pump"]["state"] == "unknown"


# --- alarms, events, notes --------------------------------------------------------------------


def test_alarms_have_an_order_and_what_follows_is_not_listed() -> None:
    """The pump's state, then errors, the newest first, and warnings; a stop hides none."""
    hold = alarm("/pump: pump", "pump", "hold", f"held: {HELD}", WARN)
    graph = watched(
        "live", hold,
        alarm("/weather: rain gauge", "weather", "input_silent", "it is old", WARN),
        alarm("/recorder: recording", "recorder", "disk_full", "nothing is recorded"),
        alarm("/mpc", "controller", "node_silent", "silent", 3, since="2021-07-20T05:00:40+00:00"),
        alarm("/pump: command", "pump", "input_silent", "it is old", follows="/mpc"),
        alarm("/weather: sky", "weather", "x", "y", number="", starting="true"),
        BROKER._replace(level=WARN, values={**BROKER.values, "serious": "false"}),
        alarm("/pump: drive", "pump", "drive_lost", "lost", OK,
              since="2021-07-19T05:00:00+00:00", ended="2021-07-20T05:00:45+00:00"),
    )
    graph.add_statuses(100.0, 0, node("/weather", "weather", forecast_by="Forecasts by someone"))
    pump_says(graph, 100.0, f"held: {HELD}", at_rest=True, hold=HOLD)
    document = shown(graph)
    assert [(row["level"], row["id"]) for row in document["alarms"]] == [
        ("warn", "/pump: pump"), ("error", "/mpc"), ("error", "/recorder: recording"),
        ("warn", "/alarms: broker"), ("warn", "/weather: rain gauge"),
    ]
    assert document["tiles"]["summary"]["text"].startswith("2 alarms, 3 warnings. ")
    assert read_conditions()["node_silent"].advise("/mpc", "controller") in document["advice"]
    assert document["advice"].endswith("again, release it with: greenroof release")
    graph.site = replace(SITE, contact="Ann, 0123")
    assert "again, ask whoever can release it (Ann, 0123), or release" in shown(graph)["advice"]
    assert len(document["notes"]) == 2  # what is still missing, and whose forecast it is
    times = [event["at_text"] for event in document["events"]]
    assert (len(times), times[0], times[-1]) == (6, "00:00", "19 Jul 00:00")


def test_the_alarm_of_the_headline_comes_first_then_the_shared_cause() -> None:
    """After a cut cable; the pump's and the valve's are listed, although they follow."""
    late = "2021-07-20T05:00:50+00:00"
    cold = alarm("/weather: temperature", "weather", "temperature_unknown", "cold?", since=late)
    relay = alarm("/valve: drive", "valve", "drive_lost", "no answer", since=late)
    may_open = alarm("/valve: valve", "valve", "valve_may_be_open", "", follows="/valve: drive")
    levels = UNREAD._replace(values={**UNREAD.values, "follows": BROKER.name})
    site = cold, relay, BROKER, levels, may_open
    for alarms, said, first in (
        ((*site, FOLLOWS), {**TURNING, "hold": HOLD}, [FOLLOWS.name]), (site, AT_REST, []),
    ):
        graph = watched("live", *alarms)
        pump_says(graph, 100.0, "off: why", **said)
        graph.add_statuses(100.0, 0, valve("held: lost", **TURNING))
        document = shown(graph)
        assert [row["id"] for row in document["alarms"]][:-2] == [
            *first, may_open.name, BROKER.name
        ]
        assert len(document["events"]) == len(document["alarms"]) == 4 + len(first)
        place = "the pump is stopped" if first else "the outlet valve is closed"
        assert document["advice"].startswith(f"Go and see whether {place}. If not, ")
        assert read_conditions()["devices_lost"].advice in document["advice"]


def test_old_alarms_mean_that_the_sites_program_no_longer_runs() -> None:
    """Only that is concluded, 10 s after the last ones; then nothing reads as running."""
    sky = alarm("/weather: sky", "weather", "x", "y", number="")
    graph = watched("live", DEAD, sky)  # killed while it starts
    graph.system += 5
    for steady, gone in ((110.0, False), (110.1, True)):
        pump_says(graph, 106.0, "running: as commanded", at_rest=True, flow=2e-4)
        document = shown(graph, steady)
        summary = document["tiles"]["summary"]
        assert ("nobody waters the roof" in summary["sentence"]) == gone
        assert document["advice"].startswith("Start it with: sudo systemctl start") == gone
        assert [row["id"] for row in document["alarms"]] == ([] if gone else [DEAD.name])
        assert (summary["level"], bool(document["notes"])) == ("error", not gone)
    assert {tile.get("state") for tile in document["tiles"].values()} == {None, "unknown"}
    # A watcher that begins later knows it by what was saved.
    graph = GraphStore()
    graph.seen_at, graph.system = START / 1e9 - 60, START / 1e9
    assert "has not run since" in shown(graph)["tiles"]["summary"]["text"]
    assert make_series(graph, 3)["now"] is None
    # A run has no such conclusion, and without alarms nothing is called well.
    graph = watched()
    add_values(graph, 61, 62, QUIET)
    assert shown(graph, 111.0)["tiles"]["summary"]["level"] == "warn"


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
