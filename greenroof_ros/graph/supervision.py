"""What a supervisor and its nodes say to each other: states and reports, and the pump's permit.

Through a socket, since discovery in the graph can take seconds. No ROS is needed here.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from typing import Any

# The states of a node: not all its peers are there; they are; the run is over; so is the process.
STARTING, READY, FINISHED, ENDED = STATES = ("starting", "ready", "finished", "ended")

# What to call the node that has a role of the interface, where its name is not known.
ROLES = {"controller": "the controller", "pump": "the pump driver"}

# Nodes that their supervisors treat in their own ways.
PUMP, RECORDER = "pump", "recorder"

# The environment variable that holds the file descriptor of a started node's end of a socket to its
# supervisor. There it writes its reports, one JSON object a line with the key "state". The pump
# node reads there, four times a second, whether it may run: one JSON object a line, with the key
# "inhibit", empty or why it may not, and "at", the time since the machine started (CLOCK_BOOTTIME,
# s) at which that was so.
SOCKET = "GREENROOF_ROS_SUPERVISOR"
# How old a permit may be (s).
_GREATEST_AGE_S = 2.0


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


def read_socket(number: int) -> bytes:
    """Return what waits in a socket; nothing at its end, in whatever way the other side ended.

    Args:
        number: of its file descriptor.

    Raises:
        BlockingIOError: nothing waits.
    """
    try:
        return os.read(number, 1 << 18)  # more than waits in one
    except ConnectionResetError:  # it ended with something unread
        return b""


def read_report(line: bytes) -> dict[str, Any] | None:
    """Return the report in a line of the socket, or None where there is none.

    A node that was started again can be of another version than its supervisor, where the package
    was changed meanwhile. What is of another type than readers expect is as if it were not said.
    """
    try:
        report = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(report, dict) or report.get("state") not in STATES:
        return None
    valid = {
        key: value for key, value in report.items()
        if key not in _IS_AS_EXPECTED or _IS_AS_EXPECTED[key](value)
    }
    return {"warnings": [], "refused": {}, **valid}


class SupervisorSocket:
    """A node's end: what it reports, and for the pump node whether bringup lets the pump run.

    Attributes:
        given: whether who started the node wants its reports, and ends it; otherwise the pump
            needs no permit.
    """

    def __init__(self) -> None:
        """Take the socket that the environment names, if it does."""
        self.given = SOCKET in os.environ
        self._socket = int(os.environ[SOCKET]) if self.given else -1
        if self.given:
            os.set_blocking(self._socket, False)
        self._ended = False
        self._inhibit = ""
        self._at: float | None = None

    def report(self, report: Mapping[str, Any]) -> None:
        """Report, to who wants that.

        A reader that is stopped must not stop the node: what does not fit is dropped, and said
        again a moment later.
        """
        if self.given:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                os.write(self._socket, f"{json.dumps(report)}\n".encode())

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
                read = read_socket(self._socket)
                self._ended = not read
                data += read
        # A line is whole: so short, it is written at once. What a bringup of another version says
        # is no permit where it says something else.
        with contextlib.suppress(IndexError, ValueError, KeyError, TypeError):
            line = json.loads(data.splitlines()[-1])
            self._inhibit, self._at = str(line["inhibit"]), float(line["at"])
