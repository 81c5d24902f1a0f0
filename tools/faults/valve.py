"""The rig of an outlet valve: a live site without a pump, and the faults of its devices.

Cistern, sensors, valve and relay are simulated in a thread of the campaign, so their true state is
known at any time, whatever is killed.
"""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from brokers import Mosquitto
from faults.bounds import (
    BY_HAND_S,
    DRIVE_TIMEOUT_S,
    LEAK,
    LEAK_TOLERANCE_M,
    LIMIT_S,
    LONGEST_TRAVEL_S,
    MOVES,
    RELEASED_M3,
    SENSOR_S,
    TRAVEL_S,
    valve_bounds,
)
from faults.line import Cable
from faults.rig import RIGS, SHORTENED, START_S, Rig, wait
from faults.truth import Truth
from faults.watcher import Watcher
from graphs import Process, alive, free_ports
from places import CONFIG

from greenroof_ros.base.mqtt import parse_topic
from greenroof_ros.live.devices.drive_file import find_drive_file, read_relay_file
from greenroof_ros.live.devices.sensor_file import read_sensors
from greenroof_ros.live.simulators import site as simulated_site
from greenroof_ros.live.simulators.relay import SimulatedRelay, SimulatedValve
from greenroof_ros.live.simulators.site import SimulatedSite
from greenroof_ros.site.file import read_site

# Areas of the cistern (m2), so that its level hardly falls, and its level (m).
_AREA, _LEVEL = 50.0, 1.9
_SWITCHES = "open_switch", "closed_switch"
_RAIN, _FROST = 5e-3 / 3600, -5.0
_DAY_S = 86_400.0
# Time for which a relay has no power (s).
_POWER_CUT_S = 3.0
# The processes find the system clock ahead by the number in the file *wall* (s), and that the
# machine was suspended for the time in the file *slept* (s).
_CLOCKS = """
import time
from pathlib import Path
_here = Path(__file__).parent
_wall, _wall_ns, _clock = time.time, time.time_ns, time.clock_gettime
def _read(name):
    try:
        return float((_here / name).read_text())
    except (OSError, ValueError):
        return 0.0
time.time = lambda: _wall() + _read("wall")
time.time_ns = lambda: _wall_ns() + round(1e9 * _read("wall"))
time.clock_gettime = lambda clock: _clock(clock) + (
    _read("slept") if clock == time.CLOCK_BOOTTIME else 0.0
)
"""


class _Site(SimulatedSite):
    """A cistern whose sensors can be silent or wrong.

    Attributes:
        silent: sections of the sensors that give no reading.
        wrong: what sensors read instead of the true value, by section.
    """

    def __init__(self, *given: Any) -> None:
        self.silent, self.wrong = set[str](), dict[str, float]()
        super().__init__(*given)

    def _read(self, line: str, device_id: int) -> dict[int, int]:
        section = [*self._sensors][device_id - 1]
        return {} if section in self.silent else super()._read(line, device_id)

    def true(self, section: str) -> float:
        return self.wrong.get(section, super().true(section))


class _Relay(SimulatedRelay):
    """A relay that can be out of reach, or without power.

    Attributes:
        lost: whether it hears nothing.
    """

    lost = False

    def answer(self, topic: str, payload: str) -> None:
        if not self.lost:
            super().answer(topic, payload)


class Devices:
    """The devices of a site with a valve, in a thread of their own."""

    def __init__(self, rig: ValveRig, make: str) -> None:
        broker, device = parse_topic(f"{rig.broker.address}/valve", "at")
        file = read_relay_file(find_drive_file(make))
        self.relay = _Relay(file, broker, device, DRIVE_TIMEOUT_S)
        self.valve = SimulatedValve(lambda: self.relay.on, TRAVEL_S)
        self.site = _Site(
            rig.site, [0.0], [0.0], (_AREA * _LEVEL, 0.0), read_sensors(rig.sensors),
            lambda: 0.0, self.valve,
        )
        self._ready, self._thread = threading.Event(), threading.Thread(target=self._run)
        self._thread.daemon = True
        self._thread.start()
        assert self._ready.wait(START_S)

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        for server in self.site.servers:
            await server.open()
        self._ready.set()
        await asyncio.gather(self.site.run(self._ended), self.relay.run(self._ended))
        for server in self.site.servers:
            server.close()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(5)

    def fail(self, fault: str) -> None:
        """Let the valve fail from now on; empty ends the fault."""
        self.valve.fault = fault


class ValveTruth(Truth):
    """The true position of the valve, in place of a drive's speed."""

    def __init__(self, valve: SimulatedValve) -> None:
        self._valve = valve
        self.begin()

    def read(self) -> float:
        return self._valve.position

    def close(self) -> None:
        self._ended.set()
        self._thread.join(5)


class ValveRig(Rig):
    """A live site without a pump, whose valve hangs on a relay at a real broker.

    Attributes:
        switches: whether it has end switches.
        options: more options of ``greenroof live``.
        by_hand: whether a person keeps the valve open, which the controller keeps closed.
        broker: of the relay.
        cable: between the broker and the valve's node.
    """

    switches = by_hand = False
    options: tuple[str, ...] = ()
    parameters_of_valve: Mapping[str, float] = {}
    changes: Mapping[str, float] = {}

    def __init__(self, directory: Path, domain: int, drive: str, **special: Any) -> None:
        vars(self).update(special)
        self.directory, self.domain, self.drive_name = directory, domain, drive
        directory.mkdir(parents=True, exist_ok=True)
        self.site_file, self.parameters, self.sensors = (
            directory / f"{name}.yaml" for name in ("site", "nodes", "sensors")
        )
        self.site_file.write_text(yaml.safe_dump({
            "extends": str(CONFIG / "site_valve.yaml"), "irrigation": "none", "a1": _AREA,
            "wet_after": 0.001, "valve_travel_time": LONGEST_TRAVEL_S,
            "valve_moves_per_hour": 3600.0, **self.changes,
        }))
        self.site = read_site(self.site_file)
        self.parameters.write_text(yaml.safe_dump({
            f"/**/{node}": {"ros__parameters": {
                **SHORTENED, **(self.parameters_of_valve if node == "valve" else {}),
            }} for node in ("valve", "onoff", "weather")
        }))
        (port,) = free_ports(1)
        sections = "cistern", "rain_gauge", "thermometer", *(_SWITCHES if self.switches else ())
        self.sensors.write_text(yaml.safe_dump({
            name: {
                "address": f"tcp://127.0.0.1:{port}", "device_id": number, "register": 0,
                "kind": "input", "type": "float32", "word_order": "high first", "scale": 1.0,
                "low": -40.0 if name == "thermometer" else 0.0, "high": 60.0, "median": 1,
                "period": SENSOR_S,
            } for number, name in enumerate(sections, start=1)
        }))
        self.lines, self.players, self.site_simulator = {}, None, None
        self.started, self.ended_badly = set(), []
        self.output = directory / "state"
        self.broker = Mosquitto(directory)
        self.cable = Cable(self.broker.port)
        simulated_site.LEAK = LEAK
        self.devices = Devices(self, drive)
        self.truth = ValveTruth(self.devices.valve)
        self.watcher = Watcher(domain, actuator="valve")
        self.watchers = [self.watcher]
        self.clocks = directory / "clocks"
        self.clocks.mkdir()
        (self.clocks / "sitecustomize.py").write_text(_CLOCKS)
        self.main = self.bring_up()

    def bring_up(self) -> Process:
        at = f"mqtt://127.0.0.1:{self.cable.port}/valve"
        with _python_path(self.clocks):
            return Process(
                self.domain, "other_limits.live", "--controller", "onoff", *self.options,
                "--site", str(self.site_file), "--sensors", str(self.sensors),
                "--valve", self.drive_name, "--valve-at", at, "--state", str(self.output),
                "--node-parameters", str(self.parameters), cwd=self.directory,
            )

    def bounds(self) -> Mapping[str, float]:
        return valve_bounds(self.site)

    def runs(self) -> bool:
        """Return whether the valve is open, by its true position and by its node."""
        return self.truth.runs() and self.watcher.state in ("open", "opening")

    def until_guarded(self) -> None:
        """Open the valve by hand, if that is what this rig is for; its relay needs no wait."""
        if self.by_hand:
            wait(lambda: self.watcher.state, START_S, "a valve node")
            self.watcher.open_until(time.time() + _DAY_S)

    def kill_all(self) -> None:
        """Kill all processes of the site at once."""
        for pid in self.pids().values():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _end_main(self) -> list[str]:
        """End the processes under test, and return what is wrong with how they ended."""
        return [each for each in super()._end_main() if "shared memory" not in each]

    def __exit__(self, *failure: object) -> None:
        self.ended_badly = self._end_main()
        self.watcher.close()
        self.truth.close()
        self.devices.close()
        self.cable.close()
        self.broker.kill()


@contextmanager
def _python_path(directory: Path) -> Iterator[None]:
    """Let processes that are started in the block import from a directory first."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(directory), before)))
    try:
        yield
    finally:
        del os.environ["PYTHONPATH"]
        if before is not None:
            os.environ["PYTHONPATH"] = before


def begin_valve(rig: Rig, fault: str, undo: ExitStack) -> None:
    """Begin a fault of a site with a valve, and add its end to a stack."""
    assert isinstance(rig, ValveRig)
    devices, watcher, site = rig.devices, rig.watcher, rig.devices.site
    name, _, section = fault.partition(" of ")
    match name:
        case "frost" | "rain":
            sensor = {"frost": "thermometer", "rain": "rain_gauge"}[name]
            site.wrong[sensor] = _FROST if name == "frost" else _RAIN
            undo.callback(site.wrong.pop, sensor)
        case "silence":
            site.silent.add(section)
            undo.callback(site.silent.discard, section)
        case "hold":
            undo.callback(watcher.stop, False)
            watcher.stop(True)
        case "moves":
            _check_moves(rig, undo)
        case "relay lost":
            devices.relay.lost = True
            undo.callback(setattr, devices.relay, "lost", False)
        case "reboot":
            rig.kill_all()
            devices.relay.switch(False, 0.0)
            devices.relay.lost = True
            undo.callback(_start_again, rig)
        case "all killed":
            rig.kill_all()
        case "clock":
            ahead = {"forward": 2 * _DAY_S, "back": -2 * _DAY_S}[section]
            if rig.by_hand:
                undo.callback(rig.until_guarded)
                watcher.open_until(time.time() + BY_HAND_S)
            (rig.clocks / "wall").write_text(f"{ahead}")
            undo.callback((rig.clocks / "wall").unlink)
        case "suspend":
            slept = rig.clocks / "slept"
            before = float(slept.read_text()) if slept.exists() else 0.0
            slept.with_suffix(".new").write_text(f"{before + 3600.0}")
            slept.with_suffix(".new").replace(slept)
        case "stuck open" | "leak" | "wrong switch" | "stuck closed":
            _fail(rig, name.replace(" ", "_"), undo)


def _check_moves(rig: ValveRig, undo: ExitStack) -> None:
    """Close the valve, and check that it does not open again before it may."""
    valve = rig.devices.valve
    rig.watcher.stop(True)
    wait(lambda: valve.position == 0, 10, "a closed valve")
    rig.watcher.stop(False)
    wait(lambda: valve.position > 0, 2 * 7200 / MOVES, "an open valve")
    opened = time.monotonic()
    rig.watcher.stop(True)

    def release() -> None:
        rig.watcher.stop(False)
        wait(lambda: valve.position > 0, 2 * 7200 / MOVES, "an open valve")
        apart = time.monotonic() - opened
        assert apart > 7200 / MOVES - 1.0, f"the valve opened again after {apart:.1f} s"

    undo.callback(release)


def _start_again(rig: ValveRig) -> None:
    """Give the relay power again, and start the site."""
    time.sleep(_POWER_CUT_S)
    rig.devices.relay.lost = False
    rig.main.process.wait(20)
    wait(lambda: not any(map(alive, rig.started)), 20, "the end of all processes")
    rig.main = rig.bring_up()


def _fail(rig: ValveRig, fault: str, undo: ExitStack) -> None:
    """Let the valve fail, and give the order that it does not follow."""
    watcher, valve = rig.watcher, rig.devices.valve
    undo.callback(watcher.stop, False)
    undo.callback(rig.devices.fail, "")
    if fault != "stuck_open":
        watcher.stop(True)
        wait(lambda: valve.position == 0, 10, "a closed valve")
    if fault == "leak":  # it counts as closed only after its travel time
        time.sleep(LONGEST_TRAVEL_S)
    rig.devices.fail(fault)
    if fault == "stuck_open":
        watcher.stop(True)
    elif fault == "stuck_closed":
        watcher.stop(False)


RIGS |= {
    "valve": partial(ValveRig, parameters_of_valve={"leak_tolerance": LEAK_TOLERANCE_M}),
    "valve with switches": partial(ValveRig, switches=True),
    "valve by hand": partial(ValveRig, by_hand=True, options=("--outlet", "closed")),
    "valve moves": partial(ValveRig, changes={"valve_moves_per_hour": MOVES}),
    "valve max_run": partial(ValveRig, parameters_of_valve={"max_run": LIMIT_S}),
    "valve max_volume_per_day": partial(
        ValveRig, parameters_of_valve={"max_volume_per_day": RELEASED_M3},
    ),
}
