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
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from greenroof_ros.base.errors import ConfigurationError, describe_choices, suggest_names
from greenroof_ros.base.files import YamlMapping, parse_plain, read_yaml
from greenroof_ros.base.ranges import Range

Record = TypeVar("Record")

OF_EVERY_NODE = {"use_sim_time", "start_type_description_service", "qos_overrides"}
"""parameters that rclpy declares in every node"""


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
        kind: type of the value in a file, if the parameter is a key of a file.
        optional: False if a file must contain the key.
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
    kind: Any = None
    optional: bool = True

    @property
    def whole(self) -> bool:
        """Whether the value is an integer."""
        return isinstance(self.default, int) or self.kind in (int, int | None)

    @property
    def description(self) -> str:
        """The meaning, with the unit."""
        return f"{self.meaning} ({self.unit})" if self.unit else self.meaning

    @functools.cached_property
    def range(self) -> Range:
        """The range of valid numbers."""
        return Range(self.low, self.high, self.unit, self.whole, self.among)

    def read(self, value: Any, **place: Any) -> Any:
        """Check a user's value, and return it, with a number converted to a Python number.

        Args:
            value: the user's value.
            place: key of the value, with its file and line if any, for the error.

        Raises:
            ConfigurationError: if the value is out of range, or is not one of the allowed strings.
        """
        if not self.among:
            return self.range.read(value, **place)
        if isinstance(value, str) and value in self.among:
            return value
        expected = describe_choices([*filter(None, self.among)], str(value))
        raise ConfigurationError(expected, value=value, **place)

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
    made = Parameter(
        "", None if default is MISSING else default, unit, low, high, meaning, among=choices,
        usual=usual, optional=default is not MISSING or factory is not MISSING,
    )
    result: Any = field(default=default, default_factory=factory, metadata={"entry": made})
    return result


@functools.cache  # a district creates thousands of sites
def parameters_of(kind: Any) -> tuple[Parameter, ...]:
    """Return the keys of a dataclass, that is, the fields that were created with `entry`.

    The default of a required key is None.
    """
    hints = get_type_hints(kind)
    return tuple(
        replace(attribute.metadata["entry"], name=attribute.name, kind=hints[attribute.name])
        for attribute in fields(kind) if "entry" in attribute.metadata
    )


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
        for key, expected in mistakes(record, content):
            place = find(content, key)[1]
            value = None if isinstance(place, (list, YamlMapping)) else place
            raise ConfigurationError(expected, key=key, value=value)
    except ConfigurationError as error:
        line = find(content, error.key or "")[0] or min(content.lines.values(), default=None)
        raise ConfigurationError(
            error.expected, file=file, line=line, key=error.key, value=error.value
        ) from None
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
    return cast(Record, _record(kind, values, ""))


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


def _record(kind: Any, value: Any, key: str) -> Any:
    place = f"{key}." if key else ""
    given, known = _mapping(value, key), {each.name: each for each in parameters_of(kind)}
    for name in given:
        if name not in known:
            wrong = f"is not a valid key; {suggest_names(name, known)}"
            raise ConfigurationError(wrong, key=place + name, value=given[name])
    made = {}
    for name, entry in known.items():
        if name in given:
            made[name] = _value(entry.kind, given[name], entry, place + name)
        elif not entry.optional:
            raise ConfigurationError(f"is missing: {entry.description}", key=place + name)
    return kind(**made)


def _mapping(value: Any, key: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigurationError("must contain 'key: value' lines", key=key, value=value)
    return value


def _value(kind: Any, value: Any, entry: Parameter, key: str) -> Any:
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
        return _value(kinds[0], value, entry, key)
    if is_dataclass(kind):
        return _record(kind, value, key)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigurationError(f"must be a list ({entry.meaning})", key=key, value=value)
        return tuple(
            _value(inner[0], item, entry, f"{key}.{number}")
            for number, item in enumerate(value, start=1)
        )
    if origin is dict:
        made = {}
        for name, item in _mapping(value, key).items():
            own = f"{key}.{name}"  # files.read_yaml returns keys as text
            number = name if inner[0] is str else _scalar(inner[0], parse_plain(name), entry, own)
            made[number] = _value(inner[1], item, entry, own)
        return made
    return _scalar(kind, value, entry, key)


def _scalar(kind: Any, value: Any, entry: Parameter, key: str) -> Any:
    if kind is bool:
        if not isinstance(value, bool):
            raise ConfigurationError("must be true or false", key=key, value=value)
        return value
    if kind is str:
        if entry.among:
            return entry.read(value, key=key)
        if not isinstance(value, str) or not value.strip():
            raise ConfigurationError(f"must be text ({entry.meaning})", key=key, value=value)
        return " ".join(value.split())
    allowed = replace(entry.range, whole=kind is int)
    return allowed.read(value, key=key, about=f" ({entry.meaning})")


def replace_infinity(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Replace infinity with None, because JSON has no infinity; null then means no limit."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in parameters.items()
    }


# --- ROS 2 parameter files ------------------------------------------------------------------------
# The name of a section has one of the forms that people and ``ros2 param dump`` write: ``/**``,
# ``node``, ``/node``, ``/namespace/node``, or a namespace that contains nodes. The names of grouped
# parameters contain dots.

_SECTION = "ros__parameters"


@dataclass(frozen=True)
class ParameterSection:
    """A section of a ROS 2 parameter file, with parameters of one or more nodes.

    Attributes:
        name: name or pattern of the nodes as written in the file, such as ``/**/onoff``.
        line: line of the section in the file.
        values: values of the parameters, keyed by name, with their lines.
    """

    name: str
    line: int
    values: YamlMapping

    def applies_to(self, node: str) -> bool:
        """Return True if the section applies to a node, such as ``/site1/onoff``."""
        pattern = re.escape(f"/{self.name.removeprefix('/')}")
        # As in rcl: ** matches any number of names, * matches one.
        pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
        return re.fullmatch(pattern, node) is not None


def read_sections(file: Path) -> list[ParameterSection]:
    """Return the sections of a parameter file; the last section that applies to a node wins.

    Raises:
        ConfigurationError: if the file is not a ROS 2 parameter file, or if a part of it has no
            effect.
    """
    return list(_sections(file, read_yaml(file), "", 1))


def _sections(
    file: Path, content: YamlMapping, section: str, line: int
) -> Iterator[ParameterSection]:
    for name, part in content.items():
        if not isinstance(part, YamlMapping):
            raise ConfigurationError(
                f"has no effect at this level: write /**/NODE: {{{_SECTION}: {{NAME: VALUE}}}}",
                file=file, line=content.lines[name], value=part,
                key=f"{section}: {name}" if section else name,
            )
        if name == _SECTION:
            values = YamlMapping()
            _flatten(part, "", values)
            yield ParameterSection(section, line, values)
        else:
            nested = f"{section}/{name}" if section else name
            yield from _sections(file, part, nested, content.lines[name])


def _flatten(part: YamlMapping, group: str, values: YamlMapping) -> None:
    for key, value in part.items():
        name = f"{group}{key}"
        if isinstance(value, YamlMapping):
            _flatten(value, f"{name}.", values)
        else:
            values[name], values.lines[name] = value, part.lines[key]
