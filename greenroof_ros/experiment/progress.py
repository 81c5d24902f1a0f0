"""The progress bar of a run, on standard error."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

# Often enough for the eye, seldom enough to cost nothing.
INTERVAL_S = 0.2


class RunProgress:
    """Shows simulated time, both levels, the command and the speed of a run."""

    def __init__(self, steps: int, tau: float, file: Any = None) -> None:
        """Make the bar.

        Args:
            steps: N, the last tick.
            tau: duration of a tick (s).
            file: where it is drawn; standard error if None.
        """
        self._steps = steps
        self._tau = tau
        self._began: tuple[float, int] | None = None
        self._warned: set[str] = set()
        self._progress = Progress(
            TextColumn("{task.fields[clock]}"),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[state]}"),
            console=Console(stderr=True, file=file),
            # Redrawn when there is news, not by a thread that would compete with the run.
            auto_refresh=False,
        )
        self._task = self._progress.add_task("", total=steps, clock="0:00:00", state="starting")

    def __enter__(self) -> RunProgress:
        """Show the bar."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the bar in its last state."""
        self._progress.refresh()
        self._progress.stop()

    def warn(self, warnings: Iterable[str]) -> None:
        """Print the warnings that were not printed yet above the bar."""
        for text in warnings:
            if text not in self._warned:
                self._warned.add(text)
                self.say(f"warning: {text}")

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def waiting(self, for_what: str) -> None:
        """Show what the run waits for before its first tick."""
        self._progress.update(self._task, state=for_what, refresh=True)

    def update(self, tick: int, cistern: float, roof: float, command: float) -> None:
        """Show a tick.

        Args:
            tick: its index.
            cistern: level (m).
            roof: level (m).
            command: share of the maximum flow (1).
        """
        now = time.monotonic()
        if self._began is None:
            self._began = (now, tick)
        elapsed = now - self._began[0]
        speed = ""
        if elapsed > INTERVAL_S:
            speed = f", {(tick - self._began[1]) * self._tau / elapsed:.0f}x real time"
        minutes, seconds = divmod(int(tick * self._tau), 60)
        hours, minutes = divmod(minutes, 60)
        self._progress.update(
            self._task,
            completed=tick,
            clock=f"{hours}:{minutes:02}:{seconds:02}",
            state=f"cistern {cistern:.3f} m, roof {roof:.4f} m, command {command:.3f}{speed}",
            refresh=True,
        )
