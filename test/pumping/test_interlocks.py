"""The table of what keeps the pump off: each row by what brings it about, and their order."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from paper import PAPER_SITE
from pump_rig import Rig

from greenroof_ros.pumping.conditions import CONDITIONS
from greenroof_ros.pumping.interlocks import CODES, INTERLOCKS, Kind, evaluate
from greenroof_ros.pumping.ledger import Record
from greenroof_ros.pumping.pump_control import Decision
from greenroof_ros.pumping.settings import pump_parameters, settings_for


def codes(decision: Decision) -> list[str]:
    """Return the codes of a decision."""
    return [one.interlock.code for one in decision.interlocks]


def changed(**change: object) -> Callable[[], Decision]:
    """Return what runs a pump and then changes what is known."""

    def run() -> Decision:
        rig = Rig()
        rig.run(30, 0.5)
        assert rig.decisions[-1].interlocks == ()
        rig.change = change
        return rig.step(0.5)

    return run


def commanded(command: float | None) -> Callable[[], Decision]:
    def run() -> Decision:
        rig = Rig()
        rig.run(30, 0.5)
        return rig.step(command)

    return run


def stuck() -> Decision:
    rig = Rig()
    rig.stuck_speed = 0.05
    return rig.run(60, 1.0, lambda one: one.state == "fault")


def told_to_stop() -> Decision:
    rig = Rig()
    rig.run(30, 0.5)
    rig.stuck_speed = rig.speed
    return rig.run(120, 0.0, lambda one: one.state == "fault")


def of_another_version() -> Decision:
    rig = Rig()
    rig.ledger.fault("its phase is lost", "phase_lost")
    return rig.step(0.5)


def closed_valve() -> Decision:
    rig = Rig()
    rig.arriving = rig.leaving = 0.0
    return rig.run(600, 1.0, lambda one: one.state == "fault")


def stopped() -> Decision:
    rig = Rig()
    rig.control.stop(True)
    return rig.step(0.5)


def unreadable() -> Decision:
    rig = Rig()
    rig.ledger.record = Record(unknown="state.json cannot be read")
    return rig.step(0.5)


def used(**use: float) -> Callable[[], Decision]:
    def run() -> Decision:
        rig = Rig()
        rig.ledger.record = Record(**use)  # type: ignore[arg-type]
        return rig.step(0.5)

    return run


def long_run() -> Decision:
    rig = Rig(x2=0.0, settings=settings_for(PAPER_SITE, greatest_run=30.0))
    return rig.run(60, 1.0, lambda one: "longest_run" in codes(one))


NODE = [
    "not_active", "drive_lost", "drive_local", "drive_timeout", "drive_guards_later", "no_permit",
    "two_controllers", "two_pumps", "no_command",
]
CAUSES: dict[str, Callable[[], Decision]] = {
    "drive_fault": changed(drive_fault="overload"),
    "turns_backwards": changed(speed=-0.1),
    "runs_on": told_to_stop,
    "speed_not_followed": stuck,
    "delivery": closed_valve,
    "fault_unknown": of_another_version,
    "operator_stop": stopped,
    "record_unknown": unreadable,
    "cistern_level_unknown": changed(cistern_level=None),
    "cistern_low": changed(cistern_level=0.1),
    "roof_level_unknown": changed(roof_level=None),
    "frost_unknown": changed(frost=None),
    "frost": changed(frost=True),
    "longest_run": long_run,
    "daily_volume": used(day_volume=1e6),
    "daily_run": used(day_run=86_400.0),
    **{code: changed(reasons={code: "it is so"}) for code in NODE},
    "command_unknown": commanded(None),
    "command_refused": commanded(math.nan),
    "drive_speed_unknown": changed(speed=None),
    "drive_not_ready": changed(drive_ready=False),
}


@pytest.mark.parametrize("code", CODES)
def test_each_keeps_the_pump_off_alone(code: str) -> None:
    """By what brings it about in a running pump; the state is its kind's."""
    decision = CAUSES[code]()
    assert (codes(decision), decision.speed) == ([code], None)
    kind = decision.interlocks[0].interlock.kind
    states = {Kind.LATCHED: {"fault"}, Kind.INHIBIT: {"held"},
              Kind.ENABLE: {"off", "stopping", "unknown"}}
    assert decision.state in states[kind]
    assert decision.why.startswith(decision.interlocks[0].why)


@pytest.mark.parametrize("code", CODES)
def test_what_latches_stays(code: str) -> None:
    """The cause gone, a latched one stands until it is reset; the others clear by themselves."""
    (row,) = [one for one in INTERLOCKS if one.code == code]
    rig = Rig()
    rig.run(30, 0.5)
    if row.kind is Kind.LATCHED:
        rig.ledger.fault("it was so", code)
        rig.run(60, 0.5)
        assert codes(rig.decisions[-1]) == [code]
        assert rig.control.reset() == "it was so"
    elif code in NODE:
        rig.change = {"reasons": {code: "it is so"}}
        rig.run(60, 0.5)
        rig.change = {}
    assert rig.run(30, 0.5).interlocks == ()


def test_they_are_named_in_the_order_of_the_table() -> None:
    rig = Rig()
    rig.control.stop(True)
    rig.ledger.fault("burst pipe", "delivery")
    rig.change = {"frost": True, "roof_level": None, "reasons": {"no_permit": "bringup has ended"}}
    decision = rig.step(0.5)
    assert codes(decision) == [
        "delivery", "operator_stop", "roof_level_unknown", "frost", "no_permit",
    ]
    assert decision.state == "fault"
    assert decision.why == (
        "burst pipe; an operator stopped it; the level of the roof is unknown; there is frost; "
        "bringup has ended"
    )


def test_what_follows_is_not_said_beside_its_cause() -> None:
    """A drive that is lost has no speed, and a node that is not active no command."""
    rig = Rig()
    rig.change = {"speed": None, "reasons": {"drive_lost": "no connection"}}
    assert codes(rig.step(None)) == ["drive_lost"]
    rig.change = {"drive_ready": False}
    assert codes(rig.step(None)) == ["command_unknown"]
    assert evaluate({"drive_not_ready": "x", "no_command": ""})[0].interlock.code == (
        "drive_not_ready"
    )


@pytest.mark.parametrize("code", ["", "phase_lost", "frost", *NODE])
def test_a_kept_fault_keeps_the_pump_off_whatever_its_code(code: str) -> None:
    """A record of another version of this package may have any."""
    rig = Rig()
    rig.ledger.record = Record(fault="it was so", fault_code=code)
    rig.change = {"reasons": dict.fromkeys(NODE, "")}
    decision = rig.run(30, 0.5)
    assert (codes(decision), decision.state, decision.speed) == (["fault_unknown"], "fault", None)
    assert rig.control.reset() == "it was so"
    assert rig.run(30, 0.5).interlocks == ()


def test_a_second_fault_is_named_beside_the_latched_one() -> None:
    rig = Rig()
    rig.ledger.fault("burst pipe", "delivery")
    rig.change = {"drive_fault": "overload"}
    assert codes(rig.step(0.5)) == ["drive_fault", "delivery"]
    rig.change = {"speed": -0.3, "drive_fault": "the pump turns backwards"}
    assert codes(rig.step(0.5)) == ["turns_backwards", "delivery"]
    rig.change = {}
    assert codes(rig.step(0.5)) == ["delivery"]


def test_a_drive_that_does_not_obey_a_stop_is_no_fault_of_its_own() -> None:
    """As the exchange finds it: a person must stop it, whatever the drive's manual says."""
    rig = Rig()
    rig.change = {"drive_fault": "it acknowledges *stop*", "runs_on": True}
    assert codes(rig.step(0.5)) == ["runs_on"]


def test_a_stop_is_not_lost_beside_a_record_that_cannot_be_read() -> None:
    """Who works at the pump has stopped it; both are named, and one release ends both."""
    rig = Rig()
    rig.ledger.record = Record(unknown="state.json cannot be read")
    rig.control.stop(True)
    assert codes(rig.step(0.5)) == ["operator_stop", "record_unknown"]
    rig.control.stop(False)
    assert rig.run(30, 0.5).interlocks == ()


def test_a_code_that_there_is_not() -> None:
    with pytest.raises(KeyError):
        evaluate({"operator_stops": "x"})


def test_the_table_is_whole() -> None:
    """Each code once, with advice, and with limits that there are."""
    assert len(set(CODES)) == len(CODES)
    assert {code for one in INTERLOCKS for code in one.follows} <= set(CODES)
    assert [one.kind for one in INTERLOCKS] == sorted(
        (one.kind for one in INTERLOCKS), key=[Kind.LATCHED, Kind.INHIBIT, Kind.ENABLE].index
    )
    assert all(one.meaning and one.advice for one in CONDITIONS.values())
    settings = {one.name for one in pump_parameters(Rig().site)}
    of_nodes = {
        "state_file", "level_limit", "frost_limit", "command_limit", "recovery_time", "autostart",
        "exchange_period", "drive_timeout_limit", "local_settings_stop_the_pump",
        "activate_without_drive_timeout", "unknown_frost_may_pump", "frozen_movement",
        "jump_tolerance",
    }
    named = {name for one in INTERLOCKS for name in one.limit.split(", ") if name}
    assert named <= settings | of_nodes
