"""One drive on Modbus, driven as its file says."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from greenroof_ros.drives.address import Address
from greenroof_ros.drives.drive_file import Condition, DriveFile, Register, Step
from greenroof_ros.drives.modbus_line import DriveError, ModbusLine
from greenroof_ros.drives.values import decode, limits

# Between two looks at whether a drive has reached a state (s).
_LOOK_S = 0.05
# Slower than this share of rated speed a pump stands.
_STANDS = 0.01
# A speed so little below 0 (share of rated speed) is noise of a pump at rest.
_NOISE = 0.02
_LOCAL = "; it is in local control: hand it over to the bus at its panel"


@dataclass(frozen=True)
class DriveStatus:
    """What a drive says of itself.

    Attributes:
        ready: no fault and no interlock; it would start.
        running: the motor is fed.
        fault: in words; empty for none. That the pump turns backwards is one, too.
        warning: in words; empty for none.
        speed: as share of rated speed; below 0 only where the pump turns backwards.
        flow: m3/s; None where the drive has none.
        remote: it obeys the bus.
        timed_out: the fault is that its own communication timeout has passed, and no other.
        runs_on: the fault is that it was told to stop, and its speed does not fall.
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
    def stands(self) -> bool:
        """Whether the pump does not turn."""
        return abs(self.speed) < _STANDS

    def __str__(self) -> str:
        parts = [f"speed {self.speed:.1%}", "running" if self.running else "off"]
        if not self.remote:
            parts.append("local control")
        if self.fault:
            parts.append(f"fault: {self.fault}")
        if self.warning:
            parts.append(f"warning: {self.warning}")
        return ", ".join(parts)


class Drive:
    """One drive; one connection.

    Attributes:
        file: what the drive is like.
        timeout_note: why its own communication timeout counts as off; empty where it does not.
        stopped: whether the last `stop` on this connection was written; None where there was none.
    """

    def __init__(
        self,
        file: DriveFile,
        address: Address,
        timeout_s: float = 0.5,
    ) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            file: what the drive is like.
            address: where it is.
            timeout_s: longest wait for a connection, and for each answer (s).
        """
        self.file = file
        self.timeout_note = ""
        self.stopped: bool | None = None
        self._timeout, self._interface = file.timeout.over(address), address.interface
        self._line = ModbusLine(
            address, port=file.tcp.port, device_id=file.device_id_at(address), serial=file.serial,
            timeout_s=timeout_s,
        )
        self._full_scale: dict[str, float] = {}
        # What the drive was left in by somebody else is not known.
        self._prepared = False
        # The control word that was written last; None where it is not known what came of it.
        self._word: int | None = None
        # The drive has given back a control word that was written.
        self._echoes = False
        steps = file.sequences
        # The bits of the control word that mean something here.
        self._bits = 0
        for step in (*steps.ready, *steps.run, *steps.stop, *steps.reset):
            if step.write == "control" and isinstance(step.value, int):
                self._bits |= step.value

    @property
    def connected(self) -> bool:
        """Whether the connection stands, as far as this end knows."""
        return self._line.connected

    def connect(self) -> None:
        """Open the connection.

        Raises:
            DriveError: it cannot be opened.
        """
        self._line.connect()

    def close(self) -> None:
        """Close the connection; the drive is left as it is."""
        self._line.close()

    def identify(self) -> str:
        """Return what the nameplate says, for people.

        Raises:
            DriveError: it cannot be read.
        """
        parts = []
        for plate in self.file.nameplate:
            raw = self._raw(plate.register)
            text = plate.texts.get(raw, str(raw)) if isinstance(raw, int) else str(raw)
            parts.append(f"{self.file.registers[plate.register].meaning}: {text}")
        return f"{self.file.make} {self.file.model} ({'; '.join(parts)})"

    def timeout(self) -> float | None:
        """Return the drive's own communication timeout (s) on this connection, None for off.

        Off is also one after which the drive would not stop; `timeout_note` then says why.

        Raises:
            DriveError: it cannot be read, or the drive's file tells of none for this interface.
        """
        own = self._timeout
        if own is None:
            raise DriveError(
                "answer",
                f"{self._line.where}: {self.file.path} tells of none by which a connection there "
                f"is guarded (timeout.{self._interface}); if a gateway to the drive's serial port "
                "is there, the address is gateway://HOST:PORT",
            )
        register = self.file.registers[own.register]
        raw = self._raw(own.register)
        seconds = self._scaled(own.register, raw)
        self.timeout_note = ""
        if raw in own.off_values or seconds is None or seconds <= 0:
            self.timeout_note = f"{register.meaning} (register {register.manual}) is {raw}: off"
        for setting in () if self.timeout_note else own.settings:
            register = self.file.registers[setting.register]
            chosen = self._number(setting.register)
            if chosen not in setting.stops:
                text = setting.runs_on.get(chosen, "not known to the drive's file")
                self.timeout_note = (
                    f"{register.meaning} (register {register.manual}) is {chosen}: {text}; the "
                    "pump might run on"
                )
                break
        return None if self.timeout_note else seconds

    def read(self) -> DriveStatus:
        """Return what the drive says of itself.

        Raises:
            DriveError: it cannot be read, or says what cannot be.
        """
        status, seen = self.file.status, dict[str, int]()
        fault, warning, timed_out = "", "", False
        if self._holds(status.fault, seen):
            raw = self._number(self.file.faults.register)
            fault = self.file.faults.text(raw) or "the drive names no cause"
            trips = () if self._timeout is None else self._timeout.trips
            timed_out = self.file.faults.only(raw, trips)
        if status.warning is not None and self._holds(status.warning, seen):
            warning = "the drive names no cause"
            if self.file.warnings is not None:
                raw = self._number(self.file.warnings.register)
                warning = self.file.warnings.text(raw) or warning
        speed = self._scaled("speed", self._raw("speed"))
        if speed is None:
            raise DriveError("answer", f"{self._line.where}: its speed is not available")
        if -_NOISE <= speed <= 0:
            speed = 0.0
        elif speed < 0:
            backwards = f"the pump turns backwards (speed {speed:.1%})"
            fault, timed_out = "; ".join(filter(None, (fault, backwards))), False
        flow = None
        if "flow" in self.file.registers:
            flow = self._scaled("flow", self._raw("flow"))
        return DriveStatus(
            ready=self._holds(status.ready, seen),
            running=self._holds(status.running, seen),
            fault=fault,
            warning=warning,
            speed=speed,
            flow=flow,
            remote=status.remote is None or self._holds(status.remote, seen),
            timed_out=timed_out,
        )

    def local(self, seen: dict[str, int] | None = None) -> bool:
        """Return whether it is in local control, where the drive's file tells how that is seen.

        Args:
            seen: raw values just read.

        Raises:
            DriveError: it cannot be read.
        """
        remote = self.file.status.remote
        return remote is not None and not self._holds(remote, {} if seen is None else seen)

    def run(self, speed: float, go_on: Callable[[], bool] = lambda: True) -> None:
        """Run at a speed: bring the drive to where it can, then write speed and control word.

        To be called again and again while the pump is to run, since many a drive stops by itself
        unless it is written to.

        Args:
            speed: as share of rated speed, 0 to 1.
            go_on: asked between the steps; where it says no, the sequence ends there.

        Raises:
            DriveError: no or a wrong answer; a fault stands; a state was not reached in time.
            ValueError: the speed is out of range.
        """
        if not 0 <= speed <= 1:
            raise ValueError(f"{speed} is no share of rated speed")
        seen: dict[str, int] = {}
        if self._holds(self.file.status.fault, seen):
            text = self.file.faults.text(self._number(self.file.faults.register))
            raise DriveError("drive", f"{self._line.where}: fault: {text or 'no cause named'}")
        if not self._prepared or not self._holds(self.file.status.enabled, seen):
            if not self._perform(self.file.sequences.ready, go_on):
                return
            self._prepared = True
            seen.clear()
        self._perform(self.file.sequences.run, go_on, speed, seen)

    def stop(self) -> None:
        """Ramp down and switch off; to be called again and again while the pump is to stand.

        A step that the drive refuses does not keep the later ones from being written: a speed of 0
        may get through where the control word does not.

        Raises:
            DriveError: no or a wrong answer.
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
        self.stopped = True

    def reset(self) -> None:
        """Stop, and acknowledge a fault.

        Raises:
            DriveError: no or a wrong answer; the fault does not go.
        """
        self.stop()
        self._prepared = False
        self._perform(self.file.sequences.reset)

    def intruder(self) -> str:
        """Return that the control word is not the one written last; empty where nothing is known.

        Only those bits count that the drive's file uses, and only on a connection on which the
        drive has given back a word that was written: there are some whose control word cannot be
        read, or reads as something else.

        Raises:
            DriveError: there is no connection any more.
        """
        if self._word is None:
            return ""
        try:
            word = self._number("control")
        except DriveError as error:
            if error.kind == "connection":
                raise
            return ""
        if not (word ^ self._word) & self._bits:
            self._echoes = True
            return ""
        if not self._echoes:
            return ""
        return (
            f"{self._line.where}: somebody else writes to the drive: its control word is "
            f"0x{word:04X}, and 0x{self._word:04X} was written (unless the drive itself changed it)"
        )

    def forget_full_scales(self) -> None:
        """Have the registers that others are divided by read again when they are next needed."""
        self._full_scale.clear()

    # --- sequences --------------------------------------------------------------------------------

    def _perform(
        self,
        steps: Iterable[Step],
        go_on: Callable[[], bool] = lambda: True,
        speed: float = 0.0,
        seen: dict[str, int] | None = None,
    ) -> bool:
        """Do the steps; return whether all were done.

        Args:
            steps: in order.
            go_on: asked before each; where it says no, the rest is left.
            speed: what a step that writes the speed writes.
            seen: raw values just read; what already holds in them is not waited for.
        """
        for step in steps:
            if not go_on():
                return False
            if isinstance(step.value, int):
                word = int(step.value)
            else:
                word = self._encoded(step.write, speed)
            if step.write == "control":
                self._word = None
            self._line.write(self.file.registers[step.write].address, word)
            if step.write == "control":
                self._word = word
            until = step.until
            if until is None or (seen and until.register in seen
                                 and until.holds(seen[until.register])):
                continue
            if not self._reached(step, until, word, go_on):
                return False
        return True

    def _reached(
        self, step: Step, until: Condition, word: int, go_on: Callable[[], bool]
    ) -> bool:
        """Wait for a state; return False where the wait was given up because of `go_on`."""
        deadline = time.monotonic() + step.within_s
        while True:
            now: dict[str, int] = {}
            if self._holds(until, now):
                return True
            if not go_on():
                return False
            if time.monotonic() > deadline:
                raw = now[until.register]
                says = f": {self._says(now)}" if until.register == "status" else ""
                raise DriveError(
                    "drive",
                    f"{self._line.where}: {step.write} = 0x{word:04X} had no effect within "
                    f"{step.within_s:g} s; {until.register} is 0x{raw:04X}, not "
                    f"0x{until.value:04X} under the mask 0x{until.mask:04X}{says}"
                    + (_LOCAL if self.local(now) else ""),
                )
            time.sleep(_LOOK_S)

    def _says(self, seen: dict[str, int]) -> str:
        raw = seen.get("status", 0)
        return ", ".join(text for bit, text in self.file.status.bits.items() if raw >> bit & 1)

    # --- values -----------------------------------------------------------------------------------

    def _holds(self, condition: Condition, seen: dict[str, int]) -> bool:
        if condition.register not in seen:
            seen[condition.register] = self._number(condition.register)
        return condition.holds(seen[condition.register])

    def _raw(self, name: str) -> int | float | str:
        register = self.file.registers[name]
        return decode(
            self._line.read(register.address, register.width), register.type, register.word_order
        )

    def _number(self, name: str) -> int:
        raw = self._raw(name)
        assert isinstance(raw, int)
        return raw

    def _factor(self, register: Register) -> float:
        """Return by what a raw value is multiplied."""
        if not register.full_scale:
            return register.scale
        if register.full_scale not in self._full_scale:
            scale, raw = self.file.registers[register.full_scale], self._number(
                register.full_scale
            )
            value = self._believable(scale, raw, raw * scale.scale, scale.low)
            if value <= 0:
                raise DriveError(
                    "answer", f"{self._line.where}: {scale.meaning} is {raw}, which cannot be"
                )
            self._full_scale[register.full_scale] = value
        return register.scale / self._full_scale[register.full_scale]

    def _scaled(self, name: str, raw: int | float | str) -> float | None:
        register = self.file.registers[name]
        assert isinstance(raw, (int, float))
        if raw == register.missing:
            return None
        low = min(register.low, -_NOISE) if name == "speed" else register.low
        return self._believable(register, raw, raw * self._factor(register), low)

    def _believable(
        self, register: Register, raw: int | float, value: float, low: float
    ) -> float:
        if not math.isfinite(value) or not low <= value <= register.high:
            raise DriveError(
                "answer",
                f"{self._line.where}: {register.meaning} (register {register.manual}) is {raw}: "
                f"{f'{value:g} {register.unit}'.strip()}, believable are {low:g} to "
                f"{register.high:g}",
            )
        return value

    def _encoded(self, name: str, value: float) -> int:
        register = self.file.registers[name]
        raw = round(value / self._factor(register))
        low, high = limits(register.type)
        if not low <= raw <= high:
            raise DriveError(
                "drive",
                f"{self._line.where}: a speed of {value:.1%} would be {raw} in {register.meaning} "
                f"(register {register.manual}), which holds {low:g} to {high:g}",
            )
        return raw & 0xFFFF
