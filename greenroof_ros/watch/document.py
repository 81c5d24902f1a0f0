"""The state and the chart series shown by the page and the status command, as JSON data.

:func:`make_document` creates the state from a store, and :func:`make_series` creates the series.

A state has the entries ``heading``, ``mode``, ``namespace``, ``time``, ``notes``, ``tiles`` (with
the ``summary``), ``advice``, ``alarms``, ``events`` and ``stop``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import accumulate
from typing import Any

from greenroof_ros.base.text import clean_text
from greenroof_ros.watch import alarms, tiles, words
from greenroof_ros.watch.history import END_S, choose_stretch
from greenroof_ros.watch.outlook import AHEAD_S
from greenroof_ros.watch.parts import Parts
from greenroof_ros.watch.stopping import describe_stop, explain_release, make_bare_stop
from greenroof_ros.watch.store import INTERVALS, LINES, GraphStore
from greenroof_ros.watch.tiles import Tile

# Longest time for which a value of a line holds (s), as in a report.
_HOLDS_S = 600.0

# How much of the past the charts can show (h), and the approximate number of stretches in a line.
HOURS, _POINTS = (3, 12, 48, 168), 300
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
    parts = Parts()
    parts.make("The list of overdue values", lambda: store.update(wall), None)
    stop = parts.make(
        "The list of actions on the pump", lambda: describe_stop(store), make_bare_stop()
    )
    rows = parts.make("Alarms", lambda: alarms.list_alarms(store), [])
    listed = _trim(rows, _MAX_ALARMS)
    shown: dict[str, Tile] = {}
    for name, label, make in (
        ("roof", "Roof level", lambda: tiles.make_roof_tile(store)),
        ("cistern", "Cistern level", lambda: tiles.make_cistern_tile(store)),
        ("pump", "Pump", lambda: tiles.make_pump_tile(store)),
        ("rain", "Rain", lambda: tiles.make_rain_tile(store)),
        ("watering", "Watering", lambda: tiles.make_watering_tile(store, shown["pump"])),
    ):
        shown[name] = parts.make(f"The {name} tile", make, tiles.make_unknown_tile(label))
    waits = parts.make(
        "The awaited rain", lambda: tiles.describe_wait(store, shown["pump"]["idle"]), ""
    )
    unknown = {"word": "Alarms are unknown.", "sentence": "", "level": "stale"}
    summary = unknown if "Alarms" in parts.failed else parts.make(
        "The summary", lambda: _summarize(store, shown, rows, stop["warning"], waits), unknown
    )
    result = {
        "heading": parts.make("The heading", lambda: _write_heading(store), "Green roof"),
        "mode": store.mode,
        "namespace": store.namespace,
        "time": parts.make(
            "The time", store.clock, {"now": None, "text": words.UNKNOWN, "clock": []},
        ),
        "tiles": {**shown, "summary": summary},
        "advice": parts.make(
            "The advice", lambda: _advise(store, shown, rows, stop, waits), stop["warning"],
        ),
        "alarms": listed,
        "events": parts.make("Events", lambda: _trim(_list_events(store), _MAX_EVENTS), []),
        "stop": stop,
    }
    notes = parts.make("The notes", lambda: _list_notes(store, len(rows) - len(listed)), [])
    if parts.failed and summary["level"] == "ok":
        summary["level"] = "warn"
    return result | {"notes": [*parts.notes, *notes]}


def _list_events(store: GraphStore) -> list[dict[str, Any]]:
    """Return the events, newest first."""
    return [
        {"at_text": store.time_of_day(at), "what": what} for at, what in reversed(store.events)
    ]


def join_summary(shown: Mapping[str, Any]) -> str:
    """Return the summary of a document as a single string."""
    summary = shown["tiles"]["summary"]
    return f"{summary['word']} {summary['sentence']}".strip()


def _write_heading(store: GraphStore) -> str:
    heading, factor = _HEADINGS[store.mode], store.factor
    if factor is None or store.mode != "simulated":
        return heading
    times = words.write_number(factor, 0 if factor >= 9.95 else 1).removesuffix(".0")
    return f"{heading}, " + ("in real time" if times == "1" else f"{times} times real time")


def _list_notes(store: GraphStore, hidden: int) -> list[str]:
    notes = [*store.notes]
    if missing := store.judge.missing:
        listed = [
            f"{words.name_source(name)}: {diagnosis.sentence}."
            for name, diagnosis in missing.items()
        ]
        notes[:0] = ["The site is starting. Still missing:", *map(clean_text, listed)]
    if hidden:
        notes.append(f"{hidden} more alarms are not shown.")
    weather = store.graph.node("weather")
    if weather is not None and (source := weather.text("forecast_by")):
        notes.append(f"{source[:1].upper()}{source[1:]}.")
    return [note for note in notes if note]


# --- the sentence above the tiles -----------------------------------------------------------------


def _summarize(
    store: GraphStore, shown: dict[str, Tile], rows: list[dict[str, Any]], warning: str, waits: str
) -> dict[str, str]:
    """Return the sentence on the state of the site, the words before it, and the level of both."""
    serious = sum(row["level"] != "warn" for row in rows)
    counts = [
        f"{count} {name}" if count == 1 else f"{count} {name}s"
        for count, name in ((serious, "alarm"), (len(rows) - serious, "warning")) if count
    ]
    wrong = serious or warning or shown["pump"]["alarm"]
    # It is not green if a value is not as it should be, even if no action is needed.
    attention = rows or store.mode == "none" or (
        any(shown[tank]["state"] != "good" for tank in ("roof", "cistern"))
        or shown["pump"]["state"] in ("unknown", "fault", "held")
    )
    level = "error" if wrong else "warn" if attention else "ok"
    if store.mode == "none":
        word = "Nothing received yet."
    elif store.gone_since is not None or not (counts or level == "ok"):
        word = ""
    else:
        word = f"{', '.join(counts)}." if counts else "All is well."
    starting = " The site is starting." if store.judge.missing else ""
    return {
        "word": word + starting, "sentence": _write_sentence(store, shown, waits), "level": level,
    }


def _write_sentence(store: GraphStore, shown: dict[str, Tile], waits: str) -> str:
    """Return a sentence on the state of the roof and the pump, and on any rain that is awaited."""
    if store.mode == "none":
        return "No run or site has been found."
    if (since := store.gone_since) is not None:
        return (
            f"The site's program has not run since {store.time_of_day(since)}; nobody waters the "
            "roof."
        )
    if store.pump is not None and store.pump.runs_on and not store.ended:
        return "Water is leaving the cistern although the pump is off. Open the main switch."
    if store.ended:
        doubt = f"; {_write_pump_clause(shown['pump'])}" if shown["pump"]["alarm"] else ""
        return f"The run has ended, and its last state is shown{doubt}."
    roof = shown["roof"]
    if roof["state"] in ("unknown", "alarm"):
        level_clause = f"The roof's level is {roof['value']}"
        if roof["state"] == "unknown":
            level_clause = f"The roof's level is unknown now ({roof['sentence']})"
    else:
        judged = {"low": "too dry, ", "high": "wetter than it should be, "}.get(roof["state"], "")
        level_clause = f"The roof is {judged}{roof['sentence']}"
    clause = f"the pump is {waits}" if waits else _write_pump_clause(shown["pump"])
    return f"{level_clause}; {clause}."


def _write_pump_clause(pump: Tile) -> str:
    clause, why = tiles.write_pump(pump["value"]), pump["why"]
    if pump["state"] in ("running", "starting", "stopping"):
        return f"{clause} at {tiles.write_flow(pump['number'])}" if pump["number"] else clause
    if not why or pump["state"] not in ("off", "held", "fault"):
        return clause
    return f"{clause}, since {why}" if pump["state"] == "off" else f"{clause}: {why}"


def _advise(
    store: GraphStore, shown: dict[str, Tile], rows: list[dict[str, Any]], stop: dict[str, Any],
    waits: str,
) -> str:
    """Return what the page's box states: what is being done to the pump, and the next step.

    The next step is the advice on the first alarm. A hold is intentional, so beside it only an
    alarm counts, not a warning.
    """
    first = next((
        row["do"] for row in rows if row["code"] != "hold" and (
            row["level"] != "warn" or not stop["hold"]
        )
    ), "")
    if stop["warning"]:
        return " ".join(filter(None, (stop["warning"], first)))
    if stop["hold"]:
        return " ".join(filter(None, (stop["hold"], first, explain_release(store, stop))))
    return " ".join(filter(None, (stop["dose"]["text"], first or _explain(store, shown, waits))))


def _explain(store: GraphStore, shown: dict[str, Tile], waits: str) -> str:
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
    if roof != "low" or runs or waits or pump["idle"]:
        return "Nothing to do."
    why = f": {pump['why']}" if pump["why"] else ""
    return f"The roof is not being watered, since the pump is {pump['state']}{why}."


def _trim(rows: list[dict[str, Any]], max_length: int) -> list[dict[str, Any]]:
    """Return the first rows, as many as fit into ``max_length`` characters of JSON."""
    lengths = accumulate(len(json.dumps(row)) + 2 for row in rows)
    return [row for row, length in zip(rows, lengths, strict=True) if length <= max_length]


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
        oldest = [past.first_ns for past in store.past.values() if past.first_ns is not None]
        first = max(last - round(hours * 3.6e12), min(oldest, default=last))
        stretch = choose_stretch(first, last, _POINTS)
        gap = max(_HOLDS_S, INTERVALS * site.tau, 2 * stretch / 1e9)
        lines = {
            name: past.line(first, last, stretch, gap) for name, past in store.past.items()
        }
        plan = [] if store.plan is None else store.plan.rows(now)
        rain = [] if store.forecast is None else store.forecast.rows(now)
        begin, end = first / 1e9, max((rows[-1][1] for rows in (plan, rain) if rows), default=now)
        end = max(now, min(end, now + AHEAD_S, 2 * now - begin))
        lines["roof_planned"] = [[at, level] for _, at, _, level in plan if at <= end]
        lines["flow_planned"] = _step([(start, stop, flow) for start, stop, flow, _ in plan], end)
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
