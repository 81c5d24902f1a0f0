"""The sections of a ROS 2 parameter file, and the nodes that each applies to under rcl's rules.

These are the forms that people and ``ros2 param dump`` write: ``/**``, ``node``, ``/node``,
``/namespace/node``, or a namespace that holds nodes; grouped parameters have dots in their names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping, read_ros_parameters

_SECTION = "ros__parameters"


@dataclass(frozen=True)
class ParameterSection:
    """Parameters of one or several nodes.

    Attributes:
        name: the nodes, such as ``/**/onoff``, as written in the file.
        line: line of the section in the file.
        values: values by parameter name.
        lines: lines of the values in the file.
    """

    name: str
    line: int
    values: Mapping[str, Any]
    lines: Mapping[str, int]

    def applies_to(self, node: str) -> bool:
        """Whether it applies to a node, named with its namespace, such as ``/site1/onoff``."""
        pattern = re.escape(f"/{self.name.removeprefix('/')}")
        # As in rcl: ** matches any number of names, * matches one.
        pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
        return re.fullmatch(pattern, node) is not None


def read_sections(file: Path) -> list[ParameterSection]:
    """Return the sections of a parameter file; if several apply to a node, the last one wins.

    Raises:
        ConfigurationError: if it is not such a file, rcl would reject it, or a part has no effect.
    """
    return list(_sections(file, read_ros_parameters(file), "", 1))


def _sections(
    file: Path, content: YamlMapping, section: str, line: int
) -> Iterator[ParameterSection]:
    for name, part in content.items():
        if name == _SECTION:
            if not isinstance(part, YamlMapping):
                raise ConfigurationError(
                    "must hold parameters, NAME: VALUE", file=file, line=line,
                    key=f"{section}: {_SECTION}", value=part,
                )
            values, lines = dict[str, Any](), dict[str, int]()
            _flatten(part, "", values, lines)
            yield ParameterSection(section, line, values, lines)
        elif isinstance(part, YamlMapping) and part:
            nested = f"{section}/{name}" if section else name
            yield from _sections(file, part, nested, content.lines[name])
        else:
            raise ConfigurationError(
                f"has no effect here: write /**/NODE: {{{_SECTION}: {{NAME: VALUE}}}}",
                file=file, line=content.lines[name], value=None if part == "" else part,
                key=f"{section}: {name}" if section else name,
            )


def _flatten(
    part: YamlMapping, group: str, values: dict[str, Any], lines: dict[str, int]
) -> None:
    for key, value in part.items():
        name = f"{group}{key}"
        if isinstance(value, YamlMapping):
            _flatten(value, f"{name}.", values, lines)
        else:
            values[name], lines[name] = value, part.lines[key]
