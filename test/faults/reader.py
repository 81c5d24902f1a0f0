"""A foreign reader of /roof/level, such as ``ros2 topic echo``: it knows nothing of this package.

With the middleware's own settings, shared memory included.
"""

from __future__ import annotations

import contextlib

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Float64

from greenroof_ros.common.processes import end_with_parent


def main() -> None:
    """Read until SIGTERM."""
    end_with_parent()
    rclpy.init()
    node = Node("reader", start_parameter_services=False)
    node.create_subscription(Float64, "/roof/level", lambda message: None, 10)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
