"""The user's ROS 2 parameter file for the nodes of a graph, checked before any node starts.

rclpy silently ignores a parameter that a node has not declared, so a mistyped limit would have no
effect. Here it is refused.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path

from greenroof_ros.common.command_line import refuse
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping, default_site_file, read_ros_parameters
from greenroof_ros.common.parameter import find_closest, suggest_parameter
from greenroof_ros.controllers.registry import OF_EVERY_NODE, ControllerChoice
from greenroof_ros.model.site import read_site

_SECTION = "ros__parameters"
# Parameters that only bringup sets, by node, each with its option of bringup.
_OF_BRINGUP = {
    "pump": {
        "drive": "--drive",
        "address": "--drive-at",
        "broker_login": "--broker-login",
        "broker_authority": "--broker-authority",
        "state_file": "--state",
    },
    "plant": {"speed": "--speed", "pump": "--pump"},
}


def node_parameter_files(
    arguments: argparse.Namespace, modules: Mapping[str, str], controller: ControllerChoice
) -> list[Path]:
    """Return the file given by ``--node-parameters``, in a list; an empty list if there is none.

    Args:
        arguments: the command line.
        modules: the module of each node that bringup runs, by the node's name.
        controller: the graph's controller.

    Raises:
        ConfigurationError: the file does not exist or sets something without effect; it sets the
            drive (bringup would then stop the wrong one), its state file or the plant's speed.
    """
    file: Path | None = arguments.node_parameters
    if file is None:
        return []
    refuse((not file.is_file(), "--node-parameters", str(file), "must be an existing file"))
    named = {f"{arguments.namespace}/{name}": module for name, module in modules.items()}
    _refuse_unknown(file, named, controller)
    return [file]


def _refuse_unknown(file: Path, nodes: Mapping[str, str], controller: ControllerChoice) -> None:
    """Refuse parameters in a file that no node of the graph has, or that only bringup may set.

    In a section for several nodes, each name must be known to one of them.

    Args:
        file: a ROS 2 parameter file.
        nodes: each node's module, by the node's name with its namespace.
        controller: the graph's controller.

    Raises:
        ConfigurationError: there is such a parameter, a section for no node of the graph, or one in
            which ``ros__parameters`` is missing or not a mapping.
    """
    known = {name: _names_of(module, controller) for name, module in nodes.items()}
    for section, line, content in _sections(file, read_ros_parameters(file)):
        pattern = re.escape(f"/{section.removeprefix('/')}")
        # As in rcl: ** matches any number of names, * matches one.
        pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
        matching = [node for node in known if re.fullmatch(pattern, node)]
        last = [node.rpartition("/")[2] for node in matching or known]
        if not matching:
            raise ConfigurationError(
                "bringup starts no such node; the closest is "
                f"/**/{find_closest(section.rpartition('/')[2], last)}; it starts "
                f"{', '.join(sorted(known))}", file=file, line=line, key=section or _SECTION,
            )
        if not isinstance(content, YamlMapping):
            raise ConfigurationError(
                "must hold parameters, NAME: VALUE", file=file, line=line,
                key=f"{section}: {_SECTION}", value=content,
            )
        names = set().union(*(known[node] for node in matching))
        for name, value in content.items():
            for node in last:
                if name in _OF_BRINGUP.get(node, ()):
                    raise ConfigurationError(
                        f"must not be given to the node {node} here: under bringup "
                        f"{_OF_BRINGUP[node][name]} sets it", file=file, line=content.lines[name],
                        key=f"{section}: {name}", value=value,
                    )
            if name not in names and name.partition(".")[0] not in OF_EVERY_NODE:
                raise ConfigurationError(
                    f"{suggest_parameter(name, sorted(names))}; --help of the node lists all",
                    file=file, line=content.lines[name], key=f"{section}: {name}", value=value,
                )


def _sections(
    file: Path, content: YamlMapping, section: str = "", line: int = 1
) -> Iterator[tuple[str, int, object]]:
    """Yield each group of parameters in a file: its section, line and content."""
    for name, part in content.items():
        nested = f"{section}/{name}" if section else name
        if name == _SECTION:
            yield section, line, part
        elif isinstance(part, YamlMapping) and part:
            yield from _sections(file, part, nested, content.lines[name])
        else:
            raise ConfigurationError(
                f"has no effect here: write /**/NODE: {{{_SECTION}: {{NAME: VALUE}}}}",
                file=file, line=content.lines[name], value=None if part == "" else part,
                key=f"{section}: {name}" if section else name,
            )


def _names_of(module: str, controller: ControllerChoice) -> set[str]:
    site = read_site(default_site_file())
    of = controller if module.endswith(".controller") else site
    return {parameter.name for parameter in import_module(module).parameters(of)}
