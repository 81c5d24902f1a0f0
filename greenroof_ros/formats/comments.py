"""Statements ``key: value`` in the comments at the head of a file; prose is ignored."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.ranges import Range, read_number

LATITUDE, LONGITUDE = "latitude", "longitude"
"""Position of the measurements (degrees), positive to the north and east, or written as 79.40 W or
79° 24' W.
"""
WIND_HEIGHT = "wind_height"
"""height at which the wind was measured (m)"""
RAIN_LATE = "rain_late"
"""delay of the rain's time stamps, 0 or 1 h, which is reported but not corrected"""
STAMPED = "stamped"
"""position of a row's time stamp in its interval, one of :data:`STAMPS`"""
START, END = STAMPS = ("start", "end")
"""The time stamp of a row is the start or the end of its interval."""
RAIN_KIND = "rain_kind"
"""source of rain that was not measured by a gauge, one of :data:`RAIN_KINDS`"""
REANALYSIS, FORECAST = RAIN_KINDS = ("reanalysis", "forecast")
"""Results of a weather model for a past period, and for a future period."""

_NUMBERS = {
    LATITUDE: Range(-90.0, 90.0, "degrees"), LONGITUDE: Range(-180.0, 180.0, "degrees"),
    WIND_HEIGHT: Range(0.5, 100.0, "m"), RAIN_LATE: Range(0, 1, "h", whole=True),
}
_WORDS = {STAMPED: STAMPS, RAIN_KIND: RAIN_KINDS}
_COMMENT = re.compile(r"\s*(\"?#|$)")
_KEY = rf"\b({'|'.join((*_NUMBERS, *_WORDS))})\s*[:=]\s*"
# A value ends at the end of a clause, or before the next key, even an unknown one.
_STATED = re.compile(
    rf"{_KEY}(.*?)(?=[;()|]|,(?!\d)|\.(?!\d)|\s+[^\W\d]\w*\s*[:=]|\s*$)", re.IGNORECASE
)
_NUMBER = r"[-+]?\d+(?:[.,]\d*)?"
_LENGTH = re.compile(
    rf"({_NUMBER})\s*(?:[mh]|met(?:er|re)s?|hours?)?(?: above (?:the )?ground)?", re.I
)
_SIDES = {"n": 1, "north": 1, "e": 1, "east": 1, "s": -1, "south": -1, "w": -1, "west": -1}
_SIDES_OF = {LATITUDE: "ns", LONGITUDE: "ew"}
_SIDE = rf"({'|'.join(sorted(_SIDES, key=len, reverse=True))})?"
_ANGLE = re.compile(
    rf"{_SIDE}\s*({_NUMBER})\s*(?:°|º|degrees?|deg|d|:|\s)?\s*"
    rf"(?:({_NUMBER})\s*(?:'|\u2032|\u2019|minutes?|min|m|:|\s)?\s*)?"
    rf"(?:({_NUMBER})\s*(?:\"|\u2033|\u201d|''|seconds?|sec|s)?\s*)?{_SIDE}", re.IGNORECASE,
)


class Stated(NamedTuple):
    """The statements in the comments."""

    numbers: dict[str, float]
    """numbers by key, with the keys of the file"""
    stamped: str
    """one of :data:`STAMPS`"""
    rain_kind: str
    """one of :data:`RAIN_KINDS`, or empty"""
    notes: list[str]
    """notes about statements that cannot be read"""


def read_comments(file: Path) -> Stated:
    """Return the statements in the comments at the head of a file.

    If the text after a key does not have the form of a value, it counts as prose, and a note
    reports it. Each key may have only one value, although comments further down, as in appended
    files, may repeat the key.

    Raises:
        ConfigurationError: if a value is out of range, or has both a sign and a cardinal direction,
            or if a later comment states a different value.
    """
    stated: dict[str, float | str] = {}
    notes = list[str]()
    is_head = True
    with file.open(encoding="utf-8-sig") as stream:
        for number, line in enumerate(stream, 1):
            if not _COMMENT.match(line.removeprefix("\ufeff")):
                is_head = False
                continue
            for match in _STATED.finditer(line.strip().strip('"')):
                key, text = match[1].lower(), match[2].strip().rstrip(" -")
                value: float | str | None
                if key in _WORDS:
                    value = text.lower() if text.lower() in _WORDS[key] else None
                else:
                    value = _read_value(key, text, file, number)
                if value is None:
                    notes.append(
                        f"{file.name}: the comment in line {number} was ignored because its "
                        f"value is invalid: {match[0]}"
                    )
                elif value != stated.setdefault(key, value if is_head else START):
                    raise ConfigurationError(
                        "differs from the value at the head of the file: split the file into "
                        "separate files",
                        file=file, line=number, key=key, value=text,
                    )
    numbers = {key: value for key, value in stated.items() if not isinstance(value, str)}
    return Stated(
        numbers, str(stated.get(STAMPED, START)), str(stated.get(RAIN_KIND, "")), notes
    )


def _read_value(key: str, text: str, file: Path, line: int) -> float | None:
    """Return the number in a text; None if the text does not have the expected form."""
    match = (_ANGLE if key in _SIDES_OF else _LENGTH).fullmatch(text)
    if match is None:
        return None
    if key not in _SIDES_OF:
        return _NUMBERS[key].read(_read_number(match[1]), file=file, line=line, key=key)
    side = (match[1] or match[5] or "").lower()
    degrees, minutes, seconds = (_read_number(match[group] or "0") for group in (2, 3, 4))
    if side[:1] not in _SIDES_OF[key] or (match[1] and match[5]):
        return None
    if side and match[2].startswith("-"):
        raise ConfigurationError(
            "has both a sign and a cardinal direction: remove one of them",
            file=file, line=line, key=key, value=text,
        )
    if (match[3] and (degrees % 1 or not 0 <= minutes < 60)) or not 0 <= seconds < 60:
        return None
    sign = -1 if match[2].startswith("-") else 1
    value = _SIDES.get(side, 1) * (degrees + sign * (minutes / 60 + seconds / 3600))
    return _NUMBERS[key].read(value, file=file, line=line, key=key)


def _read_number(text: str) -> float:
    return read_number(text.replace(",", "."))
