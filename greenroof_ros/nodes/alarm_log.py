"""The record of a live site's alarms, ``alarms.jsonl``, next to the bag."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

from greenroof_ros.base.disk import DiskThread
from greenroof_ros.base.files import replace_text
from greenroof_ros.interface.alarm import Alarm, read_alarms, to_record
from greenroof_ros.ros.alarms import describe_alarm

# Size beyond which the file is written anew, with this many of the newest alarms (bytes).
_FULL, _KEPT = 1_000_000, 1000
# How long the start waits for the file to be read (s).
_RESUMED_S = 5.0
_NOT_SHOWN = "; alarms from before this start will not be shown"
# Its own disk thread, since the recorder's may be full of messages; a node that is made again reads
# the file after the node before it has written.
_DISK = DiskThread()


class AlarmLog:
    """Log that prints every alarm that begins or ends, and stores every change immediately.

    A line is added to the file for every change. If that fails, or if the file is too large, all
    alarms are written anew.

    Attributes:
        last_number: number of the last alarm in the file.
    """

    def __init__(self, tell: Callable[[str], object], file: Path | None) -> None:
        """Continue the file from earlier starts, and end the alarms that are still active in it.

        Args:
            tell: function that prints a line of text.
            file: file to which the disk thread writes every change; None to write nothing.
        """
        self._tell, self._file = tell, file
        self._alarms: dict[int, Alarm] = {}
        self._problem = ""  # why all alarms must be written anew; empty if a line may be added
        self._write_all = partial(self._write, None)  # the same object, so that it is queued once
        if file is not None and not (_DISK.do(self._resume) and _DISK.wait(_RESUMED_S)):
            tell(f"warning: {file}: the disk does not respond{_NOT_SHOWN}")
        self.last_number = max(self._alarms, default=0)

    def _resume(self) -> None:
        """Read the file (in the disk thread), and write it anew, since its last line may be cut."""
        file, began = self._file, time.time()
        if file is None or not file.is_file():
            return
        try:
            read = {
                alarm.number: replace(alarm, ended=began if alarm.ended is None else alarm.ended)
                for alarm in read_alarms(file.parent)
            }
        except (OSError, ValueError) as error:
            self._tell(f"warning: {error}{_NOT_SHOWN}")
        else:
            self._alarms = read | self._alarms  # if it came late, there are new ones
            self._write_all()

    def add(self, changed: Iterable[Alarm]) -> None:
        """Print and store alarms; a new level or cause is stored but not printed."""
        for alarm in changed:
            title, text = _name(alarm), describe_alarm(alarm)
            if alarm.ended is not None:
                self._tell(f"{title} is over, after {alarm.seconds:.1f} s: {text}")
            elif alarm.number not in self._alarms:
                roots = "".join(
                    f" (follows from {_name(each)})" for each in self._alarms.values()
                    if each.name == alarm.follows and each.ended is None
                )
                self._tell(f"{title}: {text}{roots}")
            self._alarms[alarm.number] = alarm
            _DISK.do(partial(self._write, alarm))
        for number in [*self._alarms][:-_KEPT]:
            if self._alarms[number].ended is not None:
                del self._alarms[number]

    def write(self) -> None:
        """Try again if the last write failed; call this once a second."""
        if self._problem:
            _DISK.do(self._write_all)

    def _write(self, added: Alarm | None) -> None:
        """Add an alarm to the file, or write all of them anew (in the disk thread)."""
        file = self._file
        if file is None or (added is not None and self._problem):
            return  # all will be written anew
        alarms = [added] if added is not None else [*self._alarms.values()]
        lines = "".join(f"{json.dumps(to_record(alarm))}\n" for alarm in alarms)
        try:
            if added is None:
                replace_text(file, lines)
            else:
                with file.open("a", encoding="utf-8") as stream:
                    stream.write(lines)
            self._problem = "it is full" if file.stat().st_size > _FULL else ""
        except OSError as error:
            problem = error.strerror or str(error)
            if problem != self._problem:
                self._tell(f"warning: {file}: {problem}; another attempt is made every second")
            self._problem = problem

    def wait(self, seconds: float) -> None:
        """Wait for a limited time (s) until everything is written."""
        _DISK.wait(seconds)


def _name(alarm: Alarm) -> str:
    return f"{'alarm' if alarm.is_serious else 'warning'} {alarm.number}"
