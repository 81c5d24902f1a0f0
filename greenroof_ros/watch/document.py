"""The state and the chart series shown by the page and the status command, as JSON data.

:func:`make_document` creates the state from a store, and :func:`make_series` creates the series.

A state has the entries ``heading``, ``mode``, ``namespace``, ``contact``, ``time``, ``notes``,
``tiles`` (with the ``summary``), ``advice``, ``known`` (whether the alarms are), ``alarms``,
``events`` and ``stop``.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from shutil import which
from typing import Any

from greenroof_ros.base.text import clean_text, number_of
from greenroof_ros.interface.alarm import Alarm, advise
from greenroof_ros.interface.conditions import command_for
from greenroof_ros.interface.states import PUMP, VALVE
from greenroof_ros.ros.alarms import describe_alarm
from greenroof_ros.watch.lines import AHEAD_S, END_S, STRETCH_NS
from greenroof_ros.watch.store import FASTEST, GAP_S, LINES, TICKS, GraphStore, number_in, text_of
from greenroof_ros.watch.tiles import UNKNOWN, Tile, find_display, make_tiles, write_litres

# How much of the past the charts can show (h), and the approximate number of stretches in a line.
HOURS, _POINTS = (3, 12, 48, 168), 300
# Maximum number of alarms, and of events, that are shown; each has at most some hundred characters.
_MAX_ROWS = 50

_HEADINGS = {
    "none": "Nothing received yet", "ended": "Ended run", "live": "Live site",
    "simulated": "Simulated run",
}
_TOO_FAST = (
    "This run is faster than 60 times real time, so its values are not shown. Use greenroof report "
    "after the run."
)
_NOTHING = (
    "Start a run or a site. If one is already running, check that this watcher uses the same "
    "ROS_DOMAIN_ID and --namespace."
)
_UNKNOWN = "Some values are unknown: check that the sensors and programs are running."
_WELDED = "Water is leaving the cistern although the pump is off. Open the main switch."
_START = (
    "Start it with: sudo systemctl start greenroof, if it is a service, or else with: {live} and "
    "its options. If the pump is still turning, stop it at its drive's panel or at the main switch."
)
_GO_AND_SEE = "Go and see whether the pump is stopped. If not, use its panel or the main switch."
# Alarms that the pump may be running, and that the valve may be open: of these roles and codes.
_MAY_MOVE = (PUMP, "standstill_unknown"), (VALVE, "valve_may_be_open")
_GO_AND_CLOSE = "Go and see whether the outlet valve is closed. If not, close it by hand."

_LOCK_OUT = "Anyone working on the pump must lock it out at the pump itself."
_STOP = f"A stop holds the pump off until someone releases it. {_LOCK_OUT}"
_RELEASE = (
    "The pump then starts automatically when the controller requires it and nothing else keeps it "
    f"off, but not before its minimum time off has passed. {_LOCK_OUT}"
)
_DOSE = (
    "The pump then delivers this volume once, regardless of the controller's command, but only up "
    f"to the roof's target. The dose ends early if anything keeps the pump off. {_LOCK_OUT}"
)

_CLOSE = "The valve closes, and is kept closed until someone releases it."
_RELEASE_VALVE = "The valve then opens when the controller requires it and nothing keeps it closed."
_OPEN = "The valve opens for 30 minutes, unless an interlock keeps it closed or closes it earlier."
# A command in an advice, rather than the service of that name.
_COMMAND = re.compile(r"\bgreenroof(?= (?:live|outlet|release|reset|watch)\b)")


def make_document(store: GraphStore, steady: float) -> dict[str, Any]:
    """Return the document for the page and the status command, in plain text.

    Args:
        store: state of the graph.
        steady: current time (steady clock, s).
    """
    with store.lock:
        store.steady = steady
        tiles, rows, stop = make_tiles(store), _list_alarms(store), describe_stop(store)
        summary, step = _summarize(store, tiles, rows)
        local = store.local(store.now)
        return {
            "heading": _HEADINGS[store.mode], "mode": store.mode, "known": store.alarms_known,
            "namespace": store.namespace, "contact": store.site.contact or "",
            "time": {
                "now": int(store.now) or None,
                "zone": store.site.time_zone or local.isoformat()[-6:],
                "text": f"{local:%Y-%m-%d %H:%M:%S %Z}" if store.now else UNKNOWN,
            },
            "frost": store.present_value("/weather/frost"),
            "tiles": {**tiles, "summary": summary},
            "advice": _advise(store, step, stop), "stop": stop,
            "alarms": rows[:_MAX_ROWS], "events": _list_events(store)[:_MAX_ROWS],
            "notes": _list_notes(store),
        }


def _list_notes(store: GraphStore) -> list[str]:
    source = clean_text(str(store.value("forecast_by") or ""))
    is_fast = store.mode == "simulated" and store.factor > FASTEST
    return [
        *(f"Still missing: {describe_alarm(each)}." for each in store.present if not each.number),
        *filter(None, [store.site_note, _TOO_FAST if is_fast else "", source]),
    ]


# --- stop, release, clear, dose ------------------------------------------------------------------


def describe_stop(store: GraphStore) -> dict[str, Any]:
    """Return the actions that are possible here, and what the pump node says of those on the pump.

    The pump can be stopped if any node may control it, regardless of what the nodes report. It
    counts as stopped if it is held and at standstill; a hold alone only means that the pump should
    be stopped. ``actions`` contains the question to ask before each action.
    """
    pump = store.pump
    values = pump.values if pump is not None and pump.is_online(store.steady) else {}
    hold = _describe_hold(store, values)
    at_rest = values.get("at_rest") is True and not store.runs_on
    dose = _describe_dose(store, values)
    fault = text_of(values, "fault")
    actions = {"stop": _STOP}
    if store.allow_release:
        if hold and at_rest:
            actions["release"] = _RELEASE
        if fault and not values.get("no_clear") and at_rest:
            actions["clear"] = f"The fault is cleared: {fault}. {_RELEASE}"
        if dose["max"] is not None and not values.get("no_dose"):
            actions["dose"] = _DOSE
    if (valve := store.node(VALVE)) is not None:
        actions["valve_close"] = _CLOSE
        if store.allow_release:
            held = valve.values.get("hold")
            actions |= {"valve_release": _RELEASE_VALVE} if held else {"valve_open": _OPEN}
    return {
        "possible": bool(store.offered), "needed": store.site.irrigated, "hold": hold,
        "stopped": bool(hold) and at_rest, "dose": dose, "actions": actions,
        "label": "Keep the pump off" if at_rest else "Stop the pump",
    }


def _describe_hold(store: GraphStore, values: Mapping[str, Any]) -> str:
    """Describe who holds the pump, since when, until when and why; empty if no one does."""
    hold = values.get("hold")
    if not isinstance(hold, dict) or not (owner := text_of(hold, "owner")):
        return ""
    since, until = number_in(hold, "since"), number_in(hold, "until")
    begin = "" if since is None else f" since {store.time_text(since)}"
    end = "someone releases it" if until is None else store.time_text(until)
    reason = text_of(hold, "reason")
    why = f" ({reason})" if reason else ""
    return f"The pump is held off by {owner}{begin}, until {end}{why}."


def _describe_dose(store: GraphStore, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the latest dose in words, the limits of a dose, and why none is possible now."""
    last = values.get("dose")
    dose = last if isinstance(last, dict) else {}
    runs, largest = bool(dose) and not dose.get("over"), number_in(values, "max_dose")
    told = store.allow_release and largest is not None and not runs
    return {
        "text": _write_dose(dose, number_in(values, "flow")),
        "min": number_in(values, "min_dose") or 0.0, "max": largest,
        "refusal": text_of(values, "no_dose") if told else "",
    }


def _write_dose(dose: Mapping[str, Any], flow: float | None) -> str:
    """Write the progress or the outcome of a dose: ``A dose: 12 L of 20 L, 4 min left.``."""
    if dose.get("over"):
        return f"The latest dose: {text_of(dose, 'sentence')}."
    volume, delivered = number_in(dose, "volume"), number_in(dose, "delivered")
    if volume is None or delivered is None:
        return ""
    progress = f"A dose: {write_litres(delivered)} of {write_litres(volume)}"
    if not flow or flow < 0:
        return f"{progress}; it is waiting."
    return f"{progress}, {max(1, math.ceil(min((volume - delivered) / flow / 60, 1e6)))} min left."


# --- alarms and events ----------------------------------------------------------------------------


def _is_listed(alarm: Alarm) -> bool:
    """Return whether an alarm is shown: not if it follows, unless the headline rests on it."""
    return bool(alarm.number) and (not alarm.follows or (alarm.role, alarm.code) in _MAY_MOVE)


def _list_alarms(store: GraphStore) -> list[dict[str, Any]]:
    """Return the present alarms as they are published, the most important one first."""
    # The pump node comes first (without it, no one knows whether the pump runs), then its state,
    # and what the headline rests on. What devices share comes before what else each may cause.
    ranks = {(PUMP, ""): 0, (PUMP, PUMP): 1}
    present = sorted(filter(_is_listed, store.present), key=lambda alarm: (
        ranks.get((alarm.role, alarm.part), 2), (alarm.role, alarm.code) not in _MAY_MOVE,
        not alarm.is_serious, alarm.code != "devices_lost", -alarm.since,
    ))
    return [{
        "id": alarm.name, "role": alarm.role, "code": alarm.code,
        "level": "error" if alarm.is_serious else "warn", "what": describe_alarm(alarm),
        "do": complete_commands(advise(alarm.code, alarm.role, alarm.node)),
        "since": alarm.since, "since_text": store.time_text(alarm.since),
    } for alarm in present]


def _list_events(store: GraphStore) -> list[dict[str, Any]]:
    """Return an event for each alarm, newest first."""
    alarms = filter(_is_listed, store.alarms)
    return [{
        "at_text": store.time_text(alarm.since), "what": describe_alarm(alarm) + (
            "" if alarm.ended is None else f", until {store.time_text(alarm.ended)}"
        ),
    } for alarm in sorted(alarms, key=lambda alarm: alarm.since, reverse=True)]


# --- the sentence above the tiles, and the next step ----------------------------------------------


def _summarize(
    store: GraphStore, tiles: dict[str, Tile], rows: list[dict[str, Any]]
) -> tuple[dict[str, str], str]:
    """Return the sentence on the state of the site, with its level, and the next step."""
    roof, pump = tiles["roof"], tiles["pump"]
    starting = "The site is starting." if any(not each.number for each in store.present) else ""
    serious = [row for row in rows if row["level"] == "error"]
    gone, known = store.gone_since, store.alarms_known
    seen = "" if store.nodes else ", as far as was seen here"
    # It is not green if a value is not as it should be, even if no action is needed. A dry roof
    # that is being watered is as it should be.
    is_watered = (roof["state"], pump["state"]) == ("low", "running")
    states = {tiles[role]["state"] for role in (PUMP, VALVE) if role in tiles}
    level = "ok" if (
        known and not rows and store.mode != "none" and tiles["cistern"]["state"] == "good"
        and (roof["state"] in ("good", "none") or is_watered)
        and not states & {"unknown", "fault", "held"}
    ) else "warn"
    if serious or gone is not None or "alarm" in states:
        level = "error"
    counts = (len(serious), "alarm"), (len(rows) - len(serious), "warning")
    word = ", ".join(number_of(count, name) for count, name in counts if count)
    word = word or ("All is well" if level == "ok" else "")
    if not known and gone is None:
        word = "Whether there are alarms is unknown"
    # The advice on the first alarm; of these, the box states more.
    told = (PUMP, "hold"), *_MAY_MOVE
    step = next((row["do"] for row in rows if (row["role"], row["code"]) not in told), "")
    unknown = any(tiles[name]["state"] == "unknown" for name in ("roof", "cistern", "pump"))
    worst = serious[0]["what"] if serious else ""
    if worst and serious[0]["role"] != PUMP:
        worst += f"; pump: {pump['value']}"
    now = f"Roof: {roof['sentence'] or roof['value']}; pump: {pump['value']}."
    cases: tuple[tuple[object, str, str], ...] = (
        (gone is not None, "The site's program has not run since "
         f"{store.time_text(gone or 0.0)}{seen}; nobody waters the roof.", complete_commands(
             _START.format(live=command_for(f"{store.namespace}/site", "live")))),
        (store.mode == "none", "No run or site has been found.", _NOTHING),
        (store.mode == "ended", "The run has ended, and its last state is shown.", step),
        (store.runs_on, _WELDED, step),
        (pump["state"] == "alarm", "The pump may be running.", f"{_GO_AND_SEE} {step}".strip()),
        ("alarm" in states, "The outlet valve may be open.", f"{_GO_AND_CLOSE} {step}".strip()),
        (worst, f"{worst}.", step),
        (True, now, step or (_UNKNOWN if unknown and not starting else "No action is needed.")),
    )
    sentence, step = next((sentence, step) for case, sentence, step in cases if case)
    word = " ".join(filter(None, (word and f"{word}.", starting)))
    text = f"{word} {sentence}".strip()
    return {"word": word, "sentence": sentence, "text": text, "level": level}, step


def _advise(store: GraphStore, step: str, stop: dict[str, Any]) -> str:
    """Return what the page's box states: what is being done to the pump, and the next step.

    The step comes first if the pump may be running, or the valve open.
    """
    release = ""
    if "release" in stop["actions"]:
        release = "If the pump may run again, release it with the button below."
    elif stop["stopped"] and (node := store.pump) is not None:
        command = complete_commands(command_for(node.name, "release"))
        who = store.site.contact and f"ask whoever can release it ({store.site.contact}), or "
        release = f"If the pump may run again, {who or ''}release it with: {command}"
    said = [stop["hold"] or stop["dose"]["text"], step]
    said = said[::-1] if step.startswith("Go and see") else said
    return "; ".join(filter(None, (*said, release))).replace(".; ", ". ")


# --- the charts -----------------------------------------------------------------------------------


def make_series(store: GraphStore, hours: float) -> dict[str, Any]:
    """Return the series that the charts show, in the units in which they are shown.

    The time axis begins with the first value, at most ``hours`` ago. It ends with the forecast and
    the plan, but shows at most as much of the future as of the past, and none of it without a
    forecast or a plan. A line is a list of times and values, with None from where no value is
    known.

    Args:
        store: state of the graph.
        hours: length of the history to return (h), one of :data:`HOURS`.
    """
    with store.lock:
        now, site, plan, forecast = store.now, store.site, store.plan, store.forecast
        if not now or store.mode == "none":
            return {"now": None, "lines": {}}
        last = round(now * 1e9)
        past = {name: store.past[name] for name in LINES}
        oldest = [each.rows["ended"][0] for each in past.values() if len(each.rows)]
        first = max(last - round(hours * 3.6e12), int(min(oldest, default=last)))
        stretch = STRETCH_NS * max(1, -(-(last - first) // (STRETCH_NS * _POINTS)))
        gap = max(GAP_S, TICKS * site.tau, 2 * stretch / 1e9)
        lines = {name: each.line(first, last, stretch, gap) for name, each in past.items()}
        ahead = [float(steps.ends[-1]) for steps in (plan, forecast) if steps is not None]
        begin = first / 1e9
        end = max(now, min(max(ahead, default=now), now + AHEAD_S, 2 * now - begin))
        if plan is not None:
            flow, level = plan.values
            lines["flow_planned"] = plan.line(flow, now, end)
            levels = zip(plan.ends.tolist(), level.tolist(), strict=True)
            lines["roof_planned"] = [[at, level] for at, level in levels if now < at <= end]
        if forecast is not None:
            lines["rain_forecast"] = forecast.line(forecast.values.mean(axis=0), now, end)
        lines["target"] = [[begin, site.z_veg], [end, site.z_veg]]
        return {
            "now": now, "from": begin, "to": end,
            "lines": {name: _convert(name, line) for name, line in lines.items()},
            "display": {name: asdict(find_display(topic)) for name, topic in LINES.items()},
        }


def _convert(name: str, line: list[list[Any]]) -> list[list[Any]]:
    """Return a line in the unit in which the interface shows its quantity, with an end."""
    quantity = "roof" if name == "target" else name.partition("_")[0]
    display = find_display(LINES[quantity])
    return [
        [at, None if value is None else round(value * display.factor, display.decimals + 1)]
        for at, value in line
    ] + [[line[-1][0] + END_S, None] for _ in line[:1]]


def complete_commands(text: str) -> str:
    """Return an advice with its commands as they work in a terminal of this machine.

    They have the path of the program, if the shell does not find it, and the ROS domain.
    """
    domain, path = os.environ.get("ROS_DOMAIN_ID", "0"), Path(sys.executable).with_name("greenroof")
    before = "" if domain in ("", "0") else f"ROS_DOMAIN_ID={domain} "
    return _COMMAND.sub(before + ("greenroof" if which("greenroof") else str(path)), text)
