"""What bringup and a live site's processes agree on: heartbeats, time limits and restarts.

The heartbeat of a process is one byte with each report, on a pipe to bringup. A pipe is used rather
than a topic, since discovery can take seconds, and bringup must not miss a process that hangs. This
module does not require ROS.
"""

from __future__ import annotations

import math
import os
from collections import deque
from contextlib import suppress

PIPE = "GREENROOF_ROS_HEARTBEAT"
"""environment variable with the file descriptor of the pipe's end, which does not block"""
MAX_RESTARTS, _WINDOW_S = 10, 600.0
"""number of restarts of a process or a node allowed within a time (s)"""
_FIRST_WAIT_S, MAX_WAIT_S = 1.0, 10.0
"""shortest and longest time before a restart (s)"""
# How long a controller may take to decide (s), or the tick if that is longer; and how much longer
# its process may be silent before the supervisor kills it. The pump stops by the command's age.
_DECIDING_S, _SILENT_S = 3.0, 2.0


def send_beat(reached: bool) -> None:
    """Send a heartbeat, which states whether this process has reached the pump's drive."""
    if PIPE in os.environ:
        # A stopped bringup must not block the process, nor one that has ended end it.
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(int(os.environ[PIPE]), bytes([reached]))


def deciding_limit(tau: float) -> float:
    """Return how long a controller may take to decide (s), for a tick of tau (s)."""
    return max(_DECIDING_S, tau)


def silence_limit(tau: float) -> float:
    """Return how long a node may be silent before it is killed (s), for a tick of tau (s)."""
    return deciding_limit(tau) + _SILENT_S


class Restarts:
    """The recent restarts of a process or a node.

    Attributes:
        due: time of the next start (steady clock, s); infinite if there must be no other.
    """

    def __init__(self) -> None:
        """Begin without a restart: the first start is due."""
        self.due = 0.0
        self._times = deque[float]()

    def postpone(self, now: float) -> str:
        """Set when to start again after a failure, and return that in words.

        Args:
            now: time of the failure (steady clock, s).
        """
        while self._times and now - self._times[0] > _WINDOW_S:
            self._times.popleft()
        if len(self._times) >= MAX_RESTARTS:
            self.due = math.inf
            return "has failed too often, and stays off until the site is restarted"
        wait = min(_FIRST_WAIT_S * 2.0 ** len(self._times), MAX_WAIT_S)
        self._times.append(now)
        self.due = now + wait
        return f"starts again in {wait:g} s"
