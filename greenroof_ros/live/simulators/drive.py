"""A simulated drive with its motor: registers, sequences, ramp and communication timeout.

The drive obeys its drive file: it runs after the words of *ready* and *run* in their order, and
any control word out of order stops it. Every drive file can therefore be tried. Whether a file is
right, only the manufacturer's manual and the real drive show.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence

from pymodbus.constants import ExcCodes

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.live.devices.drive_file import DriveFile, Register, RegisterCondition
from greenroof_ros.live.devices.modbus_line import Address, decode, encode
from greenroof_ros.live.simulators.server import Server, make_device


class SimulatedDrive:
    """A drive with its motor.

    Attributes:
        ramp_s: ramp time from standstill to the rated speed, or back (s).
        speed: speed of the motor (share of the rated speed).
        flow: function that returns the pump's flow at a speed (m3/s), for a drive that reports the
            flow.
        log: function that prints a line about an event.
        timeout: the communication timeout of the interface in use.
        on: whether the drive is ordered to run.
        lost: whether the bus has been silent for longer than the timeout.
        fault: code, or bits, of the active fault; 0 for none.
    """

    ramp_s = 5.0

    def __init__(self, file: DriveFile, interface: str = "serial", timeout_s: float = 5.0) -> None:
        """Create a stopped drive whose power has been on for a long time.

        Args:
            file: the drive file.
            interface: interface in use, ``serial`` or ``tcp``; the timeout of the other interface
                is off.
            timeout_s: communication timeout (s), rounded to the resolution of its register.

        Raises:
            ConfigurationError: if the drive file has no timeout for that interface.
        """
        if interface not in file.timeout:
            raise ConfigurationError(
                "is missing: a drive without a communication timeout cannot be simulated",
                file=file.path, key=f"timeout.{interface}",
            )
        self.timeout = file.timeout[interface]
        self.flow: Callable[[float], float] = lambda speed: 0.0
        self.log: Callable[[str], None] = lambda text: None
        self.speed, self.fault, self.on, self.lost = 0.0, 0, False, False
        self._file, self._registers = file, file.registers
        self._at, self._last_request = time.monotonic(), math.inf
        sequences = file.sequences
        self._ready = [(step.write, step.value) for step in sequences.ready]
        self._run, self._stop = sequences.run[-1].value, sequences.stop[0].value
        # The control words that only *reset* has clear a fault.
        self._resets = {step.value for step in sequences.reset if step.write == "control"}
        self._resets -= {self._run, self._stop, *(value for _, value in self._ready)}
        self._done = 0  # steps of *ready* so far
        self._names = {
            address: name for name in self._registers for address in self._addresses(name)
        }
        self._words = dict.fromkeys(self._names, 0)
        for register in self._registers.values():
            if register.full_scale:  # 50 Hz or 750 rpm
                scale = self._registers[register.full_scale]
                self.write_raw(register.full_scale, 2.5 * scale.low / scale.scale)
        timer = self._registers[self.timeout.register]
        self.write_raw(
            self.timeout.register, max(1, round(min(timeout_s, timer.high) / timer.scale))
        )
        for setting in filter(None, (self.timeout.action, self.timeout.mode)):
            self.write_raw(setting.register, min(setting.stops))

    # --- orders -----------------------------------------------------------------------------------

    def _obey(self, name: str, word: int) -> None:
        """Carry out a step of the sequences, or stop if a control word is out of order."""
        if name == "control" and word in self._resets:
            self.trip(0)
        if self.fault:
            return
        if self._ready[self._done:][:1] == [(name, word)]:
            self._done += 1
        elif name == "control" and word not in (self._run, self._stop):
            self._done = int(self._ready[0] == (name, word))
        if name == "control":
            self.on = word == self._run and self._done == len(self._ready)

    def trip(self, fault: int) -> None:
        """Trip with a fault; 0 clears the current fault."""
        self.fault = fault
        self.switch_off()

    def switch_off(self) -> None:
        """Return to the state after power-up."""
        self.on, self._done = False, 0

    def status(self) -> int:
        """Return a status word for which the conditions in the drive file are true or false."""
        conditions, word = self._file.status, 0
        steps = self._file.sequences.ready[:self._done][-1:]
        steps += self._file.sequences.run[-1:] if self.on else ()
        states: list[tuple[RegisterCondition | None, bool]] = [
            (conditions.remote, True), (conditions.ready, not self.fault),
            *((step.until, True) for step in steps),
            (conditions.running, not self.fault and (self.on or self.speed > 0)),
            (conditions.fault, bool(self.fault)),
        ]
        for condition, is_true in states:
            if condition is None or condition.register != "status":
                continue
            if is_true:
                word = word & ~condition.mask | condition.value
            elif condition.fulfilled_by(word):
                word ^= condition.mask & -condition.mask  # one bit differs
        return word

    # --- time -------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Simulate the drive until now; the communication timeout expires at the exact moment."""
        now = time.monotonic()
        loss = self._loss_at()
        if loss <= now:
            self._move(loss)
            self.lost = True
            self.communication_lost()
            self.log(f"communication timeout: silence for {loss - self._last_request:.3g} s")
        self._move(now)

    def communication_lost(self) -> None:
        """Trip after the timeout, or return to the local settings, which stop the pump."""
        action, trips = self.timeout.action, self.timeout.trips
        if action is None:
            self.switch_off()
        elif self.read_raw(action.register) in action.stops:
            bits = self._file.faults.kind == "bits"
            self.trip(1 << trips[0] if bits and trips else next(iter(trips), 1))

    def _loss_at(self) -> float:
        """Return the time at which the timeout will expire without another request, or infinity."""
        raw = self.read_raw(self.timeout.register)
        if self.lost or raw == 0:
            return math.inf
        return self._last_request + raw * self._registers[self.timeout.register].scale

    def _move(self, now: float) -> None:
        step = max(0.0, now - self._at)
        self._at = max(now, self._at)
        self.turn(step, self.setpoint if self.on else 0.0)

    def turn(self, step: float, target: float) -> None:
        """Let the motor turn towards a speed for a time step (s)."""
        reach = step / self.ramp_s
        self.speed += min(max(target - self.speed, -reach), reach)

    @property
    def setpoint(self) -> float:
        """The requested speed (share of the rated speed), at least 0."""
        reference = self.read_raw("reference") * self._unit(self._registers["reference"])
        return min(max(reference, 0.0), 1.0)

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

    def _unit(self, register: Register) -> float:
        """Return the value of one count (share of the rated speed)."""
        if not register.full_scale:
            return register.scale
        scale = self._registers[register.full_scale].scale
        return register.scale / (scale * self.read_raw(register.full_scale))

    def registers(self) -> Mapping[int, int]:
        """Update all registers, and return their values by address; every reading is a request."""
        self.on_request()
        self.write_raw("status", self.status())
        self.write_raw(self._file.faults.register, self.fault)
        self.write_raw("speed", self.speed / self._unit(self._registers["speed"]))
        if "flow" in self._registers:
            self.write_raw("flow", self.flow(self.speed) / self._registers["flow"].scale)
        return self._words

    def write(self, address: int, values: Sequence[int]) -> ExcCodes | None:
        """Write a client's values to consecutive registers; return an exception code, or None."""
        self.on_request()
        addresses = range(address, address + len(values))
        if any(at not in self._names for at in addresses):
            return ExcCodes.ILLEGAL_ADDRESS
        for at, value in zip(addresses, values, strict=True):
            self._words[at] = value
            self._obey(self._names[at], value)
        return None

    def on_request(self) -> None:
        """Handle any request, which restarts the timeout, as with the most forgiving of drives."""
        self.advance()
        self.lost = False
        self._last_request = self._at


def drive_server(drive: SimulatedDrive, file: DriveFile, address: Address) -> Server:
    """Return the Modbus server of a drive on its TCP port or serial line.

    Args:
        drive: the drive.
        file: drive file of the drive.
        address: address of the drive, as for the pump node; port 0 selects a free port.
    """
    device = make_device(file.serial.device_id_at(address), drive.registers, drive.write)
    return Server(address, [device], file.serial)
