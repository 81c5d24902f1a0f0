"""Rigs for the cases: a live site, a pump node alone, or a simulation with a drive."""

from __future__ import annotations

import getpass
import os
import random
import re
import signal
import subprocess
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from brokers import Mosquitto, Talker
from disks import disk_that_fails, fill, small_disk
from faults.bounds import DRIVE_TIMEOUT_S, LIMIT_S, RAMP_S, bounds
from faults.cases import GAUGES, LEVELS, PLAYED, Sign
from faults.line import Cable, Line
from faults.players import Players
from faults.truth import AT_REST, Truth
from faults.watcher import Watcher
from graphs import Process, alive, free_ports
from places import CONFIG, guarding
from pump_rig import settings_for
from ros_rig import write_forecast

from greenroof_ros.interface.alarm import Alarm, read_alarms
from greenroof_ros.live.devices.modbus_line import Address, parse_address
from greenroof_ros.physics.pump import flow_at
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

START_S = 60.0
# Time after its power-up for which an ABB's own timeout is not effective (s).
_UNGUARDED_S = 30.0
# Time from the simulated drive's power-up until it answers (s).
BOOT_S = 2.0
# Parameters that differ from their defaults, so that a stopped pump runs again soon. No bound
# depends on them.
SHORTENED = {"recovery_time": 1.0}
PUMP_SHORTENED = {
    **SHORTENED, "min_on": 1.0, "min_off": 1.0,
    "local_settings_stop_the_pump": True,  # as the simulated Grundfos is set
}
# The paper's site, but with a roof that takes an hour to fill: ten times its target.
_TARGET = 0.45
_CISTERN_M3, _ROOF_M3 = 73.0, 0.5
CONTROLLER = "onoff"
_CISTERN_TOPIC = "cistern/sensor/level/state"
_NONSENSE = ("", "NaN", "1e999", "-3", "true", "null", "2.5", "{", "[2.5]", "[" * 30_000)


class BrokenError(Exception):
    """The rig cannot be used any more."""


def wait(condition: Callable[[], Any], seconds: float, what: str) -> None:
    """Wait for a condition.

    Raises:
        BrokenError: it is not met in time.
    """
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            raise BrokenError(f"{what} within {seconds:g} s")
        time.sleep(0.02)


def leftover(pids: Collection[int], seconds: float = 12.0) -> list[int]:
    """Return the processes that have not ended within a time (s)."""
    until = time.monotonic() + seconds
    while any(map(alive, pids)) and time.monotonic() < until:
        time.sleep(0.05)
    return [pid for pid in pids if alive(pid)]


def site_file(directory: Path, **changes: float) -> Path:
    """Write the campaign's site file, with changed values."""
    text = (CONFIG / "site.yaml").read_text()
    values = {"z_veg": _TARGET, "starts_per_hour": 3600.0, **changes}
    for name, value in values.items():
        text, count = re.subn(rf"(?m)^{name}: \S+", f"{name}: {value!r}", text)
        assert count == 1, name
    path = directory / "site.yaml"
    path.write_text(text)
    return path


def _has_shared_memory(pid: int) -> bool:
    """Return whether a process uses shared memory, which a stopped process could hold."""
    try:
        return "/dev/shm/fastrtps" in Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return False  # it has ended


class Simulator:
    """A simulated drive or site as a process, which can be restarted at the same address."""

    def __init__(self, domain: int, directory: Path, module: str, *options: str) -> None:
        self._start = (domain, directory, module, options)
        self.start()

    def start(self, *more: str) -> None:
        """Start it, or start it again; ``powered_at`` is when (s, `time.monotonic`)."""
        domain, directory, module, options = self._start
        self.process = Process(domain, module, *options, *more, cwd=directory)
        wait(
            lambda: self.process.stdout().startswith("ready:")
            or self.process.process.poll() is not None, START_S, f"no {module}",
        )
        self.ready = self.process.stdout().partition("\n")[0]
        if not self.ready.startswith("ready:"):
            raise BrokenError(f"{module}: {self.process.stderr()}")
        self.powered_at = time.monotonic()

    @property
    def place(self) -> str:
        """The address of a drive."""
        return self.ready.split()[2].rstrip(",")

    def end(self) -> None:
        popen = self.process.process
        if popen.poll() is None:
            popen.send_signal(signal.SIGCONT)
            popen.terminate()
            popen.wait(10)


class Rig:
    """A pump on a simulated drive, and everything around it.

    Attributes:
        watcher: the campaign's node in the graph.
        truth: the true state of the drive.
        watchers: all that listen for the campaign: `watcher`, and a case's own in another domain.
        output: directory of bringup's summary and alarms, if there is a bringup.
        lines: lines to the level sensors that can fail, by tank.
    """

    pump_parameters: Mapping[str, float | bool] = PUMP_SHORTENED
    nodes: tuple[str, ...] = ("pump", CONTROLLER, "weather")
    as_shipped = False
    serial = False
    site_changes: Mapping[str, float] = {}

    def __init__(self, directory: Path, domain: int, drive: str, **special: Any) -> None:
        """Start the drive.

        Args:
            directory: for all files of the rig.
            domain: of the graph.
            drive: make of the drive.
            special: attributes that differ from the usual ones.
        """
        vars(self).update(special)
        self.directory, self.domain, self.drive_name = directory, domain, drive
        directory.mkdir(parents=True, exist_ok=True)
        self.site_file = site_file(directory, **self.site_changes)
        self.site: Site = read_site(self.site_file)
        self.parameters = directory / "nodes.yaml"
        self.parameters.write_text(yaml.safe_dump({
            f"/**/{node}": {"ros__parameters": dict(
                self.pump_parameters if node == "pump" else SHORTENED
            )} for node in self.nodes
        }))
        self.lines: dict[str, Line] = {}
        # Otherwise the node would wait after each connection, for drives unguarded at power-up.
        self.drive_file = drive if self.as_shipped else guarding(drive, directory)
        (bench,) = free_ports(1)
        self.drive = Simulator(
            domain, directory, "drive_simulator", "--drive", self.drive_file, "--ramp", "1",
            "--boot", f"{BOOT_S:g}", *self._place(), "--workbench", str(bench),
            "--site", str(self.site_file),
        )
        self.drive_at = self.drive.place
        self._bench = f"tcp://127.0.0.1:{bench}"
        self.site_simulator: Simulator | None = None
        self.started: set[int] = set()
        self.ended_badly: list[str] = []
        self.output = directory / "state"
        self.players: Players | None = None
        site_bench = self.start_site()
        self.truth = Truth(parse_address(self._bench), site_bench)
        self.watcher = Watcher(self.domain)
        self.watchers = [self.watcher]
        self.main = self.bring_up()

    def _place(self) -> tuple[str, ...]:
        """Return the options that give the drive's place."""
        return ("--serial", "pty") if self.serial else ("--port", str(*free_ports(1)))

    def start_site(self) -> Address | None:
        """Start the site, if the rig has one; return its workbench, otherwise None."""
        return None

    def bring_up(self) -> Process:
        """Start what is under test, and return its main process."""
        raise NotImplementedError

    def pids(self) -> dict[str, int]:
        """Return the process of each node, by the node's name, and of ``bringup``."""
        pids = {"bringup": self.main.process.pid}
        with suppress(OSError):  # it has ended
            pids |= self.main.nodes()
        self.started.update(pids.values())
        return pids

    def bounds(self) -> Mapping[str, float]:
        """Return each bound by its name (s)."""
        return bounds(self.site)

    def runs(self) -> bool:
        """Return whether the pump runs, by its true speed and by its node."""
        return self.truth.runs() and self.watcher.state in ("running", "starting")

    def until_guarded(self) -> None:
        """Wait until the drive's own timeout works, which may take some time after power-up.

        The node's own wait for it is switched off, except in cases about it.
        """
        if self.as_shipped or self.drive_name != "abb_acs880":
            return
        until = self.drive.powered_at + BOOT_S + _UNGUARDED_S
        time.sleep(max(0.0, until - time.monotonic()))

    def until_running(self, seconds: float = START_S, steady_s: float = 0.0) -> None:
        """Wait until the pump runs, and has run without a break for ``steady_s``.

        Raises:
            BrokenError: it does not run in time.
        """
        until = time.monotonic() + seconds
        while not self.runs() or self.truth.steady_for() < steady_s:
            if self.main.process.poll() is not None:
                raise BrokenError(f"bringup ended: {self.main.stderr()[-600:]}")
            if time.monotonic() > until:
                present_texts = {who: text for who, text in self.watcher.last.items()
                        if not text.startswith("OK")}
                raise BrokenError(
                    f"the pump did not run within {seconds:.0f} s (speed {self.truth.speed:.2f}): "
                    f"{present_texts}; {self.main.stderr()[-300:]}"
                )
            time.sleep(0.02)

    def signs(self, since: float, alarms: int = 0) -> set[Sign]:
        """Return the signs on /diagnostics since a time, and of alarms from a number on."""
        return self._reported(since) | {
            (alarm.name.lstrip("/"), alarm.code) for alarm in self._recorded()[alarms:]
        }

    def _recorded(self) -> list[Alarm]:
        """Return the recorded alarms; none if the disk fails."""
        with suppress(OSError):
            return read_alarms(self.output)
        return []

    def _reported(self, since: float) -> set[Sign]:
        """Return the signs since a time; a case's own watcher hears that case alone."""
        return {
            sign for watcher in self.watchers for at, sign in list(watcher.signs)
            if at >= since or watcher is not self.watcher
        }

    def alarms(self) -> int:
        """Return the number of recorded alarms so far."""
        return len(self._recorded())

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *failure: object) -> None:
        self.ended_badly = self._end_main()
        if self.players is not None:
            self.players.close()
        self.watcher.close()
        self.truth.close()
        self.drive.end()
        if self.site_simulator is not None:
            self.site_simulator.end()
        for line in self.lines.values():
            line.close()

    def _end_main(self) -> list[str]:
        """End the processes under test, and return what is wrong with how they ended."""
        wrong = []
        pids = set(self.pids().values()) | self.started
        if any(map(_has_shared_memory, pids)):
            wrong.append("a process has shared memory")
        main = self.main.process
        if main.poll() is None:
            main.send_signal(signal.SIGCONT)
            main.terminate()
            try:
                code = main.wait(25)
                if code not in (0, 130):
                    wrong.append(f"exit code {code} after SIGTERM")
            except subprocess.TimeoutExpired:
                wrong.append("still there 25 s after SIGTERM")
                main.kill()
                main.wait()
        for pid in leftover(pids):
            wrong.append(f"process {pid} is left")
            os.kill(pid, signal.SIGKILL)
        until = time.monotonic() + 2 * RAMP_S
        while self.truth.speed > AT_REST and time.monotonic() < until:
            time.sleep(0.05)
        if self.truth.speed > AT_REST and self.drive.process.process.poll() is None:
            wrong.append(f"the pump runs on at {self.truth.speed:.2f}")
        if "Traceback" in self.main.stderr():
            wrong.append("a traceback in the output")
        return wrong


class SiteRig(Rig):
    """A live site by bringup; sensors and drive are simulated programs behind Modbus.

    Attributes:
        forecast_h: hours of the forecast; 0 for no file.
        roof_read: keys of the roof's sensor with which only the node reads it.
    """

    cistern_m3, roof_m3 = _CISTERN_M3, _ROOF_M3
    controller = CONTROLLER
    forecast_h = 48
    roof_read: Mapping[str, float] = {}

    def start_site(self) -> Address:
        file, read = (self.directory / f"{name}.yaml" for name in ("sensors", "sensors-read"))
        for path, sensors in zip((file, read), self._sensors(), strict=True):
            path.write_text(yaml.safe_dump(sensors))
        (bench,) = free_ports(1)
        self.csv = self.directory / "levels.csv"
        self.site_simulator = Simulator(
            self.domain, self.directory, "site_simulator", "--sensors", str(file), "--drive-at",
            self._bench, "--workbench", str(bench), "--site", str(self.site_file),
            "--cistern", str(self.cistern_m3),
            "--roof", str(self.roof_m3), "--output", str(self.csv),
        )
        self.forecast = self.directory / "forecast.csv"
        if self.forecast_h:
            write_forecast(self.forecast, hours=self.forecast_h)
        self._options = (
            "--controller", self.controller, "--site", str(self.site_file),
            "--sensors", str(read), "--forecast", str(self.forecast),
            "--drive", self.drive_file, "--drive-at", self.drive_at,
            "--state", str(self.output), "--node-parameters", str(self.parameters),
        )
        return Address("127.0.0.1", bench)

    def _sensors(self) -> tuple[Any, Any]:
        """Return the file of the simulated sensors, and the file with which the nodes read them."""
        sensors, by_line = (
            yaml.safe_load((CONFIG / "sensors.yaml").read_text()) for _ in range(2)
        )
        for tank in ("cistern", "roof"):
            port, behind = free_ports(2)
            sensors[tank]["address"] = f"tcp://127.0.0.1:{behind}"
            self.lines[tank] = Line(port, behind)
            by_line[tank]["address"] = f"tcp://127.0.0.1:{port}"
        by_line["roof"] |= self.roof_read
        return sensors, by_line

    def bring_up(self) -> Process:
        wait(lambda: self.truth.samples, 10, "no speed of the drive")
        return Process(self.domain, "other_limits.live", *self._options, cwd=self.directory)

    def levels(self) -> tuple[float, float]:
        """Return the true levels of cistern and roof (m)."""
        # After a restart of the simulator its table has only a head at first.
        wait(lambda: self.csv.read_text().count("\n") > 1, 10, "no level of the site")
        _, cistern, roof = self.csv.read_text().splitlines()[-1].split(",")[:3]
        return float(cistern), float(roof)

    def water(self) -> tuple[str, ...]:
        """Return the options with which the site's simulator continues from the present levels."""
        cistern, roof = self.levels()
        return ("--cistern", repr(cistern * self.site.a1), "--roof", repr(roof * self.site.a2))

    @property
    def dry_level(self) -> float:
        """The cistern level at which the pump is stopped (m)."""
        return self.site.suction_level + settings_for(self.site).level_offset


class RelayRig(SiteRig):
    """A live site with a relay on MQTT, and a cable from the pump node to the broker."""

    def _place(self) -> tuple[str, ...]:
        self.broker = Mosquitto(self.directory)
        self.cable = Cable(self.broker.port)
        return ("--at", f"{self.broker.address}/roof", "--timeout", f"{DRIVE_TIMEOUT_S:g}")

    def bring_up(self) -> Process:
        self._options = tuple(
            option.replace(f":{self.broker.port}/", f":{self.cable.port}/")
            for option in self._options
        )
        return super().bring_up()

    def __exit__(self, *failure: object) -> None:
        super().__exit__(*failure)
        self.cable.close()
        self.broker.kill()


class GaugedRig(SiteRig):
    """A live site with a weather station, which the campaign plays."""

    def bring_up(self) -> Process:
        self.players = Players(self.watcher, self.truth, self.site, GAUGES)
        return super().bring_up()


class MqttRig(SiteRig):
    """A live site with sensors on MQTT.

    Attributes:
        broker: of the sensors; it keeps retained messages when it ends.
        cable: between the broker and the nodes.
    """

    def _sensors(self) -> tuple[Any, Any]:
        self.broker = Mosquitto(
            self.directory, "allow_anonymous true", "persistence true",
            f"persistence_location {self.directory}/", f"user {getpass.getuser()}",
        )
        self.cable = Cable(self.broker.port)
        text = (CONFIG / "sensors_mqtt.yaml").read_text()
        return tuple(
            yaml.safe_load(text.replace(":1883/", f":{port}/"))
            for port in (self.broker.port, self.cable.port)
        )

    def publish_retained(self) -> None:
        """Publish the cistern's level once more, as a retained message."""
        with Talker(self.broker) as talker:
            talker.publish(_CISTERN_TOPIC, f"{self.levels()[0]:.4f}", retain=True)

    def publish_nonsense(self, count: int, rng: random.Random) -> None:
        """Publish this many payloads that are no level, as another client with write access."""
        with Talker(self.broker) as talker:
            for _ in range(count):
                talker.publish(_CISTERN_TOPIC, rng.choice(_NONSENSE))

    def __exit__(self, *failure: object) -> None:
        super().__exit__(*failure)
        self.cable.close()
        self.broker.kill()


class FullDiskRig(SiteRig):
    """A live site whose bag is on a small disk that can be filled."""

    def bring_up(self) -> Process:
        self._disk = ExitStack()
        self._disk.enter_context(small_disk(self.output / "bag", "2m"))
        return super().bring_up()

    def fill(self) -> None:
        """Fill the disk to its last byte."""
        fill(self._other())

    def free(self) -> None:
        """Make room again."""
        self._other().unlink()

    def _other(self) -> Path:
        return self.output / "bag" / "other"

    def __exit__(self, *failure: object) -> None:
        super().__exit__(*failure)
        self._disk.close()


class FailingDiskRig(SiteRig):
    """A live site whose state is on a disk that can fail."""

    def bring_up(self) -> Process:
        self._disk = ExitStack()
        self.fail_disk = self._disk.enter_context(disk_that_fails(self.output))
        return super().bring_up()

    def __exit__(self, *failure: object) -> None:
        super().__exit__(*failure)
        self._disk.close()


class PlayedRig(Rig):
    """A live site with external nodes for levels and weather, which the campaign plays."""

    topics = PLAYED
    nodes = ("pump", CONTROLLER)

    def bring_up(self) -> Process:
        self.players = Players(self.watcher, self.truth, self.site, self.topics)
        return Process(
            self.domain, "other_limits.live", "--controller", CONTROLLER,
            "--site", str(self.site_file), "--sensors", "external", "--weather", "external",
            *self._pump(), "--state", str(self.output),
            "--node-parameters", str(self.parameters), cwd=self.directory,
        )

    def _pump(self) -> tuple[str, ...]:
        return ("--drive", self.drive_file, "--drive-at", self.drive_at)


class OwnDriverRig(SiteRig):
    """A live site with a user's own pump driver: another pump node, under the name of `driver`."""

    nodes = (CONTROLLER, "weather")

    def bring_up(self) -> Process:
        drive = self._options.index("--drive")
        self._options = (*self._options[:drive], "--pump", "external", *self._options[drive + 4 :])
        main = super().bring_up()
        self.start_driver()
        return main

    def start_driver(self) -> None:
        self.driver = pump_node(self, name="driver")

    def pids(self) -> dict[str, int]:
        return {**super().pids(), "driver": self.driver.process.pid}

    def runs(self) -> bool:
        return self.truth.runs()

    def _end_main(self) -> list[str]:
        self.pids()  # of all that have been started
        self.driver.process.terminate()
        self.driver.wait(60)
        return super()._end_main()


def pump_node(rig: Rig, domain: int | None = None, name: str = "pump") -> Process:
    """Start only a pump node at a rig's drive."""
    options = {
        **{name: str(value).lower() for name, value in rig.pump_parameters.items()},
        "site_file": rig.site_file, "drive": rig.drive_file,
        "address": rig.drive_at,
        "state_file": rig.directory / f"pump-{domain}.json",
    }
    return Process(
        rig.domain if domain is None else domain, "live.pump", "--ros-args",
        "-r", f"__node:={name}",
        *(word for name, value in options.items() for word in ("-p", f"{name}:={value}")),
        cwd=rig.directory,
    )


class PumpRig(Rig):
    """The pump node alone, without a supervisor; the campaign plays all other nodes."""

    topics: tuple[str, ...] = ("/pump/command", *LEVELS)

    def bring_up(self) -> Process:
        self.players = Players(self.watcher, self.truth, self.site, self.topics)
        return pump_node(self)


RIGS: dict[str, Callable[[Path, int, str], Rig]] = {
    "site": SiteRig, "own driver": OwnDriverRig, "mqtt": MqttRig, "relay": RelayRig,
    "gauged": GaugedRig,
    "full disk": FullDiskRig, "failing disk": FailingDiskRig, "played": PlayedRig, "pump": PumpRig,
    # Water for half a minute.
    "dry": partial(SiteRig, cistern_m3=19.5),
    # A controller that uses all members of the forecast; an empty roof whose sensor reads -1 mm; no
    # forecast file, but a thermometer; much rain for the cistern.
    "lookahead": partial(
        SiteRig, controller="lookahead", nodes=("pump", "lookahead", "weather"), forecast_h=168,
        # With lookahead, bringup itself sets the pump's min_on.
        pump_parameters={name: PUMP_SHORTENED[name] for name in PUMP_SHORTENED if name != "min_on"},
    ),
    "empty": partial(SiteRig, roof_m3=0.0, roof_read={"offset": -0.001, "low": -0.001}),
    "no forecast": partial(GaugedRig, forecast_h=0),
    "catchment": partial(
        PlayedRig, topics=(*PLAYED, GAUGES[0]), site_changes={"a_in": 1000.0}),
    # With a flow meter; on a serial line (two pseudo-terminals); with the drive file as shipped.
    "metered": partial(PumpRig, topics=(*PumpRig.topics, "/pump/meter")),
    "rtu": partial(PumpRig, serial=True),
    "guarded": partial(PumpRig, as_shipped=True),
    # Limits a run, or the volume of a day, to a few seconds of pumping.
    **{
        limit: partial(PumpRig, pump_parameters={**PUMP_SHORTENED, limit: most})
        for limit, most in {
            "max_run": LIMIT_S,
            "max_volume_per_day":
                LIMIT_S * flow_at(read_site(CONFIG / "site.yaml"), 1.0, 2.9),
        }.items()
    },
}
