"""A time limit for a controller's code, which must not stop its node."""

from __future__ import annotations

import faulthandler
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from greenroof_ros.base.errors import HangError

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
    """Raise an error in Python code that takes too long, and repeat it every second until it stops.

    The code has to run in the main thread. Compiled code cannot be stopped; the position from which
    it was called is then written to standard error. A pause of the whole process counts as only one
    step, which is a tenth of the limit.

    Raises:
        HangError: if the code takes longer than the given time (s).
    """
    step = seconds / 10
    left = seconds

    def end(_: int, frame: FrameType | None) -> None:
        nonlocal left
        left -= step
        if left > step / 2:
            return
        left = 1.0
        place = "" if frame is None else f"{frame.f_code.co_filename}, line {frame.f_lineno}"
        raise HangError(f"did not return within {seconds:g} s; it was executing {place}")

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, step, step)
    faulthandler.dump_traceback_later(seconds + 1.0)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
