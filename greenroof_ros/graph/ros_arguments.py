"""The ROS arguments of ``greenroof run``, after ``--ros-args``, and the nodes they apply to.

A remapping applies to all nodes of the run, or to one: ``NODE:FROM:=TO``. What the run itself needs
to know becomes its own option: the namespace, and parameters of the controller.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from greenroof_ros.common.errors import ConfigurationError

_BEGIN, _END = "--ros-args", "--"
_REMAP, _PARAMETER, _FILE = ("-r", "--remap"), ("-p", "--param"), "--params-file"


def split_ros_arguments(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words of a command line that are not ROS arguments, and those that are."""
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
    """Return the options that some ROS arguments stand for, and the ROS arguments that are left.

    Args:
        arguments: the words after ``--ros-args``.
        controller: name of the controller's node.
        parameters: names of its parameters.

    Raises:
        ConfigurationError: if one would move or rename a single node, or sets what options set.
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
                "is not for a run: set the controller's parameters with --parameters FILE, others "
                "with --node-parameters FILE", key=word, value=rule,
            )
        if word in _PARAMETER:
            if name not in parameters or node.rpartition("/")[2] not in ("", controller):
                raise ConfigurationError(
                    f"is not a parameter of the controller's node, {controller}; what other nodes "
                    "need is set by options of greenroof run", key=word, value=rule,
                )
            options.append(f"--{name.replace('_', '-')}={value}")
        elif name in ("__ns", "__node", "__name"):
            if node or name != "__ns":
                raise ConfigurationError(
                    "must not rename or move a node of a run: the others know it by its name; "
                    "__ns:=/NAME moves all of them", key=word, value=rule,
                )
            options.append(f"--namespace={value}")
        else:
            left += word, rule
    return options, left
