"""Progress reports on standard error: a bar on a terminal, otherwise a line every ten seconds."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.standard_error import ProgressLines
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import hours_minutes_seconds

# Often enough for the eye, rarely enough to cost nothing.
INTERVAL_S = 0.2
# How many warnings are remembered, so that each is printed once. There is a limit, since a text can
# contain a changing value.
_MAX_WARNED = 1000


class ProgressBar(Progress):
    """Progress bar with the current task and the completed share of all tasks."""

    def __init__(self, file: Any = None) -> None:
        """Create the bar.

        Args:
            file: stream on which the bar is drawn; None for standard error.
        """
        console = PlainConsole(stderr=True, file=file)
        super().__init__(
            TextColumn("{task.description}", markup=False), BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"), TimeRemainingColumn(),
            console=console, disable=not console.is_interactive,
            refresh_per_second=2,  # its thread competes with the run
        )
        self._task = self.add_task("", total=1.0)
        self._lines = ProgressLines(self.print_line)

    def print_line(self, text: str) -> None:
        """Print a line above the bar."""
        self.console.print(text, soft_wrap=True)

    def show(self, text: str, share: float) -> None:
        """Show the current task and the completed share of all tasks, from 0 to 1."""
        self.update(self._task, description=escape(text), completed=share)
        if self.disable:
            self._lines.update(f"{text}: {share:.0%}")


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
