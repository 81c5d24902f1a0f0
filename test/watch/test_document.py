"""The document: what an operator is shown, from values, plans, forecasts and statuses."""

from __future__ import annotations

import json
import math
import re
import sys
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta, timezone
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from page_inputs import (
    ERROR,
    HELD,
    HOLD,
    OK,
    SECOND,
    START,
    WARN,
    add_values,
    alarm,
    fail,
    node,
    pump_report,
    store,
)
from paper import PAPER_SITE

from greenroof_ros.interface.conditions import read_conditions
from greenroof_ros.ros.reports import Status
from greenroof_ros.site.horizon import growing_steps
from greenroof_ros.site.site import Site
from greenroof_ros.watch import words
from greenroof_ros.watch.document import make_document as read_document
from greenroof_ros.watch.document import make_series as read_series
from greenroof_ros.watch.store import LINES, GraphStore

SITE = replace(PAPER_SITE, utc_offset=-5.0)  # START is 00:00 there
STANDARD = timezone(timedelta(hours=-5))
MINUTE = START + 60 * SECOND
QUIET = {
    "/roof/level": 0.0457, "/cistern/level": 2.5, "/pump/command": 0.0, "/pump/flow": 0.0,
    "/weather/precipitation": 0.0, "/weather/frost": 0.0,
}
ENSEMBLE = np.outer(np.arange(1.0, 12.0), np.full(32, 1e-7))  # 11 members, (member, step)


@pytest.fixture(autouse=True)
def short_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shell finds the program, and the domain is 0."""
    monkeypatch.setattr(words, "which", lambda _: "/bin/greenroof")
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")


def watched(mode: str = "simulated", *alarms: Status, **values: float) -> GraphStore:
    """Return a store after a minute with these values and alarms; ``_`` stands for ``/``."""
    given = {**QUIET, **{f"/{name.replace('_', '/')}": value for name, value in values.items()}}
    graph = store(mode, SITE, *alarms)
    add_values(graph, 0, 61, given)
    return graph


def add_at(graph: GraphStore, topic: str, *pairs: tuple[int, float]) -> None:
    """Add values of a topic, each with its second."""
    for second, value in pairs:
        graph.add(topic, START + second * SECOND, value)


def forecast(
    graph: GraphStore, time_ns: int, rain: Any, hours: float = 12, *, issued: float = math.nan
) -> None:
    """Add a forecast with growing steps, up to this many hours ahead."""
    graph.add_forecast(time_ns, rain, np.array([issued, *growing_steps(hours)[1:]]))


def plan_of(*steps: tuple[float, float, float]) -> np.ndarray[Any, Any]:
    """Return a plan: of each step its end (s), flow (m3/s) and level (m); none fills the roof."""
    return np.array([(*step, 0.0) for step in steps])


def leaves(value: Any) -> Iterator[Any]:
    """Yield each text and number of a document."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from leaves(item)
    else:
        yield value


def shown(graph: GraphStore, wall: float = 100.0) -> dict[str, Any]:
    """Return the document, which must be short, and JSON that a browser accepts.

    Here plain spaces are between numbers and units.
    """
    text = json.dumps(read_document(graph, wall), allow_nan=False)
    assert len(text) < 1_000_000
    document: dict[str, Any] = json.loads(text.replace(r"\u00a0", " "))
    for leaf in leaves(document):
        if isinstance(leaf, float):
            assert math.copysign(1, leaf) > 0 or leaf < 0, "minus zero"
        if isinstance(leaf, str):
            assert not re.search(r"(?<![\d.-])-0(\.0+)?(?![\d.])|\b(nan|inf)\b|\de\+", leaf), leaf
    return document


def tile_of(graph: GraphStore, name: str, wall: float = 100.0) -> dict[str, Any]:
    tile: dict[str, Any] = shown(graph, wall)["tiles"][name]
    return tile


def line_of(graph: GraphStore, name: str, hours: int = 3) -> list[list[Any]]:
    """Return a line of the charts, with times counted from START (s), without its end."""
    line = read_series(graph, hours)["lines"].get(name, [])
    assert not line or line[-1][1] is None
    return [[round(at - START / 1e9, 3), value] for at, value in line[:-1]]


def pump_says(graph: GraphStore, wall: float, text: str, stamp_ns: int = 0, **said: Any) -> None:
    """Have the pump node report its state; it offers its service for a hold."""
    graph.graph.offered = {"/pump": 1}
    graph.add_statuses(wall, node("/pump", "pump", **pump_report(text), **said), stamp_ns)


# --- tiles ------------------------------------------------------------------------------------


LOW_OUTLET = replace(SITE, low_outlet_level=1.0, low_outlet_radius=0.02)


@pytest.mark.parametrize(("name", "site", "level", "state", "sentence"), [
    ("roof", SITE, 0.04566, "good", "at its target"),
    ("roof", SITE, 0.55, "high",
     "504.3 mm above its target; the soil is full, and water is draining off"),
    ("roof", SITE, -0.0, "low", "45.7 mm below its target"),
    ("cistern", SITE, 0.75, "low", "too low for the pump, since it is not above the suction level"),
    ("cistern", SITE, 3.01, "high", "above its overflow, so water is running to the sewer"),
    ("cistern", LOW_OUTLET, 2.5, "good",
     "43.8 m³ above the suction level can be pumped; the low outlet is draining the cistern"),
])
def test_levels(name: str, site: Site, level: float, state: str, sentence: str) -> None:
    """The roof's band is 5 % of the target of 45.7 mm: from 43.415 to 47.985 mm."""
    graph = watched(**{f"{name}_level": level})
    graph.set_site(site)
    tile = tile_of(graph, name)
    assert (tile["state"], tile["sentence"], tile["number"]) == (state, sentence, level)


@pytest.mark.parametrize(("values", "state", "why", "level", "advice"), [
    ({}, "off", "nothing is commanded", "ok", "Nothing to do."),
    ({"pump_command": 0.4, "pump_flow": 2.05e-4, "roof_level": 0.04}, "running", "", "ok",
     "Nothing to do."),
    # A command of 1 % waters the roof; without one, so little is the end of a lag.
    ({"pump_command": 0.01, "pump_flow": 8e-5, "roof_level": 0.04}, "running", "", "ok",
     "Nothing to do."),
    ({"pump_flow": 8e-5, "roof_level": 0.05}, "off", "nothing is commanded", "warn",
     "Nothing to do."),
    ({"pump_command": 0.4, "roof_level": 0.04}, "off", "", "warn",
     "The roof is not being watered, since the pump is off."),
    ({"roof_level": 0.04}, "off", "nothing is commanded", "warn", "Nothing to do."),
    ({"roof_level": 0.05}, "off", "nothing is commanded", "warn", "Nothing to do."),
    ({"roof_level": -1.0}, "off", "nothing is commanded", "warn",
     "No fault is reported, but some values are unknown"),
])
def test_the_simulated_pump_and_what_to_do(
    values: dict[str, float], state: str, why: str, level: str, advice: str
) -> None:
    """A roof that is not as wanted is no alarm, and neither green nor called well.

    But a dry roof that is being watered is as it should be.
    """
    document = shown(watched(**values))
    tile, summary = document["tiles"]["pump"], document["tiles"]["summary"]
    assert (tile["value"], tile["state"], tile["why"]) == (state, state, why)
    assert (summary["word"], summary["level"]) == ("All is well." if level == "ok" else "", level)
    assert document["advice"].startswith(advice)


def test_rain_and_what_is_to_come() -> None:
    """Members of 1..11 times 1e-7 m/s for 12 h: 4.32 mm times 1 to 11, mean 6, deciles 2 and 10."""
    graph = watched(weather_precipitation=1 / 3.6e6)
    for later, (rain, sentence) in enumerate((
        (ENSEMBLE, "26 mm (8.6 to 43) expected in the next 12 h"),
        (ENSEMBLE[:3], "8.6 mm (4.3 to 13) expected in the next 12 h"),
        (ENSEMBLE[0], "4.3 mm expected in the next 12 h"),
    )):
        forecast(graph, MINUTE + later * SECOND, rain)
        tile = tile_of(graph, "rain")
        assert (tile["value"], tile["sentence"]) == ("1.0 mm/h", sentence)
        if rain is ENSEMBLE:  # its mean, and no more of the future than there is of the past
            line = line_of(graph, "rain_forecast")
            assert (line[0], line[-1]) == ([60, 2.16], [101, 2.16])
    graph, front = watched(), np.array([math.nan, *range(1, 11)])
    graph.add_forecast(MINUTE, np.full(10, 1e-7), front)
    assert tile_of(graph, "rain")["sentence"] == "no forecast for the next few hours"


def test_what_is_known_by_words_alone() -> None:
    """If no one hears a controller's command, it is not shown as working."""
    graph = store()
    pump_says(graph, 100.0, "held: there is frost")
    assert tile_of(graph, "watering")["value"] == "unknown"


def test_the_plan_in_words() -> None:
    """1e-3 m3/s from 01:20 to 02:00 are 2.4 m3; an empty plan means that it is unchanged."""
    graph = watched()
    graph.add_statuses(100.0, node("/lookahead", "controller"))
    plan = plan_of((4740.0, 0, 0.045), (7140.0, 1e-3, 0.047), (43200.0, 0, 0.046))
    will, given = ("from 01:20", "2400 L up to 47.0 mm planned"), ""
    for later, (rows, shown_as) in enumerate((
        (plan, will), (np.empty((0, 4)), will),
        (plan * [1, 0, 1, 1], ("not in the next 12 h", "no pumping is planned")),
        (np.full((1, 4), np.nan), ("not now", "")),
    )):
        graph.add_plan(MINUTE + later * SECOND, rows)
        tile = tile_of(graph, "watering")
        sentence = "; ".join(filter(None, (shown_as[1], given)))
        assert (tile["value"], tile["sentence"], tile["state"]) == (shown_as[0], sentence, "good")
    assert line_of(graph, "flow_planned") == []
    graph.add_plan(MINUTE + 5 * SECOND, plan_of((3600.0, 1e-3, 0.045)))
    add_values(graph, 61, 62, {"/pump/command": 0.4, "/controller/fill_to": 0.041})
    tile = tile_of(graph, "watering")
    assert tile["value"] == "wanted"
    assert tile["sentence"].startswith("the pump is off; up to 41.0 mm now; 3")
    add_values(graph, 62, 63, {"/pump/flow": 1e-3})
    tile = tile_of(graph, "watering")
    assert (tile["value"], tile["sentence"][:20]) == ("now", "up to 41.0 mm now; 3")


@pytest.mark.parametrize("value", [math.nan, 1e300, -1.0])
def test_what_is_not_plausible_stands_nowhere(value: float) -> None:
    """And the next good value ends it."""
    graph = watched()
    for topic in QUIET:
        add_at(graph, topic, (61, value))
    document = shown(graph)
    for name in ("roof", "cistern", "rain"):
        tile = document["tiles"][name]
        assert (tile["value"], tile["state"]) == ("not a plausible value", "alarm"), name
        assert tile["number"] is None
    assert "not a plausible value" in document["tiles"]["pump"]["sentence"]
    json.dumps(read_series(graph, 3), allow_nan=False)
    for name in LINES:  # 0-19, 20-39 and 40-59 s; then it is unknown
        line = line_of(graph, name)
        assert [at for at, known in line if known is not None][-1] == 59
        assert line[-1] == [61, None]
    assert document["tiles"]["summary"]["level"] == "warn"
    add_at(graph, "/roof/level", (62, value), (63, 0.0457))
    assert tile_of(graph, "roof")["state"] == "good"


def test_hostile_forecasts_and_plans() -> None:
    """Nor is a forecast shown without the ends of its steps."""
    graph, ten = watched(), np.full(10, 1e-7)
    for values, ends in (
        (np.empty((0, 0)), []), (np.full((3, 3, 3), 1e-7), [1, 2, 3]),
        (np.full(32, np.nan), range(1, 33)), (np.full(32, -1e-9), range(1, 33)),
        (np.full(100_000, 1e-7), range(1, 100_001)), (np.full((5000, 32), 1e-7), range(1, 33)),
        (ten, [*range(1, 11), 12]), (ten, range(10)), (ten, [*range(1, 10), math.inf]),
    ):
        graph.add_forecast(MINUTE, values, np.array([math.nan, *ends]))
        assert tile_of(graph, "rain")["sentence"] == "no forecast received"
        assert line_of(graph, "rain_forecast") == []
    for later, rows in enumerate((
        np.ones(4), np.ones((2, 3)), np.ones((2, 4, 1)), np.full((2, 4), 1e300), np.ones((2, 4)),
        plan_of((-1.0, 0, 0)), plan_of((0.0, 0, 0)), np.full((10_000, 4), 1.0),
    )):
        graph.add_plan(MINUTE + later * SECOND, rows)
        assert line_of(graph, "flow_planned") == []
    graph.add_plan(2**63, plan_of((1.0, 0, 0)))
    for time_ns in (-5, 0, 2**62, 2**63 - 1):
        graph.add("/roof/level", time_ns, 0.1)
    graph.add("/roof/level", MINUTE + 5 * SECOND, 0.02)
    document = shown(graph)
    assert document["tiles"]["roof"]["number"] == 0.02
    assert document["time"]["text"] == "2021-07-20 00:01:05 UTC-05:00"


# --- time, order, staleness ---------------------------------------------------------------------


def test_what_is_not_newer_is_left_out() -> None:
    """Whether it is older than what is there, or out of order in its batch."""
    graph = watched(roof_level=0.04)
    add_at(graph, "/roof/level", (60, 0.01), (5, 0.02))
    assert tile_of(graph, "roof")["number"] == 0.04
    add_at(graph, "/roof/level", (70, 0.03), (65, 0.5), (80, 0.02))
    levels = [level for _, level in line_of(graph, "roof")]
    assert (levels[:3], levels[-1]) == ([40.0] * 3, 20.0) and {*levels} == {40.0, 30.0, 20.0}


def test_a_value_that_does_not_come_any_more_is_stale() -> None:
    """After three ticks, which are 1 s here, but at the earliest after 5 s."""
    graph = watched(roof_level=0.0453)
    for second in range(17):
        values = {"/cistern/level": 2.0, **({"/roof/level": 0.0453} if second < 10 else {})}
        graph.update(100.0 + second)  # by the feed, whether a page is open or not
        add_values(graph, 61 + second, 62 + second, values)
        if second == 13:
            assert not tile_of(graph, "roof", 113.0)["stale"]
    graph.add_alarms(116.0, START, [])
    document = shown(graph, 116.0)
    tile = document["tiles"]["roof"]
    assert (tile["stale"], tile["value"], tile["state"]) == (True, "unknown", "unknown")
    assert tile["sentence"] == "45.3 mm at last contact, 00:01:10"
    assert not document["tiles"]["cistern"]["stale"]
    assert document["tiles"]["summary"]["level"] == "warn"
    add_values(graph, 90, 91, {"/roof/level": 0.0453})
    assert tile_of(graph, "roof", 118.0)["state"] == "good"
    # In real time, a tick has 10 s; at a live site, readers use no level older than 5 s.
    for mode, factor, limit in (("simulated", 1.0, 30.0), ("live", None, 5.0)):
        graph = store(mode, replace(SITE, tau=10.0))
        graph.set_present(mode=mode, factor=factor, note="")
        add_values(graph, 0, 1, QUIET)
        graph.add_alarms(130.0, START, [])
        for after, stale in ((limit, False), (limit + 0.1, True)):
            assert tile_of(graph, "roof", 100.0 + after)["stale"] == stale


DEAD = alarm("/roof_sensor: sensor", "roof_sensor", "sensor_lost", "no answer")
UNREAD = alarm("/pump: levels", "pump", "input_silent", "the level is old", about="/roof/level")


@pytest.mark.parametrize(("alarms", "sentence"), [
    ([], "no value received yet"),
    ([alarm("/pump: levels", "pump", "input_waiting", "it has not arrived yet",
            about="/roof/level")], "no value received yet"),
    ([DEAD, UNREAD], "Roof sensor: no answer; no values arrive"),
    ([alarm("/cistern_sensor: sensor", "cistern_sensor", "sensor_lost", "no answer")],
     "no value received yet"),
    # Another program publishes the level, and has died: only its readers report that.
    ([UNREAD], "Pump: the level is old; no values arrive"),
], ids=["no alarm", "waited for", "dead", "another is dead", "dead by its reader"])
def test_a_dead_sensor_is_not_one_from_which_nothing_came_yet(
    alarms: list[Status], sentence: str
) -> None:
    document = shown(store("live", SITE, *alarms))
    roof = document["tiles"]["roof"]
    assert (roof["value"], roof["sentence"]) == ("unknown", sentence)
    worst = "Roof sensor: no answer; " if DEAD in alarms else f"is unknown ({sentence})"
    assert worst in document["tiles"]["summary"]["sentence"] or len(alarms) == 1


def test_a_tile_whose_sensor_is_doubted_shows_the_doubt() -> None:
    """With its value, or, if it died, with its last one."""
    frozen = alarm("/pump: levels", "pump", "input_frozen", "it is frozen", about="/roof/level")
    graph = watched("live", frozen, roof_level=0.0457)
    for wall, value, state, sentence in (
        (100.0, "45.7 mm", "doubtful", "Pump: it is frozen; at its target"),
        (106.0, "unknown", "unknown", "Pump: it is frozen; 45.7 mm at last contact, 00:01:00"),
    ):
        tile = tile_of(graph, "roof", wall)
        assert (tile["value"], tile["state"], tile["sentence"]) == (value, state, sentence)
    assert shown(graph)["tiles"]["cistern"]["state"] == "good"
    graph.add_alarms(106.0, START, [])
    assert tile_of(graph, "roof", 106.0)["sentence"] == "45.7 mm at last contact, 00:01:00"


def test_the_time_of_a_live_site_goes_on_without_values_and_may_be_set_back() -> None:
    """Set back by an hour: the charts start again with new values."""
    graph = watched("live")
    graph.update(100.0, START / 1e9 + 60)
    assert shown(graph, 101.0)["notes"] == []
    graph.update(112.0, START / 1e9 + 72)
    document = shown(graph, 112.0)
    assert document["time"]["text"] == "2021-07-20 00:01:12 UTC-05:00"
    assert read_series(graph, 1.0)["now"] == START / 1e9 + 72
    pump_says(graph, 112.0, "off: nothing is commanded")
    graph.update(112.5, START / 1e9 - 3539)
    assert not any(line_of(graph, name) for name in LINES)
    graph.add_alarms(112.5, START, [])
    add_values(graph, -3539, -3530, QUIET)
    document = shown(graph, 113.0)
    assert document["tiles"]["roof"]["number"] == QUIET["/roof/level"]
    assert document["tiles"]["pump"]["value"] == "off"
    assert document["events"][0]["what"] == (
        "The system's clock was set back by 60.2 min, so the charts start again"
    )


def test_what_a_watcher_knows_before_during_and_after_a_run() -> None:
    """Nothing of an ended run is stale; another run can be of an earlier day."""
    graph = GraphStore("/site1")
    document = shown(graph, 5.0)
    assert (document["namespace"], document["heading"]) == ("/site1", "Nothing received yet")
    assert document["time"] == {"now": None, "text": "unknown", "zone": "UTC"}
    assert document["tiles"].pop("summary")["sentence"] == "No run or site has been found."
    assert {tile["state"] for tile in document["tiles"].values()} == {"unknown"}
    assert not any(read_series(graph, 12)["lines"].values())
    for factor, heading in (
        (30.0, "Simulated run, 30 times real time"), (math.nan, "Simulated run"),
    ):
        graph.set_present(mode="simulated", factor=factor, note="Shows samples.")
        assert shown(graph)["heading"] == heading
    graph.set_site(SITE, "Levels are judged by the paper's site, a.yaml.")
    graph.add_statuses(0.0, node("/site1/weather", "weather", forecast_by="forecasts by someone"))
    assert shown(graph)["notes"] == [
        "Levels are judged by the paper's site, a.yaml.", "Shows samples.", "Forecasts by someone.",
    ]
    add_values(graph, 0, 61, QUIET)
    graph.add_statuses(0.0, node("/site1/weather", "weather", state="ended"))
    graph.set_present(mode="ended", factor=None, note="")
    document = shown(graph, 9999.0)
    assert (document["heading"], document["tiles"]["roof"]["state"]) == ("Ended run", "good")
    assert document["advice"] == "The run is over, so the values shown are not current."
    graph.reset()
    assert tile_of(graph, "roof")["state"] == "unknown"
    add_values(graph, -86_400, -86_300, QUIET)
    assert tile_of(graph, "roof")["state"] == "good"


# --- notes, stop, events -------------------------------------------------------------


@pytest.mark.parametrize(("state", "at_rest", "hold", "label"), [
    ("running: as commanded", False, None, "Stop the pump"),
    (f"held: {HELD}; there is frost", True, HOLD, "Stop again"),
    ("off: the command is 0", True, None, "Keep the pump off"),
    ("fault: leak", True, None, "Keep the pump off"),
    # Only accepted: the pump may still turn, with what to do.
    (f"held: {HELD}; the pump is still turning", False, HOLD, "Stop the pump"),
    ("off: of another version", True, 7, "Keep the pump off"),
])
def test_what_stop_does_as_the_pump_is(
    state: str, at_rest: bool, hold: Any, label: str
) -> None:
    graph = watched()
    assert not shown(graph)["stop"]["possible"]  # without a pump node
    pump_says(graph, 100.0, state, at_rest=at_rest, hold=hold)
    held = hold == HOLD
    document, unsure = shown(graph), held and not at_rest
    told, summary = document["stop"], document["tiles"]["summary"]
    assert (told["possible"], told["stopped"]) == (True, held and at_rest)
    assert told["hold"] == (
        "The pump is held off by the operator, until someone releases it." if held else ""
    )
    assert told["label"] == label
    assert ("with: greenroof release" in document["advice"]) == (held and at_rest)
    assert ("stop it at its drive's panel" in told["warning"]) == unsure
    assert (summary["level"] == "error") == unsure
    # Of a hold the box states more.
    assert ("the pump is held off" in summary["sentence"]) == held
    assert HELD not in summary["sentence"]
    assert "must lock it out at the pump itself" in told["actions"]["stop"]


@pytest.mark.parametrize("forged", [
    {"name": "/other", "process": "host 2"}, {"process": "host 2"}, {"state": "ended"},
    {"process": "host 2", "state": "ended"}, {"hold": HOLD, "at_rest": True},
    {"at_rest": 7, "hold": 7, "fault": 7, "max_dose": "x", "pump_state": 7},
])
def test_no_report_switches_the_stop_off(forged: dict[str, Any]) -> None:
    """A second pump node, one that claims to have ended or to be held, or impossible values."""
    graph = watched("live")
    for wall in (100.0, 100.2, 100.4):
        pump_says(graph, wall, "running: as commanded", at_rest=False)
        said = {"name": "/pump", "process": "host 1", "state": "ready", **forged}
        graph.add_statuses(wall, node(said.pop("name"), "pump", **said))
        assert shown(graph, wall)["stop"]["possible"]


@pytest.mark.parametrize(("offered", "alarms"), [
    ({"/pump": 1, "/second": 1}, []), ({"/pump": 2}, []),
    ({"/pump": 1}, [alarm("/pump", "pump", "two_processes", "two processes report")]),
    ({"/pump": 1}, [alarm("/pump: pump nodes", "pump", "two_pump_nodes", "two nodes")]),
])
def test_if_two_nodes_may_be_the_pump_node_only_a_stop_is_offered(
    offered: dict[str, int], alarms: list[Status]
) -> None:
    """By their services, which are more than reports, or by an alarm."""
    graph = watched("live", *alarms)
    graph.allow_release = True
    pump_says(graph, 100.0, f"held: {HELD}", at_rest=True, hold=HOLD)
    assert "release" in shown(graph)["stop"]["actions"] or alarms
    graph.graph.offered = offered
    document = shown(graph)
    stop = document["stop"]
    assert "Two nodes claim to be the pump node" in stop["warning"]
    assert stop["possible"] and stop["actions"].keys() == {"stop"}
    assert stop["warning"] in document["advice"]
    assert document["tiles"]["pump"]["state"] == "unknown"
    assert document["tiles"]["summary"]["level"] == "error"


STARTS, STAYS = "The pump then starts automatically", "The pump nevertheless stays off"
SLOW = {"fault": "slow", "no_clear": ""}
LEAK = {"fault": "a leak", "no_clear": "someone has to look"}
LOST = {"unknown": "the file cannot be read"}


@pytest.mark.parametrize(("hold", "more", "release", "clear"), [
    (HOLD, {}, STARTS, ""),
    (HOLD, LOST, STAYS, ""),
    (HOLD, {"at_rest": False}, "", ""),
    (None, SLOW, "", STARTS),
    (HOLD, SLOW, STAYS, STAYS),
    (HOLD, LEAK, STAYS, ""),
    ({"owner": 7}, {"fault": ""}, "", ""),
])
def test_what_may_be_released_here(
    hold: Any, more: dict[str, Any], release: str, clear: str
) -> None:
    """Any hold, and a fault that needs no person at the pump, only if it was allowed."""
    graph = watched()
    said = {"hold": hold, "at_rest": True, **more}
    pump_says(graph, 100.0, "held: stopped", **said)
    before = shown(graph)["stop"]
    assert before["actions"].keys() == {"stop"}
    graph.allow_release = True
    stop = shown(graph)["stop"]
    for action, effect in (("release", release), ("clear", clear)):
        assert (action in stop["actions"]) == bool(effect)
        if effect:
            assert effect in stop["actions"][action]
            assert "must lock it out at the pump itself" in stop["actions"][action]
    pump_says(graph, 100.1, "off: the command is 0", at_rest=True)
    outdated = shown(graph)["stop"]["situation"] != stop["situation"]
    assert outdated or not (release or clear)  # a question is


DOSE = {"max_dose": 0.688, "min_dose": 0.00688, "no_dose": ""}


@pytest.mark.parametrize(("said", "maximum", "limits"), [
    (DOSE, 0.688, "7 L to 688 L, which is 0.1 mm to 10 mm of water on the roof"),
    (DOSE | {"min_dose": 0.0}, 0.688, "688 L, which is 10 mm of water on the roof"),
    (DOSE | {"no_dose": "the pump may not run: there is frost"}, 0.688, None),
    (DOSE | {"max_dose": None, "no_dose": "the site file does not allow doses"}, None, None),
    (DOSE | {"max_dose": "1"}, None, None),
])
def test_where_a_dose_may_be_given(
    said: dict[str, Any], maximum: float | None, limits: str | None
) -> None:
    """The paper's bed has 68.8 m2."""
    graph, here = watched(), limits is not None
    pump_says(graph, 100.0, "off: the command is 0", at_rest=True, **said)
    assert "dose" not in shown(graph)["stop"]["actions"]
    graph.allow_release = True
    stop = shown(graph)["stop"]
    assert (stop["dose"]["max"], "dose" in stop["actions"]) == (maximum, here)
    assert stop["dose"]["refusal"] == (said["no_dose"] if maximum else "")
    assert not here or stop["dose"]["limits"] == limits
    assert "dose" not in shown(graph, 105.0)["stop"]["actions"]  # it no longer responds


@pytest.mark.parametrize(("dose", "flow", "advice"), [
    ({"volume": 0.02, "delivered": 0.012, "over": ""}, 3.4e-5, "A dose: 12 of 20 L, 4 min left. "),
    ({"volume": 0.02, "delivered": 0.0, "over": ""}, 0.0, "A dose: 0 of 20 L; it is waiting. "),
    ({"over": "done", "sentence": "the dose of 0.02 m3 was delivered"}, 0.0,
     "The dose of 0.02 m³ was delivered. "),
    ({"volume": "x", "delivered": 7, "over": ""}, 0.0, ""),
])
def test_a_dose_has_its_progress(dose: dict[str, Any], flow: float, advice: str) -> None:
    graph = watched()
    pump_says(graph, 100.0, "running: a dose", at_rest=False, flow=flow, dose=dose)
    assert shown(graph)["advice"] == f"{advice}Nothing to do."


def test_nothing_is_held_off_by_a_node_that_is_gone() -> None:
    graph = watched()
    pump_says(graph, 100.0, f"held: {HELD}", at_rest=True, hold=HOLD)
    document = shown(graph, 104.0)
    pump, stop = document["tiles"]["pump"], document["stop"]
    assert not stop["hold"] and not stop["stopped"]
    assert pump["value"] == "unknown" and pump["sentence"].startswith("held at last contact")
    assert "the state of the pump is unknown" in document["tiles"]["summary"]["sentence"]


def with_pump(graph: GraphStore, state: str, **said: Any) -> dict[str, Any]:
    """Return the document after this report of the pump node."""
    pump_says(graph, 100.0, state, **said)
    return shown(graph)


LOST = "off: no connection to the drive; it is unknown whether the pump is stopped"


def test_a_pump_that_may_turn_is_unknown_and_an_alarm() -> None:
    """Placeholders on its topics are not shown: neither off nor 0.0 L/min."""
    lost = alarm("/pump: pump", "pump", "stands_unknown", LOST)
    warned = alarm("/pump: drive", "pump", "drive_local", "by hand", WARN)
    document = with_pump(
        watched("live", warned, lost, pump_command=1.0), LOST,
        at_rest=False, speed=None, flow=None,
    )
    tile, summary = document["tiles"]["pump"], document["tiles"]["summary"]
    assert (tile["value"], tile["state"], tile["alarm"]) == ("may be running", "alarm", True)
    assert tile["number"] is None and "L/min" not in tile["sentence"]
    assert tile["sentence"] == "it is unknown whether the pump is stopped"
    assert (summary["level"], summary["word"]) == ("error", "1 alarm, 1 warning.")
    assert summary["sentence"] == "The pump may be running."
    assert [(row["id"], row["level"]) for row in document["alarms"]] == [
        ("/pump: pump", "error"), ("/pump: drive", "warn"),
    ]
    assert "Go and see" in document["advice"]


def test_a_welded_contactor_is_told_first_and_offers_no_release() -> None:
    welded = alarm("/pump: pump", "pump", "runs_on", "the flow meter has shown a flow")
    graph = watched("live", welded, pump_flow=1e-3)
    graph.allow_release = True
    document = with_pump(graph, f"held: {HELD}", at_rest=True, speed=0.0, flow=1e-3, hold=HOLD)
    summary, stop = document["tiles"]["summary"], document["stop"]
    assert (summary["level"], summary["sentence"]) == (
        "error", "Water is leaving the cistern although the pump is off. Open the main switch."
    )
    assert document["tiles"]["pump"]["value"] == "may be running"
    assert (stop["label"], stop["actions"].keys()) == ("Stop the pump", {"stop"})
    assert "its drive's panel or main switch" in document["advice"]


@pytest.mark.parametrize(("said", "value", "may_turn"), [
    ({"at_rest": False, "speed": -0.5, "flow": None}, "fault", False),  # backwards: known to turn
    ({"at_rest": False, "speed": 0.7, "flow": None}, "running", False),  # no level of the cistern
    # known from a flow meter
    ({"at_rest": False, "speed": None, "flow": 1e-3}, "may be running", True),
])
def test_what_is_known_of_the_pump(said: dict[str, Any], value: str, may_turn: bool) -> None:
    state = f"{'off' if may_turn else value}: why"
    graph = watched("live", pump_flow=1e-3)
    tile = with_pump(graph, state, **said)["tiles"]["pump"]
    assert (tile["value"], tile["alarm"]) == (value, may_turn)
    assert ("60.0 L/min" in tile["sentence"]) == (said["flow"] is not None)
    assert ("flow is unknown" in tile["sentence"]) == (said["flow"] is None)
    document = shown(graph, 104.0)  # its node is gone: it ran
    tile = document["tiles"]["pump"]
    assert (tile["value"], tile["alarm"]) == ("may be running", True)
    assert document["advice"].startswith("Go and see")
    # It stood at last contact, or must stand by now: that is not a measured 0.0 L/min.
    tile = with_pump(
        watched(pump_command=0.5), "off: no connection to the drive", at_rest=True, speed=None,
        flow=0.0,
    )["tiles"]["pump"]
    assert (tile["value"], tile["number"], tile["alarm"]) == ("off", None, False)


def test_a_flow_that_is_unknown_is_a_gap() -> None:
    """Its topic then goes on with 0."""
    graph = watched("live", pump_flow=1e-3)
    graph.update(99.0, START / 1e9 + 60)
    known = {"at_rest": False, "speed": 1.0, "flow": 1e-3}

    def print_line(second: int, said: dict[str, Any]) -> None:
        graph.update(100.0 + second, START / 1e9 + second)
        pump_says(graph, 100.0 + second, "off: lost", START + second * SECOND, **said)

    print_line(60, known)
    print_line(70, {"at_rest": False, "speed": None, "flow": None})
    assert tile_of(graph, "pump", 170.0)["number"] is None
    add_values(graph, 61, 161, {**QUIET, "/pump/flow": 0.0})
    print_line(160, known)
    add_values(graph, 161, 181, {**QUIET, "/pump/flow": 1e-3})
    graph.update(301.0, START / 1e9 + 180)
    flow = line_of(graph, "flow")
    assert [at for at, value in flow if value is None] == [79, 99, 119, 139, 159]
    assert {value for _, value in flow} == {60.0, None} and flow[-1] == [180, 60.0]


def with_outlook(
    mean: float, *, command: float = 0.0, plan: Any = None, site: Site = SITE
) -> dict[str, Any]:
    """Return tiles and advice, with this much rain (m) forecast from 02:00 to 04:00, and a plan."""
    graph = watched(roof_level=0.035, pump_command=command)
    graph.set_site(site)
    steps, ends = np.zeros((11, 32)), growing_steps(12)[1:]
    begins = np.append(0.0, ends[:-1])
    steps[:, (begins >= 7200) & (ends <= 14400)] = 1.0
    share = np.linspace(0.5, 1.5, 11)[:, None] * mean / ((ends - begins) @ steps[0])
    forecast(graph, MINUTE, steps * share)
    if plan is not None:
        graph.add_plan(MINUTE, plan_of(*plan))
    document = shown(graph)
    return {**document["tiles"], "advice": document["advice"]}


def test_a_pump_that_waits_for_rain_reports_it() -> None:
    """Members of half to one and a half times 32 mm: a tenth is below 19, a tenth above 45."""
    tiles = with_outlook(0.032)
    assert tiles["summary"]["sentence"] == (
        "The roof is too dry, 10.7 mm below its target; the pump is waiting for rain: 32 mm "
        "(19 to 45) expected in the next 12 h."
    )
    # The sign does not contradict the roof's tile, which reports too low.
    assert (tiles["summary"]["level"], tiles["advice"]) == ("warn", "Nothing to do.")
    pumps = [[1800.0, 1e-3, 0.036], [43200.0, 0.0, 0.04]]
    for mean, more in ((0.008, {}), (0.032, {"command": 0.5}), (0.032, {"plan": pumps})):
        summary = with_outlook(mean, **more)["summary"]
        assert ("waiting" in summary["sentence"], summary["level"]) == (False, "warn")


def test_what_began_before_the_clock_of_a_run_is_of_its_clock() -> None:
    """Nodes stamp with the system's time until the first tick."""
    graph = store("simulated", SITE, alarm("/pump: drive", "pump", "drive_lost", "not connected",
                                           since="2026-01-01T00:00:00+00:00"))
    graph.update(100.0, time.time())
    graph.add_event("It came.")
    add_values(graph, 0, 9, QUIET)
    assert [event["at_text"] for event in shown(graph)["events"]] == ["the start"] * 2


def test_events_are_one_line_each() -> None:
    """An alarm with its end, whatever its node is called, and no other that follows from it."""
    over = {"ended": "2021-07-20T05:00:45+00:00", "seconds": "15.0"}
    graph = watched("live", *(
        alarm("/onoff", "controller", "not_heard", "no message for 3.5 s", OK, **over),
        alarm("/pump: command", "pump", "input_silent", "the command is old", OK, **over,
              follows="/onoff"),
        DEAD, alarm("/roof_sensor", "roof_sensor", "peers_awaited", "it waits", WARN,
                    number="", starting="true"),
    ))
    graph.update(100.0, START / 1e9 + 40)
    graph.add_event("Stop, from the page: held.")
    graph.update(100.0, START / 1e9 + 86_460)
    assert [(event["at_text"], event["what"]) for event in shown(graph)["events"]] == [
        ("20 Jul 00:00:40", "Stop, from the page: held."),
        ("20 Jul 00:00:30", "Controller: no message for 3.5 s, until 20 Jul 00:00:45"),
        ("20 Jul 00:00:30", "Roof sensor: no answer"),
    ]
    for number in range(100):
        graph.add_event(str(number))
    assert len(graph.events) == 50 and graph.events[-1][1] == "99"


def test_alarms_have_an_order_and_what_follows_is_not_listed() -> None:
    """The pump's state, then errors, the newest first, and warnings; other devices last."""
    hold = alarm("/pump: pump", "pump", "hold", f"held: {HELD}", WARN)
    graph = watched(
        "live", alarm("/camera", "", "", "no picture", ERROR), hold,
        alarm("/weather: rain gauge", "weather", "input_silent", "it is old", WARN),
        alarm("/recorder: recording", "recorder", "disk_full", "nothing is recorded"),
        alarm("/mpc", "controller", "not_heard", "silent", 3, since="2021-07-20T05:00:40+00:00"),
        alarm("/pump: command", "pump", "input_silent", "it is old", follows="/mpc"),
    )
    pump_says(graph, 100.0, f"held: {HELD}", at_rest=True, hold=HOLD)
    document = shown(graph)
    assert [(row["id"], row["level"]) for row in document["alarms"]] == [
        ("/pump: pump", "warn"), ("/mpc", "error"), ("/recorder: recording", "error"),
        ("/weather: rain gauge", "warn"), ("/camera", "warn"),
    ]
    assert document["tiles"]["summary"]["word"] == "2 alarms, 3 warnings."
    do = read_conditions()["not_heard"].advise("/mpc", "controller")
    # A stop hides no alarm.
    assert document["advice"] == (
        f"The pump is held off by the operator, until someone releases it. {do} If "
        "it may run again, release it with: greenroof release"
    )


def test_a_command_in_an_advice_is_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the domain, if it is not 0, and with the path, if the shell does not find it."""
    fault = alarm("/site1/pump: pump", "pump", "drive_fault", "overheat")
    for domain, path, before in (
        ("0", "/bin/greenroof", "greenroof"), ("7", "/bin/greenroof", "ROS_DOMAIN_ID=7 greenroof"),
        ("7", None, f"ROS_DOMAIN_ID=7 {Path(sys.executable).parent}/greenroof"),
    ):
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
        monkeypatch.setattr(words, "which", lambda _, path=path: path)
        advice = shown(watched("live", fault))["advice"]
        assert f": {before} reset --namespace site1, in a terminal" in advice


def test_what_may_still_come_is_a_note_while_a_site_starts() -> None:
    graph = watched("live", alarm("/pump: drive", "pump", "drive_lost", "no connection", WARN,
                                  number="", starting="true"))
    document = shown(graph)
    assert document["notes"][:2] == [
        "The site is starting. Still missing:", "Pump: no connection."
    ]
    assert document["alarms"] == document["events"] == []
    assert "The site is starting." in document["tiles"]["summary"]["word"]


def test_old_alarms_mean_that_the_sites_program_no_longer_runs() -> None:
    """Only that is concluded, 10 s after the last ones; then nothing reads as running."""
    graph = watched("live", DEAD, roof_level=0.0457)
    graph.update(100.0, START / 1e9 + 60)
    for wall, gone in ((110.0, False), (110.1, True)):
        pump_says(graph, 106.0, "running: as commanded", at_rest=False, flow=2e-4)
        document = shown(graph, wall)
        summary = document["tiles"]["summary"]
        assert (summary["sentence"] == (
            "The site's program has not run since 00:01:00; nobody waters the roof."
        )) == gone
        assert (document["advice"].startswith("Start it with: sudo systemctl start")) == gone
        assert [row["id"] for row in document["alarms"]] == ["site" if gone else DEAD.name]
        assert summary["level"] == "error"
    graph.excuse_silence(5.0)  # this process itself stood still
    assert shown(graph, 115.0)["alarms"][0]["id"] == DEAD.name
    # A run has no such conclusion, and without alarms nothing is called well.
    graph = watched()
    summary = shown(graph, 100.0)["tiles"]["summary"]
    assert (summary["word"], summary["level"]) == ("All is well.", "ok")
    add_values(graph, 61, 62, QUIET)
    summary = shown(graph, 111.0)["tiles"]["summary"]
    assert summary["word"] == "Whether there are alarms is unknown."
    assert summary["level"] != "ok"


def test_what_was_given_and_how_long_the_cistern_lasts() -> None:
    """1 L/s for 100 s on the first day, 50 s on the second: 100 L and 50 L.

    In the past day 50 L, and the cistern has 43.75 m3 that can be pumped. A watcher that has just
    begun states nothing, and later since when it knows.
    """
    graph = watched("live")
    runs = {1200: (1000, 100), 129_600: (100_000, 50)}
    for second, given in (
        (1200, "not now"), (7200, "given: 100 L since 00:00:19"), (129_600, "given: 50 L today"),
        (7 * 86_400 + 60, "given: 0 L today, 150 L in the past 7 days"),
    ):
        for begin, lasts in [runs[second]] if second in runs else []:
            add_values(graph, begin, begin + lasts, {"/pump/flow": 1e-3})
            add_values(graph, begin + lasts, begin + lasts + 1, {"/pump/flow": 0.0})
        graph.update(100.0, START / 1e9 + second)
        tile = tile_of(graph, "watering")
        assert (tile["sentence"] or tile["value"]) == given
        if second == 129_600:
            add_values(graph, second, second + 1, QUIET)
            assert "enough for 875 days at the use of the past 1 day" in (
                tile_of(graph, "cistern")["sentence"]
            )


@pytest.mark.parametrize(("measured", "frost", "value", "sentence"), [
    (-1.5, 1.0, "-1.5 °C", "measured; the pump stays off until it is above 0 °C"),
    (8.0, 0.0, "8.0 °C", "measured"),
    (None, 1.0, "0 °C or below",
     "according to the forecast; the pump stays off until it is above 0 °C"),
    (None, 0.0, "above 0 °C", "according to the forecast"),
    (None, math.nan, "unknown", ""),  # its publisher does not know it
])
def test_the_temperature(measured: float | None, frost: float, value: str, sentence: str) -> None:
    more = {} if measured is None else {"gauge_temperature": measured}
    graph = watched("live", weather_frost=frost, **more)
    tile = tile_of(graph, "temperature")
    assert (tile["value"], tile["sentence"]) == (value, sentence)
    assert tile_of(graph, "temperature", 161.0)["value"] == "unknown"


def test_the_pump_nodes_word_is_of_now_though_the_flow_is_old() -> None:
    graph = watched("live")
    shown(graph, 100.0)
    pump_says(graph, 130.0, "fault: the drive reports: brake check")
    tile = tile_of(graph, "pump", 130.0)
    assert (tile["value"], tile["stale"]) == ("fault", False)
    assert tile["sentence"].startswith("last known 0.0 L/min")


def test_a_plan_goes_with_its_controller() -> None:
    """A controller that has run for 30 s did not make a plan that is 60 s old."""
    graph = watched("live")
    graph.update(100.0, MINUTE / 1e9 + 60)
    graph.add_plan(MINUTE, plan_of((7200.0, 1e-3, 0.045)))
    for up_s, is_shown in ((90.0, True), (30.0, False), (61.0, True)):
        graph.add_statuses(100.2, node("/mpc", "controller", up_s=up_s))
        assert bool(line_of(graph, "flow_planned")) == is_shown


@pytest.mark.parametrize(("hours", "sentence"), [
    (0.9, "4.3 mm expected in the next 12 h"),
    (2.0, "4.3 mm expected in the next 12 h, according to the forecast from 00:00"),
    (7.0, "the latest forecast, from 00:00, is too old"),
    (49.0, "no current forecast: the forecast from 20 Jul 00:00 has ended"),
])
def test_a_forecast_has_an_age(hours: float, sentence: str) -> None:
    """While it is published, it is as old as its issue, and the weather node withholds old ones."""
    graph, now = watched(), round(hours * 3600)
    rain = np.full(len(growing_steps(48)) - 1, 1e-7)
    forecast(graph, START, rain, 48)
    add_values(graph, now, now + 1, QUIET)
    assert tile_of(graph, "rain")["sentence"] == sentence
    if hours >= 2:
        forecast(graph, START + now * SECOND, rain, 48, issued=START / 1e9)
        assert tile_of(graph, "rain")["sentence"].startswith(
            "4.3 mm expected in the next 12 h, according to the forecast from "
        )


def test_a_flood_leaves_a_short_document() -> None:
    """10,000 statuses a message, texts of 1 MB: memory is bounded, and own alarms come first."""
    graph, long = watched("live"), "ä" * 1_000_000
    own = alarm("/pump: drive", "pump", "drive_lost", "no connection")
    tracemalloc.start()
    for turn in range(3):
        flood = [
            alarm(f"/{turn} {number} {long[:100]}", "", "", long[:20_000], number % 3 + 1)
            for number in range(1000)
        ]
        graph.add_alarms(100.0, START, [*flood, own])
        graph.add_statuses(100.0, [status for number in range(100) for status in node(
            f"/n{number}", "weather", process=long[:20_000]
        )])
    del flood
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < 5_000_000
    document = shown(graph)
    assert document["alarms"][0]["id"] == "/pump: drive"
    assert any("more alarms are not shown" in note for note in document["notes"])


# --- charts -------------------------------------------------------------------------------------


def test_the_charts_show_the_past_before_an_empty_future() -> None:
    """At most as much of the future as of the past, and none without a forecast or a plan."""
    graph, at = watched(), START / 1e9
    series = read_series(graph, 12)
    assert (series["from"], series["now"], series["to"]) == (at + 19, at + 60, at + 60)
    assert line_of(graph, "roof")[-1] == [60, 45.7] and series["display"]["roof"]["unit"] == "mm"
    assert line_of(graph, "target") == [[19, 45.7], [60, 45.7]]
    graph.add_plan(MINUTE, plan_of((30.0, 0, 0.045), (43_200.0, 1e-3, 0.046)))
    assert read_series(graph, 12)["to"] == at + 101
    assert line_of(graph, "flow_planned") == [[60, 0.0], [90, 60.0], [101, 60.0]]
    assert line_of(graph, "roof_planned") == [[90, 45.0]]
    add_values(graph, 4 * 3600, 4 * 3600 + 1, QUIET)
    series = read_series(graph, 3)
    assert (series["to"] - series["now"], series["now"] - series["from"]) == (10_800, 10_800)


@pytest.mark.parametrize(("seconds", "gaps"), [(10, 0), (3000, 0), (9001, 4)])
def test_what_is_a_gap_of_a_line(seconds: int, gaps: int) -> None:
    """Three ticks, but at least 10 min; here a tick of 3000 s."""
    graph = store(site=replace(SITE, tau=float(min(seconds, 3000))))
    add_values(graph, 0, 12 * 3600, {"/roof/level": 0.04}, every=seconds)
    assert sum(level is None for _, level in line_of(graph, "roof", 12)) == gaps


# --- the site's clock ---------------------------------------------------------------------------


@pytest.mark.parametrize(("zone", "utc_offset", "text"), [
    (None, -5.0, "2021-07-20 00:01:00 UTC-05:00"),
    (None, None, "2021-07-20 05:01:00 UTC"),
    ("America/Toronto", -5.0, "2021-07-20 01:01:00 EDT"),
    ("Australia/Adelaide", 9.5, "2021-07-20 14:31:00 ACST"),  # winter there
])
def test_times_are_by_the_sites_clock(
    zone: str | None, utc_offset: float | None, text: str
) -> None:
    """By its time zone with daylight saving, as quiet hours are, and the clock has a name."""
    graph = watched()
    graph.set_site(replace(SITE, time_zone=zone, utc_offset=utc_offset))
    forecast(graph, MINUTE, np.full(12, 1e-7))
    graph.add_alarms(100.0, START, [alarm("/pump: drive", "pump", "drive_lost", "lost",
                                          since="2021-07-20T05:01:00+00:00")])
    document = shown(graph)
    assert document["time"]["text"] == text
    assert document["alarms"][0]["since_text"] == text[11:19]
    assert ZoneInfo(document["time"]["zone"]) if zone else document["time"]["zone"][3] == ":"


# --- words --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("text", "expected"), [
    (words.write_horizon(43_200), "12 h"),
    (words.write_clock_time(1_626_757_199, STANDARD, 1_626_757_300), "19 Jul 23:59:59"),
    (words.write_coming_time(1_626_757_200, STANDARD, 1_626_757_100), "tomorrow 00:00"),
    (words.write_number(1e15, 1), "unknown"),
])
def test_as_an_operator_reads_it(text: str, expected: str) -> None:
    """Dates have plain spaces, quantities spaces at which no line ends (U+00A0)."""
    assert text == (expected if ":" in expected else expected.replace(" ", "\u00a0"))


# --- a part that cannot be made ---------------------------------------------------------------


@pytest.mark.parametrize("place", [
    "tiles.make_rain_tile", "tiles.make_pump_tile", "tiles.make_watering_tile",
    "tiles.describe_wait", "words.convert_time", "document.list_alarms", "store.GraphStore.update",
    "document.describe_stop",
])
def test_if_a_part_cannot_be_shown_the_pump_can_be_stopped(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = watched("live")
    pump_says(graph, 100.0, "running", at_rest=False)
    monkeypatch.setattr(f"greenroof_ros.watch.{place}", fail)
    document = shown(graph)
    assert document["stop"]["possible"] and document["stop"]["label"] == "Stop the pump"
    assert document["tiles"].keys() == {
        "roof", "cistern", "pump", "watering", "rain", "temperature", "summary",
    }
    assert any("cannot be shown (ZeroDivisionError: a bug)" in note for note in document["notes"])
    assert document["tiles"]["summary"]["level"] != "ok"


def test_quiet_hours_are_no_warning() -> None:
    """Every night: the pump is off as intended, which is no alarm."""
    graph = watched("live")
    why = "quiet hours are in force until 07:00"
    pump_says(graph, 100.0, f"held: {why}", at_rest=True)
    document = shown(graph)
    pump = document["tiles"]["pump"]
    assert (pump["state"], pump["value"], pump["why"]) == ("off", "off", why)
    assert document["tiles"]["summary"]["level"] == "ok"
