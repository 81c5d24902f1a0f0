"""A node that changes its executor misses no message."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="the module needs ROS 2")


def test_messages_that_come_while_a_node_changes_its_executor() -> None:
    """A sample of test/swaps.py; without the repair 3 of 20,000 left a message behind."""
    script = Path(__file__).parents[1] / "swaps.py"
    done = subprocess.run(
        [sys.executable, str(script), "--rounds", "1000"],
        capture_output=True, text=True, timeout=300, check=False,
    )
    assert done.stdout == "0 of 1000 swaps left a message behind\n", done.stderr
    assert done.returncode == 0
