"""Check of the user's ROS 2 parameter file for the nodes of a graph, before any node starts.

rclpy silently ignores a parameter that a node has not declared, so a limit with a mistyped name
would have no effect. This module rejects undeclared parameters.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from greenroof_ros.base.command_line import refuse
from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.parameter_sections import read_sections
from greenroof_ros.controllers.registry import OF_EVERY_NODE, ControllerChoice
from greenroof_ros.site.file import read_site

_TEXTS = {bool: "true or false", str: "text", list: "a list of strings"}
# Parameters that only bringup sets, by node, each with the option of bringup that sets it.
_SET_BY_BRINGUP = {
    "pump": {
        "drive": "--drive",
        "address": "--drive-at",
        "broker_login": "--broker-login",
        "broker_authority": "--broker-authority",
        "state_file": "--state",
    },
    "plant": {"speed": "--speed", "pump": "--pump"},
    "alarms": {"directory": "--state", "expected": "greenroof live"},
}


def node_parameter_files(
    arguments: argparse.Namespace, modules: Mapping[str, str], controller: ControllerChoice,
    given: Mapping[str, float],
) -> list[Path]:
    """Return a list with the file given by ``--node-parameters``; empty if none is given.

    Args:
        arguments: the parsed command line.
        modules: module of every node that bringup runs, by the node's name.
        controller: the graph's controller.
        given: values of the controller's parameters, by name.

    Raises:
        ConfigurationError: if the file does not exist, contains a wrong value, or sets a parameter
            that no node has or that an option of bringup sets. Otherwise bringup might stop the
            wrong drive, or a summary might be wrong.
    """
    file: Path | None = arguments.node_parameters
    if file is None:
        return []
    refuse((not file.is_file(), "--node-parameters", str(file), "must be an existing file"))
    named = {f"{arguments.namespace}/{name}": module for name, module in modules.items()}
    _refuse_wrong(file, named, controller, given)
    return [file]


def find_value(files: Iterable[Path], node: str, parameter: Parameter) -> Any:
    """Return the value of a node's parameter from parameter files, or else its default."""
    value = parameter.default
    for section in (section for file in files for section in read_sections(file)):
        if section.applies_to(node):
            value = section.values.get(parameter.name, value)
    return value


def _refuse_wrong(
    file: Path, nodes: Mapping[str, str], controller: ControllerChoice, given: Mapping[str, float]
) -> None:
    """Reject a file with parameters that no node has or that only bringup may set, or wrong values.

    In a section for more than one node, every parameter must be known to at least one of the nodes.

    Args:
        file: a ROS 2 parameter file.
        nodes: module of every node, keyed by the node's name, including its namespace.
        controller: the graph's controller.
        given: values of the controller's parameters, by name.

    Raises:
        ConfigurationError: if the file contains a parameter or a value to reject, a section that
            applies to no node of the graph, or a section in which ``ros__parameters`` is missing or
            is not a mapping.
    """
    known = {name: _parameters_of(module, controller) for name, module in nodes.items()}
    for section in read_sections(file):
        matching = {node: known[node] for node in filter(section.applies_to, known)}
        if not matching:
            raise ConfigurationError(
                f"applies to no node that bringup starts: {', '.join(sorted(known))}",
                file=file, line=section.line, key=section.name,
            )
        names = sorted(set().union(*matching.values()))
        for name, value in section.values.items():
            try:
                if name not in names and name.partition(".")[0] not in OF_EVERY_NODE:
                    raise ValueError(f"there is no such parameter; {suggest_names(name, names)}")
                for node, parameters in matching.items():
                    if name in parameters:
                        _refuse_option(node.rpartition("/")[2], nodes[node], name, value, given)
                        check_value(parameters[name], value)
            except ValueError as error:
                raise ConfigurationError(
                    str(error), file=file, line=section.values.lines[name],
                    key=f"{section.name}: {name}", value=value,
                ) from None


def _refuse_option(
    node: str, module: str, name: str, value: object, given: Mapping[str, float]
) -> None:
    """Reject a parameter of a node that an option of bringup sets to another value."""
    if name in given:
        option = "" if given[name] == value else f"--{name.replace('_', '-')}"
    else:
        simulated = module.startswith("greenroof_ros.nodes.")
        usual = "an option of greenroof run" if simulated else ""
        option = _SET_BY_BRINGUP.get(node, {}).get(name, usual)
    if option:
        raise ValueError(
            f"must not be set for the node {node} in this file: under bringup, {option} sets it"
        )


def _parameters_of(module: str, controller: ControllerChoice) -> dict[str, Parameter]:
    site = read_site(default_site_file())
    of = controller if module.endswith(".controller") else site
    return {parameter.name: parameter for parameter in import_module(module).parameters(of)}


def check_value(parameter: Parameter, value: Any) -> Any:
    """Check a value of a parameter, and return it converted to the parameter's type.

    Raises:
        ValueError: if the value is invalid; the message states the valid values.
    """
    kind = type(parameter.default)
    if kind in (int, float):
        return parameter.range.check(value)
    texts = type(value) is not list or (value and {*map(type, value)} == {str})
    if type(value) is kind and texts and (value in parameter.among or not parameter.among):
        return value
    raise ValueError(f"must be {parameter.limits or _TEXTS[kind]}")
