"""Description of a make of drive or relay: a file in ``config/drives/``, as frozen dataclasses.

A drive is on Modbus; a relay is on MQTT. In a relay's file, topics and payloads may contain the
following placeholders: ``$device``, the relay's own topic, taken from its address; ``$me``, the
name of the requesting client; ``$id``, the number of the message; and ``$seconds``, the relay's
timer in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from string import Template
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import YamlMapping, as_started, shared_directory
from greenroof_ros.base.parameter import entry, find, read_record
from greenroof_ros.live.devices.modbus_line import (
    WIDTHS,
    WORD_ORDERS,
    Address,
    ModbusLine,
    Serial,
    coding_mistakes,
)

UNITS = ("", "share", "s", "m3/s")
SPEED = "speed"
# A timer shorter than this many rounds of questions cannot be renewed within a third of its time.
_ROUNDS = 6
# Default limit of a device's own communication timeout (s). Within this time, apart from its ramp,
# a device also shows whether it obeys.
LIMIT_S = 10.0
# Longest ramp down that a drive may have (s), after *stop* or after its own timeout; drive files do
# not state the ramp. A pump whose speed cannot be read may turn for this long. If it turns for
# longer after it was forbidden to run, it does not obey.
MAX_RAMP_S = 30.0


@dataclass(frozen=True)
class Source:
    """A document on which the file is based."""

    title: str = entry("title of the document")
    document: str = entry("number and revision of the document, as printed on its title page")
    where: str = entry("web address of the document, and the pages or sections consulted")


@dataclass(frozen=True, kw_only=True)
class Make:
    """What every file describes."""

    make: str = entry("name of the manufacturer")
    model: str = entry("model, with its firmware, or the option or adapter that provides Modbus")
    sources: tuple[Source, ...] = entry("documents on which the file is based")
    unverified: tuple[str, ...] = entry(
        "keys of this file (such as registers.control or timer) that could not be verified against "
        "the manufacturer's documents"
    )
    set_up: tuple[str, ...] = entry("other settings that must be made manually on the device")
    path: Path = Path()


@dataclass(frozen=True)
class Numbering:
    """The relation between the register numbers in the manual and the addresses on the wire."""

    offset: int = entry("register number in the manual minus the address on the wire", 0, 465536)
    meaning: str = entry("numbering rule stated in the manual, as a sentence")


@dataclass(frozen=True)
class Tcp:
    """Settings of Modbus TCP."""

    port: int = entry("TCP port of the drive or of a gateway", 1, 65535)
    device_id: int = entry(
        "unit identifier on TCP; for a drive behind a gateway, the slave address in `serial` is "
        "used", 0, 255
    )


@dataclass(frozen=True)
class Register:
    """A holding register, or consecutive registers that form one value.

    The value in the given unit is scale x raw. If `full_scale` names a register, the result is
    divided by the value of that register.
    """

    address: int = entry(
        "address of the register on the wire, counted from 0", 0, 65535
    )
    manual: int = entry(
        "number of the register in the manual, which must be address + numbering.offset", 0
    )
    type: str = entry("encoding of the value", choices=(*WIDTHS, "text"))
    meaning: str = entry("meaning of the value, for messages")
    source: str = entry("page or table of one of the sources, or 'none'")
    word_order: str = entry(
        "word order of a value that occupies more than one register",
        choices=WORD_ORDERS, default="",
    )
    length: int = entry(
        "for the type text only: number of registers, each of which holds two "
        "characters", 0, 64, default=0
    )
    unit: str = entry(
        "unit of the scaled value; empty for a plain (unscaled) word", choices=UNITS, default="")
    scale: float = entry("factor: value = scale x raw", default=1.0)
    full_scale: str = entry(
        "name of a second register, whose value divides the scaled value; the second register is "
        "read when the connection is established", default=""
    )
    low: float = entry("minimum plausible value, in the unit of the register", default=-math.inf)
    high: float = entry("maximum plausible value, in the unit of the register", default=math.inf)
    missing: int | None = entry("raw value that means 'not available'", default=None)

    @property
    def width(self) -> int:
        """The number of registers that the value occupies."""
        return WIDTHS.get(self.type, self.length)


@dataclass(frozen=True)
class RegisterCondition:
    """A condition that is true if register & mask == value."""

    mask: int = entry("mask of the bits that are compared", 1, 0xFFFFFFFF)
    value: int = entry("value that the bits in the mask must have", 0, 0xFFFFFFFF)
    register: str = entry("name of the register", default="status")

    def fulfilled_by(self, raw: int) -> bool:
        """Return whether a raw value satisfies the condition."""
        return raw & self.mask == self.value


@dataclass(frozen=True)
class Step:
    """A write to one register, and the condition for the next step."""

    write: str = entry("name of the register to write")
    value: int | str = entry(
        "word to write, or 'speed' for the requested speed", 0, 0xFFFF, choices=(SPEED,)
    )
    until: RegisterCondition | None = entry(
        "condition that must be true before the next step", default=None
    )
    within_s: float = entry(
        "maximum time to wait for the condition in `until` (s)", 0.05, 60, default=1.0
    )


@dataclass(frozen=True)
class Sequences:
    """The sequences of register writes that bring the drive from one state to another."""

    ready: tuple[Step, ...] = entry(
        "steps that bring the drive from any state other than a fault, for example after "
        "power-up, a reset or local control, to a state in which `run` works"
    )
    run: tuple[Step, ...] = entry(
        "steps that set the speed and then start the pump; the steps are repeated in every cycle "
        "while the pump runs"
    )
    stop: tuple[Step, ...] = entry(
        "steps that ramp the pump down and then switch it off; the steps are repeated in every "
        "cycle while the pump is off"
    )
    reset: tuple[Step, ...] = entry("steps that acknowledge a fault and leave the drive off")


@dataclass(frozen=True)
class StatusWord:
    """The meaning of the status word."""

    enabled: RegisterCondition = entry(
        "condition that is true if `run` works without a preceding `ready`"
    )
    ready: RegisterCondition = entry(
        "condition that is true if neither a fault nor an interlock prevents a start"
    )
    running: RegisterCondition = entry("condition that is true while the motor is energized")
    fault: RegisterCondition = entry("condition that is true while a fault keeps the drive off")
    warning: RegisterCondition | None = entry(
        "condition that is true while a warning is active", default=None
    )
    remote: RegisterCondition | None = entry(
        "condition that is true while the drive is controlled over the bus", default=None
    )
    bits: dict[int, str] = entry(
        "texts for the bits of the status word; bit 0 is the least significant", 0, 31, factory=dict
    )


@dataclass(frozen=True)
class Codes:
    """A register that reports faults or warnings, and a text for each of its values."""

    register: str = entry("name of the register")
    kind: str = entry("encoding: a single code, or one bit per fault", choices=("code", "bits"))
    texts: dict[int, str] = entry(
        "texts of the codes, or of the bits (bit 0 is the least "
        "significant)", 0, 0xFFFFFFFF, factory=dict
    )

    def only(self, raw: int, among: tuple[int, ...]) -> bool:
        """Return whether a raw value reports some of the given codes or bits, and no others."""
        if self.kind == "code":
            return raw in among
        return raw != 0 and raw & ~sum(1 << bit for bit in among) == 0

    def text(self, raw: int) -> str:
        """Return the text for a raw value; empty if there is no fault or warning."""
        if raw == 0:
            return ""
        if self.kind == "code":
            return f"{self.texts.get(raw, 'not in the drive file')} (code {raw}, 0x{raw:04X})"
        bits = [bit for bit in range(32) if raw >> bit & 1]
        return ", ".join(self.texts.get(bit, f"bit {bit}") for bit in bits)


@dataclass(frozen=True)
class Action:
    """A setting that decides whether the communication timeout stops the pump."""

    register: str = entry("name of the register")
    stops: dict[int, str] = entry(
        "values with which the drive stops the pump, each with its name", 0)
    runs_on: dict[int, str] = entry(
        "values with which the drive may fail to stop the pump, or may restart it at the next "
        "control word; with any of these, the timeout is treated as off", 0,
    )


@dataclass(frozen=True)
class Timeout:
    """The communication timeout of one of the drive's interfaces."""

    register: str = entry("name of the register that holds the timeout period")
    kept_alive_by: str = entry("messages that restart the timeout")
    how_to_set: str = entry("instructions for setting the timeout manually: parameter and value")
    off_values: tuple[int, ...] = entry("raw time values that switch the timeout off", default=())
    action: Action | None = entry("setting that selects what happens when the timeout "
        "expires", default=None)
    mode: Action | None = entry(
        "setting that selects which messages restart the timeout, if there is a choice",
        default=None,
    )
    trips: tuple[int, ...] = entry(
        "codes (or bits) of `faults` that report the expiry of the timeout", 0, default=()
    )
    unguarded_after_power_up_s: float = entry(
        "time after power-up during which the timeout is not effective (s); the pump is kept off "
        "for this time after every connection, since the drive may just have been powered "
        "up", 0, 600, default=0.0,
    )
    local_settings_decide: bool = entry(
        "whether the reaction to the timeout depends on drive settings that cannot be read; the "
        "operator must then confirm that the pump stops "
        "(`local_settings_stop_the_pump`)", default=False,
    )
    traps: str = entry("cases in which the timeout is not effective", default="")


@dataclass(frozen=True)
class Timeouts:
    """The drive's own communication timeouts, one for each interface."""

    serial: Timeout | None = entry(
        "timeout of the serial port, which is reached over a serial line or a "
        "gateway", default=None)
    tcp: Timeout | None = entry(
        "timeout of the Ethernet port of the drive or of its adapter", default=None
    )

    @property
    def by_interface(self) -> dict[str, Timeout]:
        """The timeouts in the file, by interface."""
        return {name: timeout for name, timeout in vars(self).items() if timeout is not None}

    def guarding(self, address: Address) -> Timeout | None:
        """Return the timeout of the interface at an address; None if the file describes none."""
        return self.by_interface.get(address.interface)


@dataclass(frozen=True)
class Nameplate:
    """A register whose value identifies the drive."""

    register: str = entry("name of the register")
    texts: dict[int, str] = entry("texts for the values of the register", factory=dict)


@dataclass(frozen=True, kw_only=True)
class DriveFile(Make):
    """The description of a make of drive."""

    numbering: Numbering = entry("numbering of the registers in the manual")
    tcp: Tcp = entry("settings of Modbus TCP")
    serial: Serial = entry("factory settings of Modbus RTU")
    registers: dict[str, Register] = entry(
        "registers by name; `control`, `reference`, `status` and `speed` are required"
    )
    sequences: Sequences = entry(
        "sequences of register writes that start, stop and reset the drive")
    status: StatusWord = entry("meaning of the status word")
    faults: Codes = entry("register and texts of the faults")
    timeout: Timeouts = entry("the drive's own communication timeouts")
    nameplate: tuple[Nameplate, ...] = entry(
        "registers that identify the drive; they are read when the connection is established"
    )
    min_speed: float = entry(
        "minimum speed at which the pump may run (share of the rated speed)", 0, 1
    )
    warnings: Codes | None = entry("register and texts of the warnings", default=None)

    def device_id_at(self, address: Address) -> int:
        """Return the unit identifier or slave address at which the drive is addressed.

        An identifier in the address takes precedence. Otherwise, the identifier of the interface in
        use is taken from the file. For a gateway, the slave address is used.
        """
        if address.device_id is not None:
            return address.device_id
        return (self.tcp if address.interface == "tcp" else self.serial).device_id

    def line(self, address: Address, timeout_s: float) -> ModbusLine:
        """Return a connection to the drive that is not yet open.

        Args:
            address: address of the drive.
            timeout_s: maximum time to wait for a connection and for each response (s).
        """
        return ModbusLine(
            address, port=self.tcp.port, device_id=self.device_id_at(address), serial=self.serial,
            timeout_s=timeout_s,
        )

    @property
    def unverified_and_vital(self) -> tuple[str, ...]:
        """The unverified keys whose values, if wrong, could let a pump run when it must be off."""
        parts = ("sequences.ready.", "sequences.run.", "sequences.stop.", "timeout.")
        vital = ["numbering.", "sequences.", "timeout.", "registers.status."]
        vital += [
            f"registers.{name}." for key, name, _ in _references(self) if key.startswith(parts)
        ]
        return tuple(key for key in self.unverified if f"{key}.".startswith(tuple(vital)))


@dataclass(frozen=True)
class RelayMessage:
    """A message to the relay."""

    topic: str = entry("topic on which the message is published")
    payload: str = entry("payload of the message")


@dataclass(frozen=True, kw_only=True)
class Question(RelayMessage):
    """A request to the relay, and the features by which its reply is recognized."""

    answer: str = entry("topic of the reply, which is a JSON object")
    known_by: str = entry("path whose presence identifies the reply, such as result.output")
    payload: str = entry("payload of the request", default="")


@dataclass(frozen=True)
class Value:
    """A value in the reply to a request."""

    question: str = entry("name of the request (a key of `questions`)")
    path: str = entry("path of the value in the reply, such as result.output")


@dataclass(frozen=True)
class RelayState(Value):
    """The state of the relay, on or off."""

    is_on: str = entry("value that means on, in JSON notation", default="true")
    is_off: str = entry("value that means off, in JSON notation", default="false")


@dataclass(frozen=True)
class Setting(Value):
    """A setting with a required value, without which the relay could be on unintentionally."""

    value: str = entry("required value, in JSON notation")
    meaning: str = entry("description of the setting, for messages")


@dataclass(frozen=True)
class Scale:
    """The conversion of a range of raw values to seconds."""

    low: float = entry("minimum raw value of the range", 0)
    high: float = entry("maximum raw value of the range", 0)
    scale: float = entry("factor: seconds = scale x raw + offset", 1e-6, 1e6, default=1.0)
    offset: float = entry("offset of the conversion (s)", -1e6, 1e6, default=0.0)


@dataclass(frozen=True)
class Timer(Value):
    """The relay's own timer, which switches the relay off: its communication timeout."""

    scales: tuple[Scale, ...] = entry(
        "conversions to seconds, one for each range of raw values; a value outside all ranges "
        "means off"
    )
    how_to_set: str = entry(
        "instructions for setting the timer manually: location of the setting, and value")
    traps: str = entry("cases in which the timer is not effective", default="")

    # Drives on Modbus may have these, but no relay does.
    unguarded_after_power_up_s = 0.0
    local_settings_decide = False

    def seconds(self, raw: float) -> float | None:
        """Return the time for a raw value (s); None if the timer is off."""
        return next((
            scale.scale * raw + scale.offset for scale in self.scales
            if scale.low <= raw <= scale.high
        ), None)


@dataclass(frozen=True, kw_only=True)
class RelayFile(Make):
    """The description of a make of relay."""

    protocol: str = entry(
        "protocol of the relay, always mqtt; only relay files have this key", choices=("mqtt",)
    )
    questions: dict[str, Question] = entry("requests to the relay, by name")
    state: RelayState = entry("value in a reply that shows whether the relay is on")
    timer: Timer = entry(
        "value in a reply that gives the time after which the relay switches itself off"
    )
    must: tuple[Setting, ...] = entry(
        "settings that must have certain values; they are read together with the timer"
    )
    name: Value = entry("value in a reply that identifies the relay, for messages")
    switch_on: RelayMessage = entry(
        "message that switches the relay on; it is repeated to keep the relay on"
    )
    switch_off: RelayMessage = entry(
        "message that switches the relay off; it is repeated for as long as the relay must be off"
    )
    number: str = entry(
        "path of the request's $id in every reply; empty if the replies have no id but arrive in "
        "the order of the requests",
        default="",
    )
    period: float = entry("minimum polling interval (s)", 0.05, 5, default=0.5)
    answer_within: float = entry("maximum time to wait for a reply (s)", 0.1, 10, default=1.0)

    # A relay is on or off, with no speed in between.
    min_speed = 1.0

    @property
    def min_timer(self) -> float:
        """The shortest timer that can be renewed in time (s)."""
        return _ROUNDS * self.period

    @property
    def unverified_and_vital(self) -> tuple[str, ...]:
        """All unverified keys, since each could let a pump run when it must be off."""
        return self.unverified


def find_drive_file(name: str) -> Path:
    """Return the path of a drive file that was selected by name or path.

    Args:
        name: a path, or the name of a file in ``config/drives/`` without its extension.

    Raises:
        ConfigurationError: if the file does not exist.
    """
    shipped = shared_directory() / "config" / "drives"
    names = sorted(path.stem for path in shipped.glob("*.yaml"))
    if name in names:
        return shipped / f"{name}.yaml"
    if as_started(Path(name)).is_file():
        return Path(name)
    raise ConfigurationError(
        f"is neither a file nor a name in config/drives/; {suggest_names(name, names)}",
        key="drive", value=name,
    )


def read_drive_file(path: Path) -> DriveFile:
    """Read and check a drive file.

    Raises:
        ConfigurationError: if a key or value is missing, unknown, impossible or contradictory.
    """
    return replace(read_record(DriveFile, path, _mistakes), path=path)


def read_relay_file(path: Path) -> RelayFile:
    """Read and check a relay file.

    Raises:
        ConfigurationError: if a key or value is missing, unknown, impossible or contradictory.
    """
    return replace(read_record(RelayFile, path, _relay_mistakes), path=path)


def _unknown_keys(file: Make, content: YamlMapping) -> Iterator[tuple[str, str]]:
    for number, key in enumerate(file.unverified, start=1):
        if find(content, key)[1] is None:
            yield f"unverified.{number}", "is not a key of this file"


# What a register must be if a key names it, apart from its unit.
_BITS, _WORD, _ANY = "bits", "word", "any"


def _parts(part: Any, key: str) -> Iterator[tuple[str, Any]]:
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


def _references(drive: DriveFile) -> Iterator[tuple[str, str, str]]:
    """Yield every key that names a register, with the register's name and required properties."""
    for name, unit in {"control": "", "reference": "share", "status": "", "speed": "share"}.items():
        yield "registers", name, unit
    if "flow" in drive.registers:
        yield "registers", "flow", "m3/s"
    for key, part in _parts(drive, ""):
        match part:
            case Step():
                yield f"{key}.write", part.write, _WORD
            case Register() if part.full_scale:
                yield f"{key}.full_scale", part.full_scale, _BITS
            case RegisterCondition() | Codes() | Action():
                yield f"{key}.register", part.register, _BITS
            case Timeout():
                yield f"{key}.register", part.register, "s"
            case Nameplate():
                yield f"{key}.register", part.register, _ANY


def _mistakes(drive: DriveFile, content: YamlMapping) -> Iterator[tuple[str, str]]:
    """Yield the key and a description of every mistake; later checks rely on earlier ones."""
    registers = drive.registers
    for name, register in registers.items():
        for key, why in _register_mistakes(register, drive.numbering.offset):
            yield f"registers.{name}.{key}", why
    for key, name, like in _references(drive):
        target = registers.get(name)
        if target is None and key == "registers":
            yield key, f"must contain {name}, which is required for every drive"
        elif target is None:
            yield key, f"must be the name of a register in this file: {', '.join(registers)}"
        elif like == _BITS and not target.type.startswith("uint"):
            yield key, "must be a register of the type uint16 or uint32"
        elif like == _WORD and target.width != 1:
            yield key, "must be a register of 16 bits"
        elif like in UNITS and target.unit != like:
            yield (
                f"registers.{name}.unit" if target.unit else f"registers.{name}",
                "must have the unit "
                f"{like}" if like else "must be a plain (unscaled) word, without a unit",
            )
    for name, register in registers.items():
        if register.full_scale:
            full = registers[register.full_scale]
            if full.low <= 0 or math.isinf(full.high) or full.full_scale:
                yield f"registers.{register.full_scale}", (
                    f"must have high, a low above 0 and no full_scale, since {name} is divided "
                    "by its value"
                )
    for key, part in _parts(drive, ""):
        if isinstance(part, RegisterCondition) and part.value & ~part.mask:
            yield f"{key}.value", (
                f"has bits outside the mask 0x{part.mask:04X}, so the condition could never be true"
            )
        elif isinstance(part, Action):
            for value in part.stops.keys() & part.runs_on.keys():
                yield f"{key}.stops.{value}", "is in both stops and runs_on"
    yield from _sequence_mistakes(drive)
    yield from _unknown_keys(drive, content)


def _register_mistakes(register: Register, offset: int) -> Iterator[tuple[str, str]]:
    if register.manual - register.address != offset:
        yield "manual", (
            f"must be {register.address + offset}, which is address {register.address} + "
            f"numbering.offset {offset}"
        )
    yield from coding_mistakes(register.type, register.word_order)
    text = register.type == "text"
    if text != bool(register.length):
        yield "length", (
            "must be the number of registers that the text occupies" if text
            else f"is only allowed for the type text, not for {register.type}"
        )
    if register.address + register.width > 65536:
        yield "address", "is too high: the value would extend beyond the last register address"
    if register.scale == 0 or not math.isfinite(register.scale):
        yield "scale", "must be finite and not 0"
    if register.low > register.high:
        yield "low", f"must be at most high, which is {register.high:g}"
    if register.unit and text:
        yield "unit", "is not allowed for the type text"


def _sequence_mistakes(drive: DriveFile) -> Iterator[tuple[str, str]]:
    for name, steps in vars(drive.sequences).items():
        for number, step in enumerate(steps, start=1):
            share = drive.registers[step.write].unit == "share"
            if step.value == SPEED and not (name == "run" and share):
                yield f"sequences.{name}.{number}.value", (
                    "may only be written in sequences.run, and only to a register whose unit is "
                    "share"
                )
        written = [step.write for step in steps]
        if name != "ready" and "control" not in written:
            yield f"sequences.{name}", "must write the register control"
    run = drive.sequences.run
    if SPEED not in [step.value for step in run]:
        yield "sequences.run", "must write the speed"
    if run[-1].write != "control":
        yield "sequences.run", "must end with a write to the register control"


def _relay_mistakes(relay: RelayFile, content: YamlMapping) -> Iterator[tuple[str, str]]:
    values = {
        "state": relay.state, "timer": relay.timer, "name": relay.name,
        **{f"must.{number}": setting for number, setting in enumerate(relay.must, start=1)},
    }
    for key, value in values.items():
        if value.question not in relay.questions:
            yield f"{key}.question", (
                "must be the name of a request under questions in this file: "
                f"{', '.join(relay.questions)}"
            )
    texts = {
        f"{key}.{name}": text
        for key, part in {
            "switch_on": relay.switch_on, "switch_off": relay.switch_off,
            **{f"questions.{name}": question for name, question in relay.questions.items()},
        }.items() for name, text in vars(part).items()
    }
    for key, text in texts.items():
        names = ["device", "me"]
        if key.endswith(".payload"):
            names += ["id", "seconds"] if key == "switch_on.payload" else ["id"]
        elif set(text) & set("#+"):
            yield key, "must be a single topic, without the wildcards # and +"
        try:
            Template(text).substitute(dict.fromkeys(names, ""))
        except (KeyError, ValueError):
            allowed = ", ".join(f"${name}" for name in names)
            yield key, f"may contain only these placeholders: {allowed}"
    if relay.number and any("$id" not in question.payload for question in relay.questions.values()):
        yield "number", "requires $id in the payload of every request"
    if relay.state.is_on == relay.state.is_off:
        yield "state.is_off", "must differ from is_on"
    for number, scale in enumerate(relay.timer.scales, start=1):
        if scale.low > scale.high:
            yield f"timer.scales.{number}.low", f"must be at most high, which is {scale.high:g}"
    yield from _unknown_keys(relay, content)
