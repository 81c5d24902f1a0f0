"""Ctrl-C and its like, looked at where a program can end cleanly."""

from __future__ import annotations

import signal
from typing import Any

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class InterruptedRun(Exception):
    """Ctrl-C, or SIGTERM, or the terminal was closed; the message says which."""


class Signals:
    """Notes that a signal came; the run looks at it where it can end cleanly.

    An exception out of the handler could fall into the middle of anything, the end of the nodes
    among it. A signal that is ignored stays so: ``nohup`` ignores the end of the terminal, and a
    shell Ctrl-C for what it starts in the background.
    """

    def __init__(self) -> None:
        self._came: signal.Signals | None = None
        for number in _NUMBERS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    def _on_signal(self, signum: int, frame: Any) -> None:
        self._came = signal.Signals(signum)

    def ignore(self) -> None:
        """Take no further one: the end of the interpreter would be ended by it."""
        for number in _NUMBERS:
            signal.signal(number, signal.SIG_IGN)

    def check(self) -> None:
        """Raise :class:`InterruptedRun` if one came."""
        if self._came is not None:
            raise InterruptedRun(f"interrupted by {self._came.name}")
