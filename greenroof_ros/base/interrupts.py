"""Ctrl-C, SIGTERM and SIGHUP while a program's modules are imported, which takes up to seconds.

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


def is_program(module: str) -> bool:
    """Return True if Python was started for a module of this package.

    Args:
        module: the module's ``__name__``. It is not ``__main__`` in the executables of pip, colcon
            and ``ros2 run``.
    """
    directory, _, name = sys.argv[0].rpartition("/")
    return module == "__main__" or name == "greenroof" or directory.endswith("/lib/greenroof_ros")


def end_interrupted(*_: Any) -> None:
    """Exit on a signal, before a command handles signals or after it has ended.

    A KeyboardInterrupt would print a traceback, or would raise another error in the import of a
    compiled module. :func:`greenroof_ros.base.command_line.command` replaces this handler.
    """
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def end_on_interrupt() -> None:
    """Let the signals end this process, except those that the shell has set to be ignored."""
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, end_interrupted)


def begin_node(module: str) -> None:
    """Begin a node's program, before its module imports ROS 2 and all else that takes long.

    From then on, a signal ends the program, and without ROS 2 the program exits with a one-line
    error and code 2. Nothing is done if another program imports the module.

    Args:
        module: the module's ``__name__``.
    """
    if is_program(module):
        end_on_interrupt()
        from greenroof_ros.base.ros_environment import end_without_ros

        end_without_ros()
