"""An alarm, its record in ``alarms.jsonl`` and in a summary, and its status on /alarms."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from greenroof_ros.base.times import iso
from greenroof_ros.interface.conditions import read_conditions

OK, WARN, ERROR, STALE = range(4)
LEVELS = "ok", "warn", "error", "stale"
# The name of the file with the alarms in the site's directory, next to the bag.
ALARMS = "alarms.jsonl"
_TIMES = "since", "ended"

OTHER = "There is no advice for this code; read the log of the node that reports it."


def advise(code: str, role: str, node: str) -> str:
    """Return the advice on a condition.

    Args:
        code: code of the condition.
        role: the node's role in the interface.
        node: fully qualified name of the node, for the commands in the advice.
    """
    condition = read_conditions().get(code)
    return OTHER if condition is None else condition.advise(node, role)


@dataclass(frozen=True)
class Alarm:
    """A fault, as shown to users and stored in ``alarms.jsonl``.

    Attributes:
        number: number of the alarm, from 1 in the order of their beginnings; 0 if it is not an
            alarm, since the site is starting.
        node: fully qualified name of the node that reports the fault or does not respond.
        part: part of the node; empty for the node itself.
        role: the node's role in the interface.
        code: code of the condition.
        level: ``error``, ``stale`` (no report), or ``warn`` for a warning.
        sentence: sentence that describes the fault, as last reported.
        since: beginning of the fault (s since 1970; in the file, UTC in ISO 8601 format).
        ended: end of the fault, likewise; None while it lasts.
        seconds: duration on the steady clock (s); None while the fault lasts, or if unknown.
        follows: node and part of the alarm that causes this one; empty if there is none.
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
        """The name of the alarm's status, on /diagnostics and on /alarms."""
        return f"{self.node}: {self.part}" if self.part else self.node

    @property
    def is_serious(self) -> bool:
        """Whether this is an alarm of a node of this package, rather than a warning."""
        return bool(self.role) and self.level != LEVELS[WARN]


def to_record(alarm: Alarm) -> dict[str, Any]:
    """Return the record of an alarm for the file and for a summary."""
    record = {key.name: getattr(alarm, key.name) for key in fields(Alarm)}
    record["about"] = list(alarm.about)
    for key in _TIMES:
        if record[key] is not None:
            record[key] = iso(record[key])
    return record


def read_record(record: Mapping[str, Any]) -> Alarm:
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


# The keys of an alarm's record that are also values of its status.
_VALUES = "number", "role", "code", "fault", "since", "ended", "seconds", "follows"


def to_status(alarm: Alarm) -> tuple[int, dict[str, str]]:
    """Return the level and the values of an alarm's status on /alarms.

    The status also has the alarm's name, and its sentence as the message.
    """
    record = to_record(alarm)
    values = {key: str(record[key]) for key in _VALUES if record[key] not in (None, 0, "")}
    values |= {"about": " ".join(alarm.about), "serious": str(alarm.is_serious).lower()}
    level = OK if alarm.ended is not None else LEVELS.index(alarm.level)
    return level, {key: value for key, value in values.items() if value}


def read_status(name: str, level: int, message: str, values: Mapping[str, str]) -> Alarm:
    """Return the alarm that a status on /alarms describes; see :func:`to_status`.

    Raises:
        ValueError: if a value is not valid for an alarm.
    """
    node, _, part = name.partition(": ")
    texts = {key: values.get(key, "") for key in ("role", "code", "fault", "since", "follows")}
    lowest = ERROR if values.get("serious") == "true" else WARN
    return read_record({
        **texts, "node": node, "part": part, "number": int(values.get("number", 0)),
        "level": LEVELS[level or lowest], "sentence": message, "ended": values.get("ended"),
        "seconds": float(values["seconds"]) if "seconds" in values else None,
        "about": values.get("about", "").split(),
    })


def read_alarms(directory: Path) -> list[Alarm]:
    """Return the latest recorded alarms of a live site, ordered by number.

    Each line of the file contains the state of an alarm at the time of writing; the last line with
    a given number is the valid one.

    Args:
        directory: the site's directory.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if a line is not an alarm. An incomplete last line after a crash is ignored.
    """
    path, alarms = directory / ALARMS, dict[int, Alarm]()
    *lines, _cut = path.read_bytes().split(b"\n") if path.is_file() else [b""]
    for index, line in enumerate(lines, start=1):
        try:
            alarm = read_record(json.loads(line))
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path}, line {index}: is not an alarm ({error})") from error
        alarms[alarm.number] = alarm
    return sorted(alarms.values(), key=lambda alarm: alarm.number)
