"""Processes that end with another one."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import threading

_PR_SET_PDEATHSIG = 1
# The environment variable by which a process asks one that it starts to end with it: its number.
_PARENT = "GREENROOF_ROS_PARENT"


def asked_to_end_with_this() -> dict[str, str]:
    """Return an environment in which a command of this package ends with the present process.

    The child itself sees to it, at its start: Python code between fork and exec (``preexec_fn``)
    can lock up where the parent has threads.
    """
    return {**os.environ, _PARENT: str(os.getpid())}


def end_with_parent() -> None:
    """Have the kernel end this process when its parent dies, even by kill -9, if that asked for it.

    By SIGTERM: what runs in the background of a shell may ignore SIGINT. A parent that died before
    this was called counts, too.
    """
    parent = os.environ.pop(_PARENT, None)  # what this process starts is not that one's child
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if str(os.getppid()) != parent:
        os.kill(os.getpid(), signal.SIGTERM)


def end_with(process: int) -> None:
    """End this process at once when another one, not its parent perhaps, has ended in any way."""

    def watch() -> None:
        try:
            select.select([os.pidfd_open(process)], [], [])
        finally:  # or it has ended before
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
