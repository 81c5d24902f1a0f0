"""Time limit for code of the main thread that may not return, such as a user's controller."""

from __future__ import annotations

import faulthandler
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from greenroof_ros.base.errors import HangError

# How often the error is raised until the code ends (s).
_AGAIN_S = 1.0
# How long after the limit Python code may still take to end (s). Whatever is not Python code, such
# as compiled code or a disk that hangs, cannot be ended.
_LAST_S = 5.0


class Watchdog:
    """Watchdog of the main thread, which must report before each limit has passed.

    The nodes of a process share its main thread. Code that does not return would therefore block
    all nodes, and Ctrl-C as well. After the limit, a :class:`HangError` is raised in the code,
    every second until the code ends.
    """

    def __init__(self, *, exits: bool = False) -> None:
        """Create the watchdog without starting it.

        Args:
            exits: whether the process exits if the error has no effect; otherwise, the place of the
                code is written to standard error.
        """
        self._exits, self._limit = exits, 0.0
        signal.signal(signal.SIGALRM, self._end_code)

    def report(self, limit: float) -> None:
        """Report that the code has returned; the next report must follow within the limit (s)."""
        self._limit = limit
        signal.setitimer(signal.ITIMER_REAL, limit, _AGAIN_S)
        faulthandler.dump_traceback_later(limit + _LAST_S, exit=self._exits)

    def stop(self) -> None:
        """Stop watching."""
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        faulthandler.cancel_dump_traceback_later()

    def _end_code(self, _: int, frame: FrameType | None) -> None:
        place = "" if frame is None else f"{frame.f_code.co_filename}, line {frame.f_lineno}"
        raise HangError(f"did not return within {self._limit:g} s; it was executing {place}")


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise an error in Python code of the main thread that takes too long.

    Raises:
        HangError: if the code takes longer than the given time (s).
    """
    watchdog = Watchdog()
    watchdog.report(seconds)
    try:
        yield
    finally:
        watchdog.stop()
