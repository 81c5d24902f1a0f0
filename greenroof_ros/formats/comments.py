"""What comments at the head of a file state about it: ``key: value``; prose is ignored."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.ranges import Range, read_number

LATITUDE, LONGITUDE = "latitude", "longitude"
"""place of the file (degrees), positive to north and east, or written as 79.40 W or 79° 24' W"""
WIND_HEIGHT = "wind_height"
"""height at which the wind was measured (m)"""
RAIN_LATE = "rain_late"
"""delay of the rain's time, 0 or 1 h, which is stated but not corrected"""
STAMPED = "stamped"
"""what the time of a row means, one of :data:`STAMPS`"""
START, END = STAMPS = ("start", "end")
"""The time of a row is the start or the end of the row."""
RAIN_KIND = "rain_kind"
"""where the rain is from, if no gauge measured it: one of :data:`RAIN_KINDS`"""
REANALYSIS, FORECAST = RAIN_KINDS = ("reanalysis", "forecast")
"""Results of a weather model, which follows measurements, or runs ahead of them."""

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
    """What the comments state."""

    numbers: dict[str, float]
    """numbers by key, as in the file"""
    stamped: str
    """one of :data:`STAMPS`"""
    rain_kind: str
    """one of :data:`RAIN_KINDS`, or empty"""
    notes: list[str]
    """notes about what is not read"""


def read_comments(file: Path) -> Stated:
    """Return what the comments at the head of a file state.

    Text that does not have the form of its key's value counts as prose, and is noted. A key may
    have only one value; a file that was appended to another one may state a second.

    Raises:
        ConfigurationError: if a value is out of range, or has both a sign and a cardinal point; or
            if a different one is stated later.
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
                    notes.append(f"{file.name}: line {number} is not read: {match[0]}")
                elif value != stated.setdefault(key, value if is_head else START):
                    raise ConfigurationError(
                        "differs from the head of the file: make a separate file of each part",
                        file=file, line=number, key=key, value=text,
                    )
    numbers = {key: value for key, value in stated.items() if not isinstance(value, str)}
    return Stated(
        numbers, str(stated.get(STAMPED, START)), str(stated.get(RAIN_KIND, "")), notes
    )


def _read_value(key: str, text: str, file: Path, line: int) -> float | None:
    """Return a number; None if the text is not in the expected form."""
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
            "has both a sign and a cardinal point: leave one out", file=file, line=line, key=key,
            value=text,
        )
    if (match[3] and (degrees % 1 or not 0 <= minutes < 60)) or not 0 <= seconds < 60:
        return None
    sign = -1 if match[2].startswith("-") else 1
    value = _SIDES.get(side, 1) * (degrees + sign * (minutes / 60 + seconds / 3600))
    return _NUMBERS[key].read(value, file=file, line=line, key=key)


def _read_number(text: str) -> float:
    return read_number(text.replace(",", "."))
