"""A node misses no message when its executor begins to listen."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="the module needs ROS 2")


def test_messages_that_come_while_an_executor_begins_to_listen() -> None:
    """A sample of test/swaps.py, by a private part of rclpy that a new one may lack."""
    script = Path(__file__).parents[1] / "swaps.py"
    done = subprocess.run(
        [sys.executable, str(script), "--rounds", "1000"],
        capture_output=True, text=True, timeout=300, check=False,
    )
    assert done.stdout == "0 of 1000 times a message was left behind\n", done.stderr
    assert done.returncode == 0
