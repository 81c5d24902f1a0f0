"""Reports of nodes to the supervisor that started them.

The reports are sent over a socket, since discovery in the graph can take seconds. This module does
not require ROS.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Mapping
from functools import cache
from typing import Any

from greenroof_ros import __version__

# Environment variable that holds the file descriptor of a process's end of the socket to its
# supervisor. Its nodes write their reports to it, one JSON object per line, with the keys "node"
# (the node's name; may be missing if the process has only one), "state" and "version" (of the
# package).
SOCKET = "GREENROOF_ROS_SUPERVISOR"


def read_report(line: bytes) -> dict[str, Any] | None:
    """Return the report in a line from the socket; None if it is not a report of this version.

    The version of a restarted node can differ from that of its supervisor if the package was
    updated in between; the node's reports are then ignored until the site is restarted.
    """
    try:
        report = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(report, dict) or report.get("version") != __version__:
        return None
    return {"warnings": [], **report}


class SupervisorSocket:
    """A process's end of the socket, which sends the reports of its nodes."""

    def __init__(self) -> None:
        """Use the socket that the environment names, if any."""
        self._enabled = SOCKET in os.environ
        self._socket = int(os.environ[SOCKET]) if self._enabled else -1
        self._unsent = b""  # the remainder of a report
        self._next: dict[str, bytes] = {}  # the newest report after it, by node
        if self._enabled:
            os.set_blocking(self._socket, False)

    def report(self, report: Mapping[str, Any]) -> None:
        """Send a report to the supervisor, if there is one.

        A stopped supervisor must not block the node: while a report waits, a newer report from the
        same node replaces it. A report that is larger than the socket's buffer is sent in pieces,
        but never incompletely.
        """
        if self._enabled:
            line = json.dumps({**report, "version": __version__})
            self._next[report.get("node", "")] = f"{line}\n".encode()
            self._send()

    def _send(self) -> bool:
        """Send as much of the waiting reports as fits, and return True if none is left."""
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while self._unsent or self._next:
                if not self._unsent:
                    self._unsent = self._next.pop(next(iter(self._next)))
                self._unsent = self._unsent[os.write(self._socket, self._unsent):]
        return not self._unsent

    def flush(self, seconds: float) -> bool:
        """Send the waiting reports for a limited time (s), and return True if none is left."""
        until = time.monotonic() + seconds
        while not (sent := self._send()) and time.monotonic() < until:
            time.sleep(0.05)
        return sent


@cache
def supervisor_socket() -> SupervisorSocket:
    """Return the only end of the socket in this process, since reports of nodes must not mix."""
    return SupervisorSocket()
