"""The progress of a run: its simulated time, levels, command and speed, and its warnings."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.times import hours_minutes_seconds

# How many warnings are remembered, so that each is printed once. There is a limit, since a text can
# contain a changing value.
_MAX_WARNED = 1000


class RunProgress(ProgressBar):
    """Progress bar with a run's simulated time, cistern and roof levels, command and speed."""

    def __init__(self, steps: int, tau: float, file: Any = None) -> None:
        """Create the bar.

        Args:
            steps: the number N of the last tick.
            tau: duration of a tick (s).
            file: stream on which the bar is drawn; None for standard error.
        """
        super().__init__(file)
        self._steps, self._tau = steps, tau
        self._warned: deque[str] = deque(maxlen=_MAX_WARNED)

    def warn(self, warnings: Iterable[str]) -> None:
        """Print the warnings that have not been printed yet, above the bar."""
        for text in warnings:
            if text not in self._warned:
                self._warned.append(text)
                self.print_line(f"warning: {text}")

    def show_tick(self, tick: int, cistern: float, roof: float, command: float) -> None:
        """Show the values of a tick.

        Args:
            tick: number of the tick.
            cistern: level in the cistern (m).
            roof: level on the roof (m).
            command: command as a share of the maximum flow (1).
        """
        share_per_s = self.tasks[0].speed
        real = f", {share_per_s * self._steps * self._tau:.0f}x real time" if share_per_s else ""
        self.show(
            f"{hours_minutes_seconds(tick * self._tau)}, cistern {cistern:.3f} m, roof "
            f"{roof:.4f} m, command {command:.3f}{real}", tick / self._steps,
        )
