"""When a process or a node that has failed is restarted."""

from __future__ import annotations

from collections import deque

MAX_RESTARTS, WINDOW_S = 10, 600.0
"""number of restarts allowed within a time (s)"""
FIRST_WAIT_S, MAX_WAIT_S = 1.0, 10.0
"""shortest and longest time before a restart (s)"""


class Restarts:
    """Recent restarts of one process or node."""

    def __init__(self) -> None:
        """Begin without restarts."""
        self._times: deque[float] = deque()

    def wait(self, now: float) -> float | None:
        """Count a restart, and return how long to wait before it (s), which doubles every time.

        Args:
            now: time of the failure (steady clock, s).

        Returns:
            The time; None if there have been too many restarts, so that there must be no other.
        """
        while self._times and now - self._times[0] > WINDOW_S:
            self._times.popleft()
        count = len(self._times)
        if count >= MAX_RESTARTS:
            return None
        self._times.append(now)
        return min(FIRST_WAIT_S * 2.0**count, MAX_WAIT_S)
