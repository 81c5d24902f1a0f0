"""Actions on the pump that the page offers: stop, release, clear a fault and request a dose.

The actions do not depend on the tiles, so the pump can be stopped even if none can be shown.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

from greenroof_ros.watch import words
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.tiles import runs_on

LOCK_OUT = (
    "Anyone working on the pump must lock it out at the pump itself; this page does not lock it "
    "out."
)
_STOP = f"A stop holds the pump off until someone releases it. {LOCK_OUT}"
_THEN = (
    "The pump then starts automatically when the controller requires it and nothing else keeps it "
    "off, but not before its minimum time off has passed. "
)
_DOSE = (
    "The pump then delivers this volume once, regardless of the controller's command, but only up "
    f"to the roof's target. The dose ends early if anything keeps the pump off. {LOCK_OUT}"
)


def describe_stop(store: GraphStore) -> dict[str, Any]:
    """Return the actions on the pump that are possible here, and what the pump node says of them.

    The pump can be stopped if any node may control it, regardless of what the nodes report. It
    counts as stopped if it is held and at standstill; a hold alone only means that the pump should
    be stopped. ``actions`` contains the question to ask before each action. A question is outdated
    as soon as ``situation`` changes. A request for a dose includes ``asked_at``, so that a delayed
    request is recognized.
    """
    two, pump = store.two_pumps, store.pump
    node = None if two or pump is None or store.is_lost(pump) or pump.has_ended else pump
    values = {} if node is None else node.values
    hold = _describe_hold(store, values)
    at_rest = values.get("at_rest") is True and not runs_on(store)
    warning = two
    if hold and not at_rest:
        warning = (
            "The stop was accepted, but the pump is still turning, or it is unknown whether it has "
            "stopped. If it does not stop within seconds, stop it at its drive's panel."
        )
    off = values.get("pump_state") in ("off", "held", "fault") and at_rest
    dose = _describe_dose(values, store.allow_release, store.site.a2)
    others = _list_others(values, hold, at_rest, dose)
    return {
        "possible": bool(store.graph.offered), "hold": hold,
        "stopped": bool(hold) and at_rest, "warning": warning, "dose": dose,
        "asked_at": time.time(),
        "label": "Stop again" if hold and at_rest else "Keep the pump off" if off
        else "Stop the pump",
        "actions": {"stop": _STOP, **(others if store.allow_release else {})},
        "situation": [bool(hold), at_rest, *(
            bool(words.text_of(values, key)) for key in ("fault", "unknown", "no_dose")
        )],
    }


def make_bare_stop() -> dict[str, Any]:
    """Return the stop action to offer while the pump node is unknown: any pump node may answer."""
    return {
        "possible": True, "stopped": False, "hold": "", "warning": "", "label": "Stop the pump",
        "dose": _describe_dose({}, False, 0.0), "asked_at": None, "actions": {"stop": _STOP},
        "situation": [],
    }


def _describe_hold(store: GraphStore, values: Mapping[str, Any]) -> str:
    """Describe who holds the pump, since when, until when and why; empty if no one does."""
    hold = values.get("hold")
    owner = hold.get("owner") if isinstance(hold, dict) else None
    if not isinstance(hold, dict) or not isinstance(owner, str):
        return ""
    until, reason, end = hold.get("until"), hold.get("reason"), "someone releases it"
    if isinstance(until, (int, float)):
        end = store.hour(until)
    since = hold.get("since")
    begin = f" since {store.time_of_day(since)}" if isinstance(since, (int, float)) else ""
    why = f" ({reason})" if isinstance(reason, str) and reason else ""
    return words.clean_sentence(f"The pump is held off by {owner}{begin}, until {end}{why}.")


def _list_others(
    values: Mapping[str, Any], hold: str, at_rest: bool, dose: Mapping[str, Any]
) -> dict[str, str]:
    """Return the questions of the possible actions other than a stop.

    Args:
        values: values that the pump node reports.
        hold: description of the hold; empty if there is none.
        at_rest: whether the pump is at standstill.
        dose: what is known of doses.
    """
    fault, unknown = (words.text_of(values, key) for key in ("fault", "unknown"))
    questions = {}
    if hold and at_rest:
        questions["release"] = _write_then(fault, unknown) + LOCK_OUT
    if fault and not words.text_of(values, "no_clear") and at_rest:
        stays = hold.removesuffix(".")
        questions["clear"] = (
            f"The fault is cleared: {fault}. {_write_then(stays, unknown)}{LOCK_OUT}"
        )
    if dose["max"] is not None and not dose["refusal"]:
        questions["dose"] = _DOSE
    return questions


def _write_then(*others: str) -> str:
    """Describe the effect on the pump; ``others`` are other reasons for it to stay off, if any."""
    remain = "; ".join(filter(None, others))
    return f"The pump nevertheless stays off: {remain}. " if remain else _THEN


def _describe_dose(values: Mapping[str, Any], allowed: bool, area: float) -> dict[str, Any]:
    """Return the latest dose in words, the limits of a dose, and why none is possible now.

    Args:
        values: values that the pump node reports.
        allowed: whether doses may be requested here.
        area: area of the roof (m2).
    """
    least, largest = values.get("min_dose"), values.get("max_dose")
    if not isinstance(least, (int, float)):
        least = 0.0
    if not allowed or not isinstance(largest, (int, float)):
        largest = None
    last = values.get("dose")
    runs = isinstance(last, dict) and not last.get("over")
    volumes = [volume for volume in (least, largest) if volume]
    depths = [words.write_rain(volume / area) for volume in volumes if area]
    return {
        "text": _write_dose(last, values.get("flow")) if isinstance(last, dict) else "",
        "min": least, "max": largest,
        "limits": f"{' to '.join(map(words.write_litres, volumes))}, which is "
        f"{' to '.join(depths)} of water on the roof",
        "refusal": "" if runs or largest is None else words.clean_sentence(
            str(values.get("no_dose") or "")
        ),
    }


def _write_dose(dose: Mapping[str, Any], flow: Any) -> str:
    """Write the progress or the outcome of a dose: ``A dose: 12 of 20 L, 4 min left.``."""
    if dose.get("over"):
        sentence = words.clean_sentence(str(dose.get("sentence", "")))
        return f"{sentence[:1].upper()}{sentence[1:]}."
    volume, delivered = dose.get("volume"), dose.get("delivered")
    if not isinstance(volume, (int, float)) or not isinstance(delivered, (int, float)):
        return ""
    progress = f"A dose: {words.write_number(delivered * 1e3, 0)} of {words.write_litres(volume)}"
    if not isinstance(flow, (int, float)) or flow <= 0:
        return f"{progress}; it is waiting."
    return f"{progress}, {max(1, math.ceil((volume - delivered) / flow / 60))} min left."
