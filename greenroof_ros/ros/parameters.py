"""Parameters of nodes: their declaration with description and range, and checks of their values.

rclpy silently ignores a parameter that a node has not declared, so a limit with a mistyped name
would have no effect. This module rejects undeclared parameters on a node's command line;
:mod:`greenroof_ros.ros.parameter_file` rejects them in the parameter file for bringup.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.parameter import Parameter, read_sections
from greenroof_ros.ros.parameter_file import check_value
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
