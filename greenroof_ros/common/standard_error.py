"""Lines for people on standard error, said by who must be in time, and written by a thread."""

from __future__ import annotations

import atexit
import os
import threading
from collections import deque

from greenroof_ros.common.disk import DiskThread

# So many wait at most, and the end of the process waits for them for so long (s).
_MOST, _END_S = 1000, 2.0


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


# Those of the process, which are written before it ends.
LINES = Lines(2)
say = LINES.say
atexit.register(LINES.wait, _END_S)
