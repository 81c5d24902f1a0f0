"""Messages from a graph, decoded from bytes; incomplete or far too large messages become None."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from greenroof_ros.ros.reports import MAX_BYTES, Status, read_statuses

if TYPE_CHECKING:
    from greenroof_ros.ros.messages import WithFront


def _read(message: bytes, decode: Callable[[bytes], Any]) -> Any:
    """Return the content of a message; None if the message is incomplete or too large."""
    if len(message) > MAX_BYTES:
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


def read_reports(message: bytes) -> tuple[int, list[Status]] | None:
    """Return the time (ns) and the statuses of a message on /diagnostics or /alarms."""
    read: tuple[int, list[Status]] | None = _read(message, read_statuses)
    return read
