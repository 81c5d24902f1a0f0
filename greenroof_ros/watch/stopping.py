"""The actions on the pump that are possible from here: stop, release, clear a fault, give a dose.

They need nothing that tiles or alarms need: even if those cannot be shown, the pump can be stopped.
"""

from __future__ import annotations

import time
from typing import Any

from greenroof_ros.common.conditions import command_for
from greenroof_ros.watch import words
from greenroof_ros.watch.registry import Node
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.words import clean_sentence

LOCK_OUT = (
    "Anyone working on the pump must lock it out at the pump itself; this page does not."
)
_THEN = (
    "The pump then starts automatically when the controller requires it and nothing else keeps it "
    "off, but not before its minimum time off has passed. "
)


def describe_stop(store: GraphStore) -> dict[str, Any]:
    """Return whether the pump can be stopped from here, whether it is stopped, and a warning.

    It can be stopped if any node may control the pump, whatever nodes report. It counts as stopped
    if someone holds it and it is at rest; the hold alone only means that it should be. ``release``
    is the command that releases it; empty if that would do nothing. Entries ending in ``_here``
    state whether an action is allowed here, and those ending in ``_then`` state what happens then.
    A request for a dose returns ``asked_at``, by which a delayed request is recognised.
    """
    two = store.graph.two_pumps(store.wall)
    node = None if two else store.graph.pump(store.wall)
    values = {} if node is None else node.values
    hold, is_silent = "" if node is None else node.hold, store.is_lost(node)
    possible = bool(store.graph.pumps(store.wall))
    at_rest = not is_silent and values.get("stands") is True
    stopped, warning = bool(hold) and at_rest, two
    if hold and not at_rest and not is_silent:
        warning = (
            "Stop was accepted, but the pump still turns, or it is unknown whether it is "
            "stopped. Stop it at its drive's panel if it is not stopped within seconds."
        )
    report = store.pump_report
    off = report is not None and report.state in ("off", "held", "fault") and at_rest
    return {
        "possible": possible, "stopped": stopped,
        "label": "The pump is held off: stop again" if stopped
        else "Keep the pump off" if off else "Stop the pump",
        "sentence": "There is no pump node that can be stopped from here."
        if not possible else ("It was held off at last contact. " if hold and is_silent else "")
        + ("The pump is held" if stopped else "Holds the pump")
        + " off until someone releases it. " + LOCK_OUT,
        "warning": warning,
        "release": "" if node is None or not hold else command_for(node.name, "release"),
        "hold": None if node is None or is_silent else hold and f"{hold[0].upper()}{hold[1:]}.",
        "clear_call": command_for(node.name, "reset")
        if node is not None and node.text("fault") else "",
        **_allow(None if is_silent or not store.allow_release else node, at_rest, store.site.a2),
    }


def _allow(node: Node | None, at_rest: bool, area: float = 0.0) -> dict[str, Any]:
    """Return which actions other than a stop are allowed here, and what happens then.

    Args:
        node: the pump node, if it is online and releasing is allowed; otherwise None.
        at_rest: whether the pump is stopped.
        area: area of the roof (m2).
    """
    maximum = None if node is None else node.values.get("max_dose")
    hold = "" if node is None else node.hold
    fault, unknown, refusal, no_dose = (
        "" if node is None else node.text(key)
        for key in ("fault", "unknown", "no_clear", "no_dose")
    )
    doses = isinstance(maximum, (int, float))
    dose = {} if node is None else node.values.get("dose") or {}
    minimum = 0.0 if node is None else float(node.values.get("min_dose") or 0.0)
    return {
        "release_here": bool(hold) and at_rest,
        "release_then": _write_then(fault, unknown) + LOCK_OUT,
        "clear_here": bool(fault) and not refusal and at_rest,
        "clear_then": f"The fault is cleared: {fault}. " + _write_then(hold, unknown) + LOCK_OUT,
        "no_clear": refusal if fault else "",
        "max_dose": maximum if doses else None,
        "min_dose": minimum if doses else None,
        "dose_limits": _write_limits(minimum, float(maximum or 0.0), area) if doses else "",
        "dose": clean_sentence(str(dose.get("said", ""))) if isinstance(dose, dict) else "",
        "dose_here": doses and not no_dose,
        "asked_at": time.time() if doses and not no_dose else None,
        "dose_then": "The pump then delivers this volume once, regardless of what the controller "
        "commands, but not above the roof's target. It ends early if anything keeps the pump off. "
        + LOCK_OUT,
        "no_dose": no_dose if doses else "",
    }


def _write_limits(minimum: float, maximum: float, area: float) -> str:
    """Return the range of a dose (m3), and the depth of water that it means on the roof (m2)."""
    volumes = f"from {minimum:.3f} to {maximum:g} m³" if minimum else f"at most {maximum:g} m³"
    depths = [words.write_rain(volume / area) for volume in (minimum, maximum) if volume and area]
    return volumes + (f", which is {' to '.join(depths)} of water on the roof" if depths else "")


def _write_then(*others: str) -> str:
    """Return what the pump does then; ``others`` are what else keeps it off (empty: nothing)."""
    remain = "; ".join(filter(None, others))
    return f"It nevertheless stays off: {remain}. " if remain else _THEN


def make_bare_stop() -> dict[str, Any]:
    """Return a stop for which nothing needs to be known: the pump node is asked, if any."""
    return {
        "possible": True, "stopped": False, "label": "Stop the pump",
        "sentence": "Holds the pump off until someone releases it. " + LOCK_OUT,
        "warning": "", "release": "", "hold": None, "clear_call": "",
        **_allow(None, at_rest=False),
    }
