"""The five values to read at a glance: roof, cistern, pump, rain, and when it is watered next.

Every tile has a ``label``, a ``value`` in words, this value as a ``number``, a ``state`` that rates
the value, and a ``sentence`` with details. The flag ``stale`` states whether the value is overdue
and therefore unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from greenroof_ros.interface.alarm import WARN
from greenroof_ros.interface.states import PUMP, PumpState
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import running_flow
from greenroof_ros.results.sums import NEAR_TARGET
from greenroof_ros.ros.alarms import find_publishers
from greenroof_ros.site.site import Site
from greenroof_ros.watch import words
from greenroof_ros.watch.outlook import Plan, RainAmount
from greenroof_ros.watch.store import GraphStore

# Most controllers look hours ahead; a shorter forecast (s) contains nothing about the rain to come.
SOON_S = 600.0
# Weather services renew their forecasts hourly, from model runs that are made every 6 h; an older
# forecast (s) has missed such a run.
_RENEWED_S, OLD_S = 3600.0, 6 * 3600.0

_FLOW, _COMMAND, _RAIN = "/pump/flow", "/pump/command", "/weather/precipitation"
_ROOF, _CISTERN, _FROST = "/roof/level", "/cistern/level", "/weather/frost"
_GAUGE, _FILL_TO, _VALVE = "/gauge/precipitation", "/controller/fill_to", "/outlet/command"
write_level = partial(words.write_value, _ROOF)
write_flow = partial(words.write_value, _FLOW)

# In place of a value that was never received: it may come, or its absence is reported as a fault.
_NOT_YET, _NONE_NOW = "no value received yet", "no values arrive"

Tile = dict[str, Any]


def _make_tile(
    store: GraphStore, label: str, topic: str, judged: Callable[[float], tuple[str, str]],
) -> Tile:
    """Return the tile for a topic; ``judged`` returns the state and the sentence for a value.

    A missing or stale value is shown as unknown; for a stale value, the sentence states the last
    value and its time, and the reported reason, if any. An implausible value is shown as an alarm.
    """
    newest = store.newest.get(topic)
    number = None if newest is None else newest.value
    stale = newest is not None and newest.stale
    why = _find_reason(store, topic) if newest is None or stale else ""
    if number is not None:
        text, (state, sentence) = words.write_value(topic, number), judged(number)
    elif newest is None:
        text, state, sentence = words.UNKNOWN, "unknown", _NONE_NOW if why else _NOT_YET
    else:
        text, state, sentence = words.NOT_PLAUSIBLE, "alarm", "the sensor's value is impossible"
    if newest is not None and stale:
        sentence = f"{text} at last contact, {store.time_of_day(newest.time_ns / 1e9)}"
        text, number, state = words.UNKNOWN, None, "unknown"
    return {
        "label": label, "value": text, "number": number, "state": state,
        "sentence": "; ".join(filter(None, (sentence, why))), "stale": stale,
    }


def _find_reason(store: GraphStore, topic: str) -> str:
    """Return the reason, reported by its publisher or readers, why a topic has no values.

    The reason is empty if no fault is reported, since the first value may still arrive, and if the
    site's program no longer runs.
    """
    if store.gone_since is not None:
        return ""
    diagnoses = store.judge.diagnoses
    own = {name: found for name, found in diagnoses.items() if found.role and found.level != WARN}
    readers = (
        name for name, found in own.items()
        if topic in found.about and found.code not in ("input_waiting", "values_refused")
    )
    for name in (*find_publishers([topic], "", own), *readers):
        condition, sentence = own[name].condition, words.clean_sentence(own[name].sentence)
        return sentence if condition is None or topic in own[name].about else (
            f"{condition.meaning}: {sentence}"
        )
    return ""


def make_unknown_tile(label: str) -> Tile:
    """Return the replacement for a tile that cannot be generated."""
    return {
        "label": label, "value": words.UNKNOWN, "number": None, "state": "unknown",
        "sentence": "cannot be shown", "stale": True, "why": "", "alarm": False, "idle": False,
    }


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
    """Return the tile of the cistern's level."""
    site = store.site

    def judged(level: float) -> tuple[str, str]:
        usable = site.cistern_volume(level - site.suction_level)
        if usable <= 0:
            return "low", "too low for the pump, since it is not above the suction level"
        if level > site.z_o:
            return "high", "above its overflow, so water is running to the sewer"
        usable_text = words.write_quantity(usable, "m³", 1)
        text = f"{usable_text} above the suction level can be pumped"
        if site.low_outlet_valve:
            share = store.present_value(_VALVE)
            return "good", text + _write_opened(share)
        drains = "; the low outlet is draining the cistern" if level > site.min_outlet_level else ""
        return "good", text + drains

    return _make_tile(store, "Cistern level", _CISTERN, judged)


def _write_opened(share: float | None) -> str:
    """Write the opening of the outlet valve as a clause that begins with a semicolon."""
    if share is None:
        return "; the command to the outlet valve is unknown"
    if not share:
        return "; the outlet valve is closed"
    return f"; the outlet valve is {words.write_value(_VALVE, share)} open"


def make_pump_tile(store: GraphStore) -> Tile:
    """Return the tile of the pump: its state, flow and command, and why it is in this state.

    ``alarm`` states whether the pump might be turning unnoticed, ``idle`` whether the pump is off
    only because the controller commands a flow of 0, and ``why`` repeats the reason.
    """
    node, report = store.pump, store.pump_report
    values = {} if node is None else node.values
    is_silent, flow_known = store.is_lost(node), store.flow_known
    may_turn = node is not None and (
        node.may_turn or (is_silent and values.get("stands") is False)
    )
    speed_known = values.get("speed", 0.0) is not None  # even if its node never reports a speed
    pumped = store.newest.get(_FLOW) if flow_known and (speed_known or may_turn) else None
    state, why = _read_pump_state(store, report)
    old = pumped is not None and pumped.stale
    # The node reports its state in a different way from the flow.
    stale = not may_turn and (is_silent or (old and report is None))
    parts = []
    if stale and state != "unknown":
        parts.append(f"{state} at last contact")
    if may_turn and not (node is not None and node.runs_on):
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
    runs = state in ("running", "starting") and not stale and not may_turn
    parts += filter(None, (
        _write_command(store) if runs else "", "" if may_turn and is_silent else why,
    ))
    if not parts and state == "unknown":
        parts.append(_NOT_YET)
    name = "" if node is None else node.name
    kept_off = store.present_value(_FROST) or f"{name}: {PUMP}" in store.judge.present
    quiet = state == "held" and node is not None and node.code_of(PUMP) == "quiet_hours"
    state = "unknown" if stale or may_turn else "off" if quiet else state  # as intended
    return {
        "label": "Pump", "value": "may be running" if may_turn else state,
        "number": None if pumped is None or old else pumped.value,
        "state": "alarm" if may_turn else state, "alarm": may_turn,
        "idle": state == "off" and not kept_off and not quiet
        and store.present_value(_COMMAND) == 0,
        "sentence": "; ".join(parts), "why": "" if may_turn else why, "stale": stale,
    }


def write_pump(value: str) -> str:
    """Write the value of the pump's tile as a clause: ``the pump is held off``."""
    if value in ("may be running", "unknown"):
        return f"the pump {value}" if value != "unknown" else "the state of the pump is unknown"
    named = {"fault": "has a fault", "held": "is held off"}
    return f"the pump {named.get(value, f'is {value}')}"


def _write_command(store: GraphStore) -> str:
    """Write the command that a pump follows; empty if it is 0 or old."""
    command = store.newest.get(_COMMAND)
    if command is None or command.stale or command.value == 0:
        return ""
    if command.value is None:
        return f"the command is {words.NOT_PLAUSIBLE}"
    return f"commanded {words.write_command(command.value)} of its maximum flow"


def _read_pump_state(store: GraphStore, report: PumpState | None) -> tuple[str, str]:
    """Return the pump's state and the reason; in a simulation, derive both if not reported."""
    if report is not None:
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


def _is_quiet(store: GraphStore) -> bool:
    hours, now = store.site.quiet, store.now
    return hours is not None and now is not None and hours.quiet_at(int(now * 1e9))


def make_rain_tile(store: GraphStore) -> Tile:
    """Return the tile of the rain, with the current and the forecast rain."""
    topic = _GAUGE if store.newest.get(_RAIN) is None else _RAIN
    return _make_tile(store, "Rain", topic, lambda _: ("good", _write_coming_rain(store)))


def _write_coming_rain(store: GraphStore) -> str:
    forecast, now = store.forecast, store.now
    if forecast is None or now is None:
        return "no forecast received"
    # The age of a forecast counts from its issue, if known; it is too old only if it is no longer
    # published.
    made_at = forecast.at if forecast.issued is None else forecast.issued
    age, made = now - made_at, store.hour(made_at)
    amount = forecast.amount(now)
    if amount is None:
        return f"no current forecast: the forecast from {made} has ended"
    reach = words.write_horizon(amount.reach_s)
    if amount.reach_s < SOON_S:
        return f"no forecast for the next few hours: the controller looks only {reach} ahead"
    if now - forecast.at > OLD_S:
        return f"the latest forecast, from {made}, is too old"
    sentence = f"{words.write_rain(amount.mean)} expected in the next {reach}{_write_range(amount)}"
    return sentence if age <= _RENEWED_S else f"{sentence}, according to the forecast from {made}"


def _write_range(amount: RainAmount) -> str:
    """Write the range of an ensemble's rain, as in `` (19 to 46)``; empty for a single forecast."""
    if amount.members == 1:
        return ""
    low, high = (words.write_rain(rain).split()[0] for rain in (amount.low, amount.high))
    return f" ({low} to {high})"


def make_watering_tile(store: GraphStore, pump: Tile) -> Tile:
    """Return the tile of what the controller intends: when it waters next, and how much.

    Args:
        store: state of the graph.
        pump: tile of the pump, which may be kept off although the controller commands a flow.
    """
    node, command = store.graph.node("controller"), store.newest.get(_COMMAND)
    share, aim = store.present_value(_COMMAND), store.present_value(_FILL_TO)
    gone, now = store.gone_since is not None, store.now
    plan = None if gone else store.plan
    fault = next((
        alarm.sentence for alarm in store.judge.present.values()
        if node is not None and alarm.node == node.name and alarm.is_serious and not gone
    ), "")
    if fault:
        value, sentence = "alarm", fault
    elif share is None and plan is None:
        value = words.UNKNOWN
        sentence = "no controller found" if node is None and command is None else (
            "the controller's command is unknown"
        )
    elif plan is not None and now is not None:
        value, sentence = _write_plan(store, plan, now)
    else:
        value = "now" if share else "not now"
        sentence = f"{words.write_command(share)} of the pump's maximum flow" if share else ""
    if share and not fault:
        runs = pump["state"] in ("running", "starting")
        value, kept = ("now", "") if runs else ("wanted", write_pump(pump["value"]))
        aims = "" if aim is None else f"up to {words.write_value(_FILL_TO, aim)} now"
        sentence = "; ".join(filter(None, (kept, aims, sentence)))
    known = value not in ("alarm", words.UNKNOWN) and share is not None
    return {
        "label": "Watering", "value": value, "number": None,
        "state": "alarm" if fault else "held" if value == "wanted" else "good" if known
        else "unknown", "sentence": sentence,
        "stale": command is not None and command.stale,
    }


def _has_forecast(store: GraphStore) -> bool:
    """Return whether a sufficiently recent forecast covers the current time."""
    forecast, now = store.forecast, store.now
    return (
        forecast is not None and now is not None and forecast.amount(now) is not None
        and now - forecast.at <= OLD_S
    )


def _write_plan(store: GraphStore, plan: Plan, now: float) -> tuple[str, str]:
    """Return when the pump runs next according to the plan, and the plan in words."""
    right = " if the forecast is right" if _has_forecast(store) else ""
    if now >= plan.ends[-1]:
        return words.UNKNOWN, "the controller has reached the end of its plan"
    pumped = plan.pumped(now)
    reach = words.write_horizon(min(12 * 3600.0, float(plan.ends[-1]) - now))
    if pumped is None:
        return f"not in the next {reach}", f"no pumping is planned{right}"
    return "now" if pumped.begin <= now else f"from {store.hour(pumped.begin)}", (
        f"{words.write_quantity(pumped.volume, 'm³', 2)} in the next {reach}, up to "
        f"{write_level(pumped.level)}{right}"
    )


def describe_wait(store: GraphStore, idle: bool) -> str:
    """Describe the rain that the controller is waiting for; empty if it is not waiting.

    The controller is waiting if the roof is too dry, only the controller keeps the pump off, and
    if, before the controller plans to pump, at least as much rain is forecast as the roof lacks.

    Args:
        store: state of the graph.
        idle: whether only the controller keeps the pump off.
    """
    site, now, forecast = store.site, store.now, store.forecast
    level = store.present_value(_ROOF)
    if (
        now is None or forecast is None or level is None
        or not idle or _is_quiet(store) or level >= find_band(site)[0] or now - forecast.at > OLD_S
    ):
        return ""
    amount, plan = forecast.amount(now), store.plan
    if amount is None or amount.reach_s < SOON_S or amount.mean < site.z_veg - level:
        return ""
    pumped = None if plan is None or now >= plan.ends[-1] else plan.pumped(now)
    if pumped is not None and pumped.begin < amount.fallen_at:
        return ""
    by = store.hour(-(-amount.fallen_at // 3600) * 3600)
    return f"waiting for rain: {words.write_rain(amount.mean)}{_write_range(amount)} by {by}"
