"""Sections of a ROS 2 parameter file, and the nodes to which each section applies in rcl.

The name of a section has one of the forms that people and ``ros2 param dump`` write: ``/**``,
``node``, ``/node``, ``/namespace/node``, or a namespace that contains nodes. The names of grouped
parameters contain dots.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import YamlMapping, read_yaml

_SECTION = "ros__parameters"


@dataclass(frozen=True)
class ParameterSection:
    """A section with parameters of one or more nodes.

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
