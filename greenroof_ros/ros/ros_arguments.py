"""The ROS arguments of ``greenroof run``, which remap topics and set the level of log messages."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.ros.domain import join, require_ros

# The options that set parameters, and the rules that rename or move a node.
_PARAMETERS, _RENAMES = ("-p", "--param", "--params-file"), re.compile(r"(.*:)?__\w+:=.*")


def remove_ros_arguments(words: Sequence[str]) -> list[str]:
    """Return the words of a command line that are not ROS arguments.

    Raises:
        ConfigurationError: if rcl cannot parse the ROS arguments, if they set a parameter or rename
            or move a node, or if ROS 2 is not installed.
    """
    with require_ros():
        from rclpy.utilities import remove_ros_args
    try:
        own = remove_ros_args(["greenroof", *words])[1:]
        join(words).try_shutdown()
    except RuntimeError as error:
        raise ConfigurationError(" ".join(str(error).split()), key="--ros-args") from error
    for option, rule in pairwise(words[words.index("--ros-args"):]):
        if option in _PARAMETERS or _RENAMES.fullmatch(rule):
            raise ConfigurationError(
                "is not possible in a run: options of greenroof run set the parameters and the "
                "namespace, and nodes keep their names", key="--ros-args", value=f"{option} {rule}",
            )
    return own
