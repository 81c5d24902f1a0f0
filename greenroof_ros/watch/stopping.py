"""Actions on the pump that the page offers: stop, release, clear a fault and request a dose.

The actions do not depend on the tiles or the alarms, so the pump can be stopped even if neither can
be shown.
"""

from __future__ import annotations

import time
from typing import Any

from greenroof_ros.interface.conditions import command_for
from greenroof_ros.watch import words
from greenroof_ros.watch.registry import Node
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.words import clean_sentence

LOCK_OUT = (
    "Anyone working on the pump must lock it out at the pump itself; this page does not lock it "
    "out."
)
_THEN = (
    "The pump then starts automatically when the controller requires it and nothing else keeps it "
    "off, but not before its minimum time off has passed. "
)


def describe_stop(store: GraphStore) -> dict[str, Any]:
    """Return whether the pump can be stopped here, whether it is stopped, and any warning.

    The pump can be stopped if any node may control it, regardless of what the nodes report. The
    pump counts as stopped if it is held and at standstill; a hold alone only means that the pump
    should be stopped. ``release`` is the command that releases the pump; empty if it would have no
    effect. Entries that end in ``_here`` state whether an action is allowed here, and entries that
    end in ``_then`` describe the effect of an action. A request for a dose includes ``asked_at``,
    so that a delayed request is recognized.
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
            "The stop was accepted, but the pump is still turning, or it is unknown whether it has "
            "stopped. If it does not stop within seconds, stop it at its drive's panel."
        )
    report = store.pump_report
    off = report is not None and report.state in ("off", "held", "fault") and at_rest
    return {
        "possible": possible, "stopped": stopped,
        "label": "The pump is held off: stop again" if stopped
        else "Keep the pump off" if off else "Stop the pump",
        "sentence": "There is no pump node through which the pump could be stopped."
        if not possible
        else ("The pump was held off at last contact. " if hold and is_silent else "")
        + ("The pump is held" if stopped else "A stop holds the pump")
        + " off until someone releases it. " + LOCK_OUT,
        "warning": warning,
        "release": "" if node is None or not hold else command_for(node.name, "release"),
        "hold": None if node is None or is_silent else hold and f"{hold[0].upper()}{hold[1:]}.",
        "clear_call": command_for(node.name, "reset")
        if node is not None and node.text("fault") else "",
        **_allow(None if is_silent or not store.allow_release else node, at_rest, store.site.a2),
    }


def _allow(node: Node | None, at_rest: bool, area: float = 0.0) -> dict[str, Any]:
    """Return the actions, other than a stop, that are allowed here, with their effects.

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
        "dose_then": "The pump then delivers this volume once, regardless of the controller's "
        "command, but only up to the roof's target. The dose ends early if anything keeps the pump "
        "off. "
        + LOCK_OUT,
        "no_dose": no_dose if doses else "",
    }


def _write_limits(minimum: float, maximum: float, area: float) -> str:
    """Write the range of a dose (m3) and the resulting water depth on a roof of an area (m2)."""
    volumes = f"from {minimum:.3f} to {maximum:g} m³" if minimum else f"at most {maximum:g} m³"
    depths = [words.write_rain(volume / area) for volume in (minimum, maximum) if volume and area]
    return volumes + (
        f", equivalent to {' to '.join(depths)} of water on the roof" if depths else ""
    )


def _write_then(*others: str) -> str:
    """Describe the effect on the pump; ``others`` are other reasons for it to stay off, if any."""
    remain = "; ".join(filter(None, others))
    return f"The pump nevertheless stays off: {remain}. " if remain else _THEN


def make_bare_stop() -> dict[str, Any]:
    """Return the stop action to offer while the pump node is unknown: any pump node may answer."""
    return {
        "possible": True, "stopped": False, "label": "Stop the pump",
        "sentence": "A stop holds the pump off until someone releases it. " + LOCK_OUT,
        "warning": "", "release": "", "hold": None, "clear_call": "",
        **_allow(None, at_rest=False),
    }
