"""The progress of a run, on standard error: a bar on a terminal, otherwise a line now and then."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from greenroof_ros.common.standard_error import ProgressLines
from greenroof_ros.common.times import hours_minutes_seconds

# Often enough for the eye, seldom enough to cost nothing.
INTERVAL_S = 0.2
# Warnings that are remembered, so that each is printed once; a text can contain a changing value.
_MOST_WARNED = 1000


class RunProgress(Progress):
    """Shows simulated time, both levels, the command and the speed of a run."""

    def __init__(self, steps: int, tau: float, file: Any = None) -> None:
        """Make the bar.

        Args:
            steps: N, the last tick.
            tau: duration of a tick (s).
            file: where it is drawn; standard error if None.
        """
        console = Console(stderr=True, file=file)
        super().__init__(
            TextColumn("{task.fields[clock]}"),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[state]}"),
            console=console,
            disable=not console.is_interactive,
            # Redrawn when there is news, not by a thread that would compete with the run.
            auto_refresh=False,
        )
        self._run = self.add_task("", total=steps, clock="00:00:00", state="starting")
        self._tau = tau
        self._lines = ProgressLines(self.print_line)
        self._warned: deque[str] = deque(maxlen=_MOST_WARNED)

    def warn(self, warnings: Iterable[str]) -> None:
        """Print the warnings that were not printed yet above the bar."""
        for text in warnings:
            if text not in self._warned:
                self._warned.append(text)
                self.print_line(f"warning: {text}")

    def print_line(self, text: str) -> None:
        """Print a line above the bar."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def waiting(self, for_what: str) -> None:
        """Show what the run waits for before its first tick."""
        self._update(state=for_what)

    def show(self, tick: int, cistern: float, roof: float, command: float) -> None:
        """Show a tick.

        Args:
            tick: its index.
            cistern: level (m).
            roof: level (m).
            command: share of the maximum flow (1).
        """
        ticks_per_s = self.tasks[0].speed
        speed = f", {ticks_per_s * self._tau:.0f}x real time" if ticks_per_s else ""
        self._update(
            completed=tick,
            clock=hours_minutes_seconds(tick * self._tau),
            state=f"cistern {cistern:.3f} m, roof {roof:.4f} m, command {command:.3f}{speed}",
        )

    def _update(self, **fields: Any) -> None:
        self.update(self._run, refresh=True, **fields)
        if self.disable:
            run = self.tasks[0]
            clock, state = run.fields["clock"], run.fields["state"]
            self._lines.update(f"{clock} ({run.percentage:.0f} %): {state}")
