"""Operation of a single Modbus drive according to its drive file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.devices.drive_file import (
    DriveFile,
    Register,
    RegisterCondition,
    Step,
    Timeout,
)
from greenroof_ros.live.devices.modbus_line import Address, DriveError, ModbusLine, decode, limits
from greenroof_ros.physics.pump import STANDSTILL

TIMEOUT_S = 0.5
"""maximum time to wait for each response (s)"""
# Time between two checks of whether a drive has reached a state (s).
_POLL_S = 0.05


@dataclass(frozen=True)
class DriveStatus:
    """The status that a drive reports.

    Attributes:
        ready: whether neither a fault nor an interlock prevents the drive from starting.
        running: whether the motor is energized.
        fault: description of the active fault, including a pump that turns backwards; empty for
            none, and for the expiry of the drive's own communication timeout.
        speed: speed (share of the rated speed); negative only if the pump turns backwards.
        flow: flow of the pump (m3/s); None if the drive does not measure the flow.
        remote: whether the drive is controlled over the bus.
        timed_out: whether the drive's own communication timeout has stopped it.
        runs_on: whether the fault is that the drive does not obey *stop*.
    """

    ready: bool
    running: bool
    fault: str
    speed: float
    flow: float | None = None
    remote: bool = True
    timed_out: bool = False
    runs_on: bool = False

    @property
    def at_rest(self) -> bool:
        """Whether the drive reports standstill."""
        return abs(self.speed) <= STANDSTILL

    def __str__(self) -> str:
        state = "running" if self.running else "off"
        return f"speed {self.speed:.1%}, {state}{'' if self.remote else ', local control'}"


class Drive:
    """A drive on a single connection, which the caller opens and closes.

    Attributes:
        line: the connection.
        may_run: function that is called before each step of a start and while waiting; if it
            returns False, the start is abandoned.
    """

    def __init__(self, file: DriveFile, address: Address, timeout_s: float = TIMEOUT_S) -> None:
        """Prepare the drive without opening a connection.

        Args:
            file: the drive file.
            address: address of the drive.
            timeout_s: maximum time to wait for a connection and for each response (s).
        """
        self.line = ModbusLine(address, file.serial, timeout_s)
        self.may_run: Callable[[], bool] = lambda: True
        self._file, self._interface = file, address.interface
        self._timeout = file.timeout.get(address.interface)
        self._full_scale: dict[str, float] = {}
        # Whether `ready` was carried out since the last *stop*.
        self._prepared = False
        # The control word written last; None if it is unknown whether that write succeeded.
        self._word: int | None = None
        # Whether the drive has returned a control word that was written.
        self._echoes = False

    def timeout(self) -> tuple[float | None, str]:
        """Return the drive's own communication timeout (s), or None and the reason if it is off.

        A timeout that would not stop the drive is treated as off. The call also discards the cached
        values of the full-scale registers, which are read again when needed.

        Raises:
            DriveError: if the timeout cannot be read.
        """
        self._full_scale.clear()
        timeout = self._timeout
        if timeout is None:
            return None, (
                f"{self._file.path} does not describe timeout.{self._interface}; if the address is "
                "a gateway to the drive's serial port, write gateway://HOST:PORT"
            )
        seconds = self._value(timeout.register)
        if seconds <= 0:
            return None, f"{self._named(timeout.register)} is {seconds:g} s, which means off"
        for setting in filter(None, (timeout.action, timeout.mode)):
            if (chosen := self._raw(setting.register)) not in setting.stops:
                right = " or ".join(f"{key} ({text})" for key, text in setting.stops.items())
                return None, (
                    f"{self._named(setting.register)} is {chosen}, but must be {right}; the pump "
                    "might run on"
                )
        return seconds, ""

    def read(self) -> DriveStatus:
        """Return the status that the drive reports.

        Raises:
            DriveError: if the status cannot be read or contains an impossible value.
        """
        status, word = self._file.status, self._raw("status")
        fault, causes = self._fault(word)
        trips = () if self._timeout is None else self._timeout.trips
        timed_out = bool(causes) and causes.issubset(trips)
        speed = self._value("speed")
        if speed < -STANDSTILL:
            backwards = f"the pump is turning backwards (speed {speed:.1%})"
            fault, timed_out = "; ".join(filter(None, (fault, backwards))), False
        flow, meter = None, self._file.registers.get("flow")
        if meter is not None and (raw := self._raw("flow")) != meter.missing:
            flow = self._scaled("flow", raw)
        return DriveStatus(
            self._holds(status.ready, word), self._holds(status.running, word),
            "" if timed_out else fault, speed if speed < -STANDSTILL else max(0.0, speed), flow,
            status.remote is None or self._holds(status.remote, word), timed_out,
        )

    def run(self, speed: float) -> None:
        """Make the drive ready if needed, then write the speed and the control word.

        The caller repeats the call while the pump must run, because many drives stop if nothing is
        written to them.

        Args:
            speed: requested speed (share of the rated speed), 0 to 1.

        Raises:
            DriveError: if no valid response arrives, a fault is active, or a state is not reached
                in time.
        """
        word = self._raw("status")
        if fault := self._fault(word)[0]:
            raise self.line.error("drive", f"fault: {fault}")
        running = self._prepared and self._holds(self._file.status.running, word)
        if not self._prepared and not self._perform(self._file.sequences.ready, self.may_run):
            return
        self._prepared = True
        self._write("reference", self._encode(speed))
        self._perform(self._file.sequences.run, self.may_run, wait=not running)

    def stop(self) -> None:
        """Ramp the pump down, and switch it off.

        The caller repeats the call while the pump must be off.

        If the drive rejects a step, the later steps are still written, since it may accept a speed
        of 0 even if it rejects the control word. After that, the drive must also respond to a
        request for its status. The response to a write is not sufficient, because it is identical
        to the request and may therefore be an echo from the line.

        Raises:
            DriveError: if no valid response arrives.
        """
        self._prepared, refused = False, None
        for step in (*self._file.sequences.stop, Step("reference", 0)):
            try:
                self._perform([step])
            except DriveError as error:
                refused = refused or error
                if error.kind == "connection":
                    break
        if refused is not None:
            raise refused
        self._raw("status")

    def reset(self) -> None:
        """Stop the drive, and acknowledge its fault.

        Raises:
            DriveError: if no valid response arrives; the fault then remains.
        """
        self.stop()
        self._perform(self._file.sequences.reset)

    def second_master(self) -> Diagnosis | None:
        """Return a diagnosis if another writer is known to have changed the control word.

        Only the bits that the drive file uses are compared. Some drives do not return their control
        word when it is read, so nothing is compared until the drive has returned a written word on
        this connection.

        Raises:
            DriveError: if the connection is lost.
        """
        if self._word is None:
            return None
        try:
            word = self._raw("control")
        except DriveError as error:
            if error.kind == "connection":
                raise
            return None
        differs = word ^ self._word
        steps = [step for steps in vars(self._file.sequences).values() for step in steps]
        same = not any(differs & step.value for step in steps if step.write == "control")
        self._echoes |= same
        if same or not self._echoes:
            return None
        return Diagnosis.of(
            "second_master", "word", where=self.line.where, word=word, written=self._word)

    # --- sequences --------------------------------------------------------------------------------

    def _perform(
        self, steps: Iterable[Step], may_continue: Callable[[], bool] = lambda: True,
        wait: bool = True,
    ) -> bool:
        """Carry out the steps of a sequence, and return True if all steps were completed.

        Args:
            steps: the steps, in order.
            may_continue: function called before each step and while waiting; if it returns False,
                the remaining steps are omitted.
            wait: whether to wait for the condition of each step.
        """
        for step in steps:
            if not may_continue():
                return False
            self._write(step.write, step.value)
            until, deadline = step.until, time.monotonic() + step.within_s
            while wait and until and not until.fulfilled_by(raw := self._raw(until.register)):
                if not may_continue():
                    return False
                if time.monotonic() > deadline:
                    problem = f"had no effect within {step.within_s:g} s; {until.register} is"
                    raise self.line.error(
                        "drive", f"{step.write} = 0x{step.value:04X} {problem} 0x{raw:04X}")
                time.sleep(_POLL_S)
        return True

    def _write(self, name: str, word: int) -> None:
        if name == "control":
            self._word = None
        self.line.write(self._file.registers[name].address, word)
        if name == "control":
            self._word = word

    def _holds(self, condition: RegisterCondition, word: int) -> bool:
        """Return whether a condition is fulfilled, given the status word."""
        other = condition.register != "status"
        return condition.fulfilled_by(self._raw(condition.register) if other else word)

    def _fault(self, word: int) -> tuple[str, set[int]]:
        """Return the text and the codes of the active fault; empty for none."""
        faults = self._file.faults
        if not self._holds(self._file.status.fault, word):
            return "", set()
        raw = self._raw(faults.register)
        return faults.describe(raw), faults.reported(raw)

    # --- values -----------------------------------------------------------------------------------

    def _raw(self, name: str) -> int:
        register = self._file.registers[name]
        words = self.line.read(register.address, register.width)
        raw = decode(words, register.type, register.word_order)
        assert isinstance(raw, int)
        return raw

    def _scaled(self, name: str, raw: float) -> float:
        """Return a register's value in its unit.

        Raises:
            DriveError: if the value is implausible.
        """
        register = self._file.registers[name]
        value = raw * self._factor(register)
        if not register.low <= value <= register.high:
            raise self.line.error(
                "answer",
                f"{self._named(name)} is {raw}: {value:g}; plausible values are {register.low:g} "
                f"to {register.high:g}",
            )
        return value

    def _value(self, name: str) -> float:
        return self._scaled(name, self._raw(name))

    def _factor(self, register: Register) -> float:
        """Return the factor that converts a raw value to the register's unit."""
        full = register.full_scale
        if not full:
            return register.scale
        if full not in self._full_scale:
            self._full_scale[full] = self._value(full)
        return register.scale / self._full_scale[full]

    def _encode(self, speed: float) -> int:
        register = self._file.registers["reference"]
        raw = round(speed / self._factor(register))
        low, high = limits(register.type)
        if not low <= raw <= high:
            problem = f"{raw}, a speed of {speed:.1%}, is too large for {self._named('reference')}"
            raise self.line.error("drive", problem)
        return raw

    def _named(self, name: str) -> str:
        register = self._file.registers[name]
        return f"{register.meaning} (register {register.manual})"


@dataclass(frozen=True)
class DriveEndpoint:
    """A drive of a certain make, with its address.

    Attributes:
        file: the drive file.
        address: address of the drive.
    """

    file: DriveFile
    address: Address

    # Time between two rounds of requests (s).
    period = 0.1

    def __str__(self) -> str:
        return str(self.address)

    @property
    def guard(self) -> Timeout:
        """The drive's communication timeout at this address."""
        return self.file.timeout.get(self.address.interface, Timeout("", "not described"))

    def lock_name(self) -> str:
        """Return the name of the drive's lock, which is the same for all spellings of the address.

        The name identifies the drive, or its entire serial line. The call may block while the
        host name is resolved.

        Raises:
            OSError: if the host is unknown or no name server responds.
        """
        place = self.address.canonical_name().strip("/")
        device_id = self.file.serial.device_id_at(self.address)
        return place if self.address.line else f"{place}-{device_id}"

    def connection(self) -> Drive:
        """Return the drive on a new connection that is not yet open and must be opened only once.

        Raises:
            ConfigurationError: if the Modbus library is not installed.
        """
        return Drive(self.file, self.address)
