"""Actions on the pump that the page offers: stop, release, clear a fault and request a dose."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from greenroof_ros.watch import words
from greenroof_ros.watch.store import GraphStore

_LOCK_OUT = (
    "Anyone working on the pump must lock it out at the pump itself; this page does not lock it "
    "out."
)
_STOP = f"A stop holds the pump off until someone releases it. {_LOCK_OUT}"
_RELEASE = (
    "The pump then starts automatically when the controller requires it and nothing else keeps it "
    f"off, but not before its minimum time off has passed. {_LOCK_OUT}"
)
_DOSE = (
    "The pump then delivers this volume once, regardless of the controller's command, but only up "
    f"to the roof's target. The dose ends early if anything keeps the pump off. {_LOCK_OUT}"
)


def runs_on(store: GraphStore) -> bool:
    """Return whether the pump turns or delivers water although it is off."""
    return any(alarm.role == "pump" and alarm.code == "runs_on" for alarm in store.present)


def describe_stop(store: GraphStore) -> dict[str, Any]:
    """Return the actions on the pump that are possible here, and what the pump node says of them.

    The pump can be stopped if any node may control it, regardless of what the nodes report. It
    counts as stopped if it is held and at standstill; a hold alone only means that the pump should
    be stopped. ``actions`` contains the question to ask before each action.
    """
    two, pump = store.two_pumps, store.pump
    here = pump is not None and pump.is_online(store.wall) and not two
    values = pump.values if here and pump is not None else {}
    hold = _describe_hold(store, values)
    at_rest = values.get("at_rest") is True and not runs_on(store)
    off = at_rest and values.get("pump_state") in ("off", "held", "fault")
    warning = two
    if hold and not at_rest:
        warning = (
            "The stop was accepted, but the pump is still turning, or it is unknown whether it has "
            "stopped. If it does not stop within seconds, stop it at its drive's panel."
        )
    dose = _describe_dose(store, values)
    fault = words.text_of(values, "fault")
    possible = {
        "release": (hold and at_rest, _RELEASE),
        "clear": (fault and not values.get("no_clear") and at_rest,
                  f"The fault is cleared: {fault}. {_RELEASE}"),
        "dose": (dose["max"] is not None and not values.get("no_dose"), _DOSE),
    }
    return {
        "possible": bool(store.graph.offered), "hold": hold, "stopped": bool(hold) and at_rest,
        "warning": warning, "dose": dose,
        "label": "Keep the pump off" if off else "Stop the pump",
        "actions": {"stop": _STOP, **{
            name: question for name, (is_possible, question) in possible.items()
            if is_possible and store.allow_release
        }},
    }


def _describe_hold(store: GraphStore, values: Mapping[str, Any]) -> str:
    """Describe who holds the pump, since when, until when and why; empty if no one does."""
    hold = values.get("hold")
    if not isinstance(hold, dict) or not (owner := words.text_of(hold, "owner")):
        return ""
    since, until = words.number_in(hold, "since"), words.number_in(hold, "until")
    begin = "" if since is None else f" since {store.time_text(since)}"
    end = "someone releases it" if until is None else store.time_text(until)
    reason = words.text_of(hold, "reason")
    why = f" ({reason})" if reason else ""
    return f"The pump is held off by {owner}{begin}, until {end}{why}."


def _describe_dose(store: GraphStore, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the latest dose in words, the limits of a dose, and why none is possible now."""
    least, largest = words.number_in(values, "min_dose") or 0.0, words.number_in(values, "max_dose")
    if not store.allow_release:
        largest = None
    last = values.get("dose")
    dose = last if isinstance(last, dict) else {}
    runs = bool(dose) and not dose.get("over")
    return {
        "text": _write_dose(dose, words.number_in(values, "flow")), "min": least, "max": largest,
        "refusal": "" if runs or largest is None else words.text_of(values, "no_dose"),
    }


def _write_dose(dose: Mapping[str, Any], flow: float | None) -> str:
    """Write the progress or the outcome of a dose: ``A dose: 12 of 20 L, 4 min left.``."""
    if dose.get("over"):
        return f"{words.capitalize(words.text_of(dose, 'sentence'))}."
    volume, delivered = words.number_in(dose, "volume"), words.number_in(dose, "delivered")
    if volume is None or delivered is None:
        return ""
    given = words.write_number(delivered, "", 0, 1e3)
    progress = f"A dose: {given} of {words.write_litres(volume)}"
    if not flow or flow < 0:
        return f"{progress}; it is waiting."
    return f"{progress}, {max(1, math.ceil((volume - delivered) / flow / 60))} min left."
