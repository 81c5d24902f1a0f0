"""Parameters of nodes: their declaration with description and range, and checks of their values.

rclpy silently ignores a parameter that a node has not declared, so a limit with a mistyped name
would have no effect. This module rejects undeclared parameters on a node's command line
and before any node starts, in the user's parameter file for bringup.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from greenroof_ros.base.command_line import refuse
from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.parameter import OF_EVERY_NODE, Parameter, read_sections
from greenroof_ros.site.horizon import MAX_HORIZON

_LONG = 2**62  # beyond any number that a node uses


def site_file() -> Parameter:
    """Return the parameter for the site file, which is the same for all nodes of a run."""
    return Parameter(
        "site_file", str(default_site_file()), meaning="path of the site file",
    )


def look_ahead_parameters() -> list[Parameter]:
    """Return the parameters of a weather node that determine the extent of its forecasts."""
    return [
        Parameter(
            "horizon", 0.0, "", 0.0, MAX_HORIZON, "length of the forecasts (h), in growing "
            "steps; 0 for forecasts of the next M ticks",
        ),
        Parameter(
            "outlet_horizon", 0.0, "", 0.0, MAX_HORIZON, "length of the forecasts for planning "
            "the outlet valve (h); 0 if it is not planned",
        ),
        Parameter(
            "all_members", False, meaning="whether all members of an ensemble are published, for "
            "lookahead, or only the first",
        ),
    ]


# --- declared by a node -----------------------------------------------------------------------


def declare(node: Node, parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Declare those parameters that are not declared yet, and return the values of all of them.

    An integer such as ``weight: 5`` is accepted for a double in a file and on the command line,
    although rclpy itself would reject the integer.

    Raises:
        ConfigurationError: if a value has the wrong type, is outside its range, or is not one of
            its choices.
    """
    return {parameter.name: _declare(node, parameter) for parameter in parameters}


def _declare(node: Node, parameter: Parameter) -> Any:
    name = parameter.name
    if node.has_parameter(name):
        return node.get_parameter(name).value
    # At first of any type, so that a wrong value is rejected in our words, not in rclpy's.
    anything = ParameterDescriptor(dynamic_typing=True)
    given = node.declare_parameter(name, parameter.default, anything).value
    node.undeclare_parameter(name)
    try:
        value = check_value(parameter, given)
    except ValueError as error:
        key = f"parameter {name} of {node.get_name()}"
        raise ConfigurationError(str(error), key=key, value=given) from None
    descriptor = _describe(parameter)
    return node.declare_parameter(name, value, descriptor, ignore_override=True).value


def _describe(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=parameter.description, read_only=not parameter.may_change,
        additional_constraints=f"must be {parameter.limits}" if parameter.among else "",
    )
    low, high = parameter.low, parameter.high
    if type(parameter.default) is int:
        low, high = (int(min(max(end, -_LONG), _LONG)) for end in (low, high))
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    elif isinstance(parameter.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor


# --- unknown parameters -----------------------------------------------------------------------


def refuse_unknown(node: Node, arguments: Sequence[str]) -> None:
    """Reject every parameter on the command line that the node has not declared.

    In a parameter file, only the sections whose names end with the node's name are checked; other
    sections are for more than one node.

    Args:
        node: the node, after it has declared all its parameters.
        arguments: command line of the process.

    Raises:
        ConfigurationError: if the node has not declared a parameter.
    """
    own, known = node.get_name(), node.get_parameters_by_prefix("")

    def refuse(name: str, value: object, **place: Any) -> None:
        if name not in known and not name.startswith("qos_overrides."):
            wrong = f"there is no such parameter; {suggest_names(name, known)}"
            key = f"parameter {name} of {own}"
            raise ConfigurationError(wrong, key=key, value=value, **place)

    for option, text in pairwise(arguments):
        if option in ("-p", "--param"):
            qualified, _, value = text.partition(":=")
            of, _, name = qualified.rpartition(":")
            if of in ("", own):
                refuse(name, value)
        elif option == "--params-file":
            for section in read_sections(Path(text)):
                is_own = section.name.rpartition("/")[2] == own
                if is_own and section.applies_to(node.get_fully_qualified_name()):
                    for name, value in section.values.items():
                        refuse(name, value, file=text, line=section.values.lines[name])


_TEXTS = {bool: "true or false", str: "text", list: "a list of strings"}
# Parameters that bringup sets from its options, besides those of the controller.
_SET_BY_BRINGUP = {
    "site_file", "state_file", "drive", "address", "broker_login", "broker_authority", "directory",
    "expected",
}


def node_parameter_files(
    arguments: argparse.Namespace, described: Callable[[], Mapping[str, Iterable[Parameter]]],
    given: Mapping[str, float],
) -> list[Path]:
    """Return a list with the file given by ``--node-parameters``; empty if none is given.

    In a section for more than one node, every parameter must be known to at least one of the nodes.

    Args:
        arguments: the parsed command line.
        described: function that returns the parameters of every node that bringup runs, by the
            node's name; it is called only if there is a file.
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
        f"{arguments.namespace}/{name}": {parameter.name: parameter for parameter in parameters}
        for name, parameters in described().items()
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
