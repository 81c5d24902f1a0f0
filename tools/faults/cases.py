"""Every case of the campaign: what is done to which target, and what must follow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from rig_simulators import DEFAULT

# How often the foreign readers are stopped in a case.
ROUNDS = 10
CHANGES = "4000 changes of a parameter"
DRIVES = ("danfoss_fc202", "abb_acs880", "grundfos_cim500", "schneider_atv630")
SITE, PUMP = f"site:{DRIVES[0]}", f"pump:{DRIVES[0]}"
# The name of a status on /diagnostics, and the code of a condition that it shows.
Sign = tuple[str, str]


def _pump(*codes: str) -> tuple[Sign, ...]:
    """Return signs with these codes, shown by the pump's own status."""
    return tuple(("pump: pump", code) for code in codes)


def _level(tank: str, why: str = "") -> tuple[Sign, ...]:
    """Return the signs of a pump that stands for an unknown level, and perhaps of the reason."""
    return _pump(f"{tank}_level_unknown") + ((("pump: levels", why),) if why else ())


@dataclass(frozen=True)
class Expected:
    """What must follow from a fault.

    Attributes:
        stops: True: the pump must stop within the bound; False: it must run on; None: either.
        bound: name of one of `bounds.bounds`.
        signs: what must be shown, all of it.
        names: node or topic that bringup must print.
        never: conditions that must not be shown.
        recovery: ``heals``: the pump runs again automatically; ``latches``: only after ~/reset;
            ``stays``: it stays off; ``ends``: bringup and all its processes end.
        watch: how long the pump must run on (s).
    """

    stops: bool | None = True
    bound: str = "step"
    signs: tuple[Sign, ...] = ()
    names: str = ""
    never: tuple[Sign, ...] = ()
    recovery: str = "heals"
    watch: float = 3.0


_RUNS_ON = Expected(stops=False)
_ENDS = Expected(bound="drive", recovery="ends")


@dataclass(frozen=True)
class Case:
    """One fault.

    Attributes:
        rig: kind of rig and drive, such as ``site:abb_acs880``; cases of one rig are consecutive.
        fault: what is done, such as ``kill``.
        target: what it is done to.
        parameter: of the fault, if it has one.
    """

    rig: str
    fault: str
    target: str
    expected: Expected
    parameter: int = DEFAULT

    @property
    def id(self) -> str:
        return f"{self.rig}/{self.fault}/{self.target.strip('/').replace('/', '.')}"


# --- processes ------------------------------------------------------------------------------------

_LOST = (("pump: drive", "drive_lost"),)
_DELIVERY = Expected(bound="undelivered", signs=_pump("delivery"), recovery="latches")


def _own_driver() -> Iterator[Case]:
    """Yield the cases of a user's own driver; if it dies, the drive's timeout stops the pump."""
    lost = (("pump_guard: driver", "driver_lost"),)
    rig = f"own driver:{DRIVES[0]}"
    for fault in ("kill", "stop long"):
        yield Case(rig, fault, "driver", Expected(bound="drive", signs=lost))
    yield Case(rig, "held", "driver", Expected(
        bound="held", signs=(("pump_guard: pump", "hold"),)))


def _process(node: str, fault: str) -> Expected:
    """Return what must follow from a fault of a live site's process."""
    # A node that ends as it is asked to is no alarm, and is started again.
    lost = () if fault == "term" else ((node, "node_silent"),)
    if node == "station":  # the alarms node, which is in it, tells of the restart
        lost = (("alarms: station", "station_restarted"),)
    if fault == "stop short":
        return _RUNS_ON
    if node == "bringup":  # the other processes do without it, until they are asked to end
        return Expected(stops=False, watch=12.0) if fault == "stop long" else Expected(
            recovery="ends")
    if node == "pump":
        return Expected(bound="step" if fault == "term" else "drive", signs=lost)
    if node == "station":  # after the first failures it is started again before levels are unknown
        unknown = fault == "stop long"
        return Expected(stops=unknown or None, bound="level", signs=(
            *lost, *(_level("cistern") if unknown else ())))
    # A controller that ends is started again, perhaps before the pump node misses its commands.
    lapses = fault == "stop long"
    return Expected(stops=lapses or None, bound="command", signs=(
        *lost, *(_pump("command_unknown") if lapses else ())))


def _processes() -> Iterator[Case]:
    for fault in ("kill", "term", "stop short", "stop long"):
        for node in ("onoff", "station", "pump", "bringup"):
            yield Case(SITE, fault, node, _process(node, fault))
    for drive in DRIVES:
        rig = f"site:{drive}"
        if rig != SITE:
            for fault in ("kill", "stop long"):
                yield Case(rig, fault, "pump", _process("pump", fault))
        yield Case(rig, "kill", "drive_simulator", Expected(
            stops=None, bound="drive", signs=_LOST))
        # Only the drive's own timeout can stop the pump.
        yield Case(rig, "kill both", "pump and bringup", _ENDS)
        # For some time after power-up some drives have no timeout.
        yield Case(f"guarded:{drive}", "power cycle, then kill", "drive", _ENDS)
    for fault in ("kill", "stop long"):
        yield Case(SITE, fault, "site_simulator", Expected(
            bound="level", signs=_level("cistern")))
    yield Case(SITE, "readers", "four of /roof/level", Expected(stops=False))


# --- the drive ------------------------------------------------------------------------------------

_DRIVE: dict[str, Expected] = {
    # An absurd value is outside the drive file's range of the speed and implausible, as if there
    # were no answer. A drive that has power again is as before, and reports no fault.
    **dict.fromkeys(
        ("refused", "dropped", "half_open", "silence", "late", "garbage", "wrong_unit",
         "wrong_function", "wrong_length", "absurd_value", "power_cycle", "echo", "trickle",
         "previous", "previous_frame"),
        Expected(bound="drive", signs=_LOST),
    ),
    "slow": _RUNS_ON,
    "split": _RUNS_ON,
    "exception": Expected(bound="refused", signs=_LOST),
    # It refuses writes, but counts every request as a sign of life.
    "refused_writes": Expected(bound="refusing", signs=_LOST),
    "drive_fault": Expected(bound="drive", signs=_pump("drive_fault"), recovery="latches"),
    "timeout_off": Expected(bound="drive", signs=_pump("drive_timeout")),
    "local": Expected(bound="drive", signs=(("pump: drive", "drive_local"),)),
    # Held by an operator, the drive reports off, but its motor runs until its own timeout passes.
    "runs_on": Expected(bound="runs on", signs=_pump("runs_on"), recovery="latches"),
    # As in PX4: silent for 7 s of 9.
    "intermittent": Expected(bound="intermittent drive", signs=_LOST),
}
# A Danfoss's speed is a share of its reference. Twice that share is accepted, as a speed that does
# not follow. A Grundfos has no panel, and its timeout cannot be set.
_OF_MAKE: dict[tuple[str, str], Expected | None] = {
    ("danfoss_fc202", "absurd_value"): Expected(
        bound="follow", signs=_pump("speed_not_followed"), recovery="latches"),
    ("grundfos_cim500", "local"): None,
}
# Not on a serial line: it has no connections, and a restarted simulator's has another name.
_NOT_SERIAL = ("refused", "timeout_off", "local", "refused_writes")
# The motor does not stop, regardless of the command: there must be an alarm, and the fault latches.
_UNSTOPPABLE = Expected(
    stops=None, watch=0.0, bound="follow", recovery="latches", signs=_pump("runs_on"))


def _drives() -> Iterator[Case]:
    for drive in DRIVES:
        for fault, usual in _DRIVE.items():
            expected = _OF_MAKE.get((drive, fault), usual)
            if expected is not None:
                kind = "pump" if fault == "refused_writes" else "site"
                yield Case(f"{kind}:{drive}", "drive", fault, expected)
        for fault in ("speed_stays", "stuck_running", "contactor", "frozen"):
            yield Case(f"site:{drive}", "unstoppable", fault, _UNSTOPPABLE)
        yield Case(f"site:{drive}", "drive", "says_running", _DELIVERY)
        yield Case(f"site:{drive}", "unstoppable", "says_stopped", replace(
            _UNSTOPPABLE, bound="welded", signs=_pump("runs_on")))
        yield Case(f"metered:{drive}", "drive", "says_stopped", Expected(
            bound="flows on", signs=_pump("runs_on"), recovery="latches"))
        # Its connections break before it can be judged on one.
        yield Case(f"pump:{drive}", "drive", "runs_on, breaks", Expected(
            bound="runs on, breaks", signs=_pump("runs_on"), recovery="latches"), 3)
        if drive != "grundfos_cim500":
            for target, bound in (("drive", "longest silence"), ("stop requested", "requested")):
                yield Case(f"site:{drive}", "timeout rewritten", target, Expected(
                    bound=bound, signs=(("pump: drive timeout", "drive_timeout"),)))
    for fault in (fault for fault in _DRIVE if fault not in _NOT_SERIAL):
        expected = _OF_MAKE.get((DRIVES[0], fault), _DRIVE[fault])
        assert expected is not None
        yield Case(f"rtu:{DRIVES[0]}", "drive", fault, expected)


def _relays() -> Iterator[Case]:
    """Yield the cases of a relay, its broker and its driver.

    Deaf means that renewals come too late or not at all: it switches itself off, but answers.
    """
    lost = Expected(bound="drive", signs=_LOST)
    for drive in ("tasmota", "shelly_gen2"):
        rig = f"relay:{drive}"
        for target in ("killed", "restarted", "paused", "half_open"):
            yield Case(rig, "broker", target, lost)
        for target in ("silence", "garbage", "late", "power_cycle"):
            yield Case(rig, "drive", target, lost)
        yield Case(rig, "drive", "deaf", replace(lost, signs=_pump("second_master")))
        yield Case(rig, "unstoppable", "welded", Expected(
            stops=None, watch=0.0, bound="welded", recovery="latches", signs=_pump("runs_on")))
        for fault in ("kill", "stop long"):
            yield Case(rig, fault, "pump", _process("pump", fault))
        yield Case(rig, "kill both", "pump and bringup", _ENDS)


# --- sensors and weather --------------------------------------------------------------------------

# Faults of the line to a sensor.
_WIRE = ("refused", "dropped", "half_open", "silence", "slow", "late", "split", "garbage",
         "wrong_unit", "wrong_function", "wrong_length", "exception", "echo", "intermittent",
         "trickle", "previous", "previous_frame")


def _still(tank: str) -> Expected:
    """Return what must follow from a level that does not change while the pump runs.

    A constant roof level does not show whether water arrives.
    """
    if tank == "roof":
        return replace(_DELIVERY, bound="roof frozen")
    return Expected(bound="cistern frozen", signs=_level("cistern", "input_frozen"))


def _sensors() -> Iterator[Case]:
    for tank in ("cistern", "roof"):
        silent = Expected(bound="level", signs=_level(tank, "input_silent"))
        jump = Expected(bound="noisy", signs=_level(tank, "input_jump"))
        for fault, expected, parameter in (
            ("silent", silent, DEFAULT), ("absurd", silent, DEFAULT), ("noisy", jump, 1000),
            ("frozen", _still(tank), DEFAULT), ("drifting", replace(jump, bound="drift"), 500),
        ):
            yield Case(SITE, "sensor", f"{tank}_{fault}", expected, parameter)
        special = {"slow": _RUNS_ON, "split": _RUNS_ON, "previous": _RUNS_ON,
                   "intermittent": replace(silent, bound="intermittent")}
        for fault in _WIRE:
            yield Case(SITE, "sensor line", f"{tank}_{fault}", special.get(fault, silent))
    for fault in ("burst_pipe", "closed_valve"):
        yield Case(SITE, "site", fault, _DELIVERY)
    # This leak lowers the level faster than pump and outlet can, so the level jumps meanwhile.
    yield Case(SITE, "site", "leak", _DELIVERY, 50_000)
    yield Case(f"dry:{DRIVES[0]}", "dry", "cistern", Expected(
        bound="filtered", signs=_pump("cistern_low"), recovery="stays"))


def _brokers() -> Iterator[Case]:
    """Yield the cases of sensors on MQTT and their broker."""
    rig = f"mqtt:{DRIVES[0]}"
    level = Expected(bound="level", signs=_level("cistern", "input_silent"))
    lost, broker_lost = (
        tuple((f"{tank}_sensor: sensor", f"{what}_lost") for tank in ("cistern", "roof"))
        for what in ("sensor", "broker")
    )
    for fault, expected in (
        ("killed", replace(level, signs=(*level.signs, *broker_lost))),
        # The broker may be back before the level is too old.
        ("restarted", Expected(stops=None, signs=broker_lost)),
        ("paused", level),
        ("half_open", level),
        # The sensor is lost, but is shown as often refused if it was within the last minute.
        ("retained", level),
        # One of the payloads is a level, though not this one.
        ("hostile", Expected(stops=None, bound="level", signs=(("pump: levels", "input_jump"),))),
    ):
        yield Case(rig, "broker", fault, expected)
    for tank, sensor in zip(("cistern", "roof"), lost, strict=True):
        for fault in ("silent", "absurd"):
            yield Case(rig, "sensor", f"{tank}_{fault}", Expected(
                bound="level", signs=(*_level(tank), sensor)))
    yield Case(rig, "kill", "site_simulator", replace(level, signs=(*level.signs, *lost)))


_UNREADABLE: Sign = ("weather: forecast", "forecast_unreadable")


def _forecasts() -> Iterator[Case]:
    for file in ("broken", "missing"):
        yield Case(SITE, "forecast file", file, Expected(stops=False, signs=(_UNREADABLE,)))
    yield Case(SITE, "forecast file", "old", Expected(
        bound="command", signs=(("weather: forecast", "forecast_missing"),
                                *_pump("frost_unknown"))))
    for target, signs in (
        ("large", ()), ("an issue too large", (_UNREADABLE,)),
        ("short", (("weather: forecast", "forecast_short"),)),
        ("a null", ()), ("an empty member", ()), ("a short control run", ()),
    ):
        yield Case(f"lookahead:{DRIVES[0]}", "forecast file", target, Expected(
            stops=False, signs=signs, watch=20.0 if "large" in target else 5.0,
            never=() if signs == (_UNREADABLE,) else (_UNREADABLE,)))
    yield Case(f"no forecast:{DRIVES[0]}", "from the start", "no forecast file", Expected(
        stops=False, signs=(("weather: forecast", "forecast_missing"),)))


def _harmless() -> Iterator[Case]:
    """Yield the cases that must not stop the pump."""
    yield Case(f"empty:{DRIVES[0]}", "from the start", "roof level of -1 mm", Expected(
        stops=False, never=_level("roof", "input_refused")))
    # The reading does not change for a while, although the level does.
    for tank, watch in (("cistern", 40.0), ("roof", 80.0)):
        yield Case(f"played:{DRIVES[0]}", "coarse", f"/{tank}/level", Expected(
            stops=False, watch=watch, never=_level(tank, "input_frozen")))
    # Surfaces hold back the rain, 2 mm.
    yield Case(f"catchment:{DRIVES[0]}", "coarse in rain", "/cistern/level", Expected(
        stops=False, watch=40.0, never=(("onoff: inputs", "input_frozen"),)))
    yield Case(SITE, CHANGES, "onoff", _RUNS_ON)
    for node in ("onoff", "weather", "cistern_sensor", "pump", "recorder"):
        yield Case(SITE, "use_sim_time", node, _RUNS_ON)


# Signs of a disk on which nothing can be written; the pump runs on.
DISK_SIGNS = (("recorder: recording", "not_recorded"), ("pump: state file", "state_not_kept"))


def _records() -> Iterator[Case]:
    """Yield the cases of a full disk, and of a killed pump node whose state file is spoilt."""
    for target in ("moved away", "torn"):
        yield Case(SITE, "state file", target, Expected(
            bound="drive", signs=_pump("state_unknown"), recovery="latches"))
    # A record that cannot be read keeps the pump off, and so does one that cannot be written.
    for how, code in (("EIO", "state_unknown"), ("EROFS", "state_not_kept")):
        yield Case(f"failing disk:{DRIVES[0]}", "failing disk", f"{how}, then kill", Expected(
            bound="drive", signs=_pump(code), recovery="stays"))
    yield Case(f"full disk:{DRIVES[0]}", "full disk", "recorder", Expected(
        stops=False, bound="full disk", signs=(("recorder: recording", "not_recorded"),),
        watch=5.0))


def _limits() -> Iterator[Case]:
    """Yield the cases of a command that never changes, which the pump's limits must stop."""
    for limit, code, recovery in (
        ("max_run", "max_run", "heals"),
        ("max_volume_per_day", "daily_volume", "stays"),
    ):
        yield Case(f"{limit}:{DRIVES[0]}", "stuck for ever", "/pump/command", Expected(
            bound="limit", signs=_pump(code), recovery=recovery))


# --- topics ---------------------------------------------------------------------------------------

MODES = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")
LEVELS = ("/cistern/level", "/roof/level", "/weather/frost")
FORECASTS = ("/forecast/precipitation", "/forecast/evapotranspiration")
PLAYED = (*LEVELS, *FORECASTS)
GAUGES = ("/gauge/precipitation", "/gauge/temperature")
# Signs of refused values, by topic.
_REFUSED = {
    "/pump/command": (*_pump("command_unknown"), ("pump: command", "input_refused")),
    "/weather/frost": _pump("frost_unknown"),
    **{f"/{tank}/level": _level(tank, "input_refused") for tank in ("cistern", "roof")},
    "/gauge/precipitation": (("weather: rain gauge", "gauge_bad"),),
    "/gauge/temperature": (("weather: thermometer", "gauge_bad"),),
}
# Topics played badly, by rig. The campaign's controller (on/off) needs no forecast.
_ON = {
    "pump": ("/pump/command", *LEVELS), "played": FORECASTS, "gauged": GAUGES,
    "metered": ("/pump/meter",),
}


def _badly() -> dict[tuple[str, str], Expected]:
    """Return what must follow from topics that are published badly; others have no effect."""
    command, frost = "/pump/command", "/weather/frost"
    refused = Expected(signs=_REFUSED[command])
    silent = Expected(bound="command", signs=_pump("command_unknown"))
    badly = {
        (frost, "off"): Expected(bound="frost", signs=_pump("frost_unknown")),
        (frost, "garbage"): Expected(signs=_REFUSED[frost]),
        (frost, "wrong"): Expected(signs=_pump("frost")),
        (command, "off"): silent,
        (command, "garbage"): refused,
        (command, "wrong"): refused,
        (command, "slow"): silent,
        (command, "intermittent"): replace(silent, bound="intermittent"),
        # The meter reports no flow: the volume counts by the speed, which agrees with the levels.
        ("/pump/meter", "wrong"): _RUNS_ON,
        ("/gauge/temperature", "wrong"): Expected(bound="command", signs=_pump("frost")),
    }
    for tank in ("cistern", "roof"):
        name = f"/{tank}/level"
        gone = Expected(bound="level", signs=_level(tank, "input_silent"))
        badly |= {
            (name, "off"): gone,
            (name, "stuck"): _still(tank),
            (name, "garbage"): Expected(signs=_REFUSED[name]),
            (name, "wrong"): Expected(signs=_level(tank, "input_jump")),
            (name, "intermittent"): replace(gone, bound="intermittent"),
        }
    for gauge in GAUGES:  # the forecast is used instead
        bad = Expected(stops=False, bound="gauge", signs=_REFUSED[gauge])
        badly |= {(gauge, "off"): bad, (gauge, "garbage"): bad}
    return badly


def _topics() -> Iterator[Case]:
    badly = _badly()
    for kind, topics in _ON.items():
        for topic in topics:
            rig = f"{kind}:{DRIVES[0]}"
            for mode in MODES:
                yield Case(rig, mode, topic, badly.get((topic, mode), _RUNS_ON))
            yield Case(rig, "10000 hostile", topic, Expected(
                stops=None, bound="gauge" if kind == "gauged" else "command",
                signs=_REFUSED.get(topic, ())))


# --- intruders ------------------------------------------------------------------------------------

# Signs of two publishers, on the topics whose second publisher stops the pump; the others do not
# command the pump.
_OBEYED = {
    "/pump/command": _pump("command_unknown"),
    "/cistern/level": _level("cistern", "input_publishers"),
    "/roof/level": _level("roof", "input_publishers"),
    "/weather/frost": (*_pump("frost_unknown"), ("pump: frost", "input_publishers")),
    "/pump/flow": (*_pump("two_pumps"), ("pump: flow", "two_pumps")),
}
_RECEIVED = (*FORECASTS, "/weather/precipitation", "/weather/evapotranspiration", "/pump/state",
             "/pump/meter", "/controller/cost", "/diagnostics")


def _intruders() -> Iterator[Case]:
    for topic in (*_OBEYED, *_RECEIVED):
        signs = _OBEYED.get(topic)
        yield Case(SITE, "intruder", topic, Expected(
            stops=True if signs else None, bound="command", signs=signs or ()))
        # Every topic that a live node receives, from any publisher.
        yield Case(SITE, "10000 hostile", topic, Expected(
            stops=None, bound="command", signs=signs or ()))
    yield Case(SITE, "second pump node", "pump", Expected(
        stops=None, bound="command", watch=8.0, names="a second program reports the pump's flow",
        signs=(("pump: flow", "two_pumps"),)))
    for target in ("in another domain", "in another domain, temporary files removed"):
        yield Case(PUMP, "second pump node", target, Expected(
            stops=False, bound="command", watch=5.0, signs=(("pump: drive", "drive_lost"),)))
    yield Case(SITE, "second controller", "onoff", Expected(
        bound="command", signs=_OBEYED["/pump/command"]))
    for target in ("bringup", "bringup, temporary files removed"):
        yield Case(SITE, "second graph", target, _RUNS_ON)


# --- the outlet valve -----------------------------------------------------------------------------

VALVE, VALVE_ALARM = "valve", "valve alarm"


def _valve(*codes: str, part: str = "valve") -> tuple[Sign, ...]:
    """Return signs with these codes, shown by the valve node."""
    return tuple((f"valve: {part}", code) for code in codes)


def _valves() -> Iterator[Case]:
    """Yield the cases of a live site with a valve on a relay, and without a pump."""
    lost = _valve("drive_lost", part="drive")
    for target, bound, code in (
        ("frost", "sensor", "frost"),
        ("rain", "sensor", "wet_weather"),
        ("silence of thermometer", "thermometer", "frost_unknown"),
        ("silence of rain_gauge", "gauge", "rain_unknown"),
        ("silence of cistern", "level", "cistern_level_unknown"),
        ("hold", "step", "hold"),
    ):
        yield Case("valve:tasmota", VALVE, target, Expected(bound=bound, signs=_valve(code)))
    yield Case("valve with switches:shelly_gen2", VALVE, "silence of closed_switch", Expected(
        bound="switch", signs=_valve("position_unknown")))
    yield Case("valve moves:tasmota", VALVE, "moves", Expected(signs=_valve("hold")))
    for limit, bound, code, recovery in (
        ("max_run", "limit", "max_run", "heals"),
        ("max_volume_per_day", "released", "daily_volume", "stays"),
    ):
        yield Case(f"valve {limit}:tasmota", "stuck for ever", "/outlet/command", Expected(
            bound=bound, signs=_valve(code), recovery=recovery))
    yield Case("valve:tasmota", "intruder", "/outlet/command", Expected(
        bound="command", signs=_valve("command_unknown")))
    yield Case("valve:tasmota", "kill", "onoff", Expected(
        stops=None, bound="command", signs=(("onoff", "node_silent"),)))
    yield Case("valve:tasmota", "stop long", "onoff", Expected(
        bound="command", signs=_valve("command_unknown")))
    for rig in ("valve:tasmota", "valve with switches:shelly_gen2"):
        for fault in ("kill", "stop long"):
            yield Case(rig, fault, "valve", Expected(
                bound="relay", signs=(("valve", "node_silent"),)))
        yield Case(rig, VALVE, "relay out of reach", Expected(bound="relay", signs=lost))
        for target in ("killed", "restarted", "paused", "half_open"):
            yield Case(rig, "broker of the valve", target, Expected(bound="relay", signs=lost))
        yield Case(rig, VALVE, "reboot", Expected(bound="relay"))
        yield Case(rig, VALVE, "all killed", Expected(bound="relay", recovery="ends"))
    yield Case("valve:tasmota", VALVE, "suspend", Expected(bound="step"))
    for direction in ("forward", "back"):
        yield Case("valve:tasmota", VALVE, f"clock of {direction}", _RUNS_ON)
        yield Case("valve by hand:tasmota", VALVE, f"clock of {direction}", Expected(
            bound="by hand"))
    rig = "valve with switches:shelly_gen2"
    for target, bound, sign in (
        ("stuck open", "travel", _valve("valve_stuck_open")),
        ("wrong switch", "travel", _valve("switches_disagree")),
    ):
        yield Case(rig, VALVE_ALARM, target, Expected(
            stops=None, watch=0.0, bound=bound, signs=sign, recovery="latches"))
    for target, bound in (("stuck open", "drained"), ("leak", "leak")):
        yield Case("valve:tasmota", VALVE_ALARM, target, Expected(
            stops=None, watch=0.0, bound=bound, signs=_valve("valve_leaks"), recovery="latches"))
    for rig, bound in (("valve with switches:shelly_gen2", "travel"),
                       ("valve:tasmota", "not drained")):
        yield Case(rig, VALVE_ALARM, "stuck closed", Expected(
            stops=None, watch=0.0, bound=bound,
            signs=_valve("valve_stuck_closed", part="opening")))


def all_cases() -> list[Case]:
    """Return the whole campaign."""
    cases = [
        *_processes(), *_own_driver(), *_drives(), *_relays(), *_sensors(), *_brokers(),
        *_forecasts(), *_harmless(), *_records(), *_limits(), *_topics(), *_intruders(), *_valves(),
    ]
    assert len({case.id for case in cases}) == len(cases)
    return cases
