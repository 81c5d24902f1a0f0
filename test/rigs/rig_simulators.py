"""The package's simulators with faults, as programs: ``-m rig_simulators drive_simulator ...``.

Faults are requested at a workbench, a Modbus device, number 247, on a TCP port of its own. So it
can be reached while the drive refuses its clients, has no power or is on a serial line.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import os
import pty
import random
import secrets
import signal
import sys
import threading
import time
import tty
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pymodbus.pdu import ExceptionResponse
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.transport import CommType

from greenroof_ros.base.command_line import add_site, command
from greenroof_ros.live.devices.drive_file import DriveFile, find_drive_file
from greenroof_ros.live.devices.exchange import read_endpoint
from greenroof_ros.live.devices.modbus_line import (
    WIDTHS,
    Address,
    DriveError,
    ModbusLine,
    Serial,
    parse_address,
)
from greenroof_ros.live.devices.relay import RelayEndpoint
from greenroof_ros.live.devices.sensor_file import ModbusSensor, default_sensors, read_sensors
from greenroof_ros.live.simulators.drive import SimulatedDrive, drive_server
from greenroof_ros.live.simulators.relay import SimulatedRelay
from greenroof_ros.live.simulators.server import Server, make_device
from greenroof_ros.live.simulators.site import SimulatedSite
from greenroof_ros.physics.parameters import State
from greenroof_ros.physics.pump import flow_at
from greenroof_ros.physics.start import initial_states
from greenroof_ros.simulation.options import add_site_arguments, build_run
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

# Functions that write.
WRITES = (5, 6, 15, 16, 22, 23)
DEVICE_ID = 247
BENCH = Serial(19200, "even", 1, DEVICE_ID)
# Registers of the workbench. The parameter of a fault is written before the fault.
SPEED, FAULT, PARAMETER, LOCAL, CISTERN_LEVEL = range(5)
SPEED_UNIT = LEVEL_UNIT = 1e-4
DEFAULT = 0xFFFF  # as a parameter: the fault's default
NONE = "none"
# Each fault, with the default of its parameter; its number is its place.
FAULTS: Mapping[str, int] = {
    NONE: 0,
    # Of the wire.
    "refused": 0,  # connections are refused, and existing ones are closed
    "dropped": 0,  # every request closes its connection
    "half_open": 0,  # connections are accepted, but no request gets through
    "silence": 0,  # requests are obeyed, but never answered
    "slow": 200,  # answers come late, but in time (ms)
    "late": 1500,  # answers come after the client has given up (ms)
    "split": 5,  # answers come byte by byte (ms between two)
    "trickle": 1000,  # the same, too slowly
    "previous": 0,  # each request gets the answer to the one before, as its own
    "previous_frame": 0,  # the same, with the number of the request before
    "garbage": 16,  # this many random bytes come instead of answers
    "wrong_unit": 0,  # answers come from the next device id
    "wrong_function": 0,  # answers are to the next function code
    "wrong_length": 0,  # answers lack their last byte
    "exception": 4,  # every request is refused with this code
    "refused_writes": 6,  # every write is refused with this code
    "echo": 0,  # no request gets through, and the line returns what is sent
    # Of the drive.
    "absurd_value": 0x7FFF,  # the speed register reads this
    "drive_fault": 0,  # it trips (code or bits; 0: the first of its file), and cannot be reset
    "speed_stays": 0,  # the speed stays as it is
    "stuck_running": 0,  # the motor runs on, whatever it is ordered (0.01 %; 0: as it is)
    "power_cycle": 0,  # it loses power for a moment, once
    "timeout_off": 0,  # its communication timeout, or the relay's timer, is turned off, for good
    "frozen": 0,  # it obeys, but all registers read as they were
    "says_stopped": 0,  # it reports off and rest, but runs on as it did until its timeout
    "says_running": 0,  # it reports that it runs as ordered, but the motor stands
    "runs_on": 0,  # ordered to stop it reports off, but runs until its timeout; connections last s
    # Of the relay.
    "timer_long": 120,  # its timer is set to this (s), for good
    "timer_off": 0,  # its timer is turned off, for good
    "power_up_on": 0,  # it is set to be on after power-up, for good
    "deaf": 0,  # it answers, but only its timer switches it
    "auto_on": 0,  # a Shelly is set to switch itself on again after off, for good
    "welded": 0,  # the contact no longer opens; the relay reports what was ordered
    # Of cistern and roof: parameters in counts of 0.1 mm, raw values, or per minute.
    **{f"{tank}_{fault}": default for tank, noise, drift in (("cistern", 500, 100),
                                                             ("roof", 100, 50))
       for fault, default in (("frozen", 0), ("silent", 0), ("absurd", 0xFFFE), ("noisy", noise),
                              ("drifting", drift))},
    "burst_pipe": 0,  # pumped water does not arrive on the roof
    "leak": 500,  # the cistern loses water (ml/s)
    "closed_valve": 0,  # the pump moves no water, however it runs
}
NUMBERS = {name: number for number, name in enumerate(FAULTS)}


@dataclass
class ActiveFault:
    """The present fault and its parameter; changed at run time."""

    name: str = NONE
    parameter: int = 0
    last: tuple[bytes, int] = (b"", 0)  # the last answer, and the number of its request


class FaultyConnection(ServerRequestHandler):
    """One connection of a client, with the faults of the wire.

    Args:
        hear: receives each request, and returns whether the device answers at all.
    """

    _random = random.Random(0)

    def __init__(self, server, *, fault: ActiveFault, hear=lambda request: True) -> None:
        super().__init__(server, None, None, None)
        self._fault, self._hear = fault, hear
        self._started_at = time.monotonic()

    async def handle_request(self) -> None:
        request, fault = self.last_pdu, self._fault
        if request is None or fault.name == "half_open":
            return
        if fault.name == "echo":
            self.pdu_send(request)
            return
        writes = request.function_code in WRITES
        lasts_s = fault.parameter if fault.name == "runs_on" else 0
        lasted = 0 < lasts_s < time.monotonic() - self._started_at
        # 'runs_on' never ends a connection at an order: *stop* must be known to have arrived.
        if fault.name == "dropped" or (lasted and not writes):
            if self.comm_params.comm_type != CommType.SERIAL:
                self.transport.abort()
        elif not self._hear(request):
            return
        elif fault.name == "exception" or (fault.name == "refused_writes" and writes):
            self.pdu_send(ExceptionResponse(
                request.function_code, fault.parameter, device_id=request.dev_id,
                transaction=request.transaction_id,
            ))
        else:
            await super().handle_request()

    def pdu_send(self, pdu, addr=None) -> None:
        """Send an answer, altered by the present fault."""
        fault, device_id = self._fault, pdu.dev_id
        content = bytes([pdu.function_code]) + pdu.encode()
        match fault.name:
            case "wrong_unit":
                device_id = device_id % 247 + 1
            case "wrong_function":
                content = bytes([content[0] + 1]) + content[1:]
            case "wrong_length":
                content = content[:-1]
        number, (last, last_number) = pdu.transaction_id, fault.last
        fault.last = content, number
        if fault.name.startswith("previous"):
            content = last
            number = last_number if fault.name == "previous_frame" else number
        frame = self.framer.encode(content, device_id, number)
        match fault.name:
            case "silence":
                return
            case "garbage":
                self._write_data(self._random.randbytes(fault.parameter))
            case "slow" | "late":
                self.loop.call_later(fault.parameter / 1000, self._write_data, frame)
            case "split" | "trickle":
                for number in range(len(frame)):
                    delay = number * fault.parameter / 1000
                    self.loop.call_later(delay, self._write_data, frame[number:number + 1])
            case _:
                self._write_data(frame)

    def _write_data(self, data: bytes) -> None:
        if self.transport is not None:
            self.transport.write(data)


class PseudoLine:
    """A simulated serial line: two pseudo-terminals, joined.

    Attributes:
        ends: the paths of its two ends, each a device that can be opened as a serial line.
    """

    def __init__(self) -> None:
        pairs = [pty.openpty() for _ in range(2)]
        for _, device in pairs:
            tty.setraw(device)
        # The devices stay open here, so an end can be closed and opened again.
        self._masters, self._devices = zip(*pairs, strict=True)
        self.ends = tuple(os.ttyname(device) for device in self._devices)
        for master in self._masters:
            os.set_blocking(master, False)

    def join(self) -> None:
        """Forward, in the running event loop, what is sent at either end."""
        loop = asyncio.get_running_loop()
        for source, target in (self._masters, self._masters[::-1]):
            loop.add_reader(source, self._forward, source, target)

    @staticmethod
    def _forward(source: int, target: int) -> None:
        data = os.read(source, 4096)
        with contextlib.suppress(BlockingIOError):  # no one reads: lost, as on a real line
            os.write(target, data)


class Bench:
    """A simulator and its workbench, which run until someone ends them."""

    addresses = ""

    def __init__(self, workbench: Address) -> None:
        self.fault = ActiveFault()
        self.registers = dict.fromkeys(range(5), 0) | {PARAMETER: DEFAULT}
        self.servers: list[Server] = []
        device = make_device(DEVICE_ID, self.read_registers, self._write)
        self._workbench = Server(workbench, [device], BENCH)
        self._started_at = time.monotonic()

    async def run(self, ended: asyncio.Event) -> None:
        raise NotImplementedError

    def read_registers(self) -> Mapping[int, int]:
        return self.registers

    def write_register(self, register: int, value: int) -> None:
        self.registers[register] = value

    def inject(self, name: str, parameter: int) -> None:
        """Replace the present fault."""
        self.fault.name = name
        self.fault.parameter = FAULTS[name] if parameter == DEFAULT else parameter
        self.registers |= {FAULT: NUMBERS[name], PARAMETER: parameter}
        self.log(f"fault {name}")

    def log(self, text: str) -> None:
        print(f"{time.monotonic() - self._started_at:9.2f} s  {text}", flush=True)

    async def serve(self) -> None:
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        for server in (self._workbench, *self.servers):
            await server.open()
        print(f"ready: {self.addresses}; workbench {self._workbench.address}, device {DEVICE_ID}",
              flush=True)
        await self.run(ended)
        for server in (*self.servers, self._workbench):
            server.close()

    def _write(self, address: int, values) -> None:
        for register, value in enumerate(values, address):
            if register == FAULT:
                self.inject([*FAULTS][value], self.registers[PARAMETER])
            else:
                self.write_register(register, value)


# --- drive ----------------------------------------------------------------------------------------


class FaultyDrive(SimulatedDrive):
    """A drive with faults, a panel, and a power supply that can fail.

    Attributes:
        boot_s: from power-up until it answers (s).
        local: whether someone has taken it over at its panel.
    """

    boot_s = 3.0
    local = False
    _active, _parameter = NONE, 0
    _answers_from = _guarded_from = -math.inf

    @property
    def answers(self) -> bool:
        """Whether it has power and has booted."""
        return time.monotonic() >= self._answers_from

    def turn(self, step: float, target: float) -> None:
        off = self._at < self._answers_from
        stays = self._ignores_stop or self._active == "says_stopped"
        if self._active in ("speed_stays", "stuck_running") or (stays and not off):
            return
        stands = off or self.local or self._active == "says_running"
        super().turn(step, 0.0 if stands else target)

    @property
    def _ignores_stop(self) -> bool:
        """Whether it is ordered to stop and reports that it is off, but runs on."""
        off = not self.on or self.local or not self.setpoint
        return self._active == "runs_on" and off and self._at >= self._answers_from

    @property
    def _reported_speed(self) -> float:
        if self._active == "says_running":
            return self.setpoint if self.on else 0.0
        return 0.0 if self._active == "says_stopped" else self.speed

    def trip(self, fault: int) -> None:
        if fault or self._active != "drive_fault":
            super().trip(fault)

    def communication_lost(self) -> None:
        if self._active in ("runs_on", "says_stopped"):
            self._active = NONE
        super().communication_lost()

    def _loss_at(self) -> float:
        return max(super()._loss_at(), self._guarded_from)

    def status(self) -> int:
        shown, self.speed = self.speed, 0.0 if self._ignores_stop else self.speed
        word, remote = super().status(), self._file.status.remote
        self.speed = shown
        if self.local and remote is not None and remote.fulfilled_by(word):
            word ^= remote.mask & -remote.mask
        return word

    def registers(self) -> Mapping[int, int]:
        self.on_request()
        if self._active == "frozen":
            return self._frozen
        true, self.speed = self.speed, self._reported_speed
        words = super().registers()
        self.speed = true
        if self._active == "absurd_value":
            self._words |= dict.fromkeys(self._addresses("speed"), self._parameter)
        return words

    def inject(self, name: str, parameter: int) -> None:
        """Replace the present fault; a trip remains until it is reset."""
        self._frozen = dict(self.registers())
        self._active, self._parameter = name, parameter
        match name:
            case "drive_fault":
                codes = self._file.faults
                first = next(iter(codes.texts), 1)
                self.trip(parameter or (1 << first if codes.kind == "bits" else first))
            case "stuck_running":  # as with a welded contactor
                self.speed = parameter * SPEED_UNIT or self.speed or 0.5
            case "power_cycle":
                self.power_cycle()
            case "timeout_off":  # as someone could at the panel
                if self.timeout.action is not None:
                    self.write_raw(self.timeout.action.register, 0)
                else:
                    self.write_raw(self.timeout.register, 0)

    def power_cycle(self) -> None:
        """Lose power for a moment: the motor stops, and nothing answers until it has booted."""
        self.advance()
        self._answers_from = self._at + self.boot_s
        # After power-up the timeout of an ABB is not effective for a while.
        self._guarded_from = self._answers_from + 30.0 * ("ABB" in self._file.make)
        self._last_request, self.lost = math.inf, False
        self.trip(0)
        self.switch_off()
        for name in ("control", "reference"):
            self.write_raw(name, 0)
        self.log(f"power cycle: answers again in {self.boot_s:g} s")


class DriveBench(Bench):
    """Runs a drive on its own port or line."""

    def __init__(
        self, file: DriveFile, address: Address, workbench: Address, site: Site,
        timeout_s: float = 5.0,
    ) -> None:
        super().__init__(workbench)
        self._line = PseudoLine() if address.line == "pty" else None
        reached = address if self._line is None else Address(line=self._line.ends[0])
        self._reached = replace(reached, gateway=not reached.line and "tcp" not in file.timeout)
        self.drive = FaultyDrive(file, self._reached.interface, timeout_s)
        self.drive.log = self.log
        self.drive.flow = lambda speed: flow_at(
            site, speed, self.registers[CISTERN_LEVEL] * LEVEL_UNIT
        )
        level = site.cistern_level(next(iter(initial_states(site).values()))[0])
        self.registers[CISTERN_LEVEL] = round(level / LEVEL_UNIT)
        (self._server,) = self.servers = [drive_server(self.drive, file, self._reached)]
        self._server.connection = partial(FaultyConnection, fault=self.fault, hear=self._hear)
        self._device_id = file.serial.device_id_at(self._reached)

    @property
    def addresses(self) -> str:
        address = replace(self._server.address, gateway=self._reached.gateway)
        end = self._line.ends[1] if self._line is not None else address
        return f"drive {end}, device {self._device_id}"

    def inject(self, name: str, parameter: int) -> None:
        super().inject(name, parameter)
        self.drive.inject(name, self.fault.parameter)

    async def run(self, ended: asyncio.Event) -> None:
        if self._line is not None:
            self._line.join()
        while not ended.is_set():
            self.drive.advance()
            if self._answers:
                await self._server.open()
            elif self._line is None:
                self._server.close()
            await asyncio.sleep(0.01)

    @property
    def _answers(self) -> bool:
        return self.drive.answers and self.fault.name != "refused"

    def _hear(self, request) -> bool:
        """Count even a request that a fault keeps from the drive as a sign of life."""
        if self._answers:
            self.drive.on_request()
        return self._answers

    def read_registers(self) -> Mapping[int, int]:
        self.drive.advance()
        return self.registers | {SPEED: round(self.drive.speed / SPEED_UNIT)}

    def write_register(self, register: int, value: int) -> None:
        if register == LOCAL:
            self.drive.advance()
            self.drive.local = bool(value)
        super().write_register(register, value)


# --- relay ----------------------------------------------------------------------------------------

# What a fault changes of the settings in the relay's replies; a path is of one make.
_SETTINGS: Mapping[str, Mapping[str, object]] = {
    "timer_off": {"PulseTime1.Set": 0, "result.auto_off": False},
    "timer_long": {"result.auto_off": True},
    "auto_on": {"result.auto_on": True},
    "power_up_on": {"PowerOnState": 3, "result.initial_state": "on"},
}


class RelayBench(Bench, SimulatedRelay):
    """Runs a relay at a broker."""

    _stuck = False

    def __init__(self, endpoint: RelayEndpoint, timer_s: float, boot_s: float, workbench) -> None:
        Bench.__init__(self, workbench)
        SimulatedRelay.__init__(
            self, endpoint.file, endpoint.broker, endpoint.device, timer_s
        )
        self._boot_s, self._answers_from = boot_s, -math.inf
        self.addresses = f"drive {endpoint}, relay"

    run = SimulatedRelay.run

    @property
    def speed(self) -> float:
        return float(self.on or self._stuck)

    def switch(self, on: bool, seconds: float) -> None:
        if self.fault.name != "deaf":
            super().switch(on, seconds)
        self._stuck = self.fault.name == "welded" and (self._stuck or self.on)

    def read_registers(self) -> Mapping[int, int]:
        return self.registers | {SPEED: round(self.speed / SPEED_UNIT)}

    def write_register(self, register: int, value: int) -> None:
        if register == LOCAL:
            self.switch(bool(value), self.timer_s)
        else:
            super().write_register(register, value)

    def inject(self, name: str, parameter: int) -> None:
        super().inject(name, parameter)
        self._stuck = name == "welded" and self.on
        changed = _SETTINGS.get(name, {})
        self.settings |= {path: changed[path] for path in changed.keys() & self.settings.keys()}
        match name:
            case "power_cycle":
                self._answers_from = time.monotonic() + self._boot_s
                self.switch(False, 0.0)
            case "timer_off":
                self.timer_s = math.inf
            case "timer_long":
                self.set_timer(float(self.fault.parameter))

    def answer(self, topic: str, payload: str) -> None:
        if time.monotonic() < self._answers_from:
            return
        late_s = self.fault.parameter / 1000 if self.fault.name == "late" else 0.0
        for answer_topic, answer in self.receive(topic, payload):
            if self.fault.name == "garbage":
                answer = secrets.token_bytes(self.fault.parameter).decode("latin-1")
            if self.fault.name != "silence":
                self._loop.call_later(late_s, self.client.publish, answer_topic, answer)


# --- site -----------------------------------------------------------------------------------------


class DistantPump:
    """The speed of a pump at another rig's workbench, which gets the cistern's level."""

    def __init__(self, address: Address, level, log) -> None:
        self.speed, self._lost = 0.0, False
        self._line = ModbusLine(address, BENCH, 1.0)
        self._level, self._log = level, log

    def update(self) -> None:
        """Read the speed, and write the level."""
        try:
            if not self._line.connected:
                self._line.connect()
            self.speed = self._line.read(SPEED, 1)[0] * SPEED_UNIT
            depth = round(self._level() / LEVEL_UNIT)
            self._line.write(CISTERN_LEVEL, min(max(depth, 0), 0xFFFF))
            self._lost = False
        except DriveError as error:
            self.speed = 0.0
            self._line.close()
            if not self._lost:
                self._log(f"{error}: the pump is assumed to be stopped")
            self._lost = True

    def poll(self) -> None:
        """Update it again and again, in a thread of its own."""
        while True:
            time.sleep(0.02)
            self.update()


class SiteBench(Bench, SimulatedSite):
    """Runs cistern and roof in dry weather behind their sensors; can write a line for each tick."""

    def __init__(
        self, site: Site, volumes, sensors, workbench: Address, drive: Address | None = None,
        output=None,
    ) -> None:
        Bench.__init__(self, workbench)
        pump = drive and DistantPump(drive, lambda: self.virtual_site.levels()[0], self.log)
        SimulatedSite.__init__(
            self, site, [0.0], [0.0], volumes, sensors, lambda: pump.speed if pump else 0.0,
        )
        self._fault_since, self._frozen, self._output = 0, dict[str, float](), output
        for server in self.servers:  # each has its own sensors
            there = {
                section: sensor for section, sensor in self._sensors.items()
                if isinstance(sensor, ModbusSensor)
                and parse_address(sensor.address) == server.address
            }
            server.connection = partial(
                FaultyConnection, fault=self.fault, hear=partial(self._hear, there)
            )
        if pump is not None:
            pump.update()
            threading.Thread(target=pump.poll, daemon=True).start()
        if output is not None:
            print("time_s,cistern_level_m,roof_level_m", file=output, flush=True)

    run, addresses = SimulatedSite.run, SimulatedSite.addresses

    def inject(self, name: str, parameter: int) -> None:
        self._fault_since, self._frozen = self.virtual_site.tick, {}
        super().inject(name, parameter)

    def _has_fault(self, section: str, name: str) -> bool:
        return self.fault.name == f"{section}_{name}"

    def _hear(self, sensors, request) -> bool:
        return not any(
            self._has_fault(section, "silent")
            and (sensor.device_id, sensor.register) == (request.dev_id, request.address)
            for section, sensor in sensors.items()
        )

    def words(self, section: str, sensor) -> list[int]:
        if self._has_fault(section, "absurd"):
            return [self.fault.parameter] * WIDTHS[sensor.type]
        return super().words(section, sensor)

    def raw(self, section: str) -> float | None:
        if self._has_fault(section, "silent"):
            return None
        if self._has_fault(section, "absurd"):
            return self.fault.parameter
        if not self._has_fault(section, "frozen"):
            return super().raw(section)
        return self._frozen.setdefault(section, super().raw(section))

    def true(self, section: str) -> float:
        value, parameter = super().true(section), self.fault.parameter
        if self._has_fault(section, "noisy"):
            value += random.gauss(0.0, parameter * LEVEL_UNIT)
        elif self._has_fault(section, "drifting"):
            minutes = (self.virtual_site.tick - self._fault_since) * self._site.tau / 60
            value += minutes * parameter * LEVEL_UNIT
        return value

    def flow(self, speed: float) -> float:
        return 0.0 if self.fault.name == "closed_valve" else super().flow(speed)

    def step(self, flow: float) -> None:
        super().step(flow)
        site, tau = self.virtual_site, self._site.tau
        x1, x2, layer = site.state
        if self.fault.name == "burst_pipe":
            x2 = max(0.0, x2 - tau * self._flowing)
        elif self.fault.name == "leak":
            x1 = max(0.0, x1 - tau * self.fault.parameter * 1e-6)
        site.state = State(x1, x2, layer)
        if self._output is not None:
            print(site.tick * tau, *site.levels(), sep=",", file=self._output, flush=True)


# --- programs -------------------------------------------------------------------------------------


def local(port: int) -> Address:
    return Address(host="127.0.0.1", port=port)


def drive_simulator(parser: argparse.ArgumentParser) -> None:
    for name in ("drive", "serial", "at"):
        parser.add_argument(f"--{name}")
    for name, default in (("port", 5020), ("workbench", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    for name, seconds in (("ramp", 5.0), ("boot", 3.0), ("timeout", 5.0), ("speed", 1.0)):
        parser.add_argument(f"--{name}", type=float, default=seconds)
    add_site(parser)
    given = parser.parse_args()
    path, workbench = find_drive_file(given.drive), local(given.workbench)
    endpoint = read_endpoint(path, given.at or "tcp://127.0.0.1", "--at")
    if isinstance(endpoint, RelayEndpoint):
        bench: Bench = RelayBench(endpoint, given.timeout, given.boot, workbench)
    else:
        address = Address(line=given.serial) if given.serial else local(given.port)
        drive_bench = DriveBench(
            endpoint.file, address, workbench, read_site(given.site), given.timeout
        )
        drive_bench.drive.boot_s = given.boot
        drive_bench.drive.ramp_s = given.ramp / given.speed
        bench = drive_bench
    asyncio.run(bench.serve())


def site_simulator(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sensors", type=Path)
    parser.add_argument("--drive-at", type=parse_address)
    parser.add_argument("--workbench", type=int, default=0)
    parser.add_argument("--output", type=Path)
    add_site_arguments(parser.add_argument_group("site"))
    given = parser.parse_args()
    run = build_run(given)
    sensors = read_sensors(given.sensors or default_sensors())
    with given.output.open("w") if given.output else contextlib.nullcontext() as output:
        bench = SiteBench(
            run.site, (run.x1, run.x2), sensors, local(given.workbench), given.drive_at, output,
        )
        asyncio.run(bench.serve())


@command
def main() -> None:
    """Run the program that the first argument names."""
    programs = {"drive_simulator": drive_simulator, "site_simulator": site_simulator}
    programs[sys.argv.pop(1)](argparse.ArgumentParser())


if __name__ == "__main__":
    main()
