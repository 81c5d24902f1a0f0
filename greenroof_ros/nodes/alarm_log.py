"""The record of a live site's alarms, ``alarms.jsonl``, next to the bag."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from greenroof_ros.base.disk import DISK
from greenroof_ros.interface.alarm import Alarm, to_record
from greenroof_ros.results.alarm_file import OLDER, read_alarms
from greenroof_ros.ros.alarms import Change, name_source

# Size at which the file is renamed, replacing the previous one: over a thousand alarms (bytes).
_FULL = 1_000_000


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
        self._warnings = set[str]()
        try:
            if file is not None:
                self._resume(file)
        except (OSError, ValueError) as error:
            tell(f"warning: {error}; alarms from before this start will not be shown")

    def _resume(self, file: Path) -> None:
        if file.is_file():  # a crash may have cut off its last line
            os.truncate(file, file.read_bytes().rfind(b"\n") + 1)
        began = time.time()
        for alarm in read_alarms(file.parent):
            self.last_number = alarm.number
            if alarm.ended is None:
                self._store(replace(alarm, ended=began))

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
            DISK.do(partial(self._write, self._file, alarm, tuple(self._lasting.values())))

    def _write(self, file: Path, alarm: Alarm, lasting: Sequence[Alarm]) -> None:
        """Write an alarm (in the disk thread); if the file is full, begin a new file.

        A new file begins with the alarms that are still active, so that none of them is lost.
        """
        written = [alarm]
        try:
            if file.exists() and file.stat().st_size >= _FULL:
                file.replace(file.with_name(OLDER))
                written = [*lasting, alarm]
            with file.open("a", encoding="utf-8") as stream:
                stream.writelines(f"{json.dumps(to_record(entry))}\n" for entry in written)
        except OSError as error:
            self._tell(f"warning: {file}: {error.strerror}")
