"""The status of an alarm on /alarms."""

from __future__ import annotations

from collections.abc import Mapping

from greenroof_ros.interface.alarm import ERROR, LEVELS, OK, WARN, Alarm, read_record, to_record

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
