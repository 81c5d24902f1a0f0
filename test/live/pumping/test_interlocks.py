"""The table of interlocks, and who may end each; each row by its cause; all codes."""

from __future__ import annotations

import ast
import re
import time
from dataclasses import replace
from datetime import datetime
from string import Formatter
from typing import Any

import pytest
from paper import PAPER_SITE
from places import CHECKOUT
from pump_rig import Rig, settings_for

from greenroof_ros.interface.conditions import (
    INHIBIT,
    LATCHED,
    PERMISSIVE,
    Diagnosis,
    read_conditions,
    read_interlocks,
)
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.pumping.interlocks import clear_refusal, evaluate
from greenroof_ros.live.pumping.limits import pump_parameters
from greenroof_ros.live.pumping.pump_control import Decision


def codes(decision: Decision) -> list[str]:
    return list(decision.interlocks)


AT_NIGHT = replace(PAPER_SITE, quiet_hours=("22:00-24:00",), time_zone="UTC")
INTERLOCKS = read_interlocks()
CAUSES: dict[str, dict[str, Any]] = {
    "drive_fault": {"change": {"drive_fault": "overload"}},
    "turns_backwards": {"change": {"speed": -0.1}},
    "runs_on": {"command": 0.0, "stuck_speed": 0.6},
    "speed_not_followed": {"stuck_speed": 0.05},
    "delivery": {"command": 1.0, "arriving": 0.0, "leaving": 0.0},
    # Another code of the table, as in a record from another version of this package.
    "fault_unknown": {"record": {"fault": "it was so", "fault_code": "frost"}},
    "state_unknown": {"record": {"unknown": "whether there was a hold or a fault is unknown"}},
    "hold": {"record": {"hold_owner": "the page", "hold_until": 4_000_000_000.0}},
    "cistern_level_unknown": {"change": {"cistern_level": None}},
    "cistern_low": {"change": {"cistern_level": 0.1}},
    "roof_level_unknown": {"change": {"roof_level": None}},
    "frost_unknown": {"change": {"frost": None}},
    "frost": {"change": {"frost": True}},
    "quiet_hours": {"site": AT_NIGHT, "change": {"time_ns": 23 * 3600 * 10**9}},
    "max_run": {"settings": settings_for(PAPER_SITE, max_run=60.0)},
    "daily_volume": {"record": {"use": ((0.0, 1e6),)}},
    "daily_run": {"record": {"use": ((86_400.0, 0.0),)}},
    "command_unknown": {"command": None},
    "drive_speed_unknown": {"change": {"speed": None}},
    "drive_not_ready": {"change": {"drive_ready": False}},
}
"""changes to a rig with a running pump that cause each interlock but the pump node's own"""


@pytest.mark.parametrize("code", INTERLOCKS)
def test_each_keeps_the_pump_off_alone_and_clears_as_its_kind_does(code: str) -> None:
    """The state is its kind's. After the cause has gone, a latched one stays until it is reset.

    The minimum time on, 10 s, does not delay the stop.
    """
    own = {"change": {"reasons": [Diagnosis(code, "it is so")]}}
    broken = {"command": 0.5, "record": {}} | CAUSES.get(code, own)
    rig = Rig(
        x2=0.5, site=broken.pop("site", PAPER_SITE), settings=broken.pop("settings", None)
    )
    rig.run(15, 0.5)
    assert (rig.decisions[-1].interlocks, rig.decisions[-1].state) == ({}, "running")
    command, record = broken.pop("command"), broken.pop("record")
    rig.state_file.state = replace(rig.state_file.state, **record)
    for name, value in broken.items():
        setattr(rig, name, value)
    decision = rig.run(600, command, until=lambda decision: bool(decision.interlocks))
    assert (codes(decision), decision.speed) == ([code], None)
    kind = INTERLOCKS[code].kind
    assert decision.state in {
        LATCHED: ("fault",), INHIBIT: ("held",), PERMISSIVE: ("off", "stopping", "unknown"),
    }[kind]
    assert decision.why.startswith(decision.interlocks[code].sentence)
    rig.change, rig.stuck_speed, rig.arriving, rig.leaving = {}, None, 1.0, 1.0
    rig.state_file.state = replace(
        rig.state_file.state, hold_owner="", use=(),
    )
    rig.run(10, 0.0)  # the pump comes to rest, which ends a run that was too long
    decision = rig.run(45, 0.5)
    if kind == LATCHED:
        assert codes(decision) == [code]
        rig.reset()
        decision = rig.run(45, 0.5)
    assert (codes(decision), decision.state) == ([], "running")


def test_they_are_named_in_the_order_of_the_table() -> None:
    rig = Rig()
    rig.state_file.hold("the operator")
    rig.state_file.fault("burst pipe", "delivery")
    rig.change = {
        "frost": True, "roof_level": None, "reasons": [Diagnosis("drive_lost", "no answer")],
    }
    decision = rig.step(0.5)
    assert codes(decision) == ["delivery", "hold", "roof_level_unknown", "frost", "drive_lost"]
    assert decision.state == "fault"


def test_what_follows_is_not_said_next_to_its_cause() -> None:
    """A lost drive has no speed, and a node that is not active has no command."""
    rig = Rig()
    rig.change = {"speed": None, "reasons": [Diagnosis("drive_lost", "no connection")]}
    assert codes(rig.step(None)) == ["drive_lost"]
    rig.change = {"drive_ready": False}
    assert codes(rig.step(None)) == ["command_unknown"]
    alone = Diagnosis("drive_not_ready", "x")
    assert evaluate([alone]) == {"drive_not_ready": alone}


def test_faults_next_to_each_other() -> None:
    """The first stays; another one is named next to it while it lasts, unless it only follows.

    A drive that does not obey a stop, as the exchange finds it, is not a separate drive fault: a
    person must stop it, regardless of what the drive's manual states.
    """
    rig = Rig()
    rig.state_file.fault("burst pipe", "delivery")
    for change, expected in (
        ({"drive_fault": "overload"}, ["drive_fault", "delivery"]),
        ({"speed": -0.3, "drive_fault": "it turns backwards"}, ["turns_backwards", "delivery"]),
        ({"drive_fault": "it acknowledges *stop*", "runs_on": True}, ["runs_on", "delivery"]),
        ({}, ["delivery"]),
    ):
        rig.change = change
        assert codes(rig.step(0.5)) == expected
    assert rig.state_file.state.fault == "burst pipe"


def test_the_table_is_whole() -> None:
    """Latched ones first, then inhibits; each has limits that exist."""
    with pytest.raises(KeyError):
        evaluate([Diagnosis("holds", "x")])
    kinds = [row.kind for row in INTERLOCKS.values()]
    assert kinds == sorted(kinds, key=[LATCHED, INHIBIT, PERMISSIVE].index)
    settings = {parameter.name for parameter in pump_parameters(PAPER_SITE)}
    of_inputs = {
        topic.max_age.parameter for topic in read_topics().values() if topic.max_age
    }
    of_nodes = {
        "state_file", "recovery_time", "drive_timeout_limit", "local_settings_stop_the_pump",
        "unknown_frost_may_pump", "frozen_movement", "jump_tolerance",
    }
    named = {name for row in INTERLOCKS.values() for name in row.limit}
    assert named <= settings | of_inputs | of_nodes


# --- who may release and clear --------------------------------------------------------------------


def test_one_release_ends_a_hold_whoever_made_it() -> None:
    rig = Rig(x2=0.5)
    rig.run(15, 0.5)
    rig.state_file.hold("the page")
    decision = rig.step(0.5)
    assert decision.state == "held" and "; the pump is still turning, at 0.6" in decision.why
    rig.state_file.hold("the operator", "a leak")
    decision = rig.step(0.5)
    (sentence,) = (reason.sentence for reason in decision.interlocks.values())
    assert re.fullmatch(r"a hold by the operator since [-\d]+ [\d:]+\+00:00: a leak", sentence)
    rig.state_file.release()
    assert rig.run(60, 0.5).state == "running"


def test_no_release_starts_a_pump_sooner_than_it_may() -> None:
    """Neither a release nor clearing a fault starts it within 120 s."""
    rig = Rig(x2=0.5, settings=settings_for(PAPER_SITE, min_off=120.0))
    assert rig.run(200, 1.0, until=lambda decision: decision.state == "running").speed is not None
    rig.state_file.hold("the page", until=time.time() + 3600)
    rig.state_file.fault("it turns at another speed", "speed_not_followed")
    assert rig.run(5, 1.0).speed is None
    rig.state_file.release()
    rig.clear()
    assert rig.run(114, 1.0, until=lambda decision: decision.speed is not None).speed is None
    assert rig.run(5, 1.0).speed is not None


@pytest.mark.parametrize("code", [code for code, row in INTERLOCKS.items() if row.kind == LATCHED])
def test_a_fault_of_delivery_or_drive_needs_a_person_at_the_pump(code: str) -> None:
    """A speed that was not followed does not, however often."""
    rig = Rig(x2=0.5)
    rig.run(2, 0.0)
    assert clear_refusal(rig.state_file) == "there is no fault"
    for _ in range(3):
        rig.state_file.fault("why", code)
        if code != "speed_not_followed":
            assert "someone who has checked the pump" in clear_refusal(rig.state_file)
            return
        assert clear_refusal(rig.state_file) == ""
        rig.clear()
        assert rig.state_file.state.fault == ""


# --- the codes that the parts of the package report -----------------------------------------------

PACKAGE = CHECKOUT / "greenroof_ros"


def texts_in(tree: ast.AST) -> set[str]:
    return {
        node.value for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }


def test_what_is_reported_is_in_the_table_and_the_other_way_round() -> None:
    """Each ``Diagnosis.of`` has a code of the table, its cases, and all values of its sentences."""
    conditions, texts, reported = read_conditions(), set[str](), set[str]()
    rooms = "base", "interface", "ros", "nodes", "live", "watch", "live/pumping", "live/devices"
    for room in rooms:
        for file in (PACKAGE / room).glob("*.py"):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            texts |= texts_in(tree)
            for call in ast.walk(tree):
                if (
                    isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute)
                    and ast.unparse(call.func.value) == "Diagnosis"
                ):
                    reported |= check_problem(call)
    assert {"no_forecast", "limited", "state_not_kept"} <= reported
    of_inputs = {text for text in texts if text.startswith("input_") and text.isidentifier()}
    assert len(of_inputs) == 8
    assert reported | of_inputs <= conditions.keys() <= texts


def check_problem(call: ast.Call) -> set[str]:
    """Check a call with a code that is written out, and return that."""
    code, *cases = call.args
    if not isinstance(code, ast.Constant):
        return set()
    row = read_conditions()[code.value]
    if isinstance(row.sentence, str):
        templates = [row.sentence or row.meaning]
        assert not cases or ast.unparse(call.func) == "Diagnosis.if_any", code.value
    else:
        assert cases, code.value
        templates = [row.sentence[case] for each in cases for case in texts_in(each)]
    given = {keyword.arg for keyword in call.keywords} | {
        "why" for _ in cases if ast.unparse(call.func) == "Diagnosis.if_any"
    }
    if code.value.startswith("input_"):
        given |= {"topic"}  # the rules of the input add it
    needed = {name for text in templates for _, name, *_ in Formatter().parse(text) if name}
    assert needed <= given or None in given, (code.value, needed, given)
    return {code.value}


# --- when it may run ------------------------------------------------------------------------------


def test_quiet_hours_begin_and_end_by_the_wall_over_a_change_of_clocks() -> None:
    """On 8 March 2026 Toronto's clocks went from 02:00 (07:00 UTC) to 03:00, without a 02:30."""
    begins, ends = (
        datetime.fromisoformat(f"2026-03-08T{hour}:00+00:00").timestamp() for hour in ("07", "08")
    )
    site = replace(PAPER_SITE, quiet_hours=("02:30-04:00",), time_zone="America/Toronto")
    rig = Rig(x2=0.5, site=site)
    rig.now = begins - 30
    assert rig.run(30, 0.3).state == "running"
    decision = rig.step(0.3)
    assert (codes(decision), decision.speed) == (["quiet_hours"], None)
    assert decision.why.startswith("quiet hours are in force until 2026-03-08 04:00-04:00")
    rig.run(30, 0.3)
    rig.now = ends - 5
    assert [rig.step(0.3).speed for _ in range(5)] == [None] * 5
    assert rig.step(0.3).speed is not None


@pytest.mark.parametrize(
    ("worse", "change"),
    [("drive_fault", {"drive_fault": "overcurrent"}), ("turns_backwards", {"speed": -0.3})],
)
def test_what_the_page_may_clear_hides_nothing_that_it_may_not(
    worse: str, change: dict[str, Any]
) -> None:
    """The worse fault replaces the first for good, even if its cause goes and the first's comes."""
    rig = Rig(x2=0.5)
    rig.stuck_speed = 0.05
    decision = rig.run(60, 0.5, until=lambda decision: bool(decision.interlocks))
    assert codes(decision) == ["speed_not_followed"]
    assert clear_refusal(rig.state_file) == ""
    rig.stuck_speed, rig.change = 0.0, change
    rig.step(0.5)
    rig.change = {}
    assert rig.step(0.5).state == "fault"
    assert rig.state_file.state.fault_code == worse
    assert clear_refusal(rig.state_file)
    rig.stuck_speed = 0.05
    rig.run(60, 0.5)
    assert rig.state_file.state.fault_code == worse
