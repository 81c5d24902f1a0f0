"""Reading of a live site's alarms, ``alarms.jsonl``, next to the bag."""

from __future__ import annotations

import json
from pathlib import Path

from greenroof_ros.interface.alarm import ALARMS, Alarm, read_record

OLDER = f"{ALARMS}.1"
"""the name that the file takes once it is full"""


def read_alarms(directory: Path) -> list[Alarm]:
    """Return the latest recorded alarms of a live site, ordered by number.

    Each line of the file contains the state of an alarm at the time of writing; the last line with
    a given number is the valid one.

    Args:
        directory: the site's directory.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if a line is not an alarm. An incomplete last line after a crash is ignored.
    """
    alarms: dict[int, Alarm] = {}
    for path in filter(Path.is_file, (directory / OLDER, directory / ALARMS)):
        *lines, _cut = path.read_bytes().split(b"\n")
        for index, line in enumerate(lines, start=1):
            try:
                alarm = read_record(json.loads(line))
            except (ValueError, TypeError, AttributeError, RecursionError) as error:
                raise ValueError(f"{path}, line {index}: is not an alarm ({error})") from error
            alarms[alarm.number] = alarm
    return sorted(alarms.values(), key=lambda alarm: alarm.number)
