"""Calls of a controller: its decision in each tick, the wall times, and errors in its code."""

from __future__ import annotations

import importlib
import inspect
import math
import sys
import traceback
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.base.errors import ConfigurationError, HangError, describe_value
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.protocol import Controller

# Places that are not a user's code: this package, and what Python uses to import.
_NO_USERS = str(Path(__file__).parent.parent), importlib.__file__, "<frozen importlib"
COMMANDS = Range(0.0, sys.float_info.max, "1")
"""the commands to the pumps"""
# Number of ticks that the percentile of the wall times covers.
_CAPACITY = 65_536


class ControllerError(ConfigurationError):
    """Error raised if a controller's code raises an error, or if its command is invalid."""


def may_decide(controller: Controller, allowed: bool, quiet: bool) -> bool:
    """Return whether a controller decides in a tick; in quiet hours, only if it uses the time."""
    return allowed and (not quiet or hasattr(controller, "time_ns"))


def decide(
    controller: Controller, allowed: bool, cistern_level: float, roof_level: float,
    precipitation: Any, evapotranspiration: Sequence[float], quiet: bool = False,
) -> float:
    """Return the command for a tick: the controller's command if pumping is allowed, otherwise 0.

    Pumping is not allowed in frost, which can burst the pipe of a running pump. Nor is pumping
    allowed after an input has been rejected, because a command based on a level that was not
    measured must not reach the pump. In quiet hours the command is also 0, but a controller that
    uses the time is still called, so that it continues to learn and plan.

    Args:
        controller: controller that computes the command or skips the tick.
        allowed: whether pumping is allowed.
        cistern_level: level in the cistern (m).
        roof_level: level on the roof (m).
        precipitation: forecast of rain (m/s), in the shape that the controller accepts.
        evapotranspiration: forecast of evapotranspiration (m3/s).
        quiet: whether the tick is in the site's quiet hours.

    Raises:
        ControllerError: if the controller raised an error or returned an invalid command.
        ConfigurationError: if the controller cannot use the forecast.
    """
    kind = type(controller)
    with OwnCode(kind):
        if not may_decide(controller, allowed, quiet):
            controller.skip()
            return 0.0
        command = controller.command(cistern_level, roof_level, precipitation, evapotranspiration)
    # Floats first: a general check takes a tenth of a simulated tick.
    if not (isinstance(command, float) and 0.0 <= command < math.inf):
        command = valid_number(kind, "command", "the command", command, COMMANDS)
    return 0.0 if quiet else float(command)


def valid_number(kind: Any, member: str, subject: str, value: Any, valid: Range) -> float:
    """Return the number that a class returned.

    Args:
        kind: the class.
        member: method or property that returned the number.
        subject: name of the number.
        value: the number.
        valid: the valid numbers.

    Raises:
        ControllerError: if it is not a valid number.
    """
    if value in valid:
        return float(value)
    file, line = find_place(kind, member, "command")
    # A function has no name that check-controller could take.
    hint = "" if hasattr(kind, "__wrapped__") else " (greenroof check-controller detects this)"
    raise ControllerError(
        valid.expected(value) + hint, file=file, line=line,
        key=f"{subject} of {kind.__name__} = {describe_value(value)}",
    )


def read_statistics(controller: Controller) -> dict[str, float] | None:
    """Return the statistics of a controller's solver; None if the controller has no solver.

    Raises:
        ControllerError: if the controller's code raised an error.
    """
    with OwnCode(type(controller)):
        return controller.statistics()


class OwnCode:
    """A block that runs the code of a class; its errors name the file and the line.

    An error of this package that the code lets through is raised unchanged.
    """

    def __init__(self, kind: Any) -> None:
        """Set the class."""
        self._kind = kind

    def __enter__(self) -> None:
        """Begin the block."""

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        """Raise an error with its place."""
        known = isinstance(error, (ConfigurationError, HangError))
        if isinstance(error, (Exception, SystemExit)) and not known:
            raise locate_error(self._kind, error) from error


def locate_error(kind: Any, error: BaseException) -> ConfigurationError | HangError:
    """Return an error that a controller's code raised, with the file and the line added.

    An error of this package that already names the cause is returned unchanged, unless the error
    comes from user code. The file and the line are those of the last frame in the file through
    which the user's code was entered. If no user code was entered, as with a wrong number of
    arguments, the file and the line are those of the method that the message names.
    """
    name = getattr(kind, "__name__", str(kind))
    text = traceback.format_exception_only(error)[-1].strip()
    file, line, function = find_frame(error)
    if isinstance(error, (ControllerError, HangError)) or (
        file is None and isinstance(error, ConfigurationError)
    ):
        return error
    if file is None and kind.__module__.startswith("greenroof_ros."):
        file, line, function, _ = traceback.extract_tb(error.__traceback__)[-1]
    named = [name for name in ("__init__", "command", "skip", "statistics") if f"{name}()" in text]
    if file is None and named:
        (file, line), function = find_place(kind, named[0]), named[0]
    return ControllerError(
        f"raises {text}", file=file, line=line,
        key=f"{name}.{function}" if function else name,
    )


def find_frame(error: BaseException) -> tuple[str | None, int | None, str]:
    """Return file, line and function of the last frame in the first user file on an error's way.

    If the error passed through no user file, there is no file and no line.
    """
    frames = [
        (frame.filename, frame.lineno, frame.name)
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith(_NO_USERS)
    ]
    return next((each for each in reversed(frames) if each[0] == frames[0][0]), (None, None, ""))


def find_place(kind: Any, *members: str) -> tuple[str | None, int | None]:
    """Return the file and line of the first method or property that is in a file, or else None.

    If a class wraps a function as ``__wrapped__``, the location of this function is returned.
    """
    for name in members:
        member: Any = getattr(kind, "__wrapped__", getattr(kind, name, None))
        member = inspect.unwrap(member)
        code = getattr(getattr(member, "fget", member), "__code__", None)
        if code is not None:
            return code.co_filename, code.co_firstlineno
    return None, None


class TickTimes:
    """Wall times of ticks (s): their mean, maximum and 99th percentile.

    The percentile covers the last 65,536 ticks, the rest all ticks.

    Attributes:
        count: number of ticks.
    """

    def __init__(self) -> None:
        """Start without ticks."""
        self.count = 0
        self._sum = 0.0
        self._max = 0.0
        self._times: deque[float] = deque(maxlen=_CAPACITY)

    def append(self, seconds: float) -> None:
        """Add the time of a tick (s)."""
        self._times.append(seconds)
        self.count += 1
        self._sum += seconds
        self._max = max(self._max, seconds)

    def statistics(self, solves: int, fallbacks: int) -> dict[str, float]:
        """Return the statistics of a controller; without ticks, the times are 0.

        Args:
            solves: number of programs that the solver attempted.
            fallbacks: number of these programs for which the solver found no solution.
        """
        return {
            "solves": solves,
            "fallbacks": fallbacks,
            "mean_s": self._sum / max(1, self.count),
            "p99_s": float(np.percentile(list(self._times) or [0.0], 99)),
            "max_s": self._max,
        }
