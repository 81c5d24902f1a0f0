"""User-defined values, with their default, unit, range and meaning, and readers of their files.

Frozen dataclasses are read from YAML; an error names the file, line, key and value. The default of
every field is an `entry`, which defines the meaning and the allowed values of the key, both for
reading a file and for generating its documentation. If the value of a key may be one of several
dataclasses, all of these except the first have a static method ``fits``, which returns True if a
mapping is meant for the dataclass.
"""

from __future__ import annotations

import functools
import math
import re
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NewType, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from greenroof_ros.base.errors import ConfigurationError, describe_choices, suggest_names
from greenroof_ros.base.files import YamlMapping, read_yaml
from greenroof_ros.base.ranges import Range

Record = TypeVar("Record")
# A whole number that a file may write in hexadecimal, such as 0x047E.
Word = NewType("Word", int)

_HEXADECIMAL = re.compile(r"0x[0-9A-Fa-f]{1,16}")


@dataclass(frozen=True)
class Parameter:
    """A value that a user sets: a parameter of a controller or a node, or a limit of the pump.

    This definition is the source of the node's declared parameter and its ``--help``, of the checks
    of parameter files and of a study's grid, of the command-line option, and of the table in the
    documentation.

    Attributes:
        name: name of the parameter, in lower case with underscores.
        default: default value. The type of the default is the type of the parameter: float,
            integer, boolean, string, or list of strings.
        unit: unit of the value, ``1`` if it is dimensionless; empty if the meaning states the unit.
        low: minimum, if the value is a number.
        high: maximum, if the value is a number.
        meaning: one-line description of the value, without the unit.
        may_change: True if the value may change during a run; the controller then has an attribute
            with the parameter's name, which is set between two ticks.
        among: the allowed strings; empty if any string is allowed.
        on_field_capacity: default value on a roof with field-capacity soil; None if the default is
            the same.
        usual: range of usual values, for the documentation; None for no range.
    """

    name: str
    default: Any
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    meaning: str = ""
    may_change: bool = False
    among: tuple[str, ...] = ()
    on_field_capacity: Any = None
    usual: tuple[float, float] | None = None

    @property
    def whole(self) -> bool:
        """Whether the value is an integer."""
        return isinstance(self.default, int)

    @property
    def description(self) -> str:
        """The meaning, with the unit."""
        return f"{self.meaning} ({self.unit})" if self.unit else self.meaning

    @functools.cached_property
    def range(self) -> Range:
        """The range of valid numbers."""
        return Range(self.low, self.high, self.unit, self.whole)

    def read(
        self, value: Any, *, key: str, file: Path | None = None, line: int | None = None
    ) -> Any:
        """Check a user's value, and return it, with a number converted to a Python number.

        Args:
            value: the user's value.
            file: file that contains the value, for the error.
            line: line that contains the value, for the error.
            key: key of the value, for the error.

        Raises:
            ConfigurationError: if the value is out of range, or is not one of the allowed strings.
        """
        if not self.among:
            return self.range.read(value, file=file, line=line, key=key)
        if isinstance(value, str) and value in self.among:
            return value
        expected = describe_choices([*filter(None, self.among)], str(value))
        raise ConfigurationError(expected, file=file, line=line, key=key, value=value)

    @property
    def limits(self) -> str:
        """The range or the allowed strings, as text; empty if the value is not restricted."""
        return " or ".join(self.among) or self.range.limits


def entry(
    meaning: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
    default: Any = MISSING,
    factory: Any = MISSING,
    usual: tuple[float, float] | None = None,
) -> Any:
    """Return a dataclass field for a key of a file.

    Args:
        meaning: meaning of the key, for the documentation and for the error if the key is missing.
        low: minimum, if the value is a number.
        high: maximum, if the value is a number.
        unit: unit of the number, ``1`` if it is dimensionless; empty if the meaning states the
            unit.
        choices: the allowed strings; empty if any string is allowed.
        default: default of an optional key.
        factory: function that creates the default if the default is a mapping.
        usual: range of usual values.
    """
    value = None if default is MISSING else default
    metadata = {
        "entry": Parameter("", value, unit, low, high, meaning, among=choices, usual=usual)
    }
    result: Any = field(default=default, default_factory=factory, metadata=metadata)
    return result


@dataclass(frozen=True)
class Key:
    """A key of a file, which corresponds to a field of a dataclass."""

    name: str
    kind: Any
    entry: Parameter
    optional: bool


@functools.cache  # a district creates thousands of sites
def keys(kind: Any) -> tuple[Key, ...]:
    """Return the keys of a dataclass, that is, the fields that were created with `entry`."""
    hints = get_type_hints(kind)
    return tuple(
        Key(
            attribute.name, hints[attribute.name],
            replace(attribute.metadata["entry"], name=attribute.name),
            attribute.default is not MISSING or attribute.default_factory is not MISSING,
        )
        for attribute in fields(kind) if "entry" in attribute.metadata
    )


def parameters_of(kind: Any) -> list[Parameter]:
    """Return the keys of a dataclass as parameters; the default of a required key is None."""
    return [key.entry for key in keys(kind)]


def _refuse(parts: tuple[str, ...], expected: str, value: object = None) -> ConfigurationError:
    return ConfigurationError(expected, key=".".join(parts), value=value)


def read_record(
    kind: type[Record], file: Path,
    mistakes: Callable[[Record, YamlMapping], Iterable[tuple[str, str]]] = lambda *_: (),
) -> Record:
    """Read a YAML file, check it, and return it as a dataclass.

    Args:
        kind: frozen dataclass whose fields were created with `entry`.
        file: the file.
        mistakes: function that receives the dataclass and the content of the file. For every
            mistake, the function yields the key, such as ``registers.control`` (list items are
            numbered from 1), and a description of the mistake.

    Raises:
        ConfigurationError: if the file cannot be read, a key is unknown or missing, a value is of
            the wrong type or out of range, or ``mistakes`` yields a mistake.
    """
    content = read_yaml(file)
    try:
        record = make_record(kind, content)
    except ConfigurationError as error:
        line = find(content, error.key or "")[0] or min(content.lines.values(), default=None)
        raise ConfigurationError(
            error.expected, file=file, line=line, key=error.key, value=error.value
        ) from None
    for key, expected in mistakes(record, content):
        line, place = find(content, key)
        value = None if isinstance(place, (list, YamlMapping)) else place
        raise ConfigurationError(expected, file=file, line=line, key=key, value=value)
    return record


def make_record(kind: type[Record], values: Mapping[str, Any]) -> Record:
    """Return a dataclass with the given values, which are checked like the values in a file.

    Args:
        kind: frozen dataclass whose fields were created with `entry`.
        values: values of the fields, by key.

    Raises:
        ConfigurationError: if a key is unknown or missing, or if a value is of the wrong type or
            out of range.
    """
    return cast(Record, _record(kind, values, ()))


def find(content: YamlMapping, key: str) -> tuple[int | None, Any]:
    """Return the line and the value of a key, which consists of names and item numbers.

    The items of a list are numbered from 1. If the key does not exist, return the line of its last
    existing part, and None.
    """
    place: Any = content
    line = None
    for part in [key] if key in content else key.split("."):
        if isinstance(place, YamlMapping) and part in place:
            line, place = place.lines[part], place[part]
        elif isinstance(place, list) and part.isdecimal() and 0 < int(part) <= len(place):
            place = place[int(part) - 1]
            line = min(place.lines.values()) if isinstance(place, YamlMapping) else line
        else:
            place = None
    return line, place


def _record(kind: Any, value: Any, parts: tuple[str, ...]) -> Any:
    entries, by_name = _mapping(value, parts), {key.name: key for key in keys(kind)}
    for name, given in entries.items():
        if name not in by_name:
            wrong = f"is not a valid key; {suggest_names(name, by_name)}"
            raise _refuse((*parts, name), wrong, given)
    fields = {}
    for name, key in by_name.items():
        if name in entries:
            fields[name] = _value(key.kind, entries[name], key.entry, (*parts, name))
        elif not key.optional:
            raise _refuse((*parts, name), f"is missing: {key.entry.description}")
    return kind(**fields)


def _mapping(value: Any, parts: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise _refuse(parts, "must contain 'key: value' lines", value)
    return value


def _value(kind: Any, value: Any, entry: Parameter, parts: tuple[str, ...]) -> Any:
    if hasattr(value, "tolist"):  # a NumPy array
        value = value.tolist()
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (types.UnionType, Union):
        if value is None and types.NoneType in inner:
            return None
        if isinstance(value, str) and str in inner and value in entry.among:
            return value
        kinds = [member for member in inner if member not in (types.NoneType, str)] or [str]
        if isinstance(value, YamlMapping):
            kinds = [*(member for member in kinds[1:] if member.fits(value)), *kinds]
        return _value(kinds[0], value, entry, parts)
    if is_dataclass(kind):
        return _record(kind, value, parts)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise _refuse(parts, f"must be a list ({entry.meaning})", value)
        return tuple(
            _value(inner[0], item, entry, (*parts, str(number)))
            for number, item in enumerate(value, start=1)
        )
    if origin is dict:
        return {
            _key(inner[0], key, entry, (*parts, key)): _value(inner[1], item, entry, (*parts, key))
            for key, item in _mapping(value, parts).items()
        }
    return _scalar(kind, value, entry, parts)


def _key(kind: Any, key: str, entry: Parameter, parts: tuple[str, ...]) -> Any:
    """Convert a mapping's key to the key's type, because `files.read_yaml` returns keys as text."""
    if kind is str:
        return key
    return _scalar(kind, int(key) if key.isdecimal() else key, entry, parts)


def _scalar(kind: Any, value: Any, entry: Parameter, parts: tuple[str, ...]) -> Any:
    if kind is bool:
        if not isinstance(value, bool):
            raise _refuse(parts, "must be true or false", value)
        return value
    if kind is str:
        if entry.among:
            return entry.read(value, key=".".join(parts))
        if not isinstance(value, str) or not value.strip():
            raise _refuse(parts, f"must be text ({entry.meaning})", value)
        return " ".join(value.split())
    if kind is Word and isinstance(value, str) and _HEXADECIMAL.fullmatch(value):
        value = int(value, 16)
    allowed = replace(entry.range, whole=kind in (int, Word), words=entry.among)
    example = ", such as 0x047E or 1150" if kind is Word else ""
    return allowed.read(value, key=".".join(parts), about=f"{example} ({entry.meaning})")


def replace_infinity(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Replace infinity with None, because JSON has no infinity; null then means no limit."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in parameters.items()
    }
