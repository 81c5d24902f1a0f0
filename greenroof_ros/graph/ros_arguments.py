"""The ROS arguments of ``greenroof run``, which follow ``--ros-args``.

A remapping applies to all nodes of the run or, in the form ``NODE:FROM:=TO``, to a single node. The
namespace and the parameters of the controller are converted to options of the run, because the run
itself needs them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from greenroof_ros.base.errors import ConfigurationError

_BEGIN, _END = "--ros-args", "--"
_REMAP, _PARAMETER, _FILE = ("-r", "--remap"), ("-p", "--param"), "--params-file"


def split_ros_arguments(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into the command's own arguments and the ROS arguments."""
    others, arguments = list[str](), list[str]()
    into = others
    for word in words:
        if word == _BEGIN:
            into = arguments
        elif word == _END and into is arguments:
            into = others
        else:
            into.append(word)
    return others, arguments


def read_ros_arguments(
    arguments: Sequence[str], controller: str, parameters: Collection[str]
) -> tuple[list[str], list[str]]:
    """Convert ROS arguments to options of a run; return the options and the other ROS arguments.

    Args:
        arguments: the words after ``--ros-args``.
        controller: name of the controller's node.
        parameters: names of the controller's parameters.

    Raises:
        ConfigurationError: if an argument would move or rename a single node, or sets a parameter
            that only options may set.
    """
    options, left, words = list[str](), list[str](), iter(arguments)
    for word in words:
        if word not in (*_REMAP, *_PARAMETER, _FILE):
            left.append(word)
            continue
        rule = next(words, "")
        qualified, _, value = rule.partition(":=")
        node, _, name = qualified.rpartition(":")
        if word == _FILE:
            raise ConfigurationError(
                "is not available for a run: set the controller's parameters with --parameters "
                "FILE, and the parameters of other nodes with --node-parameters "
                "FILE", key=word, value=rule,
            )
        if word in _PARAMETER:
            if name not in parameters or node.rpartition("/")[2] not in ("", controller):
                raise ConfigurationError(
                    f"is not a parameter of the controller's node, {controller}; parameters of "
                    "other nodes are set by options of greenroof run", key=word, value=rule,
                )
            options.append(f"--{name.replace('_', '-')}={value}")
        elif name in ("__ns", "__node", "__name"):
            if node or name != "__ns":
                raise ConfigurationError(
                    "must not rename or move a node of a run, because the other nodes know it by "
                    "its name; __ns:=/NAME moves all nodes", key=word, value=rule,
                )
            options.append(f"--namespace={value}")
        else:
            left += word, rule
    return options, left
