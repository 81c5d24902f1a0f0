"""The document: what an operator is shown, from values, plans, forecasts and statuses."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from page_inputs import (
    HELD,
    HOLD,
    SECOND,
    START,
    add_values,
    alarm,
    node,
    pump,
    rows,
    store,
    valve,
)
from paper import PAPER_SITE

from greenroof_ros.interface.alarm import OK, WARN
from greenroof_ros.interface.conditions import read_conditions
from greenroof_ros.ros.reports import Status
from greenroof_ros.watch import document
from greenroof_ros.watch.document import make_document, make_series
from greenroof_ros.watch.store import PLAN, RAIN_FORECAST, GraphStore

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


def tile_of(graph: GraphStore, name: str, steady: float = 100.0) -> tuple[str, str, str]:
    tile = shown(graph, steady)["tiles"][name]
    return tile["value"], tile["state"], tile["sentence"]


def pump_says(graph: GraphStore, steady: float, text: str, **said: Any) -> None:
    """Have the pump node report its state; it offers its service for a hold."""
    graph.offered = {"/pump": 1}
    graph.add_statuses(steady, 0, pump(text, **said))


# --- tiles ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("values", "name", "expected"), [
    ({"roof_level": 0.04566}, "roof", ("45.7 mm", "good", "at its target")),
    ({"roof_level": math.nan}, "roof", ("unknown", "unknown", "the value is impossible")),
    ({}, "cistern", ("2500 mm", "good", "43.8 m³ above the suction level can be pumped")),
    ({"cistern_level": 0.75}, "cistern", (
        "750 mm", "low", "too low for the pump, since it is not above the suction level"
    )),
    ({"cistern_level": 3.01}, "cistern", (
        "3010 mm", "high", "above its overflow, so water is running to the sewer"
    )),
    ({}, "temperature", ("above 0 °C", "good", "")),
    ({"weather_frost": 1.0, "gauge_temperature": -1.5}, "temperature", (
        "-1.5 °C", "cold", "measured; the pump stays off until it is above 0 °C"
    )),
])
def test_levels_and_temperature(
    values: dict[str, float], name: str, expected: tuple[str, str, str]
) -> None:
    """The roof's band is 5 % of the target of 45.7 mm."""
    assert tile_of(watched("live", **values), name) == expected


@pytest.mark.parametrize("wrong", [
    np.full((2, 4), 1e300), -np.ones((1, 4)), np.full((1, 4), math.nan), np.empty((0, 0)),
])
def test_an_impossible_plan_or_forecast_is_none(wrong: np.ndarray) -> None:
    graph = watched()
    for topic in (PLAN, RAIN_FORECAST):
        graph.add(topic, START + 60 * SECOND, rows(wrong, [math.nan, 1e3, 2e3, 3e3, 4e3]))
    assert tile_of(graph, "watering")[0] == "not now"
    assert tile_of(graph, "rain")[2] == "no forecast received"


# --- what is old, and what is doubted ---------------------------------------------------------


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
    assert tile_of(graph, "roof", 100.1 + limit) == (
        "unknown", "unknown", "45.7 mm at last contact, 00:00"
    )
    assert shown(graph, 100.1 + limit)["tiles"]["summary"]["level"] == "warn"
    graph.mode = "ended"
    assert tile_of(graph, "roof", 9999.0)[1] == "good"


DEAD = alarm("/roof_sensor: sensor", "roof_sensor", "sensor_lost", "no answer")
UNREAD = alarm("/pump: levels", "pump", "input_silent", "the level is old", about="/roof/level")


@pytest.mark.parametrize(("values", "alarms", "tile"), [
    (False, [], ("unknown", "unknown", "no value received yet")),
    (False, [DEAD, UNREAD], ("unknown", "unknown", "Roof sensor: no answer; no values arrive")),
    # Another program publishes the level, and has died: only its readers report that.
    (False, [UNREAD], ("unknown", "unknown", "Pump: the level is old; no values arrive")),
    (True, [UNREAD], ("45.7 mm", "doubtful", "Pump: the level is old; at its target")),
])
def test_a_tile_shows_what_is_wrong_with_its_sensor(
    values: bool, alarms: list[Status], tile: tuple[str, str, str]
) -> None:
    graph = watched("live", *alarms) if values else store("live", SITE, *alarms)
    assert tile_of(graph, "roof") == tile
    assert tile_of(graph, "cistern")[1] == ("good" if values else "unknown")


# --- stop, release, dose ----------------------------------------------------------------------

TURNS = alarm("/pump: pump", "pump", "stop_not_followed", "held; the pump is still turning", WARN)


@pytest.mark.parametrize(("alarms", "state", "at_rest", "hold"), [
    ([], "running: as commanded", False, None),
    ([], f"held: {HELD}; there is frost", True, HOLD),
    ([TURNS], f"held: {HELD}; the pump is still turning", False, HOLD),  # only accepted
    ([], "off: of another version", True, 7),
])
def test_a_pump_is_stopped_if_it_is_held_and_at_rest(
    alarms: list[Status], state: str, at_rest: bool, hold: Any
) -> None:
    graph = watched("simulated", *alarms)
    assert not shown(graph)["stop"]["possible"]  # without a pump node
    pump_says(graph, 100.0, state, at_rest=at_rest, hold=hold)
    document, held = shown(graph), hold == HOLD
    stop = document["stop"]
    assert (stop["possible"], stop["stopped"]) == (True, held and at_rest)
    assert stop["label"] == ("Keep the pump off" if at_rest else "Stop the pump")
    assert stop["hold"] == (
        "The pump is held off by the operator, until someone releases it." if held else ""
    )
    assert ("with: greenroof release" in document["advice"]) == (held and at_rest)
    assert ("stop it at its drive's panel" in document["advice"]) == (held and not at_rest)
    # Of a node that is gone, nothing is known.
    document = shown(graph, 104.0)
    assert not document["stop"]["hold"] and not document["stop"]["stopped"]
    assert document["tiles"]["pump"]["value"] == ("unknown" if at_rest else "may be running")


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


# --- what the pump does ---------------------------------------------------------------------------

LOST = alarm("/pump: pump", "pump", "standstill_unknown", "off: no connection to the drive")
FOLLOWS = LOST._replace(values={**LOST.values, "follows": "/alarms: broker"})
BROKER = alarm("/alarms: broker", "alarms", "devices_lost", "relay and sensor fell silent together")
WELDED = alarm("/pump: pump", "pump", "runs_on", "the flow meter has shown a flow")


@pytest.mark.parametrize(("alarms", "text", "said", "value", "sentence"), [
    *((alarms, "off: why", {"at_rest": False, "speed": None, "flow": flow, "hold": HOLD},
       "may be running", "The pump may be running.")
      for alarms in ([], [LOST], [LOST, BROKER], [FOLLOWS, BROKER]) for flow in (None, 1e-3)),
    # Also without a flow meter, by the levels alone.
    *(([WELDED], "held: why", {"at_rest": True, "speed": 0.0, "flow": flow, "hold": HOLD},
       "may be running",
       "Water is leaving the cistern although the pump is off. Open the main switch.")
      for flow in (1e-3, 0.0)),
    # The drive's own timeout. Your own driver. As intended.
    ([], "off: why", {"at_rest": True, "speed": None, "flow": None}, "off", ""),
    ([], "running: why", {"at_rest": None, "flow": 1e-3}, "running", ""),
    ([], "held: quiet hours are in force", {"at_rest": True, "flow": 0.0}, "off", ""),
])
def test_what_is_known_of_the_pump(
    alarms: list[Status], text: str, said: dict[str, Any], value: str, sentence: str
) -> None:
    """A pump that may turn is an alarm, and is not released; placeholders are no flow."""
    graph = watched("live", *alarms, pump_flow=1e-3)
    graph.system, graph.allow_release = graph.system + 1, True
    pump_says(graph, 100.0, text, **said)
    add_values(graph, 61, 62, {"/pump/flow": said["flow"] or 0.0})
    document = shown(graph)
    tile, summary, stop = (
        document["tiles"]["pump"], document["tiles"]["summary"], document["stop"]
    )
    told = None if value == "may be running" and not said["flow"] else said["flow"]
    assert (tile["value"], tile["number"]) == (value, told)
    drawn = make_series(graph, 3)["lines"]["flow"][-2][1]  # before the line's end
    assert (drawn is None) == (said["flow"] is None)
    if sentence:
        assert (summary["sentence"], summary["level"]) == (sentence, "error")
        assert (stop["label"], stop["actions"].keys()) == ("Stop the pump", {"stop"})
        go_and_see = document["advice"].startswith("Go and see whether the pump is stopped. ")
        assert go_and_see == (alarms != [WELDED]) != ("main switch. Find" in document["advice"])
        shared = read_conditions()["devices_lost"].advice
        assert (shared in document["advice"]) == (BROKER in alarms)
    else:
        assert summary["level"] == "ok"


# --- the outlet valve -----------------------------------------------------------------------------

OPEN = {"at_rest": False, "speed": 1.0, "position": 1, "commanded": True, "flow": 1e-3}
BLIND = OPEN | {"position": None, "flow": None, "open_until": START / SECOND + 1800}


@pytest.mark.parametrize(("text", "said", "steady", "level", "expected"), [
    ("open: as commanded", OPEN, 100.0, "ok", ("open", "open",
     "commanded open; position 100 % by its end switches; 60.0 L/min; as commanded")),
    ("opening: by MQTT", BLIND, 100.0, "ok", ("opening", "opening", "commanded open; "
     "position unknown: no end switches; requested to be open until 00:30; by MQTT")),
    ("closed: dry", {}, 104.0, "warn", ("unknown", "unknown", "closed at last contact; dry")),
    ("open: as commanded", OPEN, 104.0, "error", ("may be open", "alarm",
     "open at last contact; as commanded")),
    ("held: lost", {"at_rest": False, "speed": None}, 100.0, "error", ("may be open", "alarm",
     "commanded closed; position 0 % by its end switches; lost")),
])
def test_what_is_known_of_the_valve(
    text: str, said: dict[str, Any], steady: float, level: str, expected: tuple[str, str, str]
) -> None:
    """Command and position are two values; one that may be open unnoticed is an alarm."""
    graph = watched("live")
    pump_says(graph, 100.0, "off: why")
    assert "valve" not in shown(graph)["tiles"].keys() | shown(graph)["stop"]["actions"].keys()
    graph.add_statuses(100.0, 0, valve(text, **said))
    assert tile_of(graph, "valve", steady) == expected
    assert shown(graph, steady)["tiles"]["summary"]["level"] == level
    assert shown(graph)["stop"]["actions"].keys() == {"stop", "valve_close"}
    graph.allow_release = True
    assert shown(graph)["stop"]["actions"].keys() == {"stop", "valve_close", "valve_open"}


def test_a_site_without_a_pump_needs_none() -> None:
    graph = store("live", replace(SITE, irrigation="none", low_outlet_valve=True))
    add_values(graph, 0, 61, {"/cistern/level": 2.5, "/weather/frost": 0.0})
    graph.add_statuses(100.0, 0, valve("closed: the command is 0"))
    document = shown(graph)
    assert document["tiles"]["summary"]["level"] == "ok" and not document["stop"]["needed"]


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
    assert [(row["level"], row["what"]) for row in document["alarms"]] == [
        ("warn", f"Pump: held: {HELD}"), ("error", "Controller: silent"),
        ("error", "Recorder: nothing is recorded"), ("warn", "Weather: it is old"),
        ("warn", "Relay and sensor fell silent together"),  # what the alarms node itself found
    ]
    assert document["tiles"]["summary"]["text"] == (
        "2 alarms, 3 warnings. The site is starting. Controller: silent; pump: held."
    )
    do = read_conditions()["node_silent"].advise("/mpc", "controller")
    assert document["advice"] == (
        f"The pump is held off by the operator, until someone releases it. {do} If "
        "it may run again, release it with: greenroof release"
    )
    assert document["notes"] == ["Still missing: Weather: y.", "Forecasts by someone"]
    events = [(event["at_text"], event["what"]) for event in document["events"]]
    assert (len(events), events[0], events[-1]) == (
        6, ("00:00", "Controller: silent"), ("19 Jul 00:00", "Pump: lost, until 00:00")
    )


def test_old_alarms_mean_that_the_sites_program_no_longer_runs() -> None:
    """Only that is concluded, 10 s after the last ones; then nothing reads as running."""
    sky = alarm("/weather: sky", "weather", "x", "y", number="")
    graph = watched("live", DEAD, sky)  # killed while it starts
    graph.system += 5
    for steady, gone in ((110.0, False), (110.1, True)):
        pump_says(graph, 106.0, "running: as commanded", at_rest=True, flow=2e-4)
        document = shown(graph, steady)
        summary = document["tiles"]["summary"]
        assert (summary["sentence"] == (
            "The site's program has not run since 00:01; nobody waters the roof."
        )) == gone
        assert document["advice"].startswith("Start it with: sudo systemctl start") == gone
        assert [row["id"] for row in document["alarms"]] == ([] if gone else [DEAD.name])
        assert summary["level"] == "error"
        assert ("is starting" in summary["text"]) == bool(document["notes"]) != gone
    states = {tile.get("state") for tile in document["tiles"].values()}
    assert states == {None, "unknown"}
    pump_says(graph, 109.0, "off: why", at_rest=True)  # only the alarms node is gone
    word = shown(graph, 110.1)["tiles"]["summary"]["word"]
    assert word.startswith("Whether there are alarms is unknown.")
    # A watcher that begins later knows it by what was saved.
    graph = GraphStore()
    graph.seen_at, graph.system = START / 1e9 - 60, START / 1e9
    told = shown(graph)["tiles"]["summary"]
    assert re.match(r"The site's program has not run since \d\d:\d\d, as far as", told["text"])
    assert make_series(graph, 3)["now"] is None
    # A run has no such conclusion, and without alarms nothing is called well.
    graph = watched()
    add_values(graph, 61, 62, QUIET)
    summary = shown(graph, 111.0)["tiles"]["summary"]
    assert (summary["word"], summary["level"]) == ("Whether there are alarms is unknown.", "warn")
