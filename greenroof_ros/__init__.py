"""Watering of a green roof from a rainwater cistern, simulated without ROS or as a ROS 2 graph.

The names in ``__all__`` are loaded on first use, so that ``import greenroof_ros`` is fast.
"""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False  # typing's, whose import takes longer than all else here
if TYPE_CHECKING:
    from typing import Any

    from greenroof_ros.analysis.api import gym
    from greenroof_ros.analysis.api.arguments import read_site
    from greenroof_ros.analysis.api.district import district
    from greenroof_ros.analysis.api.environment import Environment
    from greenroof_ros.analysis.api.scenarios import scenarios, score
    from greenroof_ros.analysis.api.simulate import Result, compare, read_bag, simulate
    from greenroof_ros.analysis.api.size import size

__version__ = "1.0.0"

__all__ = [
    "Environment", "Result", "compare", "district", "gym", "read_bag", "read_site", "scenarios",
    "score", "simulate", "size",
]

# The module of each of these names in analysis/api; gym is itself one.
_MODULES = {
    "Environment": "environment", "Result": "simulate", "compare": "simulate",
    "district": "district", "read_bag": "simulate", "read_site": "arguments",
    "scenarios": "scenarios", "score": "scenarios", "simulate": "simulate", "size": "size",
}


if not TYPE_CHECKING:  # or every name would be right

    def __getattr__(name: str) -> Any:
        """Load an object whose name is in ``__all__``."""
        import importlib

        api = f"{__name__}.analysis.api"
        if name == "gym":
            return importlib.import_module(f"{api}.gym")
        if name in _MODULES:
            return getattr(importlib.import_module(f"{api}.{_MODULES[name]}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the names of all attributes, including the names that are loaded on first use."""
    return sorted({*globals(), *__all__})


# Bash's exit code after Ctrl-C, and the signals that ask a process to end.
INTERRUPTED = 130
SIGNALS = tuple(  # Windows has no SIGHUP
    signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def end_interrupted(*_: Any) -> None:
    """Exit on a signal during a command's imports, which take seconds, or after the command's end.

    A KeyboardInterrupt would print a traceback, or would raise another error in the import of a
    compiled module. :func:`greenroof_ros.base.command_line.command` replaces this handler.
    """
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def end_on_interrupt() -> None:
    """Make Ctrl-C, SIGTERM and SIGHUP stop this command's process during its imports.

    Signals that the shell has set to be ignored, such as Ctrl-C for a background process, remain
    ignored.
    """
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, end_interrupted)


# The program that Python starts, if it is of this package: the module after "python -m", whose name
# is before its arguments, or an executable of "ros2 run". Otherwise empty.
_PROGRAM = ""
if sys.argv[:1] == ["-m"]:
    _PROGRAM = sys.orig_argv[-len(sys.argv)].removeprefix("-m")
elif sys.argv and sys.argv[0].split("/")[-3:-1] == ["lib", __name__]:
    _PROGRAM = f"{__name__}.nodes.{sys.argv[0].rpartition('/')[2]}"
_PROGRAM = _PROGRAM if _PROGRAM.partition(".")[0] == __name__ else ""
# The command does it itself.
if _PROGRAM:
    end_on_interrupt()

# After it, as Ctrl-C may come at any time.
from greenroof_ros.base.registration import register  # noqa: E402

register()

if _PROGRAM.split(".")[1:2] in (["nodes"], ["live"]) and not _PROGRAM.endswith(".greenroof"):
    from greenroof_ros.base.ros_environment import end_without_ros

    end_without_ros()
