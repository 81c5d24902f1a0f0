"""The five things to see at a glance, and the sentence above them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from greenroof_ros.model.metrics import NEAR_TARGET
from greenroof_ros.model.site import Site
from greenroof_ros.watch import words
from greenroof_ros.watch.outlook import Amount, Forecast, Plan

PUMP_STATES = ("off", "starting", "running", "stopping", "held", "fault", "unknown")

# Most controllers look hours ahead; a forecast of less says nothing of the rain to come (s).
_SOON_S = 600.0
# Weather services renew their forecasts hourly, and begin each from a run that comes every 6 h:
# an older one has missed such a run (s).
_RENEWED_S, _OLD_S = 3600.0, 6 * 3600.0

_roof_level = partial(words.value_of, "/roof/level")
_cistern_level = partial(words.value_of, "/cistern/level")
_flow = partial(words.value_of, "/pump/flow")
_rain_rate = partial(words.value_of, "/weather/precipitation")


@dataclass(frozen=True)
class Value:
    """The newest value of a topic.

    Attributes:
        number: in the topic's unit; None where it is not plausible.
        stale: whether it is older than usual, so that it may have changed.
        heard: of one that is, when it was heard last, as a time is written.
    """

    number: float | None
    stale: bool = False
    heard: str = ""


def _known(value: Value | None) -> float | None:
    """Return a value that is of now."""
    return None if value is None or value.stale else value.number


def band_of(site: Site) -> list[float]:
    """Return the levels between which the roof is near its target (m)."""
    return [site.z_veg * (1 - NEAR_TARGET), site.z_veg * (1 + NEAR_TARGET)]


def _tile(
    label: str, value: Value | None, text: str, state: str, sentence: str, **more: Any
) -> dict[str, Any]:
    """Return a tile; one whose value is stale is unknown, and says what was heard last, and when.

    Args:
        label: what it is.
        value: the newest one.
        text: the value in words.
        state: how to judge it.
        sentence: more about it.
        more: of the tile.
    """
    stale = value is not None and value.stale
    if value is not None and stale:
        sentence = f"{text} when last heard at {value.heard}"
    return {
        "label": label, "value": words.UNKNOWN if stale else text, "number": _known(value),
        "state": "unknown" if stale else state, "sentence": sentence, "stale": stale, **more,
    }


def _without_number(label: str, value: Value | None, sentence: str, **more: Any) -> dict[str, Any]:
    """Return the tile of a value that is not there, or is none."""
    if value is None:
        return _tile(label, value, words.UNKNOWN, "unknown", "nothing was heard of it yet", **more)
    return _tile(label, value, words.NOT_PLAUSIBLE, "alarm", sentence, **more)


def roof(value: Value | None, site: Site | None) -> dict[str, Any]:
    """Return the tile of the roof's level."""
    level = None if value is None else value.number
    gauge: dict[str, Any] = {"low": 0.0, "high": None, "marks": [], "band": None}
    if site is not None:
        # The paper's soil is ten times as deep as the water that is wanted; where there is more
        # than twice that, the whole of it is shown.
        full = site.roof_level(site.z_cap)
        deep = level is not None and level > 2 * site.z_veg
        gauge["high"] = max(full, level or 0.0) if deep else 2 * site.z_veg
        gauge["marks"] = [{"at": site.z_veg, "label": f"target {_roof_level(site.z_veg)}"}]
        if full <= gauge["high"]:
            gauge["marks"].append({
                "at": full, "label": f"soil is full at {_roof_level(full)}",
            })
        gauge["band"] = band_of(site)
    if level is None:
        return _without_number("Roof level", value, "its sensor says what cannot be", **gauge)
    if site is None:
        return _tile("Roof level", value, _roof_level(level), "unknown",
                     "what is right for this site is not known", **gauge)
    low, high = band_of(site)
    state = "low" if level < low else "high" if level > high else "good"
    sentence = _versus_target(level - site.z_veg)
    if level >= full:
        sentence += "; the soil is full, and water drains off"
    return _tile("Roof level", value, _roof_level(level), state, sentence, **gauge)


def _versus_target(difference: float) -> str:
    """Write how far the roof's level is from its target (m): ``0.4 mm below its target``."""
    text = _roof_level(abs(difference))
    if text == _roof_level(0.0):
        return "at its target"
    return f"{text} {'below' if difference < 0 else 'above'} its target"


def cistern(value: Value | None, site: Site | None) -> dict[str, Any]:
    """Return the tile of the cistern's level."""
    level = None if value is None else value.number
    gauge: dict[str, Any] = {"low": 0.0, "high": None, "marks": [], "band": None}
    if site is not None:
        gauge["high"] = max(1.1 * site.z_o, level or 0.0)
        gauge["marks"] = [
            {"at": at, "label": f"{name} {_cistern_level(at)}"}
            for name, at in (
                ("suction level", site.suction_level), ("low outlet", site.low_outlet_level),
                ("outlet", site.z_o),
            ) if at is not None
        ]
        gauge["band"] = [site.suction_level, site.z_o]
    if level is None:
        return _without_number("Cistern level", value, "its sensor says what cannot be", **gauge)
    if site is None:
        return _tile("Cistern level", value, _cistern_level(level), "unknown",
                     "what is right for this site is not known", **gauge)
    usable = site.cistern_volume(level - site.suction_level)
    if usable <= 0:
        state, sentence = "low", "too low for the pump: not above the suction level"
    elif level > site.z_o:
        state, sentence = "high", "above its outlet: it overflows to the sewer"
    else:
        amount = words.quantity(usable, "m3", 1)
        state, sentence = "good", f"{amount} above the suction level can be pumped"
        if level > site.lowest_outlet:
            sentence += "; its low outlet drains it"
    return _tile("Cistern level", value, _cistern_level(level), state, sentence, **gauge)


@dataclass(frozen=True)
class Pumping:
    """What is known of the pump.

    Attributes:
        said: the pump node's state and why, in its words; None where there is no such node.
        gone: whether that node is not there any more.
        heard: whether its drive is; where it is not, the pump node says what must be.
        may_turn: whether it is not known that the pump stands, nor what it turns at.
        flow_known: whether ``flow`` is one, and not 0 since none is known.
        flow: m3/s.
        command: share of the greatest flow.
        roof: level (m).
        cistern: level (m).
        frost: 1 where there is.
        kept_off: whether the pump node says that something is wrong.
    """

    said: str | None
    gone: bool
    heard: bool
    may_turn: bool
    flow_known: bool
    flow: Value | None
    command: Value | None
    roof: Value | None
    cistern: Value | None
    frost: Value | None
    kept_off: bool

    @property
    def may_run(self) -> bool:
        """Whether nothing that is known keeps it off."""
        return not self.kept_off and not _known(self.frost)

    def state(self, site: Site | None) -> tuple[str, str]:
        """Return the state, and why it is so; in a plain simulation, by the plant's own rules."""
        if self.said is not None:
            state, _, why = self.said.partition(": ")
            return (state, why) if state in PUMP_STATES else ("unknown", self.said)
        command = None if self.command is None else self.command.number
        flow = None if self.flow is None else self.flow.number
        why = self._why_off(site, command)
        if flow is None:
            if command is None:
                return "unknown", "neither flow nor command is known"
            return ("off", why) if command == 0 or why else ("running", "")
        if flow > 0:
            return "running", ""
        return "off", why or "it rests between two runs"

    def _why_off(self, site: Site | None, command: float | None) -> str:
        """Return why a simulated pump stands; empty where nothing known says so."""
        roof, cistern, frost = _known(self.roof), _known(self.cistern), _known(self.frost)
        if frost:
            return "there is frost"
        if command == 0:
            return "nothing is commanded"
        if site is not None and roof is not None and roof >= site.z_veg:
            return "the roof has reached its target"
        if site is not None and cistern is not None and cistern < site.suction_level:
            return "the cistern is below the suction level"
        return "no command is known" if command is None else ""


def pump(pumping: Pumping, site: Site | None) -> dict[str, Any]:
    """Return the tile of the pump.

    ``alarm`` is whether it may turn and nobody knows, ``idle`` whether it is off since the
    controller commands nothing, and for no other reason.
    """
    state, why = pumping.state(site)
    flow = pumping.flow if pumping.flow_known and (pumping.heard or pumping.may_turn) else None
    command = pumping.command
    parts = []
    if pumping.may_turn:
        parts.append("whether it stands is not known")
        state, why = "unknown", why if pumping.said is not None else ""
    elif not pumping.heard:
        parts.append("its drive is not heard: it stood then, or its own timeout has stopped it")
    if flow is not None:
        parts.append(words.NOT_PLAUSIBLE if flow.number is None else _flow(flow.number))
    elif not pumping.flow_known and not pumping.may_turn:
        parts.append("its flow is not known")
    if command is not None:
        if command.number is None:
            parts.append(f"the command is {words.NOT_PLAUSIBLE}")
        elif command.number:
            parts.append(f"commanded {words.command(command.number)} of its greatest flow")
        else:
            parts.append("nothing is commanded")
    heard = flow if flow is not None else command
    old = heard is not None and heard.stale
    # The node says its state by another way than the flow.
    stale = not pumping.may_turn and (pumping.gone or (old and pumping.said is None))
    if old and not stale:
        place = -1 if flow is None or command is None else -2
        parts[place] = f"last known {parts[place]}"
    if not parts and state == "unknown":
        parts.append("nothing was heard of it yet")
    if stale and state != words.UNKNOWN:
        parts.insert(0, f"{state} when last heard")
    return {
        "label": "Pump", "value": words.UNKNOWN if stale else state, "number": _known(flow),
        "state": "unknown" if stale else state, "alarm": pumping.may_turn,
        "idle": state == "off" and not stale and pumping.may_run and _known(command) == 0,
        "sentence": "; ".join(parts), "why": why, "stale": stale,
    }


def rain(
    value: Value | None, forecast: Forecast | None, now: float | None, utc_offset: float,
    *, ended: bool,
) -> dict[str, Any]:
    """Return the tile of the rain, now and to come.

    Args:
        value: the rain of now.
        forecast: the newest.
        now: s since 1970.
        utc_offset: of the times (h).
        ended: whether the run is over, so that nothing is to come.
    """
    sentence = _to_come(forecast, now, utc_offset, ended=ended)
    rate = None if value is None else value.number
    if rate is None:
        if value is None:
            return _tile("Rain", value, words.UNKNOWN, "unknown", sentence)
        return _tile("Rain", value, words.NOT_PLAUSIBLE, "alarm", sentence)
    return _tile("Rain", value, _rain_rate(rate), "good", sentence)


def _to_come(
    forecast: Forecast | None, now: float | None, utc_offset: float, *, ended: bool
) -> str:
    if forecast is None or now is None:
        return "no forecast is known"
    age, made = now - forecast.at, words.hour_and_minute(forecast.at, utc_offset, now)
    amount = forecast.amount(now)
    if amount is None:
        return f"no forecast is known: that of {made} is over"
    sentence = _amount(amount, ended=ended)
    if age <= _RENEWED_S:
        return sentence
    if age <= _OLD_S or ended:
        return f"{sentence}, by the forecast of {made}"
    return f"the forecast is too old, of {made}: {_amount(amount, ended=True)}"


def _amount(amount: Amount, *, ended: bool) -> str:
    reach = words.horizon(amount.reach_s)
    if amount.reach_s < _SOON_S:
        return f"no forecast of the next hours: it reaches {reach} ahead"
    sentence = f"{words.rain(amount.mean)} {'were ' if ended else ''}expected in the next {reach}"
    return sentence + _range(amount)


def _range(amount: Amount) -> str:
    """Write the range of an ensemble's rain behind its mean: `` (19 to 46)``; empty of others."""
    if amount.members == 1:
        return ""
    low, high = (words.rain(one).removesuffix(" mm") for one in (amount.low, amount.high))
    return f" ({low} to {high})"


def waiting(
    pump: dict[str, Any], site: Site | None, pumping: Pumping, forecast: Forecast | None,
    plan: Plan | None, now: float | None, utc_offset: float,
) -> str:
    """Return for which rain the controller waits; empty where it does not.

    It does where the roof is too dry, it alone has the pump off, and at least the missing water is
    forecast, before it plans to pump any.

    Args:
        pump: its tile.
        site: by which levels are judged.
        pumping: what is known of the pump.
        forecast: the newest.
        plan: the controller's newest, where it makes any.
        now: s since 1970.
        utc_offset: of the times (h).
    """
    level = _known(pumping.roof)
    if (
        site is None or now is None or forecast is None or level is None
        or not pump["idle"] or level >= band_of(site)[0] or now - forecast.at > _OLD_S
    ):
        return ""
    amount = forecast.amount(now)
    if amount is None or amount.reach_s < _SOON_S or amount.mean < site.z_veg - level:
        return ""
    begin = None if plan is None or now >= plan.ends[-1] else plan.pumped(now)[1]
    if begin is not None and begin < amount.fallen_at:
        return ""
    by = words.hour_and_minute(-(-amount.fallen_at // 3600) * 3600, utc_offset, now)
    return f"waiting for rain: {words.rain(amount.mean)}{_range(amount)} by {by}"


def too_wet(
    roof: dict[str, Any], site: Site | None, plan: Plan | None, now: float | None,
    utc_offset: float,
) -> str:
    """Return how much too wet the controller expects the roof to be; empty where it does not.

    Args:
        roof: its tile.
        site: by which levels are judged.
        plan: the controller's newest, where it makes any.
        now: s since 1970.
        utc_offset: of the times (h).
    """
    if site is None or plan is None or now is None or roof["state"] not in ("low", "good"):
        return ""
    above = plan.above(band_of(site)[1], now)
    if above is None:
        return ""
    begin, level = above
    return (
        f"It is expected to be too wet from {words.hour_and_minute(begin, utc_offset, now)} on, "
        f"up to {_roof_level(level - site.z_veg)} above its target."
    )


def controller(
    name: str | None, command: Value | None, plan: Plan | None, now: float | None,
    utc_offset: float, *, fill_to: Value | None, trust: Value | None, alarm: str, ended: bool,
) -> dict[str, Any]:
    """Return the tile of the controller.

    Args:
        name: of the active one; None where none is known.
        command: what it commands.
        plan: its newest, where it makes any.
        now: s since 1970.
        utc_offset: of the times (h).
        fill_to: to what level it fills the roof (m), where it says that.
        trust: share of the room for forecast rain that it leaves (1), likewise.
        alarm: what is wrong with it; empty where nothing is.
        ended: whether the run is over, so that nothing of the plan comes.
    """
    stale = command is not None and command.stale
    known = name is not None and _known(command) is not None
    state = "alarm" if alarm else "good" if known else "unknown"
    if alarm:
        sentence = alarm
    elif plan is not None and now is not None:
        sentence = _planned(plan, now, utc_offset, ended=ended)
    elif name is None and command is None:
        sentence = "no controller is known"
    elif command is None or command.number is None:
        sentence = "its command is unknown"
    elif command.number:
        sentence = f"commands {words.command(command.number)} of the pump's greatest flow"
    else:
        sentence = "commands no pumping now"
    if not alarm and not ended:
        sentence = "; ".join(filter(None, (_aim(fill_to), sentence, _trusted(trust))))
    return {
        "label": "Controller", "value": name or ("not recorded" if ended else words.UNKNOWN),
        "number": None, "state": state, "sentence": sentence, "stale": stale,
    }


def _aim(fill_to: Value | None) -> str:
    """Return to what a controller fills the roof now; empty where it leaves it alone."""
    level = None if fill_to is None or fill_to.stale else fill_to.number
    return "" if level is None else f"fills to {words.value_of('/controller/fill_to', level)} now"


def _trusted(trust: Value | None) -> str:
    """Return how far a controller trusts the forecast; empty where it does in full."""
    share = None if trust is None or trust.stale else trust.number
    if share is None or share == 1:
        return ""
    if share == 0:
        return "does not trust the forecast: of late a roof without one would have done better"
    return (
        f"leaves {words.value_of('/controller/trust', share)} of the room that the forecast asks "
        "for: of late that would have done best"
    )


def _planned(plan: Plan, now: float, utc_offset: float, *, ended: bool) -> str:
    if now >= plan.ends[-1]:
        return "its plan was over" if ended else "its plan is over"
    volume, begin = plan.pumped(now)
    reach = words.horizon(min(12 * 3600.0, float(plan.ends[-1]) - now))
    if begin is None:
        return f"{'planned not to' if ended else 'will not'} pump in the next {reach}"
    start = "from now on"
    if begin > now:
        start = f"from {words.hour_and_minute(begin, utc_offset, now)} on"
    will = "planned to" if ended else "will"
    return f"{will} pump {words.quantity(volume, 'm3', 2)} in the next {reach}, {start}"


@dataclass(frozen=True)
class Wrong:
    """How much is wrong, as the alarms below say in full.

    Attributes:
        alarms: how many there are now that do not follow from others.
        warnings: how many there are now that do not.
        following: how many follow from these.
        incidents: how many a recording has that are over.
        worst: of what is wrong now: ok, warn or error.
        known: whether any node has said how it is; a recording does not tell all alarms.
    """

    alarms: int
    warnings: int
    following: int
    incidents: int
    worst: str
    known: bool

    @property
    def word(self) -> str:
        """Write it."""
        counts = [
            f"{count} {name}" if count == 1 else f"{count} {name}s"
            for count, name in (
                (self.alarms, "alarm"), (self.warnings, "warning"), (self.incidents, "incident"),
            ) if count
        ]
        if self.incidents:
            counts[-1] += ", over" if self.incidents == 1 else ", all over"
        none = "No alarms" if self.known else "Alarms are not known"
        more = f" ({self.following} more caused by these)" if self.following else ""
        return f"{', '.join(counts) or none}{more}."


def summary(
    tiles: dict[str, dict[str, Any]], wrong: Wrong, *, mode: str, waiting: str, too_wet: str
) -> dict[str, str]:
    """Return the words above the tiles: how many alarms, a sentence, and how bad it is.

    Args:
        tiles: of roof and pump, at least.
        wrong: what is.
        mode: of the document.
        waiting: for which rain the controller waits; empty where it does not.
        too_wet: how much too wet the roof is expected to be; empty where it is not.
    """
    if mode == "none":
        return {
            "word": "Nothing is heard yet:", "sentence": "no run and no site is found.",
            "level": "warn",
        }
    parts = ["The run has ended."] if mode == "ended" else []
    roof, pump = tiles["roof"], tiles["pump"]
    verb = "was" if mode == "ended" else "is"
    if roof["state"] in ("unknown", "alarm"):
        said = f"The roof's level is not known now ({roof['sentence']})" if roof["stale"] else (
            f"The roof's level is {roof['value']}"
        )
    else:
        judged = {"low": "too dry, ", "high": "wetter than it should be, "}.get(roof["state"], "")
        said = f"The roof {verb} {judged}{roof['sentence']}"
    clause = f"the pump is {waiting}" if waiting else _pump_clause(pump, verb)
    parts.append(f"{said}; {clause}.")
    if too_wet:
        parts.append(too_wet)
    doubtful = any(tiles[name]["state"] in ("unknown", "alarm") for name in ("roof", "pump"))
    attention = (
        doubtful or pump["state"] in ("fault", "held")
        or (roof["state"] in ("low", "high") and not waiting)
    )
    level = wrong.worst
    if level == "ok":
        level = "warn" if attention or wrong.incidents else "ok" if wrong.known else "stale"
    return {"word": wrong.word, "sentence": " ".join(parts), "level": level}


def advice(tiles: dict[str, dict[str, Any]], *, mode: str, waiting: str) -> str:
    """Return what to do where there is no alarm: what goes on, where something is not as wanted.

    Args:
        tiles: of roof, pump and controller, at least.
        mode: of the document.
        waiting: for which rain the controller waits; empty where it does not.
    """
    roof, pump, controller = (tiles[name] for name in ("roof", "pump", "controller"))
    if mode == "none":
        return (
            "Start a run or a site; where one runs, see that this watcher has its ROS_DOMAIN_ID "
            "and --namespace."
        )
    if mode == "ended":
        return "This was recorded: what is now is not shown."
    if any(tile["state"] in ("unknown", "alarm") for tile in (roof, pump)):
        return (
            "Nothing is reported as wrong, but not all is known: see whether sensors and programs "
            "run."
        )
    if roof["state"] == "high" and pump["state"] in ("starting", "running"):
        return "The roof has enough, and the pump runs: see whether it should."
    if roof["state"] == "high":
        return "Nothing to do: the roof drains and dries by itself."
    if roof["state"] != "low" or waiting:
        return "Nothing to do."
    if pump["state"] in ("starting", "running"):
        return "Nothing to do: the pump waters the roof."
    if pump["idle"]:
        return f"Nothing to do now: the controller {controller['sentence']}."
    why = f": {pump['why']}" if pump["why"] else ""
    return f"The roof is not watered, since the pump is {pump['state']}{why}."


def _pump_clause(pump: dict[str, Any], verb: str) -> str:
    state, why = pump["state"], pump["why"]
    if pump["alarm"]:
        return f"whether the pump {'stood' if verb == 'was' else 'stands'} is not known"
    if state == "unknown":
        return "what the pump does is not known"
    if state in ("running", "starting", "stopping"):
        clause = f"the pump {verb} {state}"
        return f"{clause} at {_flow(pump['number'])}" if pump["number"] else clause
    if state == "fault":
        return f"the pump {'had' if verb == 'was' else 'has'} a fault: {why}"
    if state == "held":
        return f"the pump {verb} held off: {why}"
    return f"the pump {verb} off" + (f", since {why}" if why else "")
