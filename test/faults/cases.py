"""Every case of the campaign: what is done to what, and what must come of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

SIMULATED, LOOP, LIVE = "simulated", "hardware in the loop", "live"
DRIVES = ("danfoss_fc202", "abb_acs880", "grundfos_cim500", "schneider_atv630")


@dataclass(frozen=True)
class Expected:
    """What must come of a fault.

    Attributes:
        stops: the pump must stop within the bound; False: it must run on; None: either.
        bound: name of one of `bounds.bounds`.
        alarm: regular expression of what must be said; empty where nothing need be.
        recovery: ``heals``: the pump runs again by itself; ``latches``: only after ~/reset;
            ``either``; ``stays``: it stays off; ``ends``: bringup ends, and all with it; of a
            simulation ``same``: it runs to its end, with the same bag; ``goes on``: likewise, and
            another process takes the node's place.
        watch: how long the pump must run on (s).
    """

    stops: bool | None = True
    bound: str = "step"
    alarm: str = ""
    recovery: str = "heals"
    watch: float = 3.0


@dataclass(frozen=True)
class Case:
    """One fault.

    Attributes:
        rig: kind of rig and drive, such as ``site:abb_acs880``; cases of one rig follow each other.
        fault: what is done, such as ``kill``.
        target: to what.
        number: of the repetition.
        parameter: of the fault, if it has one.
    """

    rig: str
    fault: str
    target: str
    number: int
    expected: Expected
    parameter: int | None = None

    @property
    def way(self) -> str:
        kind = self.target if self.rig == "readers" else self.rig.partition(":")[0]
        return {"simulated": SIMULATED, "restarting": SIMULATED, "loop": LOOP}.get(kind, LIVE)

    @property
    def id(self) -> str:
        return f"{self.rig}/{self.fault}/{self.target.strip('/').replace('/', '.')}/{self.number}"


# --- processes ------------------------------------------------------------------------------------

NODES = ("onoff", "weather", "cistern_sensor", "roof_sensor", "pump", "recorder")


def _process(node: str, fault: str) -> Expected:
    """Return what must come of a fault of a process of a live site."""
    if fault == "stop short":
        return Expected(stops=False, alarm="")
    ended = rf"{node} (ended|is missing|is starting|waits)|{node} had not answered|{node} is silent"
    if node == "recorder":
        return Expected(stops=False, alarm=r"recorder (ended|had not answered)", watch=12.0)
    if node == "bringup":
        if fault == "stop long":
            return Expected(bound="permit", alarm=r"bringup has given no permit")
        alarm = "interrupted by SIGTERM" if fault == "term" else ""
        return Expected(bound="permit", alarm=alarm, recovery="ends")
    if node == "pump":
        bound = {"kill": "drive", "term": "permit", "stop long": "drive"}[fault]
        return Expected(bound=bound, alarm=r"pump (ended|had not answered)")
    return Expected(bound="silent" if fault == "stop long" else "permit", alarm=ended)


def _processes(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        for fault in ("kill", "term", "stop short", "stop long"):
            for node in (*NODES, "bringup"):
                yield Case(f"site:{DRIVES[0]}", fault, node, number, _process(node, fault))
    for number in range(repeats // 2):
        for fault in ("kill", "stop long"):
            yield Case(f"site:{DRIVES[0]}", fault, "drive_simulator", number, Expected(
                stops=None, bound="drive", alarm=r"no connection to the drive|the drive"))
            yield Case(f"site:{DRIVES[0]}", fault, "site_simulator", number, Expected(
                bound="level", alarm=r"/(cistern|roof)/level|sensor"))


# --- the drive ------------------------------------------------------------------------------------

_LOST = r"no connection to the drive|the drive: |drive at"
_DRIVE: dict[str, Expected] = {
    "refused": Expected(bound="drive", alarm=_LOST),
    "dropped": Expected(bound="drive", alarm=_LOST),
    "half_open": Expected(bound="drive", alarm=_LOST),
    "silence": Expected(bound="drive", alarm=_LOST),
    "slow": Expected(stops=False),
    "late": Expected(bound="drive", alarm=_LOST),
    "split": Expected(stops=False),
    "garbage": Expected(bound="drive", alarm=_LOST),
    "wrong_unit": Expected(bound="drive", alarm=_LOST),
    "wrong_function": Expected(bound="drive", alarm=_LOST),
    "wrong_length": Expected(bound="drive", alarm=_LOST),
    "absurd_value": Expected(bound="follow", alarm=r"the speed|the drive: ", recovery="either"),
    "exception": Expected(bound="drive", alarm=_LOST),
    "drive_fault": Expected(bound="drive", alarm=r"the drive reports", recovery="latches"),
    "power_cycle": Expected(bound="drive", alarm=_LOST, recovery="either"),
    "timeout_off": Expected(bound="drive", alarm=r"communication timeout"),
    "local": Expected(bound="drive", alarm=r"local control"),
}
# The motor does not stop, whatever it is told: there must be an alarm, and the fault latches.
_UNSTOPPABLE = ("speed_stays", "stuck_running", "contactor")


def _drive(way: str, drives: tuple[str, ...], repeats: int) -> Iterator[Case]:
    for drive in drives:
        for number in range(repeats):
            for fault, expected in _DRIVE.items():
                if not (fault == "local" and drive == "grundfos_cim500"):
                    yield Case(f"{way}:{drive}", "drive", fault, number, expected)
            for fault in _UNSTOPPABLE:
                yield Case(f"{way}:{drive}", "unstoppable", fault, number, Expected(
                    bound="follow", alarm=r"told to stop|contactor", recovery="latches"))


# --- sensors and weather --------------------------------------------------------------------------


def _sensors(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        for tank in ("cistern", "roof"):
            for fault, expected, parameter in (
                ("silent", Expected(bound="level", alarm=rf"/{tank}/level|{tank}_sensor"), None),
                ("absurd", Expected(bound="level", alarm=rf"/{tank}/level|{tank}_sensor"), None),
                ("noisy", Expected(bound="level", alarm=rf"/{tank}/level jumped"), 1000),
                ("frozen", Expected(bound=f"{tank} frozen", alarm=rf"/{tank}/level is frozen"),
                 None),
                ("drifting", Expected(bound="drift", alarm=rf"/{tank}/level jumped"), 500),
            ):
                if fault in ("frozen", "drifting") and number >= (repeats + 1) // 2:
                    continue
                yield Case(f"site:{DRIVES[0]}", "sensor", f"{tank}_{fault}", number, expected,
                           parameter)
        for file in ("broken", "missing"):
            yield Case(f"site:{DRIVES[0]}", "forecast file", file, number, Expected(
                stops=False, alarm=r"forecast"))
        yield Case(f"site:{DRIVES[0]}", "forecast file", "old", number, Expected(
            bound="command", alarm=r"forecast|frost"))
    for number in range(max(1, repeats // 3)):
        for fault, parameter in (("burst_pipe", None), ("leak", 20000)):
            yield Case(f"site:{DRIVES[0]}", "site", fault, number, Expected(
                bound="undelivered", alarm=r"delivery|jumped", recovery="either"), parameter)


def _dry(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        yield Case(f"dry:{DRIVES[number % 4]}", "dry", "cistern", number, Expected(
            bound="filtered", alarm=r"the cistern is at .* below", recovery="stays"))


# --- topics ---------------------------------------------------------------------------------------

MODES = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")
_RUNS_ON = Expected(stops=False)


def _topic(topic: str, mode: str, rig: str) -> Expected:
    """Return what must come of a topic that is published badly."""
    name = topic
    if topic in ("/cistern/level", "/roof/level"):
        return {
            "off": Expected(bound="level", alarm=name),
            "stuck": Expected(bound=f"{topic.split('/')[1]} frozen", alarm=f"{name} is frozen"),
            "garbage": Expected(alarm=name),
            "wrong": Expected(alarm=f"{name} jumped"),
            "intermittent": Expected(bound="intermittent", alarm=name),
        }.get(mode, _RUNS_ON)
    if topic == "/weather/frost":
        return {
            "off": Expected(bound="frost", alarm=name),
            "garbage": Expected(alarm=name),
            "wrong": Expected(alarm="there is frost"),
        }.get(mode, _RUNS_ON)
    if topic == "/pump/command":
        return {
            "off": Expected(bound="command", alarm="no command has come"),
            "garbage": Expected(alarm="/pump/command was refused|command .* is refused"),
            "wrong": Expected(alarm="/pump/command was refused|command .* is refused"),
            "slow": Expected(bound="command", alarm="no command has come"),
            "intermittent": Expected(bound="intermittent", alarm="no command has come"),
        }.get(mode, _RUNS_ON)
    return {"garbage": Expected(bound="command", alarm=name)}.get(mode, _RUNS_ON)


_LEVELS = ("/cistern/level", "/roof/level", "/weather/frost")
_PLAYED = (*_LEVELS, "/forecast/precipitation", "/forecast/evapotranspiration")


def _topics(repeats: int) -> Iterator[Case]:
    for rig, topics in (("pump", ("/pump/command", *_LEVELS)), ("played", _PLAYED)):
        for number in range(repeats):
            for topic in topics:
                for mode in MODES:
                    slow = mode == "stuck" and topic in _LEVELS[:2]
                    slow |= mode == "off" and topic == "/weather/frost"
                    if slow and number >= (repeats + 2) // 3:
                        continue
                    yield Case(f"{rig}:{DRIVES[number % 4]}", mode, topic, number,
                               _topic(topic, mode, rig))
                yield Case(f"{rig}:{DRIVES[number % 4]}", "10000 hostile", topic, number, Expected(
                    stops=None, alarm=topic, bound="command"))
    for number in range(repeats):
        for topic in ("/gauge/precipitation", "/gauge/temperature"):
            yield Case(f"site:{DRIVES[0]}", "10000 hostile", topic, number, Expected(
                stops=None, alarm=r"gauge|thermometer|frost"))


# --- intruders ------------------------------------------------------------------------------------

# What stops while there are two publishers; of the others nobody takes the pump's orders.
_OBEYED = ("/pump/command", "/cistern/level", "/roof/level", "/weather/frost",
           "/forecast/precipitation", "/forecast/evapotranspiration")
_HEARD = ("/weather/precipitation", "/weather/evapotranspiration", "/pump/flow", "/pump/state",
          "/pump/meter", "/controller/cost", "/diagnostics")


def _intruders(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        for topic in _OBEYED:
            yield Case(f"site:{DRIVES[0]}", "intruder", topic, number, Expected(
                bound="command", alarm=rf"{topic}.* publishers"))
        for topic in _HEARD:
            yield Case(f"site:{DRIVES[0]}", "intruder", topic, number, Expected(stops=None))
        yield Case(f"site:{DRIVES[0]}", "second pump node", "pump", number, Expected(
            bound="start", alarm=r"/pump/flow has 2 publishers"))
        yield Case(f"site:{DRIVES[0]}", "second controller", "onoff", number, Expected(
            bound="command", alarm=r"/pump/command.* publishers"))
        yield Case(f"site:{DRIVES[0]}", "second graph", "bringup", number, Expected(stops=False))


# --- hardware in the loop, simulated --------------------------------------------------------------

_LOOP_NODES = ("plant", "weather", "controller", "pump", "recorder", "bringup")


def _loop(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        for node in _LOOP_NODES:
            yield Case(f"loop:{DRIVES[number % 4]}", "stop short", node, number, _RUNS_ON)
        for fault in ("kill", "term", "stop long"):
            for node in _LOOP_NODES:
                bound = "drive" if node == "pump" else "supervised"
                alarm = "" if node == "bringup" else rf"{_called(node)}"
                if node == "bringup":
                    bound = "permit"
                    if fault == "stop long":
                        alarm = "bringup has given no permit"
                recovery = "heals" if (node, fault) == ("bringup", "stop long") else "ends"
                yield Case(f"loop:{DRIVES[number % 4]}", fault, node, number, Expected(
                    bound=bound, alarm=alarm, recovery=recovery))
        for topic in ("/clock", *_OBEYED, "/weather/precipitation", "/pump/flow"):
            yield Case(f"loop:{DRIVES[number % 4]}", "intruder", topic, number, Expected(
                bound="supervised", recovery="ends",
                alarm=rf"publisher of {topic}|{topic} has 2 publishers"))


def _called(node: str) -> str:
    return "onoff" if node == "controller" else node


_SIMULATED_NODES = ("plant", "weather", "controller", "recorder")


def _simulated(repeats: int) -> Iterator[Case]:
    for number in range(repeats):
        for fault in ("kill", "term", "stop short", "stop long"):
            for node in (*_SIMULATED_NODES, "bringup"):
                if node == "bringup" and fault.startswith("stop"):
                    alarm, recovery = "", "same"
                else:
                    alarm = "SIGTERM" if (node, fault) == ("bringup", "term") else (
                        "" if node == "bringup" else _called(node))
                    recovery = "same" if fault == "stop short" else "ends"
                yield Case("simulated", fault, node, number, Expected(
                    stops=None, bound="supervised", alarm="" if recovery == "same" else alarm,
                    recovery=recovery))
        for topic in ("/clock", *_OBEYED, "/weather/precipitation", "/weather/evapotranspiration"):
            yield Case("simulated", "intruder", topic, number, Expected(
                stops=None, bound="supervised", recovery="ends",
                alarm=f"publisher of {topic}|{topic} has 2 publishers"))
        for topic in ("/cistern/outflow", "/roof/drainage"):
            yield Case("simulated", "intruder", topic, number, Expected(
                stops=None, bound="supervised", recovery="either"))
        yield Case("simulated", "second graph", "bringup", number, Expected(
            stops=None, recovery="same"))


def _restarting(repeats: int) -> Iterator[Case]:
    """With --on-node-failure restart another process takes the node's place."""
    for number in range(repeats):
        for fault in ("kill", "term", "stop long"):
            for node in ("weather", "controller", "recorder"):
                yield Case("restarting", fault, node, number, Expected(
                    stops=None, bound="supervised", recovery="goes on"))


def _readers(stops: int) -> Iterator[Case]:
    """Four readers of /roof/level, stopped for 6.5 s and continued, in all three ways at once."""
    for number in range(stops):
        for way in ("simulated", "loop", "live"):
            yield Case("readers", "four readers stopped", way, number, Expected(
                stops=False, recovery="same"))


def all_cases() -> list[Case]:
    """Return the whole campaign, in the order in which it is worked through."""
    cases = [
        *_simulated(8),
        *_processes(6),
        *_drive("site", DRIVES, 4),
        *_drive("loop", DRIVES, 1),
        *_sensors(4),
        *_dry(4),
        *_topics(4),
        *_intruders(4),
        *_loop(4),
        *_restarting(4),
        *_readers(200),
    ]
    assert len({case.id for case in cases}) == len(cases)
    return cases
