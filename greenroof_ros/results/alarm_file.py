"""Reading of a live site's alarms, ``alarms.jsonl``, next to the bag."""

from __future__ import annotations

import json
from pathlib import Path

from greenroof_ros.interface.alarm import ALARMS, Alarm, read_record


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
