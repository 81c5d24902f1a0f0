"""What a controller's code does wrong, as one error that names its file and line."""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any

import greenroof_ros
from greenroof_ros.common.errors import ConfigurationError

_PACKAGE = str(Path(greenroof_ros.__file__).parent)


class ControllerError(ConfigurationError):
    """A controller is broken: its code raised an error, or its command is invalid."""


def locate_error(kind: Any, error: BaseException) -> ControllerError:
    """Return an error that a controller's code raised, with file and line.

    They are the last place in the file where a user's code was entered. If it was not entered, as
    with a wrong number of arguments, they are those of the method that the message names.
    """
    name = getattr(kind, "__name__", str(kind))
    file, line = None, None
    frames = traceback.extract_tb(error.__traceback__)
    users = [frame for frame in frames if not frame.filename.startswith(_PACKAGE)]
    if users or kind.__module__.startswith("greenroof_ros."):
        file = (users[0] if users else frames[-1]).filename
        last = next(frame for frame in reversed(frames) if frame.filename == file)
        line, name = last.lineno, f"{name}.{last.name}"
    else:
        for method in ("__init__", "command", "skip", "statistics"):
            if f"{method}()" in str(error):
                file, line = find_place(kind, method)
                name = f"{name}.{method}"
    return ControllerError(
        f"raises {type(error).__name__}: {error}", file=file, line=line, key=name
    )


def find_place(kind: Any, method: str) -> tuple[str | None, int | None]:
    """Return the file and line of a method; None for what is not a function in a file."""
    code = getattr(getattr(kind, method), "__code__", None)
    return (None, None) if code is None else (code.co_filename, code.co_firstlineno)
