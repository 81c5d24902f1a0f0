"""The progress of a run: its simulated time, levels and command."""

from __future__ import annotations

from typing import Any

from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.times import hours_minutes_seconds


class RunProgress(ProgressBar):
    """Progress bar with a run's simulated time, cistern and roof levels, and command."""

    def __init__(self, steps: int, tau: float, file: Any = None) -> None:
        """Create the bar.

        Args:
            steps: the number N of the last tick.
            tau: duration of a tick (s).
            file: stream on which the bar is drawn; None for standard error.
        """
        super().__init__(file)
        self._steps, self._tau = steps, tau

    def show_tick(
        self, tick: int, cistern_level: float, roof_level: float, command: float
    ) -> None:
        """Show a tick with its levels (m), and its command as a share of the maximum flow (1)."""
        self.show(
            f"{hours_minutes_seconds(tick * self._tau)}, cistern {cistern_level:.3f} m, roof "
            f"{roof_level:.4f} m, command {command:.3f}", tick / self._steps,
        )
