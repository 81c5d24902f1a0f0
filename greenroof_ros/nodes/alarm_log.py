"""The record of a live site's alarms, ``alarms.jsonl``, next to the bag."""

from __future__ import annotations

import json
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from greenroof_ros.base.disk import DiskThread
from greenroof_ros.interface.alarm import Alarm, to_record
from greenroof_ros.results.alarm_file import OLDER, read_alarms
from greenroof_ros.ros.alarms import Change, name_source

# Size at which the file is renamed, replacing the previous one: over a thousand alarms (bytes).
_FULL = 1_000_000
# How many alarms wait for a full disk, and how long the start waits for the file to be read (s).
_MAX_UNWRITTEN, _RESUMED_S = 10_000, 5.0
_NOT_SHOWN = "; alarms from before this start will not be shown"
# Its own disk thread, since the recorder's may be full of messages; a node that is made again reads
# the file after the node before it has written.
_DISK = DiskThread()


class AlarmLog:
    """Log that prints every change in an alarm and stores it immediately.

    Attributes:
        last_number: number of the last alarm in the file.
    """

    def __init__(self, tell: Callable[[str], None], file: Path | None) -> None:
        """Continue the file from earlier starts, and end the alarms that are still active in it.

        Args:
            tell: function that prints a line of text.
            file: file to which the disk thread writes every change; None to write nothing.
        """
        self.last_number = 0
        self._tell, self._file = tell, file
        self._lasting: dict[int, Alarm] = {}
        # What is not written yet: an alarm, and those that are active with it.
        self._unwritten: deque[tuple[Alarm, Sequence[Alarm]]] = deque(maxlen=_MAX_UNWRITTEN)
        self._problem = ""  # why the last write failed
        self._warnings = set[str]()
        if file is not None and not (
            _DISK.do(partial(self._resume, file)) and _DISK.wait(_RESUMED_S)
        ):
            tell(f"warning: {file}: the disk does not respond{_NOT_SHOWN}")

    def _resume(self, file: Path) -> None:
        """Read the file (in the disk thread, after what was to be written before)."""
        try:
            if file.is_file():  # a crash may have cut off its last line
                os.truncate(file, file.read_bytes().rfind(b"\n") + 1)
            began = time.time()
            for alarm in read_alarms(file.parent):
                self.last_number = alarm.number
                if alarm.ended is None:
                    self._store(replace(alarm, ended=began))
        except (OSError, ValueError) as error:
            self._tell(f"warning: {error}{_NOT_SHOWN}")

    def add(self, changes: Iterable[Change]) -> None:
        """Print and store changes to alarms; a new level or cause is stored but not printed."""
        for what, alarm in changes:
            title = f"{'alarm' if alarm.is_serious else 'warning'} {alarm.number}"
            source = name_source(alarm.name)
            if what == "begins":
                follows = f" (follows from {name_source(alarm.follows)})" if alarm.follows else ""
                self._tell(f"{title}: {source}: {alarm.sentence}{follows}")
            elif what == "returns":
                self._tell(f"{title} has returned: {source}: {alarm.sentence}")
            elif what == "ends":
                self._tell(f"{title} is over, after {alarm.seconds:.1f} s: {source}")
            self._lasting.pop(alarm.number, None)
            if alarm.ended is None:
                self._lasting[alarm.number] = alarm
            self._store(alarm)

    def warn(self, warnings: set[str]) -> None:
        """Print the warnings of nodes that are new."""
        for text in sorted(warnings - self._warnings):
            self._tell(f"warning: {text}")
        self._warnings = warnings

    def _store(self, alarm: Alarm) -> None:
        if self._file is not None:
            self._unwritten.append((alarm, tuple(self._lasting.values())))
            self.write()

    def write(self) -> None:
        """Write what is not written yet; call this often, since the disk may be full."""
        if self._file is not None and self._unwritten:
            _DISK.do(partial(self._write_all, self._file))

    def _write_all(self, file: Path) -> None:
        """Write the waiting alarms (in the disk thread), and keep those that cannot be written."""
        for entry in tuple(self._unwritten):
            try:
                _write(file, *entry)
            except OSError as error:
                problem = error.strerror or str(error)
                if problem != self._problem:
                    again = "another attempt is made every second"
                    self._tell(f"warning: {file}: {problem}; {again}")
                self._problem = problem
                return
            self._problem = ""
            if self._unwritten[0] is entry:
                self._unwritten.popleft()

    def wait(self, seconds: float) -> None:
        """Wait for a limited time (s) until everything is written."""
        _DISK.wait(seconds)


def _write(file: Path, alarm: Alarm, lasting: Sequence[Alarm]) -> None:
    """Write an alarm; if the file is full, begin a new file.

    A new file begins with the alarms that are still active, so that none of them is lost.

    Raises:
        OSError: if the alarm cannot be written; nothing is left of it in the file.
    """
    size, written = file.stat().st_size if file.exists() else 0, [alarm]
    if size >= _FULL:
        file.replace(file.with_name(OLDER))
        size, written = 0, [*lasting, alarm]
    try:
        with file.open("a", encoding="utf-8") as stream:
            stream.writelines(f"{json.dumps(to_record(entry))}\n" for entry in written)
    except OSError:
        with suppress(OSError):
            os.truncate(file, size)
        raise
