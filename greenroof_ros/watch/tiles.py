"""The values to read at a glance: roof, cistern, pump, watering, rain and temperature.

Every tile has a ``label``, a ``value`` in words, this value as a ``number``, a ``state`` that rates
the value, and a ``sentence`` with details. The flag ``stale`` states whether the value is overdue
and therefore unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from greenroof_ros.base.text import number_of
from greenroof_ros.interface.alarm import Alarm
from greenroof_ros.interface.states import PUMP
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import running_flow
from greenroof_ros.results.sums import NEAR_TARGET
from greenroof_ros.site.site import Site
from greenroof_ros.watch import words
from greenroof_ros.watch.outlook import RainAmount
from greenroof_ros.watch.store import GraphStore

# Most controllers look hours ahead; a shorter forecast (s) contains nothing about the rain to come.
SOON_S = 600.0
# Weather services renew their forecasts hourly, from model runs that are made every 6 h; an older
# forecast (s) has missed such a run.
_RENEWED_S, OLD_S = 3600.0, 6 * 3600.0

_DAY_S, _WEEK_S = 86_400.0, 7 * 86_400.0

_FLOW, _COMMAND, _RAIN = "/pump/flow", "/pump/command", "/weather/precipitation"
_ROOF, _CISTERN, _FROST = "/roof/level", "/cistern/level", "/weather/frost"
_GAUGE, _THERMOMETER = "/gauge/precipitation", "/gauge/temperature"
_FILL_TO, _VALVE = "/controller/fill_to", "/outlet/command"
write_level = partial(words.write_value, _ROOF)
write_flow = partial(words.write_value, _FLOW)

# In place of a value that was never received: it may come, or its absence is reported as a fault.
_NOT_YET, _NONE_NOW = "no value received yet", "no values arrive"
# What a reader reports while it waits for a value, and when it has left out a single one.
_NO_DOUBT = "input_waiting", "values_refused"

Tile = dict[str, Any]


def _make_tile(
    store: GraphStore, label: str, topic: str, judged: Callable[[float], tuple[str, str]],
) -> Tile:
    """Return the tile for a topic; ``judged`` returns the state and the sentence for a value.

    A missing or stale value is shown as unknown; for a stale value, the sentence states the last
    value and its time. A value that an alarm is about is shown as doubtful, and an implausible one
    as an alarm.
    """
    newest = store.newest.get(topic)
    number, stale = None if newest is None else newest.value, store.is_stale(topic)
    doubt = _find_doubt(store, topic, newest is None or stale)
    if newest is None:
        text, state, sentence = words.UNKNOWN, "unknown", _NONE_NOW if doubt else _NOT_YET
    elif number is None and read_topics()[topic].may_be_unknown:
        text, state, sentence = words.UNKNOWN, "unknown", ""
    elif number is None:
        text, state, sentence = words.NOT_PLAUSIBLE, "alarm", "the sensor's value is impossible"
    else:
        text, (state, sentence) = words.write_value(topic, number), judged(number)
        state = "doubtful" if doubt else state
    if newest is not None and stale:
        sentence = f"{text} at last contact, {store.time_of_day(newest.time_ns / 1e9)}"
        text, number, state = words.UNKNOWN, None, "unknown"
    return {
        "label": label, "value": text, "number": number, "state": state, "stale": stale,
        "sentence": "; ".join(filter(None, (doubt, sentence))),
    }


def _find_doubt(store: GraphStore, topic: str, missing: bool) -> str:
    """Return what is reported to be wrong with a topic's values; empty if nothing is.

    Args:
        store: state of the graph.
        topic: name of the topic in the interface.
        missing: whether there are no values, so that any alarm of their publisher explains it.
    """
    entry = read_topics()[topic]
    publishers = {*entry.publishers, *entry.live_publishers} if missing else ()

    def explains(alarm: Alarm) -> bool:
        about = topic in alarm.about and alarm.code not in _NO_DOUBT
        return about or alarm.role in publishers

    found = [alarm for alarm in store.present if alarm.is_serious and explains(alarm)]
    found.sort(key=lambda alarm: (bool(alarm.follows), alarm.role not in publishers))
    if store.gone_since is not None or not found:
        return ""
    return f"{words.name_source(found[0].name, found[0].role)}: {found[0].sentence}"


def make_unknown_tile(label: str) -> Tile:
    """Return the replacement for a tile that cannot be generated."""
    return {
        "label": label, "value": words.UNKNOWN, "number": None, "state": "unknown",
        "sentence": "cannot be shown", "stale": True, "why": "", "alarm": False, "idle": False,
    }


# --- levels and weather ---------------------------------------------------------------------------


def find_band(site: Site) -> list[float]:
    """Return the lowest and the highest level at which the roof is near its target (m)."""
    return [site.z_veg * (1 - NEAR_TARGET), site.z_veg * (1 + NEAR_TARGET)]


def make_roof_tile(store: GraphStore) -> Tile:
    """Return the tile of the roof's level."""
    site = store.site
    full, (low, high) = site.roof_level(site.z_cap), find_band(site)

    def judged(level: float) -> tuple[str, str]:
        state = "low" if level < low else "high" if level > high else "good"
        drains = "; the soil is full, and water is draining off" if level >= full else ""
        return state, _write_difference(level - site.z_veg) + drains

    return _make_tile(store, "Roof level", _ROOF, judged)


def _write_difference(difference: float) -> str:
    """Format the deviation of the roof's level from its target: ``0.4 mm below its target``."""
    text = write_level(abs(difference))
    if text == write_level(0.0):
        return "at its target"
    return f"{text} {'below' if difference < 0 else 'above'} its target"


def make_cistern_tile(store: GraphStore) -> Tile:
    """Return the tile of the cistern's level, with what can be pumped and for how long it lasts."""
    site = store.site

    def judged(level: float) -> tuple[str, str]:
        usable = site.cistern_volume(level - site.suction_level)
        if usable <= 0:
            return "low", "too low for the pump, since it is not above the suction level"
        if level > site.z_o:
            return "high", "above its overflow, so water is running to the sewer"
        text = f"{words.write_quantity(usable, 'm³', 1)} above the suction level can be pumped"
        now = store.now or 0.0
        known = ((days, store.given_since(now - days * _DAY_S)) for days in range(7, 0, -1))
        days, given = next(((days, given) for days, given in known if given), (0, 0.0))
        if given:
            left = number_of(round(usable * days / given), "day")
            text += f", enough for {left} at the use of the past {number_of(days, 'day')}"
        if site.low_outlet_valve:
            share = store.present_value(_VALVE)
            if share is None:
                return "good", f"{text}; the command to the outlet valve is unknown"
            opened = f"{words.write_value(_VALVE, share)} open" if share else "closed"
            return "good", f"{text}; the outlet valve is {opened}"
        drains = "; the low outlet is draining the cistern" if level > site.min_outlet_level else ""
        return "good", text + drains

    return _make_tile(store, "Cistern level", _CISTERN, judged)


def make_rain_tile(store: GraphStore) -> Tile:
    """Return the tile of the rain, with the current and the forecast rain."""
    topic = _GAUGE if store.newest.get(_RAIN) is None else _RAIN
    return _make_tile(store, "Rain", topic, lambda _: ("good", _write_coming_rain(store)))


def make_temperature_tile(store: GraphStore) -> Tile:
    """Return the tile of the temperature, or of frost if there is no thermometer."""
    frost = store.present_value(_FROST)
    measured = _THERMOMETER in store.newest
    source = "measured" if measured else "according to the forecast" if store.mode == "live" else ""
    stops = "the pump stays off until it is above 0 °C" if frost else ""
    tile = _make_tile(store, "Temperature", _THERMOMETER if measured else _FROST, lambda _: (
        "cold" if frost else "good", "; ".join(filter(None, (source, stops)))
    ))
    if measured:
        return tile
    if tile["number"] is not None:
        tile["value"] = "0 °C or below" if frost else "above 0 °C"
    elif tile["stale"]:
        doubt = _find_doubt(store, _FROST, True)
        tile["sentence"] = "; ".join(filter(None, (doubt, _NONE_NOW)))
    return tile


def _write_coming_rain(store: GraphStore) -> str:
    forecast, now = store.forecast, store.now
    if forecast is None or now is None:
        return "no forecast received"
    made, amount = store.hour(forecast.issued), forecast.amount(now)
    if amount is None:
        return f"no current forecast: the forecast from {made} has ended"
    reach = words.write_horizon(amount.reach_s)
    if amount.reach_s < SOON_S:
        return "no forecast for the next few hours"
    # It is too old only if it is no longer published.
    if now - forecast.at > OLD_S:
        return f"the latest forecast, from {made}, is too old"
    sentence = f"{_write_rain(amount)} expected in the next {reach}"
    recent = now - forecast.issued <= _RENEWED_S
    return sentence if recent else f"{sentence}, according to the forecast from {made}"


def _write_rain(amount: RainAmount) -> str:
    """Write forecast rain: ``32 mm``, or ``32 mm (19 to 46)`` for an ensemble."""
    text = words.write_rain(amount.mean)
    if amount.members == 1:
        return text
    low, high = (words.write_rain(rain).split()[0] for rain in (amount.low, amount.high))
    return f"{text} ({low} to {high})"


# --- the pump -------------------------------------------------------------------------------------


def make_pump_tile(store: GraphStore) -> Tile:
    """Return the tile of the pump: its state and flow, and why it is in this state.

    ``alarm`` states whether the pump might be turning unnoticed, ``idle`` whether the pump is off
    only because the controller commands a flow of 0, and ``why`` repeats the reason.
    """
    node, state, why = store.pump, *_read_pump_state(store)
    values = {} if node is None else node.values
    is_silent, flow_known = store.is_lost(node), store.flow_known
    speed_known = values.get("speed", 0.0) is not None  # even if its node never reports a speed
    may_turn = runs_on(store) or (not speed_known and values.get("at_rest") is not True) or (
        is_silent and values.get("at_rest") is False
    )
    pumped = store.newest.get(_FLOW) if flow_known and (speed_known or may_turn) else None
    old = pumped is not None and store.is_stale(_FLOW)
    # The node reports its state in a different way from the flow.
    stale = not may_turn and (is_silent or (old and store.pump_report is None))
    parts = []
    if stale and state != "unknown":
        parts.append(f"{state} at last contact")
    if may_turn and not runs_on(store):
        parts.append("it is unknown whether the pump is stopped")
    elif not speed_known and not may_turn:
        parts.append(
            "the drive is not responding: stopped at last contact, or by the drive's timeout"
        )
    if pumped is not None:
        text = words.NOT_PLAUSIBLE if pumped.value is None else write_flow(pumped.value)
        parts.append(f"last known {text}" if old else text)
    elif not flow_known and not may_turn:
        parts.append("the flow is unknown")
    parts.append("" if may_turn else why)
    kept_off = any(alarm.role == PUMP and alarm.part == PUMP for alarm in store.present)
    quiet = state == "held" and not kept_off and not values.get("hold")  # as intended
    state = "unknown" if stale or may_turn else "off" if quiet else state
    sentence = "; ".join(filter(None, parts))
    return {
        "label": "Pump", "value": "may be running" if may_turn else state,
        "number": None if pumped is None or old else pumped.value,
        "state": "alarm" if may_turn else state, "alarm": may_turn, "stale": stale,
        "idle": state == "off" and not (quiet or kept_off or store.present_value(_FROST))
        and store.present_value(_COMMAND) == 0,
        "why": "" if may_turn else why,
        "sentence": sentence or (_NOT_YET if state == "unknown" else ""),
    }


def runs_on(store: GraphStore) -> bool:
    """Return whether the pump turns or delivers water although it is off."""
    return any(alarm.role == PUMP and alarm.code == "runs_on" for alarm in store.present)


def write_pump(value: str) -> str:
    """Write the value of the pump's tile as a clause: ``the pump is held off``."""
    if value in ("may be running", "unknown"):
        return f"the pump {value}" if value != "unknown" else "the state of the pump is unknown"
    named = {"fault": "has a fault", "held": "is held off"}
    return f"the pump {named.get(value, f'is {value}')}"


def _read_pump_state(store: GraphStore) -> tuple[str, str]:
    """Return the pump's state and the reason; in a simulation, derive both if not reported."""
    if (report := store.pump_report) is not None:
        return report.state, report.why
    if store.mode == "live":
        return "unknown", "the pump node is not responding"
    pumped, share = (
        None if newest is None else newest.value
        for newest in (store.newest.get(_FLOW), store.newest.get(_COMMAND))
    )
    if pumped is None:
        return "unknown", ""
    if (share and pumped > 0) or pumped > running_flow(plant_parameters(store.site)):
        return "running", ""
    return "off", "nothing is commanded" if share == 0 else ""


# --- watering -------------------------------------------------------------------------------------


def make_watering_tile(store: GraphStore, pump: Tile) -> Tile:
    """Return the tile of when the roof is watered next, and of how much water it was given.

    Args:
        store: state of the graph.
        pump: tile of the pump, which may be kept off although the controller commands a flow.
    """
    share, aim = store.present_value(_COMMAND), store.present_value(_FILL_TO)
    plan, now = store.plan, store.now
    if share is None:
        value, sentence = words.UNKNOWN, "the controller's command is unknown"
    elif plan is None or now is None:
        value, sentence = "now" if share else "not now", ""
    elif now >= plan.ends[-1]:
        value, sentence = words.UNKNOWN, "the controller has reached the end of its plan"
    elif (pumped := plan.pumped(now)) is None:
        reach = words.write_horizon(min(12 * 3600.0, float(plan.ends[-1]) - now))
        value, sentence = f"not in the next {reach}", "no pumping is planned"
    else:
        value = "now" if pumped.begin <= now else f"from {store.hour(pumped.begin)}"
        sentence = f"{words.write_litres(pumped.volume)} up to {write_level(pumped.level)} planned"
    if share:
        runs = pump["state"] in ("running", "starting")
        value, kept = ("now", "") if runs else ("wanted", write_pump(pump["value"]))
        aims = "" if aim is None else f"up to {words.write_value(_FILL_TO, aim)} now"
        sentence = "; ".join(filter(None, (kept, aims, sentence)))
    return {
        "label": "Watering", "value": value, "number": None,
        "state": "held" if value == "wanted" else "unknown" if value == words.UNKNOWN else "good",
        "sentence": "; ".join(filter(None, (sentence, _write_given(store)))),
        "stale": store.is_stale(_COMMAND),
    }


def _write_given(store: GraphStore) -> str:
    """Write how much water the roof was given, for as long as it is known."""
    now, first = store.now, store.past["flow"].first_ns
    if now is None or first is None or now - first / 1e9 < _RENEWED_S:
        return ""
    today, week = store.given_today(), store.given_since(now - _WEEK_S)
    parts = [
        f"{words.write_litres(volume)} {when}"
        for volume, when in ((today, "today"), (week, "in the past 7 days")) if volume is not None
    ]
    volume, since = store.given_since(first / 1e9) or 0.0, store.time_of_day(first / 1e9)
    return f"given: {', '.join(parts) or f'{words.write_litres(volume)} since {since}'}"


def describe_wait(store: GraphStore, pump: Tile) -> str:
    """Describe the rain that the controller is waiting for; empty if it is not waiting.

    The controller is waiting if the roof is too dry, only the controller keeps the pump off, no
    pumping is planned, and at least as much rain is forecast as the roof lacks.
    """
    site, now, forecast, plan = store.site, store.now, store.forecast, store.plan
    level = store.present_value(_ROOF)
    if now is None or forecast is None or level is None or not pump["idle"]:
        return ""
    amount = forecast.amount(now)
    if (
        level >= find_band(site)[0] or now - forecast.at > OLD_S or amount is None
        or amount.reach_s < SOON_S or amount.mean < site.z_veg - level
        or (plan is not None and now < plan.ends[-1] and plan.pumped(now) is not None)
    ):
        return ""
    reach = words.write_horizon(amount.reach_s)
    return f"waiting for rain: {_write_rain(amount)} expected in the next {reach}"
