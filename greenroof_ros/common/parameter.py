"""User-set values, each with default, unit, range and meaning in one place; and their files.

Frozen dataclasses are read from YAML; an error names the file, line, key and value. The default of
every field is an `entry`: it gives the meaning and the allowed values of the key, both to the code
that reads a file and to the code that writes its documentation. If a key may hold one of several
dataclasses, all but the first have a static method ``fits``, which reports whether a mapping is
meant for that dataclass.
"""

from __future__ import annotations

import functools
import math
import re
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NewType, TypeVar, Union, get_args, get_origin, get_type_hints

from greenroof_ros.common.errors import ConfigurationError, describe_choices, suggest_names
from greenroof_ros.common.files import YamlMapping, read_yaml
from greenroof_ros.common.ranges import Range

Record = TypeVar("Record")
# A whole number that a file may write in hexadecimal, such as 0x047E.
Word = NewType("Word", int)

_HEXADECIMAL = re.compile(r"0x[0-9A-Fa-f]{1,16}")


@dataclass(frozen=True)
class Parameter:
    """A value that a user sets: of a controller, the pump's limits, or a node.

    From it come the node's declared parameter and its ``--help``, the checks of parameter files and
    of a study's grid, the command-line option, and the table in the documentation.

    Attributes:
        name: the name, in lower case with underscores.
        default: the default value. Its type is the parameter's type: a number, a whole number, true
            or false, a text, or a list of texts.
        unit: unit of the value, ``1`` if it has none; empty if the meaning states it.
        low: minimum, for a number.
        high: maximum, for a number.
        meaning: the meaning in one line, without the unit.
        may_change: whether it may change during a run; a controller then has an attribute of that
            name, which is set between two ticks.
        among: the only texts allowed; empty if any text is allowed.
        on_field_capacity: default on a roof with field-capacity soil; None if it is the same.
        usual: range of usual values, for people; None if none is stated.
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
        """Whether it is a whole number."""
        return isinstance(self.default, int)

    @property
    def description(self) -> str:
        """Its meaning, with the unit."""
        return f"{self.meaning} ({self.unit})" if self.unit else self.meaning

    @functools.cached_property
    def range(self) -> Range:
        """The numbers that it may be."""
        return Range(self.low, self.high, self.unit, self.whole)

    def read(
        self, value: Any, *, file: Path | None = None, line: int | None = None,
        key: str = "",
    ) -> Any:
        """Return a user's value, checked; a number becomes a Python number.

        Args:
            value: the user's value.
            file: file that it is from, for the error.
            line: line that it is from, for the error.
            key: key of the value, for the error.

        Raises:
            ConfigurationError: if it is out of range, or is not one of the allowed texts.
        """
        if not self.among:
            return self.range.read(value, file=file, line=line, key=key)
        if isinstance(value, str) and value in self.among:
            return value
        raise ConfigurationError(
            describe_choices(self.among, str(value)), file=file, line=line, key=key, value=value
        )

    @property
    def limits(self) -> str:
        """Its range, or the allowed texts; empty if there is no limit."""
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
    """Return a dataclass field that is a key of a file.

    Args:
        meaning: meaning of the key, for the documentation and for the error if the key is missing.
        low: minimum, for a number.
        high: maximum, for a number.
        unit: unit of the number, ``1`` if it has none; empty if the meaning states it.
        choices: the only texts allowed.
        default: default of an optional key.
        factory: makes the default, if that is a mapping.
        usual: the range of usual values.
    """
    value = None if default is MISSING else default
    metadata = {
        "entry": Parameter("", value, unit, low, high, meaning, among=choices, usual=usual)
    }
    result: Any = field(default=default, default_factory=factory, metadata=metadata)
    return result


@dataclass(frozen=True)
class Key:
    """A key of a file: a field of a dataclass."""

    name: str
    kind: Any
    entry: Parameter
    optional: bool


@functools.cache  # a district creates thousands of sites
def keys(kind: Any) -> tuple[Key, ...]:
    """Return the keys that a dataclass reads: the fields that were made with `entry`."""
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
    """Return the keys of a dataclass as parameters; a required key has None as its default."""
    return [key.entry for key in keys(kind)]


def _refuse(parts: tuple[str, ...], expected: str, value: object = None) -> ConfigurationError:
    return ConfigurationError(expected, key=".".join(parts), value=value)


def read_record(
    kind: type[Record], file: Path,
    mistakes: Callable[[Record, YamlMapping], Iterable[tuple[str, str]]] = lambda *_: (),
) -> Record:
    """Read a YAML file as a dataclass, and check it.

    Args:
        kind: a frozen dataclass whose fields were made with `entry`.
        file: the file.
        mistakes: called with the dataclass and the content of the file; for every mistake it yields
            the key, such as ``registers.control`` (names, and numbers from 1 for items of lists),
            and what is wrong with its value, or what is missing.

    Raises:
        ConfigurationError: if the file cannot be read; a key is unknown or missing; a value is of
            the wrong kind or out of range; or there is a mistake.
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
    """Return a dataclass from the values of its keys, checked like those in a file.

    Args:
        kind: as for :func:`read_record`.
        values: the values, by key.

    Raises:
        ConfigurationError: if a key is unknown or missing, or a value is of the wrong kind or out
            of range.
    """
    record: Record = _record(kind, values, ())
    return record


def find(content: YamlMapping, key: str) -> tuple[int | None, Any]:
    """Return line and value of a key, given by names, and by numbers from 1 for items of lists.

    If there is no such key, return the line of the last part that exists, and None.
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
    for name in entries:
        if name not in by_name:
            wrong = f"is not a key here; {suggest_names(name, by_name)}"
            raise _refuse((*parts, name), wrong, entries[name])
    fields = {}
    for name, key in by_name.items():
        if name in entries:
            fields[name] = _value(key.kind, entries[name], key.entry, (*parts, name))
        elif not key.optional:
            raise _refuse((*parts, name), f"is missing: {key.entry.description}")
    return kind(**fields)


def _mapping(value: Any, parts: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise _refuse(parts, "must hold 'key: value' lines", value)
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
    """Return a mapping's key in its proper type; `files.read_yaml` returns keys as text."""
    if kind is str:
        return key
    return _scalar(kind, int(key) if key.isdecimal() else key, entry, parts)


def _scalar(kind: Any, value: Any, entry: Parameter, parts: tuple[str, ...]) -> Any:
    if kind is bool:
        if not isinstance(value, bool):
            raise _refuse(parts, "must be true or false", value)
        return value
    if kind is str:
        if not isinstance(value, str) or not (value.strip() or value in entry.among):
            raise _refuse(parts, f"must be text ({entry.meaning})", value)
        if entry.among and value not in entry.among:
            raise _refuse(parts, describe_choices([*filter(None, entry.among)], value), value)
        return " ".join(value.split())
    if kind is Word and isinstance(value, str) and _HEXADECIMAL.fullmatch(value):
        value = int(value, 16)
    allowed, whole = entry.range, kind in (int, Word)
    if (allowed.whole, allowed.words) != (whole, entry.among):
        allowed = replace(allowed, whole=whole, words=entry.among)
    example = ", such as 0x047E or 1150" if kind is Word else ""
    return allowed.read(value, key=".".join(parts), about=f"{example} ({entry.meaning})")


def replace_infinity(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters for JSON, which has no infinity: null stands for no limit."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in parameters.items()
    }


def suggest_parameter(name: str, names: Iterable[str]) -> str:
    """Return a message that there is no parameter of this name, and which name is closest."""
    return f"there is no such parameter; the closest is {find_closest(name, names)}"


def find_closest(name: str, names: Iterable[str]) -> str:
    """Return the name that is closest to another."""
    return get_close_matches(name, list(names), 1, 0.0)[0]
