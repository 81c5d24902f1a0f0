"""Errors that end a run, and their descriptions; this module does not import ROS."""

from __future__ import annotations

import sys
import traceback

from greenroof_ros.base.command_line import EXIT_FAILED, exit_code
from greenroof_ros.base.errors import ConfigurationError, HangError


class LockstepError(Exception):
    """Raised if the graph cannot continue; the message names the topic and the node."""


class MalformedMessageError(Exception):
    """Raised if the bytes received do not form a message of the topic's type."""


def describe(error: Exception) -> str:
    """Return an unexpected error as one line: its type, message and location in the code."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"


def print_failure(error: Exception) -> tuple[str, int]:
    """Print why a node or a run failed, and return it as a sentence, with the exit code.

    A traceback comes first if the error was not expected.
    """
    failure, code = explain(error)
    if failure != str(error):
        traceback.print_exception(error)
    print(f"error: {failure}", file=sys.stderr)
    return failure, code


def explain(error: Exception) -> tuple[str, int]:
    """Return a sentence that states why a node or a run failed, and the exit code."""
    if isinstance(error, ConfigurationError):
        return str(error), exit_code(error)
    known = isinstance(error, (LockstepError, OSError, HangError))
    return str(error) if known else describe(error), EXIT_FAILED
