"""Progress on standard error: a bar, or where that is no terminal a line every ten seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from greenroof_ros.common.progress_lines import ProgressLines


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show how far something is.

    Yields:
        What is called with what is done now, and the share of all that is done, 0 to 1.
    """
    console = Console(stderr=True)
    lines = ProgressLines()
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal,
        refresh_per_second=2,  # a thread that takes its share of two cores
    ) as progress:
        task = progress.add_task("", total=1.0)

        def tell(text: str, share: float) -> None:
            progress.update(task, description=text, completed=share)
            if not console.is_terminal:
                lines.tell(f"{text}: {share:.0%}")

        yield tell
