"""Statistics of the wall times of a run's ticks, in constant memory."""

from __future__ import annotations

from collections import deque

import numpy as np

# Number of ticks that the percentile covers.
_CAPACITY = 65_536


class TickTimes:
    """Wall times of ticks (s): their number, mean, maximum and 99th percentile.

    The percentile covers the last 65,536 ticks; number, mean and maximum cover all ticks.
    """

    def __init__(self) -> None:
        """Start without ticks."""
        self._count = 0
        self._sum = 0.0
        self._max = 0.0
        self._times: deque[float] = deque(maxlen=_CAPACITY)

    def __len__(self) -> int:
        """Return the number of ticks."""
        return self._count

    def append(self, seconds: float) -> None:
        """Add the time of a tick (s)."""
        self._times.append(seconds)
        self._count += 1
        self._sum += seconds
        self._max = max(self._max, seconds)

    def statistics(self, solves: int, fallbacks: int) -> dict[str, float]:
        """Return the statistics of a controller; without ticks, the times are 0.

        Args:
            solves: number of programs that the solver attempted.
            fallbacks: number of these programs for which the solver found no solution.
        """
        return {
            "solves": solves,
            "fallbacks": fallbacks,
            "mean_s": self._sum / max(1, self._count),
            "p99_s": float(np.percentile(list(self._times) or [0.0], 99)),
            "max_s": self._max,
        }
