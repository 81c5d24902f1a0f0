"""Evaluation of the interlocks in the order in which ``msg_defs/conditions.yaml`` lists them.

An interlock is active for as long as there is a reason for it. The pump does not run while any
interlock is active.
"""

from __future__ import annotations

from collections.abc import Iterable

from greenroof_ros.interface.conditions import Diagnosis, read_interlocks


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
