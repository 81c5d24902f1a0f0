"""What people read on standard error: lines that a thread writes, and how far something is.

Who must be in time has its lines written by a thread. Progress is a bar, or where that is no
terminal a line every ten seconds.
"""

from __future__ import annotations

import atexit
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from greenroof_ros.common.disk import DiskThread

# So many wait at most, and the end of the process waits for them for so long (s).
_MOST, _END_S = 1000, 2.0
# Progress is said so often.
_EVERY_S = 10.0


class Lines:
    """Lines to a file descriptor that may take nothing: a full pipe, a terminal at Ctrl-S.

    They have a thread of their own: logs and summary do not wait for who reads standard error.
    Where too many wait, the oldest are dropped, and how many is said.
    """

    def __init__(self, number: int, most: int = _MOST) -> None:
        """Say nothing yet.

        Args:
            number: the file descriptor. It is written past Python's stream: a thread that hangs
                in that holds its lock, for which the end of the interpreter would wait.
            most: how many may wait.
        """
        self._number = number
        self._most = most
        self._waiting: deque[str] = deque()
        self._dropped = 0
        self._lock = threading.Lock()
        self._thread = DiskThread()

    def say(self, text: str) -> None:
        """Have a line written, or several; return at once."""
        self.write(f"{text}\n")

    def write(self, text: str) -> None:
        """Have a text written; with the next two this is the file of a bar of progress."""
        with self._lock:
            if len(self._waiting) == self._most:
                self._waiting.popleft()
                self._dropped += 1
            self._waiting.append(text)
        self._thread.do(self._write)

    def flush(self) -> None:
        """All is written as soon as it can be."""

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return os.isatty(self._number)

    def wait(self, within: float) -> bool:
        """Wait until all is written, for so long at most (s); return whether it is."""
        return self._thread.wait(within)

    def _write(self) -> None:
        """Write what waits, on the thread; what nobody can read is lost."""
        while True:
            with self._lock:
                if not self._waiting:
                    return
                text = self._waiting.popleft()
                dropped, self._dropped = self._dropped, 0
            if dropped:
                text = f"{dropped} lines were dropped: standard error took nothing\n{text}"
            data = text.encode(errors="backslashreplace")
            try:
                while data:
                    data = data[os.write(self._number, data):]
            except OSError:
                continue


# The lines of the process, which are written before it ends.
LINES = Lines(2)
say = LINES.say
atexit.register(LINES.wait, _END_S)


class ProgressLines:
    """Prints how far something is, every ten seconds, and nothing before the first ten."""

    def __init__(self) -> None:
        """Begin to count."""
        self._due = time.monotonic() + _EVERY_S

    def tell(self, text: str) -> None:
        """Say how far it is; printed where a line is due."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + _EVERY_S
            print(text, file=sys.stderr, flush=True)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show how far something is.

    Yields:
        What is called with what is done now, and the share of all that is done, 0 to 1.
    """
    from rich.console import Console  # nodes print lines, and need none of this
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

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
