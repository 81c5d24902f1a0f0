"""Simulated drives with their motors: registers, control word, ramp and communication timeout.

The state machines are based on the manufacturers' manuals. The driver, in contrast, uses the
control words and conditions of the drive file, so the simulator and the driver verify each other.
Where a manual is ambiguous, and for words that no drive file writes, the interpretation that is
stricter for the driver is implemented: the drive stops. A drive neither waits nor uses Modbus, and
reads the time from a clock; `drive_server` connects the drive to Modbus.
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

_AT_SPEED = 0.01


class Motion(enum.Enum):
    """The way in which a drive moves its motor."""

    FOLLOW = "ramps to its reference"
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
        local: whether the drive is controlled from its panel.
        lost: whether the bus has been silent for longer than the timeout.
        fault: code, or bits, of the active fault; 0 for none.
        loss: code, or bits, of the fault that the expiry of the timeout raises.
        word: the control word.
        state: state of the drive's state machine; None for a make without states.
    """

    TRIPS: ClassVar[tuple[int, ...]] = ()
    """actions of the timeout that trip the drive; the first is the one that is set"""
    LOSS: ClassVar[Mapping[str, int]] = {}
    """code, or bits, of the fault after the timeout of each interface"""
    RESET: ClassVar[int]
    """bit of the control word whose rising edge resets a fault"""
    INITIAL: ClassVar[Any] = None
    """state after power-up and after a reset"""

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
                is off.

        Raises:
            ConfigurationError: if the drive file has no timeout for that interface.
        """
        if interface not in file.timeout:
            raise ConfigurationError(
                "is missing: a drive without a communication timeout cannot be simulated; the file "
                f"has timeout.{' and timeout.'.join(file.timeout)}, and serial means "
                "an address such as gateway://127.0.0.1:5020",
                file=file.path, key=f"timeout.{interface}",
            )
        self.settings, self.timeout = settings, file.timeout[interface]
        self.flow: Callable[[float], float] = lambda speed: 0.0
        self.log: Callable[[str], None] = lambda text: None
        self.speed = 0.0
        self.local = self.lost = False
        self.word = self.fault = 0
        self.loss = self.LOSS.get(interface, 0)
        self._file, self._clock = file, clock
        self._at = clock()
        self._last_request: float | None = None
        self._registers = file.registers
        self._commands = {"control", "reference"} | {
            step.write for steps in vars(file.sequences).values() for step in steps
        }
        self._words = {address: 0 for name in self._registers for address in self._addresses(name)}
        self._write_constants()
        self._writable = {
            address: name for name in self._commands | self._write_timeout()
            for address in self._addresses(name)
        }
        self.power_up()

    def _write_constants(self) -> None:
        """Set the registers that never change: full-scale values."""
        for register in self._registers.values():
            if register.full_scale:  # 50 Hz or 750 rpm
                scale = self._registers[register.full_scale]
                self.write_raw(register.full_scale, 2.5 * scale.low / scale.scale)

    def _write_timeout(self) -> set[str]:
        """Set the registers of the timeout, and return their names."""
        timeout, register = self.timeout, self._registers[self.timeout.register]
        seconds = min(self.settings.timeout_s, register.high)
        self.write_raw(timeout.register, max(1, round(seconds / register.scale)))
        names = {timeout.register}
        if timeout.action is not None:
            names.add(timeout.action.register)
            self.write_raw(timeout.action.register, self.TRIPS[0])
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
        if not fault:
            self.state = self.INITIAL

    def communication_lost(self) -> None:
        """Trip after the timeout if the drive is set to do so."""
        action = self.timeout.action
        if action is not None and self.read_raw(action.register) in self.TRIPS:
            self.trip(self.loss)

    def power_up(self) -> None:
        """Switch on with the control word 0 and the current values of the registers."""
        self.word, self.state = 0, self.INITIAL

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
        raw = self.read_raw(self.timeout.register)
        if self._last_request is None or self.lost or raw == 0:
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
        self.write_raw(self._file.faults.register, self.fault)
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
            if name == "control":
                self.control(value)
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


class _Abb(enum.Enum):
    INHIBITED = "switch-on inhibited"
    NOT_READY = "not ready to switch on"
    READY_ON = "ready to switch on"
    READY_RUN = "ready to operate"
    OPERATION = "operation enabled"
    OFF1 = "OFF1 active"


class AbbDrives(SimulatedDrive):
    """ABB Drives profile on the embedded fieldbus interface of the ACS880.

    The source is the firmware manual 3AUA0000085967, "Control Word", "Status Word" and "State
    transition diagram", pages 617 to 620. After OFF1, the drive must come to a standstill before it
    can be switched on again. In the control word, bits 0 to 2 are OFF1 to OFF3 (active low), bit 3
    is run, bits 4 to 6 control the ramp, bit 7 is reset and bit 10 is remote. OFF2 and OFF3 have
    the same effect, and a word without bit 10 is ignored.
    """

    TRIPS = (1, 4)  # with other actions it warns at most, and the motor runs on
    LOSS: ClassVar = {"serial": 0x6681}
    RESET = 0x0080
    INITIAL = _Abb.INHIBITED

    def restarts_timeout(self, name: str) -> bool:
        """Return True for any message if 58.15 is 1, else only for control word and reference."""
        mode = self.timeout.mode
        only = mode is None or self.read_raw(mode.register) != 1
        return not only or name in ("control", "reference")

    def control(self, word: int) -> None:
        """Obey only words from the bus."""
        if word & 0x0400:
            super().control(word)

    def standstill(self) -> None:
        """Leave OFF1 now that the motor is at standstill; a run then needs a new OFF1."""
        if self.state is _Abb.OFF1 and not self.fault and not self.local:
            self.state = _Abb.NOT_READY if self.word & 0x0001 else _Abb.READY_ON

    def next_state(self) -> _Abb:
        """Return the state of the diagram to which the control word leads."""
        word, state = self.word, _Abb(self.state)
        if word & 0x0006 != 0x0006:  # OFF2 or OFF3
            return _Abb.INHIBITED
        if state is _Abb.OFF1:
            return state
        if not word & 0x0001:
            on = state in (_Abb.READY_RUN, _Abb.OPERATION)
            return _Abb.OFF1 if on else _Abb.READY_ON
        if state in (_Abb.INHIBITED, _Abb.NOT_READY):
            return state
        return _Abb.OPERATION if word & 0x0008 else _Abb.READY_RUN

    @property
    def motion(self) -> Motion:
        """The motion, which bits 4 to 6 of the control word determine during operation."""
        if self.fault:
            return Motion.COAST
        if self.local or self.state is _Abb.OFF1:
            return Motion.RAMP_DOWN
        if self.state is not _Abb.OPERATION:
            return Motion.COAST
        return Motion.FOLLOW if self.word & 0x0070 == 0x0070 else Motion.RAMP_DOWN

    def status(self) -> int:
        """Return the status word as on page 619 of the manual; external run enable is wired."""
        state, on = self.state, (_Abb.READY_RUN, _Abb.OPERATION)
        ramps = state is _Abb.OFF1 and self.moving
        return _word({
            0: not self.fault and state in (_Abb.READY_ON, *on),
            1: not self.fault and state in on,
            2: not self.fault and (state is _Abb.OPERATION or ramps),
            3: self.fault, 4: True, 5: True, 6: state is _Abb.INHIBITED, 7: self.warning,
            8: self.at_speed and state is _Abb.OPERATION, 9: not self.local, 12: True,
        })


class FcProfile(SimulatedDrive):
    """FC profile of the Danfoss VLT AQUA Drive FC 202.

    The source is the design guide, "Danfoss FC Control Profile". In the control word, bits 2
    (brake), 3 (coast), 4 (quick stop) and 5 (hold) are active low, bit 6 is start and bit 7 is
    reset; all but coasting stop on the ramp. A word without bit 10 ("data valid") is ignored. After
    the timeout, 5 in parameter 8-04 stops and trips the drive, and with other values it runs on.
    """

    TRIPS = (5,)
    LOSS: ClassVar = {"serial": 1 << 4}
    RESET = 0x0080

    def restarts_timeout(self, name: str) -> bool:
        """Return True only for valid control words."""
        return name == "control" and bool(self.read_raw(name) & 0x0400)

    def control(self, word: int) -> None:
        """Obey only valid control words."""
        if word & 0x0400:
            super().control(word)

    @property
    def motion(self) -> Motion:
        """The motion: coasting takes precedence over the ramp."""
        if self.fault:
            return Motion.RAMP_DOWN if self.fault == self.loss else Motion.COAST
        if not self.word & 0x0008:
            return Motion.COAST
        starts = not self.local and self.word & 0x0074 == 0x0074
        return Motion.FOLLOW if starts else Motion.RAMP_DOWN

    def status(self) -> int:
        """Return the status word as in the manual's table "Definition of the status bits"."""
        return _word({
            0: True, 1: not self.fault, 2: self.word & 0x0008, 3: self.fault, 7: self.warning,
            8: self.at_speed, 9: not self.local, 10: True,
            11: self.motion is Motion.FOLLOW or self.moving,
        })


class CimProfile(SimulatedDrive):
    """Modbus profile of Grundfos pumps with a CIM 200 or CIM 500 module.

    The source is the functional profile, sections 9.4 and 9.5. In the control word, bit 0 requests
    bus control, bit 1 switches the pump on and bit 2 resets an alarm. Without bus control, or after
    its loss, the pump follows its local setting, which stops it, as this project requires.
    """

    RESET = 0x0004
    _CONTROL_MODE, _OPERATION_MODE = 101, 102
    _CONSTANT_PRESSURE, _CONSTANT_FREQUENCY = 4, 1
    _OTHER_MODE = 0.6  # a speed that no set-point requested (share of the rated speed)

    def power_up(self) -> None:
        """Start in local control."""
        super().power_up()
        self._words[self._CONTROL_MODE] = self._CONSTANT_PRESSURE

    @property
    def _remote(self) -> bool:
        return bool(self.word & 0x0001) and not self.local

    @property
    def _on(self) -> bool:
        return self._remote and bool(self.word & 0x0002)

    @property
    def motion(self) -> Motion:
        """The motion: the pump follows the set-point if it is on, and otherwise ramps down to 0."""
        if self.fault:
            return Motion.COAST
        return Motion.FOLLOW if self._on else Motion.RAMP_DOWN

    @property
    def setpoint(self) -> float:
        """The set-point, which applies only in constant-frequency mode under bus control."""
        modes = self._words[self._CONTROL_MODE], self._words.get(self._OPERATION_MODE)
        follows = self._remote and modes == (self._CONSTANT_FREQUENCY, 0)
        return super().setpoint if follows else self._OTHER_MODE

    def status(self) -> int:
        """Return the status word as in section 9.5 of the manual."""
        return _word({
            6: self.moving, 8: self._remote, 9: self._on, 10: self.fault, 12: self.local,
        })

    def communication_lost(self) -> None:
        """Return to local control; there is no alarm."""
        self.word = 0


class _Cia(enum.Enum):
    DISABLED = 0x0040
    READY = 0x0021
    SWITCHED_ON = 0x0023
    ENABLED = 0x0027
    FAULT = 0x0008


class Cia402(SimulatedDrive):
    """CiA 402 profile of the Schneider Electric Altivar drives.

    The source is BBV51701, state chart, pages 9 to 13. The value of a state consists of bits 0 to
    3, 5 and 6 of the status word ETA. In the control word, bit 0 is 'switch on', bit 1 'enable
    voltage', bit 2 'quick stop' (active low, here with the effect of bit 1), bit 3 'enable
    operation', bit 7 'fault reset' and bit 8 'halt'. After the timeout, the values 1 (freewheel), 6
    (ramp), 7 (fast stop) and 8 (DC injection) of SLL and ETHL trip the drive, and the motor coasts.
    """

    TRIPS = (1, 6, 7, 8)
    LOSS: ClassVar = {"serial": 5, "tcp": 150}
    RESET = 0x0080
    INITIAL = _Cia.DISABLED

    def next_state(self) -> _Cia:
        """Return the next state of the state chart; 'ready' first leads to 'switched on'."""
        word, state = self.word, self.state
        if word & 0x0006 != 0x0006:  # disable voltage, or quick stop
            return _Cia.DISABLED
        if not word & 0x0001:  # shutdown
            return _Cia.READY
        if state is _Cia.DISABLED:
            return _Cia.DISABLED
        if not word & 0x0008 or state is _Cia.READY:
            return _Cia.SWITCHED_ON
        return _Cia.ENABLED

    def trip(self, fault: int) -> None:
        """Trip, and enter the state 'fault'."""
        super().trip(fault)
        if fault:
            self.state = _Cia.FAULT

    @property
    def motion(self) -> Motion:
        """The motion: the drive follows its reference only in the state 'operation enabled'."""
        if self.state is _Cia.ENABLED and not self.local:
            return Motion.RAMP_DOWN if self.word & 0x0100 else Motion.FOLLOW
        ramps = self.state is _Cia.SWITCHED_ON or (self.local and not self.fault)
        return Motion.RAMP_DOWN if ramps else Motion.COAST

    def status(self) -> int:
        """Return the status word ETA: state, voltage, warning, remote, reference reached."""
        return int(self.state.value) | _word({
            4: True, 7: self.warning, 9: not self.local, 10: self.at_speed,
        })


DRIVES: Mapping[str, type[SimulatedDrive]] = {
    "ABB": AbbDrives, "Danfoss": FcProfile, "Grundfos": CimProfile, "Schneider Electric": Cia402,
}


def _word(bits: Mapping[int, object]) -> int:
    return sum(1 << bit for bit, on in bits.items() if on)


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
