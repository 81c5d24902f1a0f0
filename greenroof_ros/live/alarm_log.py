"""The record of a live site's alarms, ``alarms.jsonl``, next to the bag."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DISK
from greenroof_ros.interface.alarm import Alarm, to_record
from greenroof_ros.results.alarm_file import OLDER, read_alarms
from greenroof_ros.ros.alarms import Change

# Size at which the file is renamed, replacing the previous one: over a thousand alarms (bytes).
_FULL = 1_000_000
# Number of alarms kept in memory and in the summary; all of them are counted.
_NEWEST = 200


class AlarmLog:
    """Log that prints every change in an alarm and stores it immediately.

    Attributes:
        last_number: number of the last alarm before the current start of the site.
        count: number of alarms since the current start, excluding warnings and alarms that follow
            from other alarms.
        changes: number of changes since the current start.
    """

    def __init__(self, print_line: Callable[[str], None], file: Path) -> None:
        """Continue the file from earlier starts, and end the alarms that are still active in it.

        Args:
            print_line: function that prints a line of text.
            file: file to which the disk thread writes every change.
        """
        self.last_number = self.count = self.changes = 0
        self._print_line, self._file = print_line, file
        self._newest: dict[int, Alarm] = {}
        self._lasting: dict[int, Alarm] = {}
        try:
            self._resume()
        except (OSError, ValueError) as error:
            print_line(f"warning: {error}; alarms from before this start will not be shown")

    def _resume(self) -> None:
        if self._file.is_file():  # a crash may have cut off its last line
            os.truncate(self._file, self._file.read_bytes().rfind(b"\n") + 1)
        began = time.time()
        for alarm in read_alarms(self._file.parent):
            self.last_number = alarm.number
            if alarm.ended is None:
                self._store(replace(alarm, ended=began))

    def as_records(self) -> list[dict[str, Any]]:
        """Return the records of the latest alarms for a summary."""
        return [to_record(alarm) for alarm in self._newest.values()]

    def add(self, changes: Iterable[Change]) -> None:
        """Print and store changes to alarms; a new level or cause is stored but not printed."""
        for what, alarm in changes:
            title = f"{'alarm' if alarm.is_serious else 'warning'} {alarm.number}"
            if what == "begins":
                self.count += alarm.is_serious and not alarm.follows
                follows = f" (follows from {alarm.follows})" if alarm.follows else ""
                self._print_line(f"{title}: {alarm.name}: {alarm.sentence}{follows}")
            elif what == "returns":
                self._print_line(f"{title} has returned: {alarm.name}: {alarm.sentence}")
            elif what == "ends":
                self._print_line(f"{title} is over, after {alarm.seconds:.1f} s: {alarm.name}")
            if what == "begins" or alarm.number in self._newest:
                self._newest[alarm.number] = alarm
            if len(self._newest) > _NEWEST:
                del self._newest[next(iter(self._newest))]
            self._lasting.pop(alarm.number, None)
            if alarm.ended is None:
                self._lasting[alarm.number] = alarm
            self.changes += 1
            self._store(alarm)

    def _store(self, alarm: Alarm) -> None:
        DISK.do(partial(self._write, alarm, tuple(self._lasting.values())))

    def _write(self, alarm: Alarm, lasting: Sequence[Alarm]) -> None:
        """Write an alarm (in the disk thread); if the file is full, begin a new file.

        A new file begins with the alarms that are still active, so that none of them is lost. A
        write error only causes a warning, since the alarm is also in the summary.
        """
        written = [alarm]
        try:
            if self._file.exists() and self._file.stat().st_size >= _FULL:
                self._file.replace(self._file.with_name(OLDER))
                written = [*lasting, alarm]
            with self._file.open("a", encoding="utf-8") as stream:
                stream.writelines(f"{json.dumps(to_record(entry))}\n" for entry in written)
        except OSError as error:
            self._print_line(f"warning: {self._file}: {error.strerror}")
