"""Alarms and events, from statuses as nodes and hostile senders put them on /diagnostics."""

from __future__ import annotations

import json
import sys
import time
import tracemalloc
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenroof_ros.common.conditions import read_conditions
from greenroof_ros.pumping.interlocks import INTERLOCKS, LATCHED
from greenroof_ros.watch.alarms import FOREIGN, OTHER, Alarms, advise, find_causes
from greenroof_ros.watch.registry import Trouble
from greenroof_ros.watch.wire import Status

OK, WARN, ERROR, STALE = range(4)
STOPPED = "an operator stopped it"


def node(
    name: str, role: str, *parts: tuple[Any, ...], process: str = "host 1",
    state: str = "ready", **values: Any,
) -> list[Status]:
    """Return what a node says: its own status, and those of its parts.

    Of each part its name, level and sentence, and where it matters its code and the code of its
    cause.
    """
    pairs = {"role": role, "process": process, **values}
    own = {key: json.dumps(value) for key, value in pairs.items()}
    return [
        Status(name, OK, state, "host", own),
        *(
            Status(
                f"{name}: {part}", level, text, "host",
                dict(zip(("code", "cause"), codes, strict=False)),
            )
            for part, level, text, *codes in parts
        ),
    ]


def rows(alarms: Alarms) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in alarms.rows()}


def present(alarms: Alarms) -> list[str]:
    return [row["id"] for row in alarms.rows() if row["over"] is None]


def happened(alarms: Alarms) -> list[str]:
    """Return the events, the oldest first."""
    return [event["what"] for event in reversed(alarms.events())]


def test_an_alarm_comes_changes_its_numbers_and_goes() -> None:
    alarms = Alarms()
    good, bad = ("drive", OK, "connected"), ("drive", ERROR, "no connection for 1 s", "drive_lost")
    alarms.hear(0.0, 1000.0, node("/pump", "pump", good))
    assert (alarms.rows(), alarms.worst(), alarms.advice()) == ([], "ok", "Nothing to do.")
    alarms.hear(0.25, 1005.0, node("/pump", "pump", bad))
    assert alarms.worst() == "error"
    alarms.hear(0.5, 1010.0, node("/pump", "pump", ("drive", ERROR, "no connection for 6 s")))
    (row,) = alarms.rows()
    assert (row["what"], row["level"], row["since"]) == ("no connection for 6 s", "error", 1005.0)
    assert not row["since_at_least"]
    assert row["over"] is None
    alarms.hear(0.75, 1015.0, node("/pump", "pump", good))
    (row,) = alarms.rows()
    assert (row["since"], row["over"], alarms.worst()) == (1005.0, 1015.0, "ok")
    assert (row["since_text"], row["over_text"]) == ("00:16:45", "00:16:55")
    assert alarms.rows(lambda at: f"at {at:g}")[0]["since_text"] == "at 1005"


def test_an_alarm_that_was_there_before_anybody_listened() -> None:
    """It is so for at least as long; one that comes later, or after a restart, is not."""
    alarms = Alarms()
    wrong, right = ("drive", ERROR, "no connection"), ("drive", OK, "connected")
    alarms.hear(0.0, 100.0, node("/pump", "pump", wrong))
    assert alarms.rows()[0]["since_at_least"]
    alarms.hear(0.25, 101.0, node("/pump", "pump", right))
    alarms.hear(20.0, 120.0, node("/pump", "pump", wrong))
    assert (alarms.rows()[0]["since"], alarms.rows()[0]["since_at_least"]) == (120.0, False)
    alarms.hear(20.25, 121.0, node("/mpc", "controller", ("inputs", OK, "good")))
    alarms.hear(20.5, 122.0, node("/mpc", "controller", ("inputs", ERROR, "bad")))
    assert not rows(alarms)["/mpc: inputs"]["since_at_least"]


def test_flapping_is_one_row() -> None:
    """On and off ten times a second: one alarm since the first time, acknowledged once."""
    alarms = Alarms()
    alarms.hear(0.0, 0.0, node("/pump", "pump", ("levels", OK, "good")))
    for step in range(1, 400):
        level = ERROR if step % 2 else OK
        alarms.hear(step / 10, float(step), node("/pump", "pump", ("levels", level, "/x jumped")))
        if step == 1:
            assert alarms.acknowledge("/pump: levels")
    (row,) = alarms.rows()
    assert (row["since"], row["acknowledged"], row["over"]) == (1.0, True, None)


def test_an_acknowledged_alarm_stays_listed_until_it_is_another_one() -> None:
    alarms = Alarms()
    assert not alarms.acknowledge("/pump: drive")
    said = node("/pump", "pump", ("drive", WARN, "the drive: overvoltage 3"))
    alarms.hear(0.0, 0.0, said)
    assert alarms.acknowledge("/pump: drive")
    alarms.hear(0.1, 1.0, node("/pump", "pump", ("drive", WARN, "the drive: overvoltage 4")))
    assert alarms.rows()[0]["acknowledged"]
    alarms.hear(0.2, 2.0, node("/pump", "pump", ("drive", ERROR, "the drive reports a fault")))
    assert not alarms.rows()[0]["acknowledged"]
    assert present(alarms) == ["/pump: drive"]


def test_two_faults_of_a_drive_are_two_alarms() -> None:
    """By the numbers that the drive gives them, although all else is the same."""
    alarms = Alarms()
    for number in (2310, 2320):
        fault = f"the drive reports: fault {number}"
        alarms.hear(0.0, 0.0, node(
            "/pump", "pump", ("drive", ERROR, f"reports a fault: {number}", "drive_fault"),
            ("pump", ERROR, f"fault: {fault}; no connection for {number} s", "drive_fault"),
            fault=fault,
        ))
        for row in alarms.rows():
            assert not row["acknowledged"], number
            alarms.acknowledge(row["id"])
    alarms.hear(0.0, 0.0, node(
        "/pump", "pump", ("pump", ERROR, f"fault: {fault}; no connection for 9 s", "drive_fault"),
        fault=fault,
    ))
    assert all(row["acknowledged"] for row in alarms.rows())


def test_what_is_over_is_kept_for_a_while() -> None:
    """The last 20, the newest first, behind those of now."""
    alarms = Alarms()
    parts = [("p" + str(number), ERROR, "bad") for number in range(24)]
    alarms.hear(0.0, 0.0, node("/pump", "pump", *parts))
    assert len(alarms.rows()) == 24
    for gone in range(24):
        good = [(name, OK, "good") for name, _, _ in parts[:gone + 1]]
        alarms.hear(gone + 1.0, gone + 1.0, node("/pump", "pump", *good, *parts[gone + 1:]))
    assert [row["over"] for row in alarms.rows()] == [float(at) for at in range(24, 4, -1)]


def test_a_node_that_is_not_heard() -> None:
    """After 2 s, as one alarm: what was wrong with it before follows from that, as last said."""
    alarms = Alarms()
    said = node("/pump", "pump", ("drive", ERROR, "no connection"), ("levels", OK, "good"))
    alarms.hear(0.0, 0.0, said)
    alarms.look(1.9, 10.0)
    assert present(alarms) == ["/pump: drive"]
    alarms.look(2.1, 20.0)
    assert present(alarms) == ["/pump", "/pump: drive"]
    row = rows(alarms)["/pump"]
    assert (row["level"], row["since"], alarms.worst()) == ("stale", 20.0, "error")
    assert rows(alarms)["/pump: drive"]["follows"] == "/pump"
    assert "Nobody here knows whether the pump runs" in alarms.advice()
    alarms.hear(3.0, 30.0, said)
    assert present(alarms) == ["/pump: drive"]


def test_a_part_that_its_node_does_not_mention_any_more() -> None:
    alarms = Alarms()
    alarms.hear(0.0, 0.0, node("/pump", "pump", ("drive", OK, "connected")))
    for step in range(1, 10):
        alarms.hear(step / 4, float(step), node("/pump", "pump"))
    assert [(row["id"], row["level"]) for row in alarms.rows()] == [("/pump: drive", "stale")]


@pytest.mark.parametrize("state", ["finished", "ended"])
def test_the_end_is_no_alarm(state: str) -> None:
    alarms = Alarms()
    alarms.hear(0.0, 0.0, node("/plant", "plant", ("x", ERROR, "bad")))
    alarms.hear(0.5, 1.0, node("/plant", "plant", ("x", ERROR, "bad"), state=state))
    alarms.look(60.0, 2.0)
    assert present(alarms) == []
    assert state in happened(alarms)[0]


def test_a_node_that_failed_says_why() -> None:
    alarms = Alarms()
    why = "[Errno 28] No space left on device"
    alarms.hear(0.0, 0.0, node("/recorder", "recorder"))
    alarms.hear(0.5, 1.0, node("/recorder", "recorder", state="ended", failure=why))
    alarms.look(60.0, 2.0)
    (row,) = alarms.rows()
    assert (row["level"], row["what"], row["over"]) == ("error", f"ended: {why}", None)
    assert row["do"] == "Mend what it says, and start it again."


def test_a_restart_is_an_event_and_begins_anew() -> None:
    """What the process before said of its parts is over."""
    alarms = Alarms()
    alarms.hear(0.0, 0.0, node("/pump", "pump", ("drive file", WARN, "not verified")))
    alarms.hear(5.0, 10.0, node("/pump", "pump", process="host 2", state="starting"))
    assert happened(alarms) == ["/pump was started again"]
    assert present(alarms) == []
    assert alarms.rows()[0]["over"] == 10.0


def test_two_processes_of_one_name() -> None:
    """Not a restart each time: an alarm, for as long as both are heard."""
    alarms = Alarms()
    for step in range(20):
        alarms.hear(step / 4, float(step), node("/pump", "pump", process=f"host {step % 2}"))
    (row,) = alarms.rows()
    assert row["what"] == "two processes report under this name: host 0 and host 1"
    assert "Two programs" in row["do"]
    assert happened(alarms) == ["/pump was started again"]
    for step in range(20, 40):
        alarms.hear(step / 4, float(step), node("/pump", "pump", process="host 1"))
    assert present(alarms) == []


def test_a_node_that_waits_for_another() -> None:
    """It has a few seconds; then it names whom."""
    alarms = Alarms()
    for step in range(40):
        said = node("/mpc", "controller", state="starting", waiting=["roof_sensor", "weather"])
        alarms.hear(step / 4, float(step), said)
        if step / 4 == 4.5:
            assert alarms.rows() == []
    (row,) = alarms.rows()
    assert (row["level"], row["what"]) == ("warn", "waits for roof_sensor, weather")


def test_values_that_are_refused() -> None:
    """While the count grows, and 2 s longer; what was refused before is no news."""
    alarms = Alarms()
    for step, count in enumerate([7, 7, 8, 9, *[9] * 12]):
        alarms.hear(
            step / 4, float(step), node("/mpc", "controller", refused={"/forecast/rain": count})
        )
        assert (present(alarms) == ["/mpc: refused"]) == (2 <= step <= 11), step
    assert rows(alarms)["/mpc: refused"]["what"] == (
        "values of /forecast/rain are refused: not plausible"
    )


def test_events_of_parameters() -> None:
    """Of a run all changes are kept, live the newest 20 and their count."""
    alarms = Alarms()

    def change(to: float) -> dict[str, Any]:
        return {"tick": 3, "parameter": "weight", "before": 1.0, "value": to}

    changes = [change(float(number)) for number in range(25)]
    for step, known in enumerate((1, 2, 2)):
        alarms.hear(step / 4, 0.0, node("/mpc", "controller", parameter_changes=changes[:known]))
    for known in (20, 20, 22, 25):
        alarms.hear(1.0, 0.0, node(
            "/onoff", "controller", parameter_changes=changes[max(0, known - 20):known],
            parameter_change_count=known,
        ))
    assert happened(alarms) == [
        "/mpc: weight was changed from 1.0 to 1.0",
        *(f"/onoff: weight was changed from 1.0 to {number}.0" for number in range(20, 25)),
    ]


def test_events_of_a_stop_and_a_fault() -> None:
    alarms = Alarms()
    overheat = "the drive reports: overheat"
    for stop, fault in (("", ""), (STOPPED, ""), (STOPPED, ""), ("", ""), ("", overheat), ("", "")):
        alarms.hear(0.0, 5.0, node("/pump", "pump", stop=stop, fault=fault))
    assert happened(alarms) == [
        "stop was asked for: the pump is held off", "the stop was released",
        "the pump is off until it is reset: the drive reports: overheat", "the fault was reset",
    ]
    alarms.add_event(6.0, "a new forecast came")
    assert alarms.events()[0] == {"at": 6.0, "at_text": "00:00:06", "what": "a new forecast came"}
    for number in range(100):
        alarms.add_event(7.0, str(number))
    assert len(alarms.events()) == 50


def test_a_silent_sensor_is_one_cause() -> None:
    """The sensor comes first; the rest follows from that, the pump's state before all others."""
    alarms = Alarms()
    silent = "/cistern/level is older than 5 s (level_limit)", "input_silent"
    alarms.hear(0.0, 0.0, [
        *node("/onoff", "controller", ("inputs", ERROR, *silent)),
        *node(
            "/pump", "pump",
            ("pump", WARN, "held: not known", "cistern_level_unknown", "input_silent"),
            ("levels", ERROR, *silent), ("delivery", WARN, "blind for 3 s", "delivery_blind"),
        ),
        *node("/cistern_sensor", "cistern_sensor", ("sensor", ERROR, "no answer", "sensor_lost")),
    ])
    cause = "/cistern_sensor: sensor"
    assert [(row["id"], row["follows"]) for row in alarms.rows()] == [
        (cause, None), ("/pump: pump", cause), ("/onoff: inputs", cause), ("/pump: levels", cause),
        ("/pump: delivery", cause),
    ]
    assert alarms.advice() == rows(alarms)[cause]["do"]


@pytest.mark.parametrize(("code", "said", "advice"), [
    ("drive_lost", {"stands": False, "speed": None}, "Go and see"),
    ("drive_fault", {"stands": False, "speed": None}, "/pump/reset"),
    ("delivery", {"stands": True}, "/pump/reset"),
    ("operator_stop", {"stands": True, "stop": STOPPED}, "data: false"),
    ("operator_stop", {"stands": False, "speed": 0.8, "stop": STOPPED}, "at its drive's panel"),
    ("record_unknown", {"stands": True}, "data: false"),
])
def test_a_state_of_the_pump_that_its_cause_does_not_tell(
    code: str, said: dict[str, Any], advice: str
) -> None:
    """Its own advice stands first: no reset, release or look is left out for the drive's sake."""
    alarms = Alarms()
    alarms.hear(0.0, 0.0, node(
        "/pump", "pump", ("drive", ERROR, "no connection", "drive_lost"),
        ("pump", ERROR, "why", code), **said,
    ))
    assert [(row["id"], row["follows"]) for row in alarms.rows()] == [
        ("/pump: pump", None), ("/pump: drive", None),
    ]
    assert advice in alarms.advice()
    alarms.look(2.1, 2.1)  # what a node said last that is not heard any more
    assert rows(alarms)["/pump: pump"]["follows"] is None
    assert "Nobody here knows whether the pump runs" in alarms.advice()


@pytest.mark.parametrize(("state", "part", "code"), [
    ("drive_lost", "drive", "drive_lost"), ("not_active", "drive timeout", "drive_timeout"),
    ("no_permit", "supervisor", "no_permit"), ("two_controllers", "command", "two_controllers"),
    ("roof_level_unknown", "levels", "input_frozen"), ("frost", "frost", "frost"),
    ("frost_unknown", "frost", "temperature_unknown"),
])
def test_a_state_follows_from_the_part_that_says_more(state: str, part: str, code: str) -> None:
    """And from no other part of the pump."""
    for said, follows in ((part, f"/pump: {part}"), ("state file", None)):
        alarms = Alarms()
        alarms.hear(0.0, 0.0, node(
            "/pump", "pump", ("pump", WARN, "off: why", state), (said, ERROR, "what", code)
        ))
        assert rows(alarms)["/pump: pump"]["follows"] == follows


def test_every_code_has_its_advice() -> None:
    """Those of nodes, and those that are seen from here; what asks for a hand names the service."""
    for code in read_conditions():
        for role in ("pump", "controller", "weather", "plant"):
            do, known = advise(code, role, "/site1/pump")
            assert known and do, code
            assert "{" not in do.replace("{data: false}", ""), code
        assert advise(code, "", "/camera") == (FOREIGN, False)
    for code, one in INTERLOCKS.items():
        service = "/site1/pump/reset" if one.kind == LATCHED else "/site1/pump/stop"
        if one.kind == LATCHED or code in ("operator_stop", "record_unknown"):
            assert service in advise(code, "pump", "/site1/pump")[0]
    assert advise("of another version", "pump", "/pump") == (OTHER, False)


def test_no_error_follows_from_a_warning() -> None:
    """Neither by itself nor through another one; what is not heard may, and then counts for it."""
    start = {"state": "starting", "waiting": ["plant"]}
    waits = node("/mpc", "controller", ("inputs", ERROR, "bad", "input_waiting"), **start)
    alarms = Alarms()
    for at in range(0, 25):
        alarms.hear(at / 4, float(at), waits)
    assert [(row["id"], row["follows"]) for row in alarms.rows()] == [
        ("/mpc: inputs", None), ("/mpc", None),
    ]
    assert alarms.counts() == (1, 1, 0)
    pump = node(
        "/pump", "pump", ("command", STALE, "no command", "no_command"),
        ("pump", WARN, "off: no command", "no_command"),
    )
    waits = node("/mpc", "controller", ("inputs", OK, "good"), **start)
    for at in range(25, 30):
        alarms.hear(at / 4, float(at), [*waits, *pump])
    assert {one: rows(alarms)[one]["follows"] for one in present(alarms)} == {
        "/mpc": None, "/pump: command": "/mpc", "/pump: pump": "/mpc",
    }
    assert (alarms.counts(), alarms.worst()) == ((1, 0, 2), "error")
    chain = {
        "/pump: inputs": Trouble(ERROR, "old", "input_silent", "pump", "inputs"),
        "/pump: command": Trouble(STALE, "old", "no_command", "pump", "command"),
        "/mpc": Trouble(WARN, "waits", "waits", "controller", names=("plant",)),
    }
    assert find_causes(chain) == {"/pump: inputs": "/pump: command"}
    assert find_causes(dict(reversed(chain.items()))) == {"/pump: command": "/mpc"}


def test_the_order_of_alarms() -> None:
    """The pump's state, then errors, what is stale and warnings; other devices last."""
    alarms = Alarms()
    other = Status("/camera", ERROR, "no picture", "camera")
    alarms.hear(0.0, 0.0, [other, *node("/mpc", "controller")])
    alarms.hear(2.5, 1.0, [
        other,
        *node("/weather", "weather", ("rain gauge", WARN, "/gauge/precipitation is older")),
        *node("/recorder", "recorder", ("recording", ERROR, "nothing is recorded: full")),
        *node("/pump", "pump", ("limits", WARN, "5 m3 are outstanding"),
              ("pump", WARN, f"held: {STOPPED}", "operator_stop")),
    ])
    assert present(alarms) == [
        "/pump: pump", "/recorder: recording", "/mpc", "/weather: rain gauge", "/pump: limits",
        "/camera",
    ]
    assert "data: false" in alarms.advice()
    assert "/pump/stop" in alarms.advice()


def test_a_second_controller_is_its_own_cause() -> None:
    """Not that the pump's inputs, or the second one's, are not good for it; refused values too."""
    alarms = Alarms()
    two = "two publishers", "two_controllers"
    alarms.hear(0.0, 0.0, [
        *node("/mpc", "controller", ("inputs", WARN, "has not come yet", "input_waiting")),
        *node("/pump", "pump", ("pump", WARN, *two), ("command", ERROR, *two),
              ("inputs", ERROR, "two publishers", "input_publishers"), refused={}),
    ])
    alarms.hear(0.1, 0.0, node("/pump", "pump", refused={"/pump/command": 3}))
    assert {row["id"]: row["follows"] for row in alarms.rows()} == {
        "/pump: pump": "/pump: command", "/pump: command": None, "/mpc: inputs": None,
        "/pump: inputs": "/pump: command", "/pump: refused": "/pump: command",
    }
    assert "Two programs do the same work" in alarms.advice()


def test_advice_is_on_what_is_new() -> None:
    """What was acknowledged comes after what was not; among equals, the newest is first."""
    alarms = Alarms()
    file = ("drive file", WARN, "was not verified", "drive_file_unverified")
    blind = ("delivery", WARN, "blind for 3 s", "delivery_blind")
    alarms.hear(0.0, 0.0, node("/pump", "pump", file))
    alarms.hear(0.1, 1.0, node("/pump", "pump", file, blind))
    assert present(alarms) == ["/pump: delivery", "/pump: drive file"]
    alarms.acknowledge("/pump: delivery")
    assert present(alarms) == ["/pump: drive file", "/pump: delivery"]
    assert alarms.advice() == rows(alarms)["/pump: drive file"]["do"]
    alarms.acknowledge("/pump: drive file")
    assert alarms.advice() == rows(alarms)["/pump: delivery"]["do"]


def test_a_namespace_has_its_own_alarms() -> None:
    """Another graph's nodes are other devices, and never say what this one's pump does."""
    alarms = Alarms("/site1")
    alarms.hear(0.0, 0.0, [
        *node("/site2/pump", "pump", ("pump", ERROR, "fault: burst"), flow=2.0, stop=STOPPED),
        *node("/site1/pump", "pump", ("pump", WARN, "held", "operator_stop"), flow=1.0),
        *node("/site1/mpc", "controller"),
    ])
    pump, controller = (alarms.registry.node(role) for role in ("pump", "controller"))
    assert pump is not None and controller is not None
    assert (pump.name, pump.values["flow"], pump.state) == ("/site1/pump", 1.0, "ready")
    assert (pump.process, controller.name) == ("host 1", "/site1/mpc")
    assert present(alarms) == ["/site1/pump: pump", "/site2/pump: pump"]
    assert "/site1/pump/stop" in alarms.advice()
    assert alarms.registry.node("weather") is None


@pytest.mark.parametrize("state", ["finished", "ended"])
def test_the_end_of_another_graph_is_no_alarm(state: str) -> None:
    """Nor of its nodes' parts, of which the last word may say nothing; one that goes on is."""
    alarms = Alarms("/site1")
    inputs = ("inputs", OK, "good")
    for step in range(8):
        alarms.hear(step / 4, float(step), [
            *node("/site2/mpc", "controller", inputs), *node("/site2/pump", "pump", inputs),
        ])
    alarms.hear(2.0, 8.0, node("/site2/mpc", "controller", state=state))
    for wall in (6.0, 7.1, 60.0):
        alarms.look(wall, wall)
    assert present(alarms) == ["/site2/pump", "/site2/pump: inputs"]
    alarms.hear(61.0, 61.0, node("/site2/mpc", "controller", ("inputs", ERROR, "bad")))
    assert "/site2/mpc: inputs" in present(alarms)


def test_other_devices() -> None:
    """They have 5 s, and one that spoke only once is not missed; they never make an error here."""
    alarms = Alarms()
    once, often = Status("/camera", OK, "fine", "c"), Status("disk usage", ERROR, "99 %", "host")
    alarms.hear(0.0, 0.0, [once, often])
    assert (present(alarms), alarms.worst()) == (["disk usage"], "warn")
    assert alarms.counts() == (0, 1, 0)
    alarms.hear(1.0, 1.0, [often])
    alarms.look(5.9, 6.0)
    assert alarms.rows()[0]["level"] == "error"
    alarms.look(6.1, 7.0)
    assert [(row["id"], row["level"]) for row in alarms.rows()] == [("disk usage", "stale")]


# --- hostile --------------------------------------------------------------------------------------

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
    Status, _TEXTS, st.integers(-(2**70), 2**70) | st.sampled_from([0, 1, 2, 3]), _TEXTS, _TEXTS,
    st.dictionaries(
        st.sampled_from([
            "role", "refused", "stop", "fault", "warnings", "waiting", "parameter_changes",
            "failure", "parameter_change_count",
        ]) | _TEXTS, _TEXTS, max_size=8,
    ),
)


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0.0, 0.1, 3.0]), st.lists(_STATUSES, max_size=6)),
                max_size=6))
def test_nothing_that_is_said_raises(messages: list[tuple[float, list[Status]]]) -> None:
    """And all that is shown can be printed and sent as JSON in UTF-8."""
    alarms, wall = Alarms(), 0.0
    for passed, statuses in messages:
        wall += passed
        alarms.hear(wall, wall, statuses)
        alarms.look(wall, wall)
        for row in alarms.rows():
            alarms.acknowledge(row["id"])
        shown = [alarms.rows(), alarms.events(), alarms.worst(), alarms.advice(),
                 alarms.registry.mode(wall), alarms.registry.two_pumps(wall)]
        json.dumps(shown, allow_nan=False)
        for row in alarms.rows():
            row["what"].encode()
            assert row["what"].isprintable()
            assert row["id"].isprintable()
            assert len(row["what"]) <= 501


def test_a_flood_crowds_nobody_out() -> None:
    """10,000 statuses an array and texts of a megabyte: the graph's own stay, memory does not grow.

    The names of own nodes are forged, too, from before the graph was there.
    """
    alarms = Alarms()
    long = "x" * 1_000_000
    forged = [
        one for number in range(100) for one in node(f"/n{number}", "pump", ("p", ERROR, "!"))
    ]

    def flood(turn: int) -> list[Status]:
        return [
            *(Status(f"/{turn} {number} {long[:100]}", number % 4, long, long, {"a": long})
              for number in range(10_000)),
            *forged,
        ]

    alarms.hear(0.0, 0.0, node("/pump", "pump", ("drive", ERROR, "no connection")))
    own = node("/pump", "pump", ("drive", ERROR, "no connection"), flow=1.0)
    took = []
    for turn in range(1, 5):
        statuses = [*flood(turn), *own]
        began = time.process_time()
        alarms.hear(turn / 4, 1.0, statuses)
        took.append(time.process_time() - began)
    assert min(took) < 1.0
    tracemalloc.start()
    for turn in range(5, 7):
        alarms.hear(turn / 4, 1.0, [*flood(turn), *own])
        alarms.rows()
    statuses.clear()
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < 300_000
    rest = alarms.rows()
    assert len(rest) == 100
    assert "/pump: drive" in [row["id"] for row in rest]
    assert len(json.dumps(rest)) < 200_000
    assert alarms.registry.pump(1.5) is not None


def test_values_that_are_no_numbers() -> None:
    """Not finite, 401 digits, nested 100,000 deep: None, or not believed at all."""
    alarms = Alarms()
    texts = {
        "role": '"pump"', "process": '"p"',
        "flow": "NaN", "tick": "9" * 401, "pump": "1e999", "level": "-Infinity",
        "active": "true", "fault": '"x"',
    }
    alarms.hear(0.0, 0.0, [Status("/pump", OK, "ready", "p", texts)])
    pump = alarms.registry.node("pump")
    assert pump is not None
    values = [pump.values[key] for key in texts]
    assert values == ["pump", "p", None, None, None, None, True, "x"]
    deep = "[" * 100_000 + "]" * 100_000
    assert len(deep) > sys.getrecursionlimit()
    deep = {"role": '"pump"', "flow": deep[50_001:-50_001]}  # short enough to be looked at
    alarms.hear(0.1, 0.0, [Status("/pump", OK, "ready", "q", deep)])
    assert alarms.registry.node("pump") is pump


def test_a_watcher_that_stood_still_takes_nobody_for_silent() -> None:
    alarms = Alarms()
    alarms.hear(0.0, 0.0, [*node("/pump", "pump", ("drive", OK, "fine")), *node("/mpc", "x")])
    alarms.registry.forgive(6.0)
    alarms.hear(6.0, 6.0, node("/mpc", "x"))  # the first of those that waited
    assert alarms.rows() == []
    alarms.look(8.5, 8.5)
    assert {row["id"] for row in alarms.rows()} == {"/pump", "/mpc"}
