"""Errors in a controller's code, reported with the file and the line."""

from __future__ import annotations

import importlib
import traceback
from pathlib import Path
from typing import Any

import greenroof_ros
from greenroof_ros.common.errors import ConfigurationError, HangError

# Places that are not a user's code: this package, and what Python uses to import.
_NO_USERS = str(Path(greenroof_ros.__file__).parent), importlib.__file__, "<frozen importlib"


class ControllerError(ConfigurationError):
    """Error raised if a controller's code raises an error, or if its command is invalid."""


def locate_error(kind: Any, error: BaseException) -> ConfigurationError | HangError:
    """Return an error that a controller's code raised, with the file and the line added.

    An error of this package that already names the cause is returned unchanged, unless the error
    comes from user code. The file and the line are those of the last frame in the file through
    which the user's code was entered. If no user code was entered, as with a wrong number of
    arguments, the file and the line are those of the method that the message names.
    """
    name = getattr(kind, "__name__", str(kind))
    file, line = None, None
    last = _last_frame(error)
    if isinstance(error, (ControllerError, HangError)) or (
        last is None and isinstance(error, ConfigurationError)
    ):
        return error
    try:
        text = str(error)
    except Exception:  # its class may be a user's, too
        text = "the error message cannot be read"
    if last is None and kind.__module__.startswith("greenroof_ros."):
        last = traceback.extract_tb(error.__traceback__)[-1]
    if last is not None:
        file, line, name = last.filename, last.lineno, f"{name}.{last.name}"
    else:
        for method in ("__init__", "command", "skip", "statistics"):
            if f"{method}()" in text:
                file, line = find_place(kind, method)
                name = f"{name}.{method}"
    return ControllerError(
        f"raises {type(error).__name__}: {text}", file=file, line=line, key=name
    )


def not_imported(reference: str, error: BaseException) -> ConfigurationError:
    """Return the error for a controller that cannot be imported, with file and line if known."""
    last = _last_frame(error)
    file, line = (None, None) if last is None else (last.filename, last.lineno)
    if isinstance(error, SyntaxError):
        file, line = error.filename, error.lineno
    return ConfigurationError(
        f"cannot be imported: {type(error).__name__}: {error}", file=file, line=line,
        key="controller", value=reference,
    )


def _last_frame(error: BaseException) -> traceback.FrameSummary | None:
    """Return the last frame of an error in the first user file through which it passed, if any."""
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith(_NO_USERS)
    ]
    return next((each for each in reversed(frames) if each.filename == frames[0].filename), None)


def find_place(kind: Any, method: str) -> tuple[str | None, int | None]:
    """Return the file and line of a method or property; None for both if it is not in a file.

    If a class wraps a function as ``__wrapped__``, the location of this function is returned.
    """
    member = getattr(kind, "__wrapped__", getattr(kind, method, None))
    code = getattr(getattr(member, "fget", member), "__code__", None)
    return (None, None) if code is None else (code.co_filename, code.co_firstlineno)
