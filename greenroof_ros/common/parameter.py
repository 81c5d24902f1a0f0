"""Values that a user sets, each with its default, unit, range and meaning in one place; and files.

Frozen dataclasses are read from YAML; an error names file, line, key and value. The default of each
field is an `entry`: it gives the meaning and the allowed values of the key, both to the code that
reads a file and to the code that writes its documentation. If a key may hold one of several
dataclasses, all but the first have a static method ``fits``, which reports whether a mapping is for
that dataclass.
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
    """A value that a user sets: of a controller, of the pump's limits, or of a node.

    It defines the node's declared parameter and its ``--help``, the check of parameter files and of
    a study's grid, the command-line option, and the table in the documentation.

    Attributes:
        name: lower case, with underscores.
        default: value unless given. Its type is the parameter's: a number, a whole number, true or
            false, a text, or a list of texts.
        unit: of the value, ``1`` if it has none; empty if the meaning gives it.
        low: minimum value of a number.
        high: maximum value of a number.
        meaning: one line, without the unit.
        may_change: whether it may change during a run; a controller then has an attribute of
            that name, which is set between two ticks.
        among: the only texts allowed; empty if any text is.
        measured: default on a roof with a measured soil; None if it is the same.
        usual: range of its usual values, for people; None if it is not stated.
    """

    name: str
    default: Any
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    meaning: str = ""
    may_change: bool = False
    among: tuple[str, ...] = ()
    measured: Any = None
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
        """Return a value that a user gives, checked; a number as Python's.

        Args:
            value: what is given.
            file: where, for the error.
            line: likewise.
            key: likewise.

        Raises:
            ConfigurationError: it is not in the range, or none of the allowed texts.
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
        meaning: for the documentation, and for the error if the key is missing.
        low: the minimum number.
        high: the maximum number.
        unit: of the number, ``1`` if it has none; empty if the meaning gives it.
        choices: the only texts allowed.
        default: the default of an optional key.
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


@functools.cache  # a district makes thousands of sites
def keys(kind: Any) -> tuple[Key, ...]:
    """Return the keys that a dataclass reads: its fields that were made by `entry`."""
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
    """Return the keys of a dataclass as parameters; a required key has the default None."""
    return [key.entry for key in keys(kind)]


def _refuse(parts: tuple[str, ...], expected: str, value: object = None) -> ConfigurationError:
    return ConfigurationError(expected, key=".".join(parts), value=value)


def read_record(
    kind: type[Record], file: Path,
    mistakes: Callable[[Record, YamlMapping], Iterable[tuple[str, str]]] = lambda *_: (),
) -> Record:
    """Read a YAML file as a dataclass, and check it.

    Args:
        kind: a frozen dataclass with fields made by `entry`.
        file: the file.
        mistakes: yields the key of each mistake, such as ``registers.control`` (names, and for
            items of lists numbers from 1), and what is wrong with its value, or what is missing;
            called with the dataclass and the content of the file.

    Raises:
        ConfigurationError: the file cannot be read; a key is unknown or missing; a value is of the
            wrong kind or out of range; or there is a mistake.
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
    """Return a dataclass from the values of its keys, checked as those of a file.

    Args:
        kind: as for :func:`read_record`.
        values: by key.

    Raises:
        ConfigurationError: a key is unknown or missing, or a value is of the wrong kind or out of
            range.
    """
    record: Record = _record(kind, values, ())
    return record


def find(content: YamlMapping, key: str) -> tuple[int | None, Any]:
    """Return line and value of a key: names, and for items of lists numbers from 1.

    If there is no such key: the line of the last part of it that exists, and None.
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
    if hasattr(value, "tolist"):  # an array of numpy
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
    """Return a mapping's key in its own type; `files.read_yaml` returns keys as text."""
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
    """Return that there is no parameter of a name, and the closest of the names that there are."""
    return f"there is no such parameter; the closest is {find_closest(name, names)}"


def find_closest(name: str, names: Iterable[str]) -> str:
    """Return the name that is closest to another."""
    return get_close_matches(name, list(names), 1, 0.0)[0]
