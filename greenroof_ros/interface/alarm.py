"""An alarm, and the record of a site's alarms, ``alarms.jsonl``."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.times import iso
from greenroof_ros.interface.conditions import read_conditions

OK, WARN, ERROR, STALE = range(4)
LEVELS = "ok", "warn", "error", "stale"
# The file's name in the site's directory, next to the bag, and the name it takes once it is full.
ALARMS = "alarms.jsonl"
_OLDER = f"{ALARMS}.1"
_SUMMARY = "summary.json"
# Size at which the file is renamed, replacing the previous one: over a thousand alarms (bytes).
_FULL = 1_000_000
# Number of alarms kept in memory and in the summary; all of them are counted.
_NEWEST = 200
_TIMES = "since", "ended"
# What has to be done in a terminal on the site's machine, for a person at the pump.
_RESET = "greenroof reset, in a terminal on the site's machine"

OTHER = "There is no advice for this code; read the log of the node that reports it."
FOREIGN = (
    "Reported by another device or program, not by the green roof: see the documentation of that "
    "device or program."
)
"""Advice for unknown codes, and for other devices, about which nothing is known here."""


def advise(code: str, role: str, node: str) -> str:
    """Return the advice on a condition.

    Args:
        code: code of the condition.
        role: the node's role in the interface; empty for another device.
        node: fully qualified name of the node, for the commands in the advice.
    """
    if not role:
        return FOREIGN
    condition = read_conditions().get(code)
    return OTHER if condition is None else condition.advise(node, role, reset=_RESET)


@dataclass(frozen=True)
class Alarm:
    """A fault, as shown to users and stored in ``alarms.jsonl``.

    Attributes:
        number: number of the alarm: 1, 2, ... in the order in which the alarms began.
        node: fully qualified name of the node that reports the fault or does not respond.
        part: part of the node; empty for the node itself.
        role: the node's role in the interface; empty for another device.
        code: code of the condition.
        level: ``error``, ``stale`` (no report), or ``warn`` for a warning.
        sentence: sentence that describes the fault, as last reported.
        since: beginning of the fault, as reported by the node (s since 1970; in the file, UTC in
            ISO 8601 format).
        ended: end of the fault, in the same format as its beginning; None while the fault lasts.
        seconds: duration of the fault on the steady clock (s); None while the fault lasts or if the
            duration is unknown.
        follows: node and part of the alarm that causes this alarm; empty if there is no such alarm.
        about: the topics concerned, or the nodes that are being waited for.
        fault: a device's own fault or warning.
    """

    number: int
    node: str
    part: str
    role: str
    code: str
    level: str
    sentence: str
    since: float
    ended: float | None = None
    seconds: float | None = None
    follows: str = ""
    about: tuple[str, ...] = ()
    fault: str = ""

    @property
    def name(self) -> str:
        """The name of the alarm's status on /diagnostics."""
        return f"{self.node}: {self.part}" if self.part else self.node

    @property
    def is_serious(self) -> bool:
        """Whether this is an alarm rather than a warning; other devices cause only warnings."""
        return bool(self.role) and self.level != LEVELS[WARN]

    @property
    def is_known(self) -> bool:
        """Whether there is advice for the alarm's code."""
        return bool(self.role) and self.code in read_conditions()

    @property
    def advice(self) -> str:
        """The advice on the alarm."""
        return advise(self.code, self.role, self.node)


class Change(NamedTuple):
    """A change in an alarm.

    Attributes:
        what: type of the change: ``begins``, ``changes`` (of the level or the cause), ``ends`` or
            ``returns``.
        alarm: the alarm after the change.
    """

    what: str
    alarm: Alarm


def to_record(alarm: Alarm) -> dict[str, Any]:
    """Return the record of an alarm for the file and for a summary."""
    record = {**asdict(alarm), "about": list(alarm.about)}
    for key in _TIMES:
        if record[key] is not None:
            record[key] = iso(record[key])
    return record


def _read_record(record: Mapping[str, Any]) -> Alarm:
    """Return the alarm described by a record.

    Raises:
        ValueError: if a value of the record is not valid for an alarm. TypeError: if the record's
            keys or types are not valid for an alarm.
    """
    times = {
        key: None if record.get(key) is None else datetime.fromisoformat(record[key]).timestamp()
        for key in _TIMES
    }
    return Alarm(**{**record, **times, "about": tuple(record.get("about", ()))})


def read_alarms(directory: Path) -> list[Alarm]:
    """Return the latest recorded alarms of a live site, ordered by number.

    Each line of the file contains the state of an alarm at the time of writing; the last line with
    a given number is the valid one. If there is no file, for example because the disk was full, the
    alarms in the summary are returned.

    Args:
        directory: the site's directory.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if a line or an entry is not an alarm. An incomplete last line after a crash is
            ignored, and so is an invalid summary.
    """
    alarms: dict[int, Alarm] = {}
    for path in (directory / _OLDER, directory / ALARMS):
        if path.is_file():
            alarms |= {alarm.number: alarm for alarm in _read_file(path)}
    if not alarms:
        try:
            records = json.loads((directory / _SUMMARY).read_bytes())["alarms"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return []
        try:
            alarms = {alarm.number: alarm for alarm in map(_read_record, records)}
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"{directory / _SUMMARY}: an entry of alarms is not an alarm "
            f"({error})") from error
    return sorted(alarms.values(), key=lambda alarm: alarm.number)


def _read_file(path: Path) -> Iterator[Alarm]:
    """Yield the alarm in each complete line of a file."""
    *lines, _cut = path.read_bytes().split(b"\n")
    for index, line in enumerate(lines, start=1):
        try:
            yield _read_record(json.loads(line))
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path}, line {index}: is not an alarm ({error})") from error


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
                self._file.replace(self._file.with_name(_OLDER))
                written = [*lasting, alarm]
            with self._file.open("a", encoding="utf-8") as stream:
                stream.writelines(f"{json.dumps(to_record(entry))}\n" for entry in written)
        except OSError as error:
            self._print_line(f"warning: {self._file}: {error.strerror}")


def add_alarm_count(text: str, count: int) -> str:
    """Return the text about the end of a site's run, followed by the number of alarms, if any."""
    if count == 0:
        return text
    return f"{text}, with {count} alarm{'s' if count > 1 else ''}"
