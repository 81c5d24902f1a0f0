"""What a make of drive is like: one YAML file of ``config/drives/``, as frozen dataclasses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping, read_yaml, shared_directory
from greenroof_ros.common.records import Entry, Word, error_at, read_record
from greenroof_ros.drives.address import Address, Serial
from greenroof_ros.drives.values import WIDTHS, WORD_ORDERS

# How many registers a value takes; a text says so itself.
WIDTH = {**WIDTHS, "text": 0}
UNITS = ("", "share", "s", "m3/s")
SPEED = "speed"
# The longest ramp down that a drive may have (s), after *stop* and after its own timeout: no drive
# file says it. A pump that is not heard may turn for so long, and one that turns longer after it
# was forbidden does not obey.
LONGEST_RAMP_S = 30.0


@dataclass(frozen=True)
class Source:
    """A document that the file was made from."""

    title: Annotated[str, Entry("what it is called")]
    document: Annotated[str, Entry("its number and revision, as on its title page")]
    where: Annotated[str, Entry("where it was read")]


@dataclass(frozen=True)
class Numbering:
    """How the manual's numbers of registers follow from the addresses on the wire."""

    offset: Annotated[int, Entry("manual's number minus address on the wire", low=0, high=465536)]
    meaning: Annotated[str, Entry("the manual's own rule, in a sentence")]


@dataclass(frozen=True)
class Tcp:
    """Modbus TCP."""

    port: Annotated[int, Entry("TCP port, of a gateway, too", low=1, high=65535)]
    device_id: Annotated[
        int, Entry("unit identifier; behind a gateway it is that of `serial`", low=0, high=255),
    ]


@dataclass(frozen=True)
class Register:
    """A holding register, or two that are one value.

    The value in the stated unit is scale x raw, divided by that of the register `full_scale` where
    one is named.
    """

    address: Annotated[int, Entry("on the wire, the first register is 0", low=0, high=65535)]
    manual: Annotated[int, Entry("the manual's number for it; address + numbering.offset", low=0)]
    type: Annotated[str, Entry("how it is coded", choices=tuple(WIDTH))]
    meaning: Annotated[str, Entry("what it holds")]
    source: Annotated[str, Entry("page or table of one of the sources, or 'none'")]
    word_order: Annotated[
        str, Entry("which half of 32 bits comes first", choices=WORD_ORDERS),
    ] = ""
    length: Annotated[
        int, Entry("of a text: how many registers of two characters each", low=0, high=64),
    ] = 0
    unit: Annotated[str, Entry("of the scaled value; empty: a plain word", choices=UNITS)] = ""
    scale: Annotated[float, Entry("value = scale x raw")] = 1.0
    full_scale: Annotated[
        str, Entry("a register by whose value this one is divided, read on connecting"),
    ] = ""
    low: Annotated[float, Entry("the least believable value, in the unit")] = -math.inf
    high: Annotated[float, Entry("the greatest believable value, in the unit")] = math.inf
    missing: Annotated[Word | None, Entry("the raw value that says 'not available'")] = None

    @property
    def width(self) -> int:
        """How many registers the value takes."""
        return WIDTH[self.type] or self.length


@dataclass(frozen=True)
class Condition:
    """What holds where register & mask == value."""

    mask: Annotated[Word, Entry("bits that count", low=1, high=0xFFFFFFFF)]
    value: Annotated[Word, Entry("what they must be", low=0, high=0xFFFFFFFF)]
    register: Annotated[str, Entry("name of the register")] = "status"

    def holds(self, raw: int) -> bool:
        """Tell whether a raw value fulfils it."""
        return raw & self.mask == self.value


@dataclass(frozen=True)
class Step:
    """One write, and what the drive must say before the next."""

    write: Annotated[str, Entry("name of the register that is written")]
    value: Annotated[
        Word | str,
        Entry("the word, or 'speed': the speed asked for", low=0, high=0xFFFF, choices=(SPEED,)),
    ]
    until: Annotated[Condition | None, Entry("what must hold before the next step")] = None
    within_s: Annotated[float, Entry("how long that may take (s)", low=0.05, high=60)] = 1.0


@dataclass(frozen=True)
class Sequences:
    """What is written, in order, to bring the drive from one state to another."""

    ready: Annotated[
        tuple[Step, ...],
        Entry(
            "from any state without fault (power-up, reset, local control) to where `run` works"
        ),
    ]
    run: Annotated[
        tuple[Step, ...], Entry("speed and run; written again in every cycle while it runs"),
    ]
    stop: Annotated[
        tuple[Step, ...], Entry("ramp down and off; written again in every cycle while off"),
    ]
    reset: Annotated[tuple[Step, ...], Entry("acknowledge a fault; leaves the drive off")]


@dataclass(frozen=True)
class Status:
    """What the status word says."""

    enabled: Annotated[Condition, Entry("`run` works without `ready` before it")]
    ready: Annotated[Condition, Entry("no fault, no interlock: it would start")]
    running: Annotated[Condition, Entry("the motor is fed")]
    fault: Annotated[Condition, Entry("a fault holds it off")]
    warning: Annotated[Condition | None, Entry("a warning stands")] = None
    remote: Annotated[Condition | None, Entry("it obeys the bus")] = None
    bits: Annotated[
        dict[int, str],
        Entry("texts of the status word's bits, 0 the least significant", low=0, high=31),
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class Codes:
    """A register of faults or warnings, and its texts."""

    register: Annotated[str, Entry("its name")]
    kind: Annotated[str, Entry("one code, or a bit for each", choices=("code", "bits"))]
    texts: Annotated[
        dict[Word, str],
        Entry(
            "text of each code, or of each bit (0 the least significant)", low=0, high=0xFFFFFFFF
        ),
    ] = field(default_factory=dict)

    def only(self, raw: int, among: tuple[Word, ...]) -> bool:
        """Tell whether a raw value says nothing but what is among some codes or bits."""
        if self.kind == "code":
            return raw in among
        return raw != 0 and raw & ~sum(1 << bit for bit in among) == 0

    def text(self, raw: int) -> str:
        """Return what a raw value says; empty for none."""
        if raw == 0:
            return ""
        if self.kind == "code":
            return f"{self.texts.get(Word(raw), 'no text for it')} (code {raw}, 0x{raw:04X})"
        bits = [bit for bit in range(32) if raw >> bit & 1]
        return ", ".join(self.texts.get(Word(bit), f"bit {bit}") for bit in bits)


@dataclass(frozen=True)
class Action:
    """A setting on which it depends whether the communication timeout stops the pump."""

    register: Annotated[str, Entry("its name")]
    stops: Annotated[
        dict[int, str], Entry("values with which it stops the pump, and their names", low=0),
    ]
    runs_on: Annotated[
        dict[int, str],
        Entry(
            "values with which it does not, or not for certain, or not until somebody resets it: "
            "the timeout counts as off", low=0,
        ),
    ]


@dataclass(frozen=True)
class Timeout:
    """The communication timeout of one of the drive's interfaces."""

    register: Annotated[str, Entry("name of the register that holds the time")]
    kept_alive_by: Annotated[str, Entry("which messages start it anew")]
    how_to_set: Annotated[str, Entry("for people: where and to what")]
    off_values: Annotated[tuple[Word, ...], Entry("raw times that mean off")] = ()
    action: Annotated[Action | None, Entry("where it says what it then does")] = None
    mode: Annotated[
        Action | None, Entry("where it says which messages start it anew, if that can be chosen"),
    ] = None
    trips: Annotated[
        tuple[Word, ...],
        Entry("codes (or bits) of `faults` by which the drive says that it has passed", low=0),
    ] = ()
    unguarded_after_power_up_s: Annotated[
        float,
        Entry(
            "so long after power-up it does not guard (s); the pump stands so long after each "
            "connection, since the drive may have been switched on just before", low=0, high=600,
        ),
    ] = 0.0
    local_settings_decide: Annotated[
        bool,
        Entry(
            "what the pump does then is set in the drive and cannot be read: a person must say "
            "that it stops (`local_settings_stop_the_pump`)"
        ),
    ] = False
    traps: Annotated[str, Entry("when it does not guard")] = ""

    @property
    def settings(self) -> tuple[Action, ...]:
        """Those on which it depends whether it stops the pump."""
        return tuple(one for one in (self.action, self.mode) if one is not None)


@dataclass(frozen=True)
class Timeouts:
    """The drive's own communication timeouts: each interface has one, which guards it alone."""

    serial: Annotated[
        Timeout | None, Entry("of its serial port, over a line or a gateway"),
    ] = None
    tcp: Annotated[Timeout | None, Entry("of its own Ethernet port, or its adapter's")] = None

    @property
    def known(self) -> dict[str, Timeout]:
        """Those of which the file tells, by interface."""
        both = {"serial": self.serial, "tcp": self.tcp}
        return {name: one for name, one in both.items() if one is not None}

    def over(self, address: Address) -> Timeout | None:
        """Return the one that guards a connection; None where the file tells of none."""
        return self.known.get(address.interface)


@dataclass(frozen=True)
class Nameplate:
    """A register that tells people which drive this is."""

    register: Annotated[str, Entry("its name")]
    texts: Annotated[dict[int, str], Entry("names of its values")] = field(default_factory=dict)


@dataclass(frozen=True)
class DriveFile:
    """A make of drive."""

    make: Annotated[str, Entry("maker")]
    model: Annotated[str, Entry("the drive, and the option or adapter that speaks Modbus")]
    sources: Annotated[tuple[Source, ...], Entry("documents that the file was made from")]
    unverified: Annotated[
        tuple[str, ...],
        Entry("keys of this file (such as registers.control) that no manual's text was found for"),
    ]
    numbering: Annotated[Numbering, Entry("the manual's numbers of registers")]
    tcp: Annotated[Tcp, Entry("Modbus TCP")]
    serial: Annotated[Serial, Entry("Modbus RTU as delivered")]
    registers: Annotated[
        dict[str, Register],
        Entry("by name; `control`, `reference`, `status` and `speed` must be there"),
    ]
    sequences: Annotated[Sequences, Entry("control words")]
    status: Annotated[Status, Entry("the status word")]
    faults: Annotated[Codes, Entry("fault codes")]
    timeout: Annotated[Timeouts, Entry("the drive's own communication timeouts")]
    nameplate: Annotated[tuple[Nameplate, ...], Entry("read on connecting")]
    least_speed: Annotated[
        float, Entry("share of rated speed below which it is not run", low=0, high=1),
    ]
    set_up: Annotated[tuple[str, ...], Entry("for people: what must be set in the drive")]
    warnings: Annotated[Codes | None, Entry("warning codes")] = None
    path: Path = Path()

    @property
    def name(self) -> str:
        """How options name it."""
        return self.path.stem

    def device_id_at(self, address: Address) -> int:
        """Return the drive's unit identifier or slave address at an address.

        It is the address's own where that has one, else that of the interface that is reached:
        behind a gateway it is the slave address.
        """
        if address.device_id is not None:
            return address.device_id
        return (self.tcp if address.interface == "tcp" else self.serial).device_id

    @property
    def unverified_and_vital(self) -> tuple[str, ...]:
        """Those unverified keys by which a pump may run when it must not."""
        steps = (*self.sequences.ready, *self.sequences.run, *self.sequences.stop)
        registers = {"status", *(step.write for step in steps)}
        for own in self.timeout.known.values():
            registers |= {own.register, *(one.register for one in own.settings)}
        vital = ("numbering", "sequences", "timeout", *(f"registers.{name}" for name in registers))
        return tuple(
            key for key in self.unverified
            if any(key == each or key.startswith(f"{each}.") for each in vital)
        )


def find_drive_file(name: str) -> Path:
    """Return the file of a drive that an option names.

    Args:
        name: a file, or the name of one in ``config/drives/`` without its ending.

    Raises:
        ConfigurationError: there is none.
    """
    shipped = shared_directory() / "config" / "drives"
    names = sorted(path.stem for path in shipped.glob("*.yaml"))
    if name in names:
        return shipped / f"{name}.yaml"
    if Path(name).is_file():
        return Path(name)
    raise ConfigurationError(
        f"is neither a file nor one of {', '.join(names)} in config/drives/",
        key="drive", value=name,
    )


def read_drive_file(path: Path) -> DriveFile:
    """Read a drive's file and check it.

    Raises:
        ConfigurationError: something in it is missing, unknown, impossible, or contradicts
            something else in it.
    """
    content = read_yaml(path)
    drive = replace(read_record(DriveFile, path, content), path=path)
    _Check(drive, content).all()
    return drive


class _Check:
    """Holds the parts of a file against each other."""

    def __init__(self, drive: DriveFile, content: YamlMapping) -> None:
        self.drive, self.content = drive, content

    def fail(self, key: str, value: object, expected: str) -> None:
        """Raise the error of a key such as ``registers.control``."""
        raise error_at(self.drive.path, self.content, key, value, expected)

    def all(self) -> None:
        """Check everything."""
        for name, register in self.drive.registers.items():
            self._register(name, register)
        needed = {"control": "", "reference": "share", "status": "", "speed": "share"}
        for name, unit in needed.items():
            if name not in self.drive.registers:
                self.fail("registers", None, f"{name} is missing: every drive needs it")
            self._unit(f"registers.{name}", name, unit)
        if "flow" in self.drive.registers:
            self._unit("registers.flow", "flow", "m3/s")
        self._sequences()
        self._status()
        self._others()
        self._unverified()

    def _known(self, key: str, name: str) -> Register:
        if name not in self.drive.registers:
            self.fail(key, name, f"must be one of registers: {', '.join(self.drive.registers)}")
        return self.drive.registers[name]

    def _bits(self, key: str, name: str) -> None:
        if not self._known(key, name).type.startswith("uint"):
            self.fail(key, name, "must be a register of the type uint16 or uint32")

    def _unit(self, key: str, name: str, unit: str) -> None:
        register = self._known(key, name)
        if register.unit != unit:
            self.fail(
                f"registers.{name}.unit" if register.unit else f"registers.{name}",
                register.unit or None,
                f"must have the unit {unit}" if unit else "must be a plain word, without a unit",
            )

    def _register(self, name: str, register: Register) -> None:
        key = f"registers.{name}"
        offset = self.drive.numbering.offset
        if register.manual - register.address != offset:
            self.fail(
                f"{key}.manual", register.manual,
                f"must be {register.address + offset}: address {register.address} + "
                f"numbering.offset {offset}; one of the two is wrong",
            )
        if register.address + register.width > 65536:
            self.fail(f"{key}.address", register.address, "leaves no room for a second register")
        if (WIDTH[register.type] == 2) != bool(register.word_order):
            self.fail(
                f"{key}.word_order", register.word_order or None,
                "must be 'high first' or 'low first'" if WIDTH[register.type] == 2
                else f"does not belong to {register.type}, which is no number of 32 bits",
            )
        if (register.type == "text") != bool(register.length):
            self.fail(
                f"{key}.length", register.length,
                "must say how many registers" if register.type == "text"
                else f"belongs to a text, not to {register.type}",
            )
        if register.scale == 0 or not math.isfinite(register.scale):
            self.fail(f"{key}.scale", register.scale, "must be finite and not 0")
        if register.low > register.high:
            self.fail(f"{key}.low", register.low, f"must be at most high, {register.high:g}")
        if register.full_scale:
            self._bits(f"{key}.full_scale", register.full_scale)
            full = self.drive.registers[register.full_scale]
            if not 0 < full.low <= full.high < math.inf or full.full_scale:
                self.fail(
                    f"registers.{register.full_scale}", None,
                    f"must have low, above 0, and high, and no full_scale: {name} is divided by it",
                )
        if register.unit and register.type == "text":
            self.fail(f"{key}.unit", register.unit, "does not belong to a text")

    def _condition(self, key: str, condition: Condition | None) -> None:
        if condition is None:
            return
        self._bits(f"{key}.register", condition.register)
        if condition.value & ~condition.mask:
            self.fail(
                f"{key}.value", f"0x{condition.value:04X}",
                f"has bits outside of the mask 0x{condition.mask:04X}: it could never hold",
            )

    def _sequences(self) -> None:
        for name in ("ready", "run", "stop", "reset"):
            steps: tuple[Step, ...] = getattr(self.drive.sequences, name)
            written = set()
            for number, step in enumerate(steps, start=1):
                key = f"sequences.{name}.{number}"
                register = self._known(f"{key}.write", step.write)
                if register.width != 1:
                    self.fail(f"{key}.write", step.write, "must be a register of 16 bits")
                if step.value == SPEED and (name != "run" or register.unit != "share"):
                    self.fail(
                        f"{key}.value", step.value,
                        "can be written in sequences.run only, to a register whose unit is share",
                    )
                written.add(step.value if step.value == SPEED else step.write)
                self._condition(f"{key}.until", step.until)
            if name != "ready" and "control" not in written:
                self.fail(f"sequences.{name}", None, "must write the register control")
            if name == "run" and SPEED not in written:
                self.fail("sequences.run", None, "must write the speed")
            if name == "run" and steps[-1].write != "control":
                self.fail("sequences.run", None, "must end with the register control")

    def _status(self) -> None:
        for name in ("enabled", "ready", "running", "fault", "warning", "remote"):
            self._condition(f"status.{name}", getattr(self.drive.status, name))

    def _others(self) -> None:
        drive = self.drive
        self._bits("faults.register", drive.faults.register)
        if drive.warnings is not None:
            self._bits("warnings.register", drive.warnings.register)
        for interface, own in drive.timeout.known.items():
            key = f"timeout.{interface}"
            self._unit(f"{key}.register", own.register, "s")
            for name, setting in (("action", own.action), ("mode", own.mode)):
                if setting is None:
                    continue
                self._bits(f"{key}.{name}.register", setting.register)
                for value in setting.stops:
                    if value in setting.runs_on:
                        self.fail(
                            f"{key}.{name}.stops", value, "stands in stops and in runs_on, too"
                        )
        for number, plate in enumerate(drive.nameplate, start=1):
            self._known(f"nameplate.{number}.register", plate.register)

    def _unverified(self) -> None:
        for key in self.drive.unverified:
            place: Any = self.content
            for part in key.split("."):
                if isinstance(place, list) and part.isdecimal() and 0 < int(part) <= len(place):
                    place = place[int(part) - 1]
                elif isinstance(place, YamlMapping) and part in place:
                    place = place[part]
                else:
                    self.fail("unverified", key, "names no key of this file")
