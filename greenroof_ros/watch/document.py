"""What page and status show, as data for JSON: the document, and the series of the charts.

One function makes each of them from a store.

The entries of a document: ``heading``, ``mode``, ``namespace``, ``time``, ``notes``, ``tiles``
(with the ``summary``), ``advice``, ``alarms``, ``alarms_known``, ``events``, ``account`` and
``stop``.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np

from greenroof_ros.common.ranges import Range
from greenroof_ros.watch import tiles, words
from greenroof_ros.watch.account import ENTRIES, HOLDS_NS
from greenroof_ros.watch.history import Gaps, stretch_of
from greenroof_ros.watch.outlook import AHEAD_S
from greenroof_ros.watch.parts import Parts
from greenroof_ros.watch.stopping import bare_stop, stop_of
from greenroof_ros.watch.store import INTERVALS, GraphStore
from greenroof_ros.watch.tiles import Tile, band_of

LINES = {
    "roof": "/roof/level",
    "cistern": "/cistern/level",
    "command": "/pump/command",
    "flow": "/pump/flow",
    "rain": "/weather/precipitation",
    "evapotranspiration": "/weather/evapotranspiration",
}
"""Lines of the charts, each with its topic."""
_LEVELS = "roof", "cistern"  # change slowly, all others in steps

# How much of the past a series may show (h), and about how many points a line has.
HOURS, _POINTS = Range(0.1, 168.0), 400
# The most characters of all alarms, and of all events: the document must stay below 100 kB.
_MOST_ALARMS, _MOST_EVENTS = 55_000, 25_000

_HEADINGS = {
    "none": "Nothing received yet", "ended": "Ended run", "live": "Live site",
    "simulated": "Simulated run", "loop": "Simulated site with a drive",
}


def document(store: GraphStore, wall: float) -> dict[str, Any]:
    """Return everything that page and status show, below 100 kB, as plain texts.

    Each part is made on its own: one that cannot be made is replaced, and a note states this.

    Args:
        store: state of the graph.
        wall: now (steady clock, s).
    """
    with store.lock:
        return _document(store, wall)


def _document(store: GraphStore, wall: float) -> dict[str, Any]:
    parts, alarms = Parts(), store.alarms
    parts.make("What is overdue", lambda: store.update(wall), None)
    stop = parts.make("What may be done to the pump", lambda: stop_of(store), bare_stop())
    known, incidents = parts.make(
        "Incidents",
        lambda: (store.graph.has_received or not store.ended, _incidents(store)), (False, []),
    )
    rows = parts.make("Alarms", lambda: _alarm_rows(store, incidents), [])
    listed, present = _within(rows, _MOST_ALARMS), [row for row in rows if row["over"] is None]
    shown = {
        name: parts.make(f"The tile of the {name}", partial(make, *given), tiles.unknown(label))
        for name, label, make, *given in (
            ("roof", "Roof level", tiles.roof, store),
            ("cistern", "Cistern level", tiles.cistern, store),
            ("pump", "Pump", tiles.pump, store, present), ("rain", "Rain", tiles.rain, store),
            ("controller", "Controller", tiles.controller, store, present),
        )
    }
    waits = parts.make(
        "What is waited for", lambda: tiles.waiting(store, shown["pump"]["idle"]), ""
    )
    over = sum(row["over"] is not None for row in incidents)
    lasting = len(incidents) - over
    serious, warnings, following = parts.make("Numbers of alarms", alarms.counts, (0, 0, 0))
    serious += lasting
    own = len(present) > lasting
    summary = parts.make("The summary", lambda: {
        "word": "Nothing received yet:" if store.mode == "none"
        else _word(serious, warnings, following, over, known) + _starts(store),
        "sentence": _sentence(store, shown, waits),
        "level": "error" if serious or stop["warning"]
        else "warn" if warnings or store.mode == "none"
        else _level(shown, over=over > 0, known=known),
    }, {"word": "Alarms are unknown.", "sentence": "", "level": "stale"})
    result = {
        "heading": parts.make("The heading", lambda: _heading(store), "Green roof"),
        "mode": store.mode,
        "namespace": store.namespace,
        "time": parts.make(
            "The time", store.clock, {"now": None, "text": words.UNKNOWN, "clock": []},
        ),
        "tiles": {**shown, "summary": summary},
        "advice": parts.make(
            "The advice", lambda: alarms.advice() if own else _advice(store, shown, waits), ""
        ),
        "alarms": listed,
        "alarms_known": known,
        "events": parts.make("Events", lambda: _events(store), []),
        "account": parts.make(
            "The water account", lambda: _account(store),
            {"since_text": "", "sentence": words.UNKNOWN, "rows": []},
        ),
        "stop": stop,
    }
    notes = parts.make(
        "The notes", lambda: _notes(store, known, bool(incidents), len(rows) - len(listed)), []
    )
    if parts.failed:
        result["alarms_known"] = known and "Alarms" not in parts.failed
        if not result["alarms_known"]:
            summary["word"] = "Alarms are unknown."
        if summary["level"] == "ok":
            summary["level"] = "warn"
    return result | {"notes": [*parts.notes, *notes]}


def _incidents(store: GraphStore) -> list[dict[str, Any]]:
    """Return the recorded incidents as rows of alarms."""
    return [
        incident.row(": ".join(filter(None, (trouble.role, trouble.part))), recorded=True)
        for incident in store.incidents() for trouble in (incident.trouble,)
    ]


def _alarm_rows(store: GraphStore, incidents: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return incidents and alarms, those that are over last, with their times in words."""
    rows = sorted([*incidents, *store.alarms.rows()], key=lambda row: row["over"] is not None)
    for row in rows:
        since, over = store.dated(row["since"]), row["over"] and store.dated(row["over"])
        row |= {
            "since": since, "since_text": store.time_of_day(since),
            "since_at_least": row["since_at_least"] or since != row["since"],
            "over": over, "over_text": "" if over is None else store.time_of_day(over),
        }
    return rows


def _events(store: GraphStore) -> list[dict[str, Any]]:
    """Return the events, the newest first, as many as there is room for."""
    dated = [(store.dated(event["at"]), event["what"]) for event in store.alarms.events()]
    return _within([
        {"at": at, "what": what, "at_text": store.time_of_day(at)} for at, what in dated
    ], _MOST_EVENTS)


def _heading(store: GraphStore) -> str:
    heading, factor = _HEADINGS[store.mode], store.factor
    if factor is None or store.mode not in ("simulated", "loop"):
        return heading
    times = words.number(factor, 0 if factor >= 9.95 else 1).removesuffix(".0")
    return f"{heading}, " + ("at real time" if times == "1" else f"{times} times real time")


def _notes(store: GraphStore, known: bool, incidents: bool, hidden: int) -> list[str]:
    notes = [*store.notes]
    if missing := store.alarms.missing:
        listed = [f"{name}: {trouble.what}." for name, trouble in missing.items()]
        notes[:0] = ["The site is starting. Not there yet:", *map(words.plain, listed)]
    if not known:
        notes.append(
            "A recording shows when a drive, a sensor or a node was lost; other alarms are not "
            "recorded." if incidents else "A recording does not tell which alarms there were."
        )
    if hidden:
        notes.append(f"{hidden} more alarms are not shown.")
    weather = store.graph.node("weather")
    if weather is not None and (source := weather.text("forecast_by")):
        notes.append(f"{source[:1].upper()}{source[1:]}.")
    silent = store.silent_s
    if store.mode != "none" and silent and all(newest.stale for newest in store.newest.values()):
        notes.insert(0, f"No values have come for {words.length_of_time(silent)}.")
    return [note for note in notes if note]


# --- the sentence above the tiles -----------------------------------------------------------------


def _word(alarms: int, warnings: int, following: int, over: int, known: bool) -> str:
    """Return how many alarms, warnings and incidents there are."""
    counts = [
        f"{count} {name}" if count == 1 else f"{count} {name}s"
        for count, name in ((alarms, "alarm"), (warnings, "warning"), (over, "incident")) if count
    ]
    if over:
        counts[-1] += ", over" if over == 1 else ", all over"
    none = "No alarms" if known else "Alarms are unknown"
    more = f" ({following} more caused by these)" if following else ""
    return f"{', '.join(counts) or none}{more}."


def _starts(store: GraphStore) -> str:
    return " The site is starting." if store.alarms.missing else ""


def _level(shown: dict[str, Tile], *, over: bool, known: bool) -> str:
    """Return the level without alarms: ``ok``, ``warn``, or ``stale`` if alarms are unknown.

    It is never ``ok`` next to a tile that reports otherwise, even if there is nothing to do.
    """
    attention = (
        over or any(shown[tank]["state"] != "good" for tank in ("roof", "cistern"))
        or shown["pump"]["state"] in ("unknown", "fault", "held")
    )
    return "warn" if attention else "ok" if known else "stale"


def _sentence(store: GraphStore, shown: dict[str, Tile], waits: str) -> str:
    """Return how roof and pump are, and what is expected."""
    if store.mode == "none":
        return "no run or site is found."
    roof, verb = shown["roof"], "was" if store.ended else "is"
    if roof["state"] in ("unknown", "alarm"):
        level_clause = f"The roof's level is {roof['value']}"
        if roof["stale"]:
            level_clause = f"The roof's level is unknown now ({roof['sentence']})"
    else:
        judged = {"low": "too dry, ", "high": "wetter than it should be, "}.get(roof["state"], "")
        level_clause = f"The roof {verb} {judged}{roof['sentence']}"
    clause = f"the pump is {waits}" if waits else _pump_clause(shown["pump"], verb)
    over = "The run has ended." if store.ended else ""
    return " ".join(filter(None, (over, f"{level_clause}; {clause}.", tiles.too_wet(store))))


def _pump_clause(pump: Tile, verb: str) -> str:
    state, why = pump["state"], pump["why"]
    if pump["alarm"]:
        return f"it is unknown whether the pump {verb} stopped"
    if state == "unknown":
        return "it is unknown what the pump does"
    if state in ("running", "starting", "stopping"):
        clause = f"the pump {verb} {state}"
        return f"{clause} at {tiles.flow(pump['number'])}" if pump["number"] else clause
    if state == "fault":
        return f"the pump {'had' if verb == 'was' else 'has'} a fault: {why}"
    if state == "held":
        return f"the pump {verb} held off: {why}"
    return f"the pump {verb} off" + (f", since {why}" if why else "")


def _advice(store: GraphStore, shown: dict[str, Tile], waits: str) -> str:
    """Return what to do if there is no alarm; if something is not as wanted, what happens next."""
    if store.alarms.missing:
        return "Nothing to do: the site is starting. What is still missing is listed below."
    roof, pump = shown["roof"]["state"], shown["pump"]
    runs = pump["state"] in ("starting", "running")
    if store.mode == "none":
        return (
            "Start a run or a site; if one is running, check that this watcher has its "
            "ROS_DOMAIN_ID and --namespace."
        )
    if store.mode == "ended":
        return "The run is over: this is not the present."
    if {shown[name]["state"] for name in ("roof", "cistern", "pump")} & {"unknown", "alarm"}:
        return (
            "Nothing is reported as wrong, but some values are unknown: check whether sensors and "
            "programs run."
        )
    if roof == "high" and runs:
        return "The roof has enough water, and the pump runs: check whether it should."
    if roof == "high":
        return "Nothing to do: the roof will drain and dry."
    if roof != "low" or waits:
        return "Nothing to do."
    if runs:
        return "Nothing to do: the pump waters the roof."
    if pump["idle"]:
        why = tiles.why_not_yet(store) or f"the controller {shown['controller']['sentence']}"
        return f"Nothing to do now: {why}."
    why = f": {pump['why']}" if pump["why"] else ""
    return f"The roof is not watered, since the pump is {pump['state']}{why}."


# --- the water account ----------------------------------------------------------------------------


def _account(store: GraphStore) -> dict[str, Any]:
    account = store.account
    totals = account.totals()
    # Without rain, or such storms, there is no share of it that was kept.
    labels = {
        key: entry.label for key, entry in ENTRIES.items()
        if key in totals or not key.startswith("kept")
    }
    if store.site.mains_level is None:
        del labels["mains"]
    since, sentence = "", "still unknown"
    if account.since is not None:
        since = f"since {words.date_and_time(account.since / 1e9, store.site.zone)}"
        if not account.measured:
            for key in ("drained", "overflow"):
                labels[key] += ", computed from the level"
        gap = words.length_of_time(account.gap_s)
        sentence = f"with gaps of {gap}" if account.gap_s else ""
    return {
        "since_text": since,
        "sentence": sentence,
        "rows": [
            {
                "key": key, "label": label, "number": totals.get(key),
                "value": words.UNKNOWN if key not in totals
                else words.quantity(totals[key], *ENTRIES[key][3:]),
            }
            for key, label in labels.items()
        ],
    }


def _within(rows: list[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """Return the first rows that together have at most this many characters as JSON."""
    lengths = accumulate(len(json.dumps(row)) + 2 for row in rows)
    return [row for row, length in zip(rows, lengths, strict=True) if length <= most]


# --- the charts -----------------------------------------------------------------------------------


def series(store: GraphStore, hours: float) -> dict[str, Any]:
    """Return what the charts show, from some hours ago to 12 h ahead, in SI units.

    A row covers a ``stretch`` (s), which is a share of the time with values: a run that has just
    begun has many rows. A line ends with the newest value, which the tiles show as well. It has a
    gap between two rows that are further apart than its entry in ``gaps`` (s); no value holds for
    longer. It also has a gap from a row of None to the next row.

    Args:
        store: state of the graph.
        hours: how far back, in :data:`HOURS`.
    """
    with store.lock:
        now, site = store.now, store.site
        lines: dict[str, list[list[Any]]] = {name: [] for name in (*LINES, "roof_expected")}
        stretch = 0
        if now is not None:
            newest = max((value.time_ns for value in store.newest.values()), default=0)
            last = max(newest, round(now * 1e9))
            pasts = {
                name: store.newest[topic].past for name, topic in LINES.items()
                if topic in store.newest
            }
            oldest = [past.first_ns for past in pasts.values() if past.first_ns is not None]
            first = max(last - round(hours * 3.6e12), min(oldest, default=last))
            stretch = stretch_of(first, last, _POINTS)
            for name, past in pasts.items():
                lines[name] = past.window(first, last, _POINTS, steps=name not in _LEVELS)
            lines["roof_expected"] = store.expected.window(first, last, _POINTS, steps=False)
        gaps = {name: _gap(rows, stretch) for name, rows in lines.items()}
        lost = Gaps()
        for incident in store.incidents():
            if incident.trouble.hides_pump:
                ended_at = incident.ended_at
                lost.add(incident.since, math.inf if ended_at is None else ended_at)
        lines["flow"] = lost.cut_out(store.unknown_flow.cut_out(lines["flow"]))
        forecast, plan = store.forecast, store.plan
        return {
            "now": now,
            "from": None if now is None else now - hours * 3600,
            "to": None if now is None else now + AHEAD_S,
            "lines": lines,
            "gaps": gaps,
            "stretch": stretch / 1e9,
            "forecast": [] if forecast is None else forecast.rows(),
            "plan": [] if plan is None or now is None else plan.rows(now),
            "marks": {  # m; None if there is none
                "target": site.z_veg, "band": band_of(site), "suction": site.suction_level,
                "low_outlet": site.low_outlet_level, "outlet": site.z_o,
            },
            "display": {name: asdict(words.display_of(topic)) for name, topic in LINES.items()},
        }


def _gap(rows: list[list[Any]], stretch_ns: int) -> float:
    """Return the time between two rows of a line beyond which there is a gap (s).

    It is the account's time, or twice the stretch that a row covers if that is longer. If rows
    usually come less often, there is a gap after as many missing rows as make the value stale:
    samples of a run at full speed may be an hour apart.
    """
    gap = max(HOLDS_NS, 2 * stretch_ns) / 1e9
    usual = float(np.median(np.diff([row[0] for row in rows]))) if len(rows) > 1 else 0.0
    return INTERVALS * usual if usual > gap else gap
