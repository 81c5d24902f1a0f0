"""Lines on standard error, which a thread writes so that time-critical code does not wait."""

from __future__ import annotations

import atexit
import os
import time
from contextlib import suppress
from functools import partial

from greenroof_ros.base.disk import DiskThread

# How much may wait (bytes), and how long the end of the process waits for it (s).
_ROOM, _END_S = 1_000_000, 2.0
# How often a line that others can cause is printed (s).
_SELDOM_S = 60.0


class Lines:
    """Writer of lines to a file descriptor that may block, such as a full pipe.

    A terminal stopped with Ctrl-S blocks as well. A separate thread writes the lines, so that
    writing logs and the summary does not wait for the reader of standard error. If too many lines
    are waiting, further lines are dropped, and their number is printed.
    """

    def __init__(self, number: int) -> None:
        """Create the writer without lines.

        Args:
            number: the file descriptor. Python's stream is bypassed, because a thread that hangs in
                the stream holds its lock, and the interpreter would wait for the lock at exit.
        """
        self._number = number
        self._told = 0  # number of dropped lines that have been reported
        # By kind: when the next line is due (steady clock, s), and how many were left out.
        self._kinds: dict[str, tuple[float, int]] = {}
        self._thread = DiskThread(_ROOM)

    def print_line(self, text: str) -> None:
        """Queue one or more lines for writing, and return immediately."""
        self.write(f"{text}\n")

    def print_seldom(self, kind: str, text: str) -> None:
        """Print a message that other programs can trigger at will, at most once a minute per kind.

        Args:
            kind: kind of the message; messages of one kind are limited regardless of their text.
                The number of omitted messages is appended.
            text: one or more lines.
        """
        now = time.monotonic()
        due, left_out = self._kinds.get(kind, (0.0, 0))
        if now < due:
            self._kinds[kind] = due, left_out + 1
            return
        self._kinds[kind] = now + _SELDOM_S, 0
        more = f" (and {left_out} similar messages before it)" if left_out else ""
        self.print_line(text + more)

    def write(self, text: str) -> None:
        """Queue a text; with ``flush`` and ``isatty``, progress bars can use this as a file."""
        data = text.encode(errors="backslashreplace")
        self._thread.do(partial(self._write, data, self._thread.refused), len(data))

    def flush(self) -> None:
        """Do nothing, because all texts are written as soon as possible."""

    def isatty(self) -> bool:
        """Return True if the file descriptor is a terminal."""
        return os.isatty(self._number)

    def wait(self, within: float) -> bool:
        """Wait up to the given time (s) until all texts are written; return True if they are."""
        return self._thread.wait(within)

    def _write(self, data: bytes, refused: int) -> None:
        """Write a text in the thread, with the number of lines that were dropped before it."""
        dropped, self._told = refused - self._told, refused
        if dropped:
            data = b"%d lines were dropped: standard error was blocked\n%b" % (dropped, data)
        with suppress(OSError):  # a text that cannot be written is lost
            while data:
                data = data[os.write(self._number, data):]


# The lines of this process, which are written before it ends.
LINES = Lines(2)
print_line, print_seldom = LINES.print_line, LINES.print_seldom
atexit.register(LINES.wait, _END_S)
