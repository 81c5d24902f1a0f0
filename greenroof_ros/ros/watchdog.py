"""Watchdog that ends code of the main thread that does not return, such as a user's controller."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

from greenroof_ros.base.command_line import EXIT_FAILED
from greenroof_ros.base.errors import HangError

# How often the watchdog checks whether the code returns (s).
_CHECK_S = 0.25
# How often the error is raised until the code ends (s).
_AGAIN_S = 1.0
# How long after the limit Python code may still take to end (s). Whatever is not Python code, such
# as a disk that hangs, cannot be ended.
_LAST_S = 5.0


class Watchdog:
    """Context manager that monitors the main thread, which may report between callbacks.

    The nodes of a process share its main thread. A callback that does not return would therefore
    block all nodes, and Ctrl-C as well. After the limit, a :class:`HangError` is raised in the
    code, every second until the code ends. A pause of the whole process does not count as a hang.
    """

    def __init__(self, limit: Callable[[], float], *, exits: bool = False) -> None:
        """Create the watchdog without starting it.

        Args:
            limit: function that returns how long the code may take to end, or to report again (s).
            exits: whether the process exits if the error has no effect; the bag of its run must
                then be recovered.
        """
        self._limit, self._exits = limit, exits
        self._returned = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def report(self) -> None:
        """Report that all callbacks have returned."""
        self._returned.set()

    def __enter__(self) -> Watchdog:
        """Start watching."""
        signal.signal(signal.SIGALRM, self._end_code)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop watching."""
        self._over.set()
        self._thread.join()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)

    def _end_code(self, _: int, frame: FrameType | None) -> None:
        place = "" if frame is None else f"{frame.f_code.co_filename}, line {frame.f_lineno}"
        raise HangError(f"did not return within {self._limit():g} s; it was executing {place}")

    def _watch(self) -> None:
        silent, again = 0.0, 0.0
        while not self._over.wait(_CHECK_S):
            silent += _CHECK_S
            if self._returned.is_set():
                self._returned.clear()
                silent = again = 0.0
            late = silent - self._limit()
            if late > again:
                again = late + _AGAIN_S
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGALRM)
            if late > _LAST_S and self._exits:
                print(
                    f"error: a node or the disk has not responded for {silent:g} s; 'greenroof "
                    "recover' restores the bag", file=sys.stderr, flush=True,
                )
                os._exit(EXIT_FAILED)
