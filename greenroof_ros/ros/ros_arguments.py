"""What the ROS arguments of ``greenroof run`` mean for the run, according to rclpy.

The nodes of the run get the ROS arguments as they are. The namespace and the parameters of the
controller become options of the run as well, because the run itself needs them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.registry import OF_EVERY_NODE, ControllerChoice
from greenroof_ros.ros.domain import join, require_ros, ros_arguments


@contextmanager
def _name_option() -> Iterator[None]:
    """Turn rcl's error about ROS arguments into a ConfigurationError."""
    try:
        yield
    except RuntimeError as error:
        raise ConfigurationError(" ".join(str(error).split()), key="--ros-args") from error


def remove_ros_arguments(words: Sequence[str]) -> list[str]:
    """Return the words of a command line that are not ROS arguments.

    Raises:
        ConfigurationError: if rcl cannot parse the ROS arguments, or if ROS 2 is not installed.
    """
    with require_ros():
        from rclpy.utilities import remove_ros_args
    with _name_option():
        return remove_ros_args(["greenroof", *words])[1:]


def find_options(
    words: Sequence[str], namespace: str, nodes: Collection[str], controller: ControllerChoice
) -> list[str]:
    """Return the options of a run that have the same meaning as its ROS arguments.

    Args:
        words: the command line.
        namespace: namespace by the run's own option; empty for none.
        nodes: names of the nodes of the run.
        controller: the controller of the run.

    Raises:
        ConfigurationError: if a ROS argument would rename a node, move a single node, or set a
            parameter that only options may set.
    """
    with _name_option():
        context = join(ros_arguments([], namespace, words))
    from rclpy.node import Node

    options = list[str]()
    try:
        for name in (controller.name, *sorted({*nodes} - {controller.name})):
            node = Node(
                name, context=context, start_parameter_services=False, enable_rosout=False,
                automatically_declare_parameters_from_overrides=True,
            )
            if not options:
                place = node.get_namespace()
                options.append(f"--namespace={place}")
            if (node.get_namespace(), node.get_name()) != (place, name):
                raise ConfigurationError(
                    "must not rename or move a node of a run, because the other nodes know it by "
                    "its name; __ns:=/NAME moves all nodes", key="--ros-args",
                    value=f"{name} becomes {node.get_fully_qualified_name()}",
                )
            for given in node.get_parameters(list(node.get_parameters_by_prefix(""))):
                option = f"--{given.name.replace('_', '-')}={given.value}"
                if given.name in controller.parameters and name == controller.name:
                    options.append(option)
                elif given.name.partition(".")[0] not in OF_EVERY_NODE and option not in options:
                    raise ConfigurationError(
                        f"is not a parameter of the controller's node, {controller.name}; "
                        "parameters of other nodes are set by options of greenroof run",
                        key=f"--ros-args: {given.name} of {name}", value=given.value,
                    )
            node.destroy_node()
    finally:
        context.try_shutdown()
    return options
