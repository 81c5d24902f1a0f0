"""The console that prints tables, and progress on standard error."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from greenroof_ros.base.processes import Signals
from greenroof_ros.base.text import escape

# How often progress is printed without a terminal (s), for the first time after this time.
_EVERY_S = 10.0


class PlainConsole(Console):
    """A console that shows every text as it is, since texts can come from files.

    Nothing in a text is markup, an emoji or a value to highlight, and control characters and
    direction marks are escaped in each of its lines.
    """

    def __init__(self, **settings: Any) -> None:
        """Create the console with the settings of rich, by default on standard output."""
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render_str(self, text: str, **settings: Any) -> Text:
        """Return a text, or a cell of a table, as it is printed."""
        return super().render_str("\n".join(map(escape, text.split("\n"))), **settings)

    def print_table(
        self, title: str, headings: Sequence[str], rows: Iterable[Sequence[str]],
        marked: Collection[int] = (),
    ) -> None:
        """Print a table whose first column is text and whose other columns are numbers.

        A table that is wider than the terminal is printed in full, so that no number is cut off.

        Args:
            title: title of the table.
            headings: headings of the columns.
            rows: cells of each row.
            marked: rows that are printed in bold, counted from 0.
        """
        table = Table(
            title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1),
            show_edge=False,
        )
        for number, heading in enumerate(headings):
            table.add_column(heading, justify="right" if number else "left")
        for number, cells in enumerate(rows):
            table.add_row(*cells, style="bold" if number in marked else None)
            for column, cell in zip(table.columns[1:], cells[1:], strict=True):
                column.min_width = max([column.min_width or 0, *map(len, cell.split())])
        needed = Measurement.get(self, self.options.update(max_width=1000), table).minimum
        self.print(table, width=max(self.width, needed), crop=False)


class ProgressBar(Progress):
    """Progress bar with the current task and the completed share of all tasks.

    Without a terminal, it prints a line every ten seconds instead.
    """

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
        self._signals, self._due = signals, time.monotonic() + _EVERY_S

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
        if self.disable and (now := time.monotonic()) >= self._due:
            self._due = now + _EVERY_S
            self.print_line(f"{text}: {share:.0%}")
