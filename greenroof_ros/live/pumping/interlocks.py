"""Evaluation of the interlocks in the order in which ``msg_defs/conditions.yaml`` lists them.

An interlock is active for as long as there is a reason for it. An actuator stays off while any
interlock is active. The state file keeps a latched fault until someone clears it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from greenroof_ros.interface.conditions import (
    INHIBIT,
    LATCHED,
    PERMISSIVE,
    Diagnosis,
    read_interlocks,
)
from greenroof_ros.live.pumping.state_file import StateFile

# The state of an actuator that is kept off, by the kind of the first active interlock.
_STATES = {LATCHED: "fault", INHIBIT: "held", PERMISSIVE: "off"}


def evaluate(reasons: Iterable[Diagnosis]) -> dict[str, Diagnosis]:
    """Return the active interlocks by code, in the order of the table.

    Args:
        reasons: reasons against running the pump.

    Raises:
        KeyError: if a code does not belong to an interlock.
    """
    present = {reason.code: reason for reason in reasons}
    interlocks = read_interlocks()
    if unknown := present.keys() - interlocks.keys():
        raise KeyError(*unknown)
    active: dict[str, Diagnosis] = {}
    for code, interlock in interlocks.items():
        explained = interlock.follows and any(
            interlocks[earlier].kind == interlock.kind for earlier in active
        )
        if code in present and not explained:
            active[code] = present[code]
    return active


def state_of(active: Mapping[str, Diagnosis]) -> tuple[str, str]:
    """Return the state of an actuator that is kept off, and the reason in words."""
    kind = read_interlocks()[next(iter(active))].kind
    return _STATES[kind], "; ".join(reason.sentence for reason in active.values())


def latch(state_file: StateFile, faults: Iterable[Diagnosis]) -> None:
    """Latch the decisive one of the present faults.

    The first fault is kept, except that one that may be cleared on the page gives way to one that
    may not.
    """
    latched, interlocks, stored = evaluate(faults), read_interlocks(), state_file.state
    if stored.fault and not _is_cleared_on_page(stored.fault_code):
        return
    worst = next((code for code in latched if not interlocks[code].on_page), "")
    if not stored.fault:
        worst = worst or next(iter(latched), "")
    if worst:
        state_file.fault(latched[worst].sentence, worst)


def stored_reasons(state_file: StateFile) -> list[Diagnosis]:
    """Return the reasons in the state file: unknown contents, a hold, and a latched fault."""
    stored = state_file.state
    reasons = [Diagnosis.if_any("state_unknown", stored.unknown), state_file.active_hold]
    if stored.fault:
        row = read_interlocks().get(stored.fault_code)
        known = row is not None and row.kind == LATCHED
        # The sentence as it was when the fault latched.
        reasons.append(Diagnosis(stored.fault_code if known else "fault_unknown", stored.fault))
    return [reason for reason in reasons if reason is not None]


def clear_refusal(state_file: StateFile) -> str:
    """Return the reason why the latched fault cannot be cleared from the page; empty if it can."""
    stored = state_file.state
    if not stored.fault:
        return "there is no fault"
    if not _is_cleared_on_page(stored.fault_code):
        return "someone who has checked the pump must reset this fault at the pump node"
    return ""


def _is_cleared_on_page(code: str) -> bool:
    row = read_interlocks().get(code)
    return row is not None and row.on_page
