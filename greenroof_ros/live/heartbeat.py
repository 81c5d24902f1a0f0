"""The heartbeat of a process of a live site: one byte with each report, on a pipe to bringup.

A pipe is used rather than a topic, since discovery can take seconds, and bringup must not miss a
process that hangs. This module does not require ROS.
"""

from __future__ import annotations

import os
from contextlib import suppress

PIPE = "GREENROOF_ROS_HEARTBEAT"
"""environment variable with the file descriptor of the pipe's end, which does not block"""


def send_beat(reached: bool) -> None:
    """Send a heartbeat, which states whether this process has reached the pump's drive."""
    if PIPE in os.environ:
        # A stopped bringup must not block the process, nor one that has ended end it.
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(int(os.environ[PIPE]), bytes([reached]))
