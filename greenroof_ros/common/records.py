"""Frozen dataclasses read from YAML, each error with file, line, key and value.

A dataclass says with `entry`, as the default of each field, what the key means and which values it
may have; what reads a file and what writes its documentation both go by that.
"""

from __future__ import annotations

import math
import re
import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NewType, TypeVar, Union, get_args, get_origin, get_type_hints

from greenroof_ros.common.errors import ConfigurationError, did_you_mean
from greenroof_ros.common.files import YamlMapping
from greenroof_ros.common.parameter import Parameter

Record = TypeVar("Record")
# A whole number that a file may write in hexadecimal, such as 0x047E.
Word = NewType("Word", int)

_HEXADECIMAL = re.compile(r"0x[0-9A-Fa-f]{1,8}")


def entry(
    meaning: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
    default: Any = MISSING,
    factory: Any = MISSING,
) -> Any:
    """Return the field of a dataclass that is a key of a file.

    Args:
        meaning: for the documentation, and for who left the key away.
        low: the least number.
        high: the greatest number.
        unit: of the number, ``1`` if it has none; empty where the meaning says it.
        choices: the only texts.
        default: of a key that may be left away.
        factory: makes it, where it is a mapping.
    """
    told = {"entry": Parameter("", None, unit, low, high, meaning, among=choices)}
    made: Any = field(default=default, default_factory=factory, metadata=told)
    return made


@dataclass(frozen=True)
class Key:
    """A key of a file: a field of a dataclass."""

    name: str
    kind: Any
    entry: Parameter
    optional: bool
    default: Any


def keys(kind: Any) -> list[Key]:
    """Return the keys that a dataclass reads; fields that are no `entry` are none."""
    hints = get_type_hints(kind)
    return [
        Key(
            one.name, hints[one.name], one.metadata["entry"],
            one.default is not MISSING or one.default_factory is not MISSING, one.default,
        )
        for one in fields(kind) if "entry" in one.metadata
    ]


def parameters_of(kind: Any) -> list[Parameter]:
    """Return the keys of a dataclass as parameters; the default is None where there is none."""
    return [
        replace(key.entry, name=key.name, default=None if key.default is MISSING else key.default)
        for key in keys(kind)
    ]


def read_record(kind: type[Record], file: Path, mapping: YamlMapping, key: str = "") -> Record:
    """Return a dataclass with the values of a mapping.

    Args:
        kind: a frozen dataclass whose fields are made by `entry`.
        file: where the mapping stands.
        mapping: as `files.read_yaml` reads it.
        key: the mapping's own key; empty for a whole file.

    Raises:
        ConfigurationError: a key is unknown or missing, or a value of the wrong kind or out of
            range.
    """
    made: Record = _record(kind, mapping, _Place(file, None, key))
    return made


def error_at(file: Path, content: YamlMapping, key: str, expected: str) -> ConfigurationError:
    """Return what is wrong with a key such as ``registers.control``, with its line and its value.

    Args:
        file: that was read.
        content: of it.
        key: by names, and in lists by numbers that begin with 1.
        expected: what is wrong with what stands there, or is missing.
    """
    line, place = find(content, key)
    value = None if isinstance(place, (list, YamlMapping)) else place
    return ConfigurationError(expected, file=file, line=line, key=key, value=value)


def find(content: YamlMapping, key: str) -> tuple[int | None, Any]:
    """Return line and value of a key, by names, and in lists by numbers that begin with 1.

    Where there is none: the line of the last part of it that there is, and None.
    """
    place: Any = content
    line = None
    for part in key.split("."):
        if isinstance(place, YamlMapping) and part in place:
            line, place = place.lines[part], place[part]
        elif isinstance(place, list) and part.isdecimal() and 0 < int(part) <= len(place):
            place = place[int(part) - 1]
            line = min(place.lines.values()) if isinstance(place, YamlMapping) else line
        else:
            place = None
    return line, place


class _Place:
    """Where a value stands, for messages."""

    def __init__(self, file: Path, line: int | None, key: str) -> None:
        self.file, self.line, self.key = file, line, key

    def error(self, expected: str, value: object = None) -> ConfigurationError:
        return ConfigurationError(
            expected, file=self.file, line=self.line, key=self.key or None, value=value
        )

    def below(self, key: object, mapping: Mapping[Any, Any] | None = None) -> _Place:
        line = mapping.lines.get(str(key)) if isinstance(mapping, YamlMapping) else None
        return _Place(self.file, line or self.line, f"{self.key}.{key}" if self.key else str(key))


def _record(kind: Any, value: Any, place: _Place) -> Any:
    if not isinstance(value, YamlMapping):
        raise place.error("must hold 'key: value' lines", value)
    known = {key.name: key for key in keys(kind)}
    for name in value:
        if name not in known:
            raise place.below(name, value).error(
                f"is no key here; {did_you_mean(str(name), known)}", value[name]
            )
    made = {}
    for name, key in known.items():
        if name in value:
            made[name] = _value(key.kind, value[name], key.entry, place.below(name, value))
        elif not key.optional:
            line = place.line or min(value.lines.values(), default=None)
            raise _Place(place.file, line, place.below(name).key).error(
                f"is missing: {key.entry.meaning}"
            )
    return kind(**made)


def _value(kind: Any, value: Any, entry: Parameter, place: _Place) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (types.UnionType, Union):
        return _either(inner, value, entry, place)
    if is_dataclass(kind):
        return _record(kind, value, place)
    if origin is tuple:
        if not isinstance(value, list):
            raise place.error("must be a list", value)
        return tuple(
            _value(inner[0], each, entry, place.below(number))
            for number, each in enumerate(value, start=1)
        )
    if origin is dict:
        if not isinstance(value, YamlMapping):
            raise place.error("must hold 'key: value' lines", value)
        return {
            _key(inner[0], key, entry, place.below(key, value)):
            _value(inner[1], each, entry, place.below(key, value))
            for key, each in value.items()
        }
    return _scalar(kind, value, entry, place)


def _key(kind: Any, key: str, entry: Parameter, place: _Place) -> Any:
    """Return a mapping's key as what it was; `files.read_yaml` hands keys over as text."""
    if kind is str:
        return key
    return _scalar(kind, int(key) if key.isdecimal() else key, entry, place)


def _either(inner: tuple[Any, ...], value: Any, entry: Parameter, place: _Place) -> Any:
    if value is None and types.NoneType in inner:
        return None
    if isinstance(value, str) and str in inner and value in entry.among:
        return value
    kinds = [kind for kind in inner if kind not in (types.NoneType, str)]
    return _value(kinds[0] if kinds else str, value, entry, place)


def _scalar(kind: Any, value: Any, entry: Parameter, place: _Place) -> Any:
    if kind is bool:
        if not isinstance(value, bool):
            raise place.error("must be true or false", value)
        return value
    if kind is str:
        if not isinstance(value, str) or not (value.strip() or value in entry.among):
            raise place.error("must be a text", value)
        if entry.among and value not in entry.among:
            raise place.error(f"must be one of {', '.join(filter(None, entry.among))}", value)
        return " ".join(value.split())
    if kind is Word and isinstance(value, str) and _HEXADECIMAL.fullmatch(value):
        value = int(value, 16)
    whole = kind in (int, Word)
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        expected = "a whole number" if whole else "a number"
        if kind is Word:
            expected += ", such as 0x047E or 1150"
        raise place.error(f"must be {' or '.join((expected, *entry.among))}", value)
    if not entry.low <= value <= entry.high:
        raise place.error(f"must be {span(entry.low, entry.high)}", value)
    return value if whole else float(value)


def span(low: float, high: float) -> str:
    """Return a range in words."""
    if math.isinf(high):
        return f"{low:.9g} or more"
    return f"at most {high:.9g}" if math.isinf(low) else f"from {low:.9g} to {high:.9g}"
