"""The permit by which the pump node may run: bringup's, four times a second, through a pipe."""

from __future__ import annotations

import contextlib
import json
import os

from greenroof_ros.common.clock import boot_time
from greenroof_ros.graph.states import PERMIT_PIPE

# How often it is given, and how old it may be (s).
_PERIOD_S, _GREATEST_AGE_S = 0.25, 2.0


class Permit:
    """The writing end of the pipe to the pump node that runs at present."""

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
    """The reading end: whether bringup lets the pump node run.

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
        if now - self._at > _GREATEST_AGE_S:
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
