"""Messages from a graph, decoded from bytes; incomplete or far too large messages become None."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from greenroof_ros.ros.messages import WithFront

_NS = 1_000_000_000
# Largest message that is read (bytes): an ensemble of forecasts has some hundred thousand.
_MAX_BYTES = 8_000_000
# Limits to one array on /diagnostics: statuses, values of each, and characters of each text. An
# array from this package has fewer than ten statuses; its longest value is a list of a hundred
# numbers.
_STATUSES, _VALUES, _TEXT = 1000, 100, 20_000


@dataclass(frozen=True)
class WireStatus:
    """One status in a message on /diagnostics.

    Attributes:
        name: fully qualified name of a node; for a part of the node, followed by ``": "`` and the
            name of the part.
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        message: the status, as a sentence.
        values: values as transmitted: JSON strings from this package's nodes, plain strings from
            their parts.
    """

    name: str
    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


def _read(message: bytes, decode: Callable[[bytes], Any]) -> Any:
    """Return the content of a message; None if the message is incomplete or too large."""
    if len(message) > _MAX_BYTES:
        return None
    with suppress(Exception):  # from the middleware, or because a text is not UTF-8
        return decode(message)
    return None


def read_value(type_name: str, message: bytes) -> Any:
    """Return the value of a message (see :func:`greenroof_ros.ros.messages.decoder`)."""
    from greenroof_ros.ros.messages import decoder  # only processes that join a graph need ROS

    return _read(message, decoder(type_name))


def read_rows(message: bytes) -> WithFront | None:
    """Return the numbers of a ``std_msgs/msg/Float64MultiArray``, and those before the offset."""
    from greenroof_ros.ros.messages import decode_numbers

    rows: WithFront | None = _read(message, decode_numbers)
    return rows


def read_statuses(message: bytes) -> tuple[int, list[WireStatus]] | None:
    """Return the time (ns) and the statuses of a ``diagnostic_msgs/msg/DiagnosticArray``.

    Strings and lists that exceed the limits above are truncated; no legitimate sender exceeds them.
    """
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.serialization import deserialize_message

    read = _read(message, lambda whole: deserialize_message(whole, DiagnosticArray))
    if read is None:
        return None
    stamp = read.header.stamp
    return int(stamp.sec) * _NS + int(stamp.nanosec), [
        # An unknown level is treated as ERROR, the worst one that someone can do something about.
        WireStatus(
            status.name[:_TEXT], level if (level := status.level[0]) <= 3 else 2,
            status.message[:_TEXT],
            {pair.key[:_TEXT]: pair.value[:_TEXT] for pair in status.values[:_VALUES]},
        )
        for status in read.status[:_STATUSES]
    ]
