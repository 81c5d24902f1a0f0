"""Reports of nodes to the supervisor that started them.

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

from greenroof_ros.common.states import STATES

# Environment variable with the file descriptor of a process's end of the socket to its supervisor.
# Its nodes write their reports to it, one JSON object per line, with the keys "node" (the node's
# name; may be missing if the process has only one) and "state".
SOCKET = "GREENROOF_ROS_SUPERVISOR"


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    """Whether it is a number, or None for unknown."""
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _is_list(value: object) -> bool:
    return isinstance(value, list) and all(map(_is_text, value))


def _is_status(value: object) -> bool:
    """Whether it is the status of a part, as on /diagnostics."""
    if not isinstance(value, dict) or not isinstance(values := value.get("values"), dict):
        return False
    texts = value.get("message"), *values.values()
    return value.get("level") in range(4) and all(map(_is_text, texts))


# Checks of the types that readers of a report rely on.
_IS_AS_EXPECTED: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys((
        "node", "role", "process", "pump_state", "pump_why", "failure", "drive_state",
    ), _is_text),
    **dict.fromkeys(("cistern_level", "roof_level", "command"), _is_number),
    **dict.fromkeys(("warnings", "waiting"), _is_list),
    "diagnoses": lambda value: isinstance(value, dict) and all(map(_is_status, value.values())),
}


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
    """A process's end of the socket: sends its nodes' reports."""

    def __init__(self) -> None:
        """Use the socket that the environment names, if there is one."""
        self._enabled = SOCKET in os.environ
        self._socket = int(os.environ[SOCKET]) if self._enabled else -1
        self._unsent = b""  # the rest of a report
        self._next: dict[str, bytes] = {}  # the newest after it, by node
        if self._enabled:
            os.set_blocking(self._socket, False)

    def report(self, report: Mapping[str, Any]) -> None:
        """Send a report to the supervisor, if there is one.

        A stopped supervisor must not block the node: while a report waits, a newer one of the same
        node replaces it.
        A report that is larger than the socket's buffer is sent in pieces, and always whole.
        """
        if self._enabled:
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


@cache
def supervisor_socket() -> SupervisorSocket:
    """Return this process's end of the socket: reports of several nodes must not mix."""
    return SupervisorSocket()
