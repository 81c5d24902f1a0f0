"""Without ROS 2, or without pymodbus for drives and sensors, tests are skipped."""

from __future__ import annotations

from importlib.util import find_spec

collect_ignore_glob = [] if find_spec("rclpy") and find_spec("pymodbus") else ["test_*.py"]
