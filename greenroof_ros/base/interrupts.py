"""The end of a program by Ctrl-C, SIGTERM and SIGHUP, from its first imports on.

This module imports nothing that takes long, so that a program can call it first.
"""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False  # typing's own takes longer to import than this module
if TYPE_CHECKING:
    from typing import Any

INTERRUPTED = 130
"""exit code of a shell's command after Ctrl-C"""
SIGNALS = tuple(  # Windows has no SIGHUP
    signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""the signals that ask a process to end"""


def begin_program(module: str) -> bool:
    """Let the signals end this process if it is a program of this package; return True if it is.

    Signals that the shell has set to be ignored stay ignored. A command that has to close something
    first handles the signals with :class:`greenroof_ros.base.processes.Signals`.

    Args:
        module: the module's ``__name__``. It is not ``__main__`` in the executables of pip, colcon
            and ``ros2 run``.
    """
    directory, _, name = sys.argv[0].rpartition("/")
    is_executable = name == "greenroof" or directory.endswith("/lib/greenroof_ros")
    if module != "__main__" and not is_executable:
        return False
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, _end_interrupted)
    return True


def _end_interrupted(*_: Any) -> None:
    """Exit at once.

    A KeyboardInterrupt would print a traceback, or would raise another error in the import of a
    compiled module; compiled code could even discard it.
    """
    try:
        # A progress bar hides the cursor.
        os.write(2, b"\x1b[?25h\ninterrupted\n" if os.isatty(2) else b"interrupted\n")
    finally:
        os._exit(INTERRUPTED)
