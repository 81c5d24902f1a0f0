"""A drive that is not there: registers, ramp, faults and timeout, as far as all makes are alike.

What a make does with its control word is a subclass in `control_profiles`. A `SimulatedDrive`
neither waits nor speaks Modbus, and time is what a clock says; a `DriveBench` runs one in real
time, on a port or a line of its own, with its workbench beside it.
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
from greenroof_ros.drives.drive_file import DriveFile, Register
from greenroof_ros.drives.modbus_line import SIMULATOR, Address, decode, encode
from greenroof_ros.model.initial_state import default_state
from greenroof_ros.model.pump_speed import flow_at
from greenroof_ros.model.site import Site
from greenroof_ros.simulators import faults
from greenroof_ros.simulators.server import Bench, Device, PseudoLine, Server

_RATED_RPM = 1500
_RATED_FREQUENCY = 500
"""0.1 Hz"""
_AT_SPEED = 0.01
_STUCK_AT = 0.5
# How often a bench moves its drive (s), and the address of a drive on a pseudo-terminal.
_STEP_S, _PTY = 0.01, "pty"


class Motion(enum.Enum):
    """What the drive does with its motor."""

    FOLLOW = "ramps to its reference"
    HOLD = "keeps its speed"
    RAMP_DOWN = "ramps to rest"
    COAST = "lets it coast"


@dataclass(frozen=True)
class DriveSettings:
    """What is set in the simulated drive, and how it is made.

    Attributes:
        ramp_s: from rest to rated speed, and back (s).
        coast_s: from rated speed to rest without torque (s).
        boot_s: from power-up until it answers (s).
        timeout_s: its communication timeout (s), which then stops it, rounded to the steps of
            its register; None as delivered.
        speed: factor by which ramps and coasting are faster than real; no other time is.
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
        flow: tells what the pump delivers at a speed (m3/s), for drives that report it.
        say: reports what happens, for people.
        settings: how it is made and set.
        timeout: its communication timeout, of the interface by which it is spoken to.
        guard: raw time and action of that timeout that are in force.
        local: whether somebody has taken the drive over at its panel.
        lost: whether the bus was silent for longer than the timeout.
        fault: code, or bits, of what has tripped it; 0 if nothing has.
        last_fault: what has tripped it last.
        loss: the fault after the timeout.
        word: the control word.
        state: of its state machine, where it has one.
    """

    DELIVERED: ClassVar[tuple[int, int]]
    """time and action of the timeout as delivered (raw)"""
    TRIPS: ClassVar[tuple[int, ...]] = ()
    """actions of the timeout that trip the drive; the first is set"""
    LOSS: ClassVar[Mapping[str, int]] = {}
    """code, or bits, of the fault after the timeout of each interface"""
    UNGUARDED_S: ClassVar[float] = 0.0
    """after power-up the timeout does not count for so long (s)"""
    RESET: ClassVar[int]
    """bit of the control word that resets a fault when it rises"""
    INITIAL: ClassVar[Any] = None
    """state after power-up and after a reset"""
    EXTRA: ClassVar[Mapping[str, int]] = {}
    """registers of the manual that can be written, and need not be in a drive file: addresses"""

    def __init__(
        self, file: DriveFile, settings: DriveSettings, clock: Callable[[], float] = time.monotonic,
        interface: str = "serial",
    ) -> None:
        """Be a drive at rest that has been under power for long.

        Args:
            file: the make.
            settings: of this drive.
            clock: tells the time (s).
            interface: by which it is spoken to, ``serial`` or ``tcp``; the timeout of the drive
                file's other one is as delivered, and guards nothing.

        Raises:
            ConfigurationError: the drive file tells of no timeout of that interface.
        """
        if interface not in file.timeout.known:
            raise ConfigurationError(
                "is missing: a drive without a communication timeout cannot be simulated",
                file=file.path, key=f"timeout.{interface}",
            )
        self.settings, self.timeout = settings, file.timeout.known[interface]
        self.flow: Callable[[float], float] = lambda speed: 0.0
        self.say: Callable[[str], None] = lambda text: None
        self.speed = 0.0
        self.local = self.lost = False
        self.word = 0
        self.loss = self.LOSS.get(interface, 0)
        self.fault = self.last_fault = 0
        self._standing, self._parameter = faults.NONE, 0
        self._file, self._clock = file, clock
        self._at = self._answers_from = clock()
        self._guarded_from = -math.inf
        self._heard: float | None = None
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
        """Write what can neither move nor be written."""
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
                self.put(register.full_scale, rated / scale.scale)

    def _write_timeouts(self) -> set[str]:
        """Set the timeouts of all interfaces; return the names of their registers."""
        names = set()
        for timeout in (*self._file.timeout.known.values(), self.timeout):
            when, action = self.DELIVERED
            if timeout is self.timeout and self.settings.timeout_s is not None:
                register = self._registers[timeout.register]
                seconds = min(self.settings.timeout_s, register.high)
                when, action = max(1, round(seconds / register.scale)), next(iter(self.TRIPS), 0)
            self.put(timeout.register, when)
            names.add(timeout.register)
            if timeout.action is not None:
                names.add(timeout.action.register)
                self.put(timeout.action.register, action)
            if timeout.mode is not None:
                names.add(timeout.mode.register)
                self.put(timeout.mode.register, min(timeout.mode.stops))
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
        """Return the state that the control word leads to, without a fault and under the bus."""

    def standstill(self) -> None:  # noqa: B027 - some wait for nothing
        """Take in that the motor has come to rest; called again and again."""

    def counts(self, name: str) -> bool:
        """Tell whether a write restarts the timeout, to a register, or a reading where ''."""
        return True

    def control(self, word: int) -> None:
        """Take in a control word."""
        rising, self.word = word & ~self.word, word
        if rising & self.RESET and self.fault and self._standing != "drive_fault":
            self.trip(0)
        elif not self.fault and not self.local:
            self.state = self.next_state()

    def trip(self, fault: int) -> None:
        """Trip, or forget the fault if it is 0."""
        self.fault = fault
        self.last_fault = fault or self.last_fault
        if not fault:
            self.state = self.INITIAL

    @property
    def fault_register(self) -> int:
        """The value of the register of faults."""
        return self.fault

    def wrote(self, name: str) -> None:
        """Take in that a register was written."""
        if name == "control":
            self.control(self.get(name))
        elif name not in self._commands:
            self.take_over_settings()

    def take_over_settings(self) -> None:
        """Let the settings of the timeout be in force."""
        action = self.timeout.action
        self.guard = self.get(self.timeout.register), self.get(action.register) if action else 0

    def communication_lost(self) -> None:
        """Do what the drive is set to do after its timeout."""
        if self.guard[1] in self.TRIPS:
            self.trip(self.loss)

    def power_up(self) -> None:
        """Start with the registers as they are."""
        self.word, self.state = 0, self.INITIAL
        self.take_over_settings()

    @property
    def setpoint(self) -> float:
        """The speed that it ramps to (share of rated); pumps do not turn backwards."""
        register = self._registers["reference"]
        return min(max(self.get("reference") * self._unit(register), 0.0), 1.0)

    # --- time -------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Let time pass until now: ramps, and the communication timeout where it falls."""
        now = self._clock()
        loss = self._loss_at()
        if loss <= now:
            self._move(loss)
            self.lost = True
            if self._standing == "runs_on":
                self._standing = faults.NONE
            self.communication_lost()
            self.say(
                f"communication timeout: nothing for {loss - (self._heard or 0):.3g} s; "
                f"{self.motion.value}"
            )
        self._move(now)

    @property
    def answers(self) -> bool:
        """Whether it is under power and has booted."""
        return self._clock() >= self._answers_from

    def _loss_at(self) -> float:
        """When the timeout falls if nothing more is heard; infinity if it does not."""
        raw, _ = self.guard
        if self._heard is None or self.lost or raw == 0 or raw in self.timeout.off_values:
            return math.inf
        seconds = raw * self._registers[self.timeout.register].scale
        return max(self._heard + seconds, self._guarded_from)

    def _move(self, now: float) -> None:
        """Turn the motor until a time."""
        step = max(0.0, now - self._at)
        self._at = max(now, self._at)
        motion = self.motion if self._at >= self._answers_from else Motion.COAST
        if self._ignores_stop:
            self.standstill()  # as far as its state machine knows
            return
        stays = self._standing in ("speed_stays", "stuck_running") or motion is Motion.HOLD
        if not stays:
            setpoint = self.setpoint if motion is Motion.FOLLOW else 0.0
            full = self.settings.coast_s if motion is Motion.COAST else self.settings.ramp_s
            reach = self.settings.speed * step / full if full else math.inf
            self.speed += min(max(setpoint - self.speed, -reach), reach)
        if not self.speed:
            self.standstill()

    @property
    def _ignores_stop(self) -> bool:
        """Whether it is to stop, and runs on while it says that it is off."""
        off = self.motion is not Motion.FOLLOW or not self.setpoint
        return self._standing == "runs_on" and off and self._at >= self._answers_from

    @property
    def moving(self) -> bool:
        """Whether the motor turns, as far as the drive says."""
        return self.speed > 0 and not self._ignores_stop

    @property
    def at_speed(self) -> bool:
        """Whether it has reached its reference."""
        return self.motion is Motion.FOLLOW and abs(self.speed - self.setpoint) < _AT_SPEED

    @property
    def warning(self) -> bool:
        """Whether the timeout has passed without a trip."""
        return self.lost and not self.fault

    # --- registers --------------------------------------------------------------------------------

    def get(self, name: str) -> int:
        """Return a register's value (raw)."""
        register = self._registers[name]
        words = [self._words[address] for address in self._addresses(name)]
        return int(decode(words, register.type, register.word_order))

    def put(self, name: str, value: float) -> None:
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
        self.put("status", self.status())
        self.put(self._file.faults.register, self.fault_register)
        self.put("speed", self.speed / self._unit(self._registers["speed"]))
        if self._standing == "absurd_value":
            self._words |= dict.fromkeys(self._addresses("speed"), self._parameter)
        if "flow" in self._registers:
            self.put("flow", self.flow(self.speed) / self._registers["flow"].scale)
        return self._words

    def _unit(self, register: Register) -> float:
        """The value of one count (share of rated)."""
        if not register.full_scale:
            return register.scale
        scale = self._registers[register.full_scale].scale
        return register.scale / (scale * self.get(register.full_scale))

    def heard(self) -> None:
        """Take in a request, whatever becomes of it: with some makes that is a sign of life."""
        self.advance()
        if self.counts(""):
            self._hear()

    def write(self, address: int, values: list[int]) -> ExcCodes | None:
        """Take in what a client writes, a register after the other."""
        self.advance()
        addresses = range(address, address + len(values))
        if any(at not in self._writable for at in addresses):
            return ExcCodes.ILLEGAL_ADDRESS
        for at, value in zip(addresses, values, strict=True):
            self._words[at] = value
            before, name = self.motion, self._writable[at]
            self.wrote(name)
            if self.counts(name):
                self._hear()
            if self.motion is not before:
                self.say(f"{name} = 0x{value:04X}: {self.motion.value}")
        self._move(self._at)
        return None

    def _hear(self) -> None:
        if self.lost:
            self.say("hears from its client again")
        self.lost = False
        self._heard = self._at

    # --- the workbench ----------------------------------------------------------------------------

    def inject(self, name: str, parameter: int) -> None:
        """Let a fault of the drive stand instead of the present one; a trip stays until its reset.

        Args:
            name: of one of `faults.DRIVE_FAULTS`; faults of the wire change nothing here.
            parameter: of it.
        """
        self.advance()
        self._standing, self._parameter = name, parameter
        match name:
            case "drive_fault":
                codes = self._file.faults
                first = next(iter(codes.texts), 1)
                code = parameter or (1 << first if codes.kind == "bits" else first)
                self.trip(code)
                self.say(f"trips: {codes.text(code)}")
            case "stuck_running":  # as with a welded contactor
                self.speed = parameter * faults.SPEED_UNIT or self.speed or _STUCK_AT
            case "power_cycle":
                self.power_cycle()
            case "timeout_off":  # as somebody may do it at the panel
                if self.timeout.action is not None:
                    self.put(self.timeout.action.register, min(self.timeout.action.runs_on))
                else:
                    self.put(self.timeout.register, min(self.timeout.off_values, default=0))
                self.take_over_settings()

    def power_cycle(self) -> None:
        """Lose power for a moment: the motor coasts, and nothing answers until it has booted."""
        self.advance()
        self._answers_from = self._at + self.settings.boot_s
        self._guarded_from = self._answers_from + self.UNGUARDED_S
        self._heard = None
        self.lost = False
        if self._standing != "drive_fault":
            self.trip(0)
        for name in self._commands:
            self.put(name, 0)
        self.power_up()
        self.say(f"power cycle: answers again in {self.settings.boot_s:g} s")

    def take_over(self, local: bool) -> None:
        """Take the drive over at its panel, or hand it back to the bus."""
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
        """Prepare it; nothing is opened yet.

        Args:
            make: of the drive, as `control_profiles.profile_of` has it.
            file: of that make.
            settings: of the drive.
            address: TCP port or serial line of the drive; port 0 takes a free one, and the line
                ``pty`` is a pseudo-terminal. A drive whose file tells of no timeout of an Ethernet
                port of its own is behind a gateway there.
            workbench: TCP port of the workbench, likewise.
            site: for the flow, of drives that report it; until the workbench gets another level,
                the cistern's is the one that runs begin with.

        Raises:
            ConfigurationError: the drive file tells of no timeout of the interface that is reached.
        """
        super().__init__(faults.DRIVE_FAULTS, workbench)
        self._line = PseudoLine() if address.line == _PTY else None
        place = address if self._line is None else Address(line=self._line.ends[0])
        self._reached = replace(place, gateway=not place.line and file.timeout.tcp is None)
        self._device_id = file.device_id_at(self._reached)
        self.drive = make(file, settings, interface=self._reached.interface)
        self.drive.say = self.say
        self.drive.flow = lambda speed: flow_at(
            site, speed, self.registers[faults.CISTERN_LEVEL] * faults.LEVEL_UNIT
        )
        level = site.cistern_level(default_state(site)[1][0])
        self.registers |= {
            faults.POWER_CYCLE: 0, faults.LOCAL: 0,
            faults.CISTERN_LEVEL: round(level / faults.LEVEL_UNIT),
        }
        device = Device(self.drive.registers, self.drive.write, self._hears)
        self.servers.append(
            Server(place, {self._device_id: device}, file.serial, self.fault, SIMULATOR)
        )

    @property
    def place(self) -> str:
        """Where the drive is; behind a gateway if it has no Ethernet port of its own."""
        address = replace(self.servers[0].address, gateway=self._reached.gateway)
        end = self._line.ends[1] if self._line is not None else address
        return f"drive {end}, device {self._device_id}"

    def inject(self, name: str, parameter: int) -> bool:
        """Let a fault stand, of the wire or of the drive."""
        codes = [faults.DEFAULT, *ExcCodes]
        if name in ("exception", "refused_writes") and parameter not in codes:
            return False
        super().inject(name, parameter)
        self.drive.inject(name, self.fault.parameter)
        return True

    async def run(self, ended: asyncio.Event) -> None:
        """Let time pass until the end."""
        if self._line is not None:
            self._line.join()
        while not ended.is_set():
            self.drive.advance()
            # The drive's port is open while it has power and does not refuse.
            await self.servers[0].be_open(self._answers)
            await asyncio.sleep(_STEP_S)

    @property
    def _answers(self) -> bool:
        return self.drive.answers and self.fault.name != "refused"

    def _hears(self, register: int) -> bool:
        if self._answers:
            self.drive.heard()
        return self._answers

    def look(self) -> Mapping[int, int]:
        """Return the registers of the workbench, the true speed among them."""
        self.drive.advance()
        return self.registers | {faults.SPEED: round(self.drive.speed / faults.SPEED_UNIT)}

    def adjust(self, register: int, value: int) -> None:
        """Cut the power, or take the drive over at its panel."""
        if register == faults.POWER_CYCLE and value:
            self.drive.power_cycle()
        elif register == faults.LOCAL:
            self.drive.take_over(bool(value))
        if register != faults.POWER_CYCLE:
            self.registers[register] = value
