"""One drive on Modbus, driven as its file says."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.drives.drive_file import Codes, Condition, DriveFile, Register, Step, Timeout
from greenroof_ros.drives.modbus_line import SIMULATOR, Address, DriveError, decode, limits
from greenroof_ros.model.pump_speed import STANDS

# Between two looks at whether a drive has reached a state (s).
_LOOK_S = 0.05
_LOCAL = "; it is in local control: hand it over to the bus at its panel"


@dataclass(frozen=True)
class DriveStatus:
    """What a drive says of itself.

    Attributes:
        ready: no fault and no interlock; it would start.
        running: the motor is fed.
        fault: in words; empty for none. To turn backwards is a fault, too.
        warning: in words; empty for none.
        speed: as share of rated speed; below 0 only where the pump turns backwards.
        flow: m3/s; None where the drive has none.
        remote: it obeys the bus.
        timed_out: the fault is that its own communication timeout has passed, and no other.
        runs_on: the fault is that its speed does not fall after *stop*.
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
        return abs(self.speed) <= STANDS

    def __str__(self) -> str:
        return ", ".join(filter(None, (
            f"speed {self.speed:.1%}", "running" if self.running else "off",
            "" if self.remote else "local control", self.fault and f"fault: {self.fault}",
            self.warning and f"warning: {self.warning}",
        )))


class Drive:
    """One drive; one connection, which who uses it opens and closes.

    Attributes:
        file: what the drive is like.
        line: the connection.
        stopped: whether the last `stop` on this connection was written; None where there was none.
    """

    def __init__(self, file: DriveFile, address: Address, timeout_s: float = 0.5) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            file: what the drive is like.
            address: where it is.
            timeout_s: longest wait for a connection, and for each answer (s).
        """
        self.file, self.line = file, file.line(address, timeout_s)
        self.stopped: bool | None = None
        self._address, self._timeout = address, file.timeout.over(address)
        self._full_scale: dict[str, float] = {}
        # What the drive was left in by somebody else is not known.
        self._prepared = False
        # The control word that was written last; None where it is not known what came of it.
        self._word: int | None = None
        # The drive has given back a control word that was written.
        self._echoes = False
        # The bits of the control word that mean something here.
        self._bits = 0
        for steps in vars(file.sequences).values():
            for step in steps:
                if step.write == "control":
                    self._bits |= step.value

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

    def timeout(self) -> tuple[float | None, str]:
        """Return its own communication timeout (s) on this connection; for off None, and why.

        Off is also one after which the drive would not stop. The registers that others are divided
        by are read again, too, when they are next needed.

        Raises:
            DriveError: it cannot be read, or the drive's file tells of none for this interface.
        """
        self._full_scale.clear()
        timeout = self._timeout
        if timeout is None:
            raise self.line.error(
                "answer",
                f"{self.file.path} tells of none by which a connection there is guarded "
                f"(timeout.{self._address.interface}); if a gateway to the drive's serial port is "
                "there, the address is gateway://HOST:PORT",
            )
        raw = self._raw(timeout.register)
        seconds = self._scaled(timeout.register, raw)
        if raw in timeout.off_values or seconds is None or seconds <= 0:
            return None, f"{self._named(timeout.register)} is {raw}: off"
        for setting in (timeout.action, timeout.mode):
            if setting is None:
                continue
            chosen = self._number(setting.register)
            if chosen not in setting.stops:
                text = setting.runs_on.get(chosen, "not known to the drive's file")
                return None, (
                    f"{self._named(setting.register)} is {chosen}: {text}; the pump might run on"
                )
        return seconds, ""

    def read(self) -> DriveStatus:
        """Return what the drive says of itself.

        Raises:
            DriveError: it cannot be read, or says what cannot be.
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
        if -STANDS <= speed <= 0:
            speed = 0.0
        elif speed < 0:
            backwards = f"the pump turns backwards (speed {speed:.1%})"
            fault, timed_out = "; ".join(filter(None, (fault, backwards))), False
        flow = None
        if "flow" in self.file.registers:
            flow = self._scaled("flow", self._raw("flow"))
        return DriveStatus(
            self._fulfils(status.ready, values), self._fulfils(status.running, values), fault,
            warning, speed, flow, remote=not self.local(values), timed_out=timed_out,
        )

    def local(self, values: dict[str, int] | None = None) -> bool:
        """Return whether it is in local control, where the drive's file tells how that is seen.

        Args:
            values: raw values just read.

        Raises:
            DriveError: it cannot be read.
        """
        remote = self.file.status.remote
        return remote is not None and not self._fulfils(remote, {} if values is None else values)

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
        values: dict[str, int] = {}
        if self._fulfils(self.file.status.fault, values):
            raise self.line.error("drive", f"fault: {self._cause(self.file.faults)[1]}")
        if not self._prepared or not self._fulfils(self.file.status.enabled, values):
            if not self._perform(self.file.sequences.ready, go_on):
                return
            self._prepared = True
            values.clear()
        self._perform(self.file.sequences.run, go_on, speed, values)

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
        same = not (word ^ self._word) & self._bits
        self._echoes |= same
        if same or not self._echoes:
            return ""
        return (
            f"{self.line.where}: somebody else writes to the drive: its control word is "
            f"0x{word:04X}, and 0x{self._word:04X} was written (unless the drive itself changed it)"
        )

    def why_no_simulator(self) -> str:
        """Return why it is not, for certain, the drive simulator; empty where it is.

        Nothing is written to it, and nothing at all is sent to one that is not at loopback or a
        pseudo-terminal.

        Raises:
            DriveError: nobody answers there, of the kind ``connection``.
        """
        if not self._address.is_here:
            return f"{self._address} is neither at loopback nor a pseudo-terminal"
        try:
            named = self.line.identification()
        except DriveError as error:
            if error.kind == "connection":
                raise
            return f"what is there does not identify itself as that ({error})"
        if named == SIMULATOR:
            return ""
        return f"what is at {self._address} identifies itself as {named[0]!r}, {named[1]!r}"

    # --- sequences --------------------------------------------------------------------------------

    def _perform(
        self,
        steps: Iterable[Step],
        go_on: Callable[[], bool] = lambda: True,
        speed: float = 0.0,
        values: dict[str, int] | None = None,
    ) -> bool:
        """Do the steps; return whether all were done.

        Args:
            steps: in order.
            go_on: asked before each; where it says no, the rest is left.
            speed: what a step that writes the speed writes.
            values: raw values just read; what they fulfil already is not waited for.
        """
        for step in steps:
            if not go_on():
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
            if not self._reached(step, until, word, go_on):
                return False
        return True

    def _reached(
        self, step: Step, until: Condition, word: int, go_on: Callable[[], bool]
    ) -> bool:
        """Wait for a state; return False where the wait was given up because of `go_on`."""
        deadline = time.monotonic() + step.within_s
        while not self._fulfils(until, now := dict[str, int]()):
            if not go_on():
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
            time.sleep(_LOOK_S)
        return True

    # --- values -----------------------------------------------------------------------------------

    def _fulfils(self, condition: Condition, values: dict[str, int]) -> bool:
        if condition.register not in values:
            values[condition.register] = self._number(condition.register)
        return condition.fulfilled_by(values[condition.register])

    def _raw(self, name: str) -> int | float | str:
        register = self.file.registers[name]
        return decode(
            self.line.read(register.address, register.width), register.type, register.word_order
        )

    def _cause(self, codes: Codes | None) -> tuple[int, str]:
        """Return the code, or bits, of a fault or a warning that stands, and its text."""
        raw = 0 if codes is None else self._number(codes.register)
        return raw, (codes and codes.text(raw)) or "the drive names no cause"

    def _number(self, name: str) -> int:
        raw = self._raw(name)
        assert isinstance(raw, int)
        return raw

    def _scaled(self, name: str, raw: int | float | str) -> float | None:
        """Return the value of a register in its unit; None for not available.

        Raises:
            DriveError: it is not believable.
        """
        register = self.file.registers[name]
        assert not isinstance(raw, str)
        if raw == register.missing:
            return None
        value = raw * self._factor(register)
        low = min(register.low, -STANDS) if name == "speed" else register.low
        if not math.isfinite(value) or not low <= value <= register.high:
            raise self.line.error(
                "answer",
                f"{self._named(name)} is {raw}: {f'{value:g} {register.unit}'.strip()}, believable "
                f"are {low:g} to {register.high:g}",
            )
        return value

    def _available(self, name: str) -> float:
        """Return the value of a register in its unit, which must be available."""
        value = self._scaled(name, self._raw(name))
        if value is None:
            raise self.line.error("answer", f"its {name} is not available")
        return value

    def _factor(self, register: Register) -> float:
        """Return by what a raw value is multiplied."""
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
                f"a speed of {value:.1%} would be {raw} in {self._named(name)}, which holds "
                f"{low:g} to {high:g}",
            )
        return raw & 0xFFFF

    def _named(self, name: str) -> str:
        register = self.file.registers[name]
        return f"{register.meaning} (register {register.manual})"


@dataclass(frozen=True)
class PlacedDrive:
    """A make of drive at an address.

    Attributes:
        file: what the drive is like.
        address: where it is.
    """

    file: DriveFile
    address: Address

    # One round of requests may follow the other at once (s).
    period = 0.0

    def __str__(self) -> str:
        return str(self.address)

    @property
    def guard(self) -> Timeout | None:
        """Its communication timeout at this address; None where its file tells of none."""
        return self.file.timeout.over(self.address)

    @property
    def is_here(self) -> bool:
        """Whether it is at loopback or a pseudo-terminal; may wait for a host to be looked up."""
        return self.address.is_here

    def place(self) -> str:
        """Return where it is, by the same name for each way to write the address.

        May wait for the name of a host to be looked up.

        Raises:
            OSError: there is no such host, or nobody who knows it answers.
        """
        return f"{self._at()}-{self.file.device_id_at(self.address)}"

    def place_of_lock(self) -> str:
        """Return what one driver alone may have: it, or the serial line with all its devices.

        Raises:
            OSError: likewise.
        """
        return self._at() if self.address.line else self.place()

    def _at(self) -> str:
        return self.address.place(self.file.tcp.port).strip("/")

    def connection(self, timeout_s: float = 0.5) -> Drive:
        """Return it, to be connected once; nothing is opened yet.

        Args:
            timeout_s: longest wait for a connection, and for each answer (s).

        Raises:
            ConfigurationError: there is no Modbus library.
        """
        return Drive(self.file, self.address, timeout_s)


def no_real_time(why: str, key: str, speed: float) -> ConfigurationError:
    """Return that a speed other than real time is refused.

    Any other drive than the simulator may turn a real motor, by levels that are made up, and start
    it as many times more often as time goes faster.

    Args:
        why: it is not the simulator; see `Drive.why_no_simulator`.
        key: what says the speed, for the message.
        speed: simulated time per wall time; 0 for as fast as it goes.
    """
    return ConfigurationError(
        "is for the drive simulator alone, at loopback or on a pseudo-terminal, since another "
        f"drive may turn a real pump by made-up levels: {why}",
        key=key, value=f"{speed:g}" if speed else "max",
    )
