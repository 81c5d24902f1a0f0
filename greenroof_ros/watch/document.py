"""The state and the chart series shown by the page and the status command, as JSON data.

:func:`make_document` creates the state from a store, and :func:`make_series` creates the series.

A state has the entries ``heading``, ``mode``, ``namespace``, ``contact``, ``time``, ``notes``,
``tiles`` (with the ``summary``), ``advice``, ``known`` (whether the alarms are), ``alarms``,
``events`` and ``stop``.
"""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.base.text import clean_text, number_of
from greenroof_ros.interface.alarm import Alarm, advise
from greenroof_ros.interface.conditions import command_for
from greenroof_ros.interface.states import PUMP
from greenroof_ros.watch import tiles, words
from greenroof_ros.watch.history import END_S, choose_stretch
from greenroof_ros.watch.outlook import AHEAD_S
from greenroof_ros.watch.stopping import describe_stop, make_bare_stop
from greenroof_ros.watch.store import INTERVALS, LINES, GraphStore
from greenroof_ros.watch.tiles import Tile

# Longest time for which a value of a line holds (s), as in a report.
_HOLDS_S = 600.0

# How much of the past the charts can show (h), and the approximate number of stretches in a line.
HOURS, _POINTS = (3, 12, 48, 168), 300
# Maximum number of alarms, and of events, that are shown; each has at most some hundred characters.
_MAX_ROWS = 50

_HEADINGS = {
    "none": "Nothing received yet", "ended": "Ended run", "live": "Live site",
    "simulated": "Simulated run",
}
_GO_AND_SEE = "Go and see; if the pump is turning, stop it at its drive's panel or the main switch."
_WELDED = "Water is leaving the cistern although the pump is off. Open the main switch."


def make_document(store: GraphStore, wall: float) -> dict[str, Any]:
    """Return the document for the page and the status command, in plain text.

    If a part cannot be generated, a placeholder takes its place, and a note says so.

    Args:
        store: state of the graph.
        wall: current time (steady clock, s).
    """
    with store.lock:
        return _make_document(store, wall)


def _make_document(store: GraphStore, wall: float) -> dict[str, Any]:
    notes: list[str] = []

    def attempt(name: str, make: Callable[[], Any], instead: Any) -> Any:
        try:
            part = make()
            json.dumps(part, allow_nan=False)
        except Exception as error:  # whatever the error, the stop and the other parts are shown
            print_seldom(name, traceback.format_exc())
            why = clean_text(f"{type(error).__name__}: {error}", 200)
            notes.append(f"{name} cannot be shown ({why}).")
            return instead
        return part

    attempt("The list of overdue values", lambda: store.update(wall), None)
    stop = attempt("The list of actions on the pump", lambda: describe_stop(store),
                   make_bare_stop())
    rows = attempt("The list of alarms", lambda: list_alarms(store), [])
    shown: dict[str, Tile] = {}
    for name, label, make in (
        ("roof", "Roof level", lambda: tiles.make_roof_tile(store)),
        ("cistern", "Cistern level", lambda: tiles.make_cistern_tile(store)),
        ("pump", "Pump", lambda: tiles.make_pump_tile(store)),
        ("watering", "Watering", lambda: tiles.make_watering_tile(store, shown["pump"])),
        ("rain", "Rain", lambda: tiles.make_rain_tile(store)),
        ("temperature", "Temperature", lambda: tiles.make_temperature_tile(store)),
    ):
        shown[name] = attempt(f"The {name} tile", make, tiles.make_unknown_tile(label))
    summary, advice = attempt(
        "The summary", lambda: _summarize(store, shown, rows, stop),
        ({"word": "", "sentence": "The state is unknown.", "level": "stale"}, stop["warning"]),
    )
    unknown = {"now": None, "text": words.UNKNOWN, "zone": "UTC"}
    result = {
        "heading": attempt("The heading", lambda: _write_heading(store), "Green roof"),
        "mode": store.mode, "namespace": store.namespace, "contact": store.site.contact or "",
        "known": store.alarms_known or store.ended,
        "time": attempt("The time", store.clock, unknown),
        "tiles": {**shown, "summary": summary}, "advice": advice, "stop": stop,
        "alarms": rows[:_MAX_ROWS],
        "events": attempt("The list of events", lambda: _list_events(store), [])[:_MAX_ROWS],
    }
    if notes and summary["level"] == "ok":
        summary["level"] = "warn"
    if len(rows) > _MAX_ROWS:
        notes.append(f"{len(rows) - _MAX_ROWS} more alarms are not shown.")
    return result | {"notes": notes + attempt("The list of notes", lambda: _list_notes(store), [])}


def _write_heading(store: GraphStore) -> str:
    heading, factor = _HEADINGS[store.mode], store.factor
    if factor is None or store.mode != "simulated":
        return heading
    times = words.write_number(factor, 0 if factor >= 9.95 else 1).removesuffix(".0")
    return f"{heading}, " + ("in real time" if times == "1" else f"{times} times real time")


def _list_notes(store: GraphStore) -> list[str]:
    missing = [alarm for alarm in store.alarms if not alarm.number]
    notes = ["The site is starting. Still missing:", *(
        f"{words.name_source(alarm.name, alarm.role)}: {alarm.sentence}." for alarm in missing
    )] if missing else []
    weather = store.graph.node("weather", store.wall)
    source = "" if weather is None else words.text_of(weather.values, "forecast_by")
    return [*notes, *filter(None, store.notes), *(
        [f"{source[:1].upper()}{source[1:]}."] if source else []
    )]


# --- alarms and events ----------------------------------------------------------------------------


def list_alarms(store: GraphStore) -> list[dict[str, Any]]:
    """Return the present alarms as they are published, the most important one first.

    An alarm that follows from another one is left out. If the site's program as a whole no longer
    runs, that is the only alarm.
    """
    if (since := store.gone_since) is not None:
        space = f" --namespace {store.namespace.strip('/')}" if store.namespace else ""
        return [{
            "id": "site", "name": "Site", "level": "error", "code": "not_heard",
            "what": "the site's program no longer runs", "do": words.complete_commands(
                "Start it with: sudo systemctl start greenroof, if it is a service, or else with: "
                f"greenroof live{space} and its options. If the pump is still turning, stop it at "
                "its drive's panel or at the main switch."
            ), "since": since, "since_text": store.time_of_day(since),
        }]

    def order(alarm: Alarm) -> tuple[bool, int, bool, float]:
        # The pump node comes first (without it, no one knows whether the pump runs), then its
        # state; other devices come last.
        rank = {(PUMP, ""): 0, (PUMP, PUMP): 1}.get((alarm.role, alarm.part), 2)
        return not alarm.role, rank, not alarm.is_serious, -alarm.since

    return [
        {
            "id": alarm.name, "name": words.name_source(alarm.name, alarm.role),
            "level": "error" if alarm.is_serious else "warn", "code": alarm.code,
            "what": alarm.sentence,
            "do": words.complete_commands(advise(alarm.code, alarm.role, alarm.node)),
            "since": alarm.since, "since_text": store.time_of_day(alarm.since),
        }
        for alarm in sorted(store.present, key=order) if not alarm.follows
    ]


def _list_events(store: GraphStore) -> list[dict[str, Any]]:
    """Return the events, newest first: one for each alarm, and others such as requests."""
    events = [*reversed(store.events)]
    for alarm in store.alarms:
        if alarm.number and not alarm.follows:
            what = f"{words.name_source(alarm.name, alarm.role)}: {alarm.sentence}"
            if alarm.ended is not None:
                what += f", until {store.time_of_day(alarm.ended)}"
            events.append((alarm.since, what))
    events.sort(key=lambda event: event[0], reverse=True)
    return [{"at_text": store.time_of_day(at), "what": what} for at, what in events]


# --- the sentence above the tiles, and the next step ----------------------------------------------


def join_summary(shown: Mapping[str, Any]) -> str:
    """Return the summary of a document as a single string."""
    summary = shown["tiles"]["summary"]
    return f"{summary['word']} {summary['sentence']}".strip()


def _summarize(
    store: GraphStore, shown: dict[str, Tile], rows: list[dict[str, Any]], stop: dict[str, Any]
) -> tuple[dict[str, str], str]:
    """Return the sentence on the state of the site, with its level, and the next step."""
    serious = sum(row["level"] == "error" for row in rows)
    counts = [
        number_of(count, name)
        for count, name in ((serious, "alarm"), (len(rows) - serious, "warning")) if count
    ]
    known = store.alarms_known or store.ended
    # It is not green if a value is not as it should be, even if no action is needed.
    attention = rows or not known or store.mode == "none" or (
        not (shown["roof"]["state"] == "good" or _is_being_watered(shown))
        or shown["cistern"]["state"] != "good"
        or shown["pump"]["state"] in ("unknown", "fault", "held")
    )
    wrong = serious or stop["warning"] or shown["pump"]["alarm"]
    waits = tiles.describe_wait(store, shown["pump"])
    starting = any(not alarm.number for alarm in store.alarms)
    if store.mode == "none":
        word = "Nothing received yet."
    elif store.gone_since is not None:
        word = ""
    elif not known:
        word = "Whether there are alarms is unknown."
    else:
        word = f"{', '.join(counts)}." if counts else "" if attention else "All is well."
    return {
        "word": word + (" The site is starting." if starting else ""),
        "sentence": _write_sentence(store, shown, rows, waits),
        "level": "error" if wrong else "warn" if attention else "ok",
    }, _advise(store, shown, rows, stop, waits, starting)


def _write_sentence(
    store: GraphStore, shown: dict[str, Tile], rows: list[dict[str, Any]], waits: str
) -> str:
    """Return a sentence on the worst alarm or the state of the roof, and on the pump."""
    if store.mode == "none":
        return "No run or site has been found."
    if (since := store.gone_since) is not None:
        return (
            f"The site's program has not run since {store.time_of_day(since)}; nobody waters the "
            "roof."
        )
    if tiles.runs_on(store) and not store.ended:
        return _WELDED
    roof, clause = shown["roof"], _write_pump_clause(shown["pump"])
    if store.ended:
        doubt = f"; {clause}" if shown["pump"]["alarm"] else ""
        return f"The run has ended, and its last state is shown{doubt}."
    if shown["pump"]["alarm"]:
        return "The pump may be running."
    worst = next((row for row in rows if row["level"] == "error"), None)
    if worst is not None:
        first = f"{worst['name']}: {worst['what']}"
        pump = "" if worst["name"] == "Pump" else tiles.write_pump(shown["pump"]["value"])
        return f"{'; '.join(filter(None, (first, pump)))}."
    if roof["state"] in ("unknown", "alarm", "doubtful"):
        level_clause = f"The roof's level is {roof['value']} ({roof['sentence']})"
    else:
        judged = {"low": "too dry, ", "high": "wetter than it should be, "}.get(roof["state"], "")
        if _is_being_watered(shown):
            judged = ""  # nothing is wrong
        level_clause = f"The roof is {judged}{roof['sentence']}"
    return f"{level_clause}; {f'the pump is {waits}' if waits else clause}."


def _is_being_watered(shown: Mapping[str, Tile]) -> bool:
    """Return whether a roof that is too dry is being watered, so that nothing is wrong."""
    return (shown["roof"]["state"], shown["pump"]["state"]) == ("low", "running")


def _write_pump_clause(pump: Tile) -> str:
    clause, why = tiles.write_pump(pump["value"]), pump["why"]
    if pump["state"] in ("running", "starting", "stopping"):
        return f"{clause} at {tiles.write_flow(pump['number'])}" if pump["number"] else clause
    if not why or pump["state"] not in ("off", "held", "fault"):
        return clause
    return f"{clause}, since {why}" if pump["state"] == "off" else f"{clause}: {why}"


def _advise(
    store: GraphStore, shown: dict[str, Tile], rows: list[dict[str, Any]], stop: dict[str, Any],
    waits: str, starting: bool,
) -> str:
    """Return what the page's box states: what is being done to the pump, and the next step.

    The next step is the advice on the first alarm. A hold is intentional, so beside it only an
    alarm counts, not a warning.
    """
    first = next((
        row["do"] for row in rows if row["code"] != "hold" and (
            row["level"] == "error" or not stop["hold"]
        )
    ), "")
    if shown["pump"]["alarm"] and all(row["level"] != "error" for row in rows):
        first = _GO_AND_SEE
    if stop["warning"]:
        return " ".join(filter(None, (stop["warning"], first)))
    if stop["hold"]:
        return " ".join(filter(None, (stop["hold"], first, _explain_release(store, stop))))
    explained = first or _explain(store, shown, waits, starting)
    return " ".join(filter(None, (stop["dose"]["text"], explained)))


def _explain_release(store: GraphStore, stop: Mapping[str, Any]) -> str:
    """Explain how to release the pump; empty if it cannot be released now."""
    if "release" in stop["actions"]:
        return "If it may run again, release it with the button below."
    if store.pump is None or not stop["stopped"]:
        return ""
    command = words.complete_commands(command_for(store.pump.name, "release"))
    return f"If it may run again, release it with: {command}"


def _explain(store: GraphStore, shown: dict[str, Tile], waits: str, starting: bool) -> str:
    """Return the advice or explanation to show if there is no alarm."""
    roof, pump = shown["roof"]["state"], shown["pump"]
    if starting:
        return "Nothing to do: the site is starting. Whatever is still missing is listed below."
    if store.mode == "none":
        return (
            "Start a run or a site. If one is already running, check that this watcher uses the "
            "same ROS_DOMAIN_ID and --namespace."
        )
    if store.ended:
        return "The run is over, so the values shown are not current."
    if {shown[name]["state"] for name in ("roof", "cistern", "pump")} & {"unknown", "alarm"}:
        return (
            "No fault is reported, but some values are unknown: check that the sensors and "
            "programs are running."
        )
    runs = pump["state"] in ("starting", "running")
    if roof != "low" or runs or waits or pump["idle"]:
        return "Nothing to do."
    why = f": {pump['why']}" if pump["why"] else ""
    return f"The roof is not being watered, since the pump is {pump['state']}{why}."


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
        now, site = store.now, store.site
        if now is None:
            return {"now": None, "lines": {}}
        newest = max((value.time_ns for value in store.newest.values()), default=0)
        last = max(newest, round(now * 1e9))
        past = {name: store.past[name] for name in LINES}
        oldest = [each.first_ns for each in past.values() if each.first_ns is not None]
        first = max(last - round(hours * 3.6e12), min(oldest, default=last))
        stretch = choose_stretch(first, last, _POINTS)
        gap = max(_HOLDS_S, INTERVALS * site.tau, 2 * stretch / 1e9)
        lines = {name: each.line(first, last, stretch, gap) for name, each in past.items()}
        plan, forecast = store.plan, store.forecast
        flow = [] if plan is None else plan.rows(plan.flow, now)
        levels = [] if plan is None else plan.rows(plan.level, now)
        rain = [] if forecast is None else forecast.rows(forecast.rain.mean(axis=0), now)
        begin, end = first / 1e9, max((rows[-1][1] for rows in (flow, rain) if rows), default=now)
        end = max(now, min(end, now + AHEAD_S, 2 * now - begin))
        lines["roof_planned"] = [[at, level] for _, at, level in levels if at <= end]
        lines["flow_planned"] = _step(flow, end)
        lines["rain_forecast"] = _step(rain, end)
        lines["target"] = [[begin, site.z_veg], [end, site.z_veg]]
        return {
            "now": now, "from": begin, "to": end,
            "lines": {name: _convert(name, line) for name, line in lines.items()},
            "display": {name: asdict(words.find_display(topic)) for name, topic in LINES.items()},
        }


def _step(rows: Sequence[tuple[float, float, float]], last: float) -> list[list[Any]]:
    """Return the line of values that each hold from one time until another, up to the last."""
    seen = [(begin, min(end, last), value) for begin, end, value in rows if begin < last]
    return [*([begin, value] for begin, _, value in seen),
            *([end, value] for _, end, value in seen[-1:])]


def _convert(name: str, line: list[list[Any]]) -> list[list[Any]]:
    """Return a line in the unit in which the interface shows its quantity, with an end."""
    quantity = "roof" if name == "target" else name.partition("_")[0]
    display = words.find_display(LINES[quantity])
    return [
        [at, None if value is None else round(value * display.factor, display.decimals + 1)]
        for at, value in line
    ] + [[line[-1][0] + END_S, None] for _ in line[:1]]
