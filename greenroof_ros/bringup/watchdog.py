"""Watchdog that ends a run if a callback does not return, for example in a user's controller."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

from greenroof_ros.base.command_line import EXIT_FAILED
from greenroof_ros.base.errors import HangError

# How often the watchdog checks whether the callbacks return (s).
_CHECK_S = 0.25
# How long after the limit Python code may still take to end (s). Whatever is not Python code, such
# as a disk that hangs, cannot be ended.
_LAST_S = 5.0


class Watchdog:
    """Context manager that monitors the main thread, which must report between callbacks.

    The nodes of a process share its main thread. A callback that does not return would therefore
    block all nodes, and Ctrl-C as well. After the limit, a :class:`HangError` is raised in the
    callback; it ends the run and closes the bag. If the error has no effect, the process exits, and
    the bag must be recovered. A pause of the whole process does not count as a hang.
    """

    def __init__(self, limit: Callable[[], float]) -> None:
        """Create the watchdog without starting it.

        Args:
            limit: function that returns the current maximum duration of a callback (s).
        """
        self._limit = limit
        self._returned = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def report(self) -> None:
        """Report that all callbacks have returned."""
        self._returned.set()

    def __enter__(self) -> Watchdog:
        """Start watching."""
        signal.signal(signal.SIGALRM, self._end_callback)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop watching."""
        self._over.set()
        self._thread.join()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)

    def _end_callback(self, _: int, frame: FrameType | None) -> None:
        place = "" if frame is None else f"{frame.f_code.co_filename}, line {frame.f_lineno}"
        raise HangError(f"did not return within {self._limit():g} s; it was executing {place}")

    def _watch(self) -> None:
        silent, ended = 0.0, False
        while not self._over.wait(_CHECK_S):
            silent += _CHECK_S
            if self._returned.is_set():
                self._returned.clear()
                silent, ended = 0.0, False
            limit = self._limit()
            if silent > limit and not ended:
                ended = True
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGALRM)
            if silent > limit + _LAST_S:
                print(
                    f"error: a node or the disk has not responded for {silent:g} s; 'greenroof "
                    "recover' restores the bag", file=sys.stderr, flush=True,
                )
                os._exit(EXIT_FAILED)
