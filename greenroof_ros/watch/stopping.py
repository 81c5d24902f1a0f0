"""Actions on the pump that the page offers: stop, release, clear a fault and request a dose.

The actions do not depend on the tiles or the alarms, so the pump can be stopped even if neither can
be shown.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

from greenroof_ros.interface.conditions import command_for
from greenroof_ros.watch import words
from greenroof_ros.watch.registry import Node
from greenroof_ros.watch.store import GraphStore

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
    two = store.graph.two_pumps(store.wall)
    pump = None if two else store.graph.pump(store.wall)
    node = None if store.is_lost(pump) else pump
    values = {} if node is None else node.values
    hold, at_rest = "" if node is None else describe_hold(store, node), values.get("stands") is True
    warning = two
    if hold and not at_rest:
        warning = (
            "The stop was accepted, but the pump is still turning, or it is unknown whether it has "
            "stopped. If it does not stop within seconds, stop it at its drive's panel."
        )
    report = store.pump_report
    off = report is not None and report.state in ("off", "held", "fault") and at_rest
    stopped = bool(hold) and at_rest
    offered = node if store.allow_release else None
    return {
        "possible": bool(store.graph.pumps(store.wall)), "stopped": stopped, "hold": hold,
        "warning": warning,
        "label": "Stop again" if stopped else "Keep the pump off" if off else "Stop the pump",
        "actions": {"stop": _STOP, **_list_others(offered, hold, at_rest)},
        "situation": [bool(hold), at_rest, *(
            node is not None and bool(node.text(key)) for key in ("fault", "unknown", "no_dose")
        )],
        "dose": _describe_dose(values), "dosing": _is_dosing(values), "asked_at": time.time(),
        **_limit_doses(offered, store.site.a2),
    }


def make_bare_stop() -> dict[str, Any]:
    """Return the stop action to offer while the pump node is unknown: any pump node may answer."""
    return {
        "possible": True, "stopped": False, "hold": "", "warning": "", "label": "Stop the pump",
        "actions": {"stop": _STOP}, "situation": [], "dose": "", "dosing": False,
        "asked_at": None,
        **_limit_doses(None, 0.0),
    }


def describe_hold(store: GraphStore, node: Node) -> str:
    """Describe who holds the pump, since when, until when and why; empty if no one does."""
    hold = node.values.get("hold")
    owner = hold.get("owner") if isinstance(hold, dict) else None
    if not isinstance(hold, dict) or not isinstance(owner, str):
        return ""
    part, until, reason = node.parts.get("pump"), hold.get("until"), hold.get("reason")
    known = part is not None and part.diagnosis.code == "hold"
    since = part.diagnosis.since if part is not None and known else None
    begin = "" if since is None else f" since {store.time_of_day(since)}"
    end = "someone releases it"
    if isinstance(until, (int, float)) and math.isfinite(until):
        end = store.hour(until)
    why = f" ({reason})" if isinstance(reason, str) and reason else ""
    return words.clean_sentence(f"The pump is held off by {owner}{begin}, until {end}{why}.")


def explain_release(store: GraphStore, stop: Mapping[str, Any]) -> str:
    """Explain how to release the pump; empty if it cannot be released now."""
    if "release" in stop["actions"]:
        return "If it may run again, release it with the button below."
    if store.pump is None or not stop["stopped"]:
        return ""
    return f"If it may run again, release it with: {command_for(store.pump.name, 'release')}"


def _list_others(node: Node | None, hold: str, at_rest: bool) -> dict[str, str]:
    """Return the questions of the actions other than a stop.

    Args:
        node: the pump node, if it is online and such actions are allowed; otherwise None.
        hold: description of the hold; empty if there is none.
        at_rest: whether the pump is at standstill.
    """
    if node is None:
        return {}
    fault, unknown = node.text("fault"), node.text("unknown")
    questions = {}
    if hold and at_rest:
        questions["release"] = _write_then(fault, unknown) + LOCK_OUT
    if fault and not node.text("no_clear") and at_rest:
        stays = hold.removesuffix(".")
        questions["clear"] = (
            f"The fault is cleared: {fault}. {_write_then(stays, unknown)}{LOCK_OUT}"
        )
    if _find_largest_dose(node) is not None and not node.text("no_dose"):
        questions["dose"] = _DOSE
    return questions


def _write_then(*others: str) -> str:
    """Describe the effect on the pump; ``others`` are other reasons for it to stay off, if any."""
    remain = "; ".join(filter(None, others))
    return f"The pump nevertheless stays off: {remain}. " if remain else _THEN


def _find_largest_dose(node: Node | None) -> float | None:
    largest = None if node is None else node.values.get("max_dose")
    return float(largest) if isinstance(largest, (int, float)) else None


def _limit_doses(node: Node | None, area: float) -> dict[str, Any]:
    """Return the limits of a dose, also in words, and the reason why none is possible now.

    Args:
        node: the pump node, if it is online and doses are allowed; otherwise None.
        area: area of the roof (m2).
    """
    largest = _find_largest_dose(node)
    if node is None or largest is None:
        return {"max_dose": None, "min_dose": None, "dose_limits": "", "no_dose": ""}
    least = float(node.values.get("min_dose") or 0.0)
    volumes = " to ".join(write_litres(volume) for volume in (least, largest) if volume)
    depths = " to ".join(
        words.write_rain(volume / area) for volume in (least, largest) if volume and area
    )
    return {
        "max_dose": largest, "min_dose": least, "no_dose": node.text("no_dose"),
        "dose_limits": f"{volumes}, which is {depths} of water on the roof" if depths else volumes,
    }


def _is_dosing(values: Mapping[str, Any]) -> bool:
    dose = values.get("dose")
    return isinstance(dose, dict) and not dose.get("over")


def _describe_dose(values: Mapping[str, Any]) -> str:
    """Describe the latest dose, as in ``A dose: 12 of 20 L, 4 min left.``; empty for none."""
    dose, flow = values.get("dose"), values.get("flow")
    if not isinstance(dose, dict):
        return ""
    if not _is_dosing(values):
        said = words.clean_sentence(str(dose.get("said", "")))
        return f"{said[:1].upper()}{said[1:]}."
    volume, delivered = dose.get("volume"), dose.get("delivered")
    if not isinstance(volume, (int, float)) or not isinstance(delivered, (int, float)):
        return ""
    progress = f"A dose: {words.write_number(delivered * 1e3, 0)} of {write_litres(volume)}"
    if not isinstance(flow, (int, float)) or flow <= 0:
        return f"{progress}; it is waiting."
    return f"{progress}, {max(1, math.ceil((volume - delivered) / flow / 60))} min left."


def write_litres(volume: float) -> str:
    """Write a volume (m3) in litres."""
    return words.write_quantity(volume, "L", 0, 1e3)
