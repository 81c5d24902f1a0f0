"""Node parameters: described once, declared with description and range, refused in one line."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.site import Site, read_site

# Of each Python type: what ROS 2 calls it, and what a value must be, for messages.
_KINDS = {
    float: ("double", "a number such as 1.0"),
    int: ("integer", "a whole number"),
    bool: ("bool", "true or false"),
    str: ("string", "a text"),
    list: ("string array", "a list of texts"),
}


def type_name(one: Parameter) -> str:
    """Return what ROS 2 calls a parameter's type."""
    return _KINDS[type(one.default)][0]


def _expected(one: Parameter) -> str:
    """Return what a value must be, for messages."""
    if one.among:
        return f"must be {one.limits}"
    return f"must be {_KINDS[type(one.default)][1]}{one.limits and ' from '}{one.limits}"


def _descriptor(one: Parameter) -> ParameterDescriptor:
    """Return what a ROS tool shows of a parameter."""
    descriptor = ParameterDescriptor(
        description=one.description, read_only=not one.may_change,
        additional_constraints=_expected(one) if one.among else "",
    )
    if math.isinf(one.low):
        return descriptor
    if isinstance(one.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(one.low), to_value=float(one.high))
        ]
    else:
        descriptor.integer_range = [
            IntegerRange(from_value=int(one.low), to_value=int(one.high))
        ]
    return descriptor


LIVE = Parameter(
    "live", False, meaning="act on steady time, as on a site with sensors; otherwise in lockstep, "
    "as in a simulation",
)


def site_file() -> Parameter:
    """Return the parameter that every node has but the recorder, the same in a run."""
    default = str(shared_directory() / "config" / "site.yaml")
    return Parameter("site_file", default, meaning="the parameters of Table I")


def declare(node: Node, parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Declare parameters, and return their values by name.

    A whole number does for a double, as in ``weight: 5``, in a file, on the command line and in
    ``ros2 param set``; rclpy alone refuses it.

    Raises:
        ConfigurationError: a value given on the command line or in a file is of the wrong type or
            out of range.
    """
    declared = list(parameters)
    doubles = {one.name for one in declared if isinstance(one.default, float) and one.may_change}
    if doubles:
        node.add_pre_set_parameters_callback(lambda given: [
            RosParameter(one.name, value=float(one.value))
            if one.name in doubles and one.type_ is RosParameter.Type.INTEGER else one
            for one in given
        ])
    return {one.name: _declare(node, one) for one in declared}


def _declare(node: Node, one: Parameter) -> Any:
    key = f"parameter {one.name} of {node.get_name()}"
    try:
        value = _declare_as_given(node, one)
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        raise ConfigurationError(f"{_expected(one)} ({error})", key=key) from error
    if one.among and value not in one.among:
        raise ConfigurationError(_expected(one), key=key, value=value)
    return value


def _declare_as_given(node: Node, one: Parameter) -> Any:
    """Declare it with the value that is given; a whole number becomes a double where one is due."""
    try:
        return node.declare_parameter(one.name, one.default, _descriptor(one)).value
    except InvalidParameterTypeException:
        if not isinstance(one.default, float):
            raise
        anything = ParameterDescriptor(dynamic_typing=True)
        given = node.declare_parameter(one.name, one.default, anything).value
        node.undeclare_parameter(one.name)
        if type(given) is not int:
            raise
    return node.declare_parameter(
        one.name, float(given), _descriptor(one), ignore_override=True
    ).value


def refuse_unknown(node: Node, arguments: Sequence[str]) -> None:
    """Refuse a parameter of a command line that a node has not declared.

    rclpy ignores it, so that a mistyped limit would have no effect, and nobody be told. Those of a
    parameter file are left: a section of it may be for several nodes.

    Args:
        node: that has declared all it has.
        arguments: of the process.

    Raises:
        ConfigurationError: there is one.
    """
    for option, assignment in pairwise(arguments):
        whole, _, value = assignment.partition(":=")
        of, _, name = whole.rpartition(":")
        ours = of in ("", node.get_name()) and not name.startswith("qos_overrides.")
        if option not in ("-p", "--param") or not ours or node.has_parameter(name):
            continue
        (closest,) = get_close_matches(name, node.get_parameters_by_prefix(""), 1, 0.0)
        raise ConfigurationError(
            f"there is no such parameter; the closest is {closest}; --help lists all",
            key=f"parameter {name} of {node.get_name()}", value=value,
        )


def default_site() -> Site:
    """Return the site of a node that is given no ``site_file``."""
    return read_site(Path(str(site_file().default)))
