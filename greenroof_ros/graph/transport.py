"""How the nodes reach each other: UDP on loopback, and never shared memory.

Fast DDS, the default middleware of ROS 2, uses shared memory between processes of one machine. A
process that is stopped while it holds a lock in it, somebody's ``ros2 topic echo`` under Ctrl-Z
perhaps, then freezes nodes that have nothing to do with it, and a ``kill -9`` leaves it behind.
Over UDP there is neither. What that costs a tick is in doc/performance.md.
"""

from __future__ import annotations

import os

from greenroof_ros.common.files import shared_directory

_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"


def choose_transport() -> None:
    """Set the environment of this process so; to be called before ``rclpy.init``.

    Where the user let the graph leave the machine (``ROS_AUTOMATIC_DISCOVERY_RANGE`` other than
    ``LOCALHOST``), UDP on all its interfaces. A file of profiles that the user named, and another
    middleware, stay as they are.

    With ``LOCALHOST`` the middleware would add shared memory to whatever a file of profiles says.
    The file bound to loopback says the same and more, as no socket listens on another interface, so
    that the middleware is left to it.
    """
    import rclpy

    asked = os.environ.setdefault(_RANGE, "LOCALHOST")
    fast_dds = rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps")
    if not fast_dds or _PROFILES in os.environ:
        return
    config = shared_directory() / "config"
    if asked == "LOCALHOST":
        os.environ[_RANGE] = "SYSTEM_DEFAULT"
        os.environ[_PROFILES] = str(config / "fastdds_loopback.xml")
    else:
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
        os.environ[_PROFILES] = str(config / "fastdds.xml")
