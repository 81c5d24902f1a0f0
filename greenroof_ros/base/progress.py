"""Progress reports on standard error: a bar on a terminal, otherwise a line every ten seconds."""

from __future__ import annotations

from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.processes import Signals
from greenroof_ros.base.standard_error import ProgressLines
from greenroof_ros.base.text import escape


class ProgressBar(Progress):
    """Progress bar with the current task and the completed share of all tasks."""

    def __init__(self, file: Any = None, signals: Signals | None = None) -> None:
        """Create the bar.

        Args:
            file: stream on which the bar is drawn; None for standard error.
            signals: signals that end the work at the next call of :meth:`show`.
        """
        console = PlainConsole(stderr=True, file=file)
        super().__init__(
            TextColumn("{task.description}", markup=False), BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"), TimeRemainingColumn(),
            console=console, disable=not console.is_interactive,
            refresh_per_second=2,  # its thread competes with the run
        )
        self._task = self.add_task("", total=1.0)
        self._lines, self._signals = ProgressLines(self.print_line), signals

    def print_line(self, text: str) -> None:
        """Print a line above the bar."""
        self.console.print(text, soft_wrap=True)

    def show(self, text: str, share: float) -> None:
        """Show the current task and the completed share of all tasks, from 0 to 1.

        Raises:
            InterruptedRun: if a signal has been received.
        """
        if self._signals is not None:
            self._signals.check()
        self.update(self._task, description=escape(text), completed=share)
        if self.disable:
            self._lines.update(f"{text}: {share:.0%}")
