"""Disk access in a separate thread, so that time-critical code never waits for a disk."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable

# The most that may wait, and the overhead of one job (bytes): enough for minutes of a live site.
_ROOM, _JOB = 32_000_000, 200
# A job that waits for longer than this (s) is late: the disk does not respond.
PATIENCE_S = 2.0


class DiskThread:
    """A thread that runs jobs for reading and writing files, one after another.

    The thread starts with the first job, and ends when the process exits, without delaying the
    exit.

    Attributes:
        refused: number of jobs that were rejected because the queue was full or there was no
            thread.
    """

    def __init__(self, room: int = _ROOM) -> None:
        """Create the object without jobs; the thread does not start yet.

        Args:
            room: the most that may wait (bytes).
        """
        self.refused = 0
        self._room = room  # free (bytes)
        # Each waiting job's size (bytes), and when it was requested (steady clock, s).
        self._waiting: OrderedDict[Callable[[], object], tuple[int, float]] = OrderedDict()
        self._oldest = math.inf  # when the job being done was requested; inf if there is none
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def do(self, job: Callable[[], object], size: int = 0) -> bool:
        """Queue a job, and return True if the job was accepted.

        Args:
            job: function that handles its own errors. A job that equals a waiting job is not queued
                again, so a method that writes the latest value is queued only once.
            size: memory that the job's data occupies (bytes).
        """
        size += _JOB
        with self._changed:
            if job in self._waiting:
                return True
            if size > self._room or not self._started():
                self.refused += 1
                return False
            self._room -= size
            self._waiting[job] = size, time.monotonic()
            self._changed.notify_all()
        return True

    @property
    def late(self) -> bool:
        """Whether a job was requested more than 2 s ago and is still not done."""
        with self._changed:
            return time.monotonic() - self._oldest > PATIENCE_S

    def wait(self, within: float) -> bool:
        """Wait up to the given time (s) until all jobs are done; return True if they are."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._waiting and self._oldest == math.inf, within
            )

    def _started(self) -> bool:
        """Start the thread if necessary; return False if the system cannot create one."""
        if self._thread is None:
            thread = threading.Thread(target=self._do_all, name="disk", daemon=True)
            try:
                thread.start()
            except RuntimeError:
                return False
            self._thread = thread
        return True

    def _do_all(self) -> None:
        size = 0
        while True:
            with self._changed:
                self._room += size
                self._oldest = math.inf
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting)
                job, (size, self._oldest) = self._waiting.popitem(last=False)
            try:
                job()
            except Exception:  # an error in one job must not stop the others
                traceback.print_exc()


# The disk thread of this process.
DISK = DiskThread()
