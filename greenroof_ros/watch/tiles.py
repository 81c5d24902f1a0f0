"""The values to read at a glance: roof, cistern, pump, watering, rain, temperature and valve.

Every tile has a ``label``, a ``value`` in words, this value as a ``number``, a ``state`` that rates
the value, and a ``sentence`` with details. A value that is overdue is unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from greenroof_ros.base.text import number_of
from greenroof_ros.base.times import duration
from greenroof_ros.interface.conditions import read_conditions
from greenroof_ros.interface.states import PUMP, PUMP_STATES, VALVE, VALVE_STATES
from greenroof_ros.interface.topics import Display, read_topics
from greenroof_ros.results.sums import NEAR_TARGET
from greenroof_ros.ros.alarms import describe_alarm
from greenroof_ros.ros.reports import NodeReport
from greenroof_ros.watch.store import FLOW, GraphStore, number_in, text_of

_DAY_S, _DAYS = 86_400.0, 7
# What was given is stated after this time (s), when it is not only of the last minutes.
_SEEN_S = 3600.0

_COMMAND, _RAIN = "/pump/command", "/weather/precipitation"
_ROOF, _CISTERN, _FROST = "/roof/level", "/cistern/level", "/weather/frost"
_THERMOMETER, _VALVE = "/gauge/temperature", "/outlet/command"
_POSITION, _OUTLET_FLOW = "/outlet/position", "/outlet/flow"
UNKNOWN = "unknown"


def write_number(value: float, unit: str, decimals: int, factor: float = 1.0) -> str:
    """Write a number with its unit, such as ``45.3 mm``.

    Args:
        value: value in its SI unit.
        unit: unit to show; empty for none.
        decimals: number of decimals to show.
        factor: factor that converts the SI unit to the unit to show.
    """
    text = f"{value * factor:.{decimals}f}"
    text = text.removeprefix("-") if float(text) == 0 else text
    return f"{text} {unit}" if unit else text


def find_display(topic: str) -> Display:
    """Return the format in which the interface shows the values of a topic."""
    display = read_topics()[topic].display
    assert display is not None, topic
    return display


def write_value(topic: str, value: float) -> str:
    """Write a topic's value, or a difference of values, in the interface's format: ``45.3 mm``."""
    display = find_display(topic)
    return write_number(value, display.unit, display.decimals, display.factor)


def write_litres(volume: float) -> str:
    """Write a volume (m3) in litres."""
    return write_number(volume, "L", 0, 1e3)


write_level = partial(write_value, _ROOF)
write_flow = partial(write_value, FLOW)

Tile = dict[str, Any]


def make_tiles(store: GraphStore) -> dict[str, Tile]:
    """Return all tiles, by their keys."""
    pump, valve = _make_pump_tile(store), store.node(VALVE)
    roof = _make_tile(store, "Roof level", _ROOF, _judge_roof)
    if not store.site.irrigated and _ROOF not in store.newest:
        roof |= {"state": "none", "sentence": "not measured"}
    return {
        "roof": roof,
        "cistern": _make_tile(store, "Cistern level", _CISTERN, _judge_cistern),
        "pump": pump,
        **({} if valve is None else {VALVE: _make_valve_tile(store, valve)}),
        "watering": _make_watering_tile(store, pump),
        "rain": _make_tile(store, "Rain", _RAIN, lambda *_: ("good", _write_coming_rain(store))),
        "temperature": _make_temperature_tile(store),
    }


def _join(*parts: str) -> str:
    return "; ".join(filter(None, parts))


def _make_tile(
    store: GraphStore, label: str, topic: str,
    judge: Callable[[GraphStore, float], tuple[str, str]],
    write: Callable[[float], str] | None = None,
) -> Tile:
    """Return the tile for a topic; ``judge`` returns the state and the sentence for a value.

    A missing, stale or impossible value is shown as unknown; for a stale value, the sentence states
    the last value and its time. A value that an alarm is about is shown as doubtful.
    """
    newest, number = store.newest.get(topic), store.present_value(topic)
    write = write or partial(write_value, topic)
    doubt = _find_doubt(store, topic)
    text, state = UNKNOWN, "unknown"
    if newest is None:
        sentence = "no values arrive" if doubt else "no value received yet"
    elif number is not None:
        text, (state, sentence) = write(number), judge(store, number)
        state = "doubtful" if doubt else state
    elif newest.value is None:
        sentence = "" if read_topics()[topic].may_be_unknown else "the value is impossible"
    else:
        sentence = f"{write(newest.value)} at last contact, {store.time_text(newest.time)}"
    return {
        "label": label, "value": text, "number": number, "state": state,
        "sentence": _join(doubt, sentence),
    }


def _find_doubt(store: GraphStore, topic: str) -> str:
    """Return what the node that publishes a topic, or a reader, reports to be wrong with it."""
    senders = read_topics()[topic].senders
    parts = "", "sensor", "gauge", topic.rpartition("/")[2]  # of what publishes this topic
    lacking = {code for code, row in read_conditions().items() if row.no_data or row.device}
    found = [
        alarm for alarm in store.present if topic in alarm.about or (
            alarm.role in senders and alarm.part in parts
            and (alarm.is_serious or alarm.code in lacking)
        )
    ]
    if store.gone_since is not None or not found:
        return ""
    first = min(found, key=lambda alarm: (bool(alarm.follows), alarm.role not in senders))
    return describe_alarm(first)


# --- levels and weather ---------------------------------------------------------------------------


def _judge_roof(store: GraphStore, level: float) -> tuple[str, str]:
    difference = level - store.site.z_veg
    side, state = ("below", "low") if difference < 0 else ("above", "high")
    if abs(difference) <= NEAR_TARGET * store.site.z_veg:
        state = "good"
    text = write_level(abs(difference))
    return state, "at its target" if text == write_level(0.0) else f"{text} {side} its target"


def _judge_cistern(store: GraphStore, level: float) -> tuple[str, str]:
    """Describe what can be pumped and for how long it lasts."""
    site = store.site
    usable = site.cistern_volume(level - site.suction_level)
    if usable <= 0 and site.irrigated:
        return "low", "too low for the pump, since it is not above the suction level"
    if level > site.z_o:
        return "high", "above its overflow, so water is running to the sewer"
    if not site.irrigated:
        return "good", f"{write_number(site.cistern_volume(level), 'm³', 1)} of water"
    text = f"{write_number(usable, 'm³', 1)} above the suction level can be pumped"
    now, first = store.now, store.flow_since
    days = 0 if first is None else min(_DAYS, int((now - first) // _DAY_S))
    if days > 0 and (given := store.given_since(now - days * _DAY_S)):
        left = number_of(round(usable * days / given), "day")
        text += f", enough for {left} at the use of the past {number_of(days, 'day')}"
    if store.mode != "live" and (share := store.present_value(_VALVE)) is not None:
        text += f"; the outlet valve is {write_value(_VALVE, share)} open"
    return "good", text


def _make_temperature_tile(store: GraphStore) -> Tile:
    """Return the tile of the temperature, or of frost if there is no thermometer."""
    frost = store.present_value(_FROST)
    state, stops = ("cold", "the pump stays off until it is above 0 °C") if frost else ("good", "")
    reporting = {part for node in store.nodes.values() for part in (node.role, *node.parts)}
    measured = _THERMOMETER in store.newest or "thermometer" in reporting
    source = "measured" if measured else "according to the forecast" if store.forecast else ""
    return _make_tile(
        store, "Temperature", _THERMOMETER if measured else _FROST,
        lambda *_: (state, _join(source, stops)),
        None if measured else lambda frost: "0 °C or below" if frost else "above 0 °C",
    )


def _write_coming_rain(store: GraphStore) -> str:
    """Write forecast rain: ``32.0 mm expected in the next 12 h``."""
    forecast, now = store.forecast, store.now
    if forecast is None:
        return "no forecast received"
    if (reach := forecast.reach(now)) <= 0:
        return "the forecast has ended"
    rain = float((forecast.values @ forecast.lengths(now)).mean())
    return f"{write_number(rain, 'mm', 1, 1e3)} expected in the next {duration(round(reach))}"


# --- the pump -------------------------------------------------------------------------------------


def _make_pump_tile(store: GraphStore) -> Tile:
    """Return the tile of the pump: its state and flow, and why it is in this state.

    The state is ``alarm`` if the pump might be turning unnoticed.
    """
    node, values = store.pump, store.pump_values
    state, why = _read_pump_state(store)
    lost = node is not None and store.mode != "ended" and not node.is_online(store.steady)
    at_rest = values.get("at_rest")
    no_speed = values.get("speed", 0.0) is None  # some nodes never report a speed
    may_turn = store.runs_on or (lost and at_rest is False) or (no_speed and at_rest is not True)
    number = None if no_speed and not may_turn else store.present_value(FLOW)
    if may_turn and not number:
        number = None  # no flow is no news of a pump that may be turning
    kept_off = any(alarm.role == PUMP and alarm.part == PUMP for alarm in store.present)
    if state == "held" and not kept_off and not values.get("hold"):  # as intended
        state = "off"
    value = state
    if may_turn:
        value, state, why = "may be running", "alarm", "it is unknown whether the pump is stopped"
    elif lost:
        value, state, why = UNKNOWN, UNKNOWN, _join(f"{state} at last contact", why)
    return {
        "label": "Pump", "value": value, "number": number, "state": state,
        "sentence": _join("" if number is None else write_flow(number), why),
    }


def _read_pump_state(store: GraphStore) -> tuple[str, str]:
    """Return the pump's state and the reason; in a simulation, derive both if not reported."""
    values = store.pump_values
    if not store.site.irrigated:
        return "off", "the site has no pump"
    if state := text_of(values, "pump_state"):
        # Of a hold, the page states more, and in the site's time.
        hold = values.get("hold")
        told = text_of(hold, "sentence") if isinstance(hold, dict) else ""
        why = text_of(values, "pump_why").removeprefix(told).lstrip("; ")
        return state if state in PUMP_STATES else UNKNOWN, why
    if store.mode == "live":
        return UNKNOWN, "no pump node, or more than one, is responding"
    flow = store.newest.get(FLOW)
    if flow is None or flow.value is None:
        return UNKNOWN, ""
    return "off" if write_flow(flow.value) == write_flow(0.0) else "running", ""


# --- watering -------------------------------------------------------------------------------------


def _make_watering_tile(store: GraphStore, pump: Tile) -> Tile:
    """Return the tile of when the roof is watered next, and of how much water it was given.

    Args:
        store: state of the graph.
        pump: tile of the pump, which may be kept off although the controller commands a flow.
    """
    share, plan, now = store.present_value(_COMMAND), store.plan, store.now
    pumped = None if plan is None else plan.pumped(now)
    value, state, sentence = "not now", "good", ""
    if share is None and store.site.irrigated:
        value, state, sentence = UNKNOWN, "unknown", "the controller's command is unknown"
    elif share:
        value = "now"
        if pump["state"] not in ("running", "starting"):
            value, state, sentence = "wanted", "held", f"pump: {pump['value']}"
    elif pumped is not None:
        value = f"from {store.time_text(pumped[1])}"
    elif plan is not None:
        value = f"not in the next {duration(round(plan.reach(now)))}"
        sentence = "no pumping is planned"
    planned = "" if pumped is None or share is None else (
        f"{write_litres(pumped[0])} up to {write_level(pumped[2])} planned"
    )
    return {
        "label": "Watering", "value": value, "number": share, "state": state,
        "sentence": _join(sentence, planned, _write_given(store)),
    }


def _write_given(store: GraphStore) -> str:
    """Write how much water the roof was given today and in a week, as far as it is known."""
    now, first = store.now, store.flow_since
    if first is None or now - first < _SEEN_S:
        return ""
    midnight = store.local(now).replace(hour=0, minute=0, second=0, microsecond=0).timestamp()
    today, week = (
        write_litres(store.given_since(begin)) for begin in (midnight, now - _DAYS * _DAY_S)
    )
    since = f" (seen since {store.time_text(first)})" if first > now - _DAYS * _DAY_S else ""
    return f"given: {today} today, {week} in the past {_DAYS} days{since}"


# --- the outlet valve -----------------------------------------------------------------------------


def _make_valve_tile(store: GraphStore, node: NodeReport) -> Tile:
    """Return the tile of the valve: command and position, which are two values, and the reason.

    The state is ``alarm`` if the valve might be open unnoticed.
    """
    values, lost = node.values, store.mode != "ended" and not node.is_online(store.steady)
    reported, why = text_of(values, "valve_state"), text_of(values, "valve_why")
    position, flow, until = (
        number_in(values, key) for key in ("position", "flow", "open_until")
    )
    value = state = reported if reported in VALVE_STATES else UNKNOWN
    where = "position unknown"
    if position is not None:
        where = f"position {write_value(_POSITION, position)} by its end switches"
    elif store.node("open_switch") is None:
        where += ": no end switches"
    told = [
        f"commanded {'open' if values.get('commanded') else 'closed'}", where,
        "" if flow is None else write_value(_OUTLET_FLOW, flow),
        "" if until is None else f"requested to be open until {store.time_text(until)}",
    ]
    if lost:
        value = state = UNKNOWN
        position, told = None, [f"{reported} at last contact"]
    if values.get("at_rest") is False and (lost or values.get("speed", 0.0) is None):
        value, state = "may be open", "alarm"
    return {
        "label": "Outlet valve", "value": value, "number": position, "state": state,
        "sentence": _join(*told, why),
    }
