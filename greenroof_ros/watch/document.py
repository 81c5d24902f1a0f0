"""The document and the chart series shown by the page and the status command, as JSON data.

:func:`make_document` creates the document from a store, and :func:`make_series` creates the series.

A document has the entries ``heading``, ``mode``, ``namespace``, ``time``, ``notes``, ``tiles``
(with the ``summary``), ``advice``, ``alarms``, ``events`` and ``stop``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from itertools import accumulate
from typing import Any

from greenroof_ros.base.ranges import Range
from greenroof_ros.base.text import clean_text
from greenroof_ros.watch import alarms, tiles, words
from greenroof_ros.watch.history import choose_stretch
from greenroof_ros.watch.outlook import AHEAD_S
from greenroof_ros.watch.parts import Parts
from greenroof_ros.watch.stopping import describe_stop, make_bare_stop
from greenroof_ros.watch.store import EXPECTED, INTERVALS, LINES, GraphStore
from greenroof_ros.watch.tiles import Tile, find_band

_LEVELS = "roof", "cistern", EXPECTED  # change slowly; all other lines change in steps
# Longest time for which a value of a line holds (s), as in a report.
_HOLDS_S = 600.0

# How much of the past a series may show (h), and the approximate number of points in a line.
HOURS, _POINTS = Range(0.1, 168.0), 400
# Maximum number of characters of all alarms, and of all events, since the document must stay below
# 100 kB.
_MAX_ALARMS, _MAX_EVENTS = 55_000, 25_000

_HEADINGS = {
    "none": "Nothing received yet", "ended": "Ended run", "live": "Live site",
    "simulated": "Simulated run",
}


def make_document(store: GraphStore, wall: float) -> dict[str, Any]:
    """Return the document for the page and the status command, in plain text of less than 100 kB.

    Each part is generated separately. If a part cannot be generated, a placeholder takes its place,
    and a note says so.

    Args:
        store: state of the graph.
        wall: current time (steady clock, s).
    """
    with store.lock:
        return _make_document(store, wall)


def _make_document(store: GraphStore, wall: float) -> dict[str, Any]:
    parts, bare = Parts(), make_bare_stop()
    parts.make("The list of overdue values", lambda: store.update(wall), None)
    stop = parts.make("The list of actions on the pump", lambda: describe_stop(store), bare)
    rows = parts.make("Alarms", lambda: alarms.list_alarms(store), [])
    listed, present = _trim(rows, _MAX_ALARMS), [row for row in rows if row["over"] is None]
    shown = {
        name: parts.make(
            f"The {name} tile", partial(make, *given), tiles.make_unknown_tile(label)
        )
        for name, label, make, *given in (
            ("roof", "Roof level", tiles.make_roof_tile, store),
            ("cistern", "Cistern level", tiles.make_cistern_tile, store),
            ("pump", "Pump", tiles.make_pump_tile, store, present),
            ("rain", "Rain", tiles.make_rain_tile, store),
            ("controller", "Controller", tiles.make_controller_tile, store, present),
        )
    }
    waits = parts.make(
        "The awaited rain", lambda: tiles.describe_wait(store, shown["pump"]["idle"]), ""
    )
    serious, warnings, following = parts.make(
        "The number of alarms", lambda: alarms.count_alarms(store), (0, 0, 0)
    )
    summary = parts.make("The summary", lambda: {
        "word": "Nothing received yet:" if store.mode == "none"
        else _write_counts(serious, warnings, following)
        + (" The site is starting." if store.judge.missing else ""),
        "sentence": _write_sentence(store, shown, waits),
        "level": "error" if serious or stop["warning"]
        else "warn" if warnings or store.mode == "none"
        else _judge_level(shown),
    }, {"word": "Alarms are unknown.", "sentence": "", "level": "stale"})
    result = {
        "heading": parts.make("The heading", lambda: _write_heading(store), "Green roof"),
        "mode": store.mode,
        "namespace": store.namespace,
        "time": parts.make(
            "The time", store.clock, {"now": None, "text": words.UNKNOWN, "clock": []},
        ),
        "tiles": {**shown, "summary": summary},
        "advice": parts.make(
            "The advice",
            lambda: alarms.choose_advice(present) if present else _advise(store, shown, waits), "",
        ),
        "alarms": listed,
        "events": parts.make("Events", lambda: _trim(alarms.list_events(store), _MAX_EVENTS), []),
        "stop": stop,
    }
    notes = parts.make("The notes", lambda: _list_notes(store, len(rows) - len(listed)), [])
    if "Alarms" in parts.failed:
        summary["word"] = "Alarms are unknown."
    if parts.failed and summary["level"] == "ok":
        summary["level"] = "warn"
    return result | {"notes": [*parts.notes, *notes]}


def list_present(shown: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the alarms in a document that are still active."""
    return [row for row in shown["alarms"] if row["over"] is None]


def join_summary(shown: Mapping[str, Any]) -> str:
    """Return the summary of a document as a single string."""
    summary = shown["tiles"]["summary"]
    return f"{summary['word']} {summary['sentence']}"


def _write_heading(store: GraphStore) -> str:
    heading, factor = _HEADINGS[store.mode], store.factor
    if factor is None or store.mode != "simulated":
        return heading
    times = words.write_number(factor, 0 if factor >= 9.95 else 1).removesuffix(".0")
    return f"{heading}, " + ("in real time" if times == "1" else f"{times} times real time")


def _list_notes(store: GraphStore, hidden: int) -> list[str]:
    notes = [*store.notes]
    if missing := store.judge.missing:
        listed = [f"{name}: {diagnosis.sentence}." for name, diagnosis in missing.items()]
        notes[:0] = ["The site is starting. Still missing:", *map(clean_text, listed)]
    if hidden:
        notes.append(f"{hidden} more alarms are not shown.")
    weather = store.graph.node("weather")
    if weather is not None and (source := weather.text("forecast_by")):
        notes.append(f"{source[:1].upper()}{source[1:]}.")
    return [note for note in notes if note]


# --- the sentence above the tiles -----------------------------------------------------------------


def _write_counts(alarms: int, warnings: int, following: int) -> str:
    counts = [
        f"{count} {name}" if count == 1 else f"{count} {name}s"
        for count, name in ((alarms, "alarm"), (warnings, "warning")) if count
    ]
    more = f" (and {following} more as a result)" if following else ""
    return f"{', '.join(counts) or 'No alarms'}{more}."


def _judge_level(shown: dict[str, Tile]) -> str:
    """Return the level to show if there are no alarms: ``ok`` or ``warn``.

    The level is never ``ok`` if a tile shows a problem, even if no action is needed.
    """
    attention = (
        any(shown[tank]["state"] != "good" for tank in ("roof", "cistern"))
        or shown["pump"]["state"] in ("unknown", "fault", "held")
    )
    return "warn" if attention else "ok"


def _write_sentence(store: GraphStore, shown: dict[str, Tile], waits: str) -> str:
    """Return a sentence on the state of the roof and the pump, and on any rain that is awaited."""
    if store.mode == "none":
        return "no run or site has been found."
    if store.ended:
        doubt = f"; {_write_pump_clause(shown['pump'])}" if shown["pump"]["alarm"] else ""
        return f"The run has ended, and its last state is shown{doubt}."
    roof = shown["roof"]
    if roof["state"] in ("unknown", "alarm"):
        level_clause = f"The roof's level is {roof['value']}"
        if roof["stale"] or roof["why"]:
            level_clause = f"The roof's level is unknown now ({roof['sentence']})"
    else:
        judged = {"low": "too dry, ", "high": "wetter than it should be, "}.get(roof["state"], "")
        level_clause = f"The roof is {judged}{roof['sentence']}"
    clause = f"the pump is {waits}" if waits else _write_pump_clause(shown["pump"])
    return f"{level_clause}; {clause}."


def _write_pump_clause(pump: Tile) -> str:
    state, why = pump["state"], pump["why"]
    if pump["alarm"]:
        return "it is unknown whether the pump is stopped"
    if state == "unknown":
        return "the state of the pump is unknown"
    if state in ("running", "starting", "stopping"):
        clause = f"the pump is {state}"
        return f"{clause} at {tiles.write_flow(pump['number'])}" if pump["number"] else clause
    if state == "fault":
        return f"the pump has a fault: {why}"
    if state == "held":
        return f"the pump is held off: {why}"
    return "the pump is off" + (f", since {why}" if why else "")


def _advise(store: GraphStore, shown: dict[str, Tile], waits: str) -> str:
    """Return the advice or explanation to show if there is no alarm."""
    if store.judge.missing:
        return (
            "Nothing to do: the site is starting. Whatever is still missing is listed below."
        )
    roof, pump = shown["roof"]["state"], shown["pump"]
    if store.mode == "none":
        return (
            "Start a run or a site. If one is already running, check that this watcher uses the "
            "same ROS_DOMAIN_ID and --namespace."
        )
    if store.mode == "ended":
        return "The run is over, so the values shown are not current."
    if {shown[name]["state"] for name in ("roof", "cistern", "pump")} & {"unknown", "alarm"}:
        return (
            "No fault is reported, but some values are unknown: check that the sensors and "
            "programs are running."
        )
    runs = pump["state"] in ("starting", "running")
    if roof == "high" and runs:
        return (
            "The roof has enough water, but the pump is running: check whether it should be "
            "running."
        )
    if roof != "low" or runs or waits:
        return "Nothing to do."
    if pump["idle"]:
        return f"Nothing to do now: the controller {shown['controller']['sentence']}."
    why = f": {pump['why']}" if pump["why"] else ""
    return f"The roof is not being watered, since the pump is {pump['state']}{why}."


def _trim(rows: list[dict[str, Any]], max_length: int) -> list[dict[str, Any]]:
    """Return the first rows, as many as fit into ``max_length`` characters of JSON."""
    lengths = accumulate(len(json.dumps(row)) + 2 for row in rows)
    return [row for row, length in zip(rows, lengths, strict=True) if length <= max_length]


# --- the charts -----------------------------------------------------------------------------------


def make_series(store: GraphStore, hours: float) -> dict[str, Any]:
    """Return the series that the charts show, from ``hours`` ago to 12 h ahead, in SI units.

    Each row covers a ``stretch`` (s), which is a fraction of the time for which there are values,
    so even a run that has just begun has many rows. The last point of a line is the latest value,
    which the tiles also show. A line has a gap between two rows that are more than ``gap`` (s)
    apart, since no value is valid for longer, and from a row of None to the next row.

    Args:
        store: state of the graph.
        hours: length of the history to return (h), within :data:`HOURS`.
    """
    with store.lock:
        now, site = store.now, store.site
        newest = max((value.time_ns for value in store.newest.values()), default=0)
        last = max(newest, round((now or 0.0) * 1e9))
        oldest = [past.first_ns for past in store.past.values() if past.first_ns is not None]
        first = max(last - round(hours * 3.6e12), min(oldest, default=last))
        stretch = choose_stretch(first, last, _POINTS)
        return {
            "now": now,
            "from": None if now is None else now - hours * 3600,
            "to": None if now is None else now + AHEAD_S,
            "lines": {
                name: past.window(first, last, stretch, steps=name not in _LEVELS)
                for name, past in store.past.items()
            },
            "gap": max(_HOLDS_S, INTERVALS * site.tau, 2 * stretch / 1e9),
            "stretch": stretch / 1e9,
            "forecast": [] if store.forecast is None else store.forecast.rows(),
            "plan": [] if store.plan is None or now is None else store.plan.rows(now),
            "marks": {  # m; None if there is none
                "target": site.z_veg, "band": find_band(site), "suction": site.suction_level,
                "low_outlet": site.low_outlet_level, "overflow": site.z_o,
            },
            "display": {name: asdict(words.find_display(topic)) for name, topic in LINES.items()},
        }
