"""The interlocks of an actuator, in the order in which ``msg_defs/conditions.yaml`` lists them.

An interlock is active for as long as there is a reason for it. An actuator stays off while any
interlock is active. The state file keeps a latched fault until someone clears it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from greenroof_ros.interface.conditions import (
    INHIBIT,
    LATCHED,
    PERMISSIVE,
    Diagnosis,
    read_interlocks,
)
from greenroof_ros.interface.states import ActuatorState
from greenroof_ros.live.pumping.state_file import StateFile

# The state of an actuator that is kept off, by the kind of the first active interlock.
_STATES = {LATCHED: "fault", INHIBIT: "held", PERMISSIVE: "off"}
# What an actuator moves by at least while it comes nearer to what is requested (1).
_PROGRESS = 0.005


@dataclass(frozen=True)
class Decision:
    """What an actuator is to do, and what it does.

    Attributes:
        active: the active interlocks by code, in the order of their table.
        state: state of the actuator, one of ``PUMP_STATES``.
        why: reason for the state, in words.
        at_rest: whether the actuator surely stands.
        speed: speed that the device reports (share of the rated speed); None if it is unknown.
        flow: flow (m3/s); None if it is unknown.
        request: speed that is requested from the device; None for off.
        position: share to which a valve is open; None if it is unknown, and for a pump.
    """

    active: Mapping[str, Diagnosis]
    state: str = "unknown"
    why: str = ""
    at_rest: bool = False
    speed: float | None = None
    flow: float | None = None
    request: float | None = None
    position: float | None = None

    @property
    def shown(self) -> ActuatorState:
        """The state as it is published."""
        return ActuatorState(self.state, self.why, tuple(self.active))


def evaluate(state_file: StateFile, reasons: Iterable[Diagnosis]) -> dict[str, Diagnosis]:
    """Latch a fault, and return the active interlocks by code, in the order of the table.

    The first fault is kept, except that one that may be cleared on the page gives way to one that
    may not.

    Args:
        state_file: state file, with a hold and a latched fault.
        reasons: the present reasons to keep the actuator off, among them faults.
    """
    table, present = read_interlocks(), _in_order(reasons)
    for code, reason in present.items():
        gives_way = not clear_refusal(state_file) and not table[code].on_page
        if table[code].kind == LATCHED and (gives_way or not state_file.state.fault):
            state_file.change(fault=reason.sentence, fault_code=code)
    stored = state_file.state
    kept = [state_file.active_hold]
    if stored.fault:  # its sentence is as it was when it latched
        row = table.get(stored.fault_code)
        code = stored.fault_code if row and row.kind == LATCHED else "state_unknown"
        kept.append(Diagnosis(code, stored.fault))
    return _in_order([*present.values(), *filter(None, kept)])


def state_of(active: Mapping[str, Diagnosis]) -> tuple[str, str]:
    """Return the state of an actuator that is kept off, and the reason in words."""
    kind = read_interlocks()[next(iter(active))].kind
    return _STATES[kind], "; ".join(reason.sentence for reason in active.values())


def clear_refusal(state_file: StateFile) -> str:
    """Return the reason why the latched fault cannot be cleared from the page; empty if it can."""
    if not state_file.state.fault:
        return "there is no fault"
    row = read_interlocks().get(state_file.state.fault_code)
    if row is None or not row.on_page:
        return "someone who has checked the pump must reset this fault at the pump node"
    return ""


def _in_order(reasons: Iterable[Diagnosis]) -> dict[str, Diagnosis]:
    """Return reasons in the order of the table, without those that only follow from earlier ones.

    Of two reasons with one code, the later one counts.
    """
    present, active = {reason.code: reason for reason in reasons}, dict[str, Diagnosis]()
    kinds = set[str]()
    for code, interlock in read_interlocks().items():
        if code in present and not (interlock.follows and interlock.kind in kinds):
            active[code] = present[code]
            kinds.add(interlock.kind)
    return active


class Following:
    """Check that an actuator comes nearer to what is requested from it.

    The check does not depend on how fast the actuator is, only on its getting anywhere.

    Attributes:
        error_for: for how long the actuator has not come nearer (s).
    """

    def __init__(self, tolerance: float) -> None:
        """Initialize without an error.

        Args:
            tolerance: difference from the request that counts as none (1).
        """
        self.error_for = 0.0
        self._tolerance, self._nearest = tolerance, math.nan

    def update(self, dt: float, value: float, request: float) -> None:
        """Add time (s) at a value, while another value is requested (both shares of a maximum)."""
        apart, before = abs(value - request), abs(self._nearest - request)
        if apart <= self._tolerance or not apart > before - _PROGRESS:
            self._nearest, self.error_for = value, 0.0
        else:
            self.error_for += dt
