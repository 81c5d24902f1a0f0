"""Check of the user's ROS 2 parameter file for the nodes of a graph, before any node starts.

rclpy silently ignores a parameter that a node has not declared, so a limit with a mistyped name
would have no effect. This module rejects undeclared parameters.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from greenroof_ros.base.command_line import refuse
from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.parameter import Parameter, read_sections
from greenroof_ros.controllers.registry import OF_EVERY_NODE, ControllerChoice
from greenroof_ros.site.file import read_site

_TEXTS = {bool: "true or false", str: "text", list: "a list of strings"}
# Parameters that bringup sets from its options, besides those of the controller.
_SET_BY_BRINGUP = {
    "site_file", "state_file", "drive", "address", "broker_login", "broker_authority", "directory",
    "expected",
}


def node_parameter_files(
    arguments: argparse.Namespace, modules: Mapping[str, str], controller: ControllerChoice,
    given: Mapping[str, float],
) -> list[Path]:
    """Return a list with the file given by ``--node-parameters``; empty if none is given.

    In a section for more than one node, every parameter must be known to at least one of the nodes.

    Args:
        arguments: the parsed command line.
        modules: module of every node that bringup runs, by the node's name.
        controller: the graph's controller.
        given: values of the controller's parameters, by name.

    Raises:
        ConfigurationError: if the file does not exist, contains a wrong value, applies to no node,
            or sets a parameter that no node has or that an option of bringup sets. Otherwise
            bringup might stop the wrong drive, or a summary might be wrong.
    """
    file: Path | None = arguments.node_parameters
    if file is None:
        return []
    refuse((not file.is_file(), "--node-parameters", str(file), "must be an existing file"))
    nodes = {
        f"{arguments.namespace}/{name}": _parameters_of(module, controller, arguments.site)
        for name, module in modules.items()
    }
    for section in read_sections(file):
        known = [parameters for node, parameters in nodes.items() if section.applies_to(node)]
        if not known:
            raise ConfigurationError(
                f"applies to no node that bringup starts: {', '.join(sorted(nodes))}",
                file=file, line=section.line, key=section.name,
            )
        for name, value in section.values.items():
            try:
                _check(name, value, known, given)
            except ValueError as error:
                raise ConfigurationError(
                    str(error), file=file, line=section.values.lines[name],
                    key=f"{section.name}: {name}", value=value,
                ) from None
    return [file]


def _check(
    name: str, value: Any, known: Sequence[Mapping[str, Parameter]], given: Mapping[str, float]
) -> None:
    matching = [parameters[name] for parameters in known if name in parameters]
    if not matching and name.partition(".")[0] not in OF_EVERY_NODE:
        names = sorted({name for parameters in known for name in parameters})
        raise ValueError(f"there is no such parameter; {suggest_names(name, names)}")
    if name in _SET_BY_BRINGUP or given.get(name, value) != value:
        raise ValueError("must not be set in this file, since an option sets it")
    for parameter in matching:
        check_value(parameter, value)


def find_value(files: Iterable[Path], node: str, parameter: Parameter) -> Any:
    """Return the value of a node's parameter from parameter files, or else its default."""
    value = parameter.default
    for section in (section for file in files for section in read_sections(file)):
        if section.applies_to(node):
            value = section.values.get(parameter.name, value)
    return value


def _parameters_of(module: str, controller: ControllerChoice, site: Path) -> dict[str, Parameter]:
    of = controller if module.endswith(".controller") else read_site(site)
    return {parameter.name: parameter for parameter in import_module(module).parameters(of)}


def check_value(parameter: Parameter, value: Any) -> Any:
    """Check a value of a parameter, and return it converted to the parameter's type.

    Raises:
        ValueError: if the value is invalid; the message states the valid values.
    """
    kind = type(parameter.default)
    if kind in (int, float):
        return parameter.range.check(value)
    texts = type(value) is not list or all(type(item) is str for item in value)
    if type(value) is kind and texts and (value in parameter.among or not parameter.among):
        return value
    raise ValueError(f"must be {parameter.limits or _TEXTS[kind]}")
