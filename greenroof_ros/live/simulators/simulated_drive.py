"""A simulated drive: what all makes have in common, registers, ramp, faults and timeout.

A subclass in `control_profiles` adds what a make does with its control word. A `SimulatedDrive`
does not wait or speak Modbus, and gets the time from a clock. A `DriveBench` runs one in real time,
on its own port or line, with a workbench next to it.
"""

from __future__ import annotations

import asyncio
import enum
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from pymodbus.constants import ExcCodes

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.live.devices.drive_file import DriveFile, Register
from greenroof_ros.live.devices.modbus_line import SIMULATOR, Address, decode, encode
from greenroof_ros.live.simulators import faults
from greenroof_ros.live.simulators.server import Bench, Device, PseudoLine, Server
from greenroof_ros.model.initial_state import default_state
from greenroof_ros.model.pump_speed import flow_at
from greenroof_ros.model.site import Site

_RATED_RPM = 1500
_RATED_FREQUENCY = 500
"""0.1 Hz"""
_AT_SPEED = 0.01
_STUCK_AT = 0.5
# Interval at which a bench moves its drive (s); the name of the line that is a pseudo-terminal.
_STEP_S, _PTY = 0.01, "pty"


class Motion(enum.Enum):
    """What the drive does with its motor."""

    FOLLOW = "ramps to its reference"
    HOLD = "keeps its speed"
    RAMP_DOWN = "ramps to rest"
    COAST = "lets it coast"


@dataclass(frozen=True)
class DriveSettings:
    """The settings and properties of a simulated drive.

    Attributes:
        ramp_s: from rest to rated speed, and back (s).
        coast_s: from rated speed to rest without torque (s).
        boot_s: from power-up until it answers (s).
        timeout_s: its communication timeout (s), which then stops it, rounded to the steps of
            its register; None for the factory setting.
        speed: ramps and coasting are faster by this factor; no other time is.
    """

    ramp_s: float = 5.0
    coast_s: float = 2.0
    boot_s: float = 3.0
    timeout_s: float | None = 5.0
    speed: float = 1.0


class SimulatedDrive(ABC):
    """A drive with its motor.

    Attributes:
        speed: of the motor (share of rated).
        flow: returns what the pump delivers at a speed (m3/s), for drives that report it.
        log: reports what happens, for people.
        settings: the settings and properties.
        timeout: the communication timeout of the interface in use.
        guard: raw time and action of that timeout now in force.
        local: whether control is at the panel.
        lost: whether the bus was silent for longer than the timeout.
        fault: code, or bits, of the active fault; 0 for none.
        last_fault: the last fault that tripped it.
        loss: the fault after the timeout.
        word: the control word.
        state: of its state machine, if it has one.
    """

    DELIVERED: ClassVar[tuple[int, int]]
    """time and action of the timeout, factory settings (raw)"""
    TRIPS: ClassVar[tuple[int, ...]] = ()
    """actions of the timeout that trip the drive; the first is the one that is set"""
    LOSS: ClassVar[Mapping[str, int]] = {}
    """code, or bits, of the fault after the timeout of each interface"""
    UNGUARDED_S: ClassVar[float] = 0.0
    """the timeout is not effective for this long after power-up (s)"""
    RESET: ClassVar[int]
    """bit of the control word whose rising edge resets a fault"""
    INITIAL: ClassVar[Any] = None
    """state after power-up and after a reset"""
    EXTRA: ClassVar[Mapping[str, int]] = {}
    """addresses of registers that the manual lets be written; a drive file may lack them"""

    def __init__(
        self, file: DriveFile, settings: DriveSettings, clock: Callable[[], float] = time.monotonic,
        interface: str = "serial",
    ) -> None:
        """Start as a stopped drive that was powered up long ago.

        Args:
            file: the drive file of its make.
            settings: of this drive.
            clock: returns the time (s).
            interface: through which it is reached, ``serial`` or ``tcp``; a timeout of the other
                one has factory settings and guards nothing.

        Raises:
            ConfigurationError: the drive file has no timeout for that interface.
        """
        if interface not in file.timeout.by_interface:
            raise ConfigurationError(
                "is missing: a drive without a communication timeout cannot be simulated",
                file=file.path, key=f"timeout.{interface}",
            )
        self.settings, self.timeout = settings, file.timeout.by_interface[interface]
        self.flow: Callable[[float], float] = lambda speed: 0.0
        self.log: Callable[[str], None] = lambda text: None
        self.speed = 0.0
        self.local = self.lost = False
        self.word = 0
        self.loss = self.LOSS.get(interface, 0)
        self.fault = self.last_fault = 0
        self._active_fault, self._parameter = faults.NONE, 0
        self._file, self._clock = file, clock
        self._at = self._answers_from = clock()
        self._guarded_from = -math.inf
        self._last_request: float | None = None
        self._registers = {
            name: Register(address, address, "uint16", name, "none")
            for name, address in self.EXTRA.items()
        } | file.registers
        self._commands = {"control", "reference"} | {
            step.write for steps in vars(file.sequences).values() for step in steps
        }
        self._words = {address: 0 for name in self._registers for address in self._addresses(name)}
        self._write_constants()
        self._writable = {
            address: name
            for name in self._commands | self._write_timeouts() | set(self.EXTRA)
            for address in self._addresses(name)
        }
        self.power_up()

    def _write_constants(self) -> None:
        """Set the registers that never change: texts and full-scale values."""
        text = f"simulated {self._file.make}".encode()
        for register in self._registers.values():
            if register.type == "text":
                padded = text.ljust(2 * register.width)
                for offset in range(register.width):
                    two = padded[2 * offset:2 * offset + 2]
                    self._words[register.address + offset] = int.from_bytes(two, "big")
            if register.full_scale:
                scale = self._registers[register.full_scale]
                rated = _RATED_FREQUENCY if "Hz" in scale.meaning else _RATED_RPM
                self.write_raw(register.full_scale, rated / scale.scale)

    def _write_timeouts(self) -> set[str]:
        """Set the registers of all timeouts; return their names."""
        names = set()
        for timeout in (*self._file.timeout.by_interface.values(), self.timeout):
            when, action = self.DELIVERED
            if timeout is self.timeout and self.settings.timeout_s is not None:
                register = self._registers[timeout.register]
                seconds = min(self.settings.timeout_s, register.high)
                when, action = max(1, round(seconds / register.scale)), next(iter(self.TRIPS), 0)
            self.write_raw(timeout.register, when)
            names.add(timeout.register)
            if timeout.action is not None:
                names.add(timeout.action.register)
                self.write_raw(timeout.action.register, action)
            if timeout.mode is not None:
                names.add(timeout.mode.register)
                self.write_raw(timeout.mode.register, min(timeout.mode.stops))
        return names

    # --- what differs between the makes -----------------------------------------------------------

    @property
    @abstractmethod
    def motion(self) -> Motion:
        """What the drive does with its motor."""

    @abstractmethod
    def status(self) -> int:
        """Return the status word."""

    def next_state(self) -> Any:  # noqa: B027 - some have none
        """Return the state that the control word leads to; there is no fault or local control."""

    def standstill(self) -> None:  # noqa: B027 - some wait for nothing
        """Handle that the motor is stopped; called repeatedly."""

    def restarts_timeout(self, name: str) -> bool:
        """Return whether writing a register restarts the timeout; for '', any request."""
        return True

    def control(self, word: int) -> None:
        """Obey a control word."""
        rising, self.word = word & ~self.word, word
        if rising & self.RESET and self.fault and self._active_fault != "drive_fault":
            self.trip(0)
        elif not self.fault and not self.local:
            self.state = self.next_state()

    def trip(self, fault: int) -> None:
        """Trip, or clear the fault if it is 0."""
        self.fault = fault
        self.last_fault = fault or self.last_fault
        if not fault:
            self.state = self.INITIAL

    @property
    def fault_register(self) -> int:
        """The value of the fault register."""
        return self.fault

    def on_write(self, name: str) -> None:
        """Handle the write of a register."""
        if name == "control":
            self.control(self.read_raw(name))
        elif name not in self._commands:
            self.apply_settings()

    def apply_settings(self) -> None:
        """Put the timeout's settings in force."""
        action = self.timeout.action
        self.guard = (
            self.read_raw(self.timeout.register),
            self.read_raw(action.register) if action else 0,
        )

    def communication_lost(self) -> None:
        """Do what the drive is set to do after its timeout: trip, or nothing."""
        if self.guard[1] in self.TRIPS:
            self.trip(self.loss)

    def power_up(self) -> None:
        """Start with the present values of the registers."""
        self.word, self.state = 0, self.INITIAL
        self.apply_settings()

    @property
    def setpoint(self) -> float:
        """The speed to which it ramps (share of rated); pumps do not turn backwards."""
        register = self._registers["reference"]
        return min(max(self.read_raw("reference") * self._unit(register), 0.0), 1.0)

    # --- time -------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Simulate up to now: ramps, and the communication timeout at its moment."""
        now = self._clock()
        loss = self._loss_at()
        if loss <= now:
            self._move(loss)
            self.lost = True
            if self._active_fault == "runs_on":
                self._active_fault = faults.NONE
            self.communication_lost()
            self.log(
                f"communication timeout: nothing for {loss - (self._last_request or 0):.3g} s; "
                f"{self.motion.value}"
            )
        self._move(now)

    @property
    def answers(self) -> bool:
        """Whether it has power and has booted."""
        return self._clock() >= self._answers_from

    def _loss_at(self) -> float:
        """Return when the timeout passes if nothing more arrives; infinity if it does not."""
        raw, _ = self.guard
        if self._last_request is None or self.lost or raw == 0 or raw in self.timeout.off_values:
            return math.inf
        seconds = raw * self._registers[self.timeout.register].scale
        return max(self._last_request + seconds, self._guarded_from)

    def _move(self, now: float) -> None:
        """Turn the motor until this time."""
        step = max(0.0, now - self._at)
        self._at = max(now, self._at)
        motion = self.motion if self._at >= self._answers_from else Motion.COAST
        if self._ignores_stop:
            self.standstill()  # only its state machine believes so
            return
        stays = self._active_fault in ("speed_stays", "stuck_running") or motion is Motion.HOLD
        if not stays:
            setpoint = self.setpoint if motion is Motion.FOLLOW else 0.0
            full = self.settings.coast_s if motion is Motion.COAST else self.settings.ramp_s
            reach = self.settings.speed * step / full if full else math.inf
            self.speed += min(max(setpoint - self.speed, -reach), reach)
        if not self.speed:
            self.standstill()

    @property
    def _ignores_stop(self) -> bool:
        """Whether it is ordered to stop and reports that it is off, but runs on."""
        off = self.motion is not Motion.FOLLOW or not self.setpoint
        return self._active_fault == "runs_on" and off and self._at >= self._answers_from

    @property
    def moving(self) -> bool:
        """Whether the motor turns, as the drive reports it."""
        return self.speed > 0 and not self._ignores_stop

    @property
    def at_speed(self) -> bool:
        """Whether it follows its reference and has reached it."""
        return self.motion is Motion.FOLLOW and abs(self.speed - self.setpoint) < _AT_SPEED

    @property
    def warning(self) -> bool:
        """Whether the timeout has expired without a trip."""
        return self.lost and not self.fault

    # --- registers --------------------------------------------------------------------------------

    def read_raw(self, name: str) -> int:
        """Return a register's value (raw)."""
        register = self._registers[name]
        words = [self._words[address] for address in self._addresses(name)]
        return int(decode(words, register.type, register.word_order))

    def write_raw(self, name: str, value: float) -> None:
        """Set a register's value (raw)."""
        register = self._registers[name]
        words = encode(value, register.type, register.word_order)
        self._words |= zip(self._addresses(name), words, strict=True)

    def _addresses(self, name: str) -> range:
        register = self._registers[name]
        return range(register.address, register.address + register.width)

    def registers(self) -> Mapping[int, int]:
        """Return every register's value, by address."""
        self.advance()
        self.write_raw("status", self.status())
        self.write_raw(self._file.faults.register, self.fault_register)
        self.write_raw("speed", self.speed / self._unit(self._registers["speed"]))
        if self._active_fault == "absurd_value":
            self._words |= dict.fromkeys(self._addresses("speed"), self._parameter)
        if "flow" in self._registers:
            self.write_raw("flow", self.flow(self.speed) / self._registers["flow"].scale)
        return self._words

    def _unit(self, register: Register) -> float:
        """The value of one count (share of rated speed)."""
        if not register.full_scale:
            return register.scale
        scale = self._registers[register.full_scale].scale
        return register.scale / (scale * self.read_raw(register.full_scale))

    def on_request(self) -> None:
        """Handle any request, even one with no effect: on some makes it restarts the timeout."""
        self.advance()
        if self.restarts_timeout(""):
            self._restart_timeout()

    def write(self, address: int, values: list[int]) -> ExcCodes | None:
        """Write the values of a client, one register after another."""
        self.advance()
        addresses = range(address, address + len(values))
        if any(at not in self._writable for at in addresses):
            return ExcCodes.ILLEGAL_ADDRESS
        for at, value in zip(addresses, values, strict=True):
            self._words[at] = value
            before, name = self.motion, self._writable[at]
            self.on_write(name)
            if self.restarts_timeout(name):
                self._restart_timeout()
            if self.motion is not before:
                self.log(f"{name} = 0x{value:04X}: {self.motion.value}")
        self._move(self._at)
        return None

    def _restart_timeout(self) -> None:
        if self.lost:
            self.log("receives requests again")
        self.lost = False
        self._last_request = self._at

    # --- the workbench ----------------------------------------------------------------------------

    def inject(self, name: str, parameter: int) -> None:
        """Replace the present fault of the drive; a trip remains until it is reset.

        Args:
            name: of one of `faults.DRIVE_FAULTS`; faults of the wire change nothing here.
            parameter: of it.
        """
        self.advance()
        self._active_fault, self._parameter = name, parameter
        match name:
            case "drive_fault":
                codes = self._file.faults
                first = next(iter(codes.texts), 1)
                code = parameter or (1 << first if codes.kind == "bits" else first)
                self.trip(code)
                self.log(f"trips: {codes.text(code)}")
            case "stuck_running":  # as with a welded contactor
                self.speed = parameter * faults.SPEED_UNIT or self.speed or _STUCK_AT
            case "power_cycle":
                self.power_cycle()
            case "timeout_off":  # as someone could at the panel
                if self.timeout.action is not None:
                    self.write_raw(self.timeout.action.register, min(self.timeout.action.runs_on))
                else:
                    self.write_raw(self.timeout.register, min(self.timeout.off_values, default=0))
                self.apply_settings()

    def power_cycle(self) -> None:
        """Lose power for a moment: the motor coasts, and nothing answers until it has booted."""
        self.advance()
        self._answers_from = self._at + self.settings.boot_s
        self._guarded_from = self._answers_from + self.UNGUARDED_S
        self._last_request = None
        self.lost = False
        if self._active_fault != "drive_fault":
            self.trip(0)
        for name in self._commands:
            self.write_raw(name, 0)
        self.power_up()
        self.log(f"power cycle: answers again in {self.settings.boot_s:g} s")

    def set_local(self, local: bool) -> None:
        """Set local control at the panel, or return control to the bus."""
        self.advance()
        self.local = local


class DriveBench(Bench):
    """Runs a simulated drive.

    Attributes:
        drive: the drive.
    """

    def __init__(
        self, make: type[SimulatedDrive], file: DriveFile, settings: DriveSettings,
        address: Address, workbench: Address, site: Site,
    ) -> None:
        """Prepare the bench without opening anything.

        Args:
            make: class of the drive, from `control_profiles.profile_of`.
            file: drive file of that make.
            settings: of the drive.
            address: TCP port or serial line of the drive; port 0 takes a free one, and the line
                ``pty`` is a pseudo-terminal. If the file has no timeout for an Ethernet port, the
                TCP port is a gateway's.
            workbench: TCP port of the workbench; port 0 takes a free one.
            site: for the flow of drives that report it. Until the workbench gets another level, the
                cistern has the level with which runs start by default.

        Raises:
            ConfigurationError: the drive file has no timeout for the interface that is reached.
        """
        super().__init__(faults.DRIVE_FAULTS, workbench)
        self._line = PseudoLine() if address.line == _PTY else None
        reached = address if self._line is None else Address(line=self._line.ends[0])
        self._reached = replace(reached, gateway=not reached.line and file.timeout.tcp is None)
        self._device_id = file.device_id_at(self._reached)
        self.drive = make(file, settings, interface=self._reached.interface)
        self.drive.log = self.log
        self.drive.flow = lambda speed: flow_at(
            site, speed, self.registers[faults.CISTERN_LEVEL] * faults.LEVEL_UNIT
        )
        level = site.cistern_level(default_state(site)[1][0])
        self.registers |= {
            faults.POWER_CYCLE: 0, faults.LOCAL: 0,
            faults.CISTERN_LEVEL: round(level / faults.LEVEL_UNIT),
        }
        device = Device(self.drive.registers, self.drive.write, self._on_request)
        self.servers.append(
            Server(reached, {self._device_id: device}, file.serial, self.fault, SIMULATOR)
        )

    @property
    def addresses(self) -> str:
        """The address of the drive, behind a gateway if it has no Ethernet port of its own."""
        address = replace(self.servers[0].address, gateway=self._reached.gateway)
        end = self._line.ends[1] if self._line is not None else address
        return f"drive {end}, device {self._device_id}"

    def inject(self, name: str, parameter: int) -> bool:
        """Replace the present fault, of the wire or of the drive."""
        codes = [faults.DEFAULT, *ExcCodes]
        if name in ("exception", "refused_writes") and parameter not in codes:
            return False
        super().inject(name, parameter)
        self.drive.inject(name, self.fault.parameter)
        return True

    async def run(self, ended: asyncio.Event) -> None:
        """Run the drive until the end."""
        if self._line is not None:
            self._line.join()
        while not ended.is_set():
            self.drive.advance()
            # The drive's port is open while it has power and does not refuse.
            await self.servers[0].set_open(self._answers)
            await asyncio.sleep(_STEP_S)

    @property
    def _answers(self) -> bool:
        return self.drive.answers and self.fault.name != "refused"

    def _on_request(self, register: int) -> bool:
        if self._answers:
            self.drive.on_request()
        return self._answers

    def read_registers(self) -> Mapping[int, int]:
        """Return the registers of the workbench, with the true speed."""
        self.drive.advance()
        return self.registers | {faults.SPEED: round(self.drive.speed / faults.SPEED_UNIT)}

    def write_register(self, register: int, value: int) -> None:
        """Write a register: interrupt the power, or set local control."""
        if register == faults.POWER_CYCLE and value:
            self.drive.power_cycle()
        elif register == faults.LOCAL:
            self.drive.set_local(bool(value))
        if register != faults.POWER_CYCLE:
            self.registers[register] = value
