"""What a parameter file may say to the nodes that bringup starts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping, read_yaml
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.registry import OF_EVERY_NODE, ControllerChoice
from greenroof_ros.graph.parameters import (
    LIVE,
    default_site,
    site_file,
)

_SECTION = "ros__parameters"


def refuse_unknown_in(
    file: Path, nodes: Mapping[str, str], controller: ControllerChoice
) -> None:
    """Refuse what no node of a graph would take from a parameter file.

    rclpy ignores it, so that a mistyped limit would have no effect, and nobody be told. Of a
    section for several nodes each name must be known to one of them.

    Args:
        file: a ROS 2 parameter file.
        nodes: of each node's name, with its namespace, the module.
        controller: of the graph.

    Raises:
        ConfigurationError: there is such a name or section, or one without ``ros__parameters``.
    """
    known = {
        name: {one.name for one in _parameters(module, controller)}
        for name, module in nodes.items()
    }
    _look(file, read_yaml(file), "", 1, known)


def _parameters(module: str, controller: ControllerChoice) -> list[Parameter]:
    """Return what the node of a module declares."""
    try:
        node = import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"{module} needs {error.name}: pip install 'greenroof_ros[pump]'"
        ) from error
    match module.rpartition(".")[2]:
        case "plant":
            return [site_file(), *node.parameters(default_site())]
        case "pump" | "weather":
            return [LIVE, site_file(), *node.parameters(default_site())]
        case "controller":
            own = controller.kind.parameters
            return [LIVE, site_file(), *own, *node.LIVE_PARAMETERS]
    return list(node.PARAMETERS)


def _look(
    file: Path, content: YamlMapping, section: str, line: int, known: Mapping[str, set[str]]
) -> None:
    """Look at a part of the file.

    Args:
        file: for the message.
        content: of the part.
        section: name of the nodes that it is for, as far as that is read.
        line: where that stands.
        known: of each node's name the names of its parameters.
    """
    for name, part in content.items():
        if name == _SECTION:
            _look_at_section(file, part, section, line, known)
        elif isinstance(part, YamlMapping) and part:
            whole = f"{section}/{name}" if section else name
            _look(file, part, whole, content.lines[name], known)
        else:
            raise ConfigurationError(
                f"has no effect here: write /**/NODE: {{{_SECTION}: {{NAME: VALUE}}}}",
                file=file, line=content.lines[name], value=part,
                key=f"{section}: {name}" if section else name,
            )


def _look_at_section(
    file: Path, content: object, section: str, line: int, known: Mapping[str, set[str]]
) -> None:
    pattern = re.escape(f"/{section.removeprefix('/')}")
    # As rcl reads it: two stars are any number of names, one is one.
    pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
    here = [names for node, names in known.items() if re.fullmatch(pattern, node)]
    if not here:
        last = [node.rpartition("/")[2] for node in known]
        (closest,) = get_close_matches(section.rpartition("/")[2], last, 1, 0.0)
        raise ConfigurationError(
            f"bringup starts no such node; the closest is /**/{closest}; it starts "
            f"{', '.join(sorted(known))}",
            file=file, line=line, key=section or _SECTION,
        )
    if not isinstance(content, YamlMapping):
        raise ConfigurationError(
            "must hold parameters, NAME: VALUE", file=file, line=line,
            key=f"{section}: {_SECTION}", value=content,
        )
    names = set().union(*here)
    for name, value in content.items():
        if name in names or name.partition(".")[0] in OF_EVERY_NODE:
            continue
        (closest,) = get_close_matches(name, sorted(names), 1, 0.0)
        raise ConfigurationError(
            f"there is no such parameter; the closest is {closest}; --help of the node lists all",
            file=file, line=content.lines[name], key=f"{section}: {name}", value=value,
        )
