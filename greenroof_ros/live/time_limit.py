"""A time limit for a controller's code, which must not stop its node."""

from __future__ import annotations

import faulthandler
from collections.abc import Iterator
from contextlib import contextmanager

from greenroof_ros.ros.watchdog import Watchdog

# How long a controller may take to decide (s), or the tick if that is longer; and how much longer
# its process may be silent before the supervisor kills it. The pump stops by the command's age.
_DECIDING_S, _SILENT_S = 3.0, 2.0


def deciding_limit(tau: float) -> float:
    """Return how long a controller may take to decide (s), for a tick of tau (s)."""
    return max(_DECIDING_S, tau)


def silence_limit(tau: float) -> float:
    """Return how long a node may be silent before it is killed (s), for a tick of tau (s)."""
    return deciding_limit(tau) + _SILENT_S


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise an error in Python code of the main thread that takes too long.

    Compiled code cannot be stopped; the position from which it was called is then written to
    standard error.

    Raises:
        HangError: if the code takes longer than the given time (s).
    """
    with Watchdog(lambda: seconds):
        faulthandler.dump_traceback_later(seconds + 1.0)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
