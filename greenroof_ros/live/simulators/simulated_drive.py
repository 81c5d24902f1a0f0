"""The part of a simulated drive that is common to all makes: registers, ramp and timeout.

A subclass in `control_profiles` adds the state machine of a make. A `SimulatedDrive` neither waits
nor uses Modbus, and reads the time from a clock; `drive_server` connects the drive to Modbus.
"""

from __future__ import annotations

import enum
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from pymodbus.constants import ExcCodes

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.live.devices.drive_file import DriveFile, Register
from greenroof_ros.live.devices.modbus_line import Address, decode, encode
from greenroof_ros.live.simulators.server import Device, Server

_RATED_RPM = 1500
_RATED_FREQUENCY = 500
"""0.1 Hz"""
_AT_SPEED = 0.01


class Motion(enum.Enum):
    """The way in which a drive moves its motor."""

    FOLLOW = "ramps to its reference"
    HOLD = "keeps its speed"
    RAMP_DOWN = "ramps to rest"
    COAST = "lets the motor coast"


@dataclass(frozen=True)
class DriveSettings:
    """The settings and properties of a simulated drive.

    Attributes:
        ramp_s: ramp time from standstill to the rated speed, or back (s).
        coast_s: time from the rated speed to standstill without torque (s).
        timeout_s: communication timeout that stops the drive (s); it is rounded to the resolution
            of its register.
    """

    ramp_s: float = 5.0
    coast_s: float = 2.0
    timeout_s: float = 5.0


class SimulatedDrive(ABC):
    """Base class for a drive with its motor.

    Attributes:
        speed: speed of the motor (share of the rated speed).
        flow: function that returns the pump's flow at a speed (m3/s), for a drive that reports the
            flow.
        log: function that prints a line about an event.
        settings: settings and properties of the drive.
        timeout: the communication timeout of the interface in use.
        guard: raw time and raw action of the timeout that are in effect.
        local: whether the drive is controlled from its panel.
        lost: whether the bus has been silent for longer than the timeout.
        fault: code, or bits, of the active fault; 0 for none.
        last_fault: code, or bits, of the last fault that tripped the drive.
        loss: code, or bits, of the fault that the expiry of the timeout raises.
        word: the control word.
        state: state of the drive's state machine; None for a make without states.
    """

    DELIVERED: ClassVar[tuple[int, int]]
    """time and action of the timeout as set at the factory (raw)"""
    TRIPS: ClassVar[tuple[int, ...]] = ()
    """actions of the timeout that trip the drive; the first is the one that is set"""
    LOSS: ClassVar[Mapping[str, int]] = {}
    """code, or bits, of the fault after the timeout of each interface"""
    RESET: ClassVar[int]
    """bit of the control word whose rising edge resets a fault"""
    INITIAL: ClassVar[Any] = None
    """state after power-up and after a reset"""
    EXTRA: ClassVar[Mapping[str, int]] = {}
    """addresses of further writable registers in the manual; a drive file may lack them"""

    def __init__(
        self, file: DriveFile, settings: DriveSettings, clock: Callable[[], float] = time.monotonic,
        interface: str = "serial",
    ) -> None:
        """Initialize a stopped drive that was powered up long ago.

        Args:
            file: drive file of the make.
            settings: settings and properties of this drive.
            clock: function that returns the time (s).
            interface: interface in use, ``serial`` or ``tcp``; the timeout of the other interface
                has factory settings, and has no effect.

        Raises:
            ConfigurationError: if the drive file has no timeout for that interface.
        """
        if interface not in file.timeout.by_interface:
            raise ConfigurationError(
                "is missing: a drive without a communication timeout cannot be simulated; the file "
                f"has timeout.{' and timeout.'.join(file.timeout.by_interface)}, and serial means "
                "an address such as gateway://127.0.0.1:5020",
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
        self._file, self._clock = file, clock
        self._at = clock()
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
        """Set the registers of all timeouts, and return the names of these registers."""
        names = set()
        for timeout in (*self._file.timeout.by_interface.values(), self.timeout):
            when, action = self.DELIVERED
            if timeout is self.timeout:
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
        """The way in which the drive currently moves its motor."""

    @abstractmethod
    def status(self) -> int:
        """Return the status word."""

    def next_state(self) -> Any:  # noqa: B027 - some makes have no states
        """Return the state after the control word if there is no fault or local control."""

    def standstill(self) -> None:  # noqa: B027 - some makes wait for nothing
        """Update the state for a motor at standstill; called repeatedly."""

    def restarts_timeout(self, name: str) -> bool:
        """Return whether a write of a register, or any request (''), restarts the timeout."""
        return True

    def control(self, word: int) -> None:
        """Obey a control word."""
        rising, self.word = word & ~self.word, word
        if rising & self.RESET and self.fault:
            self.trip(0)
        elif not self.fault and not self.local:
            self.state = self.next_state()

    def trip(self, fault: int) -> None:
        """Trip with a fault; 0 clears the current fault."""
        self.fault = fault
        self.last_fault = fault or self.last_fault
        if not fault:
            self.state = self.INITIAL

    @property
    def fault_register(self) -> int:
        """The value of the fault register."""
        return self.fault

    def on_write(self, name: str) -> None:
        """Handle a write of a register: obey a control word, or apply a setting."""
        if name == "control":
            self.control(self.read_raw(name))
        elif name not in self._commands:
            self.apply_settings()

    def apply_settings(self) -> None:
        """Put the settings of the timeout into effect."""
        action = self.timeout.action
        self.guard = (
            self.read_raw(self.timeout.register),
            self.read_raw(action.register) if action else 0,
        )

    def communication_lost(self) -> None:
        """Trip after the timeout if the drive is set to do so."""
        if self.guard[1] in self.TRIPS:
            self.trip(self.loss)

    def power_up(self) -> None:
        """Switch on with the control word 0 and the current values of the registers."""
        self.word, self.state = 0, self.INITIAL
        self.apply_settings()

    @property
    def setpoint(self) -> float:
        """The speed to which the drive ramps (share of the rated speed), at least 0."""
        register = self._registers["reference"]
        return min(max(self.read_raw("reference") * self._unit(register), 0.0), 1.0)

    # --- time -------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Simulate the drive until now; the communication timeout expires at the exact moment."""
        now = self._clock()
        loss = self._loss_at()
        if loss <= now:
            self._move(loss)
            self.lost = True
            self.communication_lost()
            self.log(
                f"communication timeout: silence for {loss - (self._last_request or 0):.3g} s; "
                f"the drive {self.motion.value}"
            )
        self._move(now)

    def _loss_at(self) -> float:
        """Return the time at which the timeout will expire without another request, or infinity."""
        raw, _ = self.guard
        if self._last_request is None or self.lost or raw == 0 or raw in self.timeout.off_values:
            return math.inf
        seconds = raw * self._registers[self.timeout.register].scale
        return self._last_request + seconds

    def _move(self, now: float) -> None:
        step = max(0.0, now - self._at)
        self._at = max(now, self._at)
        self.turn(step, self.motion)
        if not self.speed:
            self.standstill()

    def turn(self, step: float, motion: Motion) -> None:
        """Update the speed after a time step (s) with a given motion."""
        if motion is not Motion.HOLD:
            setpoint = self.setpoint if motion is Motion.FOLLOW else 0.0
            full = self.settings.coast_s if motion is Motion.COAST else self.settings.ramp_s
            reach = step / full if full else math.inf
            self.speed += min(max(setpoint - self.speed, -reach), reach)

    @property
    def moving(self) -> bool:
        """Whether the motor is turning according to the drive."""
        return self.speed > 0

    @property
    def at_speed(self) -> bool:
        """Whether the drive follows its reference and has reached that speed."""
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
        """Update all registers, and return their values by address."""
        self.advance()
        self.write_raw("status", self.status())
        self.write_raw(self._file.faults.register, self.fault_register)
        self.write_raw("speed", self.speed / self._unit(self._registers["speed"]))
        if "flow" in self._registers:
            self.write_raw("flow", self.flow(self.speed) / self._registers["flow"].scale)
        return self._words

    def _unit(self, register: Register) -> float:
        """Return the value of one count (share of the rated speed)."""
        if not register.full_scale:
            return register.scale
        scale = self._registers[register.full_scale].scale
        return register.scale / (scale * self.read_raw(register.full_scale))

    def on_request(self) -> None:
        """Handle any request, even one without effect; some makes then restart their timeout."""
        self.advance()
        if self.restarts_timeout(""):
            self._restart_timeout()

    def write(self, address: int, values: list[int]) -> ExcCodes | None:
        """Write a client's values to consecutive registers; return an exception code, or None."""
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
                self.log(f"{name} = 0x{value:04X}: the drive {self.motion.value}")
        self._move(self._at)
        return None

    def _restart_timeout(self) -> None:
        if self.lost:
            self.log("the drive receives requests again")
        self.lost = False
        self._last_request = self._at


def drive_server(drive: SimulatedDrive, file: DriveFile, address: Address) -> Server:
    """Return the Modbus server of a drive on its TCP port or serial line.

    Args:
        drive: the drive.
        file: drive file of the drive.
        address: address of the drive, as for the pump node; port 0 selects a free port.
    """

    def on_request(register: int) -> bool:
        drive.on_request()
        return True

    device = Device(drive.registers, drive.write, on_request)
    return Server(address, {file.device_id_at(address): device}, file.serial)
