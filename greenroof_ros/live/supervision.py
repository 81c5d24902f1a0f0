"""Messages between a supervisor and its nodes: states, reports and the pump's permit.

They use a socket, since discovery in the graph can take seconds. This module needs no ROS.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from greenroof_ros.graph.states import STATES

# Environment variable with the file descriptor of a process's end of the socket to its supervisor.
# Its nodes write their reports to it, one JSON object per line, with the keys "node" (the node's
# name; may be missing if the process has only one) and "state". The pump node reads
# its permit from it, which comes four times a second as one JSON object per line: "inhibit" is why
# the pump must not run, empty if it may; "at" is the time since the machine started
# (CLOCK_BOOTTIME, s) at which this was decided.
SOCKET = "GREENROOF_ROS_SUPERVISOR"
# The greatest age of a permit (s).
_GREATEST_AGE_S = 2.0


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    """Whether it is a number, or None for unknown."""
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _is_list(value: object) -> bool:
    return isinstance(value, list) and all(map(_is_text, value))


def _is_diagnosis(value: object) -> bool:
    """Whether it is a part's diagnosis; see :class:`greenroof_ros.graph.reports.Diagnosis`."""
    keys = ("level", "message", "code", "cause", "since")
    return isinstance(value, dict) and all(_is_text(value.get(key)) for key in keys)


# Checks of the types that readers of a report rely on.
_IS_AS_EXPECTED: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("node", "pump", "pump_state", "failure", "fault", "unknown"), _is_text),
    **dict.fromkeys(("cistern_level", "roof_level", "command", "flow", "speed"), _is_number),
    **dict.fromkeys(("warnings", "waiting"), _is_list),
    **dict.fromkeys(("stands", "active"), lambda value: isinstance(value, bool)),
    "hold": lambda value: value is None
    or (isinstance(value, dict) and _is_text(value.get("said"))),
    "tick": lambda value: type(value) is int,
    "refused": lambda value: isinstance(value, dict)
    and all(type(count) is int for count in value.values()),
    "diagnoses": lambda value: isinstance(value, dict) and all(map(_is_diagnosis, value.values())),
}


def read_socket(number: int) -> bytes:
    """Return the data waiting in a socket; empty if the other side has ended in any way.

    Args:
        number: the socket's file descriptor.

    Raises:
        BlockingIOError: no data is waiting.
    """
    try:
        return os.read(number, 1 << 18)  # more than a socket holds
    except ConnectionResetError:  # the other side ended with data unread
        return b""


def read_report(line: bytes) -> dict[str, Any] | None:
    """Return the report in a line from the socket; None if it is not a report.

    A restarted node can have another version than its supervisor, if the package was updated in
    between. Entries whose type is not the one that readers expect are dropped.
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
    """A process's end of the socket: sends its nodes' reports; the pump node reads its permit.

    Attributes:
        given: whether the process has a supervisor, which gets its reports and ends it. Without
            one, the pump needs no permit.
    """

    def __init__(self) -> None:
        """Use the socket that the environment names, if there is one."""
        self.given = SOCKET in os.environ
        self._socket = int(os.environ[SOCKET]) if self.given else -1
        self._unsent = b""  # the rest of a report
        self._next: dict[str, bytes] = {}  # the newest after it, by node
        if self.given:
            os.set_blocking(self._socket, False)
        self._ended = False
        self._inhibit = ""
        self._at: float | None = None

    def report(self, report: Mapping[str, Any]) -> None:
        """Send a report to the supervisor, if there is one.

        A stopped supervisor must not block the node: while a report waits, a newer one of the same
        node replaces it.
        A report that is larger than the socket's buffer is sent in pieces, and always whole.
        """
        if self.given:
            self._next[report.get("node", "")] = f"{json.dumps(report)}\n".encode()
            self._send()

    def _send(self) -> bool:
        """Send as much of the waiting reports as fits; return whether none is left."""
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while self._unsent or self._next:
                if not self._unsent:
                    self._unsent = self._next.pop(next(iter(self._next)))
                self._unsent = self._unsent[os.write(self._socket, self._unsent):]
        return not self._unsent

    def flush(self, seconds: float) -> bool:
        """Send the waiting reports for at most this long (s); return whether none is left."""
        until = time.monotonic() + seconds
        while not (sent := self._send()) and time.monotonic() < until:
            time.sleep(0.05)
        return sent

    def missing(self, now: float) -> str:
        """Return why the pump must not run; empty if it may.

        Args:
            now: time since the machine started (s); includes suspends, so permits expire in them.
        """
        if not self.given:
            return ""
        self._read()
        if self._ended:
            return "bringup has ended"
        if self._at is None:
            return "bringup has given no permit yet"
        if not 0 <= now - self._at <= _GREATEST_AGE_S:  # also if it is in the future or NaN
            return f"bringup has given no permit for {_GREATEST_AGE_S:g} s"
        return self._inhibit

    def _read(self) -> None:
        """Take the newest line that has come."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            while not self._ended:
                read = read_socket(self._socket)
                self._ended = not read
                data += read
        # Lines are whole: they are short enough to be written at once. A line in another form, as
        # from a bringup of another version, is no permit.
        with contextlib.suppress(IndexError, ValueError, KeyError, TypeError):
            line = json.loads(data.splitlines()[-1])
            self._inhibit, self._at = str(line["inhibit"]), float(line["at"])


@cache
def supervisor_socket() -> SupervisorSocket:
    """Return this process's end of the socket: reports of several nodes must not mix."""
    return SupervisorSocket()
