"""Without ROS 2 these tests are skipped."""

from __future__ import annotations

from importlib.util import find_spec

collect_ignore_glob = ["test_*.py"] if find_spec("rclpy") is None else []
