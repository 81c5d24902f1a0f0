"""Operation of a single Modbus drive according to its drive file."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.devices.drive_file import (
    LIMIT_S,
    Codes,
    DriveFile,
    Register,
    RegisterCondition,
    Step,
    Timeout,
)
from greenroof_ros.live.devices.modbus_line import Address, DriveError, decode, limits
from greenroof_ros.physics.pump import STANDSTILL

# Time between two checks of whether a drive has reached a state (s).
_POLL_S = 0.05
_LOCAL = "; the drive is in local control: switch it to bus control at its panel"


@dataclass(frozen=True)
class DriveStatus:
    """The status that a drive reports.

    Attributes:
        ready: whether neither a fault nor an interlock prevents the drive from starting.
        running: whether the motor is energized.
        fault: description of the active fault, including a pump that turns backwards; empty for
            none.
        warning: description of the active warning; empty for none.
        speed: speed (share of the rated speed); negative only if the pump turns backwards.
        flow: flow of the pump (m3/s); None if the drive does not measure the flow.
        remote: whether the drive is controlled over the bus.
        timed_out: whether the only fault is the expiry of the drive's own communication timeout.
        runs_on: whether the fault is a speed that does not fall after *stop*.
    """

    ready: bool
    running: bool
    fault: str
    warning: str
    speed: float
    flow: float | None
    remote: bool
    timed_out: bool = False
    runs_on: bool = False

    @property
    def at_rest(self) -> bool:
        """Whether the drive reports standstill."""
        return abs(self.speed) <= STANDSTILL

    def __str__(self) -> str:
        return ", ".join(filter(None, (
            f"speed {self.speed:.1%}", "running" if self.running else "off",
            "" if self.remote else "local control", self.fault and f"fault: {self.fault}",
            self.warning and f"warning: {self.warning}",
        )))


class Drive:
    """A drive on a single connection, which the caller opens and closes.

    Attributes:
        file: the drive file.
        line: the connection.
        stopped: whether the last `stop` on this connection was confirmed; None before any `stop`.
    """

    def __init__(self, file: DriveFile, address: Address, timeout_s: float = 0.5) -> None:
        """Prepare the drive without opening a connection.

        Args:
            file: the drive file.
            address: address of the drive.
            timeout_s: maximum time to wait for a connection and for each response (s).
        """
        self.file, self.line = file, file.line(address, timeout_s)
        self.stopped: bool | None = None
        self._address, self._timeout = address, file.timeout.guarding(address)
        self._full_scale: dict[str, float] = {}
        # False: the state in which someone else left the drive is unknown.
        self._prepared = False
        # The control word written last; None if it is unknown whether that write succeeded.
        self._word: int | None = None
        # Whether the drive has returned a control word that was written.
        self._echoes = False
        # The bits of the control word that the drive file uses.
        self._bits = 0
        for steps in vars(file.sequences).values():
            for step in steps:
                if step.write == "control":
                    self._bits |= step.value

    def identify(self) -> str:
        """Return the drive's make, model and nameplate as text.

        Raises:
            DriveError: if the nameplate cannot be read.
        """
        parts = []
        for plate in self.file.nameplate:
            raw = self._read_raw(plate.register)
            text = plate.texts.get(raw, str(raw)) if isinstance(raw, int) else str(raw)
            parts.append(f"{self.file.registers[plate.register].meaning}: {text}")
        return f"{self.file.make} {self.file.model} ({'; '.join(parts)})"

    def timeout(self) -> tuple[float | None, str]:
        """Return the drive's own communication timeout (s), or None and the reason if it is off.

        A timeout that would not stop the drive is treated as off. The call also discards the cached
        values of the full-scale registers, which are read again when needed.

        Raises:
            DriveError: if the timeout cannot be read, or the drive file describes none for this
                interface.
        """
        self._full_scale.clear()
        timeout = self._timeout
        if timeout is None:
            raise self.line.error(
                "answer",
                f"{self.file.path} does not describe a communication timeout for this interface "
                f"(timeout.{self._address.interface}); if the address is a gateway to the drive's "
                "serial port, write gateway://HOST:PORT",
            )
        raw = self._read_raw(timeout.register)
        seconds = self._scaled(timeout.register, raw)
        if raw in timeout.off_values or seconds is None or seconds <= 0:
            return None, f"{self._named(timeout.register)} is {raw}, which means off"
        for setting in (timeout.action, timeout.mode):
            if setting is None:
                continue
            chosen = self._read_number(setting.register)
            if chosen not in setting.stops:
                text = setting.runs_on.get(chosen, "not in the drive file")
                return None, (
                    f"{self._named(setting.register)} is {chosen}: {text}; the pump might run on"
                )
        return seconds, ""

    def read(self) -> DriveStatus:
        """Return the status that the drive reports.

        Raises:
            DriveError: if the status cannot be read or contains an impossible value.
        """
        status, values = self.file.status, dict[str, int]()
        fault, warning, timed_out = "", "", False
        if self._fulfils(status.fault, values):
            raw, fault = self._cause(self.file.faults)
            trips = () if self._timeout is None else self._timeout.trips
            timed_out = self.file.faults.only(raw, trips)
        if status.warning is not None and self._fulfils(status.warning, values):
            _, warning = self._cause(self.file.warnings)
        speed = self._available("speed")
        if -STANDSTILL <= speed <= 0:
            speed = 0.0
        elif speed < 0:
            backwards = f"the pump is turning backwards (speed {speed:.1%})"
            fault, timed_out = "; ".join(filter(None, (fault, backwards))), False
        flow = None
        if "flow" in self.file.registers:
            flow = self._scaled("flow", self._read_raw("flow"))
        return DriveStatus(
            self._fulfils(status.ready, values), self._fulfils(status.running, values), fault,
            warning, speed, flow, remote=not self.local(values), timed_out=timed_out,
        )

    def local(self, values: dict[str, int] | None = None) -> bool:
        """Return whether the drive is under local control; False if its file does not define this.

        Args:
            values: raw values that have just been read, by register.

        Raises:
            DriveError: if the status cannot be read.
        """
        remote = self.file.status.remote
        return remote is not None and not self._fulfils(remote, {} if values is None else values)

    def run(self, speed: float, may_continue: Callable[[], bool] = lambda: True) -> None:
        """Make the drive ready if needed, then write the speed and the control word.

        The caller repeats the call while the pump must run, because many drives stop if nothing is
        written to them.

        Args:
            speed: requested speed (share of the rated speed), 0 to 1.
            may_continue: function that is called before each step and while waiting; if it returns
                False, the sequence is abandoned.

        Raises:
            DriveError: if no valid response arrives, a fault is active, or a state is not reached
                in time.
        """
        values: dict[str, int] = {}
        if self._fulfils(self.file.status.fault, values):
            raise self.line.error("drive", f"fault: {self._cause(self.file.faults)[1]}")
        if not self._prepared or not self._fulfils(self.file.status.enabled, values):
            if not self._perform(self.file.sequences.ready, may_continue):
                return
            self._prepared = True
            values.clear()
        self._perform(self.file.sequences.run, may_continue, speed, values)

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
        self.stopped = False
        refused: DriveError | None = None
        for step in self.file.sequences.stop:
            try:
                self._perform([step])
            except DriveError as error:
                refused = refused or error
                if error.kind == "connection":
                    break
        if refused is not None:
            raise refused
        self._read_number(self.file.status.running.register)
        self.stopped = True

    def reset(self) -> None:
        """Stop the drive, and acknowledge its fault.

        Raises:
            DriveError: if no valid response arrives; the fault then remains.
        """
        self.stop()
        self._prepared = False
        self._perform(self.file.sequences.reset)

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
            word = self._read_number("control")
        except DriveError as error:
            if error.kind == "connection":
                raise
            return None
        same = not (word ^ self._word) & self._bits
        self._echoes |= same
        if same or not self._echoes:
            return None
        return Diagnosis.of(
            "second_master", "word", "pause", where=self.line.where, word=word, written=self._word,
            pause=LIMIT_S,
        )

    # --- sequences --------------------------------------------------------------------------------

    def _perform(
        self,
        steps: Iterable[Step],
        may_continue: Callable[[], bool] = lambda: True,
        speed: float = 0.0,
        values: dict[str, int] | None = None,
    ) -> bool:
        """Carry out the steps of a sequence, and return True if all steps were completed.

        Args:
            steps: the steps, in order.
            may_continue: function called before each step and while waiting; if it returns False,
                the remaining steps are omitted.
            speed: value for the step that writes the speed (share of the rated speed).
            values: raw values that have just been read, by register; the call does not wait for a
                condition that these values already satisfy.
        """
        for step in steps:
            if not may_continue():
                return False
            word = self._encoded(step.write, speed) if isinstance(step.value, str) else step.value
            if step.write == "control":
                self._word = None
            self.line.write(self.file.registers[step.write].address, word)
            if step.write == "control":
                self._word = word
            until = step.until
            if until is None or (values and until.register in values
                                 and until.fulfilled_by(values[until.register])):
                continue
            if not self._wait_for(step, until, word, may_continue):
                return False
        return True

    def _wait_for(
        self, step: Step, until: RegisterCondition, word: int, may_continue: Callable[[], bool]
    ) -> bool:
        """Wait until the drive reports a state; return False if `may_continue` ended the wait."""
        deadline = time.monotonic() + step.within_s
        while not self._fulfils(until, now := dict[str, int]()):
            if not may_continue():
                return False
            if time.monotonic() > deadline:
                raw, texts = now[until.register], self.file.status.bits.items()
                bits = ""
                if until.register == "status":
                    bits = f": {', '.join(text for bit, text in texts if raw >> bit & 1)}"
                raise self.line.error(
                    "drive",
                    f"{step.write} = 0x{word:04X} had no effect within {step.within_s:g} s; "
                    f"{until.register} is 0x{raw:04X}, not 0x{until.value:04X} under the mask "
                    f"0x{until.mask:04X}{bits}" + (_LOCAL if self.local(now) else ""),
                )
            time.sleep(_POLL_S)
        return True

    # --- values -----------------------------------------------------------------------------------

    def _fulfils(self, condition: RegisterCondition, values: dict[str, int]) -> bool:
        if condition.register not in values:
            values[condition.register] = self._read_number(condition.register)
        return condition.fulfilled_by(values[condition.register])

    def _read_raw(self, name: str) -> int | float | str:
        register = self.file.registers[name]
        return decode(
            self.line.read(register.address, register.width), register.type, register.word_order
        )

    def _cause(self, codes: Codes | None) -> tuple[int, str]:
        """Return the code or bits of the current fault or warning, and its text."""
        raw = 0 if codes is None else self._read_number(codes.register)
        return raw, (codes and codes.text(raw)) or "the drive gives no cause"

    def _read_number(self, name: str) -> int:
        raw = self._read_raw(name)
        assert isinstance(raw, int)
        return raw

    def _scaled(self, name: str, raw: int | float | str) -> float | None:
        """Return a register's value in its unit; None if the drive marks it as not available.

        Raises:
            DriveError: if the value is implausible.
        """
        register = self.file.registers[name]
        assert not isinstance(raw, str)
        if raw == register.missing:
            return None
        value = raw * self._factor(register)
        low = min(register.low, -STANDSTILL) if name == "speed" else register.low
        if not math.isfinite(value) or not low <= value <= register.high:
            raise self.line.error(
                "answer",
                f"{self._named(name)} is {raw}: {f'{value:g} {register.unit}'.strip()}; "
                f"plausible values are {low:g} to {register.high:g}",
            )
        return value

    def _available(self, name: str) -> float:
        """Return a register's value in its unit; if it is not available, raise a DriveError."""
        value = self._scaled(name, self._read_raw(name))
        if value is None:
            raise self.line.error("answer", f"the drive reports its {name} as not available")
        return value

    def _factor(self, register: Register) -> float:
        """Return the factor that converts a raw value to the register's unit."""
        full = register.full_scale
        if not full:
            return register.scale
        if full not in self._full_scale:
            self._full_scale[full] = self._available(full)
        return register.scale / self._full_scale[full]

    def _encoded(self, name: str, value: float) -> int:
        register = self.file.registers[name]
        raw = round(value / self._factor(register))
        low, high = limits(register.type)
        if not low <= raw <= high:
            raise self.line.error(
                "drive",
                f"a speed of {value:.1%} would be {raw} in {self._named(name)}, which can hold "
                f"{low:g} to {high:g}",
            )
        return raw & 0xFFFF

    def _named(self, name: str) -> str:
        register = self.file.registers[name]
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

    # Minimum time between two rounds of requests (s): none.
    period = 0.0

    def __str__(self) -> str:
        return str(self.address)

    @property
    def guard(self) -> Timeout | None:
        """The drive's communication timeout at this address; None if its file describes none."""
        return self.file.timeout.guarding(self.address)

    def lock_name(self) -> str:
        """Return the name of the drive's lock, which is the same for all spellings of the address.

        The name identifies the drive, or its entire serial line. The call may block while the
        host name is resolved.

        Raises:
            OSError: if the host is unknown or no name server responds.
        """
        place = self.address.canonical_name(self.file.tcp.port).strip("/")
        return place if self.address.line else f"{place}-{self.file.device_id_at(self.address)}"

    def connection(self, timeout_s: float = 0.5) -> Drive:
        """Return the drive on a new connection that is not yet open and must be opened only once.

        Args:
            timeout_s: maximum time to wait for a connection and for each response (s).

        Raises:
            ConfigurationError: if the Modbus library is not installed.
        """
        return Drive(self.file, self.address, timeout_s)
