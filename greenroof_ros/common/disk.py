"""Writing to disks by a thread of its own, so that nobody who must be in time waits for a disk."""

from __future__ import annotations

import errno
import json
import math
import os
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Generic, TypeVar

from greenroof_ros.common.errors import ConfigurationError

_T = TypeVar("_T")

# So much may wait (bytes), with what a job costs itself: minutes of a live site.
_ROOM, _JOB = 32_000_000, 200
# What waits for longer is late (s): the disk hangs.
PATIENCE_S = 2.0


class DiskThread:
    """Does jobs that read or write, one after the other. What has waited for long is late.

    The thread is started with the first job and ends with the process, which does not wait for it.

    Attributes:
        refused: how many jobs found no room, and were not done.
    """

    def __init__(self, room: int = _ROOM) -> None:
        """Do nothing yet.

        Args:
            room: how much may wait (bytes).
        """
        self.refused = 0
        self._room = room  # that is left (bytes)
        # What to do, how much room it has, and when it was asked for (steady clock, s).
        self._jobs: deque[tuple[Callable[[], object], int, float]] = deque()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def do(self, job: Callable[[], object], size: int = 0) -> bool:
        """Have a job done, and return whether there was room for it.

        Args:
            job: sees to its own errors. A method that writes what is newest waits once only,
                however often it is asked for.
            size: of what it keeps in memory (bytes).
        """
        size += _JOB
        with self._changed:
            if any(job == waiting for waiting, *_ in islice(self._jobs, 1, None)):
                return True
            if size > self._room or not self._started():
                self.refused += 1
                return False
            self._room -= size
            self._jobs.append((job, size, time.monotonic()))
            self._changed.notify_all()
        return True

    @property
    def late(self) -> bool:
        """Whether a job has waited for more than 2 s, or is being done for so long."""
        with self._changed:
            return bool(self._jobs) and time.monotonic() - self._jobs[0][2] > PATIENCE_S

    def wait(self, within: float) -> bool:
        """Wait until all is done, for so long at most (s); return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._jobs, within)

    def _started(self) -> bool:
        """Start the thread, and return whether the system has one to give."""
        if self._thread is None:
            thread = threading.Thread(target=self._do_all, name="disk", daemon=True)
            try:
                thread.start()
            except RuntimeError:
                return False
            self._thread = thread
        return True

    def _do_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs)
                job, size, _ = self._jobs[0]
            try:
                job()
            except Exception:  # a mistake in one job keeps no other from being done
                traceback.print_exc()
            with self._changed:
                self._jobs.popleft()
                self._room += size
                self._changed.notify_all()


# The process has one.
DISK = DiskThread()


class Newest(Generic[_T]):
    """Has the newest of what it is given written; what waits is passed over for what is newer.

    Attributes:
        problem: why what was written last is not kept, in words; empty where it is.
    """

    def __init__(self, write: Callable[[_T], None], explain: Callable[[Exception], str]) -> None:
        """Write nothing yet.

        Args:
            write: called on the disk's thread, with one after the other.
            explain: puts what that raises into words.
        """
        self.problem = ""
        self._write, self._explain = write, explain

    def give(self, value: _T) -> None:
        """Have a value written."""
        self._value = value
        if not DISK.do(self._write_newest):
            self.problem = self._explain(OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)))

    def _write_newest(self) -> None:
        try:
            self._write(self._value)
            self.problem = ""
        except Exception as error:  # whatever it is, the next value is tried again
            self.problem = self._explain(error)


_CLOSE_S = 2.0


class Kept:
    """A file of numbers by name, or of other text; the disk's thread writes it: a disk may hang.

    The file is replaced as a whole: after a power cut it is the old one or the new one.
    """

    def __init__(self, file: Path) -> None:
        """Take the file, which need not be there."""
        self._file = file
        self._newest = Newest(self._replace, str)

    @property
    def problem(self) -> str:
        """Why what was last given is not written; empty where it is, or soon will be."""
        return "the disk takes nothing" if DISK.late else self._newest.problem

    def read(self) -> dict[str, float]:
        """Return what was kept; nothing where there is no file.

        Raises:
            ConfigurationError: it cannot be read, or is no mapping of finite numbers.
        """
        try:
            content: Any = json.loads(self._file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"cannot be read: {error}", file=self._file) from error
        if not isinstance(content, dict) or not all(
            isinstance(value, float) and math.isfinite(value) for value in content.values()
        ):
            raise ConfigurationError("must be a mapping of names to numbers", file=self._file)
        return content

    def write(self, values: Mapping[str, float]) -> None:
        """Have numbers written."""
        copy = dict(values)
        self.write_text(lambda: json.dumps(copy, indent=1))

    def write_text(self, text: Callable[[], str]) -> None:
        """Have a text written, which the disk's thread asks for."""
        self._newest.give(text)

    def close(self) -> None:
        """Wait two seconds at most for what is being written."""
        DISK.wait(_CLOSE_S)

    def _replace(self, text: Callable[[], str]) -> None:
        part = self._file.with_suffix(".part")
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with part.open("w", encoding="utf-8") as stream:
            stream.write(text())
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(self._file)
