"""Messages as they are sent on the wire (CDR), read without ROS.

No length in a message is trusted: an incomplete message is None.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Result = TypeVar("_Result")

_HEADER = 4
# Limits of one array of /diagnostics: statuses, values of each, and bytes of each text. An array of
# this package has under ten statuses; its longest value is a list of a hundred numbers.
_STATUSES, _VALUES, _TEXT = 1000, 100, 20_000
# The most numbers of one message: an ensemble of forecasts has some thousands.
_NUMBERS = 1_000_000


@dataclass(frozen=True)
class WireStatus:
    """One status of /diagnostics.

    Attributes:
        name: fully qualified name of a node; for a part of it, followed by ``": "`` and the part.
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        message: a sentence.
        values: as on the wire: JSON texts from this package's nodes, plain texts from their parts.
    """

    name: str
    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


class _Cursor:
    """Reads a message, field by field."""

    def __init__(self, message: bytes) -> None:
        if len(message) < _HEADER or message[0] != 0 or message[1] > 1:
            raise ValueError
        self._order = "<" if message[1] else ">"
        self._message = message
        self._at = _HEADER

    def read(self, size: int, align: int = 1) -> bytes:
        start = self._at + (_HEADER - self._at) % align
        self._at = start + size
        if self._at > len(self._message):
            raise ValueError
        return self._message[start : self._at]

    def whole(self, kind: str = "I") -> int:
        return int(struct.unpack(self._order + kind, self.read(4, 4))[0])

    def text(self) -> str:
        length = self.whole()
        used = min(max(length - 1, 0), _TEXT)  # a NUL ends it
        return self.read(length)[:used].decode("utf-8", errors="replace")

    def numbers(self, count: int) -> NDArray[np.float64]:
        if count > _NUMBERS:
            raise ValueError
        content = self.read(8 * count, 8 if count else 1)
        return np.frombuffer(content, f"{self._order}f8").astype(np.float64)


def _whole_or_none(
    read: Callable[[_Cursor], _Result]
) -> Callable[[bytes], _Result | None]:
    """Return a reader that returns None if the message is incomplete or not of its type."""

    def reader(message: bytes) -> _Result | None:
        try:
            return read(_Cursor(message))
        except ValueError:
            return None

    reader.__doc__ = read.__doc__
    return reader


@_whole_or_none
def number(cursor: _Cursor) -> float:
    """Read the value of a ``std_msgs/msg/Float64``."""
    return float(cursor.numbers(1)[0])


@_whole_or_none
def clock(cursor: _Cursor) -> int:
    """Read the time of a ``rosgraph_msgs/msg/Clock`` (ns since 1970)."""
    return _stamp(cursor)


@_whole_or_none
def rows(cursor: _Cursor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read a ``std_msgs/msg/Float64MultiArray``: its numbers, and those in front of them.

    The numbers have the shape of the layout, if that has at least two dimensions. ``data_offset``
    skips those in front: for a forecast when it was issued and when its steps end.
    """
    shape = []
    for _ in range(min(cursor.whole(), 8)):
        cursor.text()
        shape.append(cursor.whole())
        cursor.whole()  # the stride, which follows from the sizes
    offset = cursor.whole()
    front, numbers = np.split(cursor.numbers(cursor.whole()), [offset])
    return numbers.reshape(shape) if len(shape) >= 2 else numbers, front


@_whole_or_none
def statuses(cursor: _Cursor) -> tuple[int, list[WireStatus]]:
    """Read the time (ns) and the statuses of a ``diagnostic_msgs/msg/DiagnosticArray``.

    Texts and lists that are longer than the limits above are cut: no honest sender has such.
    """
    stamp = _stamp(cursor)
    cursor.text()
    statuses = []
    for _ in range(min(cursor.whole(), _STATUSES)):
        level = cursor.read(1)[0]
        name, message = cursor.text(), cursor.text()
        cursor.text()  # the device that it is about
        values = {}
        for place in range(cursor.whole()):
            key, value = cursor.text(), cursor.text()
            if place < _VALUES:
                values[key] = value
        # An unknown level is treated as ERROR, the worst level that someone can do something about.
        statuses.append(WireStatus(name, level if level <= 3 else 2, message, values))
    return stamp, statuses


def _stamp(cursor: _Cursor) -> int:
    return cursor.whole("i") * 1_000_000_000 + cursor.whole()
