"""Without ROS 2, or without pymodbus for drives and sensors, tests are skipped."""

from __future__ import annotations

from importlib.util import find_spec

collect_ignore_glob = []
if find_spec("rclpy") is None:
    collect_ignore_glob += ["test_live*.py", "test_*_node.py"]
if find_spec("pymodbus") is None:
    collect_ignore_glob += ["test_pump_node.py", "test_live_bringup.py"]
