"""Node parameters: declared with description and range, refused in one clear line."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.site import Site, read_site

_KINDS = {
    float: "a number such as 1.0",
    int: "a whole number",
    bool: "true or false",
    str: "a text",
    list: "a list of texts",
}


def declare(
    node: Node,
    name: str,
    default: str | float | int | bool | list[str],
    description: str,
    low: float | None = None,
    high: float | None = None,
    *,
    among: tuple[str, ...] = (),
    read_only: bool = True,
) -> Any:
    """Declare a parameter with its description and range, and return its value.

    Raises:
        ConfigurationError: the value given on the command line or in a file is of the wrong type
            or out of range.
    """
    kind = _KINDS[type(default)]
    expected = f"must be {kind}"
    descriptor = ParameterDescriptor(description=description, read_only=read_only)
    if low is not None and high is not None:
        expected += f" from {low:g} to {high:g}"
        if isinstance(default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    if among:
        expected = f"must be {' or '.join(among)}"
        descriptor.additional_constraints = expected
    key = f"parameter {name} of {node.get_name()}"
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        raise ConfigurationError(f"{expected} ({error})", key=key) from error
    if among and value not in among:
        raise ConfigurationError(expected, key=key, value=value)
    return value


def declare_table(node: Node, table: Iterable[Parameter]) -> dict[str, float]:
    """Declare the parameters of a controller, and return their values by name.

    Raises:
        ConfigurationError: a value is of the wrong type or out of range.
    """
    return {
        one.name: declare(
            node, one.name, one.default, f"{one.meaning} ({one.unit})", one.low, one.high,
            read_only=not one.may_change,
        )
        for one in table
    }


def declare_site(node: Node) -> Site:
    """Declare the parameter ``site_file``, the same for every node of a run, and read the site.

    Raises:
        ConfigurationError: the file, or a value in it, is wrong.
    """
    default = str(shared_directory() / "config" / "site.yaml")
    return read_site(Path(declare(node, "site_file", default, "the parameters of Table I")))
