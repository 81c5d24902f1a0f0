"""A green roof watered from a storm cistern, as a ROS 2 node graph and as a library without ROS."""

import os
import signal
import sys
from typing import Any

__version__ = "1.0.0"

# Bash's exit code after Ctrl-C.
INTERRUPTED = 130


def end_interrupted(*_: Any) -> None:
    """Handle Ctrl-C while a command is imported, which takes up to some seconds: end at once.

    A KeyboardInterrupt would be a traceback, or another error if a compiled module is imported.
    :func:`greenroof_ros.common.command_line.command` replaces this handler.
    """
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


# If this is imported as "python -m greenroof_ros..." or by the command, not as a library; a shell
# has its background processes ignore Ctrl-C.
if sys.argv and (sys.argv[0] == "-m" or sys.argv[0].rpartition("/")[2] == "greenroof") and (
    signal.getsignal(signal.SIGINT) is signal.default_int_handler
):
    signal.signal(signal.SIGINT, end_interrupted)
