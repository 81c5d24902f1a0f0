"""The table of interlocks, and who may end each; each row by its cause; all codes."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from datetime import datetime
from string import Formatter
from typing import Any

import pytest
from paper import PAPER_SITE
from places import CHECKOUT
from pump_rig import LOST, NOT_READY, OVERLOAD, Rig, settings_for

from greenroof_ros.interface.conditions import (
    INHIBIT,
    LATCHED,
    PERMISSIVE,
    Diagnosis,
    read_conditions,
    read_interlocks,
)
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.pumping.interlocks import Decision, clear_refusal, evaluate
from greenroof_ros.live.pumping.limits import pump_parameters
from greenroof_ros.live.pumping.state_file import StateFile


def codes(decision: Decision) -> list[str]:
    return list(decision.active)


AT_NIGHT = replace(PAPER_SITE, quiet_hours=("22:00-24:00",), time_zone="UTC")
INTERLOCKS = read_interlocks()
CAUSES: dict[str, dict[str, Any]] = {
    "drive_fault": {"change": {"reasons": [OVERLOAD]}},
    "runs_on": {"command": 0.0, "stuck_speed": 0.6},
    "speed_not_followed": {"stuck_speed": 0.05},
    "delivery": {"command": 1.0, "arriving": 0.0, "leaving": 0.0},
    "state_unknown": {"record": {"unknown": "whether there was a hold or a fault is unknown"}},
    "hold": {"record": {"hold_owner": "the page", "hold_until": 4_000_000_000.0}},
    "cistern_level_unknown": {"change": {"cistern_level": None}},
    "cistern_low": {"change": {"cistern_level": 0.1}},
    "roof_level_unknown": {"change": {"roof_level": None}},
    "frost_unknown": {"change": {"frost": None}},
    "frost": {"change": {"frost": 1.0}},
    "quiet_hours": {"site": AT_NIGHT, "change": {"time_ns": 23 * 3600 * 10**9}},
    "max_run": {"settings": settings_for(PAPER_SITE, max_run=60.0)},
    "daily_volume": {"record": {"volumes": (1e6,)}},
    "command_unknown": {"command": None},
    "drive_not_ready": {"change": {"reasons": [NOT_READY]}},
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
    assert (rig.decisions[-1].active, rig.decisions[-1].state) == ({}, "running")
    command, record = broken.pop("command"), broken.pop("record")
    rig.state_file.state = replace(rig.state_file.state, **record)
    for name, value in broken.items():
        setattr(rig, name, value)
    decision = rig.run(600, command, until=lambda decision: bool(decision.active))
    assert (codes(decision), decision.request) == ([code], None)
    kind = INTERLOCKS[code].kind
    assert decision.state in {
        LATCHED: ("fault",), INHIBIT: ("held",), PERMISSIVE: ("off", "stopping", "unknown"),
    }[kind]
    assert decision.why.startswith(decision.active[code].sentence)
    rig.change, rig.stuck_speed, rig.arriving, rig.leaving = {}, None, 1.0, 1.0
    rig.state_file.state = replace(rig.state_file.state, hold_owner="", volumes=())
    rig.run(65, 0.0)  # a run that was too long is followed by as long a rest
    decision = rig.run(45, 0.5)
    if kind == LATCHED:
        assert codes(decision) == [code]
        rig.reset()
        decision = rig.run(45, 0.5)
    assert (codes(decision), decision.state) == ([], "running")


def test_they_are_named_in_the_order_of_the_table() -> None:
    """Without what only follows: a lost drive is not ready. A fault of another version stays."""
    rig = Rig()
    rig.state_file.hold("the operator")
    rig.state_file.change(fault="burst pipe", fault_code="delivery")
    rig.change = {
        "frost": 1.0, "roof_level": None, "reasons": [Diagnosis("drive_lost", "no answer")],
    }
    decision = rig.step(0.5)
    assert codes(decision) == ["delivery", "hold", "roof_level_unknown", "frost", "drive_lost"]
    assert decision.state == "fault"
    rig = Rig()
    rig.change = {"reasons": [NOT_READY, LOST]}
    assert codes(rig.step(0.5)) == ["drive_lost"]
    rig.state_file.change(fault="it was so", fault_code="frost")
    assert codes(rig.step(0.5))[0] == "state_unknown"


def test_faults_next_to_each_other() -> None:
    """The first stays; another one is named next to it while it lasts, unless it only follows."""
    rig = Rig()
    rig.state_file.change(fault="burst pipe", fault_code="delivery")
    for change, expected in (
        ({"reasons": [OVERLOAD]}, ["drive_fault", "delivery"]),
        ({"reasons": [OVERLOAD, Diagnosis("runs_on", "so")]}, ["runs_on", "delivery"]),
        ({}, ["delivery"]),
    ):
        rig.change = change
        assert codes(rig.step(0.5)) == expected
    assert rig.state_file.state.fault == "burst pipe"


def test_the_table_is_whole() -> None:
    """Latched ones first, then inhibits; each has limits that exist."""
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
    """It does not start the pump sooner than it may, nor does clearing a fault: within 120 s."""
    rig = Rig(x2=0.5, settings=settings_for(PAPER_SITE, min_off=120.0))
    rig.run(200, 0.5, until=lambda decision: decision.state == "running")
    rig.state_file.hold("the page")
    decision = rig.step(0.5)
    assert decision.state == "held" and "; the pump is still turning, at 0.6" in decision.why
    rig.state_file.hold("the operator", "a leak")
    decision = rig.step(0.5)
    (sentence,) = (reason.sentence for reason in decision.active.values())
    assert re.fullmatch(r"a hold by the operator since [-\d]+ [\d:]+\+00:00: a leak", sentence)
    rig.state_file.change(fault="it turns at another speed", fault_code="speed_not_followed")
    rig.run(5, 1.0)
    rig.state_file.release()
    rig.clear()
    assert rig.run(112, 1.0).request is None
    assert rig.run(10, 1.0).request is not None


@pytest.mark.parametrize("code", [code for code, row in INTERLOCKS.items() if row.kind == LATCHED])
def test_a_fault_of_delivery_or_drive_needs_a_person_at_the_pump(code: str) -> None:
    """A speed that was not followed does not; it hides nothing that does, and no fault hides it."""
    state_file = StateFile(None)
    assert clear_refusal(state_file) == "there is no fault"
    evaluate(state_file, [Diagnosis("speed_not_followed", "slow")])
    assert clear_refusal(state_file) == ""
    for later in (code, "speed_not_followed"):
        evaluate(state_file, [Diagnosis(later, later)])
        assert state_file.state.fault_code == code
    assert bool(clear_refusal(state_file)) == (code != "speed_not_followed")


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
    assert {"no_forecast", "cistern_low", "state_not_kept"} <= reported
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
    assert (codes(decision), decision.request) == (["quiet_hours"], None)
    assert decision.why.startswith("quiet hours are in force until 2026-03-08 04:00-04:00")
    rig.run(30, 0.3)
    rig.now = ends - 5
    assert [rig.step(0.3).request for _ in range(5)] == [None] * 5
    assert rig.step(0.3).request is not None
