"""What a supervisor and its nodes say to each other: states and reports, and the pump's permit.

Through pipes, since discovery in the graph can take seconds. No ROS is needed here.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from typing import Any

from greenroof_ros.common.times import boot_time

# The states of a node: not all its peers are there; they are; the run is over; so is the process.
STARTING, READY, FINISHED, ENDED = STATES = ("starting", "ready", "finished", "ended")

# What to call the node that has a role of the interface, where its name is not known.
ROLES = {"controller": "the controller", "pump": "the pump driver"}

# Nodes that their supervisors treat in their own ways.
PUMP, RECORDER = "pump", "recorder"

# The environment variable that holds the file descriptor to which a started node writes its
# reports, one JSON object a line with the key "state".
REPORT_PIPE = "GREENROOF_ROS_REPORT_PIPE"

# The environment variable that holds the file descriptor from which a started pump node reads, four
# times a second, whether it may run: one JSON object a line, with the key "inhibit", empty or why
# it may not, and "at", the time since the machine started (CLOCK_BOOTTIME, s) at which that was so.
PERMIT_PIPE = "GREENROOF_ROS_PERMIT_PIPE"
# How often the permit is given, and how old it may be (s).
_PERIOD_S, _GREATEST_AGE_S = 0.25, 2.0


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    """Whether it is a number, or None, which stands for unknown."""
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _is_list(value: object) -> bool:
    return isinstance(value, list) and all(map(_is_text, value))


def _is_diagnosis(value: object) -> bool:
    """Whether it is how a part is; see :class:`greenroof_ros.graph.reports.Diagnosis`."""
    keys = ("level", "message", "code", "cause", "since")
    return isinstance(value, dict) and all(_is_text(value.get(key)) for key in keys)


# What its readers take for granted of what a report says.
_IS_AS_EXPECTED: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("pump", "pump_state", "failure", "fault", "stop"), _is_text),
    **dict.fromkeys(("cistern_level", "roof_level", "command", "flow", "speed"), _is_number),
    **dict.fromkeys(("warnings", "waiting"), _is_list),
    **dict.fromkeys(("stands", "active"), lambda value: isinstance(value, bool)),
    "tick": lambda value: type(value) is int,
    "refused": lambda value: isinstance(value, dict)
    and all(type(count) is int for count in value.values()),
    "diagnoses": lambda value: isinstance(value, dict) and all(map(_is_diagnosis, value.values())),
}


def read_report(line: bytes) -> dict[str, Any] | None:
    """Return the report in a line of the pipe, or None where there is none.

    A node that was started again can be of another version than its supervisor, where the package
    was changed meanwhile. What is of another type than readers expect is as if it were not said.
    """
    try:
        report = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(report, dict) or report.get("state") not in STATES:
        return None
    said = {
        key: value for key, value in report.items()
        if key not in _IS_AS_EXPECTED or _IS_AS_EXPECTED[key](value)
    }
    return {"warnings": [], "refused": {}, **said}


# --- the permit by which the pump node may run ----------------------------------------------------


class Permit:
    """Bringup's end: given four times a second to the pump node that runs at present."""

    def __init__(self) -> None:
        """Begin without a pump node."""
        self._writing: int | None = None
        self._told = 0.0
        self._inhibit = ""

    def open(self) -> dict[str, int]:
        """Make a pipe for a pump node that is to be started, and let go of the one before it.

        Returns:
            The reading end, by the environment variable that the node finds it by.
        """
        self.close()
        reading, self._writing = os.pipe()
        os.set_blocking(self._writing, False)
        return {PERMIT_PIPE: reading}

    def tell(self, inhibit: str) -> None:
        """Tell the pump node whether it may run, when it is time to or that has changed.

        A pump node that does not read must not stop this process.

        Args:
            inhibit: why it may not; empty where it may.
        """
        now = boot_time()
        if self._writing is None or (inhibit == self._inhibit and now - self._told < _PERIOD_S):
            return
        self._told, self._inhibit = now, inhibit
        line = json.dumps({"inhibit": inhibit, "at": now})
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._writing, f"{line}\n".encode())

    def close(self) -> None:
        """Give no further permit: the pump node finds the end of the pipe."""
        if self._writing is not None:
            os.close(self._writing)
            self._writing = None


class PermitReader:
    """The pump node's end: whether bringup lets it run.

    Attributes:
        given: whether bringup started the node; otherwise it needs no permit.
    """

    def __init__(self) -> None:
        """Take the pipe that the environment names, if it does."""
        self.given = PERMIT_PIPE in os.environ
        self._pipe = int(os.environ[PERMIT_PIPE]) if self.given else -1
        if self.given:
            os.set_blocking(self._pipe, False)
        self._ended = False
        self._inhibit = ""
        self._at: float | None = None

    def missing(self, now: float) -> str:
        """Return why the pump may not run; empty where it may.

        Args:
            now: since the machine started (s), a suspend included: no permit outlasts one.
        """
        if not self.given:
            return ""
        self._read()
        if self._ended:
            return "bringup has ended"
        if self._at is None:
            return "bringup has given no permit yet"
        if not 0 <= now - self._at <= _GREATEST_AGE_S:  # nor of a time to come, or of none
            return f"bringup has given no permit for {_GREATEST_AGE_S:g} s"
        return self._inhibit

    def _read(self) -> None:
        """Take the newest line of those that came."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            while not self._ended:
                read = os.read(self._pipe, 1 << 16)
                self._ended = not read
                data += read
        # A line is whole: so short a one is written at once. What a bringup of another version says
        # is no permit where it says something else.
        with contextlib.suppress(IndexError, ValueError, KeyError, TypeError):
            line = json.loads(data.splitlines()[-1])
            self._inhibit, self._at = str(line["inhibit"]), float(line["at"])
