"""The table of interlocks, and who may end each; each row by its cause; the table's codes."""

from __future__ import annotations

import re
from dataclasses import replace
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
from greenroof_ros.live.pumping.interlocks import clear_refusal, evaluate
from greenroof_ros.live.pumping.state_file import StateFile

AT_NIGHT = replace(PAPER_SITE, quiet_hours=("22:00-24:00",), time_zone="UTC")
INTERLOCKS = read_interlocks()
CAUSES: dict[str, dict[str, Any]] = {
    "drive_fault": {"change": {"reasons": [OVERLOAD]}},
    "runs_on": {"command": 0.0, "stuck_speed": 0.6},
    "speed_not_followed": {"stuck_speed": 0.05},
    "delivery": {"command": 1.0, "arriving": 0.0, "leaving": 0.0},
    "state_unknown": {"record": {"fault": "torn", "fault_code": "state_unknown"}},
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
    assert (list(decision.active), decision.request) == ([code], None)
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
        assert list(decision.active) == [code]
        rig.clear()
        decision = rig.run(45, 0.5)
    assert (decision.active, decision.state) == ({}, "running")


def test_they_are_named_in_the_order_of_the_table() -> None:
    """Without what only follows: a lost drive is not ready. A fault of another version stays."""
    rig = Rig()
    rig.state_file.change(fault="burst pipe", fault_code="delivery")
    rig.state_file.hold("the operator")
    rig.change = {"frost": 1.0, "roof_level": None, "reasons": [NOT_READY, LOST]}
    assert [*rig.step(0.5).active] == [
        "delivery", "hold", "roof_level_unknown", "frost", "drive_lost",
    ]
    rig.state_file.change(fault="it was so", fault_code="frost")
    assert next(iter(rig.step(0.5).active)) == "state_unknown"


# --- who may release and clear --------------------------------------------------------------------


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


def test_what_is_reported_is_in_the_table_and_the_other_way_round() -> None:
    """In which what is latched comes first, then what inhibits."""
    package = CHECKOUT / "greenroof_ros"
    text = "".join(file.read_text(encoding="utf-8") for file in package.rglob("*.py"))
    codes = read_conditions().keys()
    assert set(re.findall(r'Diagnosis\.(?:of|if_any)\(\s*"(\w+)"', text)) <= codes
    names = {code: code.removesuffix("_unknown") for code in codes}  # of an unknown value
    assert [code for code, name in names.items() if not re.search(f'"({code}|{name})"', text)] == []
    kinds = [row.kind for row in INTERLOCKS.values()]
    assert kinds == sorted(kinds, key=[LATCHED, INHIBIT, PERMISSIVE].index)
