"""Description of a make of drive or relay: a file in ``config/drives/``, as frozen dataclasses.

A drive is on Modbus; a relay is on MQTT. In a relay's file, topics and payloads may contain the
following placeholders: ``$device``, the relay's own topic, taken from its address; ``$me``, the
name of the requesting client; and, in ``switch_on``, ``$seconds``, the relay's timer in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import as_started, shared_directory
from greenroof_ros.base.parameter import entry, read_record
from greenroof_ros.live.devices.modbus_line import WIDTHS, WORD_ORDERS, Serial, coding_mistakes

# Default limit of a device's own communication timeout (s). Within this time, apart from its ramp,
# a device also shows whether it obeys.
LIMIT_S = 10.0
# Longest ramp down that a drive may have (s), after *stop* or after its own timeout; drive files do
# not state the ramp. A pump whose speed cannot be read may turn for this long. If it turns for
# longer after it was forbidden to run, it does not obey.
MAX_RAMP_S = 30.0


@dataclass(frozen=True, kw_only=True)
class DeviceFile:
    """What every file describes."""

    make: str = entry("name of the manufacturer")
    model: str = entry("model, with firmware or the adapter for Modbus")
    unverified: tuple[str, ...] = entry(
        "keys that were not verified, and could let a pump run when it must be off")
    set_up: tuple[str, ...] = entry("other settings that a person must make on the device")
    path: Path = Path()

    def __str__(self) -> str:
        return f"{self.make} {self.model}"


@dataclass(frozen=True)
class Register:
    """A holding register, or two or four registers that form one value: scale x raw."""

    address: int = entry("address on the wire, counted from 0", 0, 65535)
    manual: int = entry("number in the manual: address + numbering", 0)
    type: str = entry("encoding of the value", choices=("uint16", "int16", "uint32", "int32"))
    meaning: str = entry("meaning of the value, for messages")
    word_order: str = entry(
        "word order of a value of more than one register", choices=WORD_ORDERS, default="")
    scale: float = entry("factor: value = scale x raw", 1e-9, 1e9, default=1.0)
    full_scale: str = entry(
        "name of a register that divides the scaled value", default="")
    low: float = entry("minimum plausible value", default=-math.inf)
    high: float = entry("maximum plausible value", default=math.inf)
    missing: int | None = entry("raw value of a flow that is not available", default=None)

    @property
    def width(self) -> int:
        """The number of registers that the value occupies."""
        return WIDTHS[self.type]


@dataclass(frozen=True)
class RegisterCondition:
    """A condition that is true if register & mask == value."""

    mask: int = entry("mask of the compared bits", 1, 0xFFFFFFFF)
    value: int = entry("value that these bits must have", 0, 0xFFFFFFFF)
    register: str = entry("name of the register", default="status")

    def fulfilled_by(self, raw: int) -> bool:
        """Return whether a raw value satisfies the condition."""
        return raw & self.mask == self.value


@dataclass(frozen=True)
class Step:
    """A write to one register, and the condition for the next step."""

    write: str = entry("name of the register to write")
    value: int = entry("word to write", 0, 0xFFFF)
    until: RegisterCondition | None = entry(
        "condition for the next step", default=None)
    within_s: float = entry("maximum time to wait for it (s)", 0.05, 60, default=1.0)


@dataclass(frozen=True)
class Sequences:
    """The sequences of register writes that bring the drive from one state to another."""

    ready: tuple[Step, ...] = entry(
        "steps before every start, from any state but a fault")
    run: tuple[Step, ...] = entry(
        "steps that start the pump, after the speed was written; repeated")
    stop: tuple[Step, ...] = entry(
        "steps that ramp the pump down and switch it off; repeated")
    reset: tuple[Step, ...] = entry("steps that acknowledge a fault and leave the drive off")


@dataclass(frozen=True)
class StatusWord:
    """The meaning of the status word."""

    ready: RegisterCondition = entry("true if neither a fault nor an interlock prevents a start")
    running: RegisterCondition = entry("true while the motor is energized")
    fault: RegisterCondition = entry("true while a fault keeps the drive off")
    remote: RegisterCondition | None = entry(
        "true while the drive is controlled over the bus", default=None)


@dataclass(frozen=True)
class Codes:
    """A register that reports faults, and a text for each of its values."""

    register: str = entry("name of the register")
    kind: str = entry("encoding: a single code, or one bit per fault", choices=("code", "bits"))
    texts: dict[int, str] = entry(
        "texts of the codes, or of the bits", 0, 0xFFFFFFFF)

    def reported(self, raw: int) -> set[int]:
        """Return the codes or bits that a raw value reports; 0 reports none."""
        if self.kind == "code":
            return {raw} - {0}
        return {bit for bit in range(32) if raw >> bit & 1}

    def describe(self, raw: int) -> str:
        """Return the texts for a raw value, each with its code or bit."""
        return ", ".join(
            f"{self.texts.get(each, 'not in the drive file')} "
            + (f"(bit {each})" if self.kind == "bits" else f"(code {each}, 0x{each:04X})")
            for each in sorted(self.reported(raw))
        ) or "the drive gives no cause"


@dataclass(frozen=True)
class Action:
    """A setting that decides whether the communication timeout stops the pump."""

    register: str = entry("name of the register")
    stops: dict[int, str] = entry(
        "values, with names, for a stop that lasts until a reset; any other means off", 0)


@dataclass(frozen=True)
class Timeout:
    """The communication timeout of one of the drive's interfaces."""

    register: str = entry("name of the register of the timeout (s; 0 is off)")
    how_to_set: str = entry("how a person sets the timeout, and what to beware of")
    action: Action | None = entry("setting of what the expiry leads to", default=None)
    mode: Action | None = entry(
        "setting of which messages restart it", default=None)
    trips: tuple[int, ...] = entry(
        "codes or bits of `faults` that report its expiry", 0, default=())
    unguarded_after_power_up_s: float = entry(
        "time after power-up in which the timeout is not effective, and the pump is kept off",
        0, 600, unit="s", default=0.0)
    local_settings_decide: bool = entry(
        "whether the reaction depends on settings that cannot be read, but only be confirmed "
        "(`local_settings_stop_the_pump`)", default=False)


@dataclass(frozen=True, kw_only=True)
class DriveFile(DeviceFile):
    """The description of a make of drive."""

    numbering: int = entry("number of a register in the manual minus its address", 0, 465536)
    serial: Serial = entry("factory settings of Modbus RTU, and the device id for any interface")
    registers: dict[str, Register] = entry(
        "registers by name: `control`, `reference`, `status`, `speed` (share of the rated speed), "
        "perhaps `flow` (m3/s), and others")
    sequences: Sequences = entry("register writes that start, stop and reset the drive")
    status: StatusWord = entry("conditions that show the drive's state")
    faults: Codes = entry("register and texts of the faults")
    timeout: dict[str, Timeout] = entry(
        "communication timeouts of the port `serial` and the Ethernet port `tcp`")
    min_speed: float = entry("minimum share of the rated speed at which the pump may run", 0, 1)


@dataclass(frozen=True)
class RelayMessage:
    """A message to the relay."""

    topic: str = entry("topic on which the message is published")
    payload: str = entry("payload of the message", default="")


@dataclass(frozen=True, kw_only=True)
class Question(RelayMessage):
    """A request to the relay, and the value in its reply."""

    answer: str = entry("topic of the reply, which is a JSON object")
    path: str = entry("path of the value in the reply, such as result.output")


@dataclass(frozen=True, kw_only=True)
class RelayState(Question):
    """The state of the relay, on or off."""

    is_on: str = entry("value that means on, in JSON notation", default="true")
    is_off: str = entry("value that means off, in JSON notation", default="false")


@dataclass(frozen=True, kw_only=True)
class Setting(Question):
    """A setting with a required value, without which the relay could be on unintentionally."""

    value: str = entry("required value, in JSON notation")


@dataclass(frozen=True, kw_only=True)
class Timer(Question):
    """The relay's own timer, which switches the relay off: its communication timeout."""

    scale: float = entry("factor: seconds = scale x value", 1e-6, 1e6, default=1.0)
    high: float = entry("maximum value to which the scale applies", 0, 1e6)
    how_to_set: str = entry("how a person sets the timer, and what to beware of")

    # Drives on Modbus may have these, but no relay does.
    unguarded_after_power_up_s = 0.0
    local_settings_decide = False


@dataclass(frozen=True, kw_only=True)
class RelayFile(DeviceFile):
    """The description of a make of relay."""

    protocol: str = entry("marks the file of a relay", choices=("mqtt",))
    state: RelayState = entry("whether the relay is on")
    timer: Timer = entry("the time after which the relay switches itself off")
    must: tuple[Setting, ...] = entry("settings with required values")
    switch_on: RelayMessage = entry("message that switches the relay on, repeated")
    switch_off: RelayMessage = entry("message that switches the relay off, repeated")

    # A relay is on or off, with no speed in between.
    min_speed = 1.0


def find_drive_file(name: str) -> Path:
    """Return the path of a drive file that was selected by name or path.

    Args:
        name: a path, or the name of a file in ``config/drives/`` without its extension.

    Raises:
        ConfigurationError: if the file does not exist.
    """
    paths = sorted((shared_directory() / "config" / "drives").glob("*.yaml"))
    shipped = {path.stem: path for path in paths}
    if name in shipped:
        return shipped[name]
    if as_started(Path(name)).is_file():
        return Path(name)
    raise ConfigurationError(
        f"is neither a file nor a name in config/drives/; {suggest_names(name, shipped)}",
        key="drive", value=name,
    )


def read_drive_file(path: Path) -> DriveFile:
    """Read and check a drive file.

    Raises:
        ConfigurationError: if a key or value is missing, unknown, impossible or contradictory.
    """
    return replace(read_record(DriveFile, path, lambda file, _: _mistakes(file)), path=path)


def read_relay_file(path: Path) -> RelayFile:
    """Read and check a relay file.

    Raises:
        ConfigurationError: if a key or value is missing, unknown or impossible.
    """
    return replace(read_record(RelayFile, path), path=path)


def _parts(part: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every record in a part of a drive file, preceded by its key."""
    below: dict[Any, Any] = {}
    if is_dataclass(part):
        yield key, part
        below = vars(part)
    elif isinstance(part, dict):
        below = part
    elif isinstance(part, tuple):
        below = dict(enumerate(part, start=1))
    for name, child in below.items():
        yield from _parts(child, f"{key}.{name}".removeprefix("."))


def _mistakes(drive: DriveFile) -> Iterator[tuple[str, str]]:
    """Yield the key and a description of every mistake; later checks rely on earlier ones."""
    registers = drive.registers
    for name in ("control", "reference", "status", "speed"):
        if name not in registers:
            yield "registers", f"must contain {name}, which is required for every drive"
    written = {"reference"}
    for key, part in _parts(drive):
        for place in ("register", "write", "full_scale"):
            name = getattr(part, place, "")
            if name and name not in registers:
                names = ", ".join(registers)
                yield f"{key}.{place}", f"must be the name of a register in this file: {names}"
            elif place == "write" and name:
                written.add(name)
        if isinstance(part, RegisterCondition) and part.value & ~part.mask:
            yield f"{key}.value", (
                f"has bits outside the mask 0x{part.mask:04X}, so the condition could never be true"
            )
    for name, register in registers.items():
        key = f"registers.{name}"
        if register.manual - register.address != drive.numbering:
            yield f"{key}.manual", (
                f"must be {register.address + drive.numbering}, which is address "
                f"{register.address} + numbering {drive.numbering}"
            )
        for wrong, why in coding_mistakes(register.type, register.word_order):
            yield f"{key}.{wrong}", why
        if name in written and register.width != 1:
            yield f"{key}.type", "must be uint16 or int16, since the register is written"
        full = registers.get(register.full_scale)
        if full is not None and (full.low <= 0 or math.isinf(full.high) or full.full_scale):
            yield f"registers.{register.full_scale}", (
                f"must have high, a low above 0 and no full_scale, since {name} is divided by its "
                "value"
            )
    for name in ("run", "stop", "reset"):
        if "control" not in [step.write for step in getattr(drive.sequences, name)]:
            yield f"sequences.{name}", "must write the register control"
