"""Every case of the campaign: what is done to which target, and what must follow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from forecast_service import FAULTS, NONE
from rig_simulators import DEFAULT

SIMULATED, LOOP, LIVE = "simulated", "hardware in the loop", "live"
WAYS = (SIMULATED, LOOP, LIVE)
# How often the four foreign readers are stopped in one case.
ROUNDS = 50
CHANGES = "4000 changes of a parameter"
DRIVES = ("danfoss_fc202", "abb_acs880", "grundfos_cim500", "schneider_atv630")
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
        names: node or topic that the reason of the end must name; if the rig does not end, that
            bringup must print.
        never: conditions that must not be shown.
        recovery: ``heals``: the pump runs again automatically; ``latches``: only after ~/reset;
            ``either``; ``stays``: it stays off; ``ends``: bringup and all its processes end; for a
            simulation ``same``: it runs to its end, with an unchanged bag.
        watch: how long the pump must run on (s).
    """

    stops: bool | None = True
    bound: str = "step"
    signs: tuple[Sign, ...] = ()
    names: str = ""
    never: tuple[Sign, ...] = ()
    recovery: str = "heals"
    watch: float = 3.0


@dataclass(frozen=True)
class Case:
    """One fault.

    Attributes:
        rig: kind of rig and drive, such as ``site:abb_acs880``; cases of one rig are consecutive.
        fault: what is done, such as ``kill``.
        target: what it is done to.
        number: of the repetition.
        parameter: of the fault, if it has one.
    """

    rig: str
    fault: str
    target: str
    number: int
    expected: Expected
    parameter: int = DEFAULT

    @property
    def way(self) -> str:
        kind = self.target if self.rig == "readers" else self.rig.partition(":")[0]
        return {"simulated": SIMULATED, "loop": LOOP, "relayed": LOOP}.get(kind, LIVE)

    @property
    def id(self) -> str:
        return f"{self.rig}/{self.fault}/{self.target.strip('/').replace('/', '.')}/{self.number}"


# --- processes ------------------------------------------------------------------------------------

PROCESSES = ("onoff", "weather", "sensors", "pump", "recorder")
NODES = ("onoff", "weather", "cistern_sensor", "roof_sensor", "pump", "recorder")


def _process(node: str, fault: str) -> Expected:
    """Return what must follow from a fault of a live site's process."""
    failed = (node, "node_failed")
    if fault == "stop short":
        return Expected(stops=False)
    if node == "recorder":
        return Expected(stops=False, signs=(failed,), watch=12.0)
    if node == "bringup":  # the other processes do without it, until they are asked to end
        return Expected(stops=False, watch=12.0) if fault == "stop long" else Expected(
            recovery="ends")
    if node == "pump":
        return Expected(bound="step" if fault == "term" else "drive", signs=(failed,))
    if node == "weather":  # it is started again before frost is unknown
        return Expected(stops=False, bound="supervised", signs=(failed,))
    if node == "sensors":  # after the first failures it is started again before levels are unknown
        unknown = fault == "stop long"
        return Expected(stops=unknown or None, bound="level", signs=(
            failed, *(_level("cistern") if unknown else ())))
    # A controller that ends is started again, perhaps before the pump node misses its commands.
    lapses = fault == "stop long"
    return Expected(stops=lapses or None, bound="command", signs=(
        failed, *(_pump("command_unknown") if lapses else ())))


def _processes(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        rig = f"site:{DRIVES[number % 4]}"
        for fault in ("kill", "term", "stop short", "stop long"):
            for node in (*PROCESSES, "bringup"):
                yield Case(rig, fault, node, number, _process(node, fault))
        # A requested end is no failure.
        yield Case(rig, "term after an incident", "bringup", number, _process("bringup", "term"))
    for number, drive in enumerate(DRIVES):
        rig = f"site:{drive}"
        for fault in ("kill", "stop long"):
            yield Case(rig, fault, "drive_simulator", number, Expected(
                stops=None, bound="drive", signs=_LOST))
            yield Case(rig, fault, "site_simulator", number, Expected(
                bound="level", signs=_level("cistern")))
        for again in range(2):
            # Only the drive's own timeout can stop the pump.
            yield Case(rig, "kill both", "pump and bringup", number + 4 * again, Expected(
                bound="drive", recovery="ends"))


# --- the drive ------------------------------------------------------------------------------------

_LOST = _pump("drive_lost")
_DRIVE: dict[str, Expected] = {
    # An absurd value is outside the drive file's range of the speed and implausible, as if there
    # were no answer. A drive that has power again is as before, and reports no fault.
    **dict.fromkeys(
        ("refused", "dropped", "half_open", "silence", "late", "garbage", "wrong_unit",
         "wrong_function", "wrong_length", "absurd_value", "power_cycle", "echo"),
        Expected(bound="drive", signs=_LOST),
    ),
    "slow": Expected(stops=False),
    "split": Expected(stops=False),
    "exception": Expected(bound="refused", signs=_LOST),
    "drive_fault": Expected(bound="drive", signs=_pump("drive_fault"), recovery="latches"),
    "timeout_off": Expected(bound="drive", signs=_pump("drive_timeout")),
    "local": Expected(bound="drive", signs=(("pump: drive", "drive_local"),)),
    # Held by an operator, the drive reports off, but its motor runs until its own timeout passes.
    "runs_on": Expected(bound="runs on", signs=_pump("runs_on"), recovery="latches"),
    # As in PX4: silent for 7 s of 9.
    "intermittent": Expected(bound="intermittent drive", signs=_LOST),
}
# A Danfoss's speed is a share of its reference. Twice that share is accepted, as a speed that does
# not follow.
_OF_MAKE = {
    ("danfoss_fc202", "absurd_value"): Expected(
        bound="follow", signs=_pump("speed_not_followed"), recovery="latches"),
}
# Drive faults on a serial line, which has no connections; a restarted simulator's line would have
# another name.
_SERIAL = tuple(name for name in _DRIVE if name not in ("refused", "timeout_off", "local"))
# The motor does not stop, regardless of the command: there must be an alarm, and the fault latches.
_UNSTOPPABLE = ("speed_stays", "stuck_running", "contactor")


def _drive(kind: str, faults: tuple[str, ...], first: int, repeats: int) -> Iterator[Case]:
    for drive in DRIVES:
        for number in range(first, first + repeats):
            for fault in faults:
                if not (fault == "local" and drive == "grundfos_cim500"):
                    expected = _OF_MAKE.get((drive, fault), _DRIVE[fault])
                    yield Case(f"{kind}:{drive}", "drive", fault, number, expected)
            for fault in _UNSTOPPABLE if len(faults) == len(_DRIVE) else ():
                yield Case(f"{kind}:{drive}", "unstoppable", fault, number, Expected(
                    stops=None, watch=0.0, bound="follow", recovery="latches",
                    signs=_pump("runs_on")))


def _drive_alone(repeats: int) -> Iterator[Case]:
    """Yield the cases of a pump node alone."""
    for number in range(repeats):
        for drive in DRIVES:
            # It refuses writes, but counts every request as a sign of life.
            yield Case(f"pump:{drive}", "drive", "refused_writes", number, Expected(
                bound="refusing", signs=_LOST))
            # Its connections break before it can be judged on one.
            yield Case(f"pump:{drive}", "drive", "runs_on, breaks", number, Expected(
                bound="runs on, breaks", signs=_pump("runs_on"), recovery="latches"), 3)
            # For some time after power-up some drives have no timeout.
            yield Case(f"guarded:{drive}", "power cycle, then kill", "drive", number, Expected(
                bound="drive", recovery="ends"))


def _timeouts() -> Iterator[Case]:
    """Yield the cases of a drive whose timeout another client lengthens."""
    for drive in DRIVES:
        if drive != "grundfos_cim500":  # its timeout cannot be set
            for target, bound in (
                ("drive", "longest silence"), ("stop requested", "requested")
            ):
                yield Case(f"site:{drive}", "timeout rewritten", target, 0, Expected(
                    bound=bound, signs=(("pump: drive timeout", "drive_timeout"),)))


# --- a relay on MQTT ------------------------------------------------------------------------------

RELAYS = ("tasmota", "shelly_gen2")


def _relay(repeats: int) -> Iterator[Case]:
    """Yield the cases of a relay, its broker and its driver.

    Deaf means that renewals come too late or not at all: it switches itself off, but answers.
    """
    for drive in RELAYS:
        rig = f"relay:{drive}"
        for number in range(repeats):
            for target in ("killed", "restarted", "paused", "half_open"):
                yield Case(rig, "broker", target, number, Expected(bound="drive", signs=_LOST))
            for target in ("silence", "garbage", "late", "power_cycle"):
                yield Case(rig, "drive", target, number, Expected(bound="drive", signs=_LOST))
            yield Case(rig, "drive", "deaf", number, Expected(
                bound="drive", signs=_pump("second_master")))
            yield Case(rig, "unstoppable", "welded", number, Expected(
                stops=None, watch=0.0, bound="welded", recovery="latches",
                signs=_pump("delivery")))
            for fault in ("kill", "stop long"):
                yield Case(rig, fault, "pump", number, _process("pump", fault))
            yield Case(rig, "kill both", "pump and bringup", number, Expected(
                bound="drive", recovery="ends"))


# Faults of the line to a sensor.
WIRE = ("refused", "dropped", "half_open", "silence", "slow", "late", "split", "garbage",
        "wrong_unit", "wrong_function", "wrong_length", "exception", "echo", "intermittent")
_RUNS_ON = Expected(stops=False)

# --- sensors and weather --------------------------------------------------------------------------


def _still(tank: str) -> Expected:
    """Return what must follow from a level that does not change while the pump runs.

    A constant roof level does not show whether water arrives.
    """
    if tank == "roof":
        return Expected(bound="roof frozen", signs=_pump("delivery"), recovery="latches")
    return Expected(bound="cistern frozen", signs=_level("cistern", "input_frozen"))


def _sensors(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        rig = f"site:{DRIVES[number % 4]}"
        for tank in ("cistern", "roof"):
            for fault, expected, parameter in (
                ("silent", Expected(bound="level", signs=_level(tank, "input_silent")), DEFAULT),
                ("absurd", Expected(bound="level", signs=_level(tank, "input_silent")), DEFAULT),
                ("noisy", Expected(bound="noisy", signs=_level(tank, "input_jump")), 1000),
                ("frozen", _still(tank), DEFAULT),
                ("drifting", Expected(bound="drift", signs=_level(tank, "input_jump")), 500),
            ):
                if fault in ("frozen", "drifting") and number >= 2:
                    continue
                yield Case(rig, "sensor", f"{tank}_{fault}", number, expected, parameter)
            for fault in WIRE:
                expected = _RUNS_ON if fault in ("slow", "split") else Expected(
                    bound="intermittent" if fault == "intermittent" else "level",
                    signs=_level(tank, "input_silent"))
                yield Case(rig, "sensor line", f"{tank}_{fault}", number, expected)
            yield Case(rig, "flapping", tank, number, Expected(
                bound="intermittent", signs=_level(tank, "input_silent")))
        for file in ("broken", "missing"):
            yield Case(rig, "forecast file", file, number, Expected(
                stops=False, signs=(("weather: forecast", "forecast_unreadable"),)))
        yield Case(rig, "forecast file", "old", number, Expected(
            bound="command",
            signs=(("weather: forecast", "forecast_missing"), *_pump("frost_unknown"))))
    for number, drive in enumerate(DRIVES):
        for fault in ("burst_pipe", "closed_valve"):
            yield Case(f"site:{drive}", "site", fault, number, Expected(
                bound="undelivered", signs=_pump("delivery"), recovery="latches"))
    # These leaks lower the level faster than pump and outlet can, so the level jumps meanwhile.
    for number, leak in enumerate((20_000, 50_000)):
        yield Case(f"site:{DRIVES[number]}", "site", "leak", number, Expected(
            bound="undelivered", signs=_pump("delivery"), recovery="latches"), leak)


_UNREADABLE: Sign = ("weather: forecast", "forecast_unreadable")


def _harmless() -> Iterator[Case]:
    """Yield the cases that must not stop the pump."""
    for number, drive in enumerate(DRIVES[:2]):
        for target, signs in (
            ("large", ()), ("an issue too large", (_UNREADABLE,)),
            ("short", (("weather: forecast", "forecast_short"),)),
            ("a null", ()), ("an empty member", ()), ("a short control run", ()),
        ):
            yield Case(f"lookahead:{drive}", "forecast file", target, number, Expected(
                stops=False, signs=signs, watch=20.0 if "large" in target else 5.0,
                never=() if signs == (_UNREADABLE,) else (_UNREADABLE,)))
        yield Case(f"empty:{drive}", "from the start", "roof level of -1 mm", number, Expected(
            stops=False, never=_level("roof", "input_refused")))
        yield Case(f"no forecast:{drive}", "from the start", "no forecast file", number, Expected(
            stops=False, signs=(("weather: forecast", "forecast_missing"),)))
        # The reading does not change for a while, although the level does.
        for tank, watch in (("cistern", 40.0), ("roof", 80.0)):
            yield Case(f"played:{drive}", "coarse", f"/{tank}/level", number, Expected(
                stops=False, watch=watch, never=_level(tank, "input_frozen")))
        # Surfaces hold back the rain, 2 mm.
        yield Case(f"catchment:{drive}", "coarse in rain", "/cistern/level", number, Expected(
            stops=False, watch=40.0, never=(("onoff: inputs", "input_frozen"),)))
        yield Case(f"site:{drive}", CHANGES, "onoff", number, _RUNS_ON)
        for node in NODES:
            yield Case(f"site:{drive}", "use_sim_time", node, number, _RUNS_ON)


def _state_files() -> Iterator[Case]:
    """Yield the cases of a killed pump node whose state file is lost or broken meanwhile."""
    for number, drive in enumerate(DRIVES):
        for target in ("moved away", "unfinished", "torn", "without starts"):
            yield Case(f"site:{drive}", "state file", target, number, Expected(
                bound="drive", signs=_pump("record_unknown"), recovery="latches"))


def _brokers(repeats: int) -> Iterator[Case]:
    """Yield the cases of sensors on MQTT and their broker."""
    level = Expected(bound="level", signs=_level("cistern", "input_silent"))
    lost, broker_lost = (
        tuple((f"{tank}_sensor: sensor", f"{what}_lost") for tank in ("cistern", "roof"))
        for what in ("sensor", "broker")
    )
    for number in range(repeats):
        rig = f"mqtt:{DRIVES[number % 4]}"
        for fault, expected in (
            ("killed", replace(level, signs=(*level.signs, *broker_lost))),
            # The broker may be back before the level is too old.
            ("restarted", Expected(stops=None, signs=broker_lost)),
            ("paused", level),
            ("half_open", level),
            ("retained", replace(level, signs=(*level.signs, lost[0]))),
            ("hostile", Expected(stops=None, bound="level", signs=lost[:1])),
        ):
            yield Case(rig, "broker", fault, number, expected)
        for tank, sensor in zip(("cistern", "roof"), lost, strict=True):
            for fault in ("silent", "absurd"):
                yield Case(rig, "sensor", f"{tank}_{fault}", number, Expected(
                    bound="level", signs=(*_level(tank), sensor)))
        yield Case(rig, "kill", "site_simulator", number, replace(
            level, signs=(*level.signs, *lost)))
        yield Case(rig, "stop long", "sensors", number, _process("sensors", "stop long"))


def _dry(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        yield Case(f"dry:{DRIVES[number % 4]}", "dry", "cistern", number, Expected(
            bound="filtered", signs=_pump("cistern_low"), recovery="stays"))


def _limits(repeats: int) -> Iterator[Case]:
    """Yield the cases of a command that never changes, which the pump's limits must stop."""
    for number in range(repeats):
        for limit, code, recovery in (
            ("greatest_run", "longest_run", "heals"),
            ("greatest_run_per_day", "daily_run", "stays"),
            ("greatest_volume_per_day", "daily_volume", "stays"),
        ):
            yield Case(f"{limit}:{DRIVES[number % 4]}", "stuck for ever", "/pump/command", number,
                       Expected(bound="limit", signs=_pump(code), recovery=recovery))


def _full_disk(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        yield Case(f"full disk:{DRIVES[number % 4]}", "full disk", "recorder", number, Expected(
            stops=False, bound="full disk", signs=(("recorder: recording", "not_recorded"),),
            watch=5.0))
        yield Case("simulated", "full disk", "recorder", number, Expected(
            stops=None, bound="supervised", names="No space left", recovery="ends"))


# --- topics ---------------------------------------------------------------------------------------

MODES = ("ok", "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")


def _badly() -> dict[tuple[str, str], Expected]:
    """Return what must follow from topics that are published badly; others have no effect.

    The controller uses its own command in place of /pump/flow, and the campaign's controller
    (on/off) needs no forecast.
    """
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
        # The meter reports no flow while a level falls: one of the two is wrong.
        ("/pump/meter", "wrong"): Expected(
            bound="undelivered", signs=_pump("delivery"), recovery="latches"),
        ("/gauge/temperature", "wrong"): Expected(bound="command", signs=_pump("frost")),
    }
    for tank in ("cistern", "roof"):
        name = f"/{tank}/level"
        badly |= {
            (name, "off"): Expected(bound="level", signs=_level(tank, "input_silent")),
            (name, "stuck"): _still(tank),
            (name, "garbage"): Expected(signs=_REFUSED[name]),
            (name, "wrong"): Expected(signs=_level(tank, "input_jump")),
            (name, "intermittent"): Expected(
                bound="intermittent", signs=_level(tank, "input_silent")),
        }
    for gauge in GAUGES:  # the forecast is used instead
        bad = Expected(stops=False, bound="gauge", signs=_REFUSED[gauge])
        badly |= {(gauge, "off"): bad, (gauge, "garbage"): bad}
    return badly


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
# Topics played by the campaign, by rig.
_ON = {
    "pump": ("/pump/command", *LEVELS), "played": PLAYED, "gauged": GAUGES,
    "metered": ("/pump/meter",), "flow": ("/pump/flow",),
}


def _topics(repeats: int) -> Iterator[Case]:
    badly = _badly()
    for rig, topics in _ON.items():
        for number in range(repeats):
            for topic in topics:
                for mode in MODES:
                    # These take a minute or more.
                    slow = mode == "stuck" and topic in LEVELS[:2]
                    slow |= mode == "off" and topic in ("/weather/frost", *GAUGES)
                    slow |= mode == "wrong" and topic == "/pump/meter"
                    if number >= (1 if mode == "ok" else 2 if slow else repeats):
                        continue
                    yield Case(f"{rig}:{DRIVES[number % 4]}", mode, topic, number,
                               badly.get((topic, mode), _RUNS_ON))
                yield Case(f"{rig}:{DRIVES[number % 4]}", "10000 hostile", topic, number, Expected(
                    stops=None, bound="gauge" if rig == "gauged" else "command",
                    signs=_REFUSED.get(topic, ())))


# --- intruders ------------------------------------------------------------------------------------

# Signs of two publishers, on the topics whose second publisher stops the pump; the others do not
# command the pump.
_OBEYED = {
    "/pump/command": _pump("command_unknown"),
    "/cistern/level": _level("cistern", "input_publishers"),
    "/roof/level": _level("roof", "input_publishers"),
    "/weather/frost": (*_pump("frost_unknown"), ("pump: frost", "input_publishers")),
}
_RECEIVED = (*FORECASTS, "/weather/precipitation", "/weather/evapotranspiration", "/pump/flow",
          "/pump/state", "/pump/meter", "/controller/cost", "/diagnostics")


_TWO_PUMPS = Expected(
    bound="command", signs=(*_pump("two_pumps"), ("pump: flow", "two_pumps")), names="/pump/flow")


def _intruders(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        rig = f"site:{DRIVES[number % 4]}"
        for topic, signs in _OBEYED.items():
            yield Case(rig, "intruder", topic, number, Expected(bound="command", signs=signs))
        for topic in _RECEIVED:
            yield Case(rig, "intruder", topic, number, _TWO_PUMPS if topic == "/pump/flow" else
                       Expected(stops=None))
        # Every topic that a live node receives, from any publisher: 10,000 hostile messages.
        for topic in (*_OBEYED, *_RECEIVED, *GAUGES):
            yield Case(rig, "10000 hostile", topic, number, Expected(
                stops=None, bound="command", signs=_OBEYED.get(topic, ())))
        yield Case(rig, "second pump node", "pump", number, Expected(
            stops=None, bound="command", watch=5.0, names="/pump/flow",
            signs=(("pump", "two_processes"), ("pump: flow", "two_pumps"))))
        for target in ("in another domain", "in another domain, temporary files removed"):
            yield Case(f"pump:{DRIVES[number % 4]}", "second pump node", target, number, Expected(
                stops=False, bound="command", watch=5.0, signs=(("pump: drive", "drive_lost"),)))
        yield Case(rig, "second controller", "onoff", number, Expected(
            bound="command", signs=_OBEYED["/pump/command"]))
        for target in ("bringup", "bringup, temporary files removed"):
            yield Case(rig, "second graph", target, number, Expected(stops=False))


# --- hardware in the loop, simulated --------------------------------------------------------------


def _loop(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        for process in ("pump", "bringup"):
            yield Case(f"loop:{DRIVES[number % 4]}", "stop short", process, number, _RUNS_ON)
        for fault in ("kill", "term", "stop long"):
            where = f"loop:{DRIVES[number % 4]}"
            yield Case(where, fault, "pump", number, Expected(
                bound="drive", names="pump", recovery="ends"))
            yield Case(where, fault, "bringup", number, Expected(
                bound="command", signs=_pump("command_unknown"),
            ) if fault == "stop long" else Expected(
                recovery="ends"))
        for topic in ("/clock", *_OBEYED, *FORECASTS, "/weather/precipitation", "/pump/flow"):
            for fault in ("intruder", "10000 hostile")[:1 if number else 2]:
                yield Case(f"loop:{DRIVES[number % 4]}", fault, topic, number, Expected(
                    bound="supervised", recovery="ends",
                    names=topic))
        yield Case(f"loop:{DRIVES[number % 4]}", "kill both", "pump and bringup", number, Expected(
            bound="drive", recovery="ends"))


# Weather topics that only the plant hears.
_OF_PLANT = ("/weather/precipitation", "/weather/evapotranspiration")
RELAYED = (*_OBEYED, *FORECASTS, *_OF_PLANT)


def _relayed(repeats: int) -> Iterator[Case]:
    """Yield the cases of relayed topics: a missing message stalls the tick, a late one delays it.

    A wrong level is accepted, because a plant could have it.
    """
    for number in range(repeats):
        for topic in RELAYED:
            hearer = "plant" if topic in _OF_PLANT else "onoff"
            refused = Expected(stops=topic not in _OF_PLANT, signs=_REFUSED.get(
                topic, ((f"{hearer}: refused", "values_refused"),)))
            wrong = {"/pump/command": refused, "/weather/frost": Expected(signs=_pump("frost"))}
            # The waiting nodes are known, so the first in the chain is named.
            stalled = Expected(
                bound="command", signs=(("plant", "node_failed"),), recovery="ends",
                names=topic if topic in _OF_PLANT else "/pump/command")
            for mode, expected in {
                "off": stalled,
                "stuck": _RUNS_ON,
                "garbage": refused,
                "wrong": wrong.get(topic, _RUNS_ON),
                "ok": _RUNS_ON,
                # Later than a command may be, but before the run ends: the pump slows down, but
                # runs on before it stands.
                "slow": Expected(stops=None, bound="command", signs=_pump("command_unknown")),
                # A one-second tick and these two delays are about as long as a command may be late.
                "delayed": Expected(stops=None, watch=6.0),
                "intermittent": replace(stalled, bound="intermittent"),
            }.items():
                if number and mode in ("ok", "slow", "delayed", "intermittent"):
                    continue
                yield Case(f"relayed:{DRIVES[number % 4]}", mode, topic, number, expected)


def _simulated(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        for fault in ("kill", "term", "stop short", "stop long"):
            yield Case("simulated", fault, "bringup", number, Expected(
                stops=None, bound="supervised",
                recovery="same" if fault.startswith("stop") else "ends"))
        for topic in ("/clock", *_OBEYED, *FORECASTS, *_OF_PLANT):
            for fault in ("intruder", "10000 hostile")[:1 if number else 2]:
                yield Case("simulated", fault, topic, number, Expected(
                    stops=None, bound="supervised", recovery="ends",
                    names=topic))
        for topic in ("/cistern/outflow", "/roof/drainage"):
            yield Case("simulated", "intruder", topic, number, Expected(
                stops=None, bound="supervised", recovery="either"))
        for fault, target in (("second graph", "bringup"), (CHANGES, "onoff")):
            yield Case("simulated", fault, target, number, Expected(stops=None, recovery="same"))


def _readers(blocks: int) -> Iterator[Case]:
    """Yield cases of four readers of /roof/level, stopped for 6.5 s and continued, in all ways."""
    for number in range(blocks):
        for way in ("simulated", "loop", "live"):
            yield Case("readers", f"four readers stopped {ROUNDS} times", way, number, Expected(
                stops=False, recovery="same"))


def _service() -> Iterator[Case]:
    for fault in FAULTS:
        if fault != NONE:
            yield Case("service", "fails", fault, 0, Expected(stops=False))


def all_cases() -> list[Case]:
    """Return the whole campaign."""
    every = tuple(_DRIVE)
    cases = [
        *_simulated(4),
        *_full_disk(2),
        *_processes(4),
        *_drive("site", every, 0, 1),
        *_drive("pump", every, 1, 2),
        *_drive("loop", every, 0, 1),
        *_drive("rtu", _SERIAL, 0, 1),
        *_drive_alone(1),
        *_timeouts(),
        *_relay(2),
        *_sensors(2),
        *_harmless(),
        *_state_files(),
        *_brokers(4),
        *_dry(4),
        *_limits(2),
        *_topics(3),
        *_intruders(2),
        *_loop(2),
        *_relayed(2),
        *_readers(4),
        *_service(),
    ]
    assert len({case.id for case in cases}) == len(cases)
    return cases
