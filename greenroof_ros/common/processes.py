"""Processes that end with another one."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import threading

_PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Have the kernel end this process when its parent dies, even by kill -9.

    By SIGTERM: what runs in the background of a shell may ignore SIGINT.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def end_with(process: int) -> None:
    """End this process at once when another one, not its parent perhaps, has ended in any way."""

    def watch() -> None:
        try:
            select.select([os.pidfd_open(process)], [], [])
        finally:  # or it has ended before
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
