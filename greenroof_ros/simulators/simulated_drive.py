"""A drive that is not there: registers, ramp, faults and timeout as of a make's own.

Time is an argument (s, of any clock); nothing here waits or speaks Modbus.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pymodbus.constants import ExcCodes

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.drives.drive_file import DriveFile, Register
from greenroof_ros.drives.modbus_line import encode
from greenroof_ros.simulators.control_profiles import ControlProfile, Motion, Seen, profile_of

_RATED_RPM = 1500.0
_RATED_FREQUENCY = 50.0
_AT_SPEED = 0.01
_NOT_MOVING = 1e-9


@dataclass(frozen=True)
class DriveSettings:
    """What is set in the simulated drive, and how it is made.

    Attributes:
        ramp_s: from rest to rated speed, and back (s).
        coast_s: from rated speed to rest without torque (s).
        boot_s: from power-up until it answers (s).
        timeout_s: its communication timeout (s), which then stops it, rounded to what its register
            can hold; None as delivered.
        speed: factor by which ramps and coasting are faster than real; no other time is.
    """

    ramp_s: float = 5.0
    coast_s: float = 2.0
    boot_s: float = 3.0
    timeout_s: float | None = 5.0
    speed: float = 1.0


class SimulatedDrive:
    """A drive with its motor.

    Attributes:
        speed: of the motor (share of rated).
        flow: tells what the pump delivers at a speed (m3/s), for drives that report it.
    """

    def __init__(
        self,
        file: DriveFile,
        settings: DriveSettings,
        now: float,
        flow: Callable[[float], float] = lambda speed: 0.0,
        say: Callable[[str], None] = lambda text: None,
        interface: str = "serial",
    ) -> None:
        """Be a drive at rest that has been under power for long.

        Args:
            file: the make.
            settings: of this one.
            now: present time (s).
            flow: see the attributes.
            say: is told what happens, for people.
            interface: by which it is spoken to, ``serial`` or ``tcp``; the timeout of the drive
                file's other one is as delivered, and guards nothing.

        Raises:
            ConfigurationError: the make cannot be simulated.
        """
        self._file, self._settings, self._say = file, settings, say
        self.speed = 0.0
        self.flow = flow
        self._at = now
        self._answers_from = now
        self._guarded_from = -math.inf
        self._heard: float | None = None
        self._stuck: float | None = None
        self._speed_stays = self._runs_on = False
        self._absurd: int | None = None
        profile = profile_of(file.make)
        own = file.timeout.known.get(interface)
        if own is None:
            raise ConfigurationError(
                "is missing: a drive without a communication timeout cannot be simulated",
                file=file.path, key=f"timeout.{interface}",
            )
        self._timeout = own
        self._roles = {own.register: "timeout_time"}
        if own.action is not None:
            self._roles[own.action.register] = "timeout_action"
        if own.mode is not None:
            self._roles[own.mode.register] = "loss_mode"
        idle = {
            name: profile.DELIVERED[role]
            for one in file.timeout.known.values()
            for name, role in (
                (one.register, "timeout_time"),
                *(((one.action.register, "timeout_action"),) if one.action else ()),
            )
            if name not in self._roles
        }
        self._written = {
            step.write
            for steps in (
                file.sequences.ready, file.sequences.run, file.sequences.stop, file.sequences.reset
            )
            for step in steps
        } | {"control", "reference"}
        raw = idle | {self._roles.get(name, name): 0 for name in self._written | set(self._roles)}
        raw |= {name: value for name, (_, value) in profile.EXTRA.items()}
        raw |= self._settings_of(profile)
        self.profile = profile(raw, interface)
        self.profile.runs_locally = profile.RUNS_AS_DELIVERED and settings.timeout_s is None

    def _settings_of(self, profile: type[ControlProfile]) -> Mapping[str, int]:
        """Return the registers of the timeout as they are set."""
        if self._settings.timeout_s is None:
            return profile.DELIVERED
        register = self._file.registers[self._timeout.register]
        seconds = min(self._settings.timeout_s, register.high)
        return {
            "timeout_time": max(1, round(seconds / register.scale)),
            "timeout_action": profile.STOPS,
        }

    # --- time -------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Let time pass: ramps, and the communication timeout where it falls."""
        loss = self._loss_at()
        if loss <= now:
            self._move(loss)
            self.profile.lost, self._runs_on = True, False
            self.profile.communication_lost()
            self._say(
                f"communication timeout: nothing for {loss - (self._heard or 0):.3g} s; "
                f"{self.profile.motion.value}"
            )
        self._move(now)

    def answers(self, now: float) -> bool:
        """Tell whether it is under power and has booted."""
        return now >= self._answers_from

    def power_cycle(self, now: float) -> None:
        """Lose power for a moment: the motor coasts, and nothing answers until it has booted."""
        self.advance(now)
        self._answers_from = now + self._settings.boot_s
        self._guarded_from = self._answers_from + self.profile.UNGUARDED_S
        self._heard = None
        self.profile.lost = False
        if not self.profile.fault_stands:
            self.profile.trip(0)
        for name in self._written:
            self.profile.raw[self._roles.get(name, name)] = 0
        self.profile.power_up()
        self._say(f"power cycle: answers again in {self._settings.boot_s:g} s")

    def _loss_at(self) -> float:
        """When the timeout falls if nothing more is heard; infinity if it does not."""
        raw, _ = self.profile.guard
        timeout = self._timeout
        if self._heard is None or self.profile.lost or raw == 0 or raw in timeout.off_values:
            return math.inf
        seconds = raw * self._file.registers[timeout.register].scale
        return max(self._heard + seconds, self._guarded_from)

    def _move(self, now: float) -> None:
        """Turn the motor until a time."""
        step = max(0.0, now - self._at)
        self._at = max(now, self._at)
        if self._stuck is not None:
            self.speed = self._stuck
            return
        motion = self._motion()
        if self._ignores_stop:
            self.profile.standstill()  # as far as its state machine knows
            return
        if not self._speed_stays and motion is not Motion.HOLD:
            wanted = self._wanted() if motion is Motion.FOLLOW else 0.0
            slow = motion is Motion.COAST
            full = self._settings.coast_s if slow else self._settings.ramp_s
            reach = self._settings.speed * step / full if full else math.inf
            self.speed += min(max(wanted - self.speed, -reach), reach)
        if abs(self.speed) < _NOT_MOVING:
            self.speed = 0.0
            self.profile.standstill()

    def _motion(self) -> Motion:
        return self.profile.motion if self.answers(self._at) else Motion.COAST

    @property
    def _ignores_stop(self) -> bool:
        """Whether it is told to stop, and runs on while it says that it is off."""
        told = self._motion() is not Motion.FOLLOW or not self._wanted()
        return self._runs_on and told and self.answers(self._at)

    def _wanted(self) -> float:
        """The speed that the drive ramps to (share of rated); pumps do not turn backwards."""
        if self.profile.share is not None:
            return self.profile.share
        register = self._file.registers["reference"]
        raw = self.profile.raw["reference"]
        signed = raw - 65536 if register.type == "int16" and raw > 32767 else raw
        return min(max(signed * self._unit(register), 0.0), 1.0)

    # --- registers --------------------------------------------------------------------------------

    def addresses(self) -> dict[int, bool]:
        """Return every register there is, and whether it can be written."""
        found = {}
        for name, register in self._file.registers.items():
            for address in range(register.address, register.address + register.width):
                found[address] = name in self._written or name in self._roles
        return found | {address: True for address, _ in self.profile.EXTRA.values()}

    def registers(self, now: float) -> dict[int, int]:
        """Return what every register holds."""
        self.advance(now)
        found = {address: self.profile.raw[name]
                 for name, (address, _) in self.profile.EXTRA.items()}
        for name, register in self._file.registers.items():
            words = self._words(name, register)
            found |= dict(enumerate(words, start=register.address))
        return found

    def heard(self, now: float) -> None:
        """Take in a request, whatever becomes of it: with some makes that is a sign of life."""
        self.advance(now)
        if self.profile.read():
            self._hear(now)

    def write(self, address: int, values: list[int], now: float) -> ExcCodes | None:
        """Take in what a client writes, a register after the other."""
        self.advance(now)
        names = self._names()
        for offset, value in enumerate(values):
            if address + offset not in names:
                return ExcCodes.ILLEGAL_ADDRESS
            name, place, width = names[address + offset]
            if width == 2:  # one half of 32 bits
                shift = 0 if place else 16
                kept = self.profile.raw[name] & ~(0xFFFF << shift)
                self.profile.raw[name] = kept | value << shift
            else:
                self.profile.raw[name] = value
            before = self.profile.motion
            if self.profile.wrote(name):
                self._hear(now)
            if self.profile.motion is not before:
                self._say(f"{name} = 0x{value:04X}: {self.profile.motion.value}")
        self._move(now)
        return None

    def _hear(self, now: float) -> None:
        if self.profile.lost:
            self._say("hears from its client again")
        self.profile.lost = False
        self._heard = now

    def _names(self) -> dict[int, tuple[str, int, int]]:
        """Name and half of each register that can be written, and the width of its value."""
        found = {address: (name, 0, 1) for name, (address, _) in self.profile.EXTRA.items()}
        for name, register in self._file.registers.items():
            if name in self._written or name in self._roles:
                for offset in range(register.width):
                    low_first = register.word_order == "low first"
                    found[register.address + offset] = (
                        self._roles.get(name, name), offset ^ low_first, register.width
                    )
        return found

    def _words(self, name: str, register: Register) -> list[int]:
        """Return the words of a register of the drive file."""
        kind, order = register.type, register.word_order
        if kind == "text":
            text = f"simulated {self._file.make}".ljust(2 * register.width)[:2 * register.width]
            return [int.from_bytes(text[at:at + 2].encode("ascii"), "big")
                    for at in range(0, len(text), 2)]
        role = self._roles.get(name, name)
        if role in self.profile.raw:
            value = self.profile.raw[role]
            return [value] if register.width == 1 else encode(value, "uint32", order)
        if name == "status":
            return encode(self._status(), kind, order)
        if name == "speed":
            if self._absurd is not None:
                return [self._absurd & 0xFFFF] * register.width
            return encode(self.speed / self._unit(register), kind, order)
        if name == "flow":
            return encode(self.flow(self.speed) / register.scale, kind, order)
        return encode(self._constant(name, register), kind, order)

    def _constant(self, name: str, register: Register) -> float:
        """What a register holds that neither moves nor can be written."""
        if name == self._file.faults.register:
            return self.profile.fault_register
        if any(each.full_scale == name for each in self._file.registers.values()):
            hertz = "Hz" in register.meaning
            return (10 * _RATED_FREQUENCY if hertz else _RATED_RPM) / register.scale
        return 0.0

    def _unit(self, register: Register) -> float:
        """The value of one count (share of rated)."""
        if not register.full_scale:
            return register.scale
        scale = self._file.registers[register.full_scale]
        return register.scale / (scale.scale * self._constant(register.full_scale, scale))

    def _status(self) -> int:
        follows = self.profile.motion is Motion.FOLLOW
        return self.profile.status(Seen(
            moving=self.speed > 0 and not self._ignores_stop,
            at_speed=follows and abs(self.speed - self._wanted()) < _AT_SPEED,
            warning=self.profile.lost and not self.profile.fault,
        ))

    # --- the workbench ----------------------------------------------------------------------------

    def no_fault(self, now: float) -> None:
        """End what was done to the drive; a trip stays until it is reset."""
        self.advance(now)
        self._stuck = self._absurd = None
        self._speed_stays = self._runs_on = self.profile.fault_stands = False

    def trip(self, code: int, now: float) -> None:
        """Trip the drive; until `no_fault` it cannot be reset.

        Args:
            code: as its register of faults shows it; 0 for the first one of the drive file.
            now: present time (s).
        """
        self.advance(now)
        faults = self._file.faults
        if not code:
            code = next(iter(faults.texts), 1)
            code = 1 << code if faults.kind == "bits" else code
        self.profile.fault_stands = True
        self.profile.trip(code)
        self._say(f"trips: {faults.text(code)}")

    def hold_speed(self, now: float) -> None:
        """Let the speed stay as it is, whatever the state."""
        self.advance(now)
        self._speed_stays = True

    def run_stuck(self, speed: float, now: float) -> None:
        """Run on, as with a welded contactor, whatever the state.

        Args:
            speed: share of rated; 0 for the present one, or half of rated from rest.
            now: present time (s).
        """
        self.advance(now)
        self._stuck = speed or self.speed or 0.5
        self._move(now)

    def run_on(self, now: float) -> None:
        """Run on when told to stop, and say otherwise, until the communication timeout passes."""
        self.advance(now)
        self._runs_on = True

    def show_speed(self, raw: int) -> None:
        """Let the register of the speed hold something else."""
        self._absurd = raw

    def disable_timeout(self, now: float) -> None:
        """Turn the communication timeout off, as somebody may at the panel."""
        self.advance(now)
        timeout = self._timeout
        if timeout.action is not None:
            self.profile.raw["timeout_action"] = min(timeout.action.runs_on)
        else:
            self.profile.raw["timeout_time"] = min(timeout.off_values, default=0)
        self.profile.take_over_settings()

    def take_over(self, local: bool, now: float) -> None:
        """Take the drive over at its panel, or hand it back to the bus."""
        self.advance(now)
        self.profile.local = local
